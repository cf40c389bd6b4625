"""Indirect (amplitude modulated) time of flight: what the taps of a pixel collect.

A pixel of N taps shares the light among its taps according to a correlation code (`itof_codes.py`):

    taps_n = (1 / N) sum_k H_k (1 + contrast code_n(f t_k)) + background / N

with H the photoelectrons of the whole exposure per bin, f the modulation frequency and t the time of flight. For a sine
code the phasor ``P(f) = sum H exp(-2 pi i f t)`` holds all that the taps can see, whatever the paths that the light
took: multi-path interference needs no model of its own. Other codes need P at the multiples of f.

Several frequencies follow each other along the tap dimension, frequency-major: (..., C, F N, H, W). Pixels of two taps
are codes of 2 N taps, and what a camera adds to the phase is an `ItofCalibration`: see `itof_pixels.py`.

Sources: Lange & Seitz (2001); Lin et al., "Fourier analysis on transient imaging with a multifrequency
time-of-flight camera" (CVPR 2014); Gutierrez-Barragan et al. (2019).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.checks import real_array, shown
from torchtransient.errors import GradientError, ShapeError, UnitError
from torchtransient.floating import in_single, product
from torchtransient.sensing.base.given import refuse_cut_off
from torchtransient.sensing.base.layout import check_number, check_tensors, check_time_axis, check_transient, reals
from torchtransient.sensing.base.sensor import Sensor
from torchtransient.sensing.itof.itof_codes import CorrelationCode
from torchtransient.sensing.itof.itof_pixels import ItofCalibration, in_direction
from torchtransient.sensing.itof.itof_weights import harmonic_rows, rounding_of, taps_by_pixel

WithinBin = Literal["uniform", "center"]
# One number, a sequence, an array or a tensor of them.
Frequencies = float | Sequence[float] | Tensor | NDArray[Any]

_TURN = 2 * math.pi


def check_frequencies(frequencies_hz: Frequencies, where: str) -> tuple[float, ...]:
    """Modulation frequencies in hertz as a tuple; UnitError unless there are some, between 1 kHz and 1 THz."""
    refuse_cut_off(frequencies_hz, "frequencies_hz", where)
    array = real_array(frequencies_hz)
    given: Sequence[Any] = [frequencies_hz]  # what is no row of numbers is told by the check of its entries
    if array is not None and array.ndim <= 1:
        given = array.reshape(-1).tolist()
    elif isinstance(frequencies_hz, Sequence) and not isinstance(frequencies_hz, str):
        given = frequencies_hz
    values = tuple(check_number(f, "frequencies_hz", where, low=1e3, high=1e12) for f in given)
    if not values:
        raise UnitError(f"{where}: expected at least one modulation frequency in hertz, got none.")
    return values


def tap_weights(
    code: CorrelationCode,
    frequencies_hz: Frequencies,
    axis: TimeAxis,
    *,
    contrast: float = 1.0,
    within_bin: WithinBin = "uniform",
    calibration: ItofCalibration | None = None,
) -> Tensor:
    """(F N, T) float64 on the CPU: what share of the light of every bin goes to every tap.

    ``within_bin``: "uniform" spreads the light of a bin evenly over it (the mean of the code over the bin, exact for
    light that is nowhere special); "center" puts it in the middle. ``contrast``: demodulation contrast in [0, 1],
    0.5 to 0.9 in cameras. The shares of the taps sum to one where the code's shifted copies sum to zero (sine, square
    with half duty and an even N or any N of its sine part, every `TwoTapCode`), so that light is conserved.
    ``calibration``: phase offset and direction; maps of pixels are for `ItofCorrelation`.

    Raises UnitError, and ShapeError for a code of two taps that is no `TwoTapCode`.
    """
    me = "tap_weights"
    code, phases = _checked(code, frequencies_hz, axis, contrast, within_bin, calibration, me)
    if phases.shape[1:] != (1, 1):
        raise UnitError(f"{me}: expected a calibration without maps of pixels, whose weights ItofCorrelation makes.")
    if phases.requires_grad:
        refuse_cut_off(phases, "calibration", me)
    rows = []
    for f, phase in zip(check_frequencies(frequencies_hz, me), phases.flatten().tolist(), strict=True):
        if within_bin == "uniform":
            shape = code.bin_means(axis.edges_s * f + phase / _TURN)
        else:
            shape = code.evaluate(axis.centers_s * f + phase / _TURN)
        rows.append((1 + contrast * shape) / code.num_taps)
    return torch.cat(rows)


def _checked(
    code: CorrelationCode,
    frequencies_hz: Frequencies,
    axis: TimeAxis,
    contrast: float,
    within_bin: str,
    calibration: ItofCalibration | None,
    me: str,
) -> tuple[CorrelationCode, Tensor]:
    """The code in the direction of its steps, and the phases (F, 1, 1) or (F, H, W) of offsets and maps."""
    check_number(contrast, "contrast", me, high=1.0)
    check_time_axis(axis, me)
    if not isinstance(within_bin, str) or within_bin not in ("uniform", "center"):
        raise UnitError(f"{me}: expected within_bin 'uniform' or 'center', got {shown(within_bin)}.")
    if calibration is not None and not isinstance(calibration, ItofCalibration):
        raise UnitError(f"{me}: expected calibration to be an ItofCalibration, got {calibration!r}.")
    known = calibration or ItofCalibration()
    code = in_direction(check_code(code, me), known.direction)
    return code, known.phases_rad(check_frequencies(frequencies_hz, me))


def check_code(code: object, where: str) -> CorrelationCode:
    """`code` when it tells phase, amplitude and offset apart. Raises UnitError, ShapeError for two taps."""
    if not isinstance(code, CorrelationCode):
        raise UnitError(f"{where}: expected a code such as sine_code(4), got {code!r}.")
    if code.num_taps < 3:
        raise ShapeError(
            f"{where}: expected three taps or more, from which phase, amplitude and offset can be told apart, got "
            f"{code.num_taps}. Two phase steps suffice for pixels of two taps: TwoTapCode(code)."
        )
    return code


@in_single
def correlate(transient: Tensor, weights: Tensor) -> Tensor:
    """(..., C, M, H, W): every row of ``weights`` (M, T) times the time axis of a transient (..., C, T, H, W).

    Raises ShapeError when the numbers of bins differ.
    """
    check_transient(transient, "correlate")
    (weights,) = reals("correlate", weights=weights)
    if weights.ndim != 2 or weights.shape[1] != transient.shape[-3]:
        raise ShapeError(
            f"correlate: expected weights (M, {transient.shape[-3]}) for the transient {tuple(transient.shape)}, got "
            f"{tuple(weights.shape)}. Make them from the transient's own time axis."
        )
    taps = product(weights.to(transient), transient.flatten(-2))
    return taps.reshape(*taps.shape[:-1], *transient.shape[-2:])


def taps_from_phasor(
    phasor: Tensor,
    phasor_axis: FrequencyAxis,
    code: CorrelationCode,
    *,
    frequencies_hz: Frequencies,
    steady: Tensor | None = None,
    harmonics: Sequence[int] | None = None,
    contrast: float = 1.0,
    calibration: ItofCalibration | None = None,
) -> Tensor:
    """Taps (..., C, F N, H, W) straight from a phasor image (..., C, K, H, W), no histogram in between.

    ``phasor``: complex photoelectrons at the K frequencies of ``phasor_axis``; needed are zero (or ``steady`` (..., C,
    H, W) instead) and every harmonic of every modulation frequency, to a relative 1e-6; negative ones do as well.
    ``harmonics``: those of the code to keep, for instance ``(1, 3, 5)``; None takes all, which a code with corners,
    that has infinitely many, refuses. What is left out is lost: a square code kept to the harmonic h misses wiggles
    of about ``1 / h^2`` rad. ``calibration``: with maps of pixels too, (H, W) those of the phasor.

    Raises ShapeError for a phasor that does not fit its axis, UnitError for a missing frequency.
    """
    check_tensors("taps_from_phasor", phasor=phasor)
    me = "taps_from_phasor"
    if not phasor.is_complex() or phasor.ndim < 4 or phasor.shape[-3] != phasor_axis.num_frequencies:
        raise ShapeError(
            f"{me}: expected a complex phasor (..., C, {phasor_axis.num_frequencies}, H, W), got {phasor.dtype} "
            f"{tuple(phasor.shape)}."
        )
    contrast = check_number(contrast, "contrast", me, high=1.0)
    steady = None if steady is None else reals(me, steady=steady)[0]
    known = calibration or ItofCalibration()
    code, values = in_direction(check_code(code, me), known.direction), check_frequencies(frequencies_hz, me)
    phases = _fitting(known.phases_rad(values), phasor, me)
    kept = code.harmonics if harmonics is None else tuple(sorted({int(h) for h in harmonics} - {0}))
    if kept is None or any(h < 1 for h in kept):
        raise UnitError(
            f"{me}: expected harmonics=(1, ...), positive, for a code of infinitely many, got {harmonics!r}."
        )
    total = _component(phasor, phasor_axis, 0.0, me).real if steady is None else steady.to(phasor.real.dtype)
    taps = []
    for f, phase in zip(values, phases, strict=True):
        # exp(+i) of the code against exp(-i) of the phasor: the conjugate of one of them.
        found = [(h, _component(phasor, phasor_axis, h * f, me)) for h in kept]
        parts = [(h, part.real, -part.imag) for h, part in found]
        taps.append(_mixed(total, parts, code, contrast, phase))
    return torch.cat(taps, dim=-3)


def _mixed(
    total: Tensor,
    parts: Sequence[tuple[int, Tensor, Tensor]],
    code: CorrelationCode,
    contrast: float,
    phase: Tensor,
) -> Tensor:
    """Taps (..., N, H, W) of all light (..., H, W) and its sums with cos and sin of ``2 pi h f t``, at phases (H, W).

    No products of matrices, which autocast would round.
    """
    offset = code.coefficients([0]).real.reshape(-1, 1, 1)
    taps = (1 + contrast * offset).to(total) * total.unsqueeze(-3)
    for h, cosine, sine in parts:
        size, angle = code.coefficients([h]).reshape(-1, 1, 1), h * phase.to(total.device).double()
        factor = 2 * contrast * size.to(angle.device) * torch.complex(angle.cos(), angle.sin())
        taps = taps + factor.real.to(total) * cosine.unsqueeze(-3) - factor.imag.to(total) * sine.unsqueeze(-3)
    return taps / code.num_taps


def _fitting(phases: Tensor, x: Tensor, where: str) -> Tensor:
    """Phases (F, H, W) for the pixels of ``x``. Raises ShapeError for a map of other pixels."""
    size = tuple(phases.shape[-2:])
    if size != (1, 1) and size != tuple(x.shape[-2:]):
        raise ShapeError(f"{where}: expected light of {size} pixels, as the calibration's, got {tuple(x.shape)}.")
    return phases


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
    `tap_weights`. Light and ``background_e``, electrons of unmodulated light, are those of *all* N phase steps of a
    frequency and all taps together, which share them equally. ``electrons_per_unit`` scales a radiance to electrons;
    ``calibration``: phase offsets, direction of the steps, maps of pixels; an `nn.Parameter` in it is learnt, with a
    `FourierCode`. Linear but for the background, hence exact in the mean. Noise, saturation and converter follow in
    `PixelElectronics`, the difference of two taps in `TapDifference`; phase and depth in `read_itof`.

    A map of pixels costs one pass over the transient for each harmonic of a sine code; a code with corners needs
    weights of N T numbers for every pixel, made anew in every call. Errors as `tap_weights`; ShapeError for light of
    other pixels than those of the map.
    """

    takes, gives = ("electrons", "counts"), "electrons"

    weights: Tensor
    phases_rad: Tensor  # (F, H, W), as they were made; those of learnt calibrations are made anew

    def __init__(
        self,
        code: CorrelationCode,
        frequencies_hz: Frequencies,
        axis: TimeAxis,
        *,
        contrast: float = 1.0,
        background_e: float = 0.0,
        electrons_per_unit: float = 1.0,
        within_bin: WithinBin = "uniform",
        calibration: ItofCalibration | None = None,
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
        self.calibration = calibration
        self._turned, phases = _checked(code, self.frequencies_hz, axis, self.contrast, within_bin, calibration, me)
        learnt = () if calibration is None else calibration.learned
        for name in learnt:
            value = getattr(calibration, name)
            if not isinstance(value, nn.Parameter) or self._turned.harmonics is None:
                raise GradientError(
                    f"{me}: expected the {name} of a calibration that requires a gradient to be an nn.Parameter, with "
                    f"a sine code (or any FourierCode), got {type(value).__name__} with {shown(code)}. Other codes are "
                    "not supported: give .detach()."
                )
            self.register_parameter(name, value)
        self._learnt = learnt
        self.register_buffer("phases_rad", phases.detach())
        self.register_buffer("weights", self._weights_for(self.phases_rad))
        self.num_bins = axis.num_bins

    def _of_one(self, phases: Tensor) -> bool:
        """Whether all pixels have the same phases, which are then in the weights."""
        return not self._learnt and phases.shape[1:] == (1, 1)

    def _weights_for(self, phases: Tensor) -> Tensor:
        if self._of_one(phases):
            return tap_weights(
                self.code, self.frequencies_hz, self.axis,
                contrast=self.contrast, within_bin=self.within_bin, calibration=self._with(phases),
            )  # fmt: skip
        if self._turned.harmonics is not None:
            return harmonic_rows(self._turned.harmonics, self.frequencies_hz, self.axis, self.within_bin)
        return torch.zeros(0, self.axis.num_bins, dtype=torch.float64)

    def _with(self, phases: Tensor) -> ItofCalibration:
        """The calibration that has these phases."""
        direction = 1 if self.calibration is None else self.calibration.direction
        if phases.shape[1:] == (1, 1):
            return ItofCalibration(phase_offset_rad=phases.flatten().tolist(), direction=direction)
        return ItofCalibration(direction=direction, phase_map_rad=phases)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *others: Any) -> None:
        """Phases of another size come with the state; what else is another camera's is an error."""
        phases, weights = state_dict.get(f"{prefix}phases_rad"), state_dict.get(f"{prefix}weights")
        if isinstance(phases, Tensor) and isinstance(weights, Tensor) and not self._learnt:
            if phases.ndim != 3 or phases.shape[0] != len(self.frequencies_hz):
                raise ShapeError(
                    f"ItofCorrelation.load_state_dict: expected phases_rad ({len(self.frequencies_hz)}, H, W), got "
                    f"{tuple(phases.shape)}. Make the camera with the frequencies of the state."
                )
            own = self._weights_for(phases.double().cpu()).to(weights)
            # as much as rounding to half precision leaves
            near = own.shape == weights.shape and torch.allclose(own, weights, rtol=0, atol=4 * rounding_of(weights))
            if not near:
                raise UnitError(
                    "ItofCorrelation.load_state_dict: expected the state of a camera with the code, frequencies, axis, "
                    "contrast and direction of this one, got weights of another. Make the camera as that one was made; "
                    "its phases come with the state."
                )
            self.phases_rad, self.weights = (torch.empty_like(v, device=self.weights.device) for v in (phases, own))
        super()._load_from_state_dict(state_dict, prefix, *others)

    def _known(self) -> ItofCalibration:
        """The calibration with the parameters and phases as they are now."""
        if self.calibration is None or not self._learnt:
            return self._with(self.phases_rad)
        return replace(self.calibration, **{name: getattr(self, name) for name in self._learnt})

    def _phases(self) -> Tensor | None:
        """Of pixels that differ."""
        if self._learnt:
            return self._known().phases_rad(self.frequencies_hz)
        return None if self._of_one(self.phases_rad) else self.phases_rad

    def expected(self, x: Tensor) -> Tensor:
        phases = self._phases()
        # Scaled on the small side: taps are fewer than bins.
        taps = correlate(x, self.weights) if phases is None else self._of_pixels(x, phases)
        return taps * self.electrons_per_unit + self.background_e / self.code.num_taps

    def _of_pixels(self, x: Tensor, phases: Tensor) -> Tensor:
        """Taps of pixels whose phases differ."""
        check_transient(x, type(self).__name__)
        _fitting(phases, x, "ItofCorrelation")
        code, harmonics = self._turned, self._turned.harmonics
        if harmonics is None:
            given = zip(self.frequencies_hz, phases, strict=True)
            found = [taps_by_pixel(x, code, f, self.axis, self.contrast, self.within_bin, p) for f, p in given]
            return torch.cat(found, dim=-3)
        sums = torch.split(correlate(x, self.weights), 2 * len(harmonics), dim=-3)
        total = x.sum(-3)
        taps = []
        for group, phase in zip(sums, phases, strict=True):
            rows = group.unbind(-3)
            parts = [(h, rows[2 * i], rows[2 * i + 1]) for i, h in enumerate(harmonics)]
            taps.append(_mixed(total, parts, code, self.contrast, phase))
        return torch.cat(taps, dim=-3)

    def expected_from_phasor(
        self,
        phasor: Tensor,
        phasor_axis: FrequencyAxis,
        *,
        steady: Tensor | None = None,
        harmonics: Sequence[int] | None = None,
    ) -> Tensor:
        """The same taps from a phasor image; arguments and errors as in `taps_from_phasor`."""
        taps = taps_from_phasor(
            phasor,
            phasor_axis,
            self.code,
            frequencies_hz=self.frequencies_hz,
            steady=steady,
            harmonics=harmonics,
            contrast=self.contrast,
            calibration=self._known(),
        )
        return taps * self.electrons_per_unit + self.background_e / self.code.num_taps

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, taps={self.code.num_taps}"
