"""Passes of a render: their seeds, their size, sums over them, and the variance of each bin.

From ``n`` passes with sample variance ``s^2`` in each bin, channels averaged::

    V = (f s^2 + 8 <s^2>) / (f + 8)                        <.>: mean over 3 x 3 pixels, and 3 bins of time
    f = 2 <(a + b)^2> / <(a - b)^2>, from 1 to n - 1       a, b: s^2 of the passes of even, and of odd number

``f`` are the degrees of freedom that ``s^2`` has: ``n - 1`` of normal values, the number of events where light is rare,
and most bins have not seen theirs (with ``f = n - 1`` the error behind glass is half of what it is).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import torch

from torchtransient.plugins.guards import interrupts_wait
from torchtransient.rendering.error_bars import local_mean
from torchtransient.rendering.film_layout import FilmLayout
from torchtransient.rendering.output import RenderOutput, RenderStats
from torchtransient.scene.variant import stokes_components

# Degrees of freedom that the neighbours' variance counts for.
_NEIGHBORS = 8
# A pass has at least so many samples per pixel, and up to so many where fewer make no 2^16 paths: a call has costs of
# its own (benchmarks/tolerance.py), and points of "owen" pay in numbers.
_SMALLEST_BATCH, _LARGEST_BATCH, _PATHS = {"owen": 16}, 256, 2**16


def samples_of_pass(sampler: str, pixels: int) -> int:
    """Return the samples per pixel of a pass, a power of two.

    Args:
        sampler: plugin name.
        pixels: number of pixels of a film.
    """
    least = _SMALLEST_BATCH.get(sampler, 8)
    return max(least, min(_LARGEST_BATCH, 2 ** round(math.log2(_PATHS / pixels)) if pixels < _PATHS else 1))


def moderated_variance(variance: torch.Tensor, freedom: torch.Tensor | float, dims: tuple[int, ...]) -> torch.Tensor:
    """Return sample variances, of so many degrees of freedom, drawn to the mean of neighbours along ``dims``.

    Args:
        variance: sample variances, any shape.
        freedom: degrees of freedom, broadcastable.
        dims: dimensions with neighbours.

    Returns:
        The shape of ``variance``.
    """
    moderated: torch.Tensor = (variance * freedom).add_(local_mean(variance, dims), alpha=_NEIGHBORS)
    return moderated.div_(freedom + _NEIGHBORS)


def freedom_of_halves(even: torch.Tensor, odd: torch.Tensor, passes: int, dims: tuple[int, ...]) -> torch.Tensor:
    """Return the degrees of freedom of sample variances, of which two halves of the passes have ``even`` and ``odd``.

    Args:
        even, odd: sample variances of both halves, of one shape.
        passes: number of all passes.
        dims: dimensions with neighbours.

    The variance of a sample variance over its square is 2 / freedom.
    """
    apart, both = local_mean((even - odd).square_(), dims), local_mean((even + odd).square_(), dims)
    found: torch.Tensor = both.mul_(2.0).div_(apart)
    return found.nan_to_num_(nan=passes - 1.0, posinf=passes - 1.0).clamp_(1.0, max(passes - 1.0, 1.0))


# ----------------------------------------------------------------------------------------------------------------- sums


@dataclass
class PassSums:
    """Sums over passes, in double precision: all numbers that an estimate needs, and a later call to go on.

    Args:
        seed, batch_spp: seed of the render, and samples per pixel of a pass.
        film: layout of the film.
        settings: variant, sampler and others by name, which all passes have in common.
        values: tensors that were rendered, by key.
        passes, seconds: number of passes, and their wall time.
        measured, steady: sums of the film's measurements, and of steady images.
        odd: sum over passes of odd number in bins (..., T, H, W), channels averaged.
        squares: sums of squared magnitudes in bins, of passes of even and of odd number.
        stats, channels: statistics of all passes together, and names of the channels.
        losses: value of the loss for each pass, where there is one.
    """

    seed: int
    batch_spp: int
    film: FilmLayout
    settings: dict[str, Any]
    values: dict[str, torch.Tensor]
    passes: int = 0
    seconds: float = 0.0
    measured: torch.Tensor | None = None
    steady: torch.Tensor | None = None
    odd: torch.Tensor | None = None
    squares: tuple[torch.Tensor, torch.Tensor] | None = None
    stats: RenderStats | None = None
    channels: tuple[str, ...] = ()
    losses: list[float] = field(default_factory=list)

    def copy(self) -> PassSums:
        """Return sums that can be added to."""
        found = {one.name: getattr(self, one.name) for one in fields(self)}
        for name in ("measured", "steady", "odd"):
            found[name] = found[name].clone()
        even, odd = _filled(self.squares)
        return PassSums(**{**found, "squares": (even.clone(), odd.clone()), "losses": list(self.losses)})

    def add(self, out: RenderOutput, loss: float | None) -> None:
        """Add a pass, and the value of its loss.

        Args:
            out: render of the pass.
            loss: value of the loss, None without one.
        """
        measured = self.film.tensor(out)
        assert measured is not None  # a layout finds the tensor of its own film
        bins = _channel_mean(measured, out.steady.ndim - 3, out.polarized)
        squared, number = bins.abs().square_(), self.passes % 2
        with interrupts_wait():
            if self.measured is None or self.steady is None or self.odd is None or self.squares is None:
                self.measured, self.steady = _wide(measured), _wide(out.steady)
                self.odd, self.squares = torch.zeros_like(bins), (squared, torch.zeros_like(squared))
            else:
                self.measured += measured
                self.steady += out.steady
                self.squares[number].add_(squared)
                if number:
                    self.odd += bins
            self.losses += [] if loss is None else [loss]
            self.stats = out.stats if self.stats is None else _stats_of_both(self.stats, out.stats)
            self.channels, self.passes = out.channels, self.passes + 1

    @property
    def spp(self) -> int:
        """Samples per pixel of all passes together."""
        return _filled(self.stats).spp

    @property
    def leading(self) -> int:
        """Number of dimensions of batch and sensor."""
        steady, stats = _filled(self.steady), _filled(self.stats)
        return steady.ndim - 3 - (stokes_components(stats.variant) > 1)

    @property
    def near(self) -> tuple[int, ...]:
        """Dimensions of bins along which neighbours are alike: rows, columns, and bins of time."""
        return (self.leading, -2, -1) if self.film.has_bins else (-2, -1)

    def mean_bins(self) -> torch.Tensor:
        """Return the mean of the passes in bins (..., T, H, W), channels averaged."""
        polarized = stokes_components(_filled(self.stats).variant) > 1
        return _channel_mean(_filled(self.measured), _filled(self.steady).ndim - 3, polarized).div_(self.passes)

    def variance(self) -> torch.Tensor:
        """Return the moderated variance of one pass in each bin; infinite after a single pass."""
        even, odd = _filled(self.squares)
        n = self.passes
        if n < 2:
            return torch.full_like(even, math.inf)
        freedom: torch.Tensor | float = n - 1.0
        if n >= 4:
            freedom = freedom_of_halves(*self.variances_of_halves(), n, self.near)
        return moderated_variance(_sample_variance(self.mean_bins(), even + odd, n), freedom, self.near)

    def variances_of_halves(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the sample variances of a pass of even and of odd number in each bin, of four passes and more."""
        (even, odd), n = _filled(self.squares), self.passes // 2
        of_odd = _filled(self.odd)
        of_even = self.mean_bins().mul_(self.passes).sub_(of_odd).div_(self.passes - n)
        return _sample_variance(of_even, even, self.passes - n), _sample_variance(of_odd / n, odd, n)

    def output(self) -> RenderOutput:
        """Return the mean of the passes as a render."""
        measured, steady = _filled(self.measured) / self.passes, _filled(self.steady) / self.passes
        narrow = torch.complex64 if measured.is_complex() else torch.float32
        stats = _filled(self.stats)
        return RenderOutput.of(self.film, steady.float(), measured.to(narrow), stats=stats, channels=self.channels)


