"""How an indirect time-of-flight camera is built: pixels of two taps, the difference of both, phases it gets wrong.

A pixel of two taps throws every electron into A or into B. An exposure n with the gate of a code gives
``A_n = (B + A cos(phi - 2 pi n / N)) / 2N`` and, by the opposite gate, ``B_n = (B - A cos(...)) / 2N`` of the light of
all N exposures; the next exposure has its phase a step further on. Cameras report both, or the difference
``D_n = A_n - B_n``, in which unmodulated light cancels and its noise does not: draw A and B, then take the difference,

    Compose([ItofCorrelation(TwoTapCode(sine_code(4)), f, axis), PixelElectronics(...), TapDifference()])

The scene is taken to stand still during all exposures; `tt.PhaseSteps` takes each from a scene of its own.

Sources: Schwarte et al., "New electro-optical mixing and correlating sensor" (SPIE 1997); Bamji et al., "A 0.13 um
CMOS system-on-chip for a 512 x 424 time-of-flight image sensor" (IEEE JSSC 2015), differential pixels; Lindner,
Schiller, Kolb & Koch, "Time-of-flight sensor calibration for accurate range sensing" (CVIU 2010), phases of pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass

import torch
from torch import Tensor

from torchtransient.checks import Numbers, real_array, shown
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import holds
from torchtransient.sensing.base.given import check_dense, no_arrays
from torchtransient.sensing.base.layout import check_transient
from torchtransient.sensing.base.sensor import Sensor
from torchtransient.sensing.itof.itof_codes import CorrelationCode
from torchtransient.units import SPEED_OF_LIGHT

_TURN = 2 * math.pi
_DEEPEST_M = 10.0  # depth that a pixel or its wires may add; millimetres are a thousand times that of cameras


class TwoTapCode(CorrelationCode):
    """Pixels of two taps: the 2 N taps A_0, B_0, A_1, B_1, ... of a code of N gates, with B the opposite of A.

    ``code``: of any kind, with N >= 2 phase steps, exposed one after another. Light is conserved whatever the code.
    For a pixel whose B is not the opposite of its A, measure both and give 2 N functions to `measured_code`. Raises
    UnitError for what is no code or has two taps already.
    """

    def __init__(self, code: CorrelationCode) -> None:
        if not isinstance(code, CorrelationCode) or isinstance(code, TwoTapCode):
            raise UnitError(f"TwoTapCode: expected a code of one tap such as sine_code(4), got {shown(code)}.")
        self.code = code
        self.num_taps = 2 * code.num_taps
        self.shifts = None

    def evaluate(self, turns: Tensor) -> Tensor:
        return _with_opposites(self.code.evaluate(turns))

    def bin_means(self, edges_turns: Tensor) -> Tensor:
        return _with_opposites(self.code.bin_means(edges_turns))

    def coefficients(self, harmonics: Sequence[int]) -> Tensor:
        return _with_opposites(self.code.coefficients(harmonics))

    @property
    def harmonics(self) -> tuple[int, ...] | None:
        return self.code.harmonics


class ReversedCode(CorrelationCode):
    """A code whose phase steps go the other way: tap n is moved by minus its shift.

    Raises UnitError for a code that is not one function moved along (`CorrelationCode.shifts` is None).
    """

    def __init__(self, code: CorrelationCode) -> None:
        if not isinstance(code, CorrelationCode) or code.shifts is None:
            raise UnitError(
                "ReversedCode: expected a code of one function moved along, whose steps have a direction, got "
                f"{shown(code)}. Give measured or Hamiltonian codes in the order that the camera has."
            )
        self.code = code
        self.num_taps = code.num_taps
        self.shifts = -code.shifts % 1.0
        self._back = 2 * code.shifts

    def evaluate(self, turns: Tensor) -> Tensor:
        return torch.stack([self.code.evaluate(turns + float(s))[n] for n, s in enumerate(self._back)])

    def bin_means(self, edges_turns: Tensor) -> Tensor:
        return torch.stack([self.code.bin_means(edges_turns + float(s))[n] for n, s in enumerate(self._back)])

    def coefficients(self, harmonics: Sequence[int]) -> Tensor:
        turns = self._back[:, None] * torch.tensor(list(harmonics), dtype=torch.float64)
        return self.code.coefficients(harmonics) * torch.exp(1j * _TURN * turns)

    @property
    def harmonics(self) -> tuple[int, ...] | None:
        return self.code.harmonics


def in_direction(code: CorrelationCode, direction: int) -> CorrelationCode:
    """The code itself for +1; with its phase steps reversed for -1. Errors as `ReversedCode`."""
    if direction == 1:
        return code
    return TwoTapCode(ReversedCode(code.code)) if isinstance(code, TwoTapCode) else ReversedCode(code)


def _with_opposites(weights: Tensor) -> Tensor:
    return torch.stack([weights, -weights], dim=1).flatten(0, 1)


class TapDifference(Sensor):
    """Taps A_0, B_0, A_1, B_1, ... (..., C, 2 M, H, W) to the differences ``A - B`` (..., C, M, H, W).

    Stands behind the `PixelElectronics` that draw the noise of both taps. A camera that digitizes the difference has
    its converter in a second one behind it, of signed codes, `PixelElectronics(shot_noise=False, gain_e_per_dn=...,
    bits=..., signed=True)`, or with a black level in the middle of its range: `Compose` refuses one without room below
    zero, which would clip every negative difference, and shot noise of a difference, which has none of its own. Raises
    ShapeError for an odd number of taps.
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


