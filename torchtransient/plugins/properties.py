"""Numbers of plugins, checked: properties by type and range, parameters of built scenes for NaN and infinity."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.checks import shown
from torchtransient.errors import SceneError
from torchtransient.plugins.mitsuba_compat import VERTEX_COLUMNS, rows_of_faces
from torchtransient.plugins.node_walk import ShownValue

# ----------------------------------------------------------------------------------------------------------------------
# Numbers and truth values of a plugin's properties, checked where Python would take others for them.
#

# Kernels count in 32 bits.
MOST = 2**32 - 2


def whole_number(props: Any, name: str, default: int, least: int = -1) -> int:
    """Return a whole number of a plugin's properties.

    Args:
        props: ``mi.Properties``.
        name: name of the property.
        default: value without it.
        least: least value that is allowed; the largest one is 2^32 - 2.

    Raises:
        SceneError: for other values.
    """
    given = props.get(name, default)
    if isinstance(given, bool) or not isinstance(given, (int, float)) or given != given // 1:
        raise SceneError(f"{props.plugin_name()}: {name}: expected a whole number, got {shown(given)}.")
    if not least <= given <= MOST:
        raise SceneError(
            f"{props.plugin_name()}: {name}: expected a whole number from {least} to 2^32 - 2, got {shown(given)}."
        )
    return int(given)


def number(props: Any, name: str, default: float | None = None) -> float:
    """Return a finite number of a plugin's properties.

    Args:
        props: ``mi.Properties``.
        name: name of the property.
        default: value without it; None: it has to be there.

    Raises:
        SceneError: for other values.
    """
    given = props[name] if default is None else props.get(name, default)
    if isinstance(given, bool) or not isinstance(given, (int, float)):
        raise SceneError(
            f"{props.plugin_name()}: {name}: expected a number, got {shown(given)}. It takes no texture and no text."
        )
    if not math.isfinite(given):
        raise SceneError(f"{props.plugin_name()}: {name}: expected a finite number, got {shown(given)}.")
    return float(given)


def vector(props: Any, name: str, default: Sequence[float]) -> list[float]:
    """Return three finite numbers of a plugin's properties.

    Args:
        props: ``mi.Properties``.
        name: name of the property.
        default: value without it, (3,).

    Raises:
        SceneError: for other values.
    """
    given = np.array(props.get(name, default), dtype=np.float64).reshape(-1)
    if len(given) != 3 or not np.isfinite(given).all():
        raise SceneError(f"{props.plugin_name()}: {name}: expected three finite numbers, got {shown(given.tolist())}.")
    return [float(x) for x in given]


def truth(props: Any, name: str, default: bool) -> bool:
    """Return a property that is true or false, or 1 or 0.

    Args:
        props: ``mi.Properties``.
        name: name of the property.
        default: value without it.

    Raises:
        SceneError: for other values.
    """
    given = props.get(name, default)
    if not isinstance(given, (bool, int, float)) or given not in (0, 1):
        raise SceneError(f"{props.plugin_name()}: {name}: expected true or false, got {shown(given)}.")
    return bool(given)


# ----------------------------------------------------------------------------------------------------------------------
# Whether the numbers of a scene are numbers: NaN and infinity are found before anything is rendered.
# A texture with a NaN in it takes light away without a word, an infinite light fills every bin. No parameter of
# Mitsuba's plugins or of ours has a meaning for either.


def check_parameters(params: Any) -> None:
    """Check that the parameters of a built scene are finite.

    Vertices of a mesh count where a face has them: files come with others that no ray can meet.

    Args:
        params: ``mi.traverse`` of the scene.

    Raises:
        SceneError: with the keys of those that are not.
    """
    bad = {}
    for key, (handle, cpptype, node, _) in params.properties.items():
        array = numbers_of(ShownValue(key, handle, 0, cpptype).read(node))
        if array is not None and not np.isfinite(array).all():
            name = key.rsplit(".", 1)[-1]
            if isinstance(node, mi.Mesh) and (name in VERTEX_COLUMNS or name.startswith("vertex_")):
                array = _at_faces(node, name, array)
            count_bad(bad, key, array)
    refuse(bad)


def count_bad(bad: dict[str, str], key: str, array: np.ndarray) -> None:
    """Note how many numbers of an array are not finite, if any are not.

    Args:
        bad: notes by key, for :func:`refuse`; changed.
        key: key of the array.
        array: numbers of any shape.
    """
    wrong = int(array.size - np.isfinite(array).sum())
    if wrong:
        bad[key] = f"{wrong} of {array.size}" if array.size > 1 else str(float(array.reshape(-1)[0]))


def refuse(bad: Mapping[str, str]) -> None:
    """Raise for the bad numbers that :func:`count_bad` has noted, if there are any.

    Args:
        bad: notes by key.

    Raises:
        SceneError: with the keys.
    """
    if not bad:
        return
    listed = "; ".join(f"{key!r} ({count})" for key, count in bad.items())
    raise SceneError(
        f"expected finite numbers, got NaN or infinity in {listed}. Mend the value or the file that it comes from."
    )


def numbers_of(value: Any) -> np.ndarray | None:
    """Return the real numbers of a value of Mitsuba, detached.

    Args:
        value: property or parameter: number, transform, spectrum, bitmap, grid or Dr.Jit array.

    Returns:
        Numpy array of the value's shape, None for values without real numbers (text, whole numbers, objects).
    """
    if isinstance(value, (bool, int, str)) or value is None:
        return None
    if isinstance(value, float):
        return np.array(value)
    if "Transform" in type(value).__name__:  # by name: Dr.Jit arrays answer to any attribute of component letters
        value = value.matrix
    if hasattr(value, "wavelengths") and hasattr(value, "values"):  # a spectrum as a property of a plugin
        return np.array([*value.wavelengths, *value.values])
    if isinstance(value, (mi.Bitmap, mi.VolumeGrid, np.ndarray)):
        array = np.asarray(value)
    elif dr.is_array_v(value) and dr.is_float_v(value):
        # of a copy: to read a literal evaluates it, and shows the scene another array
        array = _components(dr.detach(value))
    else:
        return None
    return array if array.dtype.kind == "f" else None


def _components(value: Any) -> np.ndarray:
    """All numbers, read one component at a time: to put them into one array would take a kernel."""
    if dr.depth_v(value) > 1 and not dr.is_tensor_v(value):
        return np.concatenate([_components(entry).reshape(-1) for entry in value])
    return np.array(value)


def _at_faces(mesh: Any, name: str, array: np.ndarray) -> np.ndarray:
    """Return the entries of an array or attribute at vertices that faces refer to."""
    rows = array if array.ndim > 1 else array.reshape(mesh.vertex_count(), -1)
    return rows[rows_of_faces(mesh, name)]
