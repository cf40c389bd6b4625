"""``diff_conductor``: Mitsuba's smooth ``conductor`` with derivatives at every angle, normal incidence included."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins._registry import register
from torchtransient.plugins.bsdfs.fresnel import across_plane, metal_reflection
from torchtransient.plugins.bsdfs.microfacet import half_vector
from torchtransient.plugins.node_walk import objects_of, shown_by

_TEXTURES = ("eta", "k", "specular_reflectance")


class DiffConductor(mi.BSDF):
    """Smooth metal, parameters and values as Mitsuba's ``conductor``.

    ``material`` (name), or ``eta`` and ``k`` (textures); ``specular_reflectance`` (texture, 1). Differentiable: the
    textures and the direction. In polarized variants Mitsuba's own has no derivative at normal incidence.
    """

    def __init__(self, props: Any) -> None:
        mi.BSDF.__init__(self, props)
        given = {name: props[name] for name in ("material", *_TEXTURES) if name in props}
        # Materials are looked up by Mitsuba itself, so that the table and its spelling are the installed version's.
        textures = dict(objects_of(mi.load_dict({"type": "conductor", **given})))
        self.eta, self.k, self.specular_reflectance = (textures[name] for name in _TEXTURES)
        self.m_components = [mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.FrontSide]
        self.m_flags = self.m_components[0]

    def traverse(self, cb: Any) -> None:
        for name in _TEXTURES:
            cb.put(name, getattr(self, name), +mi.ParamFlags.Differentiable)

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        bs = dr.zeros(mi.BSDFSample3f)
        active = active & (si.wi.z > 0)
        if not ctx.is_enabled(mi.BSDFFlags.DeltaReflection, 0):
            return bs, mi.Spectrum(0)
        bs.wo = mi.Vector3f(-si.wi.x, -si.wi.y, si.wi.z)
        bs.pdf, bs.eta = mi.Float(1), mi.Float(1)
        bs.sampled_type, bs.sampled_component = mi.UInt32(+mi.BSDFFlags.DeltaReflection), mi.UInt32(0)
        eta, k = self.eta.eval(si, active), self.k.eval(si, active)
        matrix = metal_reflection(si.wi.z, eta, k)
        reflectance = self.specular_reflectance.eval(si, active)
        if not mi.is_polarized:
            return bs, mi.Spectrum(reflectance * matrix) & active
        radiance = ctx.mode == mi.TransportMode.Radiance
        towards_sensor, towards_light = (si.wi, bs.wo) if radiance else (bs.wo, si.wi)
        matrix = across_plane(matrix, mi.Vector3f(0, 0, 1), towards_sensor, towards_light)
        return bs, mi.mueller.absorber(reflectance) @ matrix & active

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return mi.Spectrum(0)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return mi.Float(0)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return mi.Spectrum(0), mi.Float(0)

    def to_string(self) -> str:
        return "DiffConductor[\n" + ",\n".join(f"  {name} = {getattr(self, name)}" for name in _TEXTURES) + "\n]"


register("bsdf", "diff_conductor", DiffConductor)


# ----------------------------------------------------------------------------------------------------------------------
# ``diff_rough_conductor``: Mitsuba's ``roughconductor`` with derivatives by an index or an absorption of zero.
#

_FRESNEL = ("material", "eta", "k")
_FACETS = ("alpha", "alpha_u", "alpha_v", "distribution", "sample_visible", "specular_reflectance")


class DiffRoughConductor(mi.BSDF):
    """Rough metal, parameters and values as Mitsuba's ``roughconductor``.

    ``material`` (name), or ``eta`` and ``k`` (textures); ``alpha`` (0.1), or ``alpha_u`` and ``alpha_v`` (textures);
    ``distribution`` ("beckmann" or "ggx"), ``sample_visible`` (true), ``specular_reflectance`` (texture, 1).
    Differentiable: the textures and the direction.

    The facets are those of Mitsuba's plugin, asked for a perfect mirror; Fresnel's term is that of ``diff_conductor``,
    whose slopes are finite everywhere.
    """

    def __init__(self, props: Any) -> None:
        mi.BSDF.__init__(self, props)
        fresnel, facets = ({name: props[name] for name in names if name in props} for names in (_FRESNEL, _FACETS))
        # Materials are looked up by Mitsuba itself, so that the table and its spelling are the installed version's.
        metal = dict(objects_of(mi.load_dict({"type": "conductor", **fresnel})))
        self.eta, self.k = metal["eta"], metal["k"]
        self.facets = mi.load_dict({"type": "roughconductor", "material": "none", **facets})
        self.m_components = [self.facets.flags(i) for i in range(self.facets.component_count())]
        self.m_flags = self.facets.flags()

    def traverse(self, cb: Any) -> None:
        for name, texture, flags in shown_by(self.facets)[1]:
            cb.put(name, getattr(self, name, texture), flags)

    def _reflection(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
        """Return the reflectance of the facets between two directions, or its Mueller matrix."""
        normal, _ = half_vector(si.wi, wo, 1.0)
        cosine = dr.dot(si.wi, normal)
        cosine = dr.select(cosine > 0, cosine, 1)
        matrix = metal_reflection(cosine, self.eta.eval(si, active), self.k.eval(si, active))
        if not mi.is_polarized:
            return mi.Spectrum(matrix)
        radiance = ctx.mode == mi.TransportMode.Radiance
        towards_sensor, towards_light = (si.wi, wo) if radiance else (wo, si.wi)
        return across_plane(matrix, normal, towards_sensor, towards_light)

    def _coated(self, ctx: Any, si: Any, wo: Any, mirrored: Any, active: Any) -> Any:
        """Reflectance ``mirrored`` times that of facets of metal."""
        share = mi.unpolarized_spectrum(mirrored)
        metal = self._reflection(ctx, si, wo, active)
        # Where nothing is mirrored, too: a colour of zero has a derivative.
        return (mi.mueller.absorber(share) @ metal if mi.is_polarized else share * metal) & mi.Mask(active)

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        bs, weight = self.facets.sample(ctx, si, sample1, sample2, active)
        return bs, self._coated(ctx, si, bs.wo, weight, active)

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self._coated(ctx, si, wo, self.facets.eval(ctx, si, wo, active), active)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.facets.pdf(ctx, si, wo, active)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        value, pdf = self.facets.eval_pdf(ctx, si, wo, active)
        return self._coated(ctx, si, wo, value, active), pdf

    def to_string(self) -> str:
        return f"DiffRoughConductor[\n  eta = {self.eta},\n  k = {self.k},\n  facets = {self.facets}\n]"


register("bsdf", "diff_rough_conductor", DiffRoughConductor)
