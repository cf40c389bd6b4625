"""Edits of a parsed scene before it is built: options of a renderer, transient plugins in place of steady ones.

A property keeps its meaning, and one that is left out has the default of the plugin that the scene names. Mitsuba
builds that plugin first, so that it refuses misspelt properties and wrong values itself.

| in the scene | becomes |
|---|---|
| size, crop and spatial filter of a film, ``sample_border`` | kept |
| ``pixel_format`` of an ``hdrfilm`` | refused where it asks for other channels than a time-resolved film has |
| ``file_format``, ``component_format`` | without effect, since renders are tensors |
| ``max_depth``, ``rr_depth``, ``hide_emitters`` | kept; of ``aov``, ``moment``, ``stokes`` those of the nested one |
| ``use_spectral_mis`` (``volpathmis``), ``jitter``, ``strength`` (samplers) | without effect but on noise |
| ``shading_samples``, ``emitter_samples``, ``bsdf_samples`` (``direct``) | only noise; 0 of one kind is refused |
| ``timeout``, ``block_size``, ``samples_per_pass`` | without effect in variants that compile kernels |
| samples of silhouettes (``prb_projective``) | refused, see ``spp_boundary``; values that ask for none pass |
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from torchtransient.errors import ArgumentError, SceneError
from torchtransient.plugins import kind_of
from torchtransient.plugins.mitsuba_compat import (
    BUILDS_LOBES,
    COMPLETED_PLUGINS,
    DIFFERENTIABLE_PLUGINS,
    PLASTICS,
    POLARIZED_PLUGINS,
    TEXTURES_WITHOUT_MEAN,
)
from torchtransient.plugins.node_walk import has_mean
from torchtransient.pulses import Pulse
from torchtransient.scene.nodes import (
    children,
    descendants,
    find_child,
    has_media,
    is_film,
    is_integrator,
    is_transient_integrator,
    node_kind,
)
from torchtransient.scene.variant import quiet

NO_LIMIT = -1
# Steady integrators, and the transient ones for which their parameters mean the same.
_COUNTERPARTS = {
    **dict.fromkeys(("path", "prb", "prb_basic", "prb_projective"), "transient_path"),
    **dict.fromkeys(("volpath", "volpathmis", "prbvolpath"), "transient_prbvolpath"),
}
_PATH_PROPERTIES = ("max_depth", "rr_depth", "hide_emitters")
_STEADY_FILMS = ("hdrfilm", "specfilm")
# Properties that a transient film takes over from a steady one.
_FILM_PROPERTIES = (
    "width", "height", "crop_width", "crop_height", "crop_offset_x", "crop_offset_y", "sample_border",
    "exhaustive_scan", "laser_scan_width", "laser_scan_height",
)  # fmt: skip
# Properties that one film with bins takes over from another.
_BIN_PROPERTIES = ("start_opl", "bin_width_opl", "temporal_bins", "temporal_filter", "gaussian_stddev")
# Properties that one transient integrator takes over from another.
_TRANSIENT_PROPERTIES = (
    *_PATH_PROPERTIES, "camera_unwarp", "discard_direct_light", "temporal_filter", "gaussian_stddev",
)  # fmt: skip

# Further ones that these integrators of the library read.
_OWN_PROPERTIES = {
    **dict.fromkeys(
        ("transient_path", "transient_prbvolpath", "transient_path_reuse"), ("connections", "boundary", "spp_boundary")
    ),
    "transient_nlos_path": ("boundary",),
}

# Advice for integrators of other pictures.
_ADVICE = {
    "aov": " Give the integrator inside of it alone; depths, normals and numbers of shapes are tt.data.scene_labels.",
    "moment": " Give the integrator inside of it alone; errors of the light are tt.cost_of_accuracy.",
}
# Integrators that measure the paths of a nested one.
_AROUND_OTHERS = ("aov", "moment", "stokes")
# `max_depth` of integrators that do not state it; the others are written in Python and have that of the transient ones.
_DEPTHS = {
    **dict.fromkeys(("path", "volpath", "volpathmis", "ptracer"), NO_LIMIT),
    **dict.fromkeys(("direct", "direct_projective"), 2),
}
_DEPTH_IN_PYTHON = 6
# Properties of silhouettes, and values of them that ask for no samples.
_SILHOUETTES = {
    "sppc": (), "sppp": (0,), "sppi": (0,), "guiding": ("none",),
    "guiding_proj": (False,), "guiding_rounds": (), "project_seed": (),
}  # fmt: skip
# Values of `pixel_format` that an `hdrfilm` prints in another way.
_PRINTED = {"y": "luminance", "ya": "luminance_alpha"}
# Pulses and impulse responses as properties of films, and the films that spread arrivals by them.
_PULSES = ("pulse", "irf")
_PULSE_NUMBERS = ("fwhm_opl", "width_opl", "center_opl", "opl", "values")
_PULSE_PROPERTIES = tuple(prefix + suffix for prefix in _PULSES for suffix in ("", *(f"_{n}" for n in _PULSE_NUMBERS)))
_SPREADING = ("transient_hdr_film", "gated_hdr_film", "rate_hdr_film", "beat_hdr_film")


class FilmRequest(Protocol):
    """Film that replaces those of a scene: a plugin and its properties."""

    @property
    def plugin(self) -> str:
        """Name of the plugin."""

    @property
    def argument(self) -> str:
        """Argument of a renderer that chooses the film, for messages."""

    @property
    def has_bins(self) -> bool:
        """The film has bins of time."""

    @property
    def takes_pulse(self) -> bool:
        """The film spreads arrivals by a pulse."""

    def describes(self, film: Any) -> bool:
        """Return whether a built film has the properties.

        Args:
            film: a built film.
        """

    def fits(self, plugin: str) -> bool:
        """Return whether a film plugin takes the properties.

        Args:
            plugin: name of a film plugin.
        """

    def write(self, props: Any) -> None:
        """Write the properties into those of a film node.

        Args:
            props: ``mitsuba.Properties`` of the node.
        """


@dataclass(frozen=True)
class BuildOptions:
    """Changes of a description before it is built.

    Attributes:
        film: film that takes the place of every film, None to keep them.
        max_depth: bound for the integrator, None to keep its own.
        rr_depth: parameter of the integrator, None to keep its own, as is kept where no depth ends paths.
        connections: parameter of the integrator, None to keep its own.
        substitute: BSDFs to be built as their differentiable twins: name, and name of the texture with the parameter
            ("" for a number).
        real_bitmaps: store bitmaps as real numbers; Mitsuba keeps 8-bit images in 8 bits, which have no derivative.
        merge: let Mitsuba merge meshes and equal materials, which is faster to trace but takes parameters away.
        transient: turn a steady film and integrator into transient ones.
        pulse, irf: shape of the pulse and impulse response of every film, None to keep their own.
        steady: False takes the steady image from the histograms.
        integrator: plugin name of a transient integrator that replaces the scene's, with the parameters of both.
    """

    film: FilmRequest | None = None
    max_depth: int | None = None
    rr_depth: int | None = None
    connections: str | None = None
    substitute: frozenset[tuple[str, str]] = frozenset()
    real_bitmaps: bool = False
    merge: bool = False
    transient: bool = False
    pulse: Pulse | None = None
    irf: Pulse | None = None
    steady: bool = True
    integrator: str | None = None


def edit(config: Any, state: Any, options: BuildOptions) -> None:
    """Edit a parsed scene in place.

    Args:
        config: ``mitsuba.parser.ParserConfig`` of the variant.
        state: ``mitsuba.parser.ParserState``.
        options: the changes.

    Raises:
        SceneError: for changes that would lose something of the scene.
    """
    described = _replaceable(state)
    _edit_films(state, options)
    _edit_integrator(state, options)
    _check_replaced(config, state, described)
    _substitute_twins(state, options)


# --------------------------------------------------------------------------------------------------------------- nodes


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


def _become(
    state: Any, index: int, plugin: str, keep: tuple[str, ...], nested: bool = True, source: int | None = None
) -> None:
    """Turn a node into another plugin with the properties ``keep`` of the node ``source``, by default its own.

    ``nested``: keep child objects and spectra too.
    """
    import mitsuba as mi

    old, kept = state.nodes[index].props, state.nodes[index if source is None else source].props
    inner = {key for key, _ in children(state, state.nodes[index])}
    inner |= {key for key in list(old.keys()) if old.type(key) == mi.Properties.Type.Spectrum}
    new = mi.Properties(plugin)
    new.set_id(old.id())
    for key in list(kept.keys()):
        if key in keep or (nested and key in inner):
            new[key] = kept[key]
    state.nodes[index].props = new


def _loaded_child(node: Any, kind: type) -> str | None:
    """Return the property that holds a loaded plugin of a kind, None without one."""
    return next((key for key, value in node.props.items() if isinstance(value, kind)), None)


def forget_queries(state: Any) -> None:
    """Mark all properties of a parsed scene as unread: looking at one counts as use, and hides misspelt ones.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
    """
    for node in state.nodes:
        for key in list(node.props.keys()):
            node.props.mark_queried(key, False)


# --------------------------------------------------------------------------------------------------------------- films


def _edit_films(state: Any, options: BuildOptions) -> None:
    import mitsuba as mi

    if options.film is None and not options.transient:
        return
    for index in range(len(state.nodes)):
        node = state.nodes[index]
        film = find_child(state, node, is_film)
        if film is None and node.type == mi.ObjectType.Sensor and _loaded_child(node, mi.Film) is None:
            _add_child(state, index, "film", "hdrfilm", mi.ObjectType.Film, {})
            film = len(state.nodes) - 1
        if film is not None:
            _edit_film(state, film, options)
            props = state.nodes[film].props
            for prefix in _PULSES:
                _write_pulse(props, prefix, getattr(options, prefix))
            if not options.steady:
                props["steady"] = False  # which Mitsuba reports as unread for films that have no such property


def _edit_film(state: Any, index: int, options: BuildOptions) -> None:
    props, film = state.nodes[index].props, options.film
    plugin = props.plugin_name()
    if film is None:
        if options.transient and plugin in _STEADY_FILMS:
            raise SceneError(
                f"the film is a steady {plugin!r}, which has no time axis. Give TransientRenderer(..., time_axis=...), "
                "frequencies=..., gates=..., rates=... or chirps=..., or make the film a transient_hdr_film, "
                "phasor_hdr_film, gated_hdr_film, rate_hdr_film or beat_hdr_film."
            )
        return
    if plugin in _STEADY_FILMS and not options.transient:
        return
    if plugin != film.plugin and (plugin in _STEADY_FILMS or kind_of(plugin) == "film"):
        if not film.takes_pulse and any(prefix in props for prefix in _PULSES):
            raise SceneError(
                f"the film {plugin!r} has a pulse or an irf, which a {film.plugin} would lose; take it out."
            )
        kept = _FILM_PROPERTIES + _PULSE_PROPERTIES + (_BIN_PROPERTIES if film.has_bins else ())
        _become(state, index, film.plugin, keep=kept)
        props = state.nodes[index].props
    if not film.fits(props.plugin_name()):
        raise SceneError(f"the film {plugin!r} cannot become a {film.plugin}; make it one.")
    film.write(props)


# ------------------------------------------------------------------------------------------------------- integrators


def _edit_integrator(state: Any, options: BuildOptions) -> None:
    import mitsuba as mi

    index = find_child(state, state.root, is_integrator)
    if index is None and _loaded_child(state.root, mi.Integrator) is not None:
        return  # a loaded one is checked in the built scene
    if options.transient:
        if index is None:
            # Mitsuba renders a scene without an integrator by `path`, which has no limit.
            plugin = "transient_prbvolpath" if has_media(state) else "transient_path"
            _add_child(state, 0, "integrator", plugin, mi.ObjectType.Integrator, {"max_depth": NO_LIMIT})
            index = len(state.nodes) - 1
        index = _path_tracer(state, index, replaced=options.integrator is not None)
        plugin, depth = state.nodes[index].props.plugin_name(), described_depth(state, index)
        if options.integrator is not None and plugin != options.integrator:
            source = _traced(state, index)
            kept = _TRANSIENT_PROPERTIES + _OWN_PROPERTIES.get(options.integrator, ())
            _become(state, index, options.integrator, keep=kept, nested=False, source=source)
            state.nodes[index].props["max_depth"] = depth
        elif plugin in _COUNTERPARTS:
            wanted = "transient_prbvolpath" if has_media(state) else _COUNTERPARTS[plugin]
            _become(state, index, wanted, keep=_PATH_PROPERTIES)
            state.nodes[index].props["max_depth"] = depth
        elif not is_transient_integrator(plugin):
            raise SceneError(
                f"integrator {plugin!r} has no transient counterpart. Expected transient_path, transient_prbvolpath, "
                f"or one that they can stand in for: {', '.join(_COUNTERPARTS)}, direct, stokes."
                f"{_ADVICE.get(plugin, '')}"
            )
    if options.max_depth is not None and index is not None:
        state.nodes[index].props["max_depth"] = int(options.max_depth)
    if options.rr_depth is not None and index is not None and described_depth(state, index) != NO_LIMIT:
        state.nodes[index].props["rr_depth"] = options.rr_depth
    if options.connections is not None and index is not None:
        state.nodes[index].props["connections"] = options.connections


def _traced(state: Any, index: int) -> int:
    """Return the index of the integrator that traces the paths of another one: itself or a nested one."""
    nested = None
    if state.nodes[index].props.plugin_name() in _AROUND_OTHERS:
        nested = find_child(state, state.nodes[index], is_integrator)
    return index if nested is None else _traced(state, nested)


def described_depth(state: Any, index: int) -> Any:
    """Return ``max_depth`` of the integrator at node ``index``, or the plugin's default; -1 for no limit.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
        index: index of the node of an integrator.
    """
    props = state.nodes[_traced(state, index)].props
    return props.get("max_depth", _DEPTHS.get(props.plugin_name(), _DEPTH_IN_PYTHON))


def built_depth(integrator: Any) -> int | None:
    """Return ``max_depth`` of a built integrator, -1 for no limit; None for one without.

    Args:
        integrator: a built integrator.
    """
    depth = getattr(integrator, "max_depth", None)
    return None if depth is None else NO_LIMIT if int(depth) % 2**32 == 2**32 - 1 else int(depth)


def _path_tracer(state: Any, index: int, replaced: bool) -> int:
    """Return the index of the integrator that is rendered in place of the one at ``index``.

    Of a ``stokes`` it is the nested one, since films hold Stokes vectors in polarized variants; a ``direct`` becomes a
    ``path`` of two vertices. ``replaced``: another plugin takes its place anyway, as in pilot runs.
    """
    plugin = state.nodes[index].props.plugin_name()
    if plugin == "direct":
        _become_path(state, index)
    inner = find_child(state, state.nodes[index], is_integrator) if plugin == "stokes" and not replaced else None
    return index if inner is None else _unwrap_stokes(state, index, inner)


def _unwrap_stokes(state: Any, index: int, inner: int) -> int:
    import mitsuba as mi

    if not mi.is_polarized:
        raise SceneError(
            f"integrator 'stokes': expected a polarized variant, got {mi.variant()!r}. Load the scene with "
            "variant='llvm_ad_spectral_polarized', or give the integrator inside of it alone."
        )
    for name, child in children(state, state.root):
        if child == index:
            state.root.props[name] = mi.Properties.ResolvedReference(inner)
    # Nothing refers to it any more: `_check_replaced` builds it as it was, for its own misspelt properties.
    state.nodes[index].props.set_plugin_name(state.nodes[inner].props.plugin_name())
    return inner


def _become_path(state: Any, index: int) -> None:
    import mitsuba as mi

    old, props = state.nodes[index].props, mi.Properties("path")
    if any(key in old and old[key] == 0 for key in ("emitter_samples", "bsdf_samples")):
        raise SceneError(
            "integrator 'direct': expected samples of emitters and of BSDFs, got one kind alone, which shows a way of "
            "sampling. Leave out emitter_samples and bsdf_samples, or describe it as 'path' with max_depth = 2."
        )
    props.set_id(old.id())
    props["max_depth"] = 2
    if "hide_emitters" in old:
        props["hide_emitters"] = old["hide_emitters"]
    state.nodes[index].props = props


# --------------------------------------------------------------------------------------------------------------- twins


def _substitute_twins(state: Any, options: BuildOptions) -> None:
    """Replace plugins by their differentiable or complete twins, and store bitmaps as real numbers."""
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
        elif plugin in PLASTICS.values() and (_lacks_mean(state, node) or _is_too_bright(node.props)):
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
    """Return whether a texture of a plugin, or one inside it, has no mean."""
    import mitsuba as mi

    described = any(inner.props.plugin_name() in TEXTURES_WITHOUT_MEAN for inner in descendants(state, node))
    return described or any(isinstance(v, mi.Texture) and not has_mean(v) for _, v in node.props.items())


def _is_too_bright(props: Any) -> bool:
    """Return whether a node is a smooth plastic whose index is beyond that of Mitsuba's fit (see ``diff_plastic``)."""
    from torchtransient.plugins.bsdfs.ior import relative_index
    from torchtransient.plugins.bsdfs.plastic import GOOD_FIT

    given = any(name in props for name in ("int_ior", "ext_ior"))
    if props.plugin_name() != "plastic" or not given:
        return False
    return bool(relative_index(props, "plastic", "polypropylene")[0] > GOOD_FIT)


