"""Several SPADs as one pixel: counts of SPADs that share the light, and of zones of an image, summed."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchtransient.checks import Numbers
from torchtransient.errors import GradientError, ShapeError, UnitError
from torchtransient.sensing.afterpulsing_spad import AfterpulsingSPAD
from torchtransient.sensing.checks import check_count, check_number, check_transient
from torchtransient.sensing.free_running import FreeRunningSPAD
from torchtransient.sensing.sensor import (
    GradPolicy,
    RandomSensor,
    Sensor,
    WrappedDetector,
    added,
    cycles_of,
    several_of,
)
from torchtransient.sensing.spad import SynchronousSPAD

Groups = list[tuple[float, int]]  # (share of the light, SPADs that have it)


def groups_of(spads: int, weights: Numbers | None, where: str) -> Groups:
    """Group SPADs with the same share of the light.

    Args:
        spads: number of SPADs.
        weights: weight of each SPAD, of which only the ratios matter; None for equal shares.
        where: name of the caller, for errors.

    Returns:
        Shares, which add up to 1 over all SPADs, and the number of SPADs of each.

    Raises:
        ShapeError: for another number of weights.
        UnitError: for weights below 0.
    """
    number = check_count(spads, "spads", where)
    if weights is None:
        return [(1.0 / number, number)]
    values = [check_number(w, "weights", where) for w in torch.as_tensor(weights, dtype=torch.float64).tolist()]
    if len(values) != number:
        raise ShapeError(f"{where}: expected weights of {number} SPADs, got {len(values)}.")
    total = math.fsum(values)
    if not total > 0:
        raise UnitError(f"{where}: expected weights with a sum above 0, got {values}.")
    return [(w / total, values.count(w)) for w in sorted(set(values)) if w > 0]


class MacroPixel(WrappedDetector):
    """Pixel of several SPADs, each with its own dead time, whose counts (..., C, T, H, W) are summed.

    The input is the rate of the whole pixel, per cycle and bin (`PhotonBudget` with the area and the dark counts of all
    its SPADs). A pixel of N SPADs piles up at N times the light of one. SPADs in step with the laser and of equal
    shares are drawn at once, and the cost does not depend on their number; each that runs free is a train of its own.
    Dark counts are shared as light is, and so is the `background` of an AfterpulsingSPAD: that of the whole pixel, too.
    One converter for all, which is dead after the first of them, is a SPAD of its own: use the detector alone.

    Args:
        detector: one of the SPADs, for the cycles of the exposure.
        spads: number of SPADs.
        weights: shares of the light, one for each SPAD, of which only the ratios matter; 0 switches a SPAD off; None
            for equal ones.
        grad: gradient policy; None leaves the detector's own.

    Raises:
        ShapeError: for another number of weights.
        UnitError: for weights below 0.
    """

    takes, gives = ("rate",), "counts"

    def __init__(
        self,
        detector: SynchronousSPAD | FreeRunningSPAD | AfterpulsingSPAD,
        spads: int,
        *,
        weights: Numbers | None = None,
        grad: GradPolicy | None = None,
    ) -> None:
        super().__init__(detector, grad)
        self.groups = groups_of(spads, weights, "MacroPixel")
        self.spads = int(spads)

    def _parts(self, x: Tensor) -> list[tuple[RandomSensor, Tensor]]:
        """Detectors for all SPADs of an equal share, and their light."""
        check_transient(x, "MacroPixel")
        return [(several_of(self.detector, number, share), x * share) for share, number in self.groups]

    def probabilities(self, x: Tensor) -> Tensor:
        """Expected detections of all SPADs per cycle and bin.

        Args:
            x: rate of the pixel per cycle and bin, (..., C, T, H, W).
        """
        return self.expected(x) / cycles_of(self.detector)

    def expected(self, x: Tensor) -> Tensor:
        return added(detector.expected(rate) for detector, rate in self._parts(x))

    def variance(self, x: Tensor) -> Tensor:
        return added(detector.variance(rate) for detector, rate in self._parts(x))

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return added(detector.gaussian(rate, generator) for detector, rate in self._parts(x))

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            return added(detector.sample(rate, generator) for detector, rate in self._parts(x))

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        """Log-probability of the sum of equal SPADs, summed over time.

        Args:
            measurement: counts (..., C, T, H, W).
            x: rate of the pixel per cycle and bin, (..., C, T, H, W).

        Raises:
            GradientError: for several shares: the sum does not tell which SPAD counted.
        """
        if len(self.groups) > 1:
            raise GradientError(
                "MacroPixel.log_prob: expected SPADs of equal shares; the sum does not tell which of them counted. Use "
                "grad='score', which scores the draws themselves."
            )
        ((detector, rate),) = self._parts(x)
        return detector.log_prob(measurement, rate)

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Sum the measurements of the SPADs, each under the policy.

        Args:
            x: rate of the pixel per cycle and bin, (..., C, T, H, W).
            generator: source of randomness.
        """
        return added(detector(rate, generator=generator) for detector, rate in self._parts(x))

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, shares={len(self.groups)}"


class ZoneSum(Sensor):
    """Sum the counts of an image of SPADs over zones: (..., C, T, H, W) to (..., C, T, H / rows, W / columns).

    Behind detectors, crosstalk and the like, where every SPAD is a pixel of the render. Linear.

    Args:
        rows: SPADs of a zone along H.
        columns: SPADs of a zone along W.

    Raises:
        ShapeError: for an image that is not made of whole zones.
    """

    gives = "the same"

    def __init__(self, rows: int, columns: int) -> None:
        super().__init__()
        self.rows = check_count(rows, "rows", "ZoneSum")
        self.columns = check_count(columns, "columns", "ZoneSum")

    def expected(self, x: Tensor) -> Tensor:
        check_transient(x, "ZoneSum")
        *_, height, width = x.shape
        if height % self.rows or width % self.columns:
            raise ShapeError(
                f"ZoneSum: expected an image of whole zones of {self.rows} x {self.columns}, got {height} x {width}."
            )
        down, across = height // self.rows, width // self.columns
        return x.reshape(*x.shape[:-2], down, self.rows, across, self.columns).sum((-3, -1))
