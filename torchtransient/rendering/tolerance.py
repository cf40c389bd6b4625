"""Renders to a tolerance: numbered passes are averaged until the relative error of the mean is small enough.

Estimate of the error, of ``n`` passes with mean ``x`` and the variance ``V`` of ``passes.py``::

    r = quantile over bins of sqrt(V / n) / <|x|>          never of the mean of a single bin, which may be dark

Where rarer light has been found by few bins only, those with a small variance in the one half of the passes have a
large one in the other: six times larger in the mean is a heavy tail.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, TypeAlias

import torch

from torchtransient.checks import as_number, count, of_class, positive, shown
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.rendering.error_bars import local_mean
from torchtransient.rendering.job import mix_seed
from torchtransient.rendering.output import RenderOutput
from torchtransient.rendering.passes import PassSums, moderated_variance
from torchtransient.rendering.progress import ForecastBar
from torchtransient.tensor_record import same

Loss: TypeAlias = "Callable[[RenderOutput], torch.Tensor]"

_PASS = 0x9A55
# Passes before the first look, and before a look without any light ends the render.
_FIRST_LOOK, _DARK_PASSES = 8, 64
# Aim at this share of the tolerance at most: looking at an estimate until it is small favours those that are too small.
_AIM = 0.95
# The normal deviate that 5 % exceed.
_ONE_SIDED = 1.645
# Passes whose seconds make the forecast.
_RECENT = 15
# Without a mask, bins count whose local mean is at least this share of the mean over all bins.
_LIT = 0.02
# Variance of bins in one half of the passes over that in the half which they were found to be good in, and passes that
# tell it.
_MOST_IN_OTHER_HALF, _ENOUGH_FOR_HALVES = 6.0, 16
# Tail of a loss (see `Tail` of `accuracy`): squared distances before one is looked at, the largest share of one,
# distances before Hill's index is estimated, those that it is estimated from, and its least value.
_FEW_PASSES, _MOST_OF_ONE, _MANY_PASSES, _FURTHEST, _LEAST_INDEX = 24, 1 / 3, 88, 8, 2.0


# ------------------------------------------------------------------------------------------------------------ formulas


def quantile_of(values: torch.Tensor, quantile: float) -> float:
    """Return the smallest of the values that a share ``quantile`` of them does not exceed, NaN without any.

    Args:
        values: tensor of any shape.
        quantile: share of the values, in (0, 1].
    """
    number = values.numel()
    if number == 0:
        return math.nan
    place = min(max(math.ceil(quantile * number), 1), number)
    return float(values.reshape(-1).kthvalue(place).values)


def next_look(passes: int, forecast: float) -> int:
    """Return the number of passes at the next look: those of the forecast, an eighth to as many more.

    Args:
        passes: passes so far.
        forecast: passes that are expected to be needed.
    """
    return math.ceil(min(max(1.05 * forecast, passes + passes / 8), 2.0 * passes))


def share_to_aim_at(freedom: float) -> float:
    """Return the share of the tolerance to aim at, for a variance of so many degrees of freedom.

    Args:
        freedom: degrees of freedom of the variance.

    5 % less than the tolerance, and less by as much as chance hides in one of 20 estimates: the root of the 5 %
    quantile of chi squared over its mean (Wilson and Hilferty 1931).
    """
    if not freedom > 0:
        return 0.05
    part = 2.0 / (9.0 * freedom)
    root = max(1.0 - part - _ONE_SIDED * math.sqrt(part), 0.0)
    share: float = min(_AIM, max(root**1.5, 0.05))
    return share


def is_heavy(squared: list[float]) -> bool:
    """Return True if few passes decide about a variance.

    Args:
        squared: squared distance of each pass from the mean, in any unit.
    """
    total = sum(squared)
    if len(squared) < _FEW_PASSES or not total > 0:
        return False
    if max(squared) > _MOST_OF_ONE * total:
        return True
    furthest = sorted(squared, reverse=True)[: _FURTHEST + 1]
    if len(squared) < _MANY_PASSES or not furthest[-1] > 0:
        return False
    # Hill (1975), of distances: half the logarithm of their squares.
    excess = 0.5 * sum(math.log(one / furthest[-1]) for one in furthest[:-1]) / _FURTHEST
    return excess > 1.0 / _LEAST_INDEX


# -------------------------------------------------------------------------------------------------------------- request


@dataclass(frozen=True)
class Request:
    """Tolerance of a render, checked.

    Args:
        rtol: relative error.
        quantile: share of the bins that keep to it.
        on: mask of bins, loss, or None for the bins with light.
        max_seconds: wall time of the call, None for no limit.
        max_spp: samples per pixel, earlier calls included, None for no limit.

    Raises:
        UnitError, ArgumentError: for other values.
    """

    rtol: float
    quantile: float = 0.9
    on: torch.Tensor | Loss | None = None
    max_seconds: float | None = None
    max_spp: int | None = None

    def __post_init__(self) -> None:
        rtol, quantile = as_number(self.rtol), as_number(self.quantile)
        if rtol is None or not 0 < rtol < 1:
            raise UnitError(f"rtol: expected a relative error between 0 and 1, 0.05 for 5 %, got {shown(self.rtol)}.")
        if quantile is None or not 0 < quantile <= 1:
            raise UnitError(
                f"quantile: expected a share of the bins above 0 and at most 1, got {shown(self.quantile)}."
            )
        object.__setattr__(self, "rtol", rtol)
        object.__setattr__(self, "quantile", quantile)
        if self.max_seconds is not None:
            object.__setattr__(self, "max_seconds", positive("max_seconds", self.max_seconds))
        if self.max_spp is not None:
            object.__setattr__(self, "max_spp", count("max_spp", self.max_spp, error=UnitError))
        on: Any = self.on
        if on is not None and not callable(on):
            object.__setattr__(self, "on", _mask(on))

    @property
    def loss(self) -> Loss | None:
        """The loss, None for a mask."""
        return None if self.on is None or isinstance(self.on, torch.Tensor) else self.on

    def asks_of_the_same(self, other: Request) -> bool:
        """Return whether both ask for the error of the same bins or loss."""
        return self.on is other.on or bool(same(self.on, other.on))

    def is_as(self, other: Request) -> bool:
        """Return whether both ask for the same error."""
        return (self.rtol, self.quantile) == (other.rtol, other.quantile) and self.asks_of_the_same(other)


def _mask(on: Any) -> torch.Tensor:
    try:
        mask = torch.as_tensor(on)
    except (TypeError, ValueError, RuntimeError):
        mask = None
    if mask is None or mask.dtype != torch.bool:
        got = shown(on) if mask is None else f"numbers of {mask.dtype}; write on=mask > 0 or the like"
        raise ArgumentError(
            f"on: expected a mask of truth values that broadcasts to (T, H, W) or (C, T, H, W), or a loss, a function "
            f"of a RenderOutput; got {got}."
        )
    if not bool(mask.any()):
        raise ArgumentError("on: expected a mask that is true somewhere, got one that is false everywhere.")
    return mask.detach().clone()


# ---------------------------------------------------------------------------------------------------------------- looks


@dataclass(frozen=True)
class Look:
    """Estimate of the error after some passes.

    Args:
        passes: number of passes.
        error: relative error; infinite where it is not known, NaN where no bin that counts has light.
        rtol: tolerance.
        freedom: degrees of freedom of the error.
        heavy: few passes or bins decide about the error.
    """

    passes: int
    error: float
    rtol: float
    freedom: float
    heavy: bool

    @property
    def aim(self) -> float:
        """Error to reach: below the tolerance by as much as chance can hide."""
        return self.rtol * share_to_aim_at(self.freedom)

    @property
    def small(self) -> bool:
        """The error is small enough."""
        return self.error <= self.aim

    @property
    def forecast(self) -> float:
        """Number of passes that the aim takes, infinite where it is not known."""
        if not math.isfinite(self.error):
            return math.inf
        wanted = float(self.passes)
        for _ in range(4):  # the aim is higher after more passes
            aim = self.rtol * share_to_aim_at(self.freedom * wanted / self.passes)
            wanted = max(self.passes * (self.error / aim) ** 2, 2.0)
        return wanted


def look(sums: PassSums, request: Request) -> Look:
    """Return the error of the mean of ``sums``.

    Args:
        sums: sums of the passes.
        request: tolerance, and the quantity that it is for.
    """
    if request.loss is not None:
        return _look_at_loss(sums, request.rtol)
    mean = local_mean(sums.mean_bins().abs(), sums.near)
    counted = counted_bins(mean, request.on, sums)
    errors = (sums.variance()[counted] / sums.passes).sqrt_().div_(mean[counted])
    error = quantile_of(errors, request.quantile)
    freedom = (sums.passes - 1.0) * errors.numel()
    heavy = _ratio_of_halves(sums, mean, counted, request.quantile) > _MOST_IN_OTHER_HALF
    return Look(sums.passes, error, request.rtol, freedom, heavy)


def _ratio_of_halves(sums: PassSums, mean: torch.Tensor, counted: torch.Tensor, quantile: float) -> float:
    """Return the relative variance of a half of the passes, in bins that are good in the other half, over theirs."""
    if sums.passes < _ENOUGH_FOR_HALVES or not bool(counted.any()):
        return 1.0
    power, freedom = mean[counted].square_(), sums.passes / 2 - 1
    variances = [moderated_variance(half, freedom, sums.near) for half in sums.variances_of_halves()]
    halves = [variance[counted] / power for variance in variances]
    good = [half <= quantile_of(half, quantile) for half in halves]
    own = sum(float(half[mask].mean()) for half, mask in zip(halves, good, strict=True))
    other = sum(float(half[mask].mean()) for half, mask in zip(halves, reversed(good), strict=True))
    return other / own if own > 0 else 1.0 if other == 0 else math.inf


def _look_at_loss(sums: PassSums, rtol: float) -> Look:
    values, n = sums.losses, sums.passes
    mean = math.fsum(values) / n
    squared = [(value - mean) ** 2 for value in values]
    power = math.fsum(squared)
    if n < 2 or mean == 0:
        return Look(n, math.inf, rtol, n - 1.0, False)
    error = math.sqrt(power / (n - 1) / n) / abs(mean)
    # Variance of a sample variance over its square: 2 / (n - 1) of normal values, more by their excess kurtosis.
    excess = max(n * math.fsum((x / power) ** 2 for x in squared) - 3.0, 0.0) if power > 0 else 0.0
    freedom = 2.0 / (2.0 / (n - 1) + excess / n)
    return Look(n, error, rtol, freedom, is_heavy(squared))


def counted_bins(mean: torch.Tensor, on: Any, sums: PassSums) -> torch.Tensor:
    """Return the mask of bins that count.

    Args:
        mean: local means of the bins, (..., T, H, W).
        on: mask of a user that broadcasts to it or to (C, T, H, W), or None.
        sums: sums of the passes.

    Raises:
        ShapeError: for a mask of another shape.
    """
    if on is None:
        bins = tuple(range(sums.leading, mean.ndim))
        return mean > _LIT * mean.mean(dim=bins, keepdim=True)
    place = sums.leading
    with_channels = (*mean.shape[:place], len(sums.channels), *mean.shape[place:])
    mask = on.to(mean.device)
    for shape in (tuple(mean.shape), with_channels):
        try:
            wide = mask.broadcast_to(shape)
        except RuntimeError:
            continue
        found: torch.Tensor = (wide if wide.ndim == mean.ndim else wide.any(dim=place)) & (mean > 0)
        return found
    raise ShapeError(
        f"on: expected a mask that broadcasts to {tuple(mean.shape)} or, with channels, {with_channels}, got "
        f"{tuple(on.shape)}."
    )


# ------------------------------------------------------------------------------------------------------------- the loop


@dataclass(frozen=True)
class ToleranceState:
    """State from which ``renderer.to_tolerance(resume=...)`` goes on.

    Args:
        sums: sums over passes.
        request: tolerance of the last call.
        next_look: number of passes at which the error is looked at next.
        met_at: passes at which the error was small first, with a heavy tail; 0 before.
        ended: the last call ended by itself: the error was small, or passes were no use.
    """

    sums: PassSums
    request: Request
    next_look: int
    met_at: int
    ended: bool


@dataclass(frozen=True, eq=False)
class ToleranceResult:
    """Mean of as many passes as a tolerance takes, and its error. Made by ``renderer.to_tolerance``.

    Attributes:
        output: the mean, as a render; ``output.stats`` has samples, seconds and seeds of all passes.
        error: relative error that was asked for: the quantile over bins that was reached, or that of the loss.
            Infinite after a single pass, NaN without light.
        reached: the error is below the tolerance, and passes do not tell of one that is larger.
        reason: why the render has ended, in words.
        passes, spp: number of passes, and their samples per pixel together.
        seconds: wall time, of all calls together.
        rtol, quantile: relative error and share of the bins that were asked for.
        heavy_tailed: few passes hold most of the deviations: the error may be larger than it looks.
        standard_error: standard error of the mean in each bin (..., T, H, W), float32: channels averaged (S0 of
            polarized light), drawn to that of the neighbours; of phasors the root of the summed variances of real and
            imaginary parts.
        looks: estimates on the way, one after the other.
        state: sums of the passes, for ``resume``.
    """

    _: KW_ONLY
    output: RenderOutput
    error: float
    reached: bool
    reason: str
    passes: int
    spp: int
    seconds: float
    rtol: float
    quantile: float
    heavy_tailed: bool
    standard_error: torch.Tensor
    looks: tuple[Look, ...]
    state: ToleranceState

    def __repr__(self) -> str:
        made = f"{self.passes} passes, {self.spp} spp, {self.seconds:.3g} s"
        return f"ToleranceResult(error={self.error:.3g}, rtol={self.rtol:g}, reached={self.reached}, {made})"


def render_to_tolerance(
    render: Callable[[int], RenderOutput],
    sums: PassSums,
    request: Request,
    *,
    resume: ToleranceResult | None = None,
    progress: bool = True,
) -> ToleranceResult:
    """Average passes until their error is small.

    Args:
        render: function of a seed that returns a pass.
        sums: sums to begin with, without passes.
        request: tolerance.
        resume: result to go on from, in place of ``sums``; of the same render.
        progress: show a bar.

    Returns:
        The mean and its error.

    Raises:
        ArgumentError: if ``resume`` is of another render or lacks the values of the loss.
        UnitError: if ``max_spp`` is less than a pass.
        ShapeError: for a mask of another shape, and a loss that is no scalar.
    """
    first = ToleranceState(sums, request, _FIRST_LOOK, 0, False)
    state = first if resume is None else _goes_on(resume, sums, request)
    if request.max_spp is not None and request.max_spp < sums.batch_spp:
        raise UnitError(
            f"max_spp: expected at least the {sums.batch_spp} samples per pixel of one pass, got {request.max_spp}; "
            "batch_spp= makes passes smaller."
        )
    looks = list(resume.looks) if resume is not None and request.is_as(resume.state.request) else []
    loop = _Loop(render, state, looks)
    bar = ForecastBar("tolerance") if progress else None
    try:
        reason = loop.run(bar)
    finally:
        if bar is not None:
            bar.close()
    return loop.result(reason)


def _goes_on(resume: ToleranceResult, new: PassSums, request: Request) -> ToleranceState:
    """Return the state of a result for another call."""
    before = of_class("resume", resume, ToleranceResult, hint="; give what to_tolerance has returned").state
    old = before.sums
    mine_of = {"seed": new.seed, "batch_spp": new.batch_spp, "film": new.film, **new.settings}
    theirs_of = {"seed": old.seed, "batch_spp": old.batch_spp, "film": old.film, **old.settings}
    for name, mine in mine_of.items():
        theirs = theirs_of.get(name)
        if mine != theirs:
            raise ArgumentError(
                f"resume: expected a result with the {name} of this call, {shown(mine)}, got one with {shown(theirs)}; "
                f"give the same {name}, or begin anew."
            )
    if not same(new.values, old.values):
        raise ArgumentError(
            "resume: expected a result of the same values, got one of others, whose passes have another mean; begin "
            "anew, or give the values of the first call."
        )
    alike = request.asks_of_the_same(before.request)
    if request.loss is not None and not alike:
        raise ArgumentError(
            "resume: expected a result with the same loss (on=), whose value is needed for each of its passes; begin "
            "anew, or go on without a loss."
        )
    sums = old.copy()
    if before.request.loss is not None and request.loss is None:
        sums.losses = []
    if request.is_as(before.request) and not before.ended:
        return replace(before, sums=sums, request=request)
    return ToleranceState(sums, request, max(sums.passes, 2), 0, False)


class _Loop:
    """One call: passes, looks, and what ends it."""

    def __init__(self, render: Callable[[int], RenderOutput], state: ToleranceState, looks: list[Look]) -> None:
        self.render, self.sums, self.request, self.looks = render, state.sums, state.request, looks
        self.next_look, self.met_at, self.ended = state.next_look, state.met_at, False
        self.begin, self.before = time.perf_counter(), state.sums.seconds
        self.pass_seconds: list[float] = []

    def run(self, bar: ForecastBar | None) -> str:
        """Render, and return why it ended."""
        try:
            while True:
                if self.sums.passes >= self.next_look:
                    reason = self._look()
                    if reason:
                        self.ended = True
                        return reason
                if reason := self._limit():
                    return reason
                self._one_pass()
                if bar is not None:
                    bar.show(*self._forecast())
        except KeyboardInterrupt:
            if self.sums.passes == 0:
                raise
            return "interrupted"

    def _one_pass(self) -> None:
        sums, start = self.sums, time.perf_counter()
        out = self.render(mix_seed(sums.seed, _PASS + sums.passes))
        sums.add(out, None if self.request.loss is None else _number_of(self.request.loss, out))
        if sums.passes == 1 and self.request.loss is None:
            counted_bins(sums.mean_bins().abs(), self.request.on, sums)  # a mask of another shape ends here
        self.pass_seconds.append(time.perf_counter() - start)

    def _look(self) -> str:
        """Look at the error; return the reason to end, empty to go on."""
        found = look(self.sums, self.request)
        n = found.passes
        if not self.looks or self.looks[-1].passes != n:
            self.looks.append(found)
        self.next_look = next_look(n, found.forecast)
        if found.small and not found.heavy:
            return "reached"
        if found.small:
            self.met_at = self.met_at or n
            if n >= 2 * self.met_at:
                return "heavy tailed"
        if math.isnan(found.error) and n >= _DARK_PASSES:
            return "no light"
        return ""

    def _limit(self) -> str:
        sums, request = self.sums, self.request
        if request.max_spp is not None and (sums.passes + 1) * sums.batch_spp > request.max_spp:
            return "max_spp"
        if request.max_seconds is not None and sums.passes and self.pass_seconds:
            elapsed = time.perf_counter() - self.begin
            if elapsed + self._seconds_per_pass() > request.max_seconds:
                return "max_seconds"
        return ""

    def _seconds_per_pass(self) -> float:
        # The first one compiles.
        recent = self.pass_seconds[1:][-_RECENT:] or self.pass_seconds
        return statistics.median(recent)

    def _forecast(self) -> tuple[float, str]:
        """Return the share that is done, and error, target and remaining time as text."""
        request, n = self.request, self.sums.passes
        last, elapsed = self.looks[-1] if self.looks else None, time.perf_counter() - self.begin
        in_time = math.inf if request.max_seconds is None else max(request.max_seconds - elapsed, 0.0)
        target = f"target {request.rtol:.3g}"
        if last is None or not math.isfinite(last.forecast):
            return 0.0, f"{target}, {n} passes"
        wanted = max(last.forecast, n + 1.0)
        if request.max_spp is not None:
            wanted = min(wanted, max(request.max_spp / self.sums.batch_spp, n))
        left = min((wanted - n) * self._seconds_per_pass(), in_time)
        error = last.error * math.sqrt(last.passes / n)
        done = elapsed / (elapsed + left) if math.isfinite(in_time) else n / wanted
        return done, f"error {error:.3g}, {target}, {_duration(left)} left"

    def result(self, kind: str) -> ToleranceResult:
        """Return the result of an end of this kind."""
        sums, request = self.sums, self.request
        sums.seconds = self.before + time.perf_counter() - self.begin
        found = look(sums, request)
        if not self.looks or self.looks[-1].passes != found.passes:
            self.looks.append(found)
        reached = found.small and not found.heavy
        error = (sums.variance() / sums.passes).sqrt_().float()
        return ToleranceResult(
            output=sums.output(),
            error=found.error,
            reached=reached,
            reason=_reason("reached" if reached else kind, found, request, sums),
            passes=sums.passes,
            spp=sums.spp,
            seconds=sums.seconds,
            rtol=request.rtol,
            quantile=request.quantile,
            heavy_tailed=found.heavy,
            standard_error=error,
            looks=tuple(self.looks),
            state=ToleranceState(sums, request, self.next_look, self.met_at, self.ended or reached),
        )


def _number_of(loss: Loss, out: RenderOutput) -> float:
    value: Any = loss(out)
    number = as_number(value.detach() if isinstance(value, torch.Tensor) else value)
    if number is None and isinstance(value, torch.Tensor) and value.numel() == 1:
        number = as_number(value.detach().reshape(()))
    if number is None:
        raise ShapeError(f"on: expected a loss that returns one number, got {shown(value)}; sum or average it.")
    if not math.isfinite(number):
        raise UnitError(f"on: expected a loss that is finite for every pass, got {number}.")
    return number


def _reason(kind: str, found: Look, request: Request, sums: PassSums) -> str:
    """Return the reason of an end as a sentence."""
    error = f"error {found.error:.3g} after {found.passes} passes"
    if kind == "reached":
        return f"{error}, tolerance {request.rtol:g}"
    if kind == "no light":
        return f"no light in what was asked for in {found.passes} passes: nothing to be relative to"
    named = {"max_spp": request.max_spp, "max_seconds": request.max_seconds}
    limit = f"{kind}={named[kind]:g}" if named.get(kind) else kind
    if found.heavy:
        said = "" if kind == "heavy tailed" else ", heavy tailed"
        return (
            f"{limit}: {error} is not to be trusted{said}: few bins, or few passes, hold most of the deviations, and "
            "rare light is still missing in the others. More samples help, or a sampling that finds it"
        )
    if not math.isfinite(found.forecast):
        return f"{limit}: {error}"
    more = max(math.ceil(found.forecast) - found.passes, 1)
    return f"{limit}: {error}, about {more * sums.batch_spp} samples per pixel more for {request.rtol:g}"


def _duration(seconds: float) -> str:
    """Return "1:05" and "2:03:00"."""
    minutes, rest = divmod(math.ceil(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
