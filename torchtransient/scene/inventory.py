"""Contents of a scene's description, read off its list of nodes without building anything.

Only nodes that a render can meet count: those reachable from the shapes, emitters, sensors and the integrator of the
scene, through references, groups and nested plugins. Declarations that nothing uses cost nothing.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from torchtransient import plugins
from torchtransient.checks import one_line
from torchtransient.errors import SceneError, TorchTransientError
from torchtransient.plugins._registry import OWN_BSDFS
from torchtransient.plugins.drjit_pool import threads_for_files
from torchtransient.scene.checks import check_nodes
from torchtransient.scene.edits import NO_LIMIT, described_depth
from torchtransient.scene.load import Scene
from torchtransient.scene.motions import has_velocities
from torchtransient.scene.nodes import (
    children,
    find_child,
    is_film,
    is_integrator,
    is_transient_integrator,
    node_kind,
    node_label,
    reachable,
    rendered_children,
)
from torchtransient.scene.objects import LoadedScene
from torchtransient.scene.variant import active_variant

_Found = TypeVar("_Found")

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
    """Something that a scene contains, and the label of its node: plugin, name and place in the file.

    Args:
        what: description of the finding.
        where: label of its node.
    """

    what: str
    where: str

    def __str__(self) -> str:
        return f"{self.what} ({self.where})"


@dataclass
class SceneInventory:
    """Contents of a scene. Lists are in the order of the description.

    Attributes:
        media: participating media.
        colours: colours that three numbers carry.
        measured: data over wavelength.
        bands: response curves of films.
        elements: polarizing elements.
        interfaces: polarizing surfaces.
        interfaces_in_a_row: light can meet two polarizing surfaces in a row.
        declared_only: media and polarizing elements that nothing refers to.
        albedo: largest share of the light that a surface or medium scatters, 1 if unknown.
        brightest: label of the node with that share.
        integrator, max_depth: plugin name, and its bound on the depth, -1 for no limit.
        connections: property ``connections`` of the integrator, None without it.
        film, film_props: plugin name and properties of the film of the sensor.
        temporal_filter: described temporal filter, of the integrator or else of the film.
        sampler: sampler that integrator or sensor name, None if neither does.
        moves: some body has a velocity.
        pulsed: the film spreads arrivals by a pulse or an impulse response.
        plugins: names of all plugins.
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
    connections: str | None = None
    max_depth: int = NO_LIMIT
    film: str | None = None
    film_props: Any = None
    temporal_filter: str | None = None
    sampler: str | None = None
    pulsed: bool = False
    moves: bool = False
    plugins: set[str] = field(default_factory=set)


def scene_inventory(scene: Scene, sensor: int = 0) -> SceneInventory:
    """Return the contents of a scene.

    Args:
        scene: the scene.
        sensor: index of the sensor whose film is described.

    Raises:
        SceneError: for a scene that Mitsuba cannot parse, and for one with loaded objects.
    """
    return _parsed(scene, "tt.plan", lambda state: _take_inventory(state, sensor))


def _parsed(scene: Scene, what: str, read: Callable[[Any], _Found]) -> _Found:
    """Return what ``read`` finds in a parsed scene. ``what`` begins the message where it cannot be parsed."""
    import mitsuba as mi

    description = scene._description
    description.check_described(what)
    assert not isinstance(description, LoadedScene)  # refused above
    with active_variant(scene.variant):
        config = mi.parser.ParserConfig(scene.variant)
        try:
            with description.resolved_files(), plugins.plugin_errors():
                state = description.parse(config)
                check_nodes(state)
                mi.parser.transform_upgrade(config, state)
                return read(state)
        except TorchTransientError as error:
            raise type(error)(f"{description.name}: {error}") from error
        except (RuntimeError, ValueError, TypeError) as error:
            raise SceneError(f"{description.name}: Mitsuba could not read the scene. {one_line(error)}") from error


def described_samplers(scene: Scene) -> list[str | None]:
    """Return the plugin name of the sampler of each sensor of a scene, None for a sensor without one.

    Args:
        scene: the scene.

    Raises:
        SceneError: for a scene that Mitsuba cannot parse, and for one with loaded objects.
    """
    return _parsed(scene, "recipe", _samplers_of)


def _resolved(name: str) -> Path:
    """Return the path of a file as Mitsuba finds it."""
    import mitsuba as mi

    return Path(str(mi.file_resolver().resolve(name)))