def _has_index_of_one(props: Any) -> bool:
    """Return whether a node is a principled surface without a dielectric.

    Mitsuba's plugin loses its mirror lobe there, that of its metal too; the twin renders the limit.
    """
    if props.plugin_name() != "principled":
        return False
    found = [(props.get(name), one) for name, one in (("specular", 0), ("eta", 1))]
    return any(isinstance(value, int | float) and abs(value - one) < 1e-12 for value, one in found)


# ------------------------------------------------------------------------------------------------ replaced plugins


def _replaceable(state: Any) -> dict[int, Any]:
    """Return copies of the films, integrators and samplers of a parsed scene, by index."""
    import mitsuba as mi

    return {
        index: mi.parser.SceneNode(node)
        for index, node in enumerate(state.nodes)
        if is_film(node) or is_integrator(node) or node_kind(node) == "Sampler"
    }


def _check_replaced(config: Any, state: Any, described: Mapping[int, Any]) -> None:
    """Build every node that has become another plugin as it was described, so that Mitsuba refuses its mistakes.

    Raises ``SceneError`` for channels and samples of silhouettes, which the other plugin does not have.
    """
    import mitsuba as mi

    changed = {
        index: node
        for index, node in described.items()
        if node.props.plugin_name() != state.nodes[index].props.plugin_name() and _is_built(node.props.plugin_name())
    }
    if not changed:
        return
    alone = mi.parser.ParserConfig(config.variant)
    alone.parallel = alone.merge_equivalent = alone.merge_meshes = False
    whole = mi.parser.ParserState(state)
    for index, node in changed.items():
        whole.nodes[index] = node
    forget_queries(whole)
    mi.parser.transform_resolve(alone, whole)
    paths = list(whole.node_paths)
    for index, node in changed.items():
        # Mitsuba builds the first node and what it refers to.
        whole.nodes[0] = mi.parser.SceneNode(whole.nodes[index])
        whole.node_paths = [paths[index], *paths[1:]] if paths else []
        with quiet():
            plugin = _built(alone, whole, node.props.plugin_name())
        if node.props.plugin_name() == "hdrfilm":
            _check_channels(plugin, state.nodes[index].props.plugin_name())
        _check_silhouettes(node.props)


