"""Time stamps: jitter of detections and sweeps, delays of pixels, time-to-digital converters.

Light is spread evenly over a bin, so that a delay of m + f bins takes a share 1 - f of it to the bin m later and f to
the one after that.

Source: Cottini, Gatti, Svelto, A new method for analog to digital conversion (Nuclear Instruments and Methods 24,
1963), the sliding scale.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from torchtransient.axes import TimeAxis
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import in_single
from torchtransient.sensing.checks import (
    TIME,
    bins_from,
    check_choice,
    check_count,
    check_number,
    check_seconds,
    check_transient,
    reals,
)
from torchtransient.sensing.counts import MovedCounts, Moves, shifted
from torchtransient.sensing.draws import halve
from torchtransient.sensing.parameters import check_map, keep_number, pixels_of
from torchtransient.sensing.responses import FWHM_PER_SIGMA, Response, WithinBin, kernel_of, normal_integral
from torchtransient.sensing.sensor import GradPolicy, PhysicalModule, RandomSensor, Sensor, gaussian_noise
from torchtransient.sensing.time_convolution import Boundary, convolve_time, window_lags


class DetectionJitter(MovedCounts):
    """Move every detection of counts (..., C, T, H, W) by a random delay.

    Jitter of the detector and of the timing electronics acts on what is detected: it stands behind pile-up and dead
    time, which know only when photons arrived. In front of them it would let detections pile up at times at which none
    arrived. The laser's pulse is not jitter but light: `ImpulseResponse`, in front.

    The mean is a convolution. Whole counts are drawn one by one (multinomial over the delays); counts that are not
    whole stay means. Policies: all four. "gaussian" has the covariance of the moves, given the counts; "score" the
    probabilities of the delays that were drawn, for learnable responses, while the counts given pass with the gradient
    of the mean. Behind a detector of one detection per cycle `Compose` draws both at once: the same distribution, in
    the time of the detector alone. Not modelled: jitter that depends on the rate (time walk).

    Args:
        response: distribution of the delays.
        axis: axis of the counts, or
        bin_width_s: their bin width in seconds.
        boundary: "periodic": what leaves the window comes in at the other end, so that constant counts stay constant;
            "zero": it is lost.
        within_bin: place of detections in their bin, "uniform" or "center", see `Response.kernel`.
        grad: gradient policy.

    Raises:
        ArgumentError: for other choices.
        UnitError: for widths out of range.
    """

    takes, gives = ("counts",), "counts"

    def __init__(
        self,
        response: Response,
        axis: TimeAxis | None = None,
        *,
        bin_width_s: float | None = None,
        boundary: Boundary = "periodic",
        within_bin: WithinBin = "uniform",
        grad: GradPolicy = "expected",
    ) -> None:
        super().__init__(grad)
        check_choice(boundary, Boundary, "boundary", "DetectionJitter")
        self.response = response
        self.bin_width_s, self.num_bins = bins_from(axis, bin_width_s, "DetectionJitter")
        self.boundary: Boundary = boundary
        self.within_bin: WithinBin = within_bin

    def expected(self, x: Tensor) -> Tensor:
        first, kernel = kernel_of(self.response, self.bin_width_s, self.within_bin)
        return convolve_time(check_transient(x, "DetectionJitter"), kernel, first, boundary=self.boundary)

    def moves(self, x: Tensor) -> Moves:
        first, kernel = kernel_of(self.response, self.bin_width_s, self.within_bin)
        kernel, first = window_lags(kernel.to(x.device), first, x.shape[TIME], self.boundary)
        if not kernel.numel():
            kernel, first = torch.zeros(1, dtype=torch.float64, device=x.device), 0
        return Moves(first, kernel, self.boundary)


# ----------------------------------------------------------------------------------------------------- jitter of sweeps


class SweepJitter(RandomSensor):
    """Shift the time axis of (..., C, T, H, W) by normal jitter, a number of sweeps averaged.

    Each item in front of C draws its own shifts, all its pixels share them. A shift by a part of a bin is linear
    interpolation, which broadens by less than a bin. ``expected`` is the mean over the jitter, exactly. The draw is a
    random *linear* map that does not depend on the input, so that every policy but ``expected`` gives its ordinary
    gradient, which is unbiased for any loss.

    Args:
        jitter_fwhm_s: jitter of one sweep, full width at half maximum in seconds.
        axis: axis of the light, or
        bin_width_s: its bin width in seconds.
        sweeps: sweeps averaged in an exposure.
        boundary: "periodic": what is shifted out of the window comes in at its other end, so that constant light stays
            constant; "zero": it is lost, and darkness moves in.
        grad: gradient policy.

    Raises:
        UnitError: for numbers out of range, and for jitter beyond the window.
    """

    gives = "the same"

    def __init__(
        self,
        jitter_fwhm_s: float,
        axis: TimeAxis | None = None,
        *,
        bin_width_s: float | None = None,
        sweeps: int = 1,
        boundary: Boundary = "periodic",
        grad: GradPolicy = "expected",
    ) -> None:
        super().__init__(grad)
        me = type(self).__name__
        check_choice(boundary, Boundary, "boundary", me)
        self.boundary: Boundary = boundary
        self.jitter_fwhm_s = check_seconds(jitter_fwhm_s, "jitter_fwhm_s", me)
        self.bin_width_s, self.num_bins = bins_from(axis, bin_width_s, me)
        self.sweeps = check_count(sweeps, "sweeps", me)

    @property
    def sigma_bins(self) -> float:
        """Standard deviation of one shift, in bins."""
        return self.jitter_fwhm_s / FWHM_PER_SIGMA / self.bin_width_s

    def expected(self, x: Tensor) -> Tensor:
        self._check(x)
        if self.sigma_bins == 0:
            return x
        reach, lags = self._lags(x)
        # Mean of the tent max(0, 1 - |shift - lag|): second difference of the integral of the normal cumulative, on
        # the side where that keeps its digits.
        low = -lags.abs()
        ramp = self.sigma_bins * normal_integral(torch.stack([low - 1, low, low + 1]) / self.sigma_bins)
        kernel = ramp[0] - 2 * ramp[1] + ramp[2]
        return convolve_time(x, kernel / kernel.sum(), -reach, boundary=self.boundary)

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self.expected(x) if self.grad == "expected" else self._shifted(x, generator)

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            return self._shifted(x, generator)

    def _shifted(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        self._check(x)
        if self.sigma_bins == 0:
            return x
        items = x.shape[:-4]
        noise = torch.randn((*items, self.sweeps), generator=generator, device=x.device, dtype=torch.float64)
        shifts = (noise * self.sigma_bins).clamp(-6 * self.sigma_bins, 6 * self.sigma_bins)
        reach, lags = self._lags(x)
        weights = (1 - (shifts.unsqueeze(-1) - lags).abs()).clamp(min=0).mean(-2).to(x.dtype)
        result = torch.zeros_like(x)
        for k, lag in enumerate(range(-reach, reach + 1)):
            if bool((weights[..., k] > 0).any()):
                result = result + weights[..., k].reshape(*items, 1, 1, 1, 1) * shifted(x, lag, self.boundary)
        return result

    def _lags(self, x: Tensor) -> tuple[int, Tensor]:
        reach = math.ceil(6 * self.sigma_bins) + 1
        return reach, torch.arange(-reach, reach + 1, dtype=torch.float64, device=x.device)

    def _check(self, x: Tensor) -> None:
        check_transient(x, type(self).__name__)
        if self.sigma_bins > x.shape[TIME]:
            raise UnitError(
                f"{type(self).__name__}: expected jitter below the window of {x.shape[TIME] * self.bin_width_s:g} s, "
                f"got jitter_fwhm_s={self.jitter_fwhm_s!r}. Picoseconds? 1 ps is 1e-12."
            )


# ----------------------------------------------------------------------------------------------------- delays of pixels


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
    """Shift light to later times, pixel by pixel, to fractions of a bin.

    Differentiable in `x` and in the delays (piecewise linear).

    Args:
        x: (..., C, T, H, W).
        delay_bins: delay in bins, a number or a map that broadcasts to (..., C, H, W); below 0 earlier.
        boundary: "periodic": the window is one laser period, sums are conserved and constant light stays constant;
            "zero": what leaves the window is lost and nothing comes in.

    Returns:
        Shape, dtype and device of `x`; half precision gives float32.

    Raises:
        ShapeError: for maps of other images.
    """
    check_transient(x, "shift_time")
    check_choice(boundary, Boundary, "boundary", "shift_time")
    pixels_of(delay_bins, x, "delay_bins", "shift_time")
    return Delayed(*_whole_and_part(delay_bins, x), boundary).mean(x)


_LONGEST_S = 1e-3


class _Delays(PhysicalModule):
    """The delays of pixels, in picoseconds, which is what a learning rate can be chosen for."""

    delay_ps: Tensor

    def __init__(self, delay_s: float | Tensor, bin_width_s: float, learnable: bool, where: str) -> None:
        super().__init__()
        given = check_map(delay_s, "delay_s", where, low=-_LONGEST_S, high=_LONGEST_S)
        delay = torch.as_tensor(given, dtype=torch.float64).detach()
        self.bin_width_s = bin_width_s
        keep_number(self, "delay_ps", delay * 1e12, learnable)

    @property
    def delay_s(self) -> Tensor:
        """Delay of all pixels, or of every one, in seconds."""
        return self.delay_ps.double() * 1e-12

    def bins(self, x: Tensor, where: str) -> Tensor:
        """Delays in bins, (..., C, H, W) or (), float64, checked against the pixels of `x`."""
        pixels_of(self.delay_ps, check_transient(x, where), "delay_s", where)
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
        """Move each count to the earlier or the later bin; tallies are (2, ..., H, W)."""
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
    """Delay light or rates of every pixel by a time of its own; see `shift_time`. Deterministic, linear in the light.

    In front of the detector: paths of different lengths, a fibre array, a shutter that runs over the rows.
    `DetectionSkew`, behind the detector, is for delays of its electronics.

    Args:
        delay_s: delay of every pixel in seconds, of either sign: a number, a map (H, W), or a tensor that broadcasts to
            (..., C, H, W).
        axis: axis of the light, or
        bin_width_s: its bin width in seconds.
        boundary: treatment of the window's ends, "periodic" or "zero", see `shift_time`.
        learnable: make `delays.delay_ps` a parameter, in picoseconds.

    Raises:
        UnitError: for a millisecond or more (picoseconds?).
        ShapeError: for maps of other images.
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
        self.boundary: Boundary = boundary
        self.bin_width_s, self.num_bins = bins_from(axis, bin_width_s, "PixelSkew")
        self.delays = _Delays(delay_s, self.bin_width_s, learnable, "PixelSkew")

    def expected(self, x: Tensor) -> Tensor:
        return shift_time(x, self.delays.bins(x, "PixelSkew"), boundary=self.boundary)


