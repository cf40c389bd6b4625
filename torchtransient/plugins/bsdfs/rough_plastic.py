"""``diff_rough_plastic``: Mitsuba's ``roughplastic`` with the derivatives of its tables by roughness and index."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.plugins._registry import register
from torchtransient.plugins.bsdfs.fresnel import fresnel
from torchtransient.plugins.bsdfs.ior import opaque, optional_texture, relative_index, specular_share, textured
from torchtransient.plugins.bsdfs.microfacet import half_vector, normal_density, smith_g1_over_cos
from torchtransient.plugins.bsdfs.rough_coating import external_transmittance, internal_reflectance, look_up
from torchtransient.plugins.node_walk import attached_as, carries_derivatives
from torchtransient.plugins.parameter_effect import VALUE, declare_effects
from torchtransient.plugins.properties import number, truth

_DISTRIBUTIONS = {"ggx": True, "beckmann": False}
_ALPHA_MIN = 1e-4  # Mitsuba's


class DiffRoughPlastic(mi.BSDF):
    """Diffuse base under a rough dielectric coating; parameters, values and samples as Mitsuba's ``roughplastic``.

    ``int_ior``, ``ext_ior`` (number or material name, not equal; by default ``polypropylene`` in ``air``),
    ``distribution`` (``beckmann`` or ``ggx``), ``alpha`` (number, clamped to 1e-4 from below), ``sample_visible``,
    ``nonlinear``, ``diffuse_reflectance``, ``specular_reflectance`` (textures). One-sided.

    Differentiable: ``alpha``, ``eta`` (inside over outside index) and the textures. Roughness and index act through the
    lobe and through how much light passes the coating, which is tabulated anew with every update (0.1 s).
    ``sample`` draws a detached direction, its weight is value over density. Depolarizes in polarized variants.
    """

    def __init__(self, props: Any) -> None:
        mi.BSDF.__init__(self, props)
        self.eta = relative_index(props, "diff_rough_plastic", "polypropylene")
        if dr.any(self.eta == 1):
            raise SceneError(
                "diff_rough_plastic: 'int_ior' and 'ext_ior' must differ, got a relative index of exactly 1. "
                "Use 'diffuse' for a surface without coating."
            )
        self.diffuse_reflectance = props.get_texture("diffuse_reflectance", 0.5)
        self.specular_reflectance = optional_texture(props, "specular_reflectance")
        name = str(props.get("distribution", "beckmann")).lower()
        if name not in _DISTRIBUTIONS:
            raise SceneError(f"diff_rough_plastic: 'distribution' must be 'beckmann' or 'ggx', got '{name}'.")
        if "alpha_u" in props or "alpha_v" in props:
            raise SceneError("diff_rough_plastic: coatings are isotropic, expected 'alpha', got 'alpha_u', 'alpha_v'.")
        self.ggx = _DISTRIBUTIONS[name]
        self.alpha = opaque(mi.Float(max(number(props, "alpha", 0.1), _ALPHA_MIN)))
        self.sample_visible = truth(props, "sample_visible", default=True)
        self.nonlinear = truth(props, "nonlinear", default=False)
        self.m_components = [
            mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide,
            mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide,
        ]
        self.m_flags = self.m_components[0] | self.m_components[1]
        self.parameters_changed([])

    def traverse(self, cb: Any) -> None:
        cb.put("diffuse_reflectance", self.diffuse_reflectance, +mi.ParamFlags.Differentiable)
        cb.put("alpha", self.alpha, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)
        cb.put("eta", self.eta, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)
        if self.specular_reflectance is not None:
            cb.put("specular_reflectance", self.specular_reflectance, +mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Any = ()) -> None:
        opaque(self.eta)
        opaque(self.alpha)
        if not keys or "alpha" in keys or "eta" in keys:
            self._tables_of = None
        self._followed = None
        self.follow_derivatives(True)

    def follow_derivatives(self, asked: bool) -> None:
        """Follow derivatives as :meth:`.principled.DiffPrincipled.follow_derivatives`."""
        lobes = [lobe for lobe in (self.specular_reflectance, self.diffuse_reflectance) if lobe is not None]
        followed = asked and any(carries_derivatives(lobe) for lobe in lobes)
        if followed != self._followed:
            self._followed = followed
            self.specular_share = specular_share(self.specular_reflectance, self.diffuse_reflectance, followed)
        attached = attached_as(self.alpha, self.eta)
        if attached != self._tables_of:
            self._tables_of = attached
            alpha = self._alpha()
            self.transmittance = external_transmittance(alpha, self.eta, self.ggx)
            self.thrown_back = internal_reflectance(alpha, self.eta, self.ggx)
            dr.eval(self.transmittance, self.thrown_back)

    def _alpha(self) -> Any:
        return dr.maximum(self.alpha, _ALPHA_MIN)

    def _lobes(self, ctx: Any) -> tuple[bool, bool]:
        return ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0), ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 1)

    def _specular_probability(self, ctx: Any, passes: Any) -> Any:
        """Probability of the lobe of the coating, where ``passes`` of the light gets through it."""
        has_specular, has_diffuse = self._lobes(ctx)
        if has_specular != has_diffuse:
            return mi.Float(1 if has_specular else 0)
        specular, diffuse = (1 - passes) * self.specular_share, passes * (1 - self.specular_share)
        return specular / (specular + diffuse)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        has_specular, has_diffuse = self._lobes(ctx)
        if not (has_specular or has_diffuse):
            return mi.Spectrum(0), mi.Float(0)
        wi = si.wi
        active = mi.Mask(active) & (wi.z > 0) & (wo.z > 0)
        passes = look_up(self.transmittance, wi.z, active)
        specular = self._specular_probability(ctx, passes)

        # The facet that mirrors one direction into the other, Walter et al. 2007, equation 20.
        alpha = self._alpha()
        m, defined = half_vector(wi, wo, 1.0)
        facets = normal_density(m, alpha, alpha, self.ggx) * 0.25
        visible = smith_g1_over_cos(wi, m, alpha, alpha, self.ggx)
        wo_m = dr.dot(wo, m)
        drawn = visible if self.sample_visible else m.z / dr.select(active & (wo_m > 0), wo_m, 1)
        pdf = dr.select(defined, specular * facets * drawn, 0) + (1 - specular) * wo.z * dr.inv_pi

        value = mi.UnpolarizedSpectrum(0)
        if has_specular:
            lobe = fresnel(dr.dot(wi, m), self.eta).reflectance * facets * visible
            lobe *= smith_g1_over_cos(wo, m, alpha, alpha, self.ggx) * wo.z
            value += textured(dr.select(defined, lobe, 0), self.specular_reflectance, si, active)
        if has_diffuse:
            base = self.diffuse_reflectance.eval(si, active)
            base = base / (1 - (base * self.thrown_back if self.nonlinear else self.thrown_back))
            passes *= look_up(self.transmittance, wo.z, active)
            value += base * (passes * wo.z * dr.inv_pi / dr.square(self.eta))
        value = dr.select(active, value, 0)
        return mi.mueller.depolarizer(value) if mi.is_polarized else value, dr.select(active, pdf, 0)

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
            specular = sample1 < self._specular_probability(ctx, look_up(self.transmittance, wi.z, active))
            kind = mi.MicrofacetType.GGX if self.ggx else mi.MicrofacetType.Beckmann
            m, _ = mi.MicrofacetDistribution(kind, self._alpha(), self.sample_visible).sample(wi, sample2)
            mirrored = m * (2 * dr.dot(wi, m)) - wi
            bs.wo = dr.select(specular, mirrored, mi.warp.square_to_cosine_hemisphere(sample2))
        bs.eta = mi.Float(1)
        bs.sampled_component = dr.select(specular, mi.UInt32(0), mi.UInt32(1))
        glossy, diffuse = (mi.UInt32(+flag) for flag in (mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.DiffuseReflection))
        bs.sampled_type = dr.select(specular, glossy, diffuse)
        value, bs.pdf = self.eval_pdf(ctx, si, bs.wo, active)
        return bs, value * dr.select(bs.pdf > 0, dr.rcp(bs.pdf), 0)

    def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
        return self.diffuse_reflectance.eval(si, active)

    def to_string(self) -> str:
        return (
            f"DiffRoughPlastic[\n  distribution = {'ggx' if self.ggx else 'beckmann'},\n"
            f"  sample_visible = {self.sample_visible},\n  nonlinear = {self.nonlinear},\n  alpha = {self.alpha},\n"
            f"  eta = {self.eta},\n  diffuse_reflectance = {self.diffuse_reflectance},\n"
            f"  specular_reflectance = {self.specular_reflectance}\n]"
        )


register("bsdf", "diff_rough_plastic", DiffRoughPlastic)
# Nothing is refracted onwards: roughness and index change how much is reflected, and no direction.
declare_effects(DiffRoughPlastic, {"alpha": VALUE, "eta": VALUE})
