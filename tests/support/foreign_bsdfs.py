"""BSDFs as users write them in Python: one that holds another one, one that holds none and describes itself not."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def register():
    """Their plugins, for the active variant: ``tint`` and ``nameless``."""
    for name, kind in (("tint", _tint()), ("nameless", _nameless())):
        mi.register_bsdf(name, kind)


def _tint():
    class Tint(mi.BSDF):
        """Half of what another BSDF scatters, whose name it does not tell."""

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.inner = next(held for _, held in props.objects() if isinstance(held, mi.BSDF))
            self.m_components = [self.inner.flags(i) for i in range(self.inner.component_count())]
            self.m_flags = self.inner.flags()
            self.tint = mi.Float(0.5)

        def traverse(self, cb):
            cb.put("inner", self.inner, +mi.ParamFlags.Differentiable)
            cb.put("tint", self.tint, +mi.ParamFlags.Differentiable)

        def sample(self, ctx, si, u, v, active=True):
            bs, weight = self.inner.sample(ctx, si, u, v, active)
            return bs, weight * self.tint

        def eval(self, ctx, si, wo, active=True):
            return self.inner.eval(ctx, si, wo, active) * self.tint

        def pdf(self, ctx, si, wo, active=True):
            return self.inner.pdf(ctx, si, wo, active)

        def eval_pdf(self, ctx, si, wo, active=True):
            value, pdf = self.inner.eval_pdf(ctx, si, wo, active)
            return value * self.tint, pdf

        def to_string(self):
            return "Tint[]"

    return Tint


def _nameless():
    class Nameless(mi.BSDF):
        """Paint without ``to_string``."""

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.m_components = [mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]

        def sample(self, ctx, si, u, v, active=True):
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = mi.warp.square_to_cosine_hemisphere(v)
            bs.pdf, bs.eta = mi.warp.square_to_cosine_hemisphere_pdf(bs.wo), mi.Float(1)
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            return bs, mi.Spectrum(0.5) & (active & (si.wi.z > 0))

        def eval(self, ctx, si, wo, active=True):
            return mi.Spectrum(0.5 * self.pdf(ctx, si, wo, active))

        def pdf(self, ctx, si, wo, active=True):
            return dr.select((si.wi.z > 0) & (wo.z > 0), mi.warp.square_to_cosine_hemisphere_pdf(wo), 0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    return Nameless
