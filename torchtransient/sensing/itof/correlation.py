"""Indirect (amplitude modulated) time of flight: the light that the taps of a pixel collect.

A pixel of N taps shares the light among its taps according to a correlation code (`codes.py`):

    taps_n = (1 / N) sum_k H_k (1 + contrast code_n(f t_k)) + background / N

with H the photoelectrons of the whole exposure per bin, f the modulation frequency and t the time of flight. For a sine
code the phasor ``P(f) = sum H exp(-2 pi i f t)`` holds all that the taps can see, whatever the paths that the light
took: multi-path interference needs no model of its own. Other codes need P at the multiples of f.

Several frequencies follow each other along the tap dimension, frequency-major: (..., C, F N, H, W). What a camera adds
to the phase is an `ItofCalibration`.

A pixel of two taps throws every electron into A or into B. An exposure n with the gate of a code gives
``A_n = (B + A cos(phi - 2 pi n / N)) / 2N`` and, by the opposite gate, ``B_n = (B - A cos(...)) / 2N`` of the light of
all N exposures; the next exposure has its phase a step further on. Cameras report both, or the difference
``D_n = A_n - B_n``, in which unmodulated light cancels and its noise does not: draw A and B, then take the difference,

    Compose([ItofCorrelation(TwoTapCode(sine_code(4)), f, axis), PixelElectronics(...), TapDifference()])

The scene is taken to stand still during all exposures; `tt.PhaseSteps` takes each from a scene of its own.

Sources: Lange & Seitz (2001); Lin et al., "Fourier analysis on transient imaging with a multifrequency
time-of-flight camera" (CVPR 2014); Gutierrez-Barragan et al. (2019). Schwarte et al., "New electro-optical mixing and
correlating sensor" (SPIE 1997); Bamji et al., "A 0.13 um CMOS system-on-chip for a 512 x 424 time-of-flight image
sensor" (IEEE JSSC 2015), differential pixels; Lindner, Schiller, Kolb & Koch, "Time-of-flight sensor calibration for
accurate range sensing" (CVIU 2010), phases of pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.checks import Numbers, real_array, shown
from torchtransient.errors import GradientError, ShapeError, UnitError
from torchtransient.floating import holds, in_single, number_tensor, product
from torchtransient.sensing.checks import check_number, check_transient, no_arrays, reals, refuse_cut_off
from torchtransient.sensing.itof.codes import CorrelationCode, in_direction
from torchtransient.sensing.sensor import Sensor
from torchtransient.units import SPEED_OF_LIGHT

_TURN = 2 * math.pi
_DEEPEST_M = 10.0  # depth that a pixel or its wires may add; millimetres are a thousand times that of cameras


@dataclass(frozen=True, eq=False)
class ItofCalibration:
    """Phases that a camera adds to that of light: raw phase = direction x (phase + offset + maps).

    Maps and offsets add up. Tensors keep their gradients, in `read_itof` and, as an `nn.Parameter`, in an
    `ItofCorrelation` of a sine code. `ItofCorrelation` puts them in, `read_itof` takes them off.

    Attributes:
        phase_offset_rad: offset of all pixels, one number or one for each frequency; a delay in the camera is positive,
            as if the scene were further away.
        direction: -1 for a camera whose phase steps go the other way.
        phase_map_rad: fixed pattern of the pixels, (H, W) for all frequencies or (F, H, W).
        depth_map_m: fixed pattern of the pixels as metres of depth, (H, W), ``4 pi f / c`` radians each (wires and
            drivers are delays).

    Raises:
        UnitError: for numbers that are not finite, more than two turns (degrees?) and depths beyond 10 m
            (millimetres?).
        ShapeError: for other dimensions.
    """

    _: KW_ONLY
    phase_offset_rad: float | Numbers = 0.0
    direction: int = 1
    phase_map_rad: Tensor | None = None
    depth_map_m: Tensor | None = None

    def __post_init__(self) -> None:
        if self.direction not in (1, -1):
            raise UnitError(f"ItofCalibration: expected direction 1 or -1, got {shown(self.direction)}.")
        for name in ("phase_offset_rad", "phase_map_rad", "depth_map_m"):
            object.__setattr__(self, name, no_arrays(getattr(self, name)))
        degrees = "Degrees? Say math.radians(...); a phase of more than a turn is one of less."
        _numbers(self.phase_offset_rad, "phase_offset_rad", (0, 1), 2 * _TURN, degrees)
        _numbers(self.phase_map_rad, "phase_map_rad", (2, 3), 2 * _TURN, degrees)
        _numbers(self.depth_map_m, "depth_map_m", (2,), _DEEPEST_M, "Millimetres? 12 mm are 12e-3.")

    @property
    def learned(self) -> tuple[str, ...]:
        """Names of the tensors that require a gradient."""
        values = {name: getattr(self, name) for name in ("phase_offset_rad", "phase_map_rad", "depth_map_m")}
        return tuple(name for name, v in values.items() if isinstance(v, Tensor) and v.requires_grad)

    def phases_rad(self, frequencies_hz: Numbers) -> Tensor:
        """Sum offset and maps, with their gradients.

        Args:
            frequencies_hz: F modulation frequencies in hertz.

        Returns:
            (F, H, W) float64 on the CPU, (F, 1, 1) without maps.

        Raises:
            ShapeError: for offsets or maps of another number of frequencies, or maps of different sizes.
        """
        hertz = torch.tensor(list(frequencies_hz), dtype=torch.float64).reshape(-1, 1, 1)
        offset = _numbers(self.phase_offset_rad, "phase_offset_rad", (0, 1)).reshape(-1, 1, 1)
        table = _numbers(self.phase_map_rad, "phase_map_rad", (2, 3))
        metres = _numbers(self.depth_map_m, "depth_map_m", (2,))
        if len(offset) not in (1, len(hertz)) or (table.ndim == 3 and len(table) not in (1, len(hertz))):
            raise ShapeError(
                f"ItofCalibration: expected phase offsets and maps of {len(hertz)} frequencies, got "
                f"{tuple(offset.shape)} and {tuple(table.shape)}."
            )
        if table.ndim and metres.ndim and table.shape[-2:] != metres.shape:
            raise ShapeError(
                f"ItofCalibration: expected maps of one size, got {tuple(table.shape)} and {tuple(metres.shape)}."
            )
        return offset + table + metres * hertz * (2 * _TURN / SPEED_OF_LIGHT)


def _numbers(given: object, name: str, dims: tuple[int, ...], most: float = math.inf, why: str = "") -> Tensor:
    """Return finite numbers in float64 on the CPU, with their gradient.

    Raises:
        UnitError: for anything else, and for magnitudes above ``most``.
        ShapeError: for other numbers of dimensions.
    """
    if given is None:
        return torch.zeros((), dtype=torch.float64)
    expected = f"ItofCalibration: expected {name} as finite numbers"
    numbers = number_tensor(given, expected, UnitError).to("cpu", torch.float64)
    if numbers.ndim not in dims or not numbers.numel():
        got = tuple(numbers.shape)
        raise ShapeError(f"ItofCalibration: expected {name} of {dims} dimensions, got the shape {got}.")
    if not holds(torch.isfinite(numbers)):
        raise UnitError(f"{expected}, got {shown(given)}.")
    if not holds(numbers.abs() <= most):
        raise UnitError(
            f"ItofCalibration: expected {name} between -{most:.4g} and {most:.4g}, got up to "
            f"{float(numbers.detach().abs().max()):g}. {why}"
        )
    return numbers


# ------------------------------------------------------------------------------------------------------ weights of bins


_LARGEST = 1 << 22  # numbers of a table of weights of pixels


def harmonic_rows(harmonics: Sequence[int], frequencies: Sequence[float], axis: TimeAxis) -> Tensor:
    """Cosine and sine of every harmonic of every frequency, over the bins.

    Args:
        harmonics: whole numbers.
        frequencies: F modulation frequencies in hertz.
        axis: axis of the light.

    Returns:
        (F x 2 harmonics, T) float64.
    """
    rows = []
    for f in frequencies:
        for h in harmonics:
            # The mean of a cosine over a bin is its value in the middle times sinc.
            turns = h * f * axis.centers_s
            keep = torch.sinc(h * f * axis.edges_s.diff())
            rows += [keep * torch.cos(_TURN * turns), keep * torch.sin(_TURN * turns)]
    return torch.stack(rows)


def taps_by_pixel(x: Tensor, code: CorrelationCode, f: float, axis: TimeAxis, contrast: float, phase: Tensor) -> Tensor:
    """Taps of light, each pixel with weights of its own.

    Args:
        x: light (..., T, H, W).
        code: code of N taps.
        f: modulation frequency in hertz.
        axis: axis of the light.
        contrast: demodulation contrast.
        phase: (H, W) or (1, 1), in radians.

    Returns:
        (..., N, H, W).
    """
    light, bins = x.flatten(-2), axis.num_bins
    turns = (phase.to("cpu", torch.float64) / _TURN % 1.0).flatten()
    turns = turns.expand(light.shape[-1]) if turns.numel() == 1 else turns
    places = axis.edges_s * f
    apart = math.ceil(float(places[-1] - places[0])) + 2.0
    rows = math.prod(light.shape[:-2]) * code.num_taps * bins
    size = max(_LARGEST // max(rows, 1), 1)
    taps = []
    for begin in range(0, light.shape[-1], size):
        here = turns[begin : begin + size]
        # Codes are periodic: whole turns between the pixels make one ascending row of all their edges.
        edges = places + (here + apart * torch.arange(len(here), dtype=torch.float64))[:, None]
        means = torch.nn.functional.pad(code.bin_means(edges.flatten()), (0, 1))
        shape = means.reshape(code.num_taps, len(here), bins + 1)[..., :bins]
        weights = ((1 + contrast * shape) / code.num_taps).movedim(1, -1).to(x)
        # No product of matrices, which autocast would round.
        taps.append((light[..., None, :, begin : begin + size] * weights).sum(-2))
    together = torch.cat(taps, dim=-1)
    return together.reshape(*together.shape[:-1], *x.shape[-2:])


# ---------------------------------------------------------------------------------------------------------- correlation


# One number, a sequence, an array or a tensor of them.
Frequencies = float | Sequence[float] | Tensor | NDArray[Any]


def check_frequencies(frequencies_hz: Frequencies, where: str) -> tuple[float, ...]:
    """Return modulation frequencies as a tuple.

    Args:
        frequencies_hz: one or several modulation frequencies in hertz.
        where: name of the caller, for errors.

    Raises:
        UnitError: unless there are some, between 1 kHz and 1 THz.
    """
    refuse_cut_off(frequencies_hz, "frequencies_hz", where)
    array = real_array(frequencies_hz)
    if array is None or array.ndim > 1 or not array.size:
        raise UnitError(f"{where}: expected modulation frequencies in hertz, got {shown(frequencies_hz)}.")
    return tuple(check_number(f, "frequencies_hz", where, low=1e3, high=1e12) for f in array.reshape(-1).tolist())


def tap_weights(
    code: CorrelationCode,
    frequencies_hz: Frequencies,
    axis: TimeAxis,
    *,
    contrast: float = 1.0,
    calibration: ItofCalibration | None = None,
) -> Tensor:
    """Share of the light of every bin in every tap.

    The shares of the taps sum to one where the code's shifted copies sum to zero (sine, square with half duty and an
    even N or any N of its sine part, every `TwoTapCode`), so that light is conserved. Light is spread evenly over its
    bin.

    Args:
        code: code of N taps.
        frequencies_hz: F modulation frequencies in hertz.
        axis: axis of the light, of T bins.
        contrast: demodulation contrast in [0, 1], 0.5 to 0.9 in cameras.
        calibration: phase offset and direction; maps of pixels are for `ItofCorrelation`.

    Returns:
        (F N, T) float64 on the CPU.

    Raises:
        UnitError: for numbers out of range, and maps of pixels.
        ShapeError: for a code of two taps that is no `TwoTapCode`.
    """
    me = "tap_weights"
    code, values, phases = _checked(code, frequencies_hz, contrast, calibration, me)
    if phases.shape[1:] != (1, 1):
        raise UnitError(f"{me}: expected a calibration without maps of pixels, whose weights ItofCorrelation makes.")
    refuse_cut_off(phases, "calibration", me)
    rows = []
    for f, phase in zip(values, phases.flatten().tolist(), strict=True):
        rows.append((1 + contrast * code.bin_means(axis.edges_s * f + phase / _TURN)) / code.num_taps)
    return torch.cat(rows)


def _checked(
    code: CorrelationCode,
    frequencies_hz: Frequencies,
    contrast: float,
    calibration: ItofCalibration | None,
    me: str,
) -> tuple[CorrelationCode, tuple[float, ...], Tensor]:
    """Return the code in the direction of its steps, frequencies, and the phases (F, 1, 1) or (F, H, W)."""
    check_number(contrast, "contrast", me, high=1.0)
    known = calibration or ItofCalibration()
    if code.num_taps < 3:
        raise ShapeError(
            f"{me}: expected three taps or more, from which phase, amplitude and offset can be told apart, got "
            f"{code.num_taps}. Two phase steps suffice for pixels of two taps: TwoTapCode(code)."
        )
    values = check_frequencies(frequencies_hz, me)
    return in_direction(code, known.direction), values, known.phases_rad(values)


@in_single
def correlate(transient: Tensor, weights: Tensor) -> Tensor:
    """Multiply rows of weights with the time axis of a transient.

    Args:
        transient: (..., C, T, H, W).
        weights: (M, T).

    Returns:
        (..., C, M, H, W).

    Raises:
        ShapeError: when the numbers of bins differ.
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
    """Taps straight from a phasor image, no histogram in between.

    Needed are zero (or ``steady`` instead) and every harmonic of every modulation frequency, to a relative 1e-6;
    negative ones do as well. Harmonics that are left out are lost: a square code kept to the harmonic h misses wiggles
    of about ``1 / h^2`` rad.

    Args:
        phasor: complex photoelectrons (..., C, K, H, W).
        phasor_axis: K frequencies of the phasor.
        code: code of N taps.
        frequencies_hz: F modulation frequencies in hertz.
        steady: total light, (..., C, H, W).
        harmonics: harmonics of the code to keep, for instance ``(1, 3, 5)``; None takes all, which a code with corners,
            that has infinitely many, refuses.
        contrast: demodulation contrast in [0, 1].
        calibration: phase offset and direction; maps of pixels too, (H, W) as the phasor.

    Returns:
        (..., C, F N, H, W).

    Raises:
        ShapeError: for a phasor that does not fit its axis.
        UnitError: for a missing frequency.
    """
    me = "taps_from_phasor"
    if not phasor.is_complex() or phasor.ndim < 4 or phasor.shape[-3] != phasor_axis.num_frequencies:
        raise ShapeError(
            f"{me}: expected a complex phasor (..., C, {phasor_axis.num_frequencies}, H, W), got {phasor.dtype} "
            f"{tuple(phasor.shape)}."
        )
    code, values, phases = _checked(code, frequencies_hz, contrast, calibration, me)
    phases = fitting_pixels(phases, phasor, me)
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


