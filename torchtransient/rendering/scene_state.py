"""What a ``mitsuba.SceneParameters`` holds: remembered, put back, and written from torch tensors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from torchtransient.errors import SceneError, TorchTransientError, UnknownKeyError
from torchtransient.plugins.mitsuba_compat import check_pose, is_turned_by_reflections
from torchtransient.plugins.node_walk import ShownValue
from torchtransient.rendering.interrupts import quiet
from torchtransient.rendering.mitsuba_words import one_line
from torchtransient.rendering.parameters import (
    as_mitsuba_value,
    changed_with,
    classify,
    is_transform,
    read_value,
    unknown_key,
)


def variant_of(params: Any) -> str | None:
    """The variant of the scene behind ``params``; None where there is no parameter."""
    for _, _, node, _ in params.properties.values():
        return str(node.variant_name())
    return None


def values_of(params: Any) -> dict[str, Any]:
    """Every value that can be written, by key: handles, no copies of memory."""
    import mitsuba as mi

    found = {}
    for key, (handle, cpptype, node, flags) in params.properties.items():
        if flags & mi.ParamFlags.ReadOnly.value:
            continue
        try:
            value = ShownValue(key, handle, 0, cpptype).read(node)  # type: ignore[call-arg]
        except (RuntimeError, TypeError):
            continue
        if value is not None:  # not set, as the absorption of hair
            found[key] = _handle(value)
    return found


def _handle(value: Any) -> Any:
    """An object of one's own for the same memory: the plugin's own would follow what is written."""
    import drjit as dr

    return type(value)(value) if dr.is_jit_v(value) or is_transform(value) else value


def _same(a: Any, b: Any) -> bool:
    """Whether two values are the same memory and the same node of the graph of derivatives; equal plain ones."""
    import drjit as dr

    if type(a) is not type(b):
        return False
    first, second = dr.detail.collect_indices(a), dr.detail.collect_indices(b)
    if first or second:
        return bool(first == second)
    return a is b or bool(np.all(a == b))


def put_back(params: Any, values: Mapping[str, Any], now: Mapping[str, Any] | None = None) -> None:
    """Write those of ``values`` that the scene does not hold ``now`` any more, and let the scene follow."""
    now = values_of(params) if now is None else now
    keys = [key for key, value in values.items() if key not in now or not _same(value, now[key])]
    if not keys:
        return
    # Mitsuba recomputes normals when positions change: both have to go back.
    normals = [key.replace(".vertex_positions", ".vertex_normals") for key in keys]
    keys = list(dict.fromkeys(key for key in (*keys, *normals) if key in values))
    for key in keys:
        params[key] = values[key]
    _follow(params, keys)


def _follow(params: Any, keys: Sequence[str]) -> None:
    for key in (*keys, *changed_with(keys, params)):
        params.set_dirty(key)
    with quiet():
        params.update()


def detached(values: Mapping[str, Any]) -> dict[str, Any]:
    """The values without derivatives of Dr.Jit: to a wrapped function they are constants."""
    import drjit as dr

    return {key: dr.detach(value) if dr.grad_enabled(value) else value for key, value in values.items()}


def shapes_of(params: Any, keys: Iterable[str], name: str) -> dict[str, tuple[int, ...]]:
    """The shapes of torch values for some keys. Raises ``UnknownKeyError`` and ``SceneError``."""
    found = {}
    for key in keys:
        if key not in params.properties:
            hint = unknown_key(str(key), list(params.properties), "`parameters`")
            raise UnknownKeyError(f"{name}: {hint.replace('scene.parameters()', 'params')}")
        kind, shape = classify(key, params[key])
        if kind in ("plain", "integer") or shape is None:
            raise SceneError(
                f"{name}: the parameter {key!r} is not an array of real numbers; write it into the scene before the "
                "call, params[key] = value."
            )
        found[key] = shape
    return found


def write(params: Any, leaves: Mapping[str, Any], name: str) -> None:
    """Set parameters from flat Dr.Jit arrays by operations that can be differentiated, and let the scene follow."""
    try:
        for key, leaf in leaves.items():
            current = params[key]
            kind, shape = classify(key, current)
            _check_pose(params, key, leaf, read_value(current, shape) if kind == "transform" else None)
            params[key] = as_mitsuba_value(kind, shape or (), current, leaf)
        _follow(params, tuple(leaves))
    except (RuntimeError, ValueError, TypeError) as error:
        if isinstance(error, TorchTransientError):
            raise
        raise SceneError(f"{name}: values of {', '.join(leaves)}: Mitsuba refuses them: {one_line(error)}") from error


def _check_pose(params: Any, key: str, leaf: Any, current: Any) -> None:
    node = params.properties[key][2]
    if current is not None and is_turned_by_reflections(node.class_name(), key.rsplit(".", 1)[-1]):
        check_pose(key, current, np.array(leaf))