def _is_built(plugin: str) -> bool:
    """Return False for films with response curves in variants without wavelengths, which no film of curves takes."""
    import mitsuba as mi

    return plugin != "specfilm" or bool(mi.is_spectral)


def _built(config: Any, state: Any, plugin: str) -> Any:
    import mitsuba as mi

    if plugin != "stokes" or mi.is_polarized:
        return mi.parser.instantiate(config, state)
    # Pilot runs are unpolarized, where Mitsuba has no `stokes`. `moment` reads the same properties.
    state.nodes[0].props.set_plugin_name("moment")
    try:
        return mi.parser.instantiate(config, state)
    except RuntimeError as error:
        raise RuntimeError(str(error).replace('plugin of type "moment"', 'plugin of type "stokes"')) from error


def _check_channels(film: Any, wanted: str) -> None:
    import mitsuba as mi

    found, there = pixel_format(film), "luminance" if mi.is_monochromatic else "rgb"
    if found != there:
        raise SceneError(
            f"hdrfilm: pixel_format: expected {there!r}, got {found!r}: a {wanted} has the channels of "
            f"{mi.variant()}, without alpha. Make it {there!r} or leave it out. Variants '..._mono' have luminance; "
            "tt.data.scene_labels has depths and normals of pixels."
        )


def _check_silhouettes(props: Any) -> None:
    found = [name for name, none in _SILHOUETTES.items() if name in props and props[name] not in none]
    if found:
        raise SceneError(
            f"{props.plugin_name()}: {', '.join(map(repr, found))}: expected no samples of silhouettes in the "
            "description. Leave it out; spp_boundary= of a TransientRenderer sets them, and spp_grad= the samples of a "
            "derivative."
        )


