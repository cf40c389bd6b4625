"""Stages of a chain: the walk through them, what each takes and gives, and the order that they need.

A row is what light passes one after another, the stages of a `Compose`. Branches are what it passes one of: the sensors
of `PixelGroups`. Everything else is one stage. Stages in a row have to agree on bins, laser cycles, the laser period
and on the quantity that one gives and the next takes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor, nn

from torchtransient.axes import TimeAxis
from torchtransient.checks import as_number
from torchtransient.errors import ArgumentError, UnitError
from torchtransient.sensing.afterpulsing import Afterpulsing
from torchtransient.sensing.afterpulsing_spad import AfterpulsingSPAD
from torchtransient.sensing.electronics import PixelElectronics
from torchtransient.sensing.gated import GatedIntegration
from torchtransient.sensing.impulse_response import ImpulseResponse
from torchtransient.sensing.itof.correlation import TapDifference
from torchtransient.sensing.photon_budget import PhotonBudget
from torchtransient.sensing.sensor import SAME_BIN, Quantity, RandomSensor, Sensor, bins_text
from torchtransient.sensing.spatial_psf import LensBlur, SpatialPSF
from torchtransient.sensing.timing import TDC, DetectionJitter, DetectionSkew, PixelSkew, SweepJitter

Way = Literal["sample", "gaussian"]
Places = list[tuple[str, nn.Module]]


def flat(stages: Iterable[nn.Module]) -> list[nn.Module]:
    """Return stages one by one, those in torch's own rows that hold sensors too, which know no generator.

    Args:
        stages: stages in a row.
    """
    found: list[nn.Module] = []
    for stage in stages:
        row = isinstance(stage, nn.ModuleList) or getattr(type(stage), "forward", None) is nn.Sequential.forward
        if row and any(isinstance(part, Sensor) for part in stage.modules()):
            found += flat(stage)  # type: ignore[arg-type]
        else:
            found.append(stage)
    return found


def branches_of(stage: nn.Module) -> Places:
    """Return the sensors of which every pixel passes one, with their names; none for a stage without branches.

    Args:
        stage: a stage of a chain.
    """
    inner = getattr(stage, "sensors", None) if isinstance(stage, Sensor) else None
    return list(numbered(inner)) if isinstance(inner, nn.ModuleList) else []


def in_order(stages: Iterable[tuple[str, nn.Module]], prefix: str = "") -> Iterator[tuple[str, nn.Module]]:
    """Yield the single stages of chains in chains, in the order of the light, with places: ``0``, ``1.0``, ``1.1``.

    Args:
        stages: stages by their names.
        prefix: text in front of names.
    """
    for name, stage in stages:
        row = getattr(stage, "stages", None) if isinstance(stage, Sensor) else None
        if isinstance(row, nn.ModuleList):
            yield from in_order(numbered(row), f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", stage


def numbered(stages: Iterable[nn.Module]) -> Iterator[tuple[str, nn.Module]]:
    """Return stages with their numbers for names.

    Args:
        stages: stages in a row.
    """
    return ((str(number), stage) for number, stage in enumerate(stages))


def draws(stage: nn.Module) -> bool:
    """Return True if anything in a stage draws.

    Args:
        stage: a stage of a chain.
    """
    return any(isinstance(part, RandomSensor) for part in stage.modules())


def check_draws(stages: Iterable[nn.Module], where: str) -> None:
    """Check that stages with random sensors inside can be drawn: they would hand on means.

    Args:
        stages: stages in a row.
        where: name of the caller, for errors.

    Raises:
        ArgumentError: for a stage without `expected` and `sample`.
    """
    for name, stage in in_order(numbered(stages)):
        if draws(stage) and not (isinstance(stage, Sensor) and callable(getattr(stage, "sample", None))):
            inside = sorted({type(part).__name__ for part in stage.modules() if isinstance(part, RandomSensor)})
            raise ArgumentError(
                f"{where}: expected sensors that can be drawn, got stage '{name}' ({type(stage).__name__}) with "
                f"{', '.join(inside)} inside and no sample(x, generator). Give its parts as stages."
            )


def ends_of(stages: Iterable[nn.Module]) -> tuple[tuple[Quantity, ...], Quantity | str | None]:
    """Return the quantities that a row takes and gives, as `Sensor.takes` and `Sensor.gives`.

    Args:
        stages: stages in a row.
    """
    takes: tuple[Quantity, ...] = ()
    gives: Quantity | str | None = "the same"
    for _, stage in in_order(numbered(stages)):
        if not isinstance(stage, Sensor):
            gives = None
            continue
        if gives == "the same" and not takes:
            takes = stage.takes
        if stage.gives != "the same":
            gives = stage.gives
    return takes, gives


# --------------------------------------------------------------------------------------- one stage, in four ways


def mean_of(stage: nn.Module, x: Tensor) -> Tensor:
    """Mean of one stage.

    Args:
        stage: a stage of a chain.
        x: light of the stage.
    """
    result: Tensor = stage.expected(x) if isinstance(stage, Sensor) else stage(x)
    return result


def draw_of(way: Way, stage: nn.Module, x: Tensor, generator: torch.Generator | None) -> Tensor:
    """Draw one stage whatever its policy; the mean of one that draws nothing.

    Args:
        way: "sample", or "gaussian" for the normal surrogate.
        stage: a stage of a chain.
        x: light of the stage.
        generator: source of randomness.
    """
    draw = getattr(stage, way, None) if isinstance(stage, Sensor) else None
    result: Tensor = mean_of(stage, x) if draw is None else draw(x, generator)
    return result


def measurement_of(stage: nn.Module, x: Tensor, generator: torch.Generator | None) -> Tensor:
    """Measure light with one stage under its own policy.

    Args:
        stage: a stage of a chain.
        x: light of the stage.
        generator: source of randomness.
    """
    result: Tensor = stage(x, generator=generator) if isinstance(stage, Sensor) else stage(x)
    return result


# -------------------------------------------------------------------- agreement of bins, quantities, cycles and periods


# Periods written as 1/rate or as a number of bins were rounded on the way.
_SAME_PERIOD = 1e-6

_WORDS: dict[Quantity, str] = {
    "radiance": "radiance",
    "rate": "detections per laser cycle and bin",
    "electrons": "mean electrons, or photons, of a whole exposure",
    "counts": "counts that a detector has drawn",
}


@dataclass(frozen=True)
class Stage:
    """Sensor in a chain, with its name for messages."""

    name: str
    sensor: Sensor

    def __str__(self) -> str:
        return f"stage '{self.name}' ({type(self.sensor).__name__})"


@dataclass(frozen=True)
class _Light:
    """Light between two stages, and the stages that its quantity and bins are known from."""

    quantity: Quantity | None = None
    giver: Stage | None = None
    cycles: int = 1  # of the exposure that a rate per cycle belongs to
    width: Stage | None = None
    number: Stage | None = None  # of bins
    background: bool = False  # behind a budget with ambient light or dark counts
    behind: str | None = None  # detector that has made counts of it
    codes: str | None = None  # converter that has made codes of its bins
    difference: bool = False  # behind a difference of taps
    pulses: bool = False  # the detector has afterpulses of its own

    def unknown(self) -> _Light:
        """Return light whose quantity and bins are not known any more."""
        return replace(self, quantity=None, giver=None, cycles=1, width=None, number=None)

    def also(self, other: _Light) -> _Light:
        """Return light of which pixels have passed one or the other, in the bins of the other."""
        return replace(
            self,
            width=other.width,
            number=other.number,
            background=self.background or other.background,
            behind=self.behind or other.behind,
            codes=self.codes or other.codes,
            difference=self.difference or other.difference,
            pulses=self.pulses or other.pulses,
        )


def check_chain(chain: nn.Module, stages: Iterable[nn.Module]) -> bool:
    """Check the order of a chain, and that each stage takes what the stages before it give.

    Compared are bins, `cycles`, laser periods and quantities. The output of a module of another kind, or of a sensor
    without `gives`, is unknown: behind these, bins and quantities are compared anew. The order concerns constant light
    and ends of windows, rates and counts.

    Args:
        chain: a chain.
        stages: stages of the chain.

    Returns:
        True if `check_window` has to be called again for light whose bins are known.

    Raises:
        UnitError: for stages that do not go together, and where constant light would starve at the end of a window, or
            counts would be averaged.
    """
    _through(list(in_order(numbered(stages))), _Light(), [])
    parts = _parts_of(chain)
    _check_cycles(parts)
    check_dead_times(chain)
    check_window(chain, None)
    periods = [getattr(part.sensor, n, None) for part in parts for n in ("repetition_rate_hz", "period_s")]
    return any(isinstance(p, float) for p in periods) and any(_bins(part)[1] is None for part in parts)


def _through(row: Places, light: _Light, after: list[nn.Module]) -> _Light:
    """Compare each stage in a row with its light and the stages `after` it, and return the light behind."""
    for place, (name, module) in enumerate(row):
        if not isinstance(module, Sensor):
            light = light.unknown()
            continue
        stage, branches = Stage(name, module), branches_of(module)
        rest = [later for _, later in row[place + 1 :]] + after
        if not branches:
            _check_place(module, light, rest)
        _check_quantity(light, stage)
        passed = _same_bins(light, stage)
        for branch, sensor in branches:
            passed = passed.also(_through(list(in_order([(f"{name}.{branch}", sensor)])), light, rest))
        light = _after(stage, passed if branches else _passed(module, passed))
    return light


def _parts_of(chain: nn.Module) -> list[Stage]:
    """Return every sensor of a chain with its place, parts of other sensors too."""
    found = chain.named_modules(remove_duplicate=False)
    return [Stage(n.replace("stages.", ""), s) for n, s in found if s is not chain and isinstance(s, Sensor)]


# ------------------------------------------------------------------------------------------------------------- bins


def check_axis(sensor: nn.Module, axis: TimeAxis) -> None:
    """Check that a sensor and its parts were made for the bins of an axis.

    Args:
        sensor: sensor or chain.
        axis: axis of the light.

    Raises:
        UnitError: for other bins.
    """
    for name, module in sensor.named_modules():
        if not isinstance(module, Sensor):
            continue  # a measured response has bins of its own
        own, stage = getattr(module, "axis", None), Stage(name or "0", module)
        width, number = _bins(stage)
        same = number in (None, axis.num_bins)
        same &= width is None or abs(width - axis.bin_width_s) * axis.num_bins <= SAME_BIN * axis.bin_width_s
        if isinstance(own, TimeAxis):
            same &= abs(own.start_opl - axis.start_opl) <= SAME_BIN * axis.bin_width_opl
        if not same:
            raise UnitError(
                f"sensor: expected the axis of {stage}, {own or bins_text(width, number)}, got {axis}. Make the sensor "
                "with the renderer's axis."
            )


def _same_bins(light: _Light, stage: Stage) -> _Light:
    """Add the bins of a stage to the light; UnitError for a stage that was made for others."""
    width, number = _bins(stage)
    other: Stage | None = None
    if light.number is not None and number not in (None, _bins(light.number)[1]):
        other = light.number
    if light.width is not None and width is not None:
        known, bins = _bins(light.width)
        if abs(width - (known or 0.0)) * max(number or 1, bins or 1) > SAME_BIN * width:
            other = light.width
    if other is not None:
        raise UnitError(
            f"Compose: expected one time axis for all stages, got {bins_text(*_bins(other))} in {other} and "
            f"{bins_text(width, number)} in {stage}."
        )
    return replace(
        light, width=light.width if width is None else stage, number=light.number if number is None else stage
    )


def _bins(stage: Stage) -> tuple[float | None, int | None]:
    """Return width in seconds and number of the bins that a sensor was made for; None where any fits."""
    axis, width = getattr(stage.sensor, "axis", None), as_number(getattr(stage.sensor, "bin_width_s", None))
    if isinstance(axis, TimeAxis):
        return axis.bin_width_s, axis.num_bins
    return width, stage.sensor.num_bins


# ------------------------------------------------------------------------------------------------------- quantities


def _check_quantity(light: _Light, stage: Stage) -> None:
    """Raise UnitError for a stage that takes other light than the stages before it give."""
    takes, given = stage.sensor.takes, light.quantity
    if not takes or given is None or given in takes:
        return
    per_cycle = given == "rate" and "electrons" in takes
    # of one cycle, or made into those of all of them
    if per_cycle and (light.cycles == 1 or getattr(stage.sensor, "electrons_per_unit", 1.0) != 1.0):
        return
    wanted = " or ".join(_WORDS[t] for t in takes)
    raise UnitError(
        f"Compose: expected {wanted} for {stage}, got {_WORDS[given]} of {light.giver}. {_what_to_do(light, takes)}"
    )


def _what_to_do(light: _Light, takes: tuple[Quantity, ...]) -> str:
    if light.quantity == "rate" and "electrons" in takes:
        return (
            f"They are those of one of {light.cycles} cycles. Count them with SynchronousSPAD({light.cycles}), or give "
            f"electrons_per_unit={light.cycles} where the stage has it."
        )
    if light.quantity == "rate" and "counts" in takes:
        return "Put the detector between them: SynchronousSPAD, FreeRunningSPAD or BinaryFrames."
    if "radiance" in takes:
        return "PhotonBudget takes what a renderer gives."
    if light.quantity == "counts":
        return "Light is counted once: leave one of them out, or say PixelElectronics(shot_noise=False)."
    return "Electrons of an exposure are no rates per cycle: leave one of the two out."


def _after(stage: Stage, light: _Light) -> _Light:
    gives = stage.sensor.gives
    if gives == "the same":
        return light
    if gives is None:
        return light.unknown()
    cycles = getattr(stage.sensor, "cycles", 1)
    light = light.unknown() if gives == "electrons" else light  # taps and gates stand where bins were
    return replace(light, quantity=gives, giver=stage, cycles=cycles if isinstance(cycles, int) else 1)


# ----------------------------------------------------------------------------------------------- cycles and periods


def _check_cycles(stages: list[Stage]) -> None:
    """Raise UnitError for stages that count different numbers of laser cycles."""
    counting = [(s, s.sensor.cycles) for s in stages if isinstance(getattr(s.sensor, "cycles", None), int)]
    for stage, cycles in counting[1:]:
        first, wanted = counting[0]
        if cycles != wanted:
            raise UnitError(
                f"Compose: expected one number of cycles in all stages, got {wanted} in {first} and {cycles} in "
                f"{stage}. Give the detector budget.cycles; change both in a Device."
            )


def check_window(chain: nn.Module, num_bins: int | None) -> None:
    """Check that bins, dead times and the laser period of a chain go together.

    A `FreeRunningSPAD` takes its bins for the whole period, and so does an `Afterpulsing` without `period_s`; any other
    detector has to be armed again when the next cycle begins, with the dead time of its afterpulses as with its own.
    The period is that of a `PhotonBudget`, or without one the `period_s` of an Afterpulsing.

    Args:
        chain: a chain.
        num_bins: bins of the light; None leaves out the window of stages that were made with a width alone.

    Raises:
        UnitError: if they do not.
    """
    stages = _parts_of(chain)
    rates = [(s, getattr(s.sensor, "repetition_rate_hz", None)) for s in stages]
    budgets = [(s, 1 / rate) for s, rate in rates if isinstance(rate, float)]
    for budget, period_s in budgets:
        for stage in stages:
            _check_period(budget, period_s, stage, num_bins)
    goes_on = any(s.sensor.takes == ("rate",) and s.sensor.window_is_period for s in stages)
    for stage in stages:
        own = getattr(stage.sensor, "period_s", None)
        if not goes_on and isinstance(_dead_time(stage), float):
            for budget, period_s in budgets:
                _check_armed(budget, period_s, stage, num_bins)
            if not budgets and isinstance(own, float):
                _check_armed(stage, own, stage, num_bins)


def _dead_time(stage: Stage) -> float | None:
    dead_s = getattr(stage.sensor, "dead_time_s", None)
    if isinstance(dead_s, Tensor):  # learnt
        return float(dead_s.detach()) if dead_s.numel() == 1 else None
    return float(dead_s) if isinstance(dead_s, (int, float)) else None


def _check_period(budget: Stage, period_s: float, stage: Stage, num_bins: int | None) -> None:
    own = getattr(stage.sensor, "period_s", None)
    if isinstance(own, float):
        if not math.isclose(own, period_s, rel_tol=_SAME_PERIOD):
            raise UnitError(
                f"Compose: expected the laser period of {budget}, {period_s:g} s, in {stage}, got {own:g} s. Give it "
                "period_s=1 / repetition_rate_hz."
            )
        return
    width_s, own_number = _bins(stage)
    number = own_number or num_bins
    if width_s is None or number is None or not stage.sensor.window_is_period:
        return
    if not math.isclose(number * width_s, period_s, rel_tol=_SAME_PERIOD):
        raise UnitError(
            f"Compose: expected the bins of {stage} to be one laser period of {budget}, {period_s:g} s, got {number} "
            f"bins of {width_s:g} s. Take an axis of the whole period; Afterpulsing takes period_s= as well."
        )


def _check_armed(giver: Stage, period_s: float, stage: Stage, num_bins: int | None) -> None:
    """Raise UnitError for a detector that is still dead when the next cycle begins."""
    (width_s, number), dead_s = _bins(stage), _dead_time(stage) or 0.0
    # what is not known yet is looked at when light comes
    window_s = 0.0 if width_s is None else (number or num_bins or 0) * width_s
    if dead_s and window_s + dead_s > period_s * (1 + _SAME_PERIOD):
        raise UnitError(
            f"Compose: expected {stage} to be armed again before the next cycle of {giver}, {period_s:g} s later, got "
            f"a window of {window_s:g} s and a dead time of {dead_s:g} s. Else take a FreeRunningSPAD."
        )


def check_dead_times(chain: nn.Module) -> None:
    """Check that an `Afterpulsing` has the dead time of the detector before it: one detector has one.

    A detector of one detection per cycle has none of its own. In `PixelGroups`, whose sensors stand beside one another,
    the dead time has to be that of one of them.

    Args:
        chain: a chain.

    Raises:
        UnitError: for another dead time.
    """
    before: list[Stage] = []
    for stage in _parts_of(chain):
        dead_s = _dead_time(stage)
        if dead_s is None:
            continue
        if stage.sensor.takes == ("rate",):
            before.append(stage)
        elif stage.sensor.takes == ("counts",):
            others = [s for s in before if not math.isclose(_dead_time(s) or 0.0, dead_s, rel_tol=1e-6, abs_tol=1e-15)]
            grouped = ".sensors." in f".{stage.name}."
            if others and (not grouped or len(others) == len(before)):
                raise UnitError(
                    f"Compose: expected the dead time of {others[0]}, {_dead_time(others[0]):g} s, in {stage}, got "
                    f"{dead_s:g} s. One detector has one dead time."
                )


# ---------------------------------------------------------------------------------------------------------------- order


_MOVES = (DetectionJitter, DetectionSkew)
# what spreads light over bins or pixels, and would average counts
_SPREADS = (ImpulseResponse, LensBlur, PixelSkew, SpatialPSF, SweepJitter)
# share of a gate outside the window that starves no image by more than the rounding of a count
_OUTSIDE = 1e-6

_PULSE_AND_JITTER = (
    "The pulse of the laser stays an ImpulseResponse and goes in front of the PhotonBudget; the jitter of the detector "
    "and its timing becomes a DetectionJitter of the same response behind the detector, where every detection moves."
)


def has_background(budget: PhotonBudget) -> bool:
    """Return True if a budget adds ambient light or dark counts, or may learn to.

    Args:
        budget: the budget.
    """
    rates = (torch.as_tensor(rate) for rate in (budget.ambient_rate_hz, budget.dark_count_rate_hz))
    return any(rate.requires_grad or bool((rate > 0).any()) for rate in rates)


def _detects(stage: nn.Module) -> bool:
    """Return True if a stage makes counts of light."""
    return isinstance(stage, Sensor) and stage.gives == "counts" and bool({"rate", "electrons"} & set(stage.takes))


def _passed(stage: Sensor, seen: _Light) -> _Light:
    if isinstance(stage, PhotonBudget):
        return replace(seen, background=seen.background or has_background(stage))
    if isinstance(stage, TDC) and stage.acts_on == "detections":
        return replace(seen, codes=type(stage).__name__)
    if isinstance(stage, TapDifference):
        return replace(seen, difference=True)
    # charge behind an amplifier is spread like light, by a phosphor for instance
    if stage.gives == "counts" and not isinstance(stage, PixelElectronics):
        pulses = seen.pulses or any(isinstance(part, AfterpulsingSPAD) for part in stage.modules())
        return replace(seen, behind=seen.behind or type(stage).__name__, pulses=pulses)
    return seen


def _check_place(stage: Sensor, seen: _Light, rest: list[nn.Module]) -> None:
    """Raise UnitError where constant light would starve, or counts be averaged."""
    name, where = type(stage).__name__, "Compose"
    if seen.background and getattr(stage, "boundary", None) == "zero":
        raise UnitError(
            f"{where}: expected no {name} with boundary='zero' behind the background of a PhotonBudget, whose "
            f"ambient light and dark counts would starve at the ends of the window. Use boundary='periodic'; or: "
            f"{_PULSE_AND_JITTER}"
        )
    if seen.background and isinstance(stage, GatedIntegration):
        _check_gates(stage)
    if seen.difference and isinstance(stage, PixelElectronics):
        _check_signed(stage)
    if seen.behind is not None and isinstance(stage, ImpulseResponse):
        raise UnitError(
            f"{where}: expected no ImpulseResponse behind {seen.behind}: it would average counts. {_PULSE_AND_JITTER}"
        )
    if seen.behind is not None and (isinstance(stage, _SPREADS) or (isinstance(stage, TDC) and not _codes(stage))):
        instead = {"PixelSkew": "Use DetectionSkew, which moves every detection", "TDC": "Say acts_on='detections'"}
        raise UnitError(
            f"{where}: expected no {name} behind {seen.behind}: it would average counts. "
            f"{instead.get(name, 'It acts on light')}; or put it in front of the detector."
        )
    if seen.codes is not None and isinstance(stage, (*_MOVES, Afterpulsing)):
        raise UnitError(
            f"{where}: expected {name} in front of {seen.codes}, got it behind, where bins are codes of unequal widths."
        )
    if seen.pulses and isinstance(stage, Afterpulsing):
        raise UnitError(f"{where}: expected no {name} behind an AfterpulsingSPAD, which has afterpulses of its own.")
    later = next((type(s).__name__ for s in rest if _detects(s)), None)
    if (isinstance(stage, _MOVES) or _codes(stage)) and later is not None:
        raise UnitError(
            f"{where}: expected {name} behind the detector, got it in front of {later}. It acts on detections. "
            + ("Say acts_on='rates'" if isinstance(stage, TDC) else "Take an ImpulseResponse or a PixelSkew")
            + " for light."
        )


def _codes(stage: nn.Module) -> bool:
    return isinstance(stage, TDC) and stage.acts_on == "detections"


def _check_signed(stage: PixelElectronics) -> None:
    """Raise UnitError for the electronics of a difference that know no numbers below zero."""
    if stage.shot_noise:
        raise UnitError(
            "Compose: expected no shot noise behind a TapDifference, got a PixelElectronics that draws it. Put it in "
            "front; the one behind is PixelElectronics(shot_noise=False, ...)."
        )
    low, high = stage.range_dn
    if stage.bits is not None and stage.black_level_dn - low < 0.25 * (high - low):
        raise UnitError(
            f"Compose: expected a converter with room below zero behind a TapDifference, got codes from {low:g} to "
            f"{high:g} and a black level of {stage.black_level_dn:g}. Say signed=True."
        )


def _check_gates(stage: GatedIntegration) -> None:
    missed = stage.outside()
    worst = int(missed.argmax())
    if float(missed[worst]) > _OUTSIDE:
        raise UnitError(
            f"Compose: expected gates inside the window of {stage.axis} behind a background, got gate {worst} with "
            f"{float(missed[worst]):.2g} of its time outside, where the ambient light is not known."
        )
