"""``diff_rough_conductor``: Mitsuba's ``roughconductor`` with derivatives where its index or its absorption is zero."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins._registry import register
from torchtransient.plugins.node_walk import objects_of

from .ior import textured
from .microfacet import half_vector, normal_density, smith_g1_over_cos
from .mueller import across_plane, metal_reflection

_ROUGHNESS = ("alpha", "alpha_u", "alpha_v")
_UNBOUNDED = ("eta", "k", *_ROUGHNESS)
# Mitsuba's own least roughness.
_LEAST_ALPHA = 1e-4


class DiffRoughConductor(mi.BSDF):
    """Rough metal, parameters and values as Mitsuba's ``roughconductor``.

    ``material`` (name), or ``eta`` and ``k`` (textures); ``alpha``, or ``alpha_u`` and ``alpha_v`` (textures, clamped
    to 1e-4 from below); ``distribution`` (``beckmann`` or ``ggx``), ``sample_visible``, ``specular_reflectance``
    (texture). Differentiable: the textures and the directions.

    ``eval``, ``pdf`` and ``eval_pdf`` are attached to ``si.wi``, ``wo`` and the textures. ``sample`` draws a detached
    direction ``bs.wo``; ``bs.pdf`` is its attached density, and the weight is value over density with both attached. A
    roughness at the clamp has no derivative.

    Facets are smooth metals, in polarized variants with their Mueller matrix. Mitsuba's term for them subtracts two
    numbers that are equal to single precision where the index is small, or the absorption below total reflection.
    """

    def __init__(self, props: Any) -> None:
        mi.BSDF.__init__(self, props)
        given = {name: props[name] for name in ("material", "distribution", "sample_visible") if name in props}
        given |= {name: props.get_unbounded_texture(name) for name in _UNBOUNDED if name in props}
        if "specular_reflectance" in props:
            given["specular_reflectance"] = props.get_texture("specular_reflectance")
        # Mitsuba itself refuses what does not go together, and looks materials up.
        own = mi.load_dict({"type": "roughconductor", **given})
        self.textures = dict(objects_of(own))
        self.ggx = str(given.get("distribution", "beckmann")).lower() == "ggx"
        self.sample_visible = bool(given.get("sample_visible", True))
        self.m_components = [own.flags(i) for i in range(own.component_count())]
        self.m_flags = own.flags()

    def traverse(self, cb: Any) -> None:
        for name, texture in self.textures.items():
            edges = 0 if name == "specular_reflectance" else mi.ParamFlags.Discontinuous
            cb.put(name, texture, mi.ParamFlags.Differentiable | edges)

    def _alpha(self, si: Any, active: Any) -> tuple[Any, Any]:
        u, v = (
            dr.maximum(self.textures[name].eval_1(si, active), _LEAST_ALPHA)
            for name in (("alpha", "alpha") if "alpha" in self.textures else ("alpha_u", "alpha_v"))
        )
        return u, v

    def _lobe(self, ctx: Any, si: Any, wo: Any, m: Any, active: Any) -> tuple[Any, Any, Any]:
        """Density of ``wo``, value over density (without what the facets absorb), and the mask where both are meant."""
        wi = si.wi
        wi_m, wo_m = dr.dot(wi, m), dr.dot(wo, m)
        active = active & (wi.z > 0) & (wo.z > 0) & (wi_m > 0) & (wo_m > 0)
        active &= mi.Mask(ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0))
        alpha_u, alpha_v = self._alpha(si, active)
        density = normal_density(m, alpha_u, alpha_v, self.ggx)
        masking_i = smith_g1_over_cos(wi, m, alpha_u, alpha_v, self.ggx)
        weight = smith_g1_over_cos(wo, m, alpha_u, alpha_v, self.ggx) * wo.z
        if self.sample_visible:
            pdf = 0.25 * density * masking_i
        else:
            above = dr.select(active, m.z, 1.0)
            pdf = 0.25 * density * above / dr.select(active, wo_m, 1.0)
            weight *= masking_i * wo_m / above
        return dr.select(active, pdf, 0.0), dr.select(active, weight, 0.0), active

    def _spectrum(self, ctx: Any, si: Any, wo: Any, m: Any, value: Any, active: Any) -> Any:
        """``value`` times what the facets reflect."""
        eta, k = self.textures["eta"].eval(si, active), self.textures["k"].eval(si, active)
        colour = textured(value, self.textures.get("specular_reflectance"), si, active)
        matrix = metal_reflection(dr.dot(si.wi, m), eta, k)
        if not mi.is_polarized:
            return mi.Spectrum(colour * matrix) & active
        radiance = ctx.mode == mi.TransportMode.Radiance
        towards_sensor, towards_light = (si.wi, wo) if radiance else (wo, si.wi)
        matrix = across_plane(matrix, m, towards_sensor, towards_light)
        return mi.mueller.absorber(mi.UnpolarizedSpectrum(colour)) @ matrix & active

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        m, defined = half_vector(si.wi, wo, 1.0)
        pdf, weight, active = self._lobe(ctx, si, wo, m, mi.Mask(active) & defined)
        return self._spectrum(ctx, si, wo, m, pdf * weight, active), pdf

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        m, defined = half_vector(si.wi, wo, 1.0)
        return self._lobe(ctx, si, wo, m, mi.Mask(active) & defined)[0]

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        bs = dr.zeros(mi.BSDFSample3f)
        if not ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0):
            return bs, mi.Spectrum(0)
        active = mi.Mask(active) & (si.wi.z > 0)
        with dr.suspend_grad():
            wi = dr.detach(si.wi)
            alpha_u, alpha_v = self._alpha(si, active)
            kind = mi.MicrofacetType.GGX if self.ggx else mi.MicrofacetType.Beckmann
            drawn, _ = mi.MicrofacetDistribution(kind, alpha_u, alpha_v, self.sample_visible).sample(wi, sample2)
            m = mi.Vector3f(drawn)
            bs.wo = m * (2 * dr.dot(wi, m)) - wi
        # The facet that mirrors si.wi into the fixed direction. Its value is that which was drawn: the sum of the
        # directions has fewer digits.
        if dr.is_diff_v(m):  # dr.replace_grad ends the process on the vectors of a scalar variant
            m = dr.replace_grad(m, half_vector(si.wi, bs.wo, 1.0)[0])
        bs.pdf, weight, active = self._lobe(ctx, si, bs.wo, m, active)
        active &= bs.pdf > 0
        bs.eta, bs.sampled_component = mi.Float(1), mi.UInt32(0)
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        return bs, self._spectrum(ctx, si, bs.wo, m, weight, active)

    def to_string(self) -> str:
        held = "".join(f",\n  {name} = {texture}" for name, texture in self.textures.items())
        distribution = "ggx" if self.ggx else "beckmann"
        return (
            f"DiffRoughConductor[\n  distribution = {distribution},\n  sample_visible = {self.sample_visible}{held}\n]"
        )


register("bsdf", "diff_rough_conductor", DiffRoughConductor)