def _take_inventory(state: Any, sensor: int) -> SceneInventory:
    inventory = SceneInventory(moves=has_velocities(state))
    order = reachable(state, rendered_children(state))
    _note_unused(inventory, state, set(order))
    surfaces_of_interfaces: list[int] = []
    for index in order:
        node = state.nodes[index]
        plugin = node.props.plugin_name()
        inventory.plugins.add(plugin)
        _note_physics(inventory, state, index, surfaces_of_interfaces)
        if index != 0 and not is_film(node):
            _note_colours(inventory, state, index)
        _note_bands(inventory, state, node)
    _note_film(inventory, state, order, sensor)
    samplers = _samplers_of(state)
    inventory.sampler = samplers[sensor] if sensor < len(samplers) else None
    _note_integrator(inventory, state)
    _note_albedo(inventory, state, order)
    inventory.interfaces_in_a_row = _in_a_row(state, order, surfaces_of_interfaces)
    return inventory


def like_mitsuba(plugin: str) -> str:
    """Return the plugin of Mitsuba that one of this library stands in for: ``dielectric`` for ``diff_dielectric``.

    Args:
        plugin: plugin name.
    """
    name = plugin.removeprefix(_TWIN)
    return name.replace("rough_", "rough")


def _note_unused(inventory: SceneInventory, state: Any, used: set[int]) -> None:
    for _, index in children(state, state.root):
        node = state.nodes[index]
        if index not in used and (
            node_kind(node) == "Medium" or like_mitsuba(node.props.plugin_name()) in POLARIZING_ELEMENTS
        ):
            inventory.declared_only.append(Finding(node.props.plugin_name(), node_label(state, index)))


# --------------------------------------------------------------------------------------------------------- findings


def _note_physics(inventory: SceneInventory, state: Any, index: int, interfaces: list[int]) -> None:
    node = state.nodes[index]
    plugin = node.props.plugin_name()
    if node_kind(node) == "Medium":
        inventory.media.append(Finding("participating medium", node_label(state, index)))
    if like_mitsuba(plugin) in POLARIZING_ELEMENTS:
        inventory.elements.append(Finding(plugin, node_label(state, index)))
    elif like_mitsuba(plugin) in POLARIZING_INTERFACES:
        inventory.interfaces.append(Finding(plugin, node_label(state, index)))
        interfaces.append(index)


def _note_colours(inventory: SceneInventory, state: Any, index: int) -> None:
    node = state.nodes[index]
    where = node_label(state, index)
    found = [_node_colour(node)]
    found += [_value_colour(node, key, value) for key, value in node.props.items()]
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
        curve = nested and node_kind(state.nodes[value.index()]) == "Texture"
        if curve or props.type(key) == mi.Properties.Type.Spectrum:
            inventory.bands.append(Finding(f"response curve {key!r}", props.plugin_name()))


def _note_film(inventory: SceneInventory, state: Any, order: list[int], sensor: int) -> None:
    import mitsuba as mi

    films: list[int | None] = [find_child(state, node, is_film) for node in _sensors(state)[sensor : sensor + 1]]
    # A sensor of unknown kind, or one that is missing, which the render will report.
    films = films or [next((index for index in order if is_film(state.nodes[index])), None)]
    if films[0] is None:
        return
    props = state.nodes[films[0]].props
    inventory.film, inventory.film_props = props.plugin_name(), mi.Properties(props)
    inventory.pulsed = any(name in props for name in ("pulse", "irf"))
    if "temporal_filter" in props:
        inventory.temporal_filter = str(props["temporal_filter"])


def _sensors(state: Any) -> list[Any]:
    return [state.nodes[index] for index in rendered_children(state) if node_kind(state.nodes[index]) == "Sensor"]


def _samplers_of(state: Any) -> list[str | None]:
    """Return the plugin name of each sensor's sampler in a parsed scene, that of the integrator first; None without
    one.
    """
    of_integrator = _sampler_of_integrator(state)
    if of_integrator not in ("", "auto"):
        return [of_integrator for _ in _sensors(state)]
    found = [find_child(state, node, lambda child: node_kind(child) == "Sampler") for node in _sensors(state)]
    return [None if index is None else state.nodes[index].props.plugin_name() for index in found]


def _sampler_of_integrator(state: Any) -> str:
    """Return the sampler that the integrator of a parsed scene names in place of those of the sensors, or nothing."""
    for _, index in children(state, state.root):
        props = state.nodes[index].props
        if is_integrator(state.nodes[index]) and is_transient_integrator(props.plugin_name()):
            given = props.get("sampler", "")
            return given if isinstance(given, str) else ""
    return ""


def _note_integrator(inventory: SceneInventory, state: Any) -> None:
    for _, index in children(state, state.root):
        props = state.nodes[index].props
        if is_integrator(state.nodes[index]):
            inventory.integrator = props.plugin_name()
            inventory.max_depth = int(described_depth(state, index))
            inventory.connections = str(props["connections"]) if "connections" in props else None
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
            surface = [child for _, child in children(state, node) if node_kind(state.nodes[child]) == "BSDF"]
            # A shape without a BSDF is diffuse with an albedo of one half.
            bound = max((_reflectance(state, child) for child in surface), default=0.5)
        elif node_kind(node) == "Medium":
            bound = _largest(state, node, "albedo", 0.75)
        if bound is not None and bound > inventory.albedo:
            inventory.albedo, inventory.brightest = bound, node_label(state, index)