class DetectionSkew(MovedCounts):
    """Delay detections (counts) of every pixel by a time of its own: a signal tree, a converter that starts late.

    Draws move whole counts one by one: each of a bin goes to the earlier or the later of the two bins that its delay
    reaches, a binomial number. Gradient policies as in `MovedCounts`; the score is that of learnable delays.

    Args:
        delay_s: delay of every pixel in seconds, of either sign: a number, a map (H, W), or a tensor that broadcasts to
            (..., C, H, W).
        axis: axis of the counts, or
        bin_width_s: their bin width in seconds.
        boundary: treatment of the window's ends, "periodic" or "zero", see `shift_time`.
        learnable: make `delays.delay_ps` a parameter, in picoseconds.
        grad: gradient policy.

    Raises:
        UnitError: for a millisecond or more (picoseconds?), and for draws of NaN or infinity.
        ShapeError: for maps of other images.
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
        check_choice(boundary, Boundary, "boundary", "DetectionSkew")
        self.boundary: Boundary = boundary
        self.bin_width_s, self.num_bins = bins_from(axis, bin_width_s, "DetectionSkew")
        self.delays = _Delays(delay_s, self.bin_width_s, learnable, "DetectionSkew")

    def expected(self, x: Tensor) -> Tensor:
        return shift_time(x, self.delays.bins(x, "DetectionSkew"), boundary=self.boundary)

    def variance(self, x: Tensor) -> Tensor:
        moves = self.moves(x)
        split = x * (moves.part * (1 - moves.part)).to(x.dtype)
        return _moved(split, moves.whole, self.boundary) + _moved(split, moves.whole + 1, self.boundary)

    def moves(self, x: Tensor) -> Delayed:
        return Delayed(*_whole_and_part(self.delays.bins(x, "DetectionSkew"), x), self.boundary)


# ----------------------------------------------------------------------------------------------------------- converters


ActsOn = Literal["detections", "rates"]

# Mean width of codes, up to which they fill the window: what single precision leaves of a mean of 1.
_FILLED = 1e-5


def random_code_widths(num_bins: int, dnl_std: float, generator: torch.Generator | None = None) -> Tensor:
    """Draw relative widths of the codes of a converter.

    Args:
        num_bins: number of codes T.
        dnl_std: standard deviation of the widths, in mean widths.
        generator: source of randomness.

    Returns:
        (T,) float64, normal, at least 0.05, mean 1.

    Raises:
        UnitError: for numbers out of range.
    """
    std = check_number(dnl_std, "dnl_std", "random_code_widths", high=1.0)
    widths = 1 + std * torch.randn(
        check_count(num_bins, "num_bins", "random_code_widths"), dtype=torch.float64, generator=generator
    )
    widths = widths.clamp_min(0.05)
    return widths / widths.mean()


def code_bands(edges: Tensor, num_bins: int, *, periodic: bool = False, dither: bool = False) -> tuple[int, Tensor]:
    """Share of the light of each true bin that gets each code, as a band around the diagonal.

    Light lies evenly in its true bin.

    Args:
        edges: borders of the codes in true bins, (T + 1,), increasing.
        num_bins: true bins.
        periodic: light outside of the window lies in the bin a whole number of windows away; else in none.
        dither: add a random time that is uniform over one bin.

    Returns:
        First lag, and (T, B) float64: share of the true bin k + first + b that gets the code k.
    """
    lower, upper = edges[:-1], edges[1:]
    index = torch.arange(lower.shape[0], dtype=torch.float64, device=edges.device)
    first = int(torch.floor((lower - index).amin())) - int(dither)
    last = int(torch.ceil((upper - index).amax()))
    true = index.unsqueeze(1) + torch.arange(first, max(last, first + 1), dtype=torch.float64, device=edges.device)
    before = _triangle if dither else _box
    share = before(upper.unsqueeze(1) - true) - before(lower.unsqueeze(1) - true)
    inside = 1.0 if periodic else (true >= 0) & (true < num_bins)
    return first, share * inside


def _box(z: Tensor) -> Tensor:
    """Share of a bin's light before z, in bins from its start."""
    return z.clamp(0, 1)


