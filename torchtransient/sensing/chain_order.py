"""The order of a chain: what may stand before what, and the errors that say so."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import torch
from torch import nn

from torchtransient.errors import UnitError
from torchtransient.sensing.detection_jitter import DetectionJitter
from torchtransient.sensing.electronics import PixelElectronics
from torchtransient.sensing.gated import GatedIntegration
from torchtransient.sensing.impulse_response import ImpulseResponse
from torchtransient.sensing.itof_pixels import TapDifference
from torchtransient.sensing.photon_budget import PhotonBudget
from torchtransient.sensing.pixel_groups import PixelGroups
from torchtransient.sensing.pixel_skew import DetectionSkew
from torchtransient.sensing.sensor import Sensor
from torchtransient.sensing.tdc import TDC

_MOVES = (DetectionJitter, DetectionSkew)
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


def flattened(stages: Iterable[nn.Module]) -> Iterator[nn.Module]:
    """The stages of a chain and of the chains in it, in order."""
    for stage in stages:
        inner = stage if isinstance(stage, nn.Sequential) else getattr(stage, "stages", None)
        if isinstance(inner, (nn.Sequential, nn.ModuleList)):
            yield from flattened(inner)
        else:
            yield stage


def has_background(budget: PhotonBudget) -> bool:
    """Whether a budget adds ambient light or dark counts."""
    ambient = torch.as_tensor(budget.ambient_rate_hz) * torch.as_tensor(budget.quantum_efficiency)
    return bool((ambient > 0).any()) or bool((torch.as_tensor(budget.dark_count_rate_hz) > 0).any())


def _detects(stage: nn.Module) -> bool:
    """Whether a stage makes counts of light."""
    return isinstance(stage, Sensor) and stage.gives == "counts" and bool({"rate", "electrons"} & set(stage.takes))


def check_order(stages: Iterable[nn.Module], where: str) -> None:
    """UnitError where constant light meets the end of a window, or counts and rates are taken for one another."""
    background, behind, difference, outer = False, None, False, list(stages)
    # of pixels of several kinds the first stands for all
    found = [stage.sensors[0] if isinstance(stage, PixelGroups) else stage for stage in flattened(outer)]
    for number, stage in enumerate(found):
        name = type(stage).__name__
        if background and isinstance(stage, Sensor) and getattr(stage, "boundary", None) == "zero":
            raise UnitError(
                f"{where}: expected no {name} with boundary='zero' behind the background of a PhotonBudget, whose "
                f"ambient light and dark counts would starve at the ends of the window. {_instead(stage, outer)}"
            )
        if background and isinstance(stage, GatedIntegration):
            _check_gates(stage, where)
        difference = difference or isinstance(stage, TapDifference)
        if difference and isinstance(stage, PixelElectronics):
            _check_signed(stage, where)
        if behind is not None and isinstance(stage, ImpulseResponse):
            raise UnitError(
                f"{where}: expected no ImpulseResponse behind {behind}: it would average counts. {_PULSE_AND_JITTER}"
            )
        on_detections = isinstance(stage, _MOVES) or (isinstance(stage, TDC) and stage.acts_on == "detections")
        later = next((type(s).__name__ for s in found[number + 1 :] if _detects(s)), None)
        if on_detections and later is not None:
            raise UnitError(
                f"{where}: expected {name} behind the detector, got it in front of {later}. It acts on detections. "
                + ("Say acts_on='rates'" if isinstance(stage, TDC) else "Take an ImpulseResponse or a PixelSkew")
                + " for light."
            )
        if isinstance(stage, PhotonBudget):
            background = background or has_background(stage)
        elif _detects(stage) and "rate" in getattr(stage, "takes", ()):
            behind = name


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
