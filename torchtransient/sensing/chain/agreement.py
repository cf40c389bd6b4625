"""Whether stages in a row are made for one another: bins, laser cycles and period, what is given and what taken."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from torch import Tensor, nn

from torchtransient.axes import TimeAxis
from torchtransient.checks import as_number
from torchtransient.errors import UnitError
from torchtransient.sensing.base.sensor import Quantity, Sensor
from torchtransient.sensing.chain.chain_walk import branches_of, in_order, named, parts_of

# Two axes are the same when their bins agree to a millionth of a bin over the whole length.
_SAME_BIN = 1e-6
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
    """A sensor in a chain, with the words that name it in messages."""

    name: str
    sensor: Sensor

    def __str__(self) -> str:
        return f"stage '{self.name}' ({type(self.sensor).__name__})"


@dataclass(frozen=True)
class _Light:
    """What is known of the light between two stages, and which stage it is from."""

    quantity: Quantity | None = None
    giver: Stage | None = None
    cycles: int = 1  # of the exposure that a rate per cycle belongs to
    width: Stage | None = None
    number: Stage | None = None  # of bins


def stages_of(chain: nn.Module) -> Iterator[Stage | None]:
    """The sensors of a chain in their order, those of nested chains too; None for modules of another kind."""
    for name, stage in in_order(named(getattr(chain, "stages", chain))):
        yield Stage(name, stage) if isinstance(stage, Sensor) else None


def check_stages(chain: nn.Module) -> bool:
    """UnitError for stages of which one is not made for what those before it give. Whether `check_window` has more to
    say of light whose bins are known.

    Compared are bins, `cycles`, laser periods and quantities. What a module of another kind does to the light is not
    known, nor what a sensor does that has no `gives`: behind these, bins and quantities are compared anew.
    """
    _through(stages_of(chain), _Light())
    parts = _parts_of(chain)
    _check_cycles(parts)
    check_dead_times(chain)
    check_window(chain, None)
    return has_period(chain) and any((_bins(part) or (0.0, 1))[1] is None for part in parts)


def _through(stages: Iterable[Stage | None], light: _Light) -> _Light:
    """The light behind stages in a row, each compared with what comes to it; every branch with the same."""
    for stage in stages:
        if stage is None:
            light = _Light()
            continue
        _check_quantity(light, stage)
        before = _same_bins(light, stage)
        for name, sensor in branches_of(stage.sensor):
            row = in_order([(f"{stage.name}.{name}", sensor)])
            end = _through((Stage(n, s) if isinstance(s, Sensor) else None for n, s in row), light)
            before = replace(before, width=end.width, number=end.number)
        light = _after(stage, before)
    return light


def _parts_of(chain: nn.Module) -> list[Stage]:
    """Every sensor of a chain, those that other sensors are made of too."""
    return [Stage(name, part) for name, part in parts_of(chain)]


# ------------------------------------------------------------------------------------------------------------- bins


def check_axis(sensor: nn.Module, axis: TimeAxis) -> None:
    """UnitError when a sensor, or one that is part of it, was made for other bins than those of ``axis``."""
    for name, module in sensor.named_modules():
        if not isinstance(module, Sensor):
            continue  # a measured response has bins of its own
        own, width_s = getattr(module, "axis", None), getattr(module, "bin_width_s", None)
        slack = _SAME_BIN * axis.bin_width_opl
        same, made_for = module.num_bins in (None, axis.num_bins), f"{module.num_bins} bins"
        if isinstance(own, TimeAxis):
            made_for = str(own)
            same = own.num_bins == axis.num_bins and abs(own.start_opl - axis.start_opl) <= slack
            same = same and abs(own.bin_width_opl - axis.bin_width_opl) * axis.num_bins <= slack
        elif isinstance(width_s, float):
            made_for = f"bins of {width_s:g} s" if module.num_bins is None else f"{made_for} of {width_s:g} s"
            same = same and abs(width_s - axis.bin_width_s) * axis.num_bins <= _SAME_BIN * axis.bin_width_s
        if not same:
            raise UnitError(
                f"sensor: expected the axis of stage '{name or 0}' ({type(module).__name__}: {made_for}), got {axis}. "
                "Make the sensor with the renderer's axis."
            )


def _same_bins(light: _Light, stage: Stage) -> _Light:
    """The light with the stage that its bins are known from. UnitError for a stage that was made for others."""
    width, number = _bins(stage)
    other: Stage | None = None
    if light.number is not None and number not in (None, _bins(light.number)[1]):
        other = light.number
    if light.width is not None and width is not None:
        known, bins = _bins(light.width)
        if abs(width - (known or 0.0)) * max(number or 1, bins or 1) > _SAME_BIN * width:
            other = light.width
    if other is not None:
        raise UnitError(
            f"Compose: expected one time axis for all stages, got {_shown(_bins(other))} in {other} and "
            f"{_shown((width, number))} in {stage}. Make both with the axis of the light."
        )
    return replace(
        light, width=light.width if width is None else stage, number=light.number if number is None else stage
    )


def _bins(stage: Stage) -> tuple[float | None, int | None]:
    """(width in seconds, number) of the bins that a sensor was made for; None for what it takes any of."""
    axis, width = getattr(stage.sensor, "axis", None), as_number(getattr(stage.sensor, "bin_width_s", None))
    if isinstance(axis, TimeAxis):
        return axis.bin_width_s, axis.num_bins
    return width, stage.sensor.num_bins


def _shown(bins: tuple[float | None, int | None]) -> str:
    width, number = bins
    if width is None:
        return f"{number} bins"
    return f"bins of {width:g} s" if number is None else f"{number} bins of {width:g} s"


# ------------------------------------------------------------------------------------------------------- quantities


def _check_quantity(light: _Light, stage: Stage) -> None:
    """UnitError for a stage that takes other light than the stages before it give."""
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
            f"They are those of one of {light.cycles} cycles. Count them with SynchronousSPAD({light.cycles}), give "
            f"electrons_per_unit={light.cycles} where the stage has it, or make the budget with cycles=1 and the "
            "energy of them all."
        )
    if light.quantity == "rate" and "counts" in takes:
        return "Put the detector between them: SynchronousSPAD, FreeRunningSPAD or BinaryFrames."
    if "radiance" in takes:
        return "PhotonBudget takes what a renderer gives; leave out what has made detections of it before."
    if light.quantity == "counts":
        return "Light is counted once: leave one of them out, or say PixelElectronics(shot_noise=False)."
    return "Electrons of an exposure are no rates per cycle: leave one of the two out."


def _after(stage: Stage, light: _Light) -> _Light:
    gives = stage.sensor.gives
    if gives == "the same":
        return light
    if gives is None:
        return _Light()
    cycles = getattr(stage.sensor, "cycles", 1)
    light = _Light() if gives == "electrons" else light  # taps and gates stand where bins were
    return replace(light, quantity=gives, giver=stage, cycles=cycles if isinstance(cycles, int) else 1)


# ----------------------------------------------------------------------------------------------- cycles and periods


def _check_cycles(stages: list[Stage]) -> None:
    """UnitError for stages that count different numbers of laser cycles."""
    counting = [(s, s.sensor.cycles) for s in stages if isinstance(getattr(s.sensor, "cycles", None), int)]
    for stage, cycles in counting[1:]:
        first, wanted = counting[0]
        if cycles != wanted:
            raise UnitError(
                f"Compose: expected one number of cycles in all stages, got {wanted} in {first} and {cycles} in "
                f"{stage}. Give the detector budget.cycles; change both in a Device."
            )


def check_window(chain: nn.Module, num_bins: int | None) -> None:
    """UnitError where bins, dead times and the laser period of a chain do not go together.

    A `FreeRunningSPAD` takes its bins for the whole period, and so does an `Afterpulsing` without `period_s`; any other
    detector has to be armed again when the next cycle begins, with the dead time of its afterpulses as with its own.
    The period is that of a `PhotonBudget`, or without one the `period_s` of an Afterpulsing. ``num_bins``: of the
    light, None while there is none, which leaves out the window of stages that were made with a width alone.
    """
    stages = _parts_of(chain)
    budgets = [s for s in stages if isinstance(getattr(s.sensor, "repetition_rate_hz", None), float)]
    for budget in budgets:
        period_s = 1 / float(budget.sensor.repetition_rate_hz)  # type: ignore[arg-type]
        for stage in stages:
            _check_period(budget, period_s, stage, num_bins)
    goes_on = any(s.sensor.takes == ("rate",) and s.sensor.window_is_period for s in stages)
    for stage in stages:
        own = getattr(stage.sensor, "period_s", None)
        if not goes_on and isinstance(_dead_time(stage), float):
            for budget in budgets:
                _check_armed(budget, 1 / float(budget.sensor.repetition_rate_hz), stage, num_bins)  # type: ignore[arg-type]
            if not budgets and isinstance(own, float):
                _check_armed(stage, own, stage, num_bins)


def has_period(chain: nn.Module) -> bool:
    """Whether a laser period is known in a chain."""
    names = ("repetition_rate_hz", "period_s")
    return any(isinstance(getattr(part.sensor, name, None), float) for part in _parts_of(chain) for name in names)


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
            f"bins of {width_s:g} s, {number * width_s:g} s. Take an axis of the whole period; Afterpulsing takes "
            "period_s= as well."
        )


def _check_armed(giver: Stage, period_s: float, stage: Stage, num_bins: int | None) -> None:
    """UnitError for a detector that is still dead when the next cycle begins."""
    (width_s, number), dead_s = _bins(stage), _dead_time(stage) or 0.0
    # what is not known yet is looked at when light comes
    window_s = 0.0 if width_s is None else (number or num_bins or 0) * width_s
    if dead_s and window_s + dead_s > period_s * (1 + _SAME_PERIOD):
        raise UnitError(
            f"Compose: expected {stage} to be armed again before the next cycle of {giver}, {period_s:g} s later, got "
            f"a window of {window_s:g} s and a dead time of {dead_s:g} s. A detector that goes on into the next cycle "
            "is a FreeRunningSPAD on an axis of the whole period; or lower repetition_rate_hz."
        )


def check_dead_times(chain: nn.Module) -> None:
    """UnitError for an `Afterpulsing` behind a detector of another dead time: one detector has one.

    A detector of one detection per cycle has none of its own. In `PixelGroups`, whose sensors stand beside one another,
    the dead time has to be that of one of them.
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
                    f"{dead_s:g} s. One detector has one dead time: give both the same."
                )
