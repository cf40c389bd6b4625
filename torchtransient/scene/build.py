"""A Mitsuba scene from a description: parsed, checked, edited by the options of a renderer, instantiated.

The same edits of Mitsuba's list of nodes serve XML files and dictionaries. Errors name places of the description.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from torchtransient import plugins
from torchtransient.checks import cut_line, one_line, some_of
from torchtransient.errors import SceneError, TorchTransientError
from torchtransient.interfaces import IntegratorInterface, is_time_resolved
from torchtransient.plugins.described_scene import check_scene
from torchtransient.plugins.drjit_pool import threads_for_files
from torchtransient.plugins.guards import release_when_safe
from torchtransient.plugins.mitsuba_compat import is_dark, scene_parameters
from torchtransient.plugins.node_walk import objects_below
from torchtransient.plugins.parameter_effect import class_of
from torchtransient.plugins.parameters import PhysicalRange, described_ranges, ranges_of
from torchtransient.scene.checks import check_finite, check_mesh_files, check_meshes, check_nodes
from torchtransient.scene.description import Plain, SceneDescription
from torchtransient.scene.edits import BuildOptions, edit, forget_queries
from torchtransient.scene.motions import has_velocities
from torchtransient.scene.nodes import (
    described_transforms,
    find_child,
    is_integrator,
    name_children,
    name_nested,
    restore_texture_names,
    split_merged_shapes,
    texture_names,
)
from torchtransient.scene.objects import WAY_OUT, LoadedScene, pointers
from torchtransient.scene.physics import scene_findings


@dataclass
class BuiltScene:
    """Built Mitsuba scene, with data of its description that Mitsuba does not keep.

    Attributes:
        scene, params: the ``mitsuba.Scene``, and its ``mitsuba.SceneParameters`` by users' keys.
        mesh_to_world: transforms (4, 4) of shapes as described, by name.
        integrator: plugin name of the integrator.
        to_world: all transforms as described, by key.
        label_tables: tables of labels, once they are asked for.
        loaded: addresses of the plugins that users have loaded themselves, which no other plugin can replace.
    """

    scene: Any
    params: Any
    mesh_to_world: dict[str, np.ndarray] = field(default_factory=dict)
    integrator: str = ""
    to_world: dict[str, np.ndarray] = field(default_factory=dict)
    label_tables: Any = None
    loaded: frozenset[int] = frozenset()
    _findings: dict[str, str] | None = None
    _ranges: dict[str, PhysicalRange] | None = None

    def findings(self) -> dict[str, str]:
        """Return messages about unphysical values of the description, by key."""
        if self._findings is None:
            dark = [emitter.id() for emitter in self.scene.emitters() if is_dark(emitter)]
            self._findings = scene_findings(described_ranges(self.params), self.to_world, dark)
        return self._findings

    def ranges(self) -> dict[str, PhysicalRange]:
        """Return the physical ranges of parameters that have one, by key."""
        if self._ranges is None:
            self._ranges = ranges_of(self.params)
        return self._ranges

    def __del__(self) -> None:
        contents = list(self.__dict__.values())
        self.__dict__.clear()
        release_when_safe(contents)


# Errors of constructors, of Mitsuba and of plugins in Python.
_PLUGIN_ERRORS = (RuntimeError, ValueError, TypeError, ArithmeticError, AttributeError, LookupError, MemoryError)

# Mitsuba merges meshes of one surface, and stops where their normals are made in different ways.
_CANNOT_MERGE = "Mesh::merge()"


def build(description: SceneDescription, variant: str, options: BuildOptions) -> BuiltScene:
    """Build a description under the active variant.

    Args:
        description: description of the scene, or a loaded scene.
        variant: name of the active variant.
        options: changes of the description.

    Raises:
        SceneError: with file and line, or the entry of the dictionary, where Mitsuba knows them.
    """
    if isinstance(description, LoadedScene):
        return _loaded(description, options)
    try:
        return _instantiated(description, variant, options)
    except TorchTransientError as error:
        raise type(error)(f"{_location(error.__cause__) or description.name}: {error}") from error
    except _PLUGIN_ERRORS as error:
        if options.merge and _CANNOT_MERGE in str(error):
            return build(description, variant, replace(options, merge=False))
        text = one_line(error).replace("While loading string", f"While loading {description.name}")
        unread = _unread_properties(str(error), description.name)
        message = unread or f"{description.name}: Mitsuba could not build the scene. {cut_line(text)}"
        raise SceneError(message) from error


def _instantiated(description: Plain, variant: str, options: BuildOptions) -> BuiltScene:
    import mitsuba as mi

    config = mi.parser.ParserConfig(variant)
    config.merge_equivalent = options.merge
    config.merge_meshes = options.merge
    with description.resolved_files(), plugins.plugin_errors(), threads_for_files():
        state = description.parse(config)
        # Files of older versions spell properties in another way.
        mi.parser.transform_upgrade(config, state)
        if state.root.props.plugin_name() != "scene":
            raise SceneError(f"expected a <scene> at the top, got <{state.root.props.plugin_name()}>.")
        if options.merge and has_velocities(state):
            # What is merged forgets whose it was.
            return _instantiated(description, variant, replace(options, merge=False))
        check_nodes(state)
        check_mesh_files(state)
        check_meshes(description.objects)
        name_children(state)
        if not options.merge:
            split_merged_shapes(state)
            name_nested(state)
        edit(config, state, options)
        mesh_to_world, to_world = described_transforms(state)
        index = find_child(state, state.root, is_integrator)
        integrator = "" if index is None else state.nodes[index].props.plugin_name()
        check_finite(state)
        forget_queries(state)
        textures = texture_names(state)
        mi.parser.transform_all(config, state)
        try:
            scene = mi.parser.instantiate(config, state)
        except BaseException:
            # It holds lights whose shapes are gone, and whoever keeps the error keeps it: every later kernel would
            # call them.
            state.nodes.clear()
            raise
        if not isinstance(scene, mi.Scene):
            raise SceneError(f"expected one <scene>, got {type(scene).__name__}.")
        restore_texture_names(scene, textures)
        if description.objects:
            _check_loaded(scene, description.objects, options)
        _check_integrator(scene, options)
        params = scene_parameters(scene)
        check_scene(scene, params)
    return BuiltScene(scene, params, mesh_to_world, integrator, to_world, loaded=pointers(description.objects))


def _loaded(description: LoadedScene, options: BuildOptions) -> BuiltScene:
    """Return a loaded scene as it is. Raises ``SceneError`` where ``options`` would change it."""
    scene = description.scene
    _check_loaded(scene, description.objects, options)
    check_meshes(description.objects)
    params = scene_parameters(scene)
    check_scene(scene, params)
    name = "" if scene.integrator() is None else class_of(scene.integrator())
    return BuiltScene(scene, params, integrator=name, loaded=pointers(description.objects))


def _check_integrator(scene: Any, options: BuildOptions) -> None:
    """Raise ``SceneError`` for an integrator of a user's plugin that knows nothing of time."""
    integrator = scene.integrator()
    if options.transient and not isinstance(integrator, IntegratorInterface):
        raise SceneError(
            f"the integrator {class_of(integrator)} renders images. Expected one that renders through time: "
            "transient_path, transient_prbvolpath, or a subclass of their classes. mi.render takes it as it is."
        )


