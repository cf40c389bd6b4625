"""What of a parsed scene Mitsuba would not refuse, and die of, never end with, or fail at much later."""

from __future__ import annotations

from typing import Any

from torchtransient.checks import shown
from torchtransient.errors import SceneError
from torchtransient.rendering.nodes import children, is_film, kind_of_node

# Nodes inside of nodes, references counted. Kernels hold a call inside of a call for each, and the time to build them
# grows with a power of their number: 16 take seconds.
MOST_LEVELS = 32
# Nodes of a surface, medium or light, each as often as it is reached: a two-sided surface reaches its inside twice, a
# blend of twice the same surface as well.
MOST_EXPANDED = 256
_EXPANDED = ("BSDF", "Texture", "Volume", "PhaseFunction", "Medium", "Emitter")
_REACHED_TWICE = ("twosided",)
# Mitsuba counts samples and pixels in 32 bits with a sign.
_MOST = 2**31 - 1
_SIZES = ("width", "height", "crop_width", "crop_height")


def check_nodes(state: Any) -> None:
    """Raise ``SceneError`` for a scene that is nested too deeply, for numbers of samples and sizes of films below one,
    and for transforms that are none.
    """
    check_nesting(state)
    for node in state.nodes:
        _check_transforms(node)
        if kind_of_node(node) == "Sampler":
            _check_whole(node, "sample_count")
            if node.props.plugin_name() == "orthogonal":
                _check_whole(node, "strength", least=2)
        elif is_film(node):
            for name in _SIZES:
                _check_whole(node, name)


def _check_whole(node: Any, name: str, least: int = 1) -> None:
    if name not in node.props:
        return
    given = node.props[name]
    is_number = isinstance(given, (int, float)) and not isinstance(given, bool)
    if not is_number or given != given // 1 or not least <= given <= _MOST:
        raise SceneError(
            f"{_name(node)}: {name}: expected a whole number from {least} to 2^31 - 1, got {shown(given)}."
        )


def _check_transforms(node: Any) -> None:
    for name in ("to_world", "to_uv"):
        given = node.props.get(name, None)
        if given is not None and not hasattr(given, "matrix"):
            size = "(3, 3)" if name == "to_uv" else "(4, 4)"
            raise SceneError(
                f"{_name(node)}: {name}: expected a transform, a {size} array or one of Mitsuba's, got {shown(given)}."
            )


def _name(node: Any) -> str:
    name, plugin = node.props.id(), node.props.plugin_name()
    return f"{name!r} ({plugin})" if name else plugin


def check_nesting(state: Any) -> None:
    """Raise ``SceneError`` where nodes stand in nodes more than 32 deep, or a surface holds more than 256 nodes, each
    counted as often as it is reached. Circles of references are left to Mitsuba, which names them.
    """
    levels: dict[int, int] = {}
    sizes: dict[int, int] = {}
    by_id = state.id_to_index
    below = {index: [child for _, child in children(state, node, by_id)] for index, node in enumerate(state.nodes)}
    entered: set[int] = set()
    for start in below:
        waiting = [start]
        while waiting:
            index = waiting[-1]
            if index not in entered:
                entered.add(index)
                waiting.extend(child for child in below[index] if child not in entered)
                continue
            waiting.pop()
            if index in levels:
                continue
            held = [child for child in below[index] if child in levels]
            levels[index] = 1 + max((levels[child] for child in held), default=0)
            sizes[index] = _size(state.nodes[index], sum(sizes[child] for child in held))
            if levels[index] > MOST_LEVELS:
                raise SceneError(
                    f"{_name(state.nodes[index])}: expected nodes inside of nodes at most {MOST_LEVELS} deep, got "
                    "more. Kernels are not built of deeper ones in a time that anybody waits for."
                )


def _size(node: Any, inside: int) -> int:
    if kind_of_node(node) not in _EXPANDED:
        return 1
    size = 1 + (2 if node.props.plugin_name() in _REACHED_TWICE else 1) * inside
    if size > MOST_EXPANDED:
        raise SceneError(
            f"{_name(node)}: expected at most {MOST_EXPANDED} nodes in one surface, medium or light, each counted as "
            f"often as it is reached, got {size}. Kernels are not built of more in a time that anybody waits for."
        )
    return size
