"""Plugins as a user writes them: an integrator through time, an emitter, a texture and a surface."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins import register
from torchtransient.plugins.integrators.path import TransientPath


class Walker(TransientPath):
    pass


class Spark(mi.Emitter):
    """A point light before the small room's wall."""

    def __init__(self, props):
        mi.Emitter.__init__(self, props)
        self.m_flags = +mi.EmitterFlags.DeltaPosition
        self.power = mi.Float(props.get("power", 3.0))

    def traverse(self, cb):
        cb.put("power", self.power, mi.ParamFlags.Differentiable)

    def sample_direction(self, it, sample, active=True):
        ds = dr.zeros(mi.DirectionSample3f)
        ds.p, ds.n, ds.delta, ds.pdf = mi.Point3f(0, 0.5, 3), mi.Normal3f(0, 0, -1), mi.Mask(True), mi.Float(1)
        ds.emitter, ds.d = mi.EmitterPtr(self), ds.p - it.p
        ds.dist = dr.norm(ds.d)
        ds.d /= ds.dist
        return ds, mi.Spectrum(self.power / dr.square(ds.dist))

    def eval_direction(self, it, ds, active=True):
        return mi.Spectrum(self.power / dr.square(ds.dist))

    def pdf_direction(self, it, ds, active=True):
        return mi.Float(0)

    def eval(self, si, active=True):
        return mi.Spectrum(0)

    def bbox(self):
        return mi.ScalarBoundingBox3f([0, 0.5, 3], [0, 0.5, 3])


class Stripes(mi.Texture):
    def __init__(self, props):
        mi.Texture.__init__(self, props)
        self.level = mi.Float(props.get("level", 0.5))

    def traverse(self, cb):
        cb.put("level", self.level, mi.ParamFlags.Differentiable)

    def eval(self, si, active=True):
        return mi.UnpolarizedSpectrum(self.level * (1 + dr.sin(20 * si.uv.x)) / 2)

    def mean(self):
        return self.level

    def is_spatially_varying(self):
        return True


class Paint(mi.BSDF):
    def __init__(self, props):
        mi.BSDF.__init__(self, props)
        self.colour = props.get_texture("colour", 0.5)
        self.m_components = [mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide]
        self.m_flags = self.m_components[0]

    def traverse(self, cb):
        cb.put("colour", self.colour, mi.ParamFlags.Differentiable)

    def sample(self, ctx, si, sample1, sample2, active=True):
        bs = dr.zeros(mi.BSDFSample3f)
        bs.wo, bs.eta = mi.warp.square_to_cosine_hemisphere(sample2), mi.Float(1)
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
        bs.pdf = self.pdf(ctx, si, bs.wo, active)
        return bs, dr.select(bs.pdf > 0, self.colour.eval(si, active), 0)

    def eval(self, ctx, si, wo, active=True):
        return self.colour.eval(si, active) * self.pdf(ctx, si, wo, active)

    def pdf(self, ctx, si, wo, active=True):
        return dr.select((si.wi.z > 0) & (wo.z > 0), mi.warp.square_to_cosine_hemisphere_pdf(wo), 0)


register("integrator", "walker", Walker)
register("emitter", "spark", Spark)
register("texture", "stripes", Stripes)
register("bsdf", "paint", Paint)
