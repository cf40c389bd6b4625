"""``diff_rough_dielectric``: Mitsuba's ``roughdielectric`` with an attached index, stable from alpha 1e-3 to 1."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.plugins._registry import register
from torchtransient.plugins.bsdfs.fresnel import Interface, across_plane, fresnel, refract
from torchtransient.plugins.bsdfs.ior import opaque, optional_texture, relative_index, textured
from torchtransient.plugins.bsdfs.microfacet import ALPHA_MIN, half_vector, normal_density, smith_g1_over_cos
from torchtransient.plugins.parameter_effect import ParameterEffect, declare_effects
from torchtransient.plugins.properties import truth

_DISTRIBUTIONS = {"ggx": True, "beckmann": False}
# From an index of one to the nearest one whose refracted lobe single precision resolves at the smallest roughness.
_NEAREST = 1e-6


class DiffRoughDielectric(mi.BSDF):
    """Rough interface between two dielectrics, parameters and values as Mitsuba's ``roughdielectric``.

    ``int_ior``, ``ext_ior`` (number or material name, not equal), ``distribution`` (``beckmann`` or ``ggx``),
    ``alpha`` or ``alpha_u`` and ``alpha_v`` (textures, clamped to 1e-3 from below), ``sample_visible``,
    ``specular_reflectance``, ``specular_transmittance`` (textures). Differentiable: ``eta`` (inside over outside
    index), the roughness, the textures.

    Derivatives. ``eval``, ``pdf`` and ``eval_pdf`` are attached to ``si.wi``, ``wo``, ``eta`` and the roughness,
    the half vector and the Jacobian of refraction included. ``sample`` draws a detached direction ``bs.wo``;
    ``bs.pdf`` is its attached density, ``bs.eta`` the attached index, and the weight is value over density with
    both attached, so that ``weight * dr.relative_grad(bs.pdf)`` is the detached estimator's. A roughness at the
    clamp has no derivative.

    Single precision: the half vector of a refraction keeps about ``1e-7 / |eta - 1|`` of relative accuracy, and the
    derivative by an index within 1e-3 of one is wrong. At exactly one the transmitted lobe is a delta function; an
    index within 1e-6 of one scatters as ``1 + 1e-6``, or ``1 - 1e-6`` below it, without a derivative.

    In polarized variants every facet is a smooth interface with its Mueller matrix, as in Mitsuba's
    ``roughconductor``; Mitsuba's ``roughdielectric`` depolarises instead. Powers of unpolarized light agree.

    With ``sample_visible`` off, weights of ``roughdielectric`` lack the ratio of the two normal densities; here
    they are value over density.
    """

    def __init__(self, props: Any) -> None:
        mi.BSDF.__init__(self, props)
        self.eta = relative_index(props, "diff_rough_dielectric")
        if dr.any(self.eta == 1):
            raise SceneError(
                "diff_rough_dielectric: 'int_ior' and 'ext_ior' must differ, got a relative index of exactly 1. "
                "Use 'null' for an interface that is not there."
            )
        self.specular_reflectance = optional_texture(props, "specular_reflectance")
        self.specular_transmittance = optional_texture(props, "specular_transmittance")
        name = str(props.get("distribution", "beckmann")).lower()
        if name not in _DISTRIBUTIONS:
            raise SceneError(f"diff_rough_dielectric: 'distribution' must be 'beckmann' or 'ggx', got '{name}'.")
        self.ggx = _DISTRIBUTIONS[name]
        self.sample_visible = truth(props, "sample_visible", default=True)
        self._read_roughness(props)

        extra = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
        if self.anisotropic:
            extra = extra | mi.BSDFFlags.Anisotropic
        self.m_components = [
            mi.BSDFFlags.GlossyReflection | extra,
            mi.BSDFFlags.GlossyTransmission | extra | mi.BSDFFlags.NonSymmetric,
        ]
        self.m_flags = self.m_components[0] | self.m_components[1]

    def _read_roughness(self, props: Any) -> None:
        given = [name for name in ("alpha", "alpha_u", "alpha_v") if name in props]
        if given not in ([], ["alpha"], ["alpha_u", "alpha_v"]):
            raise SceneError(
                f"diff_rough_dielectric: give either 'alpha' or both 'alpha_u' and 'alpha_v', got {', '.join(given)}."
            )
        self.anisotropic = len(given) == 2
        if self.anisotropic:
            self.alpha_u = props.get_unbounded_texture("alpha_u")
            self.alpha_v = props.get_unbounded_texture("alpha_v")
        else:
            self.alpha_u = self.alpha_v = props.get_unbounded_texture("alpha", 0.1)
        self.warned_of_clamp = False
        self._warn_of_clamp()

    def _roughness_textures(self) -> dict[str, Any]:
        return {"alpha_u": self.alpha_u, "alpha_v": self.alpha_v} if self.anisotropic else {"alpha": self.alpha_u}

    def _warn_of_clamp(self) -> None:
        """Say once that a roughness lies below the clamp. Procedural textures without a table cannot be checked."""
        for name, texture in self._roughness_textures().items():
            params = mi.traverse(texture)
            for key in ("value", "data"):
                if self.warned_of_clamp or key not in params:
                    continue
                lowest = dr.min(params[key], axis=None)
                if dr.any(lowest < ALPHA_MIN):
                    self.warned_of_clamp = True
                    mi.Log(
                        mi.LogLevel.Warn,
                        f"diff_rough_dielectric: '{name}' is clamped to {ALPHA_MIN} and has no derivative below it. "
                        "Use diff_dielectric for a smooth interface.",
                    )

    def traverse(self, cb: Any) -> None:
        cb.put("eta", self.eta, +mi.ParamFlags.Differentiable)
        for name, texture in self._roughness_textures().items():
            cb.put(name, texture, +mi.ParamFlags.Differentiable)
        for name in ("specular_reflectance", "specular_transmittance"):
            texture = getattr(self, name)
            if texture is not None:
                cb.put(name, texture, +mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Any) -> None:
        opaque(self.eta)
        self._warn_of_clamp()

    def _alpha(self, si: Any, active: Any) -> tuple[Any, Any]:
        alpha_u = dr.maximum(self.alpha_u.eval_1(si, active), ALPHA_MIN)
        if not self.anisotropic:
            return alpha_u, alpha_u
        return alpha_u, dr.maximum(self.alpha_v.eval_1(si, active), ALPHA_MIN)

    def _index(self) -> Any:
        """Return the index of the lobes."""
        return dr.select(dr.abs(self.eta - 1) < _NEAREST, 1 + dr.mulsign(mi.Float(_NEAREST), self.eta - 1), self.eta)

    def _lobe(self, ctx: Any, si: Any, wo: Any, m: Any, reflect: Any, active: Any) -> tuple[Any, Any, Any]:
        """Density of ``wo``, value over density (without colours), and the mask where both are meant.

        Walter et al. 2007, equations 20, 21, 41. With c = |wi.m| and g = eta_it |wo.m| the length of the refraction's
        half vector is |c - g| = |eta_it^2 - 1| / (c + g), which does not cancel.
        """
        has_r = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0)
        has_t = ctx.is_enabled(mi.BSDFFlags.GlossyTransmission, 1)
        wi = si.wi
        wi_m, wo_m = dr.dot(wi, m), dr.dot(wo, m)
        active &= (wi_m * wi.z > 0) & (wo_m * wo.z > 0)
        active &= dr.select(reflect, mi.Mask(has_r), mi.Mask(has_t))

        terms = fresnel(wi_m, self._index())
        c, cos_t = dr.abs(wi_m), dr.abs(wo_m)
        excess = (terms.eta_it - 1) * (terms.eta_it + 1)
        refracts = reflect ^ True
        rcp_length = (c + terms.eta_it * cos_t) / dr.select(refracts, excess, 1.0)
        jacobian = dr.select(
            reflect,
            0.25 / dr.select(active, c, 1.0),
            dr.select(refracts, dr.square(terms.eta_it * rcp_length) * cos_t, 0.0),
        )

        alpha_u, alpha_v = self._alpha(si, active)
        density = normal_density(m, alpha_u, alpha_v, self.ggx)
        masking_i = smith_g1_over_cos(wi, m, alpha_u, alpha_v, self.ggx)
        weight = smith_g1_over_cos(wo, m, alpha_u, alpha_v, self.ggx) * dr.abs(wo.z)
        if self.sample_visible:
            pdf = density * masking_i * c * jacobian
        else:
            widening = _widening(wi)
            wide = normal_density(m, alpha_u * widening, alpha_v * widening, self.ggx)
            pdf = wide * m.z * jacobian
            drawn = wide > 0
            weight *= masking_i * c * density / dr.select(drawn, wide * m.z, 1.0)
            active &= drawn
        fresnel_factor = dr.select(reflect, terms.reflectance, terms.transmittance)
        if has_r and has_t:
            pdf *= fresnel_factor
        else:
            weight *= fresnel_factor
        if ctx.mode == mi.TransportMode.Radiance:
            weight *= dr.select(reflect, 1.0, dr.square(terms.eta_ti))
        return dr.select(active, pdf, 0.0), dr.select(active, weight, 0.0), active

    def _colour(self, si: Any, reflect: Any, active: Any) -> Any:
        reflection = textured(1.0, self.specular_reflectance, si, active & reflect)
        transmission = textured(1.0, self.specular_transmittance, si, active & (reflect ^ True))
        return dr.select(reflect, reflection, transmission)

    def _spectrum(self, ctx: Any, si: Any, wo: Any, m: Any, value: Any, reflect: Any, active: Any) -> Any:
        colour = self._colour(si, reflect, active) * value
        if not mi.is_polarized:
            return mi.Spectrum(colour) & active
        # The facet is a smooth interface. The power of its matrix is in the value already, the same for all colours.
        interface = Interface(dr.dot(si.wi, m), self._index())
        matrix = dr.select(reflect, interface.reflection(), interface.transmission())
        power = dr.max(mi.unpolarized_spectrum(matrix))
        there = active & (power > 0)
        radiance = ctx.mode == mi.TransportMode.Radiance
        towards_sensor, towards_light = (si.wi, wo) if radiance else (wo, si.wi)
        matrix = across_plane(matrix, m, towards_sensor, towards_light)
        return mi.mueller.absorber(colour * dr.rcp(dr.select(there, power, 1.0))) @ matrix & there

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        wi = si.wi
        active = mi.Mask(active) & (wi.z != 0)
        reflect = wi.z * wo.z > 0
        eta = self._index()
        eta_it = dr.select(wi.z > 0, eta, dr.rcp(eta))
        m, defined = half_vector(wi, wo, dr.select(reflect, 1.0, eta_it))
        pdf, weight, active = self._lobe(ctx, si, wo, m, reflect, active & defined)
        return self._spectrum(ctx, si, wo, m, pdf * weight, reflect, active), pdf

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(ctx, si, wo, active)[1]

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        has_r = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0)
        has_t = ctx.is_enabled(mi.BSDFFlags.GlossyTransmission, 1)
        bs = dr.zeros(mi.BSDFSample3f)
        if not (has_r or has_t):
            return bs, mi.Spectrum(0)

        active = mi.Mask(active) & (si.wi.z != 0)
        with dr.suspend_grad():
            wi = si.wi
            m = self._draw_normal(si, wi, sample2, active)
            terms = fresnel(dr.dot(wi, m), self._index())
            if has_r and has_t:
                selected_r = (sample1 < terms.reflectance) | (terms.transmittance <= 0)
            else:
                selected_r = mi.Mask(has_r)
            reflected = m * (2 * dr.dot(wi, m)) - wi
            wo = dr.select(selected_r, reflected, refract(wi, m, terms.cos_theta_t, terms.eta_ti))

        # The facet that turns si.wi into the fixed direction wo. Its value is the normal that was drawn, which does not
        # suffer from the cancellation in the half vector.
        eta = self._index()
        eta_it = dr.select(wi.z > 0, eta, dr.rcp(eta))
        if dr.is_diff_v(m):  # dr.replace_grad ends the process on the vectors of a scalar variant
            attached_m, _ = half_vector(si.wi, wo, dr.select(selected_r, 1.0, eta_it))
            m = dr.replace_grad(m, attached_m)
        bs.wo = wo
        bs.pdf, weight, active = self._lobe(ctx, si, wo, m, selected_r, active)
        bs.eta = dr.select(selected_r, 1.0, eta_it)
        bs.sampled_component = dr.select(selected_r, mi.UInt32(0), mi.UInt32(1))
        bs.sampled_type = dr.select(
            selected_r, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.GlossyTransmission)
        )
        return bs, self._spectrum(ctx, si, wo, m, weight, selected_r, active)

    def _draw_normal(self, si: Any, wi: Any, sample2: Any, active: Any) -> Any:
        alpha_u, alpha_v = self._alpha(si, active)
        kind = mi.MicrofacetType.GGX if self.ggx else mi.MicrofacetType.Beckmann
        distribution = mi.MicrofacetDistribution(kind, alpha_u, alpha_v, self.sample_visible)
        if not self.sample_visible:
            distribution.scale_alpha(_widening(wi))
        m, _ = distribution.sample(dr.select(wi.z < 0, -wi, wi), sample2)
        return mi.Vector3f(m)

    def to_string(self) -> str:
        roughness = "".join(f"  {name} = {texture},\n" for name, texture in self._roughness_textures().items())
        return (
            f"DiffRoughDielectric[\n  distribution = {'ggx' if self.ggx else 'beckmann'},\n"
            f"  sample_visible = {self.sample_visible},\n{roughness}  eta = {self.eta},\n"
            f"  specular_reflectance = {self.specular_reflectance},\n"
            f"  specular_transmittance = {self.specular_transmittance}\n]"
        )


def _widening(wi: Any) -> Any:
    """Factor on the sampling roughness when all normals are drawn (Walter et al. 2007, section 5.3)."""
    return 1.2 - 0.2 * dr.sqrt(dr.abs(wi.z))


register("bsdf", "diff_rough_dielectric", DiffRoughDielectric)
# Directions are held fixed while the index moves, so what is seen through the interface stays where it is.
declare_effects(DiffRoughDielectric, {"eta": ParameterEffect(moves_length=True, role="index", trusted=True)})
