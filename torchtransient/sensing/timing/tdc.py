"""Time-to-digital converters: codes of unequal width (DNL, INL), sliding scale, dither.

Source: Cottini, Gatti, Svelto, A new method for analog to digital conversion (Nuclear Instruments and Methods 24,
1963), the sliding scale.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from torchtransient.errors import ShapeError, UnitError
from torchtransient.sensing.base.layout import TIME, check_choice, check_count, check_number, check_transient, reals
from torchtransient.sensing.base.policies import GradPolicy
from torchtransient.sensing.counts.moved_counts import MovedCounts, Moves
from torchtransient.sensing.numerics.time_convolution import Boundary

ActsOn = Literal["detections", "rates"]

# Mean width of codes, up to which they fill the window: what single precision leaves of a mean of 1.
_FILLED = 1e-5


def random_code_widths(num_bins: int, dnl_std: float, generator: torch.Generator | None = None) -> Tensor:
    """(T,) float64 relative widths of codes, mean 1, normal with standard deviation `dnl_std`, at least 0.05 before."""
    std = check_number(dnl_std, "dnl_std", "random_code_widths", high=1.0)
    widths = 1 + std * torch.randn(
        check_count(num_bins, "num_bins", "random_code_widths"), dtype=torch.float64, generator=generator
    )
    widths = widths.clamp_min(0.05)
    return widths / widths.mean()


def code_bands(
    edges: Tensor, num_bins: int, *, periodic: bool = False, dither: bool = False
) -> tuple[int, Tensor]:
    """(first, (T, B) float64): share of the true bin k + first + b that gets the code k.

    `edges`: (T + 1,) borders of the codes, in true bins, increasing. Light lies evenly in its true bin; `dither` adds a
    time that is uniform over one bin. Light outside [0, num_bins] is in no bin, or, if `periodic`, in the bin a whole
    number of windows away.
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
    """The share matrix follows code widths that came from a state_dict."""
    if isinstance(module, TDC):
        module.first, bands = module._bands(module.code_widths.double())
        module.bands = bands.to(module.code_widths)


class TDC(MovedCounts):
    """Turns equal true bins into the codes of a real converter, (..., C, T, H, W) to the same shape.

    `code_widths`: (T,) relative widths (mean about 1): their deviations are the DNL, the running sum of these the INL.
    Light of a true bin is taken to be spread evenly over it. `sliding_scale`: number of known offsets,
    0, 1, 2, ... mean code widths, one of which is added before every conversion, at random, and taken off its code.
    That evens the DNL out; the mean of the INL at the codes used stays. Beyond the last code the widths begin again.
    `dither`: an unknown time, uniform over one bin, that is added before the conversion and not taken off: of equal
    codes, half the events get the next one.
    `offset_bins`: where, in true bins, the first code begins; light then gets earlier codes by as much.

    `acts_on` "detections": the input are counts behind a detector. Each of them gets its code: whole counts by a draw,
    under the policies of `MovedCounts`; counts that are not whole stay means. It is the last stage where bins stand
    for codes. "rates": the input is light in front of a detector, nothing is drawn; pile-up then happens in codes.

    `boundary` "periodic": codes that fill the window go round, so that constant light stays constant up to the widths
    of the codes; "zero": light outside the window is none, and what falls beyond the last code is lost. Codes that do
    not fill the window (mean width not 1) are taken with "zero".

    The mean is linear; the expectation over offsets is exact. Raises UnitError for widths that are not positive,
    ShapeError when T does not fit.
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
        if not isinstance(code_widths, Tensor) or code_widths.ndim != 1 or code_widths.numel() == 0:
            raise ShapeError("TDC: expected code_widths (T,), got something else.")
        widths = reals("TDC", torch.float64, code_widths=code_widths)[0].detach().double()
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
        """Whether the codes fill the window and are taken round it."""
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

    @property
    def differential_nonlinearity(self) -> Tensor:
        """(T,) deviation of each code's width from the bin, in bins."""
        return self.code_widths - 1

    @property
    def integral_nonlinearity(self) -> Tensor:
        """(T,) deviation of each code's end from where it should be, in bins."""
        return self.differential_nonlinearity.cumsum(0)

    def check_bins(self, x: object) -> None:
        if isinstance(x, Tensor) and x.ndim >= 4 and x.shape[TIME] != self.num_bins:
            raise ShapeError(
                f"TDC: expected T = {self.num_bins} as in code_widths, got {x.shape[TIME]} of {tuple(x.shape)}. Make "
                "one width for every bin of the light."
            )

    def _check(self, x: Tensor) -> Tensor:
        check_transient(x, "TDC")
        self.check_bins(x)
        return x

    def expected(self, x: Tensor) -> Tensor:
        bins = self._check(x).shape[TIME]
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
        self._check(x)
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
