"""The base of sensors around a detector: its random numbers and its policy are the detector's."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from functools import reduce

import torch
from torch import Tensor

from torchtransient.sensing.base.policies import GradPolicy, check_policy
from torchtransient.sensing.base.sensor import RandomSensor, bins_of


def added(parts: Iterable[Tensor]) -> Tensor:
    """The sum of tensors, in their order."""
    return reduce(torch.add, parts)


class WrappedDetector(RandomSensor):
    """A random sensor whose draws are made by its `detector`. `grad` is the detector's, and sets it."""

    detector: RandomSensor
    # cycles by which counts of the whole exposure and pixel are divided; None: those of the detector
    exposure_cycles: float | None = None

    def __init__(self, detector: RandomSensor, grad: GradPolicy | None = None) -> None:
        super(RandomSensor, self).__init__()
        self.detector = detector
        self.bin_width_s, self.num_bins = bins_of(detector)
        if grad is not None:
            self.grad = grad

    @property
    def grad(self) -> GradPolicy:
        """The policy of the detector."""
        return self.detector.grad

    @grad.setter
    def grad(self, value: GradPolicy) -> None:
        self.detector.grad = check_policy(value, type(self).__name__)

    def check_bins(self, x: object) -> None:
        super().check_bins(x)
        self.detector.check_bins(x)

    def rate(self, x: Tensor) -> Tensor:
        """The rate that the detector is given."""
        raise NotImplementedError(f"{type(self).__name__} has to define rate(x).")

    def probabilities(self, x: Tensor) -> Tensor:
        """Expected detections per cycle and bin."""
        result: Tensor = self.detector.probabilities(self.rate(x))  # type: ignore[operator]
        return result

    def expected(self, x: Tensor) -> Tensor:
        return self.detector.expected(self.rate(x))

    def variance(self, x: Tensor) -> Tensor:
        return self.detector.variance(self.rate(x))

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self.detector.gaussian(self.rate(x), generator)

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        return self.detector.log_prob(measurement, self.rate(x))

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            return self.detector.sample(self.rate(x), generator)

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The measurement under the policy of the detector."""
        result: Tensor = self.detector(self.rate(x), generator=generator)
        return result


def several_of(detector: RandomSensor, number: int, share: float = 1.0) -> RandomSensor:
    """As many detectors alike as one whose counts are their sum, in the same light each: the cycles of all of them,
    and the same parameters.

    `share`: what each has of light, and of counts, that are given for a whole pixel.
    """
    other = copy.copy(detector)
    if isinstance(other, WrappedDetector):
        other.exposure_cycles = (other.exposure_cycles or cycles_of(detector)) / share
        other._modules = dict(other._modules)  # its own children
        other.detector = several_of(other.detector, number)
    else:
        other.cycles = cycles_of(detector) * number  # type: ignore[assignment]
        if hasattr(other, "trains"):  # detections of different detectors know nothing of one another
            other.trains = other.trains * number  # type: ignore[assignment, operator]
    return other


def cycles_of(detector: RandomSensor) -> int:
    """How many laser cycles a detector counts."""
    inner = detector
    while isinstance(inner, WrappedDetector):
        inner = inner.detector
    return int(inner.cycles)  # type: ignore[arg-type]
