"""The order of a chain: what may stand before what, and the errors that say so."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import nn

from torchtransient.errors import UnitError
from torchtransient.sensing.base.sensor import Sensor
from torchtransient.sensing.cameras.electronics import PixelElectronics
from torchtransient.sensing.cameras.gated import GatedIntegration
from torchtransient.sensing.chain.chain_walk import branches_of, in_order, numbered
from torchtransient.sensing.correlated_noise.afterpulsing import Afterpulsing
from torchtransient.sensing.correlated_noise.afterpulsing_spad import AfterpulsingSPAD
from torchtransient.sensing.itof.itof_pixels import TapDifference
from torchtransient.sensing.optics.photon_budget import PhotonBudget
from torchtransient.sensing.optics.spatial_psf import LensBlur, SpatialPSF
from torchtransient.sensing.response.impulse_response import ImpulseResponse
from torchtransient.sensing.timing.detection_jitter import DetectionJitter
from torchtransient.sensing.timing.pixel_skew import DetectionSkew, PixelSkew
from torchtransient.sensing.timing.sweep_jitter import SweepJitter
from torchtransient.sensing.timing.tdc import TDC

_MOVES = (DetectionJitter, DetectionSkew)
# what spreads light over bins or pixels, and would average counts
_SPREADS = (ImpulseResponse, LensBlur, PixelSkew, SpatialPSF, SweepJitter)
# share of a gate outside the window that starves no image by more than the rounding of a count
_OUTSIDE = 1e-6

_PULSE_AND_JITTER = (
    "The pulse of the laser stays an ImpulseResponse and goes in front of the PhotonBudget; the jitter of the detector "
    "and its timing becomes a DetectionJitter of the same response behind the detector, where every detection moves."
)


def _instead(stage: nn.Module, outer: Sequence[nn.Module]) -> str:
    """What to do about a zero boundary; a camera that is made of responses has a boundary of its own."""
    within = any(getattr(o, "boundary", None) and o is not stage and stage in list(o.modules()) for o in outer)
    return _PULSE_AND_JITTER if isinstance(stage, ImpulseResponse) and not within else "Use boundary='periodic'."


@dataclass(frozen=True)
class _Seen:
    """What the light has passed: a background, what has made counts of it, what has made codes of its bins, and
    whether taps were subtracted and the detector had afterpulses of its own.

    `outer`: the stages of the chain as they were given.
    """

    background: bool = False
    behind: str | None = None
    codes: str | None = None
    difference: bool = False
    pulses: bool = False
    outer: tuple[nn.Module, ...] = ()

    def also(self, other: _Seen) -> _Seen:
        """What pixels of one kind or another have passed."""
        return _Seen(
            background=self.background or other.background,
            behind=self.behind or other.behind,
            codes=self.codes or other.codes,
            difference=self.difference or other.difference,
            pulses=self.pulses or other.pulses,
            outer=self.outer,
        )


def has_background(budget: PhotonBudget) -> bool:
    """Whether a budget adds ambient light or dark counts, or may learn to."""
    ambient, dark = torch.as_tensor(budget.ambient_rate_hz), torch.as_tensor(budget.dark_count_rate_hz)
    efficiency = torch.as_tensor(budget.quantum_efficiency)
    if ambient.requires_grad or dark.requires_grad:
        return True
    lit = ambient > 0 if efficiency.requires_grad else ambient * efficiency > 0
    return bool(lit.any()) or bool((dark > 0).any())


def _detects(stage: nn.Module) -> bool:
    """Whether a stage makes counts of light."""
    return isinstance(stage, Sensor) and stage.gives == "counts" and bool({"rate", "electrons"} & set(stage.takes))


def check_order(stages: Iterable[nn.Module], where: str) -> None:
    """UnitError where constant light meets the end of a window, or counts and rates are taken for one another."""
    outer = list(stages)
    _follow([stage for _, stage in in_order(numbered(outer))], _Seen(outer=tuple(outer)), [], where)


def _follow(row: list[nn.Module], seen: _Seen, after: list[nn.Module], where: str) -> _Seen:
    """What has been passed at the end of a row of single stages, with the stages `after` it; see `check_order`."""
    for number, stage in enumerate(row):
        rest = row[number + 1 :] + after
        branches = branches_of(stage)
        if branches:
            ends = [_follow([s for _, s in in_order([branch])], seen, rest, where) for branch in branches]
            for end in ends:
                seen = seen.also(end)
        else:
            _check_stage(stage, seen, rest, where)
            seen = _passed(stage, seen)
    return seen


def _passed(stage: nn.Module, seen: _Seen) -> _Seen:
    if isinstance(stage, PhotonBudget):
        return replace(seen, background=seen.background or has_background(stage))
    if isinstance(stage, TDC) and stage.acts_on == "detections":
        return replace(seen, codes=type(stage).__name__)
    if isinstance(stage, TapDifference):
        return replace(seen, difference=True)
    # charge behind an amplifier is spread like light, by a phosphor for instance
    if isinstance(stage, Sensor) and stage.gives == "counts" and not isinstance(stage, PixelElectronics):
        pulses = seen.pulses or any(isinstance(part, AfterpulsingSPAD) for part in stage.modules())
        return replace(seen, behind=seen.behind or type(stage).__name__, pulses=pulses)
    return seen


def _check_stage(stage: nn.Module, seen: _Seen, rest: list[nn.Module], where: str) -> None:
    name = type(stage).__name__
    if seen.background and isinstance(stage, Sensor) and getattr(stage, "boundary", None) == "zero":
        raise UnitError(
            f"{where}: expected no {name} with boundary='zero' behind the background of a PhotonBudget, whose "
            f"ambient light and dark counts would starve at the ends of the window. {_instead(stage, seen.outer)}"
        )
    if seen.background and isinstance(stage, GatedIntegration):
        _check_gates(stage, where)
    if seen.difference and isinstance(stage, PixelElectronics):
        _check_signed(stage, where)
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
            f"{where}: expected {name} in front of {seen.codes}, got it behind: bins are codes there, of unequal "
            "widths, and it needs times. The converter is the last that acts on detections."
        )
    if seen.pulses and isinstance(stage, Afterpulsing):
        raise UnitError(
            f"{where}: expected no {name} behind {seen.behind} with an AfterpulsingSPAD, which has afterpulses of its "
            "own, got both. Leave one of them out."
        )
    later = next((type(s).__name__ for s in rest if _detects(s)), None)
    if (isinstance(stage, _MOVES) or _codes(stage)) and later is not None:
        raise UnitError(
            f"{where}: expected {name} behind the detector, got it in front of {later}. It acts on detections. "
            + ("Say acts_on='rates'" if isinstance(stage, TDC) else "Take an ImpulseResponse or a PixelSkew")
            + " for light."
        )


def _codes(stage: nn.Module) -> bool:
    return isinstance(stage, TDC) and stage.acts_on == "detections"


def _check_signed(stage: PixelElectronics, where: str) -> None:
    """UnitError for the electronics of a difference that know no numbers below zero."""
    if stage.shot_noise:
        raise UnitError(
            f"{where}: expected no shot noise behind a TapDifference, whose negative numbers are no light, got a "
            "PixelElectronics that draws it. Put it in front of the difference, where both taps have theirs; the one "
            "behind is PixelElectronics(shot_noise=False, ...)."
        )
    low, high = stage.range_dn
    if stage.bits is not None and stage.black_level_dn - low < 0.25 * (high - low):
        raise UnitError(
            f"{where}: expected a converter with room below zero behind a TapDifference, got codes from {low:g} to "
            f"{high:g} and a black level of {stage.black_level_dn:g}, which clip negative differences. Say signed=True "
            "(codes in two's complement), or a black_level_dn in the middle of the range."
        )


def _check_gates(stage: GatedIntegration, where: str) -> None:
    missed = stage.outside()
    worst = int(missed.argmax())
    if float(missed[worst]) > _OUTSIDE:
        raise UnitError(
            f"{where}: expected gates inside the window of {stage.axis} behind a background, got gate {worst} with "
            f"{float(missed[worst]):.2g} of its time outside, where the ambient light is not known. Move the gate or "
            "lengthen the axis."
        )