def fitting_pixels(phases: Tensor, x: Tensor, where: str) -> Tensor:
    """Return phases of a calibration if they are those of the pixels of light or frames.

    Args:
        phases: (F, H, W) or (F, 1, 1).
        x: (..., H, W).
        where: name of the caller, for errors.

    Raises:
        ShapeError: for other pixels.
    """
    size = tuple(phases.shape[-2:])
    if size != (1, 1) and size != tuple(x.shape[-2:]):
        raise ShapeError(f"{where}: expected light of {size} pixels, as the calibration's, got {tuple(x.shape)}.")
    return phases


def _component(phasor: Tensor, axis: FrequencyAxis, frequency_hz: float, where: str) -> Tensor:
    """Phasor at one frequency, referred to t = 0: (..., C, H, W) complex."""
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

    Linear but for the background, hence exact in the mean. Noise, saturation and converter follow in
    `PixelElectronics`, the difference of two taps in `TapDifference`; phase and depth in `read_itof`. A map of pixels
    costs one pass over the transient for each harmonic of a sine code; a code with corners needs weights of N T numbers
    for every pixel, made anew in every call.

    Args:
        code: code of N taps.
        frequencies_hz: F modulation frequencies in hertz.
        axis: axis of the light.
        contrast: demodulation contrast in [0, 1], see `tap_weights`.
        background_e: electrons of unmodulated light. Light and background are those of *all* N phase steps of a
            frequency and all taps together, which share them equally.
        electrons_per_unit: electrons for light of 1, factor from a radiance to electrons.
        calibration: phase offsets, direction of the steps, maps of pixels; an `nn.Parameter` in it is learnt, with a
            `FourierCode`.

    Raises:
        UnitError: for numbers out of range.
        ShapeError: for a code of two taps that is no `TwoTapCode`, and for light of other pixels than those of the map.
        GradientError: for a calibration that requires a gradient otherwise.
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
        calibration: ItofCalibration | None = None,
    ) -> None:
        super().__init__()
        me = type(self).__name__
        self.code = code
        self.axis = axis
        self.background_e = check_number(background_e, "background_e", me)
        self.electrons_per_unit = check_number(electrons_per_unit, "electrons_per_unit", me, open_low=True)
        self.calibration = calibration
        self._turned, self.frequencies_hz, phases = _checked(code, frequencies_hz, contrast, calibration, me)
        self.contrast = float(contrast)
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
        self.register_buffer("weights", self._weights())
        self.num_bins = axis.num_bins

    def _of_one(self, phases: Tensor) -> bool:
        """Return True if all pixels have the same phases, which are then in the weights."""
        return not self._learnt and phases.shape[1:] == (1, 1)

    def _weights(self) -> Tensor:
        if self._of_one(self.phases_rad):
            return tap_weights(
                self.code, self.frequencies_hz, self.axis, contrast=self.contrast, calibration=self._known()
            )
        if self._turned.harmonics is not None:
            return harmonic_rows(self._turned.harmonics, self.frequencies_hz, self.axis)
        return torch.zeros(0, self.axis.num_bins, dtype=torch.float64)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *others: Any) -> None:
        """Take phases of another size with the state; refuse the weights of another camera."""
        phases, given = (state_dict.get(prefix + name) for name in ("phases_rad", "weights"))
        if isinstance(phases, Tensor) and phases.shape[:-2] == (len(self.frequencies_hz),) and not self._learnt:
            self.phases_rad = phases.detach().to(self.weights.device, copy=True)
        own = self.weights = self._weights().to(self.weights)
        if isinstance(given, Tensor) and given.shape == own.shape:
            # as much as rounding to their dtype leaves
            slack = 4 * max(torch.finfo(given.dtype).eps, torch.finfo(own.dtype).eps, 1e-9)
            if not torch.allclose(own.to(given), given, rtol=0, atol=slack):
                raise UnitError(
                    "ItofCorrelation.load_state_dict: expected the state of a camera with the code, frequencies, axis, "
                    "contrast and direction of this one, got weights of another."
                )
        super()._load_from_state_dict(state_dict, prefix, *others)

    def _known(self) -> ItofCalibration:
        """Return the calibration with the parameters and phases as they are now."""
        if self.calibration is not None and self._learnt:
            return replace(self.calibration, **{name: getattr(self, name) for name in self._learnt})
        direction = 1 if self.calibration is None else self.calibration.direction
        if self.phases_rad.shape[1:] == (1, 1):
            return ItofCalibration(phase_offset_rad=self.phases_rad.flatten(), direction=direction)
        return ItofCalibration(direction=direction, phase_map_rad=self.phases_rad)

    def _phases(self) -> Tensor | None:
        """Return phases of pixels that differ, else None."""
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
        fitting_pixels(phases, check_transient(x, "ItofCorrelation"), "ItofCorrelation")
        code, harmonics = self._turned, self._turned.harmonics
        if harmonics is None:
            given = zip(self.frequencies_hz, phases, strict=True)
            found = [taps_by_pixel(x, code, f, self.axis, self.contrast, p) for f, p in given]
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
        self, phasor: Tensor, phasor_axis: FrequencyAxis, *, steady: Tensor | None = None
    ) -> Tensor:
        """Taps from a phasor image in place of a transient; see `taps_from_phasor`.

        Args:
            phasor: complex (..., C, K, H, W).
            phasor_axis: K frequencies of the phasor.
            steady: total light, (..., C, H, W), where the phasor does not hold zero.

        Returns:
            (..., C, F N, H, W).
        """
        taps = taps_from_phasor(
            phasor,
            phasor_axis,
            self.code,
            frequencies_hz=self.frequencies_hz,
            steady=steady,
            contrast=self.contrast,
            calibration=self._known(),
        )
        return taps * self.electrons_per_unit + self.background_e / self.code.num_taps

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, taps={self.code.num_taps}"


# ---------------------------------------------------------------------------------------------- differences of two taps


class TapDifference(Sensor):
    """Taps A_0, B_0, A_1, B_1, ... (..., C, 2 M, H, W) to the differences ``A - B`` (..., C, M, H, W).

    Stands behind the `PixelElectronics` that draw the noise of both taps. A camera that digitizes the difference has
    its converter in a second one behind it, of signed codes, `PixelElectronics(shot_noise=False, gain_e_per_dn=...,
    bits=..., signed=True)`, or with a black level in the middle of its range: `Compose` refuses one without room below
    zero, which would clip every negative difference, and shot noise of a difference, which has none of its own. An odd
    number of taps is a ShapeError.
    """

    gives = "the same"

    def expected(self, x: Tensor) -> Tensor:
        check_transient(x, "TapDifference")
        if x.shape[-3] % 2:
            raise ShapeError(
                f"TapDifference: expected taps A and B in turn, (..., C, 2 M, H, W), got {tuple(x.shape)}. Make them "
                "with ItofCorrelation(TwoTapCode(...), ...)."
            )
        return x[..., 0::2, :, :] - x[..., 1::2, :, :]