# ------------------------------------------------------------------------------------------------------------ messages


def _location(error: BaseException | None) -> str | None:
    """Return the file and line, or the node of a dictionary, that a message of Mitsuba names."""
    found = re.search(r'(?:At|While loading) (.+? \(line \d+, col \d+\)|dictionary node "[^"]+")', str(error or ""))
    return found.group(1) if found else None


_REPORT = re.compile(
    r'While loading (?P<where>.*): Found \d+ unreferenced propert(?:y|ies) in \w+ plugin of type "(?P<plugin>[^"]*)":'
    r"(?P<list>(?:\n  - .*)+)"
)
_ONE = re.compile(r'\n  - \w+ "(?P<name>[^"]*)": (?P<value>.*)')
# Properties of mitransient, which reads them.
_INSTEAD = {
    "nlos_hidden_geometry_sampling_max_depth": "hidden geometry is sampled at all depths up to max_depth",
    "original_film_width": "the film itself says its width",
    "original_film_height": "the film itself says its height",
}


def _unread_properties(text: str, description: str) -> str | None:
    """Return a message with advice for Mitsuba's report of unread properties; None for another ``text``."""
    report = _REPORT.search(text)
    if report is None:
        return None
    plugin, found = report["plugin"], dict(_ONE.findall(report["list"]))
    # In files the place begins with the name of the file.
    where = report["where"] if report["where"].startswith(description) else f"{description}: {report['where']}"
    named = some_of([f"{name!r} = {value}" for name, value in found.items()])
    hints = [f"Leave {name!r} out: {_INSTEAD[name]}." for name in found if name in _INSTEAD]
    if plugin != "transient_nlos_path":
        nlos = [name for name in found if name.startswith("nlos_") and name not in _INSTEAD]
        hints += [f"{', '.join(map(repr, nlos))}: transient_nlos_path reads such."] if nlos else []
    if len(hints) < len(found):
        hints.append("Misspelt, of another plugin, or without effect beside the others: mend it, or leave it out.")
    return f"{where}: {plugin!r} does not read {named}. {' '.join(hints)}"


