"""Plugins of steady pictures, and the time-resolved ones that are built in their place.

What a node states keeps its meaning, and what it leaves out has the default of the plugin that it names. Mitsuba builds
that plugin first, so that it refuses what it would refuse in a picture: misspelt properties and values that are none.

| stated | becomes |
|---|---|
| size, crop and spatial filter of a film, ``sample_border`` | kept |
| ``pixel_format`` of an ``hdrfilm`` | refused where it asks for other channels than a time-resolved film has |
| ``file_format``, ``component_format`` | without effect, since renders are tensors |
| ``max_depth``, ``rr_depth``, ``hide_emitters`` | kept; of ``aov``, ``moment``, ``stokes`` those of the nested one |
| ``use_spectral_mis`` (``volpathmis``), ``jitter``, ``strength`` (samplers) | without effect but on noise |
| ``shading_samples``, ``emitter_samples``, ``bsdf_samples`` (``direct``) | only noise; 0 of one kind is refused |
| ``timeout``, ``block_size``, ``samples_per_pass`` | without effect in variants that compile kernels |
| samples of silhouettes (``prb_projective``) | refused, see ``spp_boundary``; those that ask for none pass |
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torchtransient.errors import SceneError
from torchtransient.pulses import Pulse
from torchtransient.rendering.films.choice import FilmChoice
from torchtransient.rendering.interrupts import quiet
from torchtransient.scene.nodes import children, find_child, is_film, is_integrator, kind_of_node

NO_LIMIT = -1
# Steady integrators, and the transient ones for which their parameters mean the same.
COUNTERPARTS = {
    **dict.fromkeys(("path", "prb", "prb_basic", "prb_projective"), "transient_path"),
    **dict.fromkeys(("volpath", "volpathmis", "prbvolpath"), "transient_prbvolpath"),
}
PATH_PROPERTIES = ("max_depth", "rr_depth", "hide_emitters")
# What a transient film takes over from a steady one.
STEADY_FILMS = ("hdrfilm", "specfilm")
FILM_PROPERTIES = (
    "width", "height", "crop_width", "crop_height", "crop_offset_x", "crop_offset_y", "sample_border",
    "exhaustive_scan", "laser_scan_width", "laser_scan_height",
)  # fmt: skip

# What to do about those that show something beside light.
ADVICE = {
    "aov": " Give the integrator inside of it alone; depths, normals and numbers of shapes are "
    "torchtransient.rendering.labels.scene_labels.",
    "moment": " Give the integrator inside of it alone; errors of the light are tt.cost_of_accuracy.",
}
# They measure what a nested integrator traces.
_AROUND_OTHERS = ("aov", "moment", "stokes")
# `max_depth` of integrators that do not state it; the others are written in Python and have that of the transient ones.
_DEPTHS = {
    **dict.fromkeys(("path", "volpath", "volpathmis", "ptracer"), NO_LIMIT),
    **dict.fromkeys(("direct", "direct_projective"), 2),
}
_DEPTH_IN_PYTHON = 6
# Properties of silhouettes, and values of them that ask for no samples.
_OF_SILHOUETTES = {
    "sppc": (), "sppp": (0,), "sppi": (0,), "guiding": ("none",),
    "guiding_proj": (False,), "guiding_rounds": (), "project_seed": (),
}  # fmt: skip
# What an `hdrfilm` prints for some of the values of its `pixel_format`.
_PRINTED = {"y": "luminance", "ya": "luminance_alpha"}


def tracing(state: Any, index: int) -> int:
    """Index of the integrator that traces the paths of the integrator at ``index``: itself or a nested one."""
    nested = None
    if state.nodes[index].props.plugin_name() in _AROUND_OTHERS:
        nested = find_child(state, state.nodes[index], is_integrator)
    return index if nested is None else tracing(state, nested)


def depth_of(state: Any, index: int | None) -> Any:
    """``max_depth`` of an integrator, as it is stated or by default, -1 for no limit; None: that of a scene without
    one, which Mitsuba renders by ``path``.
    """
    if index is None:
        return NO_LIMIT
    props = state.nodes[tracing(state, index)].props
    return props.get("max_depth", _DEPTHS.get(props.plugin_name(), _DEPTH_IN_PYTHON))


def path_tracer_of(state: Any, index: int, replaced: bool) -> int:
    """Index of the integrator that is rendered in place of the one at ``index``: of a ``stokes`` the one inside, since
    films hold Stokes vectors in polarized variants; a ``direct`` becomes the ``path`` of two vertices that it is, and
    others stay. ``replaced``: whether another plugin takes its place anyway, as in pilot runs.

    Raises SceneError for a ``stokes`` in an unpolarized variant and a ``direct`` that leaves out a kind of samples.
    """
    plugin = state.nodes[index].props.plugin_name()
    if plugin == "direct":
        _become_path(state, index)
    inner = find_child(state, state.nodes[index], is_integrator) if plugin == "stokes" and not replaced else None
    return index if inner is None else _taken_out(state, index, inner)


def _taken_out(state: Any, index: int, inner: int) -> int:
    import mitsuba as mi

    if not mi.is_polarized:
        raise SceneError(
            f"integrator 'stokes': expected a polarized variant, got {mi.variant()!r}. Load the scene with "
            "variant='llvm_ad_spectral_polarized', or give the integrator inside of it alone."
        )
    for name, child in children(state, state.root):
        if child == index:
            state.root.props[name] = mi.Properties.ResolvedReference(inner)
    # Nothing refers to it any more: `check_stated` builds it as it was stated, for its own misspelt properties.
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


def shown_properties(plugin: Any) -> dict[str, str]:
    """Properties that a plugin of Mitsuba prints, by name."""
    return dict(re.findall(r"^ *(\w+) = ([^\n,\[]+),?$", str(plugin), flags=re.MULTILINE))


def pixels_of(film: Any) -> str:
    """``pixel_format`` of a built ``hdrfilm``; its file format and the variant may have replaced the one stated."""
    printed = shown_properties(film)["pixel_format"].strip()
    return _PRINTED.get(printed, printed)


# ------------------------------------------------------------------------------------------------------------- checks


def stated_nodes(state: Any) -> dict[int, Any]:
    """Copies of the nodes of a parsed scene that may be translated, by index."""
    import mitsuba as mi

    return {
        index: mi.parser.SceneNode(node)
        for index, node in enumerate(state.nodes)
        if is_film(node) or is_integrator(node) or kind_of_node(node) == "Sampler"
    }


def check_stated(config: Any, state: Any, stated: Mapping[int, Any]) -> None:
    """Build every node that has become another plugin as it was ``stated``.

    Raises what Mitsuba raises for it, and SceneError for properties that ask for something that is not there.
    """
    import mitsuba as mi

    changed = {
        index: node
        for index, node in stated.items()
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


def forget_queries(state: Any) -> None:
    """Mark all properties of a parsed scene as unread: looking at one counts as use, and hides misspelt ones."""
    for node in state.nodes:
        for key in list(node.props.keys()):
            node.props.mark_queried(key, False)


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

    found, there = pixels_of(film), "luminance" if mi.is_monochromatic else "rgb"
    if found != there:
        raise SceneError(
            f"hdrfilm: pixel_format: expected {there!r}, got {found!r}: a {wanted} has the channels of "
            f"{mi.variant()}, without alpha. Make it {there!r} or leave it out. Variants '..._mono' have luminance; "
            "torchtransient.rendering.labels tells what pixels see."
        )


def _check_silhouettes(props: Any) -> None:
    found = [name for name, none in _OF_SILHOUETTES.items() if name in props and props[name] not in none]
    if found:
        raise SceneError(
            f"{props.plugin_name()}: {', '.join(map(repr, found))}: expected no samples of silhouettes in the "
            "description. Leave it out; of a TransientRenderer spp_boundary= says them, and spp_grad= the samples of "
            "a derivative."
        )


@dataclass(frozen=True)
class BuildOptions:
    """What is changed of a description when it is built.

    ``film``: what every film becomes, None to keep them. ``max_depth``: for the integrator, or None. ``substitute``:
    BSDFs that are built as their differentiable twins, by name, with the texture that is asked for or "".
    ``real_bitmaps``: store every bitmap as real numbers;
    Mitsuba keeps 8-bit images in 8 bits, which have no derivative. ``merge``: let Mitsuba merge meshes and equal
    materials, which is faster to trace but takes parameters away. ``transient``: turn a steady film and integrator into
    transient ones. ``sampler``: plugin name of a sampler that replaces those of the sensors, with the same number of
    samples; None to keep them. ``pulse``, ``irf``: shape of the light's pulse and impulse response of the sensor for
    every film, None to keep what the films have. ``integrator``: plugin name of a transient integrator that replaces
    the scene's, with the parameters that both have; None to keep it. ``steady``: False takes the steady image from the
    histograms.
    """

    film: FilmChoice | None = None
    max_depth: int | None = None
    substitute: frozenset[tuple[str, str]] = frozenset()
    real_bitmaps: bool = False
    merge: bool = False
    transient: bool = False
    sampler: str | None = None
    pulse: Pulse | None = None
    irf: Pulse | None = None
    steady: bool = True
    integrator: str | None = None


def depth_limit(integrator: Any) -> int | None:
    """``max_depth`` of a built integrator, -1 for no limit; None for one without."""
    depth = getattr(integrator, "max_depth", None)
    return None if depth is None else NO_LIMIT if int(depth) % 2**32 == 2**32 - 1 else int(depth)
