"""A SPAD whose afterpulses obey its dead time, start dead times of their own and keep photons from being seen.

A trapped carrier is released after an exponential time, whatever the detector does: it fires an armed detector and is
lost on a dead one. Followed are factorial moments of the numbers of trapped carriers, in bins and over armed detectors:
F of none (the probability to be armed), F_k of one of kind k, F_kl of ordered pairs. All of them obey the renewal
equation of the detector, with released carriers as a loss,

    dF_S/dt = -(n + H_S + sum 1/tau) F_S + [rearmed from detections one dead time ago],

H_S being the rate of all other carriers. Detections leave S as it is (thinned by releases during the dead time) or add
a new carrier to a smaller set. The hazard of an armed detector, H of none, is sum F_k / (tau_k F): with it the balance
of a detector that knows phases only has the mean of the one that knows its carriers. Pairs are followed too; of triples
the rate of others is H_k + H_l - H, exact for independent carriers (as many of them are) and for detections that have
at most two between them.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.functional import jvp

from torchtransient.errors import TorchTransientError, UnitError
from torchtransient.floating import in_single
from torchtransient.sensing.afterpulsing import Afterpulsing
from torchtransient.sensing.checks import TIME, check_transient
from torchtransient.sensing.dead_time.clocked import (
    PHOTONS,
    DeadTimeBlocks,
    armed_probabilities,
    response_series,
    series_degree,
    solve_by_level,
    subdivision_levels,
)
from torchtransient.sensing.dead_time.free_running import DARK, detections_per_period, rows_by_contrast
from torchtransient.sensing.dead_time.once import once_differentiable
from torchtransient.sensing.dead_time.renewal import (
    BinResponse,
    ConstantLight,
    RenewalChain,
    bin_response,
    gmres,
    split_dead_time,
    stationary_phases,
)
from torchtransient.sensing.draws import check_rates
from torchtransient.sensing.free_running import FreeRunningSPAD
from torchtransient.sensing.parameters import kept_map, over_time
from torchtransient.sensing.sensor import GradPolicy, WrappedDetector, common_bins, cycles_of
from torchtransient.sensing.spad import SynchronousSPAD
from torchtransient.sensing.time_convolution import filter_rows

_LEFT = 1e-5  # of a detection, where generations end: some ten times the error of counts that is left
_SERIES = 2.0  # photons of a piece, up to which powers of them add up to all digits that count
_EXPONENT = 500.0  # of a stretch, inside float64
_TOLERANCE = 1e-10  # of carriers on a ring; derivatives are compared to 1e-6
_LARGEST_RESIDUAL = 1e-7  # of carriers on a ring, above which it is an error
_ROWS_AT_ONCE = 128  # bounds the memory of the Krylov vectors
_LEFT_INDEPENDENT = 1e-8  # of all counts, where generations of independent releases end
_FEW = 1e-5  # carriers of a detection, whose time inside a bin does not show
_DIM = 1e-8  # photons of a bin
_NONE = 1e-8  # of the time armed in the piece where it is longest: what is left of less, in a flood, is rounding
_STEP, _MOST_STEPS = 1.2, 3  # mean delays that a part of a bin is wide, at most, and the logarithm of their number
_Detector = SynchronousSPAD | FreeRunningSPAD
# transfer functions of a period, and of two windows for what is to be left out, of the same cycle; period in bins
_Transfers = tuple[Tensor, Tensor | None, int]


# ------------------------------------------------------------------------------------------- carriers on a ring of bins


def _twice(x: Tensor) -> Tensor:
    return torch.cat([x, x], -1)


class _LossyChain:
    """Step of the share `kept` of the lines of a renewal chain, and the inverse of 1 minus it."""

    def __init__(self, loss: Tensor, kept: Tensor, part: Tensor, whole: int) -> None:
        self.chain, self.kept = RenewalChain(loss, whole, part), kept
        wait, share = 1 / loss.mean(-1, keepdim=True), kept.mean(-1, keepdim=True)
        self.constant = ConstantLight(wait, self.chain.bins, whole, part, share)

    def step(self, x: Tensor) -> Tensor:
        return self.chain.step(_twice(self.kept) * x)

    def solve(self, right: Tensor) -> Tensor:
        return self._checked(*gmres(lambda v: v - self.step(v), right, right, _TOLERANCE, self.constant.solve))

    def solve_transposed(self, right: Tensor) -> Tensor:
        def operator(v: Tensor) -> Tensor:
            return v - _twice(self.kept) * self.chain.transposed(v)

        return self._checked(*gmres(operator, right, right, _TOLERANCE, self.constant.solve_transposed))

    @staticmethod
    def _checked(found: Tensor, residual: Tensor) -> Tensor:
        if not bool((residual <= _LARGEST_RESIDUAL).all()):
            raise TorchTransientError(
                f"AfterpulsingSPAD: expected a relative residual of {_LARGEST_RESIDUAL:g} of trapped carriers, got "
                f"{float(residual.max()):g}. Lower the flux per period or use fewer, wider bins."
            )
        return found


def _step(given: Sequence[Tensor], whole: int, x: Tensor) -> Tensor:
    loss, kept, source, part = given
    return RenewalChain(loss, whole, part).step(_twice(kept) * x + source)


class _Trapped(torch.autograd.Function):
    """Stationary lines (R, 2 T) of the loss of an armed detector that holds trapped carriers.

    Of the rate (R, T) > 0 at which the state is left while armed, the share (R, T) of the loss that returns after the
    dead time, the lines (R, 2 T) that are put in after it, and the dead time in bins, split. Both modes by the implicit
    function theorem.
    """

    @staticmethod
    def forward(ctx: Any, loss: Tensor, kept: Tensor, source: Tensor, part: Tensor, whole: int) -> Tensor:
        ctx.whole = whole
        found = []
        for at in torch.split(torch.arange(loss.shape[0], device=loss.device), _ROWS_AT_ONCE):
            chain = _LossyChain(loss[at], kept[at], part, whole)
            found.append(chain.solve(chain.chain.step(source[at])))
        x = torch.cat(found)
        ctx.save_for_backward(loss, kept, source, part, x)
        ctx.save_for_forward(loss, kept, source, part, x)
        return x

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        loss, kept, source, part, x = ctx.saved_tensors
        given = (loss, kept, source, part)
        along = tuple(torch.zeros_like(v) if t is None else t for v, t in zip(given, tangents, strict=False))
        # by two backward passes, which are the derivative of the gradient in its weights
        right = jvp(lambda *v: _step(v, ctx.whole, x), given, along)[1]  # type: ignore[no-untyped-call]
        found = []
        for at in torch.split(torch.arange(loss.shape[0], device=loss.device), _ROWS_AT_ONCE):
            found.append(_LossyChain(loss[at], kept[at], part, ctx.whole).solve(right[at]))
        return torch.cat(found)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        loss, kept, source, part, x = ctx.saved_tensors
        found = []
        for at in torch.split(torch.arange(loss.shape[0], device=loss.device), _ROWS_AT_ONCE):
            found.append(_LossyChain(loss[at], kept[at], part, ctx.whole).solve_transposed(gradient[at]))
        with torch.enable_grad():
            leaves = [v.detach().requires_grad_() for v in (loss, kept, source, part)]
            value = _step(leaves, ctx.whole, x)
            gradients = torch.autograd.grad(value, leaves, torch.cat(found))
        return *gradients, None


# ----------------------------------------------------------------------------------------- carriers and armed detectors


def _response(loss: Tensor, part: Tensor, largest: float) -> BinResponse:
    """`bin_response`; for few photons one matrix times their powers, in a quarter of the time."""
    if largest > _SERIES or part.requires_grad:
        return bin_response(loss, part, largest)
    series = response_series(float(part), series_degree(largest))[0].to(loss.device)
    order = [2, 3, 0, 1, 4]  # younger lines first
    kept, hit, slope = series[:, order].unbind(0)
    waited = torch.nn.functional.pad(hit[:, 1:], (0, 1))
    powers = [torch.ones_like(loss), loss]
    for _ in range(series.shape[-1] - 2):
        powers.append(powers[-1] * loss)
    rows = torch.cat([kept, waited, slope])
    found = torch.mm(rows, torch.stack(powers).flatten(1)).view(15, *loss.shape)
    kept, waited, slope = (v.movedim(0, 1) for v in torch.split(found, 5))
    return BinResponse(
        kept[:, :4], waited[:, :4], waited[:, :4], slope[:, :4], kept[:, 4], slope[:, 4], waited[:, 4], kept[:, 4]
    )


@dataclass(frozen=True)
class ClockedTrain:
    """Detector armed at the start of a cycle, without carriers of this cycle. Detections are on straight lines."""

    whole: int
    part: Tensor
    largest: float  # rates, but for those lost

    def bare(self, rate: Tensor) -> tuple[Tensor, Tensor]:
        """Rates (R, N) -> time armed in each piece (R, N), lines of detections (R, 2, N)."""
        return self._solve(rate, rate, None, None, self.largest)

    def trapped(self, rate: Tensor, lost: Tensor, back: Tensor, source: Tensor) -> tuple[Tensor, Tensor]:
        """The same of a state with trapped carriers.

        It is also left at the rate `lost` (R, 1), returns by the share `back` (R, 1) of detections and is put in by the
        lines `source` (R, 2, N).
        """
        return self._solve(rate, rate + lost, back.unsqueeze(-1), source, self.largest + float(lost.detach().amax()))

    def _solve(
        self, rate: Tensor, loss: Tensor, back: Tensor | None, source: Tensor | None, largest: float
    ) -> tuple[Tensor, Tensor]:
        pieces = rate.shape[-1]
        bins = _response(loss, self.part, largest)
        kept = None if source is None else rate / loss
        start = torch.ones_like(rate[:, :1]) if source is None else torch.zeros_like(rate[:, :1])
        blocks, put = DeadTimeBlocks(pieces, self.whole, 1), None
        if source is not None:
            put = torch.cat([torch.nn.functional.pad(source, (self.whole + k, 0))[..., :pieces] for k in (0, 1)], 1)
        stretch = max(1, math.floor(_EXPONENT / max(largest, 1e-3)))
        found: list[tuple[Tensor, Tensor, Tensor]] = []
        # split, since derivatives of slices are as large as what they are taken from
        needed = (bins.kept, bins.waited, bins.hit_slope, bins.wait, bins.slope, rate, loss)
        columns = [torch.split(value, self.whole, -1) for value in needed]
        none: list[Tensor | None] = [None] * len(columns[0])
        sources = none if put is None else torch.split(put, self.whole, -1)
        shares = none if kept is None else torch.split(kept, self.whole, -1)
        for own, put_here, share in zip(zip(*columns, strict=True), sources, shares, strict=True):
            kept_, waited_, slope_, wait, fire_slope, light, lost = own
            inflow = blocks.inflow(light.shape[-1])
            if put_here is not None and back is not None and inflow is not None:
                inflow = inflow * back + put_here
            joined = None if inflow is None else (kept_ * inflow).sum(1)
            armed, start = armed_probabilities(start, lost, joined, stretch)
            waited, slope = armed * wait, armed * fire_slope
            if inflow is not None:
                waited = waited + (waited_ * inflow).sum(1)
                slope = slope + (slope_ * inflow).sum(1)
            count = light * waited
            slope = slope if share is None else slope * share
            blocks.append(count, slope)
            found.append((waited, count, slope))
        waited, count, slope = (torch.cat(c, -1) for c in zip(*found, strict=True))
        return waited, torch.stack([count, slope], 1)


@dataclass(frozen=True)
class FreeRunningTrain:
    """Free-running detector in its stationary state; methods as in `ClockedTrain`."""

    whole: int
    part: Tensor

    def bare(self, rate: Tensor) -> tuple[Tensor, Tensor]:
        chain = RenewalChain(rate, self.whole, self.part)
        lines = detections_per_period(chain, stationary_phases(rate, self.part, self.whole))
        back = chain.inflow(lines)
        waited = chain.at_start(back) * chain.response.wait + (chain.response.waited * back).sum(1)
        return waited, lines.view(rate.shape[0], 2, -1)

    def trapped(self, rate: Tensor, lost: Tensor, back: Tensor, source: Tensor) -> tuple[Tensor, Tensor]:
        loss = rate + lost
        kept = rate / loss
        lines: Tensor = _Trapped.apply(loss, kept * back, source.flatten(1), self.part, self.whole)  # type: ignore[no-untyped-call]
        lines = lines.view_as(source)
        return lines[:, 0] / loss, lines * kept.unsqueeze(1)


def _safe_ratio(part: Tensor, whole: Tensor) -> Tensor:
    """part / whole, at least 0, and 0 where whole is none beside its row: rounding has no slope."""
    some = whole > _NONE * whole.detach().amax(-1, keepdim=True)
    return torch.where(some, part / torch.where(some, whole, torch.ones_like(whole)), 0.0).clamp_min(0)


def carrier_hazard(
    train: ClockedTrain | FreeRunningTrain,
    photons: Callable[[Tensor], Tensor] | None,
    first: Tensor,
    gate: Tensor | None,
    seen: Tensor,
    tau: Tensor,
    dead: Tensor,
) -> tuple[Tensor, Tensor]:
    """Rate of carriers that fire an armed detector, by rounds over generations of carriers.

    Args:
        train: detector.
        photons: rate of all else that fires it, from the detections of the round before; None: `first`.
        first: (P, N) photons per piece.
        gate: (N,) share of carriers that are seen, or None.
        seen: (K,) carriers of a detection.
        tau: (K,) mean delays beyond the dead time, in pieces.
        dead: dead time in pieces.

    Returns:
        Hazard per piece (P, N), and time armed (P, N) in pieces.
    """
    kinds, (pixels, pieces) = tau.shape[0], first.shape
    one, stay = (1 / tau).view(1, kinds, 1), torch.exp(-dead / tau).view(1, kinds, 1)
    p = seen.view(1, kinds, 1)
    # of pairs: lost, come back, and the chance that one detection leaves both
    pair_lost = (one.unsqueeze(2) + one.unsqueeze(1)).expand(pixels, -1, -1, -1)
    pair_stay = (stay.unsqueeze(2) * stay.unsqueeze(1)).expand(pixels, -1, -1, -1)
    other = 1 - torch.eye(kinds, dtype=p.dtype, device=p.device).view(1, kinds, kinds, 1)
    pair_new = p.unsqueeze(2) * p.unsqueeze(1) * other

    def level(
        rate: Tensor, lost: Tensor, back: Tensor, source: Tensor, shape: tuple[int, ...]
    ) -> tuple[Tensor, Tensor]:
        waited, lines = train.trapped(
            rate.reshape(-1, pieces), lost.reshape(-1, 1), back.reshape(-1, 1), source.reshape(-1, 2, pieces)
        )
        return waited.view(*shape, pieces), lines.view(*shape, 2, pieces)

    alone = first
    hazard = torch.zeros_like(first)  # given none,
    given = first.new_zeros(pixels, kinds, pieces)  # given one of each kind
    waited = torch.zeros_like(first)
    number = _generations(seen)
    for k in range(number):
        waited, bare = train.bare(alone + hazard)
        own = alone.unsqueeze(1) + given
        singles, lines = level(
            own, one.expand(pixels, -1, -1), stay.expand(pixels, -1, -1), p.unsqueeze(-1) * bare.unsqueeze(1),
            (pixels, kinds),
        )  # fmt: skip
        if k and (number - k) % 2 == 0:  # what pairs do comes with p^2
            more = (given.unsqueeze(2) + given.unsqueeze(1) - hazard[:, None, None]).clamp_min(0)
            put = p.view(1, kinds, 1, 1, 1) * (stay.view(1, 1, kinds, 1, 1) * lines.unsqueeze(1))
            source = put + put.transpose(1, 2) + pair_new.unsqueeze(-1) * bare[:, None, None]
            pairs, _ = level(alone[:, None, None] + more, pair_lost, pair_stay, source, (pixels, kinds, kinds))
            given = _safe_ratio((pairs * one.unsqueeze(1)).sum(2), singles)
        hazard = _safe_ratio((singles * one).sum(1), waited)
        if gate is not None:
            given, hazard = given * gate, hazard * gate
        if photons is not None:
            alone = photons(bare[:, 0])
    return hazard, waited


def _generations(seen: Tensor) -> int:
    """Rounds until the carriers of a generation are negligible."""
    most = float(seen.detach().sum())
    return max(2, math.ceil(math.log(_LEFT) / math.log(most))) if most > _LEFT else 1


def _merge_pieces(hazard: Tensor, waited: Tensor, pieces: int) -> Tensor:
    """Hazard per piece -> hazard per `pieces` of them, weighted by the time armed."""
    shape = (hazard.shape[0], -1, pieces)
    return pieces * _safe_ratio((hazard * waited).view(shape).sum(-1), waited.view(shape).sum(-1))


def _subdivide(value: Tensor, pieces: int) -> Tensor:
    """Values of bins -> values of `pieces` equal parts."""
    return (value / pieces).repeat_interleave(pieces, -1)


def clocked_hazard(
    rate: Tensor,
    dead_bins: Tensor,
    gate: Tensor | None,
    seen: Tensor,
    tau: Tensor,
    earlier: Callable[[Tensor, Tensor], Tensor],
    steps: int = 1,
) -> Tensor:
    """Rate of carriers that fire an armed detector that is armed at the start of cycles.

    Args:
        rate: (P, T) photons per cycle and bin, float64.
        dead_bins: dead time in bins, scalar float64.
        gate: (T,) factor of photons and carriers, or None.
        seen: (K,) carriers of a detection.
        tau: (K,) mean delays beyond the dead time, in bins.
        earlier: function of detections and rows, giving the carriers of other cycles.
        steps: equal parts of a bin, a power of 2.

    Returns:
        (P, steps T) per cycle and part of a bin.
    """
    size = rate.shape[-1]
    least = max(steps, 1 if float(dead_bins) >= 1 - 1e-9 else 2)

    def solved(rows: Tensor, at: Tensor, pieces: int) -> Tensor:
        def photons(detected: Tensor) -> Tensor:
            free = earlier(detected.view(rows.shape[0], size, pieces).sum(-1), at)
            last.append(free)
            return _subdivide(rows + free if gate is None else (rows + free) * gate, pieces)

        last: list[Tensor] = []
        train = ClockedTrain(*split_dead_time(dead_bins * pieces), 2 * PHOTONS)
        opened = None if gate is None else gate.repeat_interleave(pieces, -1)
        first = _subdivide(rows if gate is None else rows * gate, pieces)
        hazard, waited = carrier_hazard(train, photons, first, opened, seen, tau * pieces, dead_bins * pieces)
        own = _merge_pieces(hazard, waited, pieces // steps)
        if gate is not None:
            own = _safe_ratio(own, gate.repeat_interleave(steps, -1).expand_as(own))
        return own + _subdivide(last[-1], steps)

    return solve_by_level(rate, subdivision_levels(rate + (seen / tau).sum(), least), least, solved)


def free_running_hazard(rate: Tensor, dead_bins: Tensor, seen: Tensor, tau: Tensor, steps: int = 1) -> Tensor:
    """Rate of carriers that fire an armed free-running detector, 0 in the dark.

    Args:
        rate: (P, T) photons per period and bin, float64.
        dead_bins: dead time in bins, scalar float64.
        seen: (K,) carriers of a detection.
        tau: (K,) mean delays beyond the dead time, in bins.
        steps: equal parts of a bin, a power of 2.

    Returns:
        (P, steps T) per period and part of a bin.
    """
    dark = rate.sum(-1, keepdim=True) < DARK
    safe = torch.where(dark, rate + _DIM, rate)  # where carriers are proportional to photons, with the slope of none
    found = rate.new_zeros(rate.shape[0], steps * rate.shape[-1])
    for rows, cut in rows_by_contrast(safe):
        pieces = max(cut, steps)
        fine = _subdivide(safe if rows is None else safe[rows], pieces)
        train = FreeRunningTrain(*split_dead_time(dead_bins * pieces))
        hazard, waited = carrier_hazard(train, None, fine, None, seen, tau * pieces, dead_bins * pieces)
        own = _merge_pieces(hazard, waited, pieces // steps)
        found = own if rows is None else found.index_copy(0, rows, own)
    return torch.where(dark, found - found.detach(), found)


# --------------------------------------------------------------------------------------------------------- the detector


class AfterpulsingSPAD(WrappedDetector):
    """SPAD with afterpulses that obey its dead time: rates (..., C, T, H, W) per cycle and bin in, counts out.

    Released carriers act as photons do: they fire an armed detector and are lost on a dead one; those that fire start a
    dead time and leave carriers of their own. Their rate while the detector is armed, `released(x)`, is added to that
    of the photons; means, draws and all four policies are the detector's own. A SynchronousSPAD without dead time is
    dead to the end of the cycle: only afterpulses of later cycles are seen. A closed gate stops afterpulses, too. With
    a `period_s` beyond the window the `background` of the Afterpulsing, counts of a bin of the whole exposure, goes on
    outside of it; inside a `MacroPixel` or `CoincidencePixel` it is that of the whole pixel, of which every SPAD has
    its share.

    Exponential delays of a detector with dead time (SynchronousSPAD, or FreeRunningSPAD "non_paralyzable"): each
    carrier is followed from its detection on (`carrier_hazard`), so that one released right after the dead time finds
    the detector armed, and all older carriers that are still trapped count. Pairs of carriers are exact, three and more
    by their pairs; means are within 1.5 times the noise of events for probabilities up to 0.3, delays of 0.3 to 300
    bins. Several exponentials are independent. Delays below 1.2 bins are followed in parts of bins, at the cost of as
    many bins (8 at most); `log_prob`, `variance` and pixels of several SPADs take them as constant inside a bin.

    Other laws of delays, "paralyzable" detectors and detectors without dead time of their own: releases are independent
    of whether a photon has fired the detector since. Exact for one detection a cycle; else off by up to a third of the
    probability in total variation, totals by a quarter, where most carriers are released right after the dead time
    (docs/photon_counting.md).

    Draws have the variance of the detector at that rate: afterpulses vary as photons do, short by twice their share in
    dim light (variance over mean of totals 0.83 for 1.41 with a probability of 0.3, 0.7 for 0.8 with 0.05).

    Args:
        detector: SynchronousSPAD or FreeRunningSPAD.
        afterpulsing: `Afterpulsing` made for the detector's bins and dead time.
        grad: gradient policy; None: that of the detector.

    Raises:
        UnitError: for another dead time or other bins than the detector's, and periods that do not fit the window.
    """

    detector: SynchronousSPAD | FreeRunningSPAD
    takes, gives = ("rate",), "counts"

    def __init__(
        self,
        detector: SynchronousSPAD | FreeRunningSPAD,
        afterpulsing: Afterpulsing,
        *,
        grad: GradPolicy | None = None,
    ) -> None:
        where = "AfterpulsingSPAD"
        own = detector.dead_time_s
        own = float(own.detach()) if isinstance(own, Tensor) else own
        if own is not None and not math.isclose(own, afterpulsing.dead_time_s, rel_tol=1e-6):
            raise UnitError(
                f"{where}: expected the detector's dead time of {own:g} s in afterpulsing, got "
                f"{afterpulsing.dead_time_s:g} s. One detector has one dead time."
            )
        super().__init__(detector, grad)
        self.bin_width_s, self.num_bins = common_bins([detector, afterpulsing], where)
        self.afterpulsing = afterpulsing

    def check_bins(self, x: object) -> None:
        super().check_bins(x)
        self.afterpulsing.check_bins(x)

    def _transfers(self, x: Tensor) -> _Transfers:
        check_transient(x, "AfterpulsingSPAD")
        bins = x.shape[TIME]
        period = self.afterpulsing.period_bins or bins
        if period < bins or (isinstance(self.detector, FreeRunningSPAD) and period != bins):
            raise UnitError(
                f"AfterpulsingSPAD: expected a period of the afterpulses of the window's {bins} bins (or more, of a "
                f"SynchronousSPAD), got {period} bins. Set period_s."
            )
        round_period = torch.fft.rfft(self.afterpulsing.kernel(period).to(x.device))
        if isinstance(self.detector, FreeRunningSPAD) or (self.detector.dead_bins and not self._follows_carriers):
            return round_period, None, period
        same_cycle = torch.fft.rfft(self.afterpulsing.first_kernel(bins).to(x.device), n=2 * bins)
        return round_period, same_cycle, period

    def _from_outside(self, x: Tensor, round_period: Tensor, period: int) -> Tensor | float:
        """Releases of the constant counts outside of the window, per cycle and bin, float64."""
        given = self.afterpulsing.background
        if period == x.shape[TIME] or (not isinstance(given, Tensor) and given == 0):
            return 0.0
        cycles = self.exposure_cycles or cycles_of(self.detector)
        level = over_time(kept_map(self.afterpulsing, "background"), x, "background", "AfterpulsingSPAD")
        all_of_one = round_period[0].real
        ones = torch.ones(1, x.shape[TIME], dtype=torch.float64, device=x.device)
        missing = (all_of_one - filter_rows(ones, round_period, period, 0, x.shape[TIME])).clamp_min(0)
        return missing.view(-1, 1, 1) * level / ((1 - all_of_one) * cycles)

    @property
    def _follows_carriers(self) -> bool:
        """True if each carrier is followed from its detection on."""
        spad = self.detector
        dead = spad.dead_bins is not None if isinstance(spad, SynchronousSPAD) else spad.kind == "non_paralyzable"
        return self.afterpulsing.delays is None and dead

    def _of_armed(self, x: Tensor, transfers: _Transfers, outside: Tensor | float, steps: int) -> Tensor:
        """Releases per cycle, part of a bin and armed detector, float64."""
        module, spad, bins = self.afterpulsing, self.detector, x.shape[TIME]
        if x.numel() == 0:
            return x.double().repeat_interleave(steps, TIME)
        check_rates(x, "AfterpulsingSPAD")
        seen, tau = module.seen().to(x.device), (module.tau_s.reshape(-1) / module.bin_width_s).to(x.device)
        wide = x.double().movedim(TIME, -1)
        rows = wide.reshape(-1, bins)
        if isinstance(spad, SynchronousSPAD):
            dead = torch.as_tensor(spad.dead_bins, dtype=torch.float64, device=x.device)
            given = outside.expand(x.shape).movedim(TIME, -1).reshape(rows.shape) if isinstance(outside, Tensor) else 0

            def earlier(detected: Tensor, at: Tensor) -> Tensor:
                """Releases of other cycles, which are independent of this one."""
                free = _released(detected, transfers)
                return free + given[at] if isinstance(given, Tensor) else free

            gate = None if spad.gate is None else spad.gate.to(x.device)
            found = clocked_hazard(rows, dead, gate, seen, tau, earlier, steps)
        else:
            dead = spad.dead_time_s.to(x.device) / module.bin_width_s
            found = free_running_hazard(rows, dead, seen, tau, steps)
        return found.view(*wide.shape[:-1], steps * bins).movedim(-1, TIME)

    @in_single
    def released(self, x: Tensor) -> Tensor:
        """Rate of carriers that fire an armed detector.

        Args:
            x: rate of photons per cycle and bin, (..., C, T, H, W).

        Returns:
            Per cycle and bin, in shape and dtype of `x`.
        """
        return self._free(x, 1)

    def _free(self, x: Tensor, steps: int) -> Tensor:
        transfers = self._transfers(x)
        outside = self._from_outside(x, transfers[0], transfers[2])
        if self._follows_carriers:
            return self._of_armed(x, transfers, outside, steps).to(x.dtype)
        most = float(self.afterpulsing.kernel(transfers[2]).detach().sum())
        free = torch.zeros_like(x)
        # where all carriers are set free during the dead time, there is nothing to iterate
        rounds = max(1, math.ceil(math.log(_LEFT_INDEPENDENT) / math.log(most)) - 1) if most > _LEFT_INDEPENDENT else 1
        for _ in range(rounds):
            rows = self.detector.probabilities(x + free).movedim(TIME, -1).contiguous().double()
            free = (_released(rows, transfers).movedim(-1, TIME) + outside).to(x.dtype)
        return free

    @in_single
    def rate(self, x: Tensor) -> Tensor:
        """Rate of photons and released carriers.

        Args:
            x: rate of photons per cycle and bin, (..., C, T, H, W).
        """
        return x + self.released(x)

    def _steps(self) -> int:
        """Parts of a bin in which the rate of carriers is constant."""
        if not self._follows_carriers:
            return 1
        seen, tau = self.afterpulsing.seen(), self.afterpulsing.tau_s.detach().reshape(-1)
        tau_bins = float(tau[seen > _FEW].min()) / self.afterpulsing.bin_width_s if bool((seen > _FEW).any()) else 1e9
        return 1 << min(_MOST_STEPS, max(0, math.ceil(math.log2(_STEP / tau_bins))))

    def _in_steps(self, x: Tensor, measure: Callable[[_Detector, Tensor], Tensor]) -> Tensor:
        """`measure(detector, rate)` in parts of bins, added up."""
        steps = self._steps()
        if steps == 1:
            return measure(self.detector, self.rate(x))
        rate = (x / steps).repeat_interleave(steps, TIME) + self._free(x, steps)
        found = measure(_in_parts(self.detector, steps), rate)
        return found.reshape(*x.shape[:TIME], x.shape[TIME], steps, *x.shape[TIME + 1 :]).sum(TIME)

    def probabilities(self, x: Tensor) -> Tensor:
        return self._in_steps(x, lambda spad, rate: spad.probabilities(rate))

    def expected(self, x: Tensor) -> Tensor:
        return self._in_steps(x, lambda spad, rate: spad.expected(rate))

    def variance(self, x: Tensor) -> Tensor:
        return self.detector.variance(self.rate(x))

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        return self.detector.log_prob(measurement, self.rate(x))

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self._in_steps(x, lambda spad, rate: spad.gaussian(rate, generator))

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            return self._in_steps(x, lambda spad, rate: spad.sample(rate, generator))

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self._in_steps(x, lambda spad, rate: spad(rate, generator=generator))


def _released(rows: Tensor, transfers: _Transfers) -> Tensor:
    """Independent releases (..., T) per cycle and bin of detections, float64, without those left out."""
    round_period, same_cycle, period = transfers
    bins = rows.shape[-1]
    free = filter_rows(rows, round_period, period, 0, bins)
    if same_cycle is None:
        return free
    return (free - filter_rows(rows, same_cycle, 2 * bins, 0, bins)).clamp_min(0)


def _in_parts(detector: _Detector, steps: int) -> _Detector:
    """Copy of the detector with bins cut in `steps`."""
    other = copy.copy(detector)
    if other.bin_width_s is not None:
        other.bin_width_s = other.bin_width_s / steps
    if other.num_bins is not None:
        other.num_bins = other.num_bins * steps
    if isinstance(other, SynchronousSPAD):
        if other.dead_bins is not None:
            other.dead_bins = other.dead_bins * steps
        if other.gate is not None:
            other._buffers = {**other._buffers, "gate": other.gate.repeat_interleave(steps)}
    return other
