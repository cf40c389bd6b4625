"""``retroreflector``: a surface that sends light back to where it came from (sheeting, tape, road signs)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.plugins._registry import register
from torchtransient.plugins.bsdfs.ior import opaque
from torchtransient.plugins.bsdfs.microfacet import ALPHA_MIN, half_vector, normal_density, smith_g1_over_cos
from torchtransient.plugins.parameter_effect import VALUE, declare_effects
from torchtransient.plugins.properties import number

# The lobe is drawn no less and no more often than this, so that its derivative by the share is there at zero and one.
_LEAST_DRAWN = 0.1


class Retroreflector(mi.BSDF):
    """A lobe around the direction that the light came from, beside a diffuse rest (:monosp:`retroreflector`).

    ``reflectance`` (texture, 0.8)
        Colour of both.
    ``share`` (number in [0, 1]; 1)
        How much of it goes back; the rest is Lambertian.
    ``alpha`` (number; 0.02)
        Width of the lobe: the roughness of a GGX microfacet surface whose mirror lobe would be as wide. Light is spread
        by about ``2 alpha`` radians around the way back. Clamped to 1e-3 from below.

    The lobe is that of a rough mirror for the *back vector*, the half vector of one direction and of the mirror image
    of the other about the normal: ``share reflectance D(b) G1(i) G1(o) / 4 cos i cos o`` with
    ``b = normalize(i + mirror(o))``, and so the BRDF of those facets with ``mirror(o)`` in the place of ``o``: it is
    reciprocal, reflects no more than ``reflectance``, and loses as much of it where it is rough (``alpha`` above 0.3)
    as every microfacet model of single scattering. One-sided: put it into a ``twosided`` for both. Depolarizes in
    polarized variants. Differentiable: ``reflectance``, ``share`` and ``alpha``; they move nothing. ``sample`` draws a
    detached direction, its weight is value over density.

    Not supported: the shift of a beam to the side inside a corner cube, the cones in which corner cubes fail, and the
    length of the way inside them.

    Source: J. Portsmouth, M. Raab, L. Belcour, F. Liu, The minimal retroreflective microfacet model, Journal of
    Computer Graphics Techniques 15(1), 2026, 60-75 (mirroring one direction, with the proofs of reciprocity and
    energy); L. Belcour, R. Pacanowski, M. Delahaie, A. Laville-Geay, L. Eupherte, Bidirectional reflectance
    distribution function measurements and analysis of retroreflective materials, JOSA A 31(12), 2014, 2561-2572 (the
    back vector, against measurements, with Beckmann facets); B. Walter et al., Microfacet models for refraction through
    rough surfaces, EGSR 2007 (GGX facets and their masking).
    """

    def __init__(self, props: Any) -> None:
        mi.BSDF.__init__(self, props)
        self.reflectance = props.get_texture("reflectance", 0.8)
        share, alpha = number(props, "share", 1.0), number(props, "alpha", 0.02)
        if not 0 <= share <= 1:
            raise SceneError(f"retroreflector: expected a 'share' from 0 to 1, got {share:g}.")
        if not 0 < alpha <= 1:
            raise SceneError(f"retroreflector: expected an 'alpha' above 0 and up to 1, got {alpha:g}.")
        self.share, self.alpha = opaque(mi.Float(share)), opaque(mi.Float(alpha))
        self.m_components = [
            mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide,
            mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide,
        ]
        self.m_flags = self.m_components[0] | self.m_components[1]

    def traverse(self, cb: Any) -> None:
        cb.put("reflectance", self.reflectance, +mi.ParamFlags.Differentiable)
        cb.put("share", self.share, +mi.ParamFlags.Differentiable)
        cb.put("alpha", self.alpha, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)

    def parameters_changed(self, keys: Any = ()) -> None:
        opaque(self.share)
        opaque(self.alpha)

    def _lobes(self, ctx: Any) -> tuple[bool, bool]:
        return ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0), ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 1)

    def _drawn(self, ctx: Any) -> Any:
        """Probability of the lobe."""
        back, diffuse = self._lobes(ctx)
        if back != diffuse:
            return mi.Float(1 if back else 0)
        return dr.clip(self.share, _LEAST_DRAWN, 1 - _LEAST_DRAWN)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        has_back, has_diffuse = self._lobes(ctx)
        if not (has_back or has_diffuse):
            return mi.Spectrum(0), mi.Float(0)
        wi, mirrored = si.wi, mi.Vector3f(-wo.x, -wo.y, wo.z)
        active = mi.Mask(active) & (wi.z > 0) & (wo.z > 0)
        alpha, drawn = dr.maximum(self.alpha, ALPHA_MIN), self._drawn(ctx)
        b, defined = half_vector(wi, mirrored, 1.0)
        lobe = normal_density(b, alpha, alpha, ggx=True) * 0.25 * smith_g1_over_cos(wi, b, alpha, alpha, ggx=True)
        lobe = dr.select(defined, lobe, 0)
        pdf = drawn * lobe + (1 - drawn) * wo.z * dr.inv_pi

        value = mi.Float(0)
        if has_back:
            masked = smith_g1_over_cos(mirrored, b, alpha, alpha, ggx=True) * wo.z
            value += self.share * lobe * masked
        if has_diffuse:
            value += (1 - self.share) * wo.z * dr.inv_pi
        colour = dr.select(active, self.reflectance.eval(si, active) * value, 0)
        return mi.mueller.depolarizer(colour) if mi.is_polarized else colour, dr.select(active, dr.detach(pdf), 0)

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(ctx, si, wo, active)[1]

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        bs = dr.zeros(mi.BSDFSample3f)
        if not any(self._lobes(ctx)):
            return bs, mi.Spectrum(0)
        active = mi.Mask(active) & (si.wi.z > 0)
        with dr.suspend_grad():
            wi = si.wi
            back = sample1 < self._drawn(ctx)
            alpha = dr.maximum(self.alpha, ALPHA_MIN)
            b, _ = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True).sample(wi, sample2)
            mirrored = b * (2 * dr.dot(wi, b)) - wi
            returned = mi.Vector3f(-mirrored.x, -mirrored.y, mirrored.z)
            bs.wo = dr.select(back, returned, mi.warp.square_to_cosine_hemisphere(sample2))
        bs.eta = mi.Float(1)
        bs.sampled_component = dr.select(back, mi.UInt32(0), mi.UInt32(1))
        glossy, diffuse = (mi.UInt32(+flag) for flag in (mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.DiffuseReflection))
        bs.sampled_type = dr.select(back, glossy, diffuse)
        value, bs.pdf = self.eval_pdf(ctx, si, bs.wo, active)
        return bs, value * dr.select(bs.pdf > 0, dr.rcp(bs.pdf), 0)

    def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
        return (1 - self.share) * self.reflectance.eval(si, active)

    def to_string(self) -> str:
        numbers = f"  share = {self.share},\n  alpha = {self.alpha}\n"
        return f"Retroreflector[\n  reflectance = {self.reflectance},\n{numbers}]"


register("bsdf", "retroreflector", Retroreflector)
# How much goes where, and no direction of what goes.
declare_effects(Retroreflector, {"share": VALUE, "alpha": VALUE})