def _reflectance(state: Any, index: int) -> float:
    """Return a bound on the share of the light that leaves a surface, 1 where none is known."""
    node = state.nodes[index]
    plugin = node.props.plugin_name()
    if plugin == "diffuse":
        return _largest(state, node, "reflectance", 0.5)
    if plugin in ("twosided", "blendbsdf", "bumpmap", "normalmap"):
        nested = [child for _, child in children(state, node) if node_kind(state.nodes[child]) == "BSDF"]
        return max((_reflectance(state, child) for child in nested), default=1.0)
    return 1.0


def _largest(state: Any, node: Any, key: str, default: float) -> float:
    """Return the largest value of a colour or number; 1 for nested plugins (textures, grids)."""
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
    """Return whether light can meet two polarizing surfaces in a row: not on a single flat one alone."""
    import mitsuba as mi

    wanted, carriers = set(interfaces), []
    for index in order:
        node = state.nodes[index]
        if node.type == mi.ObjectType.Shape and wanted & set(reachable(state, [index])):
            carriers.append(node.props.plugin_name())
        elif node_kind(node) == "Medium" and wanted & set(reachable(state, [index])):
            return True
    return len(carriers) > 1 or any(plugin not in _FLAT_SHAPES for plugin in carriers)


# ------------------------------------------------------------------------------------------------------------- colours
# Spectra are grey, a colour that three numbers carry, or data over wavelength that they do not. Grey means the same in
# monochromatic, RGB and spectral variants. Measured data keep their meaning in spectral variants only: others reduce
# them to three numbers before light is reflected twice.

COLOUR, MEASURED = "colour", "measured"
# Wavelengths (nm) that a constant table has to cover to be grey.
_VISIBLE = (380.0, 780.0)
# Properties that Mitsuba reads as one number whatever the colour of their texture.
_NOT_COLOURS = (
    "alpha", "alpha_u", "alpha_v", "opacity", "weight", "roughness", "metallic", "anisotropic", "spec_tint",
    "sheen_tint", "clearcoat", "clearcoat_gloss", "flatness", "diff_trans", "rough", "thickness", "theta",
)  # fmt: skip
# Pictures above this many bytes are taken as coloured if they have three channels, without a look at their pixels.
_PIXELS_WORTH_READING = 1 << 18

# Plugins of Mitsuba 3.9 and of this library whose spectra are all among their properties, or that have none.
_TRANSPARENT = frozenset((
    "scene", "area", "angulararea", "directionalarea", "point", "spot", "directional", "constant", "projector",
    "diffuse", "dielectric", "thindielectric", "roughdielectric", "diff_dielectric", "diff_rough_dielectric",
    "diff_plastic", "diff_rough_plastic", "diff_conductor", "diff_polarizer", "diff_retarder", "diff_circular",
    "conductor", "roughconductor", "plastic", "roughplastic", "diff_rough_conductor", "diff_pplastic",
    "pplastic", "principled", "principledthin", "diff_principled", "diff_principled_thin",
    "blendbsdf", "mask", "twosided", "bumpmap",
    "normalmap", "null", "polarizer", "retarder", "circular", "delayed", "retroreflector", "homogeneous",
    "heterogeneous",
    "isotropic", "hg", "rayleigh", "tabphase", "blendphase", "sggx", "constvolume", "checkerboard", "srgb",
    "uniform", "rawconstant", "d65", "volume", "cube", "sphere", "rectangle", "disk", "cylinder", "obj", "ply",
    "serialized", "mesh_arrays", "merge", "shapegroup", "instance", "bsplinecurve", "linearcurve", "sdfgrid",
    "ellipsoids", "ellipsoidsmesh", "blender", "perspective", "orthographic", "thinlens", "radiancemeter",
    "irradiancemeter",
    "nlos_capture_meter", "laser_beam", "distant", "batch", "hdrfilm", "specfilm",
    "independent", "stratified", "multijitter", "orthogonal", "ldsampler", "box", "tent",
    "gaussian", "mitchell", "catmullrom", "lanczos",
))  # fmt: skip
_MEASURED_PLUGINS = {
    "regular": "spectrum given over wavelength",
    "irregular": "spectrum given over wavelength",
    "blackbody": "black body spectrum",
    "measured": "measured material",
    "measured_polarized": "measured material",
}
_COLOURED_PLUGINS = {
    "sunsky": "coloured sky",
    "timed_sunsky": "coloured sky",
    **dict.fromkeys(("hair", "diff_hair"), "coloured absorption of hair"),
    "mesh_attribute": "attribute of a mesh, which may be coloured",
}


