"""Pixels that are late: delays of signal trees and optics, pixel by pixel, to fractions of a bin.

Light is spread evenly over a bin, so that a delay of m + f bins takes a share 1 - f of it to the bin m later and f to
the one after that.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from torchtransient.axes import TimeAxis
from torchtransient.floating import in_single
from torchtransient.sensing.added_counts import is_whole
from torchtransient.sensing.layout import TIME, bin_width_of, check_seconds, check_transient
from torchtransient.sensing.pixel_maps import check_map, pixels_of
from torchtransient.sensing.policies import GradPolicy, gaussian_noise, record_score, straight_through
from torchtransient.sensing.sensor import PhysicalModule, RandomSensor, Sensor
from torchtransient.sensing.thinning import halve
from torchtransient.sensing.time_convolution import check_choice

Boundary = Literal["periodic", "zero"]


def _whole_and_part(delay_bins: Tensor | float, x: Tensor) -> tuple[Tensor, Tensor]:
    """Whole bins (int64) and the rest, differentiable, over the time of `x`: (..., 1, H, W) or ()."""
    delay = torch.as_tensor(delay_bins, dtype=torch.float64, device=x.device)
    delay = delay.unsqueeze(TIME) if delay.ndim >= 2 else delay
    whole = delay.detach().floor()
    # less than a rounding below a whole bin is that bin: 1 - 1e-30 is 1, and no share of a bin
    whole = whole + (delay.detach() - whole >= 1).to(whole)
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

    def bins(self, x: Tensor, where: str) -> Tensor:
        """(..., C, H, W) or (), float64, checked against the pixels of `x`."""
        pixels_of(self.delay_ps, x, "delay_s", where)
        return self.delay_ps.double() * (1e-12 / self.bin_width_s)


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

    def extra_repr(self) -> str:
        return f"delays={tuple(self.delays.delay_ps.shape)}, boundary={self.boundary!r}"


class DetectionSkew(RandomSensor):
    """Detections (counts) of every pixel later by a delay of its own: a signal tree, a converter that starts late.

    Draws move whole counts one by one: each of a bin goes to the earlier or the later of the two bins that its delay
    reaches, a binomial number. Counts that are not whole are means of another sensor, and are moved as `expected` does.
    Arguments as of `PixelSkew`. Policies: all four. "gaussian" has the covariance of the binomials; "score" the
    probabilities of the moves that were drawn, for learnable delays, while the counts given pass with the gradient of
    the mean.
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

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        whole, part = _whole_and_part(self._delay_bins(x), x)
        late = gaussian_noise(x * (part * (1 - part)).to(x.dtype), generator)
        noise = _moved(late, whole + 1, self.boundary) - _moved(late, whole, self.boundary)
        return self.expected(x) + noise

    def _drawn(self, x: Tensor, generator: torch.Generator | None) -> tuple[Tensor, Tensor | None]:
        """The counts moved, and how many of each bin went to the later one; None where there are means to move."""
        with torch.no_grad():
            delay = self._delay_bins(x)
            work = x.detach().contiguous()
            if not is_whole(work):
                return shift_time(work, delay, boundary=self.boundary), None
            whole, part = _whole_and_part(delay, x)
            late = halve(work, part.to(work.dtype).expand(work.shape).contiguous(), generator)
            moved = _moved(work - late, whole, self.boundary) + _moved(late, whole + 1, self.boundary)
            return moved, late

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self._drawn(x, generator)[0]

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if self.grad != "score":
            return super().forward(x, generator)
        moved, late = self._drawn(x, generator)
        if late is None:
            return self.expected(x)
        if not torch.is_grad_enabled():
            return moved
        _, part = _whole_and_part(self._delay_bins(x), x)

        def log_prob() -> Tensor:
            # no count takes a way of probability 0
            tiny = torch.finfo(torch.float64).tiny
            ways = late.double() * part.clamp_min(tiny).log() + (x.detach() - late).double() * torch.log1p(-part)
            return ways.sum(TIME)

        if part.requires_grad:
            record_score(log_prob, type(self).__name__)
        with torch.no_grad():
            fixed = self._delay_bins(x)
        return straight_through(moved, shift_time(x, fixed, boundary=self.boundary)) if x.requires_grad else moved

    def extra_repr(self) -> str:
        return f"delays={tuple(self.delays.delay_ps.shape)}, boundary={self.boundary!r}, {super().extra_repr()}"
