"""Closed forms of detector responses: cumulative distributions that stay exact far out on both sides."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from torchtransient.errors import ShapeError, UnitError
from torchtransient.sensing.base.layout import check_number, going_together, one_number, reals

FWHM_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))  # 2.3548


def normal_cdf(u: Tensor) -> Tensor:
    """Cumulative normal distribution; keeps relative precision for u far below 0."""
    share: Tensor = 0.5 * torch.special.erfc(-u / math.sqrt(2))
    return share


def normal_integral(u: Tensor) -> Tensor:
    """Integral of `normal_cdf` up to u: u Phi(u) + phi(u). Keeps 1e-13 of itself down to u = -30."""
    return u * normal_cdf(u) + torch.exp(-0.5 * u * u) / math.sqrt(2 * math.pi)


def _tail_term(u: Tensor, ratio: Tensor) -> Tensor:
    """exp(ratio^2/2 - u ratio) Phi(u - ratio) for ratio = sigma/tau, without overflow for any of them.

    With z = (ratio - u)/sqrt 2: for z >= 0 it is exp(-u^2/2) erfcx(z)/2, and else both factors of the plain form are
    below one. Each branch sees an argument that it can take, so that gradients stay finite in the other one too.
    """
    z = (ratio - u) / math.sqrt(2)
    scaled = z >= 0
    # z >= 0 means u <= ratio; u is clamped for the unused branch only
    u_scaled = torch.where(scaled, u, torch.zeros_like(u))
    by_erfcx = 0.5 * torch.exp(-0.5 * u_scaled**2) * torch.special.erfcx(torch.where(scaled, z, torch.zeros_like(z)))
    exponent = torch.where(scaled, torch.zeros_like(u), 0.5 * ratio**2 - u * ratio)
    plain = 0.5 * torch.exp(exponent) * torch.special.erfc(torch.where(scaled, torch.zeros_like(z), z))
    return torch.where(scaled, by_erfcx, plain)


def emg_density(time_s: Tensor, mean_s: Tensor, sigma_s: Tensor, tau_s: Tensor) -> Tensor:
    """Density (1/s) of a normal delay plus an exponential one: the exponentially modified Gaussian.

    `mean_s`, `sigma_s`: of the normal part; `tau_s`: mean of the exponential part. Stable for every ratio of the two.
    Source: Grushka, Anal. Chem. 44 (1972); erfcx form as in Kalambet et al., J. Chemometrics 25 (2011).
    """
    given = going_together("emg_density", time_s=time_s, mean_s=mean_s, sigma_s=sigma_s, tau_s=tau_s)
    time_s, mean_s, sigma_s, tau_s = given
    return _tail_term((time_s - mean_s) / sigma_s, sigma_s / tau_s) / tau_s


def emg_cdf(time_s: Tensor, mean_s: Tensor, sigma_s: Tensor, tau_s: Tensor) -> Tensor:
    """Share of `emg_density` before `time_s`."""
    given = going_together("emg_cdf", time_s=time_s, mean_s=mean_s, sigma_s=sigma_s, tau_s=tau_s)
    time_s, mean_s, sigma_s, tau_s = given
    u = (time_s - mean_s) / sigma_s
    return normal_cdf(u) - _tail_term(u, sigma_s / tau_s)


def emg_survival(time_s: Tensor, mean_s: Tensor, sigma_s: Tensor, tau_s: Tensor) -> Tensor:
    """Share of `emg_density` after `time_s`, with relative precision far out in the tail."""
    given = going_together("emg_survival", time_s=time_s, mean_s=mean_s, sigma_s=sigma_s, tau_s=tau_s)
    time_s, mean_s, sigma_s, tau_s = given
    u = (time_s - mean_s) / sigma_s
    return normal_cdf(-u) + _tail_term(u, sigma_s / tau_s)


def normal_integrals(time_s: Tensor, mean_s: Tensor, sigma_s: Tensor) -> tuple[Tensor, Tensor]:
    """Integrals of the cumulative normal up to each time and of its survival from there on, in seconds."""
    u = (time_s - mean_s) / sigma_s
    return sigma_s * normal_integral(u), sigma_s * normal_integral(-u)


def emg_integrals(time_s: Tensor, mean_s: Tensor, sigma_s: Tensor, tau_s: Tensor) -> tuple[Tensor, Tensor]:
    """Integrals of `emg_cdf` up to each time and of `emg_survival` from there on, in seconds.

    The tail term is tau times the density, so that its integral is tau times the cumulative.
    """
    below, above = normal_integrals(time_s, mean_s, sigma_s)
    cdf, survival = emg_cdf(time_s, mean_s, sigma_s, tau_s), emg_survival(time_s, mean_s, sigma_s, tau_s)
    return below - tau_s * cdf, above + tau_s * survival


def integrated_counts(counts: Tensor, width_s: float, time_s: Tensor, start_s: float | Tensor = 0.0) -> Tensor:
    """Integral, up to each time, of the counts that lie before: (K,) float64, counts times seconds.

    `counts`: (T,) in bins of `width_s` from `start_s` on, spread evenly over each bin, so that the result is quadratic
    inside the bins. `time_s`: (K,). Differentiable in the counts, the times and the start.
    """
    values = counts.to(torch.float64)
    before = torch.nn.functional.pad(values.cumsum(0), (1, 0))
    area = torch.nn.functional.pad((before[:-1] + 0.5 * values).cumsum(0), (1, 0))
    bins = counts.shape[0]
    position = (time_s.to(torch.float64) - start_s) / width_s
    inside = position.clamp(0, bins)
    k = inside.floor().clamp_max(bins - 1).long()
    part = inside - k
    beyond = (position - inside).clamp_min(0) * before[-1]
    return width_s * (area[k] + part * (before[k] + 0.5 * part * values[k]) + beyond)


def resample_counts(counts: Tensor, width_s: float, edges_s: Tensor, *, start_s: float | Tensor = 0.0) -> Tensor:
    """Counts between new edges, by integrating: a bin's counts are spread evenly over it, and sums are conserved.

    `counts`: (T,) in bins of `width_s` from `start_s` on; `edges_s`: (K + 1,) increasing; returns (K,) float64. What
    lies outside the new edges is left out. Differentiable in the counts, the edges and the start.
    """
    me = "resample_counts"
    counts, edges_s = reals(me, torch.float64, counts=counts, edges_s=edges_s)
    if counts.ndim != 1 or edges_s.ndim != 1 or not counts.numel():
        raise ShapeError(f"{me}: expected counts (T,) of one bin or more and edges_s (K + 1,), got "
                         f"{tuple(counts.shape)} and {tuple(edges_s.shape)}.")  # fmt: skip
    width_s, start_s = one_number(width_s, "width_s", me), one_number(start_s, "start_s", me)
    cumulative = torch.nn.functional.pad(counts.to(torch.float64).cumsum(0), (1, 0))
    bins = counts.shape[0]
    position = ((edges_s.to(torch.float64) - start_s) / width_s).clamp(0, bins)
    below = position.floor().clamp_max(bins - 1).long()
    value = cumulative[below] + (position - below) * (cumulative[below + 1] - cumulative[below])
    return value.diff()


def above_floor(counts: Tensor, floor: float | bool, where: str) -> Tensor:
    """A measured histogram without its background, not below 0, sum 1: float64.

    `floor` True: the median of all bins, which is the background when the response fills less than half of them; False:
    none; a number: so many counts of every bin. Raises UnitError for other floors, and where nothing is left.
    """
    numbers = counts.to(torch.float64)
    level = floor if isinstance(floor, (bool, np.bool_)) else check_number(floor, "floor", where)
    if isinstance(level, (bool, np.bool_)):
        level = float(numbers.median()) if level else 0.0
    clean = (numbers - level).clamp_min(0)
    if not float(clean.sum()) > 0:
        raise UnitError(f"{where}: expected counts above the floor of {level:g}, got none.")
    return clean / clean.sum()
