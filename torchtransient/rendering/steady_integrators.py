"""Integrators of Mitsuba that hold a path tracer, or are one of a fixed depth, and the path tracers in their place."""

from __future__ import annotations

from typing import Any

from torchtransient.errors import SceneError
from torchtransient.rendering.nodes import children, find_child, is_integrator

# What to do about those that show something beside light.
ADVICE = {
    "aov": " Give the integrator inside of it alone; depths, normals and numbers of shapes are "
    "torchtransient.rendering.labels.scene_labels.",
    "moment": " Give the integrator inside of it alone; errors of the light are tt.cost_of_accuracy.",
}


def path_tracer_of(state: Any, index: int) -> int:
    """Index of the integrator that is rendered in place of the one at ``index``: of a ``stokes`` the one inside, since
    films hold Stokes vectors in polarized variants; a ``direct`` becomes the ``path`` of two vertices that it is, and
    others stay.

    Raises SceneError for a ``stokes`` in an unpolarized variant and a ``direct`` that leaves out a kind of samples.
    """
    plugin = state.nodes[index].props.plugin_name()
    if plugin == "direct":
        _become_path(state, index)
    inner = find_child(state, state.nodes[index], is_integrator) if plugin == "stokes" else None
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