@dataclass(frozen=True, eq=False)
class ItofCalibration:
    """What a camera adds to the phase of light: raw phase = direction x (phase + offset + maps).

    ``phase_offset_rad``: of all pixels, one number or one for each frequency; a delay in the camera is positive, as if
    the scene were further away. ``direction``: -1 for a camera whose phase steps go the other way. ``phase_map_rad``:
    fixed pattern of the pixels, (H, W) for all frequencies or (F, H, W). ``depth_map_m``: the same as metres of depth,
    (H, W), ``4 pi f / c`` radians each (wires and drivers are delays). Maps and offsets add up. Tensors keep their
    gradients, in `read_itof` and, as an `nn.Parameter`, in an `ItofCorrelation` of a sine code.

    `ItofCorrelation` puts them in, `read_itof` takes them off. Raises UnitError, for more than two turns (degrees?)
    and for depths beyond 10 m (millimetres?) too, and ShapeError.
    """

    _: KW_ONLY
    phase_offset_rad: float | Numbers = 0.0
    direction: int = 1
    phase_map_rad: Tensor | None = None
    depth_map_m: Tensor | None = None

    def __post_init__(self) -> None:
        if isinstance(self.direction, bool) or self.direction not in (1, -1):
            raise UnitError(f"ItofCalibration: expected direction 1 or -1, got {shown(self.direction)}.")
        object.__setattr__(self, "direction", int(self.direction))
        for name in ("phase_offset_rad", "phase_map_rad", "depth_map_m"):
            object.__setattr__(self, name, no_arrays(getattr(self, name), "ItofCalibration"))
        degrees = "Degrees? Say math.radians(...); a phase of more than a turn is one of less."
        _numbers(self.phase_offset_rad, "phase_offset_rad", (0, 1), 2 * _TURN, degrees)
        _numbers(self.phase_map_rad, "phase_map_rad", (2, 3), 2 * _TURN, degrees)
        _numbers(self.depth_map_m, "depth_map_m", (2,), _DEEPEST_M, "Millimetres? 12 mm are 12e-3.")

    @property
    def learned(self) -> tuple[str, ...]:
        """Names of what requires a gradient."""
        values = {name: getattr(self, name) for name in ("phase_offset_rad", "phase_map_rad", "depth_map_m")}
        return tuple(name for name, v in values.items() if isinstance(v, Tensor) and v.requires_grad)

    @property
    def has_map(self) -> bool:
        """Whether pixels differ."""
        return self.phase_map_rad is not None or self.depth_map_m is not None

    def phases_rad(self, frequencies_hz: Numbers) -> Tensor:
        """(F, H, W) float64 on the CPU: offset and maps together, (F, 1, 1) without maps, with their gradients.

        Raises ShapeError when offsets or maps are of another number of frequencies, or maps of different sizes.
        """
        count = len(frequencies_hz)
        offset = _numbers(self.phase_offset_rad, "phase_offset_rad", (0, 1))
        total = (offset.expand(count) if offset.numel() == 1 else offset).reshape(-1, 1, 1)
        if total.shape[0] != count:
            raise ShapeError(
                f"ItofCalibration: expected phase_offset_rad as one number or {count}, got {offset.numel()}."
            )
        if self.phase_map_rad is not None:
            table = _numbers(self.phase_map_rad, "phase_map_rad", (2, 3))
            if table.ndim == 3 and table.shape[0] not in (1, count):
                raise ShapeError(
                    f"ItofCalibration: expected phase_map_rad (H, W) or ({count}, H, W), got {tuple(table.shape)}."
                )
            total = total + table
        if self.depth_map_m is not None:
            metres = _numbers(self.depth_map_m, "depth_map_m", (2,))
            if self.phase_map_rad is not None and metres.shape != total.shape[1:]:
                raise ShapeError(
                    f"ItofCalibration: expected maps of one size, got {tuple(total.shape[1:])} and "
                    f"{tuple(metres.shape)}."
                )
            hertz = torch.tensor(list(frequencies_hz), dtype=torch.float64).reshape(-1, 1, 1)
            total = total + metres * hertz * (2 * _TURN / SPEED_OF_LIGHT)
        return total


def _numbers(given: object, name: str, dims: tuple[int, ...], most: float = math.inf, why: str = "") -> Tensor:
    """float64 on the CPU, with its gradient. UnitError for what holds no finite numbers or larger ones than ``most``,
    ShapeError for other numbers of dimensions.
    """
    if given is None:
        return torch.zeros((), dtype=torch.float64)
    if isinstance(given, Tensor) and given.is_floating_point():
        numbers = check_dense(given, "ItofCalibration", name).to("cpu", torch.float64)
    else:
        array = real_array(given)
        if array is None:
            raise UnitError(f"ItofCalibration: expected {name} as finite numbers, got {shown(given)}.")
        numbers = torch.from_numpy(array)
    if numbers.ndim not in dims or not numbers.numel():
        got = tuple(numbers.shape)
        raise ShapeError(f"ItofCalibration: expected {name} of {dims} dimensions, got the shape {got}.")
    if not holds(torch.isfinite(numbers)):
        raise UnitError(f"ItofCalibration: expected {name} as finite numbers, got {shown(given)}.")
    if not holds(numbers.abs() <= most):
        raise UnitError(
            f"ItofCalibration: expected {name} between -{most:.4g} and {most:.4g}, got up to "
            f"{float(numbers.detach().abs().max()):g}. {why}"
        )
    return numbers
