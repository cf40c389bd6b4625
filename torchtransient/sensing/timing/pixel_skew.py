"""Pixels that are late: delays of signal trees and optics, pixel by pixel, to fractions of a bin.

Light is spread evenly over a bin, so that a delay of m + f bins takes a share 1 - f of it to the bin m later and f to
the one after that.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchtransient.axes import TimeAxis
from torchtransient.floating import in_single
from torchtransient.sensing.base.layout import (
    TIME,
    bin_width_of,
    check_choice,
    check_seconds,
    check_transient,
    number_or_tensor,
)
from torchtransient.sensing.base.pixel_maps import check_map, pixels_of
from torchtransient.sensing.base.policies import GradPolicy, gaussian_noise
from torchtransient.sensing.base.sensor import PhysicalModule, Sensor
from torchtransient.sensing.counts.moved_counts import MovedCounts
from torchtransient.sensing.numerics.draws import halve
from torchtransient.sensing.numerics.time_convolution import Boundary


def _whole_and_part(delay_bins: Tensor | float, x: Tensor) -> tuple[Tensor, Tensor]:
    """Whole bins (int64) and the rest, differentiable, over the time of `x`: (..., 1, H, W) or ()."""
    delay = torch.as_tensor(delay_bins, dtype=torch.float64, device=x.device)
    delay = delay.unsqueeze(TIME) if delay.ndim >= 2 else delay
    whole = delay.floor()
    # less than a rounding below a whole bin is that bin: 1 - 1e-30 is 1, and no share of a bin
    whole = whole + (delay - whole >= 1).to(whole)
    return whole.long(), delay - whole


def _moved(x: Tensor, whole: Tensor, boundary: Boundary) -> Tensor:
    """`x` (..., T, H, W) by whole bins, pixel by pixel."""
    bins = x.shape[TIME]
    source = torch.arange(bins, device=x.device).view(-1, 1, 1) - whole
    inside = (source >= 0) & (source < bins)
    moved = x.gather(TIME, (source % bins).expand(x.shape))
    return moved if boundary == "periodic" else moved * inside.to(x.dtype)


@in_single
def shift_time(x: Tensor, delay_bins: Tensor | float, *, boundary: Boundary = "periodic") -> Tensor:
    """(..., C, T, H, W) later by `delay_bins`, a number or a map that broadcasts to (..., C, H, W); below 0 earlier.

    "periodic": the window is one laser period, sums are conserved and constant light stays constant. "zero": what
    leaves the window is lost and nothing comes in. Differentiable in `x` and in the delays (piecewise linear); dtype
    and device of `x` are kept, half precision gives float32. Raises ShapeError for maps of other images.
    """
    check_transient(x, "shift_time")
    check_choice(boundary, Boundary, "boundary", "shift_time")
    delay_bins = number_or_tensor(delay_bins, "delay_bins", "shift_time")
    pixels_of(delay_bins, x, "delay_bins", "shift_time")
    if x.numel() == 0:
        return x
    whole, part = _whole_and_part(delay_bins, x)
    first = _moved(x, whole, boundary)
    return first + part.to(x.dtype) * (_moved(x, whole + 1, boundary) - first)


class _Delays(PhysicalModule):
    """The delays of pixels, in picoseconds, which is what a learning rate can be chosen for."""

    delay_ps: Tensor

    def __init__(self, delay_s: float | Tensor, bin_width_s: float, learnable: bool, where: str) -> None:
        super().__init__()
        given = check_map(delay_s, "delay_s", where, low=-1.0, high=1.0)
        delay = torch.as_tensor(given, dtype=torch.float64).detach()
        if delay.numel():
            check_seconds(float(delay.abs().max()), "delay_s", where)
        self.bin_width_s = bin_width_s
        if learnable:
            self.register_parameter("delay_ps", nn.Parameter(delay * 1e12))
        else:
            self.register_buffer("delay_ps", delay * 1e12)

    @property
    def delay_s(self) -> Tensor:
        """Delay of all pixels, or of every one, in seconds."""
        return self.delay_ps.double() * 1e-12

    def bins(self, x: Tensor, where: str) -> Tensor:
        """(..., C, H, W) or (), float64, checked against the pixels of `x`."""
        pixels_of(self.delay_ps, x, "delay_s", where)
        return self.delay_ps.double() * (1e-12 / self.bin_width_s)


@dataclass(frozen=True)
class Delayed:
    """Counts of every pixel later by `whole` bins, and a share `part` of them by one more: (..., 1, H, W) or ()."""

    whole: Tensor
    part: Tensor
    boundary: Boundary

    @property
    def learned(self) -> bool:
        return self.part.requires_grad

    def detached(self) -> Delayed:
        return Delayed(self.whole, self.part.detach(), self.boundary)

    def mean(self, x: Tensor) -> Tensor:
        first = _moved(x, self.whole, self.boundary)
        moved: Tensor = first + self.part.to(x.dtype) * (_moved(x, self.whole + 1, self.boundary) - first)
        return moved

    def noise(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        late = gaussian_noise(x * (self.part * (1 - self.part)).to(x.dtype), generator)
        return _moved(late, self.whole + 1, self.boundary) - _moved(late, self.whole, self.boundary)

    def draw(self, counts: Tensor, generator: torch.Generator | None, tally: bool) -> tuple[Tensor, Tensor | None]:
        """Each goes to the earlier or the later bin; tallies are (2, ..., H, W)."""
        counts = counts.contiguous()
        late = halve(counts, self.part.to(counts.dtype).expand(counts.shape).contiguous(), generator)
        early = counts - late
        moved = _moved(early, self.whole, self.boundary) + _moved(late, self.whole + 1, self.boundary)
        return moved, torch.stack([early.sum(TIME), late.sum(TIME)]) if tally else None

    def log_prob(self, tallies: Tensor) -> Tensor:
        early, late = tallies.double()
        part = self.part.squeeze(TIME) if self.part.ndim else self.part
        # no count takes a way of probability 0
        tiny = torch.finfo(torch.float64).tiny
        ways: Tensor = late * part.clamp_min(tiny).log() + early * torch.log1p(-part)
        return ways


class PixelSkew(Sensor):
    """Light or rates of every pixel later by a delay of its own; see `shift_time`. Deterministic, linear in the light.

    In front of the detector: paths of different lengths, a fibre array, a shutter that runs over the rows. What comes
    late by its electronics is a `DetectionSkew`, behind it. `delay_s`: a number or a map (H, W) or what broadcasts to
    (..., C, H, W), seconds, of either sign. `learnable`: `delays.delay_ps` is a parameter, in picoseconds.

    Raises UnitError for a millisecond or more (picoseconds?), ShapeError for maps of other images.
    """

    gives = "the same"

    def __init__(
        self,
        delay_s: float | Tensor,
        axis: TimeAxis | None = None,
        *,
        bin_width_s: float | None = None,
        boundary: Boundary = "periodic",
        learnable: bool = False,
    ) -> None:
        super().__init__()
        where = "PixelSkew"
        check_choice(boundary, Boundary, "boundary", where)
        self.boundary: Boundary = boundary
        self.bin_width_s = bin_width_of(axis, bin_width_s, where)
        self.num_bins = None if axis is None else axis.num_bins
        self.delays = _Delays(delay_s, self.bin_width_s, learnable, where)

    def expected(self, x: Tensor) -> Tensor:
        check_transient(x, "PixelSkew")
        return shift_time(x, self.delays.bins(x, "PixelSkew"), boundary=self.boundary)


class DetectionSkew(MovedCounts):
    """Detections (counts) of every pixel later by a delay of its own: a signal tree, a converter that starts late.

    Draws move whole counts one by one: each of a bin goes to the earlier or the later of the two bins that its delay
    reaches, a binomial number. Arguments as of `PixelSkew`; policies as of `MovedCounts`, the score that of learnable
    delays. Raises UnitError, ShapeError as `PixelSkew`, and UnitError for draws of NaN or infinity.
    """

    takes, gives = ("counts",), "counts"

    def __init__(
        self,
        delay_s: float | Tensor,
        axis: TimeAxis | None = None,
        *,
        bin_width_s: float | None = None,
        boundary: Boundary = "periodic",
        learnable: bool = False,
        grad: GradPolicy = "expected",
    ) -> None:
        super().__init__(grad)
        where = "DetectionSkew"
        check_choice(boundary, Boundary, "boundary", where)
        self.boundary: Boundary = boundary
        self.bin_width_s = bin_width_of(axis, bin_width_s, where)
        self.num_bins = None if axis is None else axis.num_bins
        self.delays = _Delays(delay_s, self.bin_width_s, learnable, where)

    def _delay_bins(self, x: Tensor) -> Tensor:
        check_transient(x, "DetectionSkew")
        return self.delays.bins(x, "DetectionSkew")

    def expected(self, x: Tensor) -> Tensor:
        delay = self._delay_bins(x)
        return shift_time(x, delay, boundary=self.boundary)

    def variance(self, x: Tensor) -> Tensor:
        whole, part = _whole_and_part(self._delay_bins(x), x)
        split = x * (part * (1 - part)).to(x.dtype)
        return _moved(split, whole, self.boundary) + _moved(split, whole + 1, self.boundary)

    def moves(self, x: Tensor) -> Delayed:
        whole, part = _whole_and_part(self._delay_bins(x), x)
        return Delayed(whole, part, self.boundary)