# ------------------------------------------------------------------------------------------------------ loaded objects

# Classes of Mitsuba that this library builds others in place of: always, and in polarized variants.
_COMPLETED = {"DirectionalArea": "diff_directionalarea"}
_POLARIZED = {
    "SmoothDielectric": "diff_dielectric",
    "SmoothConductor": "diff_conductor",
    "RoughDielectric": "diff_rough_dielectric",
    "LinearPolarizer": "diff_polarizer",
    "LinearRetarder": "diff_retarder",
    "CircularPolarizer": "diff_circular",
}


def _check_loaded(scene: Any, objects: tuple[Any, ...], options: BuildOptions) -> None:
    """Raise ``SceneError`` where options ask for a change of loaded objects in a built scene.

    Described nodes were edited by the options before.
    """
    import mitsuba as mi

    addresses = pointers(objects)
    for value in (scene, *objects_below(scene, mi.Object)):
        if value.ptr in addresses:
            _check_complete(value)
    integrator = scene.integrator()
    if integrator is not None and integrator.ptr in addresses and options.transient:
        _check_loaded_integrator(integrator, options)
    for number, sensor in enumerate(scene.sensors()):
        if sensor.ptr in addresses or sensor.film().ptr in addresses:
            _check_loaded_sensor(number, sensor, options)


def _check_complete(value: Any) -> None:
    import mitsuba as mi

    twins = _COMPLETED | (_POLARIZED if mi.is_polarized else {})
    twin = twins.get(value.class_name())
    if twin is not None:
        raise SceneError(
            f"tt.load: {value.class_name()} {value.id()!r} was taken as it is. Mitsuba's own is wrong or incomplete in "
            f"{mi.variant()}, and {twin!r} is built in its place where a scene is described. Make it a {twin!r}, or "
            "give the scene as a dictionary or an XML file."
        )


def _check_loaded_integrator(integrator: Any, options: BuildOptions) -> None:
    depth = getattr(integrator, "max_depth", None)
    same_depth = options.max_depth is None or (depth is not None and int(depth) % 2**32 == options.max_depth % 2**32)
    if isinstance(integrator, IntegratorInterface) and same_depth and options.integrator is None:
        return
    asked = f"max_depth={options.max_depth}" if isinstance(integrator, IntegratorInterface) else "a transient one"
    raise SceneError(
        f"the integrator {class_of(integrator)} was taken as it is, and {options.integrator or asked} is asked for. "
        "Make the scene with the integrator that you want, transient_path or transient_prbvolpath, or path, volpath or "
        f"volpathmis, which these stand in for. {WAY_OUT}."
    )


def _check_loaded_sensor(number: int, sensor: Any, options: BuildOptions) -> None:
    film = sensor.film()
    if options.transient and not is_time_resolved(film):
        raise SceneError(
            f"sensor {number} was taken as it is with its film, a {class_of(film)}, which has no time axis; no other "
            "film is built in its place. Make the scene with a transient_hdr_film, phasor_hdr_film, gated_hdr_film, "
            f"rate_hdr_film or beat_hdr_film. {WAY_OUT}."
        )
    changes = [name for name in ("pulse", "irf") if getattr(options, name) is not None]
    changes += [] if options.steady or not getattr(film, "keeps_steady", True) else ["steady"]
    if options.film is not None and not (options.transient and options.film.describes(film)):
        changes.append(options.film.argument)
    if changes:
        raise SceneError(
            f"sensor {number} was taken as it is with its film and sampler, and {', '.join(changes)} would change it. "
            f"Leave {'it' if len(changes) == 1 else 'them'} out, or make the scene with what you want. {WAY_OUT}."
        )
