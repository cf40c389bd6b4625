"""Indirect (amplitude modulated) time of flight: what the taps of a pixel collect.

A pixel of N taps shares the light among its taps according to a correlation code (`itof_codes.py`):

    taps_n = (1 / N) sum_k H_k (1 + contrast code_n(f t_k)) + background / N

with H the photoelectrons of the whole exposure per bin, f the modulation frequency and t the time of flight. For a sine
code the phasor ``P(f) = sum H exp(-2 pi i f t)`` holds all that the taps can see, whatever the paths that the light
took: multi-path interference needs no model of its own. Other codes need P at the multiples of f.

Several frequencies follow each other along the tap dimension, frequency-major: (..., C, F N, H, W).

Sources: Lange & Seitz (2001); Lin et al., "Fourier analysis on transient imaging with a multifrequency
time-of-flight camera" (CVPR 2014); Gutierrez-Barragan et al. (2019).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import in_single
from torchtransient.sensing.itof_codes import CorrelationCode
from torchtransient.sensing.layout import check_number, check_time_axis, check_transient, without_autocast
from torchtransient.sensing.sensor import Sensor

WithinBin = Literal["uniform", "center"]


def check_frequencies(frequencies_hz: float | Sequence[float], where: str) -> tuple[float, ...]:
    """Modulation frequencies in hertz as a tuple; UnitError unless there are some, between 1 kHz and 1 THz."""
    given = frequencies_hz if isinstance(frequencies_hz, Sequence) else (frequencies_hz,)
    values = tuple(check_number(f, "frequencies_hz", where, low=1e3, high=1e12) for f in given)
    if not values:
        raise UnitError(f"{where}: expected at least one modulation frequency in hertz, got none.")
    return values


def tap_weights(
    code: CorrelationCode,
    frequencies_hz: float | Sequence[float],
    axis: TimeAxis,
    contrast: float = 1.0,
    within_bin: WithinBin = "uniform",
) -> Tensor:
    """(F N, T) float64 on the CPU: what share of the light of every bin goes to every tap.

    ``within_bin``: "uniform" spreads the light of a bin evenly over it (the mean of the code over the bin, exact for
    light that is nowhere special); "center" puts it in the middle. ``contrast``: demodulation contrast in [0, 1],
    0.5 to 0.9 in cameras. The shares of the taps sum to one where the code's shifted copies sum to zero (sine, and
    square with half duty and an even N or any N of its sine part), so that light is conserved.
    """
    me = "tap_weights"
    check_number(contrast, "contrast", me, high=1.0)
    if not isinstance(code, CorrelationCode):
        raise UnitError(f"{me}: expected a code such as sine_code(4), got {code!r}.")
    edges_s = check_time_axis(axis, me).edges_s
    rows = []
    for f in check_frequencies(frequencies_hz, me):
        if within_bin == "uniform":
            shape = code.bin_means(edges_s * f)
        elif within_bin == "center":
            shape = code.evaluate(axis.centers_s * f)
        else:
            raise UnitError(f"{me}: expected within_bin 'uniform' or 'center', got {within_bin!r}.")
        rows.append((1 + contrast * shape) / code.num_taps)
    return torch.cat(rows)


@in_single
@without_autocast
def correlate(transient: Tensor, weights: Tensor) -> Tensor:
    """(..., C, M, H, W): every row of ``weights`` (M, T) times the time axis of a transient (..., C, T, H, W).

    Raises ShapeError when the numbers of bins differ.
    """
    check_transient(transient, "correlate")
    if weights.ndim != 2 or weights.shape[1] != transient.shape[-3]:
        raise ShapeError(
            f"correlate: expected weights (M, {transient.shape[-3]}) for the transient {tuple(transient.shape)}, got "
            f"{tuple(weights.shape)}. Make them from the transient's own time axis."
        )
    taps = weights.to(transient) @ transient.flatten(-2)
    return taps.reshape(*taps.shape[:-1], *transient.shape[-2:])


@without_autocast
def taps_from_phasor(
    phasor: Tensor,
    phasor_axis: FrequencyAxis,
    code: CorrelationCode,
    frequencies_hz: float | Sequence[float],
    *,
    steady: Tensor | None = None,
    harmonics: Sequence[int] | None = None,
    contrast: float = 1.0,
) -> Tensor:
    """Taps (..., C, F N, H, W) straight from a phasor image (..., C, K, H, W), no histogram in between.

    ``phasor``: complex photoelectrons at the K frequencies of ``phasor_axis``; needed are zero (or ``steady`` (..., C,
    H, W) instead) and every harmonic of every modulation frequency, to a relative 1e-6; negative ones do as well.
    ``harmonics``: those of the code to keep, for instance ``(1, 3, 5)``; None takes all, which a code with corners,
    that has infinitely many, refuses. What is left out is lost: a square code kept to the harmonic h misses wiggles
    of about ``1 / h^2`` rad.

    Raises ShapeError for a phasor that does not fit its axis, UnitError for a missing frequency.
    """
    me = "taps_from_phasor"
    if not phasor.is_complex() or phasor.ndim < 4 or phasor.shape[-3] != phasor_axis.num_frequencies:
        raise ShapeError(
            f"{me}: expected a complex phasor (..., C, {phasor_axis.num_frequencies}, H, W), got {phasor.dtype} "
            f"{tuple(phasor.shape)}."
        )
    check_number(contrast, "contrast", me, high=1.0)
    kept = code.harmonics if harmonics is None else tuple(sorted({int(h) for h in harmonics} - {0}))
    if kept is None or any(h < 1 for h in kept):
        raise UnitError(
            f"{me}: expected harmonics=(1, ...), positive, for a code of infinitely many, got {harmonics!r}."
        )
    total = _component(phasor, phasor_axis, 0.0, me).real if steady is None else steady.to(phasor.real.dtype)
    offset = code.coefficients([0]).real.squeeze(1)
    factors = 2 * contrast * code.coefficients(kept)
    taps = []
    for f in check_frequencies(frequencies_hz, me):
        parts = torch.stack([_component(phasor, phasor_axis, h * f, me) for h in kept], dim=-3)
        # exp(+i) of the code against exp(-i) of the phasor: the conjugate of one of them.
        mixed = (factors.to(parts) @ parts.conj().flatten(-2)).real
        mixed = mixed.reshape(*mixed.shape[:-1], *parts.shape[-2:])
        base = (1 + contrast * offset).to(total).reshape(-1, 1, 1) * total.unsqueeze(-3)
        taps.append((base + mixed) / code.num_taps)
    return torch.cat(taps, dim=-3)


def _component(phasor: Tensor, axis: FrequencyAxis, frequency_hz: float, where: str) -> Tensor:
    """(..., C, H, W) complex: the phasor at one frequency, referred to t = 0."""
    have = axis.hertz
    tolerance = 1e-6 * abs(frequency_hz) + 1e-3
    for sign in (1.0, -1.0):
        found = torch.nonzero((have - sign * frequency_hz).abs() <= tolerance)
        if len(found):
            k = int(found[0])
            value = phasor.select(-3, k)
            turns = -(axis.frequencies[k] * axis.start_opl) % 1.0
            value = value * complex(math.cos(2 * math.pi * turns), math.sin(2 * math.pi * turns))
            return value if sign > 0 else value.conj()
    raise UnitError(
        f"{where}: expected the phasor to hold {frequency_hz:g} Hz, got {axis!r}. Render it with "
        "FrequencyAxis.from_hertz of zero and of every harmonic, or give steady= and fewer harmonics."
    )


class ItofCorrelation(Sensor):
    """Photoelectrons per bin (..., C, T, H, W) to the mean electrons of the taps (..., C, F N, H, W).

    ``code``, ``frequencies_hz`` (F of them), ``axis`` (of the transient), ``contrast`` and ``within_bin`` as in
    `tap_weights`; ``background_e`` electrons of unmodulated light per exposure, shared equally by the taps;
    ``electrons_per_unit`` scales a radiance to electrons. Linear but for the background, hence exact in the mean.
    Noise, saturation and converter follow in `PixelElectronics`; phase and depth in `itof_depth.py`.
    """

    takes, gives = ("electrons", "counts"), "electrons"

    weights: Tensor

    def __init__(
        self,
        code: CorrelationCode,
        frequencies_hz: float | Sequence[float],
        axis: TimeAxis,
        *,
        contrast: float = 1.0,
        background_e: float = 0.0,
        electrons_per_unit: float = 1.0,
        within_bin: WithinBin = "uniform",
    ) -> None:
        super().__init__()
        me = type(self).__name__
        self.code = code
        self.frequencies_hz = check_frequencies(frequencies_hz, me)
        self.axis = axis
        self.contrast = check_number(contrast, "contrast", me, high=1.0)
        self.background_e = check_number(background_e, "background_e", me)
        self.electrons_per_unit = check_number(electrons_per_unit, "electrons_per_unit", me, open_low=True)
        self.within_bin: WithinBin = within_bin
        weights = tap_weights(code, self.frequencies_hz, axis, self.contrast, within_bin)
        self.register_buffer("weights", weights)
        self.num_bins = axis.num_bins

    def expected(self, x: Tensor) -> Tensor:
        # Scaled on the small side: taps are fewer than bins.
        taps = correlate(x, self.weights) * self.electrons_per_unit
        return taps + self.background_e / self.code.num_taps

    def expected_from_phasor(
        self,
        phasor: Tensor,
        phasor_axis: FrequencyAxis,
        steady: Tensor | None = None,
        harmonics: Sequence[int] | None = None,
    ) -> Tensor:
        """The same taps from a phasor image; arguments and errors as in `taps_from_phasor`."""
        taps = taps_from_phasor(
            phasor,
            phasor_axis,
            self.code,
            self.frequencies_hz,
            steady=steady,
            harmonics=harmonics,
            contrast=self.contrast,
        )
        return taps * self.electrons_per_unit + self.background_e / self.code.num_taps

    def extra_repr(self) -> str:
        megahertz = ", ".join(f"{f / 1e6:g}" for f in self.frequencies_hz)
        return f"taps={self.code.num_taps}, frequencies_MHz=({megahertz}), contrast={self.contrast:g}"
