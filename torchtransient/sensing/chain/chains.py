"""Chains of single-photon detectors from their parts, in the order in which light meets them."""

from __future__ import annotations

from collections.abc import Sequence

from torch import nn

from torchtransient.checks import shown
from torchtransient.errors import ArgumentError, ShapeError
from torchtransient.sensing.base.policies import GradPolicy
from torchtransient.sensing.base.sensor import Sensor
from torchtransient.sensing.chain.compose import Compose
from torchtransient.sensing.correlated_noise.afterpulsing import Afterpulsing
from torchtransient.sensing.correlated_noise.afterpulsing_spad import AfterpulsingSPAD
from torchtransient.sensing.correlated_noise.crosstalk import Crosstalk
from torchtransient.sensing.optics.photon_budget import PhotonBudget
from torchtransient.sensing.response.impulse_response import ImpulseResponse
from torchtransient.sensing.response.responses import Response
from torchtransient.sensing.timing.detection_jitter import DetectionJitter
from torchtransient.sensing.timing.pixel_skew import DetectionSkew
from torchtransient.sensing.timing.tdc import TDC


def counting_chain(
    budget: PhotonBudget,
    detector: Sensor,
    *,
    optics: Sequence[Sensor] | None = (),
    pulse: Response | ImpulseResponse | None = None,
    jitter: Response | DetectionJitter | None = None,
    skew: DetectionSkew | None = None,
    afterpulsing: Afterpulsing | None = None,
    crosstalk: Crosstalk | None = None,
    converter: TDC | None = None,
    readout: Sequence[Sensor] | None = (),
    grad: GradPolicy | None = None,
) -> Compose:
    """Radiance (..., C, T, H, W) to counts: the parts of a single-photon detector as one chain, whatever their order.

    Light is spread by `optics` and by the laser's `pulse`; `budget` makes detections of it and adds what is constant;
    `detector` counts them (`SynchronousSPAD`, `FreeRunningSPAD`, a `MacroPixel` of them, ...); `jitter` and `skew` move
    every detection; `afterpulsing` and `crosstalk` add others; `converter` gives each of them its code; `readout` is
    what the pixel keeps (`ZoneSum`, `CodedHistogram`). A `Response` is taken for the bins of the budget. Why so:
    docs/photon_counting.md. `grad` as of `Compose`.

    Raises ArgumentError for a part that is none of its kind, UnitError for parts that do not go together: another
    number of cycles, another laser period, other bins, afterpulses of a detector that has its own (`AfterpulsingSPAD`).
    """
    where = "counting_chain"
    _check(budget, (PhotonBudget,), "budget", where)
    if not isinstance(detector, Sensor) or (detector.takes, detector.gives) != (("rate",), "counts"):
        raise ShapeError(
            f"{where}: expected detector to make counts of rates, such as SynchronousSPAD, got {shown(detector)}."
        )
    if afterpulsing is not None and any(isinstance(part, AfterpulsingSPAD) for part in detector.modules()):
        raise ArgumentError(
            f"{where}: expected afterpulsing=None with an AfterpulsingSPAD, got both. Its own afterpulses are enough."
        )
    light: list[nn.Module | None] = [*_parts(optics, "optics", where), _response(pulse, budget, where)]
    stages = [
        *light,
        budget,
        detector,
        _jitter(jitter, budget, where),
        _check(skew, (DetectionSkew, type(None)), "skew", where),
        _check(afterpulsing, (Afterpulsing, type(None)), "afterpulsing", where),
        _check(crosstalk, (Crosstalk, type(None)), "crosstalk", where),
        _check(converter, (TDC, type(None)), "converter", where),
        *_parts(readout, "readout", where),
    ]
    return Compose([s for s in stages if s is not None], grad=grad)


def _parts(parts: Sequence[nn.Module] | None, name: str, where: str) -> list[nn.Module]:
    """A list of sensors, or None for none of them."""
    if parts is None:
        return []
    if not isinstance(parts, (list, tuple, nn.ModuleList, nn.Sequential)):
        raise ArgumentError(f"{where}: expected {name} as a list of sensors, got {shown(parts)}. Put it into [].")
    wrong = [shown(part) for part in parts if not isinstance(part, nn.Module)]
    if wrong:
        raise ArgumentError(f"{where}: expected {name} as a list of sensors, got {', '.join(wrong)} in it.")
    return list(parts)


def _response(pulse: Response | ImpulseResponse | None, budget: PhotonBudget, where: str) -> ImpulseResponse | None:
    _check(pulse, (Response, ImpulseResponse, type(None)), "pulse", where)
    return ImpulseResponse(pulse, bin_width_s=budget.bin_width_s) if isinstance(pulse, Response) else pulse


def _jitter(jitter: Response | DetectionJitter | None, budget: PhotonBudget, where: str) -> DetectionJitter | None:
    _check(jitter, (Response, DetectionJitter, type(None)), "jitter", where)
    return DetectionJitter(jitter, bin_width_s=budget.bin_width_s) if isinstance(jitter, Response) else jitter


def _check(part: nn.Module | None, kinds: tuple[type, ...], name: str, where: str) -> nn.Module | None:
    if not isinstance(part, kinds):
        names = " or ".join("None" if kind is type(None) else kind.__name__ for kind in kinds)
        raise ShapeError(f"{where}: expected {name} to be {names}, got {shown(part)}.")
    return part