def printed_properties(plugin: Any) -> dict[str, str]:
    """Return the properties that a plugin of Mitsuba prints, by name.

    Args:
        plugin: a built plugin.
    """
    return dict(re.findall(r"^ *(\w+) = ([^\n,\[]+),?$", str(plugin), flags=re.MULTILINE))


def pixel_format(film: Any) -> str:
    """Return ``pixel_format`` of a built ``hdrfilm``; file format and variant may have replaced the described one.

    Args:
        film: a built ``hdrfilm``.
    """
    printed = printed_properties(film)["pixel_format"].strip()
    return _PRINTED.get(printed, printed)

# -------------------------------------------------------------------------------------------------------------- pulses


def checked_pulse(name: str, value: Any) -> Pulse | None:
    """Return a pulse of a call, or None.

    Args:
        name: name of the argument, for the message.
        value: value of the argument.

    Raises:
        ArgumentError: for other objects.
    """
    if value is None or isinstance(value, Pulse):
        return value
    raise ArgumentError(
        f"{name}: expected a tt.Pulse, for instance tt.Pulse.gaussian(fwhm_opl=0.05), got {type(value).__name__}."
    )


def _write_pulse(props: Any, prefix: str, pulse: Pulse | None) -> None:
    """Replace the pulse of a film node; None leaves the film its own."""
    if pulse is None:
        return
    if props.plugin_name() not in _SPREADING:
        raise SceneError(
            f"{prefix}: the film {props.plugin_name()!r} does not spread arrivals over time, "
            f"{' and '.join(_SPREADING)} do. "
            "Multiply a phasor by torchtransient.pulses.transform(pulse, frequencies) instead, or leave it out."
        )
    for name in _PULSE_NUMBERS:
        if f"{prefix}_{name}" in props:
            del props[f"{prefix}_{name}"]
    props[prefix] = pulse.kind
    props[f"{prefix}_center_opl"] = pulse.center_opl
    if pulse.kind == "tabulated":
        props[f"{prefix}_opl"] = ", ".join(map(repr, pulse.opl))
        props[f"{prefix}_values"] = ", ".join(map(repr, pulse.values))
    else:
        props[f"{prefix}_{'fwhm' if pulse.kind == 'gaussian' else 'width'}_opl"] = pulse.width_opl
