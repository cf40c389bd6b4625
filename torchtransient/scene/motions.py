"""Motions of bodies in a description: `rigid_motion` children of whatever moves, and volumes of media."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torchtransient.checks import shown, some_of
from torchtransient.errors import ArgumentError, GradientError, SceneError
from torchtransient.plugins import kind_of
from torchtransient.plugins.mitsuba_compat import VELOCITY
from torchtransient.scene.nodes import children, name_children, node_kind

PLUGIN = "rigid_motion"
# Child of a body that says how it moves, and end of the name of the motion.
CHILD = "velocity"
_BODIES = ("shape", "emitter", "sensor", "medium")


@dataclass(frozen=True)
class BodyMotion:
    """Velocity of a body, as numbers: metres, seconds and radians, in the world.

    Args:
        of: name of the body.
        linear: velocity of ``center``, m/s.
        angular: axis of rotation times angular speed, rad/s.
        center: point on the axis, metres.
    """

    of: str
    linear: tuple[float, float, float]
    angular: tuple[float, float, float]
    center: tuple[float, float, float]


def body_motions(motions: Mapping[str, Any]) -> list[BodyMotion]:
    """Return motions as numbers.

    Args:
        motions: a :class:`torchtransient.Motion` by the name of each body.

    Raises:
        ArgumentError: for anything but motions.
        GradientError: for motions with gradients.
    """
    found = []
    for name, motion in motions.items():
        if not all(hasattr(motion, part) for part in ("linear", "angular", "center")):
            raise ArgumentError(f"scene.moving: expected a tt.Motion for {name!r}, got {shown(motion)}.")
        if any(getattr(getattr(motion, part), "requires_grad", False) for part in ("linear", "angular", "center")):
            raise GradientError(
                f"scene.moving: expected numbers for {name!r}, which become parameters, got a tensor with a gradient. "
                f"Give that to the renderer: values={{'{name}.{CHILD}.linear': tensor}}, of its parameters=."
            )
        parts = ([float(x) for x in getattr(motion, part)] for part in ("linear", "angular", "center"))
        found.append(BodyMotion(str(name), *map(tuple, parts)))  # type: ignore[arg-type]
    return found


def place_motions(state: Any, motions: Sequence[BodyMotion]) -> None:
    """Make the motions of bodies children of the scene, ``NAME.velocity``; Mitsuba refuses them of most plugins.

    Args:
        state: ``mitsuba.parser.ParserState``, changed in place.
        motions: motions that take the place of described ones.
    """
    import mitsuba as mi

    moving = [(node, key, index) for node in state.nodes for key, index in _motions_of(state, node)]
    if not motions and not moving and all(node.props.plugin_name() != PLUGIN for node in state.nodes):
        return
    name_children(state)
    for node, key, index in moving:
        _place(state, node, key, index)
    described = {state.nodes[index].props.get("of", ""): index for _, index in children(state, state.root)}
    names = {node.props.id() for node in state.nodes if _is_body(node)}
    for motion in motions:
        if motion.of not in names:
            known = some_of(sorted(name for name in names if name and not name.startswith("_")))
            raise SceneError(f"scene.moving: expected the name of a body, one of {known}, got {motion.of!r}.")
        for key, index in children(state, state.root):
            if state.nodes[index].props.id() == f"{motion.of}.{CHILD}" and _is_volume(state.nodes[index]):
                del state.root.props[key]
        index = described.get(motion.of, -1)
        if index < 0 or state.nodes[index].props.plugin_name() != PLUGIN:
            node = mi.parser.SceneNode()
            node.type, node.props = mi.ObjectType.Texture, mi.Properties(PLUGIN)
            node.props.set_id(f"{motion.of}.{CHILD}")
            node.props["of"] = motion.of
            state.nodes.append(node)
            if len(state.node_paths):
                state.node_paths = [*state.node_paths, f"{motion.of}.{CHILD}"]
            index = len(state.nodes) - 1
            state.root.props[_free_key(state, motion.of)] = mi.Properties.ResolvedReference(index)
        for part in ("linear", "angular", "center"):
            state.nodes[index].props[part] = mi.ScalarVector3f(getattr(motion, part))


def _place(state: Any, node: Any, key: str, index: int) -> None:
    """Make the velocity ``index`` of a body, its child ``key``, a child of the scene."""
    import mitsuba as mi

    name, velocity = node.props.id(), state.nodes[index]
    props, own = velocity.props, f"{name}.{CHILD}"
    if not name:
        raise SceneError(f"{CHILD}: expected a named {node.props.plugin_name()} around it; give that an id.")
    if _is_volume(velocity):
        if node_kind(node) != "Medium":
            raise SceneError(f"{name!r}: expected a {PLUGIN} as its {CHILD}; volumes are those of media alone.")
        of = props.id().removesuffix(f".{CHILD}") if props.id().endswith(f".{CHILD}") else name
        props["raw"] = True  # no colours
        props["accel"] = False  # textures of GPUs interpolate with eight bits
    else:
        of = props.get("of", name)
        props["of"] = name
    if of != name:
        raise SceneError(f"{CHILD}: one motion of {of!r} and {name!r}; describe one for each.")
    del node.props[key]
    props.set_id(own)
    state.root.props[_free_key(state, name)] = mi.Properties.ResolvedReference(index)


def _is_volume(node: Any) -> bool:
    return node_kind(node) == "Volume"


def _is_body(node: Any) -> bool:
    kind = node_kind(node).lower()
    # Mitsuba learns the kind of a plugin written in Python when it builds it.
    return (kind_of(node.props.plugin_name()) if kind == "unknown" else kind) in _BODIES


def _free_key(state: Any, name: str) -> str:
    key = f"{name}_{CHILD}"
    while key in state.root.props:
        key += "_"
    return key


def _motions_of(state: Any, node: Any) -> list[tuple[str, int]]:
    if node.props.plugin_name() == "scene":
        return []
    found = [(key, index, state.nodes[index]) for key, index in children(state, node) if key == CHILD]
    return [(key, index) for key, index, held in found if held.props.plugin_name() == PLUGIN or _is_volume(held)]


def moved_names(state: Any) -> set[str]:
    """Return the names of the bodies of a parsed scene that motions and volumes of velocities refer to.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
    """
    rigid = {node.props.get("of", "") for node in state.nodes if node.props.plugin_name() == PLUGIN}
    named = [node.props.id() for node in state.nodes if _is_volume(node)]
    return rigid | {name.removesuffix(f".{CHILD}") for name in named if name.endswith(f".{CHILD}")}


def has_velocities(state: Any) -> bool:
    """Return True if some body of a parsed scene has a velocity.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
    """
    return bool(moved_names(state)) or any(VELOCITY in node.props for node in state.nodes)