@dataclass(frozen=True)
class _Verdict:
    """Colour of a value or plugin: ``kind`` COLOUR or MEASURED, and the property or plugin that has it."""

    kind: str
    why: str


def _value_colour(node: Any, key: str, value: Any) -> _Verdict | None:
    """Return the colour of one property; None for grey and for values that are no spectrum."""
    import mitsuba as mi

    kind = node.props.type(key)
    if key in _NOT_COLOURS:
        return None
    if kind == mi.Properties.Type.Color:
        three = [float(value[c]) for c in range(3)]
        return None if three[0] == three[1] == three[2] else _Verdict(COLOUR, f"coloured {key}")
    if kind == mi.Properties.Type.Spectrum and not _constant(value):
        return _Verdict(MEASURED, f"{key} given over wavelength")
    return None


def _constant(spectrum: Any) -> bool:
    """Return whether a spectrum is constant over the visible: a table of equal values may end inside it."""
    if spectrum.is_uniform():
        return True
    values, wavelengths = list(spectrum.values), list(spectrum.wavelengths)
    covers = bool(wavelengths) and wavelengths[0] <= _VISIBLE[0] and wavelengths[-1] >= _VISIBLE[1]
    return covers and min(values) == max(values)


def _node_colour(node: Any) -> _Verdict | None:
    """Return the colour of a plugin itself: tables of materials, pictures, grids, plugins with colours of their own."""
    import mitsuba as mi

    props, plugin = node.props, node.props.plugin_name()
    if plugin in _MEASURED_PLUGINS:
        return _Verdict(MEASURED, _MEASURED_PLUGINS[plugin])
    if plugin in _COLOURED_PLUGINS:
        return _Verdict(COLOUR, _COLOURED_PLUGINS[plugin])
    if plugin in ("conductor", "roughconductor", "diff_conductor", "diff_rough_conductor"):
        material = str(props.get("material", "none"))
        return None if material.lower() == "none" else _Verdict(MEASURED, f"indices of {material!r} over wavelength")
    if plugin == "delayed" and any(key in props for key in ("emission", "excitation")):
        return _Verdict(MEASURED, "re-emission at other wavelengths")
    if plugin in ("bitmap", "envmap"):
        return _picture(props)
    if plugin == "gridvolume":
        return _grid(props)
    if plugin in (*_TRANSPARENT, *OWN_BSDFS) or node.type in (mi.ObjectType.Integrator, mi.ObjectType.Sampler):
        return None
    return None if is_integrator(node) else _Verdict(COLOUR, f"{plugin!r}, whose colours are not known here")


def _picture(props: Any) -> _Verdict | None:
    import mitsuba as mi

    for key in ("bitmap", "data"):
        if key in props:
            return None if _grey(np.array(props[key])) else _Verdict(COLOUR, "coloured picture")
    name = str(props.get("filename", ""))
    path = _resolved(name)
    if not path.is_file():
        return _Verdict(COLOUR, f"picture {name!r}, which was not found")
    if path.stat().st_size > _PIXELS_WORTH_READING:
        return _Verdict(COLOUR, f"picture {name!r}, taken as coloured without a look at its pixels")
    try:
        with threads_for_files():
            pixels = np.array(mi.Bitmap(str(path)))
    except (RuntimeError, ValueError):
        return _Verdict(COLOUR, f"picture {name!r}, which cannot be read")
    return None if _grey(pixels) else _Verdict(COLOUR, f"coloured picture {name!r}")


def _grid(props: Any) -> _Verdict | None:
    for key in ("grid", "data"):
        if key in props:
            values = np.array(props[key])
            return None if values.ndim < 4 or _grey(values) else _Verdict(COLOUR, "coloured grid")
    name = str(props.get("filename", ""))
    path = _resolved(name)
    channels = 3
    if path.is_file():
        # "VOL", version, encoding, three sizes, channels: little-endian 32-bit integers after the first four bytes.
        head = path.open("rb").read(24)
        channels = struct.unpack("<i", head[20:24])[0] if head[:3] == b"VOL" and len(head) == 24 else 3
    return None if channels == 1 else _Verdict(COLOUR, f"grid {name!r} with {channels} channels")


def _grey(pixels: np.ndarray) -> bool:
    """Return whether the colour channels of (..., C) agree. One channel, or one and alpha, is grey."""
    if pixels.ndim < 3 or pixels.shape[-1] < 3:
        return True
    return bool(np.all(pixels[..., 0] == pixels[..., 1]) and np.all(pixels[..., 0] == pixels[..., 2]))
