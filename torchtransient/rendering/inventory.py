"""What a scene's description contains, read off its list of nodes without building anything.

Only nodes that a render can meet count: those reachable from the shapes, emitters, sensors and the integrator of the
scene, through references, groups and nested plugins. What is declared and never used costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from torchtransient.axes import TimeAxis
from torchtransient.rendering.films import FilmLayout, layout_of_plugin
from torchtransient.rendering.inventory_colour import COLOUR, MEASURED, colour_of_node, colour_of_value
from torchtransient.rendering.nodes import children, find_child, is_film, is_integrator, kind_of_node, reachable, roots
from torchtransient.rendering.translation import NO_LIMIT, depth_of

# Optical elements whose only purpose is polarization: without it even a single one is drawn wrongly.
POLARIZING_ELEMENTS = ("polarizer", "retarder", "circular", "pplastic", "measured_polarized")
# Surfaces and phase functions that polarize what they reflect or scatter: one of them in a row leaves the intensity of
# unpolarized light right, two do not. The other BSDFs depolarize. Mitsuba's rough dielectric does too, but is replaced
# by one that does not in polarized variants.
POLARIZING_INTERFACES = ("dielectric", "conductor", "roughconductor", "roughdielectric", "rayleigh")
# Plugins of this library that stand in for Mitsuba's of the same name and follow derivatives further.
_TWIN = "diff_"
# A single one of these shapes cannot be met twice in a row.
_FLAT_SHAPES = ("rectangle", "disk")


@dataclass(frozen=True)
class Finding:
    """Something in a scene, and where: what the user calls the node, with its place in the file if it has one."""

    what: str
    where: str

    def __str__(self) -> str:
        return f"{self.what} ({self.where})"


@dataclass
class SceneInventory:
    """What was found. Lists are in the order of the description.

    ``albedo``: no surface or medium scatters more than this share of the light, 1 when that is not known, with the
    node that sets it in ``brightest``. ``integrator`` and ``film`` are plugin names, with the properties that a plan
    reads; ``max_depth`` is -1 for no limit. ``pulsed``: the film spreads arrivals by a pulse or an impulse response.
    """

    media: list[Finding] = field(default_factory=list)
    colours: list[Finding] = field(default_factory=list)
    measured: list[Finding] = field(default_factory=list)
    bands: list[Finding] = field(default_factory=list)
    elements: list[Finding] = field(default_factory=list)
    interfaces: list[Finding] = field(default_factory=list)
    interfaces_in_a_row: bool = False
    declared_only: list[Finding] = field(default_factory=list)
    albedo: float = 0.0
    brightest: str = ""
    integrator: str | None = None
    max_depth: int = NO_LIMIT
    film: str | None = None
    film_axis: TimeAxis | None = None
    temporal_filter: str | None = None
    film_settings: FilmLayout | None = None
    pulsed: bool = False
    plugins: set[str] = field(default_factory=set)


def take_inventory(state: Any, folder_lookup: Any, sensor: int = 0) -> SceneInventory:
    """Read a parser state. ``folder_lookup`` finds a file by the name that a scene uses, as Mitsuba would; the film of
    ``sensor`` counts.
    """
    inventory = SceneInventory()
    order = reachable(state, roots(state))
    _note_unused(inventory, state, set(order))
    surfaces_of_interfaces: list[int] = []
    for index in order:
        node = state.nodes[index]
        plugin = node.props.plugin_name()
        inventory.plugins.add(plugin)
        _note_physics(inventory, state, index, surfaces_of_interfaces)
        if index != 0 and not is_film(node):
            _note_colours(inventory, state, index, folder_lookup)
        _note_bands(inventory, state, node)
    _note_film(inventory, state, order, sensor)
    _note_integrator(inventory, state)
    _note_albedo(inventory, state, order)
    inventory.interfaces_in_a_row = _in_a_row(state, order, surfaces_of_interfaces)
    return inventory


def like_mitsuba(plugin: str) -> str:
    """The plugin of Mitsuba that one of this library stands in for, ``dielectric`` for ``diff_dielectric``."""
    name = plugin.removeprefix(_TWIN)
    return name.replace("rough_", "rough")


def name_of(state: Any, index: int) -> str:
    """How a message calls a node."""
    import mitsuba as mi

    node = state.nodes[index]
    plugin, given = node.props.plugin_name(), node.props.id()
    label = f"{plugin} {given!r}" if given and not given.startswith("_unnamed") else plugin
    if len(state.node_paths) > index and state.node_paths[index]:
        return f"{label} at {state.node_paths[index]!r}"
    where = mi.parser.file_location(state, node).rsplit("/", 1)[-1].rsplit("\\", 1)[-1]
    return f"{label}, {where}" if where else label


def _note_unused(inventory: SceneInventory, state: Any, used: set[int]) -> None:
    for _, index in children(state, state.root):
        node = state.nodes[index]
        if index not in used and (
            kind_of_node(node) == "Medium" or like_mitsuba(node.props.plugin_name()) in POLARIZING_ELEMENTS
        ):
            inventory.declared_only.append(Finding(node.props.plugin_name(), name_of(state, index)))


# --------------------------------------------------------------------------------------------------------- findings


def _note_physics(inventory: SceneInventory, state: Any, index: int, interfaces: list[int]) -> None:
    node = state.nodes[index]
    plugin = node.props.plugin_name()
    if kind_of_node(node) == "Medium":
        inventory.media.append(Finding("participating medium", name_of(state, index)))
    if like_mitsuba(plugin) in POLARIZING_ELEMENTS:
        inventory.elements.append(Finding(plugin, name_of(state, index)))
    elif like_mitsuba(plugin) in POLARIZING_INTERFACES:
        inventory.interfaces.append(Finding(plugin, name_of(state, index)))
        interfaces.append(index)


def _note_colours(inventory: SceneInventory, state: Any, index: int, folder_lookup: Any) -> None:
    node = state.nodes[index]
    where = name_of(state, index)
    found = [colour_of_node(node, folder_lookup)]
    found += [colour_of_value(node, key, value) for key, value in node.props.items()]
    for verdict in found:
        if verdict is not None and verdict.kind == COLOUR:
            inventory.colours.append(Finding(verdict.why, where))
        elif verdict is not None and verdict.kind == MEASURED:
            inventory.measured.append(Finding(verdict.why, where))


def _note_bands(inventory: SceneInventory, state: Any, node: Any) -> None:
    import mitsuba as mi

    if not is_film(node):
        return
    props = node.props
    for key, value in props.items():
        nested = isinstance(value, mi.Properties.ResolvedReference)
        curve = nested and kind_of_node(state.nodes[value.index()]) == "Texture"
        if curve or props.type(key) == mi.Properties.Type.Spectrum:
            inventory.bands.append(Finding(f"response curve {key!r}", props.plugin_name()))


def _note_film(inventory: SceneInventory, state: Any, order: list[int], sensor: int) -> None:
    sensors = [state.nodes[index] for index in roots(state) if kind_of_node(state.nodes[index]) == "Sensor"]
    films: list[int | None] = [find_child(state, node, is_film) for node in sensors[sensor : sensor + 1]]
    # A sensor whose kind is not known here, or that is not there, which the render will say.
    films = films or [next((index for index in order if is_film(state.nodes[index])), None)]
    if films[0] is None:
        return
    props = state.nodes[films[0]].props
    inventory.film = props.plugin_name()
    inventory.pulsed = any(name in props for name in ("pulse", "irf"))
    if "temporal_filter" in props:
        inventory.temporal_filter = str(props["temporal_filter"])
    kind = layout_of_plugin(inventory.film)
    settings = None if kind is None else kind.from_properties(props)
    inventory.film_settings = settings
    inventory.film_axis = None if settings is None else settings.attributes().get("axis")


def _note_integrator(inventory: SceneInventory, state: Any) -> None:
    for _, index in children(state, state.root):
        props = state.nodes[index].props
        if is_integrator(state.nodes[index]):
            inventory.integrator = props.plugin_name()
            inventory.max_depth = int(depth_of(state, index))
            if props.get("temporal_filter", ""):
                inventory.temporal_filter = str(props["temporal_filter"])


# ------------------------------------------------------------------------------------------------------------ albedo


def _note_albedo(inventory: SceneInventory, state: Any, order: list[int]) -> None:
    import mitsuba as mi

    for index in order:
        node = state.nodes[index]
        shapes = node.type == mi.ObjectType.Shape and node.props.plugin_name() not in ("instance", "shapegroup")
        bound = None
        if shapes:
            surface = [child for _, child in children(state, node) if kind_of_node(state.nodes[child]) == "BSDF"]
            # A shape without a BSDF is diffuse with an albedo of one half.
            bound = max((_reflectance(state, child) for child in surface), default=0.5)
        elif kind_of_node(node) == "Medium":
            bound = _largest(state, node, "albedo", 0.75)
        if bound is not None and bound > inventory.albedo:
            inventory.albedo, inventory.brightest = bound, name_of(state, index)


def _reflectance(state: Any, index: int) -> float:
    """No more than this share of the light leaves a surface; 1 where that is all that is known."""
    node = state.nodes[index]
    plugin = node.props.plugin_name()
    if plugin == "diffuse":
        return _largest(state, node, "reflectance", 0.5)
    if plugin in ("twosided", "blendbsdf", "bumpmap", "normalmap"):
        nested = [child for _, child in children(state, node) if kind_of_node(state.nodes[child]) == "BSDF"]
        return max((_reflectance(state, child) for child in nested), default=1.0)
    return 1.0


def _largest(state: Any, node: Any, key: str, default: float) -> float:
    """The largest value of a colour or number; 1 for what is nested (textures, grids)."""
    import mitsuba as mi

    if key not in node.props:
        return default
    kind = node.props.type(key)
    value = node.props[key]
    if kind == mi.Properties.Type.Float or kind == mi.Properties.Type.Integer:
        return float(value)
    if kind == mi.Properties.Type.Color:
        return max(float(value[c]) for c in range(3))
    if kind == mi.Properties.Type.Spectrum:
        return max(float(v) for v in value.values)
    return 1.0


# ---------------------------------------------------------------------------------------------------- polarization


def _in_a_row(state: Any, order: list[int], interfaces: list[int]) -> bool:
    """Whether light can meet two polarizing surfaces in a row: not on a single flat one among depolarizing walls."""
    import mitsuba as mi

    wanted, carriers = set(interfaces), []
    for index in order:
        node = state.nodes[index]
        if node.type == mi.ObjectType.Shape and wanted & set(reachable(state, [index])):
            carriers.append(node.props.plugin_name())
        elif kind_of_node(node) == "Medium" and wanted & set(reachable(state, [index])):
            return True
    return len(carriers) > 1 or any(plugin not in _FLAT_SHAPES for plugin in carriers)
