"""From a description to a Mitsuba scene: what is overridden on the way, and the errors told in the user's terms.

The description is parsed into Mitsuba's list of nodes, the nodes are edited (film, integrator, plugins with more
derivatives, stable names), and the list is instantiated. The same edits serve XML files and dictionaries.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from torchtransient import plugins
from torchtransient._collection import let_go
from torchtransient.errors import ArgumentError, SceneError, TorchTransientError
from torchtransient.interfaces import IntegratorInterface
from torchtransient.plain_texts import line_of
from torchtransient.plugins.described_scene import check_scene
from torchtransient.plugins.drjit_pool import threads_for_files
from torchtransient.plugins.mitsuba_compat import (
    BUILDS_LOBES,
    COMPLETED_PLUGINS,
    DIFFERENTIABLE_PLUGINS,
    PLASTICS,
    POLARIZED_PLUGINS,
    TEXTURES_WITHOUT_MEAN,
    is_dark,
)
from torchtransient.plugins.node_walk import has_mean
from torchtransient.plugins.parameter_effect import class_of
from torchtransient.plugins.parameters import PhysicalRange, described_ranges, ranges_of
from torchtransient.rendering.build_options import BuildOptions
from torchtransient.rendering.description import Description
from torchtransient.rendering.films.choices import all_films, of_plugin, plugins_in_words
from torchtransient.rendering.mesh_files import check_mesh_files, check_taken_meshes
from torchtransient.rendering.mitsuba_words import one_line
from torchtransient.rendering.node_checks import check_nodes
from torchtransient.rendering.node_names import (
    name_instantiated,
    name_nested,
    name_nodes,
    names_of_textures,
    take_merged_apart,
)
from torchtransient.rendering.nodes import (
    check_finite,
    children,
    descendants,
    find_child,
    is_film,
    is_integrator,
    is_transient_integrator,
    media_in_use,
)
from torchtransient.rendering.physics import scene_findings
from torchtransient.rendering.placements import mesh_transforms, placements
from torchtransient.rendering.pulse_properties import PREFIXES, PROPERTIES, write_pulse
from torchtransient.rendering.taken import ReadyScene, check_taken, pointers
from torchtransient.rendering.translation import (
    ADVICE,
    COUNTERPARTS,
    FILM_PROPERTIES,
    PATH_PROPERTIES,
    STEADY_FILMS,
    check_stated,
    depth_of,
    forget_queries,
    path_tracer_of,
    stated_nodes,
    tracing,
)
from torchtransient.rendering.unread_properties import unread_properties

_TRANSIENT_PROPERTIES = (
    *PATH_PROPERTIES, "camera_unwarp", "discard_direct_light", "temporal_filter", "gaussian_stddev",
)  # fmt: skip


@dataclass
class BuiltScene:
    """A Mitsuba scene with what has to be known about its nodes. ``to_world``: all transforms as described, by key.
    ``label_tables``: what labels look up, once they are asked for. ``taken``: addresses of the plugins that were taken
    as they are, in whose place none can be built.
    """

    scene: Any
    params: Any
    mesh_to_world: dict[str, np.ndarray] = field(default_factory=dict)
    integrator: str = ""
    to_world: dict[str, np.ndarray] = field(default_factory=dict)
    label_tables: Any = None
    taken: frozenset[int] = frozenset()

    def findings(self) -> dict[str, str]:
        """What is unphysical in the description, by key."""
        if self._findings is None:
            dark = [emitter.id() for emitter in self.scene.emitters() if is_dark(emitter)]
            self._findings = scene_findings(described_ranges(self.params), self.to_world, dark)
        return self._findings

    _findings: dict[str, str] | None = None

    def ranges(self) -> dict[str, PhysicalRange]:
        """The ranges of what has one, by key."""
        if self._ranges is None:
            self._ranges = ranges_of(self.params)
        return self._ranges

    _ranges: dict[str, PhysicalRange] | None = None

    def __del__(self) -> None:
        contents = list(self.__dict__.values())
        self.__dict__.clear()
        let_go(contents)


# What constructors raise, Mitsuba's and those of plugins in Python.
_OF_PLUGINS = (RuntimeError, ValueError, TypeError, ArithmeticError, AttributeError, LookupError, MemoryError)

# Mitsuba merges meshes of one surface, and stops where their normals are made in different ways.
_CANNOT_MERGE = "Mesh::merge()"


def build(description: Description, variant: str, options: BuildOptions) -> BuiltScene:
    """Instantiate a description under the active variant. Raises ``SceneError`` with file and line where Mitsuba
    knows them.
    """
    import mitsuba as mi

    if isinstance(description, ReadyScene):
        return _as_it_is(description, options)
    config = mi.parser.ParserConfig(variant)
    config.merge_equivalent = options.merge
    config.merge_meshes = options.merge
    try:
        with description.resolved_files(), plugins.plugin_errors(), threads_for_files():
            state = description.parse(config)
            # Files of older versions spell properties in another way.
            mi.parser.transform_upgrade(config, state)
            _check_root(state)
            check_nodes(state)
            check_mesh_files(state)
            check_taken_meshes(description.taken)
            name_nodes(state)
            if not options.merge:
                take_merged_apart(state)
                name_nested(state)
            stated = stated_nodes(state)
            _override_films(state, options)
            _override_integrator(state, options)
            _override_samplers(state, options)
            check_stated(config, state, stated)
            _substitute_plugins(state, options)
            transforms = mesh_transforms(state)
            placed = placements(state)
            integrator = find_child(state, state.root, is_integrator)
            plugin = "" if integrator is None else state.nodes[integrator].props.plugin_name()
            check_finite(state)
            forget_queries(state)
            textures = names_of_textures(state)
            mi.parser.transform_all(config, state)
            scene = mi.parser.instantiate(config, state)
            if not isinstance(scene, mi.Scene):
                raise SceneError(f"expected one <scene>, got {type(scene).__name__}.")
            name_instantiated(scene, textures)
            if description.taken:
                check_taken(scene, description.taken, options)
            _check_integrator(scene, options)
            params = mi.traverse(scene)
            check_scene(scene, params)
    except TorchTransientError as error:
        raise type(error)(f"{_location(error.__cause__) or description.name}: {error}") from error
    except _OF_PLUGINS as error:
        if options.merge and _CANNOT_MERGE in str(error):
            return build(description, variant, replace(options, merge=False))
        text = one_line(error).replace("While loading string", f"While loading {description.name}")
        said = unread_properties(str(error), description.name)
        raise SceneError(said or f"{description.name}: Mitsuba could not build the scene. {line_of(text)}") from error
    return BuiltScene(scene, params, transforms, plugin, placed, taken=pointers(description.taken))


def _as_it_is(description: ReadyScene, options: BuildOptions) -> BuiltScene:
    """A scene that is ready. Raises ``SceneError`` where ``options`` would change it."""
    import mitsuba as mi

    scene = description.scene
    check_taken(scene, description.taken, options)
    check_taken_meshes(description.taken)
    params = mi.traverse(scene)
    check_scene(scene, params)
    name = "" if scene.integrator() is None else class_of(scene.integrator())
    return BuiltScene(scene, params, integrator=name, taken=pointers(description.taken))


def _location(error: BaseException | None) -> str | None:
    """File and line, or dictionary node, that a message of Mitsuba names."""
    found = re.search(r'(?:At|While loading) (.+? \(line \d+, col \d+\)|dictionary node "[^"]+")', str(error or ""))
    return found.group(1) if found else None


def _check_root(state: Any) -> None:
    if state.root.props.plugin_name() != "scene":
        raise SceneError(f"expected a <scene> at the top, got <{state.root.props.plugin_name()}>.")


# --------------------------------------------------------------------------------------------------------- nodes


def _add_child(state: Any, parent: int, key: str, plugin: str, kind: Any, properties: Mapping[str, Any]) -> None:
    import mitsuba as mi

    there = dict(children(state, state.nodes[parent])).get(key)
    if there is not None:  # a plugin that Mitsuba does not know; in its place another one would be rendered
        unknown = state.nodes[there].props.plugin_name()
        raise SceneError(
            f"{key!r}: expected a plugin that Mitsuba or this library has as {key}, got {unknown!r}, which neither "
            "knows. Check how it is spelt. One of your own is made known, in every variant, by "
            "torchtransient.plugins.register_module of the module that registers it."
        )
    node = mi.parser.SceneNode()
    node.type = kind
    node.props = mi.Properties(plugin)
    for name, value in properties.items():
        node.props[name] = value
    state.nodes.append(node)
    if len(state.node_paths):
        state.node_paths = [*state.node_paths, key]
    state.nodes[parent].props[key] = mi.Properties.ResolvedReference(len(state.nodes) - 1)


# ----------------------------------------------------------------------------------------------------- overrides


def _override_films(state: Any, options: BuildOptions) -> None:
    import mitsuba as mi

    if options.film is None and not options.transient:
        return
    for index in range(len(state.nodes)):
        node = state.nodes[index]
        film = find_child(state, node, is_film)
        if film is None and node.type == mi.ObjectType.Sensor and _taken_of(node, mi.Film) is None:
            _add_child(state, index, "film", "hdrfilm", mi.ObjectType.Film, {})
            film = len(state.nodes) - 1
        if film is not None:
            _override_film(state, film, options)
            props = state.nodes[film].props
            for prefix in PREFIXES:
                write_pulse(props, prefix, getattr(options, prefix))
            if not options.steady:
                _leave_out_steady(props)


def _leave_out_steady(props: Any) -> None:
    kind = of_plugin(props.plugin_name())
    if kind is None or not kind.spares_steady:
        raise ArgumentError(
            f"steady=False spares a histogram the light outside of its window; the film is a {props.plugin_name()!r}. "
            "Leave it out."
        )
    props["steady"] = False


def _override_film(state: Any, index: int, options: BuildOptions) -> None:
    props, film = state.nodes[index].props, options.film
    plugin = props.plugin_name()
    if film is None:
        if options.transient and plugin in STEADY_FILMS:
            ways = " or ".join(f"TransientRenderer(..., {kind.example})" for kind in all_films())
            raise SceneError(
                f"the film is a steady {plugin!r}, which has no time axis. Give one: {ways}, or make the film one of "
                f"{plugins_in_words()}."
            )
        return
    if plugin in STEADY_FILMS and not options.transient:
        return
    if plugin != film.plugin and (plugin in STEADY_FILMS or of_plugin(plugin) is not None):
        if not film.takes_pulse and any(prefix in props for prefix in PREFIXES):
            raise SceneError(
                f"the film {plugin!r} has a pulse or an irf, which a {film.plugin} would lose; take it out."
            )
        _become(state, index, film.plugin, keep=FILM_PROPERTIES + PROPERTIES)
        props = state.nodes[index].props
    if not film.fits(props.plugin_name()):
        raise SceneError(f"the film {plugin!r} cannot become a {film.plugin}; make it one of {plugins_in_words()}.")
    film.write(props)


def _become(
    state: Any, index: int, plugin: str, keep: tuple[str, ...], nested: bool = True, source: int | None = None
) -> None:
    """Turn a node into another plugin; keep the named properties, of the node ``source`` or its own, and, if
    ``nested``, child objects and spectra.
    """
    import mitsuba as mi

    old, given = state.nodes[index].props, state.nodes[index if source is None else source].props
    inner = {key for key, _ in children(state, state.nodes[index])}
    inner |= {key for key in list(old.keys()) if old.type(key) == mi.Properties.Type.Spectrum}
    new = mi.Properties(plugin)
    new.set_id(old.id())
    for key in list(given.keys()):
        if key in keep or (nested and key in inner):
            new[key] = given[key]
    state.nodes[index].props = new


def _override_integrator(state: Any, options: BuildOptions) -> None:
    import mitsuba as mi

    index = find_child(state, state.root, is_integrator)
    if index is None and _taken_of(state.root, mi.Integrator) is not None:
        return  # which is looked at when the scene is built
    if options.transient:
        if index is None:
            plugin = "transient_prbvolpath" if media_in_use(state) else "transient_path"
            _add_child(state, 0, "integrator", plugin, mi.ObjectType.Integrator, {"max_depth": depth_of(state, None)})
            index = len(state.nodes) - 1
        index = path_tracer_of(state, index, replaced=options.integrator is not None)
        plugin, depth = state.nodes[index].props.plugin_name(), depth_of(state, index)
        if options.integrator is not None and plugin != options.integrator:
            source = tracing(state, index)
            _become(state, index, options.integrator, keep=_TRANSIENT_PROPERTIES, nested=False, source=source)
            state.nodes[index].props["max_depth"] = depth
        elif plugin in COUNTERPARTS:
            wanted = "transient_prbvolpath" if media_in_use(state) else COUNTERPARTS[plugin]
            _become(state, index, wanted, keep=PATH_PROPERTIES)
            state.nodes[index].props["max_depth"] = depth
        elif not is_transient_integrator(plugin):
            raise SceneError(
                f"integrator {plugin!r} has no transient counterpart. Expected transient_path, transient_prbvolpath, "
                f"or one that they can stand in for: {', '.join(COUNTERPARTS)}, direct, stokes."
                f"{ADVICE.get(plugin, '')}"
            )
    if options.max_depth is not None and index is not None:
        state.nodes[index].props["max_depth"] = int(options.max_depth)


def _check_integrator(scene: Any, options: BuildOptions) -> None:
    """Raise ``SceneError`` for an integrator of a user's that knows nothing of time."""
    integrator = scene.integrator()
    if options.transient and not isinstance(integrator, IntegratorInterface):
        raise SceneError(
            f"the integrator {class_of(integrator)} renders images. Expected one that renders through time: "
            "transient_path, transient_prbvolpath, or a subclass of their classes. mi.render takes it as it is."
        )


