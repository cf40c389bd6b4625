"""``diff_dielectric``: Mitsuba's smooth ``dielectric`` with an index of refraction that can be differentiated."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins._registry import register
from torchtransient.plugins.bsdfs.fresnel import Interface, across_plane, fresnel, refract
from torchtransient.plugins.bsdfs.ior import opaque, optional_texture, relative_index, textured
from torchtransient.plugins.parameter_effect import ParameterEffect, declare_effects


class DiffDielectric(mi.BSDF):
    """Smooth interface between two dielectrics, parameters and values as Mitsuba's ``dielectric``.

    ``int_ior``, ``ext_ior`` (number or material name), ``specular_reflectance``, ``specular_transmittance`` (textures).
    Differentiable: ``eta`` (inside over outside index) and the textures.

    Derivatives. ``sample`` chooses the lobe with detached numbers and attaches the rest to ``eta`` and ``si.wi``:
    the direction ``bs.wo``, the index ``bs.eta`` and the weight, which is the lobe's value divided by its detached
    probability. ``bs.pdf`` is detached, as in Mitsuba's own ``dielectric``.

    ``eta`` is marked as discontinuous: moving it moves the refracted images of edges, which no boundary term
    follows through smooth glass.
    """

    def __init__(self, props: Any) -> None:
        mi.BSDF.__init__(self, props)
        self.eta = relative_index(props, "diff_dielectric")
        self.specular_reflectance = optional_texture(props, "specular_reflectance")
        self.specular_transmittance = optional_texture(props, "specular_transmittance")
        sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
        self.m_components = [
            mi.BSDFFlags.DeltaReflection | sides,
            mi.BSDFFlags.DeltaTransmission | sides | mi.BSDFFlags.NonSymmetric,
        ]
        self.m_flags = self.m_components[0] | self.m_components[1]

    def traverse(self, cb: Any) -> None:
        cb.put("eta", self.eta, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)
        for name in ("specular_reflectance", "specular_transmittance"):
            texture = getattr(self, name)
            if texture is not None:
                cb.put(name, texture, +mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Any) -> None:
        opaque(self.eta)

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        has_r = ctx.is_enabled(mi.BSDFFlags.DeltaReflection, 0)
        has_t = ctx.is_enabled(mi.BSDFFlags.DeltaTransmission, 1)
        bs = dr.zeros(mi.BSDFSample3f)
        if not (has_r or has_t):
            return bs, mi.Spectrum(0)

        cos_i = si.wi.z
        terms = fresnel(cos_i, self.eta)
        if has_r and has_t:
            # The second condition keeps a lobe of zero probability from being drawn when the first one rounds.
            selected_r = (sample1 < terms.reflectance) | (terms.transmittance <= 0)
            probability = dr.select(selected_r, terms.reflectance, terms.transmittance)
            bs.pdf = dr.detach(probability)
            # The value over its detached probability: one, with the derivative of Fresnel's term.
            factor = dr.relative_grad(probability)
        else:
            selected_r = mi.Mask(has_r)
            bs.pdf = mi.Float(1)
            factor = terms.reflectance if has_r else terms.transmittance

        bs.sampled_component = dr.select(selected_r, mi.UInt32(0), mi.UInt32(1))
        bs.sampled_type = dr.select(
            selected_r, mi.UInt32(+mi.BSDFFlags.DeltaReflection), mi.UInt32(+mi.BSDFFlags.DeltaTransmission)
        )
        reflected = mi.Vector3f(-si.wi.x, -si.wi.y, si.wi.z)
        bs.wo = dr.select(selected_r, reflected, refract(si.wi, mi.Vector3f(0, 0, 1), terms.cos_theta_t, terms.eta_ti))
        bs.eta = dr.select(selected_r, 1.0, terms.eta_it)

        # Radiance is compressed into a smaller solid angle when it enters the denser side.
        scale = dr.square(terms.eta_ti) if ctx.mode == mi.TransportMode.Radiance else mi.Float(1)
        reflection = textured(1.0, self.specular_reflectance, si, active & selected_r)
        transmission = textured(scale, self.specular_transmittance, si, active & (selected_r ^ True))
        absorption = dr.select(selected_r, reflection, transmission)
        if mi.is_polarized:
            per_pdf = absorption * dr.rcp(bs.pdf)
            weight = mi.mueller.absorber(per_pdf) @ self._mueller(ctx, si, bs, selected_r)
        else:
            weight = mi.Spectrum(absorption * factor)
        return bs, weight & active

    def _mueller(self, ctx: Any, si: Any, bs: Any, selected_r: Any) -> Any:
        """Mueller matrix of the chosen lobe between the implicit Stokes frames of the two directions."""
        forward = ctx.mode == mi.TransportMode.Radiance
        towards_light, towards_sensor = (bs.wo, si.wi) if forward else (si.wi, bs.wo)
        # Both matrices are the same seen from either side. The cosine that was given is the accurate one: that of a
        # refracted direction close to the critical angle has lost the digits that matter.
        interface = Interface(si.wi.z, self.eta)
        matrix = dr.select(selected_r, interface.reflection(), interface.transmission())
        return across_plane(matrix, mi.Vector3f(0, 0, 1), towards_sensor, towards_light)

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return mi.Spectrum(0)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return mi.Float(0)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return mi.Spectrum(0), mi.Float(0)

    def to_string(self) -> str:
        return (
            f"DiffDielectric[\n  eta = {self.eta},\n  specular_reflectance = {self.specular_reflectance},\n"
            f"  specular_transmittance = {self.specular_transmittance}\n]"
        )


register("bsdf", "diff_dielectric", DiffDielectric)
# Edges that are seen through the interface move with its index.
_INDEX = ParameterEffect(moves_length=True, moves_silhouette=True, role="index", trusted=True)
declare_effects(DiffDielectric, {"eta": _INDEX})