_Filled = TypeVar("_Filled")


def _filled(value: _Filled | None) -> _Filled:
    """Return a value that the first pass has made."""
    assert value is not None
    return value


def _sample_variance(mean: torch.Tensor, squares: torch.Tensor, passes: int) -> torch.Tensor:
    deviations: torch.Tensor = squares - mean.abs().square_().mul_(passes)
    return deviations.clamp_(min=0.0).div_(passes - 1)


def _wide(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.to(torch.complex128 if tensor.is_complex() else torch.float64, copy=True)


def _channel_mean(measured: torch.Tensor, channel: int, polarized: bool) -> torch.Tensor:
    """Return the mean over channels in double precision, of polarized light that of S0."""
    if polarized:
        channel, measured = channel - 1, measured.select(channel - 1, 0)
    # `mean` takes ten times as long over a dimension that is last in the film's memory.
    first, *rest = measured.unbind(channel)
    total = _wide(first)
    for one in rest:
        total += one
    mean: torch.Tensor = total.div_(1 + len(rest))
    return mean


def _stats_of_both(sums: RenderStats, more: RenderStats) -> RenderStats:
    """Return the statistics of a mean and one pass more: samples, seconds and seeds of both, mean energies."""
    seconds, paths = sums.seconds + more.seconds, sums.samples_per_second * sums.seconds
    share = more.spp / (sums.spp + more.spp)

    def mean(name: str) -> tuple[float, ...]:
        pairs = zip(getattr(sums, name), getattr(more, name), strict=True)
        return tuple(a + (b - a) * share for a, b in pairs)

    return replace(
        more,
        spp=sums.spp + more.spp,
        seconds=seconds,
        samples_per_second=(paths + more.samples_per_second * more.seconds) / seconds,
        seeds=sums.seeds + more.seeds,
        energy_before=mean("energy_before"),
        energy_after=mean("energy_after"),
        energy_total=mean("energy_total"),
    )