def _triangle(z: Tensor) -> Tensor:
    """The same with a time on top that is uniform over one bin."""
    return 0.5 * (z.clamp(0, 1).square() + 1 - (2 - z.clamp(1, 2)).square())


def _bands_of_loaded_widths(module: nn.Module, incompatible: object) -> None:
    """Make the share matrix anew for code widths that came from a state_dict."""
    if isinstance(module, TDC):
        module.first, bands = module._bands(module.code_widths.double())
        module.bands = bands.to(module.code_widths)


class TDC(MovedCounts):
    """Convert equal true bins into the codes of a real converter, (..., C, T, H, W) to the same shape.

    Light of a true bin is taken to be spread evenly over it. The mean is linear; the expectation over offsets is exact.
    Codes that do not fill the window (mean width not 1) are taken with boundary "zero".

    Args:
        code_widths: (T,) relative widths (mean about 1): their deviations are the DNL, the running sum of these the
            INL.
        offset_bins: start of the first code in true bins; light then gets earlier codes by as much.
        sliding_scale: number of known offsets, 0, 1, 2, ... mean code widths, one of which is added before every
            conversion, at random, and taken off its code. That evens the DNL out; the mean of the INL at the codes used
            stays. Beyond the last code the widths begin again.
        dither: add an unknown time, uniform over one bin, before the conversion: of equal codes, half the events get
            the next one.
        acts_on: "detections": counts behind a detector, each of which gets its code: whole counts by a draw, under the
            policies of `MovedCounts`; counts that are not whole stay means. It is the last stage where bins stand for
            codes. "rates": light in front of a detector, nothing is drawn; pile-up then happens in codes.
        boundary: "periodic": codes that fill the window go round, so that constant light stays constant up to the
            widths of the codes; "zero": light outside the window is none, and what falls beyond the last code is lost.
        grad: gradient policy.

    Raises:
        UnitError: for widths that are not positive.
        ShapeError: for light of another T.
    """

    code_widths: Tensor
    bands: Tensor

    def __init__(
        self,
        code_widths: Tensor,
        *,
        offset_bins: float = 0.0,
        sliding_scale: int = 1,
        dither: bool = False,
        acts_on: ActsOn = "detections",
        boundary: Boundary = "periodic",
        grad: GradPolicy = "expected",
    ) -> None:
        super().__init__(grad)
        widths = reals("TDC", torch.float64, code_widths=code_widths)[0].detach().double()
        if widths.ndim != 1:
            raise ShapeError(f"TDC: expected code_widths (T,), got {tuple(widths.shape)}.")
        if not bool((widths > 0).all()) or not bool(torch.isfinite(widths).all()):
            raise UnitError("TDC: expected code_widths > 0, finite, relative to the bin (mean about 1).")
        if not 0.1 <= float(widths.mean()) <= 10:
            raise UnitError(
                f"TDC: expected code_widths relative to the bin (mean about 1), got a mean of {float(widths.mean()):g}."
                " Seconds or picoseconds? Divide them by the bin."
            )
        check_choice(acts_on, ActsOn, "acts_on", "TDC")
        check_choice(boundary, Boundary, "boundary", "TDC")
        self.acts_on: ActsOn = acts_on
        if acts_on == "detections":
            self.takes, self.gives = ("counts",), "counts"
        else:
            self.takes, self.gives = ("radiance", "rate", "electrons"), "the same"
        self.boundary: Boundary = boundary
        self.sliding_scale = check_count(sliding_scale, "sliding_scale", "TDC")
        self.offset_bins = check_number(offset_bins, "offset_bins", "TDC", low=-1e6, high=1e6)
        self.dither = bool(dither)
        self.num_bins = widths.shape[0]
        self.register_buffer("code_widths", widths)
        self.first, bands = self._bands(widths)
        # not saved: the band of other widths may have another shape, and begins at another bin
        self.register_buffer("bands", bands, persistent=False)
        self.register_load_state_dict_post_hook(_bands_of_loaded_widths)  # type: ignore[no-untyped-call]

    @property
    def goes_round(self) -> bool:
        """True if the codes fill the window and are taken round it."""
        codes = self.code_widths.shape[0]
        filled = abs(float(self.code_widths.double().sum()) - codes) < _FILLED * codes
        return self.boundary == "periodic" and filled

    def _bands(self, widths: Tensor) -> tuple[int, Tensor]:
        """The share matrix as a band, averaged over the offsets of the sliding scale."""
        codes, periodic = widths.shape[0], self.goes_round
        if periodic:
            widths = widths * (codes / widths.sum())
        step = widths.mean()
        two_turns = torch.nn.functional.pad(widths.repeat(2).cumsum(0), (1, 0)) + self.offset_bins
        parts = []
        for shift in range(self.sliding_scale):
            later = shift % codes  # whole turns change nothing
            edges = two_turns[later : later + codes + 1] - later * step
            if periodic:
                # exactly one turn: rounding at the last edge would leave a gap
                edges[-1] = edges[0] + codes
            parts.append(code_bands(edges, codes, periodic=periodic, dither=self.dither))
        low = min(first for first, _ in parts)
        high = max(first + band.shape[1] for first, band in parts)
        total = widths.new_zeros(codes, high - low)
        for first, band in parts:
            total[:, first - low : first - low + band.shape[1]] += band / self.sliding_scale
        return low, total

    def expected(self, x: Tensor) -> Tensor:
        bins = check_transient(x, "TDC").shape[TIME]
        bands = self.bands.to(x.dtype)
        total, periodic = torch.zeros_like(x), self.goes_round
        for b, column in enumerate(bands.view(bins, -1, 1, 1).unbind(1)):
            # code k gets light of the true bin k + offset
            offset = self.first + b
            if periodic:
                offset %= bins
            for true in (0, bins) if periodic else (0,):
                low, high = max(0, true - offset), min(bins, true + bins - offset)
                if low < high:
                    codes = total.narrow(TIME, low, high - low)
                    codes.addcmul_(column[low:high], x.narrow(TIME, low + offset - true, high - low))
        return total

    def moves(self, x: Tensor) -> Moves:
        columns = self.bands.double().unbind(1)
        # a true bin t goes to the code t - offset
        shares = [c.roll(self.first + b) for b, c in enumerate(columns)]
        return Moves(
            1 - self.first - len(columns), torch.stack(shares[::-1]), "periodic" if self.goes_round else "zero"
        )

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self.expected(x) if self.acts_on == "rates" else super().forward(x, generator)

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if self.acts_on == "detections":
            return super().sample(x, generator)
        with torch.no_grad():
            return self.expected(x)
