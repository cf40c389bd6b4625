"""``diff_conductor``: Mitsuba's smooth ``conductor`` with derivatives at every angle, normal incidence included."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins._registry import register
from torchtransient.plugins.bsdfs.mueller import across_plane, metal_reflection
from torchtransient.plugins.node_walk import objects_of

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
