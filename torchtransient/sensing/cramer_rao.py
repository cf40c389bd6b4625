"""Cramer-Rao bound of distance, signal and background of one return in a histogram, with background and pile-up.

No unbiased estimate has a covariance below the inverse of the Fisher information. Of Poisson counts of mean m(p) that
is ``sum m_i m_j / m`` over the bins, m_i the derivative by parameter i; of the first photons of N cycles at rates r(p)
per cycle, by the binomial of every bin given the cycles still armed, ``sum A r_i r_j / (exp(r) - 1)`` with
``A = N exp(-sum of the rates before)``; of N cycles with at most one detection each, wherever a chain puts it (a
multinomial), ``sum m_i m_j / m + (sum m_i)(sum m_j) / (N - sum m)``. All sums are float64.

Sources: Kay, Fundamentals of statistical signal processing I (1993), 3.7; Coates, J. Phys. E 1 (1968), for the armed
cycles. Bounds are for estimates without bias: at few detections a maximum-likelihood estimate is worse (a peak of the
background is taken for the return), and one that knows more, such as a prior, may be better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.errors import ShapeError, UnitError
from torchtransient.sensing.checks import TIME, check_count, no_arrays
from torchtransient.sensing.responses import Response
from torchtransient.tensor_record import TensorRecord
from torchtransient.units import SPEED_OF_LIGHT

_DARK = 1e-100  # a rate of that much is none, and its square still a number
_SAME = 1e-13  # of a variance, what is left when the others are known: two parameters that do the same but for rounding


@dataclass(frozen=True, eq=False, repr=False)
class CramerRaoBound(TensorRecord):
    """Least standard deviations of unbiased estimates, of the shape of the pixels; infinite where nothing is known.

    Attributes:
        distance_m: standard deviation of the distance, metres one way.
        delay_s: standard deviation of the delay there and back, seconds.
        signal: standard deviation of the signal, in the unit it was given in.
        background: standard deviation of the background, in the unit it was given in.
        covariance: covariance of distance, signal and background, (..., 3, 3).
    """

    distance_m: Tensor
    _: KW_ONLY
    delay_s: Tensor
    signal: Tensor
    background: Tensor
    covariance: Tensor


def return_rates(
    response: Response,
    axis: TimeAxis,
    *,
    distance_m: Tensor | float,
    signal: Tensor | float,
    background: Tensor | float = 0.0,
) -> Tensor:
    """Mean histogram of one return of a plane: the response around ``2 distance / c``, integrated over the bins.

    Numbers, or tensors that broadcast to the shape of the pixels (...); differentiable in them and in the response.
    What arrives outside of the axis is lost.

    Args:
        response: impulse response.
        axis: axis of the histogram.
        distance_m: distance one way, metres.
        signal: expected detections, of the exposure or of a cycle.
        background: expected detections of the background in each bin.

    Returns:
        (..., T) float64. ``.movedim(-1, -3)`` of pixels (..., C, H, W) is what sensors take.

    Raises:
        UnitError: for negative numbers.
    """
    distance, light, dark = _pixels((distance_m, signal, background), response, "return_rates")
    return light.unsqueeze(-1) * _shares(response, axis, distance) + dark.unsqueeze(-1)


def crlb(
    response: Response,
    axis: TimeAxis,
    *,
    distance_m: Tensor | float,
    signal: Tensor | float,
    background: Tensor | float = 0.0,
    cycles: int | None = None,
) -> CramerRaoBound:
    """Cramer-Rao bound of distance, signal and background of the return of `return_rates`, for each pixel.

    Pixels have any shape and do not see each other; results are those of its float dtype, float32 at least, and
    differentiable in all tensors and in the parameters of the response, so that a device can be designed by them.
    Without background, in bins that are narrow beside a normal pulse, ``distance_m`` is `range_deviation_m`. Memory:
    some ten numbers of 8 bytes for each pixel and bin. Not supported: dead times with several detections a cycle,
    free-running detectors, readout noise: `covariance_bound` where their statistics are one of the two. All three
    numbers are unknown; where the background is known, `covariance_bound` by the other two.

    Args:
        response: impulse response.
        axis: axis of the histogram.
        distance_m: distance one way, metres.
        signal: expected detections.
        background: expected detections of the background in each bin.
        cycles: None for Poisson counts; signal and background are expected detections of the whole exposure. N for the
            first photon of each of N cycles, with pile-up; they are rates per cycle of a detector that is never dead,
            as `first_photon_nll` and `SynchronousSPAD` take them.

    Raises:
        UnitError: for negative numbers.
    """
    number = None if cycles is None else check_count(cycles, "cycles", "crlb")
    distance, light, dark = _pixels((distance_m, signal, background), response, "crlb")
    both = torch.func.jvp(lambda d: _shares(response, axis, d), (distance,), (torch.ones_like(distance),))
    shares, change = both[0], both[1]
    light = light.unsqueeze(-1)
    rates = (light * shares + dark.unsqueeze(-1)).clamp_min(_DARK)
    each = torch.stack([light * change, shares, torch.ones_like(shares)], -1)
    weights = 1 / rates
    if number is not None:
        before = rates.cumsum(-1) - rates
        weights = number * torch.exp(-before - rates) / -torch.expm1(-rates)
    dtype = _floating((distance_m, signal, background))
    covariance = _inverse(torch.einsum("...ti,...t,...tj->...ij", each, weights, each))
    own, of_signal, of_background = covariance.diagonal(dim1=-2, dim2=-1).sqrt().unbind(-1)
    return CramerRaoBound(
        distance_m=own.to(dtype),
        delay_s=(own * 2 / SPEED_OF_LIGHT).to(dtype),
        signal=of_signal.to(dtype),
        background=of_background.to(dtype),
        covariance=covariance.to(dtype),
    )


def covariance_bound(mean: Callable[..., Tensor], parameters: Sequence[Tensor], *, cycles: int | None = None) -> Tensor:
    """Least covariance of unbiased estimates of P parameters of any chain's mean.

    Derivatives by forward mode, one call each. float64 parameters are advised; differentiable as far as the chain is
    twice. Not supported: statistics of other kinds (several detections a cycle, afterpulses, free-running detectors,
    readout noise), for which this is no bound; parameters that act on other pixels, whose light would count as their
    own.

    Args:
        mean: function of the parameters that returns (..., C, T, H, W), such as ``lambda d, s: chain.expected(light(d,
            s))``.
        parameters: maps (..., C, H, W), each of which acts on its own pixel.
        cycles: None for independent Poisson counts of that mean; N for those of N cycles with at most one detection
            each, which stages behind the detector may have moved (jitter, converter) or lost.

    Returns:
        (..., C, H, W, P, P). The roots of ``.diagonal(dim1=-2, dim2=-1)`` are standard deviations, infinite where a
        parameter has no say.

    Raises:
        ShapeError: for other shapes.
        UnitError: for negative means, and more detections than cycles.
    """
    where, given = "covariance_bound", tuple(parameters)
    number = None if cycles is None else check_count(cycles, "cycles", where)
    slopes = []
    for i, parameter in enumerate(given):

        def one(p: Tensor, i: int = i) -> Tensor:
            return mean(*given[:i], p, *given[i + 1 :])

        both = torch.func.jvp(one, (parameter,), (torch.ones_like(parameter),))
        value, slope = both[0], both[1]
        if value.ndim < 4 or (*value.shape[:TIME], *value.shape[TIME + 1 :]) != tuple(parameter.shape):
            raise ShapeError(
                f"{where}: expected a mean (..., C, T, H, W) for parameters (..., C, H, W), got {tuple(value.shape)} "
                f"for {tuple(parameter.shape)}."
            )
        slopes.append(slope.movedim(TIME, -1).to(torch.float64))
    counts = value.movedim(TIME, -1).to(torch.float64)
    if bool((counts < 0).any()):
        raise UnitError(f"{where}: expected mean counts >= 0, got negative ones.")
    each = torch.stack(slopes, -1)
    information = torch.einsum("...ti,...t,...tj->...ij", each, 1 / counts.clamp_min(_DARK), each)
    if number is not None:
        rest, total = number - counts.sum(-1), each.sum(-2)
        if bool((rest < -1e-6 * number).any()):
            raise UnitError(f"{where}: expected at most one detection in each of {number} cycles, got a mean of more.")
        # as many cycles as rounding leaves of those that saw nothing
        rest = rest.clamp_min(number * torch.finfo(value.dtype).eps)[..., None, None]
        information = information + total.unsqueeze(-1) * total.unsqueeze(-2) / rest
    return _inverse(information).to(value.dtype)


def _shares(response: Response, axis: TimeAxis, distance: Tensor) -> Tensor:
    """Share of a return at `distance` in each bin, (..., T)."""
    edges = axis.edges_s.to(distance.device) - distance.unsqueeze(-1) * (2 / SPEED_OF_LIGHT)
    return response.mass(edges)


def _inverse(information: Tensor) -> Tensor:
    """Invert information; infinite variances where a parameter has none, of all where they cannot be told apart.

    In units in which every parameter alone has the variance one: metres and counts differ by many decades.
    """
    own = information.diagonal(dim1=-2, dim2=-1)
    known = own > 0
    size = torch.where(known, own, 1.0).sqrt()
    scaled = information / size.unsqueeze(-1) / size.unsqueeze(-2)
    scaled = scaled + torch.diag_embed((~known).to(own))
    factor, failed = torch.linalg.cholesky_ex(scaled)
    told = (failed == 0) & (factor.diagonal(dim1=-2, dim2=-1).square() > _SAME).all(-1)
    unit = torch.eye(own.shape[-1], dtype=own.dtype, device=own.device)
    inverse = torch.cholesky_inverse(torch.where(told[..., None, None], factor, unit))
    inverse = inverse / size.unsqueeze(-1) / size.unsqueeze(-2)
    without = torch.diag_embed((~known | ~told.unsqueeze(-1)).to(own)) > 0
    return torch.where(without, torch.inf, inverse)


def _pixels(values: tuple[Tensor | float, ...], response: Response, where: str) -> tuple[Tensor, ...]:
    """Distance, signal and background of every pixel, float64, of one shape, on the device of the response."""
    tensors = []
    for name, given in zip(("distance_m", "signal", "background"), values, strict=True):
        # a number stands on the device of the response; a tensor that does not is torch's error
        own = None if isinstance(given, Tensor) and given.ndim else response.delay_ps.device
        tensor = torch.as_tensor(no_arrays(given), device=own).to(torch.float64)
        if not bool((torch.isfinite(tensor) & (tensor >= 0)).all()):
            raise UnitError(f"{where}: expected {name} to be finite and >= 0, got other numbers.")
        tensors.append(tensor)
    # of their own memory, as forward derivatives want it
    together = torch.broadcast_tensors(*tensors)  # type: ignore[no-untyped-call]
    return tuple(t.clone(memory_format=torch.contiguous_format) for t in together)


def _floating(values: tuple[Tensor | float, ...]) -> torch.dtype:
    """The dtype of the most precise tensor, float32 at least; torch's default without one."""
    tensors = [no_arrays(value) for value in values]
    dtypes = [v.dtype for v in tensors if isinstance(v, Tensor) and v.is_floating_point()]
    if not dtypes:
        return torch.get_default_dtype()
    return torch.float64 if torch.float64 in dtypes else torch.float32
