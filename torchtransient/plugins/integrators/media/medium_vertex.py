"""Scattering at a point inside a medium, in the form that the path loop knows from surfaces."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def reference(si, mei, scatter):
    """The vertex as a point of reference: that of the surface, or of the medium where ``scatter``."""
    at = dr.zeros(mi.Interaction3f)
    at.t = dr.select(scatter, mei.t, si.t)
    at.time = si.time
    at.wavelengths = si.wavelengths
    at.p = dr.select(scatter, mei.p, si.p)
    # Without a normal, rays start at the point itself.
    at.n = dr.select(scatter, mi.Normal3f(0), si.n)
    return at


# Stands for the density of a phase function so narrow that single precision has none; its square is still a number.
DELTA_LIKE = 1e15


def finite(value, otherwise=0):
    """``otherwise`` where a phase function is so narrow that single precision has no value for it."""
    return dr.select(dr.isfinite(value), value, otherwise)


def unpolarizing(value):
    """Scattering by ``value`` that leaves nothing of the polarization: what a scalar phase function says."""
    if not mi.is_polarized:
        return value
    matrix = dr.zeros(mi.Spectrum)
    matrix[0, 0] = value
    return matrix


def scatter_in_medium(media, here, d_em, u_lobe, u_dir, active, active_em, surface):
    """The scattering of the vertex ``here``, where it lies in a medium in place of that of its ``surface``.

    ``surface`` and the result: value and density towards ``d_em``; the sampled direction as a BSDF sample, its weight,
    and the direction in world coordinates. In a medium, the phase function times the scattering coefficient.
    """
    if media is None:
        return surface
    value, pdf, bs, weight, out = surface
    ctx, mei, scatter = mi.PhaseFunctionContext(None), here.mei, here.scatter
    active, active_em = active & scatter, active_em & scatter
    phase = dr.select(active, mei.medium.phase_function(), dr.zeros(mi.PhaseFunctionPtr))
    σ_s = mei.medium.get_scattering_coefficients(mei, active)[0]
    f, f_pdf = phase.eval_pdf(ctx, mei, d_em, active_em)
    wo, w, w_pdf = phase.sample(ctx, mei, u_lobe, u_dir, active)
    w_pdf = finite(w_pdf, DELTA_LIKE)
    w = dr.select(w_pdf > 0, finite(mi.unpolarized_spectrum(w)) * σ_s, 0)
    bs = dr.copy(bs)
    bs.pdf = dr.select(scatter, w_pdf, bs.pdf)
    bs.eta = dr.select(scatter, 1, bs.eta)
    bs.sampled_type = dr.select(scatter, mi.UInt32(0), bs.sampled_type)
    value = dr.select(scatter, unpolarizing(finite(mi.unpolarized_spectrum(f)) * σ_s), value)
    weight = dr.select(scatter, unpolarizing(w), weight)
    return value, dr.select(scatter, finite(f_pdf), pdf), bs, weight, dr.select(scatter, wo, out)


def medium_behind(si, d, medium, at_surface):
    """The medium of a ray that leaves a vertex in direction ``d``."""
    changes = at_surface & si.is_medium_transition()
    return dr.select(changes, si.target_medium(d), medium)
