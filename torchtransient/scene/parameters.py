"""Table of a scene's parameters: shapes, values, and which of them have derivatives.

Keys are those of ``mitsuba.traverse``, with the names of Mitsuba 3.9 for the arrays of meshes in every version. Meshes
apply ``to_world`` while loading and forget it; a key ``<mesh>.to_world`` is offered for them all the same: the matrix
replaces the one of the description, and vertices and normals follow.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torchtransient.errors import UnknownKeyError
from torchtransient.interfaces import IntegratorInterface
from torchtransient.plugins.mitsuba_compat import FACES, POSITIONS, VERTEX_COLUMNS, key_beside
from torchtransient.plugins.node_walk import ShownValue, unshared
from torchtransient.plugins.parameter_effect import UNCHECKED, is_checked
from torchtransient.plugins.parameters import ParameterEffect, ParameterTracker
from torchtransient.plugins.transport.boundary.moving_edges import Gap, MovingEdges, moves_edges, moving_edges
from torchtransient.scene.build import BuiltScene
from torchtransient.scene.objects import without_stand_in

_MAX_LISTED = 65536  # larger values are not copied: textures of a real scene would fill the memory once more
# Names that plugins have for the same: where an object is, and how bright.
_ONE_MEANING = ({"to_world", "position", "origin"}, {"intensity", "radiance", "irradiance", "color", "colour"})


@dataclass(frozen=True)
class ParameterInfo:
    """Parameter of a scene: shape, value, and the properties of its derivative.

    Attributes:
        key: name in ``mitsuba.traverse``, and in ``TransientRenderer(parameters=...)``.
        kind: form of Mitsuba's value: number, list, vector, points, vertices, tensor, transform, mesh_transform,
            integer, plain.
        shape: shape of the torch value without a batch dimension, None for values that are not numeric.
        value: current value as numpy, None for more than 65536 numbers (``renderer.values[key]`` has them).
        differentiable: a derivative exists.
        moves_path_length, moves_silhouette, moves_medium: it can change an optical path length, move a visibility
            edge, change an extinction.
        reason: why there is no derivative, or where it is wrong.
        substitute: materials that are replaced by differentiable ones for this key: name, and the name of the texture
            in it ("" for a number).
        always_biased: the derivative is known to be wrong in every scene.
        edges_missing: moving edges that the derivative does not follow in this scene, in words.
        has_boundary_term: it moves edges, and the derivative follows them.
        is_velocity: films of rates alone measure it.
        place: names of the parameter and of the plugins around it.
        checked: the sweep of gradients has compared it with finite differences in such a place
            (``docs/gradients_sweep.md``).
    """

    key: str
    kind: str
    shape: tuple[int, ...] | None
    value: Any
    differentiable: bool
    moves_path_length: bool
    reason: str
    substitute: frozenset[tuple[str, str]] = frozenset()
    moves_silhouette: bool = False
    moves_medium: bool = False
    always_biased: bool = False
    edges_missing: tuple[str, ...] = ()
    has_boundary_term: bool = False
    is_velocity: bool = False
    place: tuple[str, ...] = ()
    checked: bool = True

    @property
    def biased(self) -> bool:
        """The derivative is known to be wrong: in every scene, or at edges of this one."""
        return self.always_biased or bool(self.edges_missing)


class ParameterTable(Mapping[str, ParameterInfo]):
    """Parameters of a scene by key. ``str(table)`` is a readable table.

    Args:
        entries: the parameters, in order.
    """

    def __init__(self, entries: list[ParameterInfo]):
        self._entries = {entry.key: entry for entry in entries}

    def __getitem__(self, key: str) -> ParameterInfo:
        if key not in self._entries:
            raise UnknownKeyError(unknown_key(key, list(self._entries)))
        return self._entries[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def differentiable(self) -> list[str]:
        """Return the keys that have a derivative."""
        return [key for key, entry in self.items() if entry.differentiable]

    def __str__(self) -> str:
        rows = [("key", "shape", "value", "derivative")]
        for entry in self._entries.values():
            shape = "-" if entry.shape is None else str(entry.shape)
            mark = "" if entry.differentiable else "no: "
            rows.append((entry.key, shape, _short(entry.value), mark + entry.reason))
        widths = [max(len(row[i]) for row in rows) for i in range(3)]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row[:3], widths, strict=True)) + "  " + row[3]
            for row in rows
        ]
        lines.insert(1, "-" * max(len(line) for line in lines))
        return "\n".join(lines)

    __repr__ = __str__


def unknown_key(key: str, known: list[str], owner: str = "the scene") -> str:
    """Return the message for an unknown key, with similar keys.

    Args:
        key: the unknown key.
        known: all keys of the owner.
        owner: subject of the message.
    """
    inside = [other for other in known if f".{key}." in f".{other}."] or _of_one_meaning(str(key), known)
    close = inside[:3] or difflib.get_close_matches(str(key), known, n=3, cutoff=0.5)
    hint = f"Did you mean {', '.join(repr(c) for c in close)}? " if close else ""
    return f"{owner} has no parameter {key!r}. {hint}print(scene.parameters()) lists all keys."


def _of_one_meaning(key: str, known: list[str]) -> list[str]:
    """Return keys of the object of an unknown key that say the same of it: of a point light ``position``, the place
    that others have as ``to_world``."""
    parts = key.split(".")
    for end in range(len(parts) - 1, 0, -1):
        owner = ".".join(parts[:end]) + "."
        own = [other for other in known if other.startswith(owner)]
        if own:
            meant = set().union(*(names for names in _ONE_MEANING if not names.isdisjoint(parts[end:])))
            return [other for other in own if not meant.isdisjoint(other.removeprefix(owner).split("."))]
    return []


def _short(value: Any) -> str:
    if value is None:
        return "(large)"
    if isinstance(value, np.ndarray):
        if value.size > 4:
            return f"mean {float(np.mean(value)):.4g}"
        return np.array2string(value, precision=4, separator=", ").replace("\n", "")
    return f"{value:.6g}" if isinstance(value, float) else str(value)


# ------------------------------------------------------------------------------------------------------ the table


def parameter_table(built: BuiltScene) -> ParameterTable:
    """Return the table of a built scene (unmerged, real bitmaps, no substitutions). Called inside its variant.

    Args:
        built: the built scene.
    """
    tracker = ParameterTracker(built.scene)
    edges = _moving_edges_of(built.scene, built.scene.sensors())
    entries = []
    for key in built.params.properties:
        node = built.params.properties[key][2]
        found = [_describe(built, tracker, key, node)]
        if key.endswith(f".{POSITIONS}"):
            matrix = built.mesh_to_world.get(node.id(), np.eye(4)).astype(np.float32)
            effect = tracker.effect_of(node, "to_world")
            found.append(_info(f"{key.rsplit('.', 1)[0]}.to_world", "mesh_transform", (4, 4), matrix, effect))
        entries += [_placed(_with_gaps(info, edges, tracker, node), tracker, node) for info in found]
    return ParameterTable(entries)


def _moving_edges_of(scene: Any, sensors: Sequence[Any]) -> MovingEdges:
    """Return the gaps of derivatives at moving edges that some sensors see, by the scene's integrator.

    Args:
        scene: built scene.
        sensors: some of its sensors.
    """
    integrator = scene.integrator()
    if isinstance(integrator, IntegratorInterface):
        edges: MovingEdges = integrator.silhouettes(scene, sensors)
        return edges
    return moving_edges(scene, sensors)


def missing_edges(built: BuiltScene, keys: Iterable[str], sensors: Iterable[int]) -> dict[Gap, list[str]]:
    """Return the gaps of derivatives at moving edges.

    Args:
        built: built scene.
        keys: keys of the derivatives.
        sensors: indices of the sensors that see the edges.

    Returns:
        Keys by gap.
    """
    every = built.scene.sensors()
    edges = _moving_edges_of(built.scene, [every[sensor] for sensor in sensors])
    tracker = built.scene.integrator().parameters(built.scene)
    found: dict[Gap, list[str]] = {}
    for key in keys:
        shown = key if key in built.params else key_beside(key, POSITIONS)
        node = built.params.properties[shown][2]
        for gap in edges.lacking(node, key, tracker.effect_of(node, key)):
            found.setdefault(gap, []).append(key)
    return found


def _with_gaps(info: ParameterInfo, edges: MovingEdges, tracker: ParameterTracker, node: Any) -> ParameterInfo:
    """Return the parameter with the gaps of its derivative at moving edges."""
    if not (info.differentiable and info.moves_silhouette):
        return info
    effect = replace(tracker.effect_of(node, info.key), reason=info.reason)
    missing = tuple(gap.where for gap in edges.lacking(node, info.key, effect))
    followed = edges.has_term and moves_edges(info.key, effect)
    reason = edges.reason(node, info.key, effect)
    return replace(info, edges_missing=missing, has_boundary_term=followed, reason=reason)


def _placed(info: ParameterInfo, tracker: ParameterTracker, node: Any) -> ParameterInfo:
    """Return the parameter with its place, and whether the sweep of gradients covers that."""
    if not info.differentiable:
        return info
    place = tracker.location_of(node, info.key)
    if is_checked(place):
        return replace(info, place=place)
    return replace(info, place=place, checked=False, reason=f"{info.reason}; {UNCHECKED}")


def _info(key: str, kind: str, shape: tuple[int, ...] | None, value: Any, effect: ParameterEffect) -> ParameterInfo:
    return ParameterInfo(
        key,
        kind,
        shape,
        value,
        effect.supported,
        effect.moves_length,
        effect.reason,
        moves_silhouette=effect.moves_silhouette,
        moves_medium=effect.moves_medium,
        always_biased=effect.biased,
        is_velocity=effect.role == "velocity",
    )


def _describe(built: BuiltScene, tracker: ParameterTracker, key: str, node: Any) -> ParameterInfo:
    import mitsuba as mi

    # Not by `built.params[key]`, which fails for parameters that are not set, such as the absorption of hair.
    handle, cpptype, _, _ = built.params.properties[key]
    current = ShownValue(key, handle, 0, cpptype).read(node)  # type: ignore[call-arg]
    name = key.rsplit(".", 1)[-1]
    kind, shape = classify(key, current)
    value = read_value(current, shape) if shape is None or math.prod(shape) <= _MAX_LISTED else None
    effect = tracker.effect_of(node, name, built.params.flags(key))
    if effect.stand_in:
        holders = tracker.replaced_plugins(node, name)
        if built.loaded.intersection(plugin.ptr for plugin, _ in holders):
            return _info(key, kind, shape, value, without_stand_in(effect, holders[0][0]))
        if isinstance(node, mi.BSDF):
            # The plugin that is built in its place has a number there, whatever Mitsuba's has.
            kind, shape, value = "number", (), float(np.reshape(np.asarray(value), ()))
            effect = tracker.effect_of(node, name)
        exchanged = frozenset((plugin.id(), slot) for plugin, slot in holders)
        return replace(_info(key, kind, shape, value, effect), substitute=exchanged)
    if kind == "plain":
        effect = replace(effect, supported=False, reason="a plain value, fixed when the scene is built")
    elif kind == "integer":
        reason = "a list of vertex numbers" if name == FACES else "not a real number"
        effect = replace(effect, supported=False, reason=reason)
    elif kind == "vertices" and shape is not None and shape[0] == 0:
        effect = replace(effect, supported=False, reason="the mesh has none")
    return _info(key, kind, shape, value, effect)


def needing_slope(infos: Mapping[str, ParameterInfo], keys: Iterable[str], rates: bool = False) -> list[str]:
    """Return the keys that can change a path length, whose derivatives need a film with a slope in time.

    Args:
        infos: parameters by key.
        keys: some of the keys.
        rates: the film measures rates, so that velocities need a slope, too.
    """
    return [key for key in keys if infos[key].moves_path_length and (rates or not infos[key].is_velocity)]


def is_transform(value: Any) -> bool:
    """Return whether a value is a transform of Mitsuba.

    By name of its class: Dr.Jit arrays answer to any attribute made of component letters.

    Args:
        value: any value.
    """
    return "Transform" in type(value).__name__


def classify(key: str, current: Any) -> tuple[str, tuple[int, ...] | None]:
    """Return kind and shape of the torch value of a parameter.

    Args:
        key: key of the parameter; its name tells vertices from lists.
        current: Mitsuba's value.

    Returns:
        A kind of :class:`ParameterInfo`, and the shape, None for a value that is not numeric.
    """
    import drjit as dr

    if current is None:
        return "plain", None
    if is_transform(current):
        size = len(current.matrix)
        return "transform" if dr.is_jit_v(current.matrix) else "plain", (size, size)
    if not dr.is_jit_v(current):
        if dr.is_array_v(current):
            return "plain", (len(current),)
        return "plain", () if isinstance(current, (bool, int, float)) else None
    columns = VERTEX_COLUMNS.get(key.rsplit(".", 1)[-1])
    if columns is not None and dr.is_float_v(current) and (dr.is_tensor_v(current) or dr.depth_v(current) == 1):
        return "vertices", (dr.width(current) // columns, columns)
    if dr.is_tensor_v(current):
        return "tensor" if dr.is_float_v(current) else "integer", tuple(int(n) for n in current.shape)
    if not dr.is_float_v(current):
        return "integer", (dr.width(current),)
    if dr.depth_v(current) == 2:
        width = dr.width(current)
        several = width > 1 or key.rsplit(".", 1)[-1] == "points"
        return ("points", (width, len(current))) if several else ("vector", (len(current),))
    size = dr.width(current)
    return ("number", ()) if size == 1 else ("list", (size,))


def read_value(current: Any, shape: tuple[int, ...] | None) -> Any:
    """Return a Mitsuba value as numpy, plain Python values unchanged.

    Args:
        current: Mitsuba's value.
        shape: shape of its torch value (:func:`classify`), None for the name of the type of other objects.
    """
    import drjit as dr

    if is_transform(current):
        current = current.matrix
    elif current is None:
        return None
    elif not dr.is_array_v(current):
        return current if shape == () else type(current).__name__
    current = unshared(current)
    if dr.is_jit_v(current) and not dr.is_tensor_v(current) and len(shape or ()) == 2 and dr.depth_v(current) == 2:
        return np.array(current).T.reshape(shape)
    # Arrays of width one come with a trailing dimension of one.
    return np.array(current).reshape(shape)


# ---------------------------------------------------------------------------------------------- values in a scene
