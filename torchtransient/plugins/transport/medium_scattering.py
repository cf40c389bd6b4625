"""Scattering by BSDFs on surfaces and by phase functions in media. Everything else is that of surfaces."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.transport.surface_scattering import Surface

# Stands for the density of a phase function so narrow that single precision has none; its square is still a number.
DELTA_LIKE = 1e15


def _finite(value, otherwise=0):
    """``otherwise`` where a phase function is so narrow that single precision has no value for it."""
    return dr.select(dr.isfinite(value), value, otherwise)


def _unpolarizing(value):
    """Scattering by ``value`` that removes all polarization, as a scalar phase function does."""
    if not mi.is_polarized:
        return value
    matrix = dr.zeros(mi.Spectrum)
    matrix[0, 0] = value
    return matrix


class SurfaceOrMedium(Surface):
    """Scattering at surfaces, and in media by the phase function times the scattering coefficient."""

    def prepare(self, context):
        super().prepare(context)
        blends = context.contents.media.phase_mixtures
        self.blends = None if blends is None else blends.read(context.wanted)

    def _phase_and_scattering(self, mei, u, active):
        """Return (phase function, or the part of one that ``u`` chooses; scattering coefficient times its weight)."""
        phase = dr.select(active, mei.medium.phase_function(), dr.zeros(mi.PhaseFunctionPtr))
        σ_s = mei.medium.get_scattering_coefficients(mei, active)[0]
        if self.blends is None:
            return phase, σ_s
        phase, weight = self.blends.part_of(phase, mei, u, active)
        return phase, σ_s * weight

    # ------------------------------------------------------------------------------------------------- primal

    def arrive(self, context, path, vertex, sampler):
        super().arrive(context, path, vertex, sampler)
        vertex.u_phase = None if self.blends is None else sampler.next_1d()

    def connectable(self, context, vertex):
        smooth = super().connectable(context, vertex)
        allowed = True if context.contents.media.emitter_sampling else vertex.medium.use_emitter_sampling()
        return dr.select(vertex.scatter, allowed, smooth)

    def scatter_in_volume(self, context, vertex, proposals, answers, step):
        ctx, mei, scatter = mi.PhaseFunctionContext(None), vertex.mei, vertex.scatter
        active = vertex.goes_on & scatter
        step.u_phase = vertex.u_phase
        phase, σ_s = self._phase_and_scattering(mei, vertex.u_phase, active)
        for p, answer in zip(proposals, answers, strict=True):
            if p is not None:
                f, pdf = phase.eval_pdf(ctx, mei, p.d, p.active & scatter)
                f = _unpolarizing(_finite(mi.unpolarized_spectrum(f)) * σ_s)
                answer.value = dr.select(scatter, f, answer.value)
                answer.pdf = dr.select(scatter, _finite(pdf), answer.pdf)
        out, w, pdf = phase.sample(ctx, mei, step.u_lobe, step.u_dir, active)
        pdf = _finite(pdf, DELTA_LIKE)
        w = dr.select(pdf > 0, _finite(mi.unpolarized_spectrum(w)) * σ_s, 0)
        step.weight = dr.select(scatter, _unpolarizing(w), step.weight)
        step.out, step.pdf = dr.select(scatter, out, step.out), dr.select(scatter, pdf, step.pdf)
        step.eta, step.delta = dr.select(scatter, 1, step.eta), step.delta & ~scatter
        step.unconnected = step.delta
        if not context.contents.media.emitter_sampling:
            step.unconnected = step.delta | (scatter & ~vertex.medium.use_emitter_sampling())

    def value_towards(self, context, path, vertex, out, active):
        value, pdf = super().value_towards(context, path, vertex, out, active)
        scatter, mei = vertex.scatter, vertex.mei
        phase, σ_s = self._phase_and_scattering(mei, vertex.u_phase, active & scatter)
        f, f_pdf = phase.eval_pdf(mi.PhaseFunctionContext(None), mei, out, active & scatter)
        f = _unpolarizing(_finite(mi.unpolarized_spectrum(f)) * σ_s)
        return dr.select(scatter, f, value), dr.select(scatter, _finite(f_pdf), pdf)

    def value_in_medium(self, mei, out, u, active):
        """Return the scattering at a point in a medium that no path has walked to, unpolarized.

        Args:
            mei: MediumInteraction3f.
            out: direction of the light in world space.
            u: number that chooses a part of a blend, None without blends.

        Returns:
            (value times the scattering coefficient, density).
        """
        phase, σ_s = self._phase_and_scattering(mei, u, active)
        f, pdf = phase.eval_pdf(mi.PhaseFunctionContext(None), mei, out, active)
        return _finite(mi.unpolarized_spectrum(f)) * σ_s, _finite(pdf)

    # ------------------------------------------------------------------------------------------------- record

    def fields(self, context):
        return super().fields(context) | ({} if self.blends is None else {"u_phase": mi.Float})

    # ----------------------------------------------------------------------------------------------- attached

    def look_up_attached(self, context, vertex, wanted):
        super().look_up_attached(context, vertex, wanted)
        u, active = vertex.v.record_of(self.name).get("u_phase"), vertex.v.active & vertex.scatter
        vertex.phase, vertex.σ_s = self._phase_and_scattering(vertex.mei, u, active)

    def eval_pdf(self, vertex, wo, out, active, sampled):
        """Return value and density of an attached vertex towards a direction.

        A phase function too narrow for single precision has no light towards a given point, and its own samples
        (``sampled``) have the ratio of value and density that they were drawn with.
        """
        surface_value, surface_pdf = super().eval_pdf(vertex, wo, out, active, sampled)
        ctx, scatter = mi.PhaseFunctionContext(None), vertex.scatter
        value, pdf = vertex.phase.eval_pdf(ctx, vertex.mei, out, active & scatter)
        usable = dr.isfinite(pdf) & (pdf > 0)
        other = 1 if sampled else 0
        value = _unpolarizing(dr.select(usable, mi.unpolarized_spectrum(value), other) * vertex.σ_s)
        return dr.select(scatter, value, surface_value), dr.select(scatter, dr.select(usable, pdf, other), surface_pdf)
