"""Scattering where every surface is Lambertian: cosines instead of virtual calls."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.bsdfs.delay_table import DelaySample
from torchtransient.plugins.bsdfs.lambertian import is_lambertian, scatters_behind
from torchtransient.plugins.transport.scattering.surface import Surface
from torchtransient.plugins.transport.strategy import Answer, Step


class Lambertian(Surface):
    """:class:`.surface.Surface` for scenes that :meth:`fits`. ``draws_lobe``: draw the number that chooses a lobe, so
    that a seed gives the same paths as there.
    """

    turns_freely = samples_all = True

    def __init__(self, guides=(), draws_lobe=False):
        super().__init__(guides)
        self.draws_lobe = draws_lobe

    @staticmethod
    def fits(contents):
        """Whether all that paths meet is Lambertian, in unpolarized light."""
        special = (contents.delays, contents.mixtures, contents.refraction, contents.media, contents.hidden_probability)
        return not mi.is_polarized and all(s is None for s in special) and all(is_lambertian(b) for b in contents.bsdfs)

    def arrive(self, world, path, vertex, sampler):
        si = vertex.si
        vertex.u_delay = vertex.u_part = None
        vertex.bsdf = si.bsdf(path.ray)
        vertex.delay, vertex.scattered_si = DelaySample(vertex.bsdf), si
        vertex.connectable = mi.Bool(True)

    def scatter(self, world, path, vertex, proposals, sampler):
        u_lobe = sampler.next_1d() if self.draws_lobe else mi.Float(0)
        u_dir = sampler.next_2d()
        # After the lights were asked, as BSDFs are: kernels of a scene are then the same whatever was rendered before.
        vertex.side = _side(vertex.bsdf, vertex.si)
        vertex.ρ = _albedo(vertex.bsdf, vertex.si, vertex.goes_on)
        answers = [None if p is None else self._towards(vertex, p.d) for p in proposals]
        wo = mi.warp.square_to_cosine_hemisphere(u_dir)
        pdf = mi.warp.square_to_cosine_hemisphere_pdf(wo)
        lit = vertex.side != 0
        wo.z *= vertex.side
        step = Step(
            out=vertex.si.to_world(wo), wo=wo, weight=dr.select(lit, vertex.ρ, 0), pdf=dr.select(lit, pdf, 0),
            eta=mi.Float(1), u_lobe=u_lobe, u_dir=u_dir, u_delay=None, u_part=None, delta=mi.Bool(False),
            unconnected=mi.Bool(False),
        )  # fmt: skip
        if self.guides:
            self._follow_guides(world, path, vertex, step, sampler)
            for p, answer in zip(proposals, answers, strict=True):
                if p is not None:
                    answer.pdf = self.mixture(world, path.depth, vertex.at.p, p.ds, answer.pdf, p.active)
        return answers, step

    @staticmethod
    def _towards(vertex, d):
        """The :class:`~..strategy.Answer` towards the world direction ``d``."""
        cos = dr.dot(vertex.si.sh_frame.n, d) * vertex.side
        pdf = dr.select(cos > 0, cos, 0) * dr.inv_pi
        value = vertex.ρ * pdf
        return Answer(value=value, matrix=value, pdf=pdf, eta=mi.Float(1))

    def value_towards(self, world, path, vertex, out, active):
        answer = self._towards(vertex, out)
        return answer.value, answer.pdf

    # ----------------------------------------------------------------------------------------------- attached

    def look_up_attached(self, world, vertex, wanted):
        super().look_up_attached(world, vertex, wanted)
        vertex.side = _side(vertex.bsdf, vertex.sid)
        vertex.ρ = _albedo(vertex.bsdf, vertex.si, vertex.v.active & vertex.sid.is_valid())

    def eval_pdf(self, vertex, wo, out, active, sampled):
        towards = self._towards(vertex, out)
        return dr.select(active, towards.value, 0), dr.select(active, towards.pdf, 0)


def _side(bsdf, si):
    """1 where light comes from the front, -1 from the back, 0 where nothing scatters: on the back of a one-sided
    surface.
    """
    return dr.select(si.wi.z > 0, 1, dr.select(scatters_behind(bsdf) & (si.wi.z < 0), -1, 0))


def _albedo(bsdf, si, active):
    return dr.select(active, mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(si, active)), 0)