def _taken_of(node: Any, kind: type) -> str | None:
    """Name of the property that holds a plugin of a kind as it was taken."""
    return next((key for key, value in node.props.items() if isinstance(value, kind)), None)


def _override_samplers(state: Any, options: BuildOptions) -> None:
    """Another sampler with the same number of samples; parameters that only the old one had are dropped."""
    import mitsuba as mi

    if options.sampler is None:
        return
    for index in range(len(state.nodes)):
        node = state.nodes[index]
        if node.type != mi.ObjectType.Sensor:
            continue
        sampler = find_child(state, node, lambda child: child.type == mi.ObjectType.Sampler)
        taken = _taken_of(node, mi.Sampler)
        if sampler is None:
            count = {} if taken is None else {"sample_count": node.props[taken].sample_count()}
            _add_child(state, index, taken or "sampler", options.sampler, mi.ObjectType.Sampler, count)
        else:
            _become(state, sampler, options.sampler, keep=("sample_count", "seed"))


def _substitute_plugins(state: Any, options: BuildOptions) -> None:
    """Build plugins as their differentiable or complete twins, which take the same parameters, and bitmaps with a
    derivative.
    """
    import mitsuba as mi

    asked: dict[str, set[str]] = {}
    for name, slot in options.substitute:
        asked.setdefault(name, set()).add(slot)
    for node in state.nodes:
        plugin, name = node.props.plugin_name(), node.props.id()
        if mi.is_polarized and plugin in POLARIZED_PLUGINS:
            node.props.set_plugin_name(POLARIZED_PLUGINS[plugin])
        elif plugin in DIFFERENTIABLE_PLUGINS and (name in asked or _has_index_of_one(node.props)):
            node.props.set_plugin_name(DIFFERENTIABLE_PLUGINS[plugin])
            if plugin in BUILDS_LOBES and name in asked:
                node.props["lobes"] = ",".join(sorted(asked[name]))
        elif plugin in PLASTICS.values() and _lacks_mean(state, node):
            node.props.set_plugin_name(DIFFERENTIABLE_PLUGINS[plugin])
        elif plugin in COMPLETED_PLUGINS:
            node.props.set_plugin_name(COMPLETED_PLUGINS[plugin])
        elif plugin == "bitmap" and options.real_bitmaps:
            node.props["format"] = "variant"
        elif plugin == "twosided":
            # A lobe that is built although its weight is zero may be one of transmission.
            held = descendants(state, node)
            if any(inner.props.id() in asked and inner.props.plugin_name() in BUILDS_LOBES for inner in held):
                node.props["allow_transmission"] = True


def _lacks_mean(state: Any, node: Any) -> bool:
    """Return whether one of a plugin's textures, or of those that they hold, has no mean."""
    import mitsuba as mi

    described = any(inner.props.plugin_name() in TEXTURES_WITHOUT_MEAN for inner in descendants(state, node))
    return described or any(isinstance(v, mi.Texture) and not has_mean(v) for _, v in node.props.items())


def _has_index_of_one(props: Any) -> bool:
    """Return whether a node is a principled surface without a dielectric.

    Mitsuba's loses its mirror lobe there, that of its metal too; its twin has the limit, as it does for derivatives.
    """
    if props.plugin_name() != "principled":
        return False
    found = [(props.get(name), one) for name, one in (("specular", 0), ("eta", 1))]
    return any(isinstance(value, int | float) and abs(value - one) < 1e-12 for value, one in found)
