"""Instants at which a camera looks at a scene that moves, and what it makes of their pictures.

Time here is the slow one, in which bodies move, in seconds; light crosses the scene in no time of it. A picture that
is smooth in time is a polynomial through Gauss-Legendre nodes x_k of [-1, 1],

    P(x) = sum_k P(x_k) sum_m (2 m + 1) / 2 g_k L_m(x_k) L_m(x),    m < K,

with the weights g_k of the nodes and Legendre polynomials L_m. Averages over an exposure with a beat replace L_m(x) by
its moment with the beat. They are exact for polynomials of degree K - 1, whatever the beat, so that light that stands
still drops out as it does in a camera, to rounding. A plain quadrature has errors of a share of that light instead,
which is a thousand times the signal.
"""

from __future__ import annotations

import abc
import functools
import math
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.checks import Numbers, count, finite, positive, shown
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import holds, number_tensor

# Polynomials of higher degree than this are not what a smooth picture is made of.
_MOST_POSES = 64
# More beats than this in an exposure are a mistake of units.
_MOST_BEATS = 1000


class SlowTimes(abc.ABC):
    """Base class of exposures for `tt.over_time`: times of poses, and a map from their pictures to the result.

    Attributes:
        needs_phasors: only phasor films have a result.
    """

    needs_phasors: bool = False

    @abc.abstractmethod
    def poses_s(self, rows: int) -> Tensor:
        """Return the times of the poses, (K,), seconds, float64; ``rows``: height of the film.

        Args:
            rows: height of the film, pixels.

        Returns:
            (K,), seconds, float64.
        """

    @abc.abstractmethod
    def combine(self, pictures: Tensor) -> Tensor:
        """Return the result of one tensor of the output, (K, ..., H, W), one entry for each pose.

        Args:
            pictures: one tensor of the output for each pose, (K, ..., H, W).

        Returns:
            (..., H, W), or (K, ..., H, W) where poses stay apart.
        """


@dataclass(frozen=True)
class Exposure(SlowTimes):
    """Average over an exposure, whose middle is t = 0: motion blur, or heterodyne and Doppler time of flight.

    With a beat, the phasor of light and sensor that are modulated at frequencies ``beat_hz`` apart,
    `1 / T  integral of P(t) exp(2 pi i beat t) dt` over the exposure T, P the phasor of the scene at t. A scene that
    stands still has none where the exposure is a whole number of beats. ``steady`` is the average without the beat.

    Args:
        duration_s: length of the exposure, seconds.
        beat_hz: frequency of the light's modulation minus that of the sensor's, hertz, of either sign; zero for none.
        poses: number of renders; the picture is a polynomial of one degree less in time.

    Raises:
        UnitError: for other numbers, and for a beat with a single pose, which sees no motion.

    Source of the measurement: Heide et al., "Doppler time-of-flight imaging" (SIGGRAPH 2015).
    """

    duration_s: float
    beat_hz: float = field(default=0.0, kw_only=True)
    poses: int = field(default=3, kw_only=True)

    def __post_init__(self) -> None:
        positive("Exposure: duration_s", self.duration_s)
        _check_poses("Exposure", self.poses, 2 if finite("Exposure: beat_hz", self.beat_hz) else 1)
        if abs(self.beat_hz) * self.duration_s > _MOST_BEATS:
            raise UnitError(
                f"Exposure: beat_hz: expected at most {_MOST_BEATS} beats in an exposure, got {shown(self.beat_hz)} "
                f"hertz in {shown(self.duration_s)} s. It is the difference of the frequencies of light and sensor."
            )

    @property
    def needs_phasors(self) -> bool:  # type: ignore[override]
        """A beat is seen by phasors alone."""
        return self.beat_hz != 0

    def poses_s(self, rows: int = 1) -> Tensor:
        """Return the times of the poses, (poses,), seconds.

        Args:
            rows: height of the film, pixels; changes nothing.
        """
        return float(self.duration_s) / 2 * torch.tensor(_nodes(int(self.poses)))

    def weights(self) -> Tensor:
        """Return the weight of each pose, complex128 (poses,); their sum is the beat's average."""
        return torch.tensor(_beat_weights(int(self.poses), float(self.beat_hz) * float(self.duration_s)))

    def combine(self, pictures: Tensor) -> Tensor:
        """Return the average of pictures (poses, ...), with the beat if they are complex.

        Args:
            pictures: pictures of the poses, (poses, ...), real or complex.

        Returns:
            (...), of the same dtype.
        """
        if pictures.is_complex():
            # In double precision: what stands still is a thousand times what is left.
            return _sum(self.weights(), pictures.to(torch.complex128)).to(pictures.dtype)
        return _sum(torch.tensor(_beat_weights(int(self.poses), 0.0).real), pictures)


@dataclass(frozen=True)
class RollingShutter(SlowTimes):
    """Rows at their own times, from the first at the top to the last; the middle of the film, or its crop window, is
    t = 0.

    The picture is a polynomial in time through its poses, of which the first and the last row are two: it can be
    negative where a body crosses bins between them. Each row sees one instant.

    Args:
        row_s: time from one row to the next, seconds; negative from the bottom to the top.
        poses: number of renders.

    Raises:
        UnitError: for other numbers.
    """

    row_s: float
    poses: int = field(default=3, kw_only=True)

    def __post_init__(self) -> None:
        finite("RollingShutter: row_s", self.row_s)
        _check_poses("RollingShutter", self.poses)

    def poses_s(self, rows: int) -> Tensor:
        """Return the times of the poses, (poses,), seconds.

        Args:
            rows: height of the film, pixels.
        """
        return float(self.row_s) * (rows - 1) / 2 * torch.tensor(_nodes_with_ends(int(self.poses)))

    def rows_s(self, rows: int) -> Tensor:
        """Return the times of the rows, (rows,), seconds.

        Args:
            rows: height of the film, pixels.
        """
        return float(self.row_s) * (torch.arange(rows).double() - (rows - 1) / 2)

    def combine(self, pictures: Tensor) -> Tensor:
        """Return the pictures (poses, ..., H, W) with each row at its time.

        Args:
            pictures: pictures of the poses, (poses, ..., H, W).

        Returns:
            (..., H, W).
        """
        rows = pictures.shape[-2]
        weights = torch.tensor(_through_ends(int(self.poses), np.linspace(-1, 1, rows) if rows > 1 else np.zeros(1)))
        return _sum(weights[..., None], pictures)


@dataclass(frozen=True)
class PhaseSteps(SlowTimes):
    """Exposures of an iToF camera one after another, a render each; the middle of them is t = 0.

    The output has a leading dimension of exposures. `taps` puts together the taps of each of them.

    Args:
        number: exposures: phase steps times frequencies, in the order of the sensor's taps.
        period_s: time from one exposure to the next, seconds.

    Raises:
        UnitError: for other numbers.
    """

    number: int
    period_s: float

    def __post_init__(self) -> None:
        count("PhaseSteps: number", self.number, 1, UnitError)
        positive("PhaseSteps: period_s", self.period_s)

    def poses_s(self, rows: int = 1) -> Tensor:
        """Return the times of the exposures, (number,), seconds.

        Args:
            rows: height of the film, pixels; changes nothing.
        """
        return float(self.period_s) * (torch.arange(int(self.number)).double() - (int(self.number) - 1) / 2)

    def combine(self, pictures: Tensor) -> Tensor:
        """Return the pictures as they are, (number, ...).

        Args:
            pictures: pictures of the exposures, (number, ...).

        Returns:
            (number, ...).
        """
        return pictures

    def taps(self, taps: Tensor) -> Tensor:
        """Return the taps of the exposures, each at its own time.

        Args:
            taps: all taps of the scene as it stands at each exposure, (number, ..., C, M, H, W), which
                `sensing.ItofCorrelation` makes of the output; M is ``number``, or twice that for pixels of two taps
                (`sensing.TwoTapCode`), A and B in turn.

        Returns:
            Taps (..., C, M, H, W).

        Raises:
            ShapeError: for other shapes.
        """
        n = int(self.number)
        if taps.ndim < 5 or taps.shape[0] != n or taps.shape[-3] not in (n, 2 * n):
            raise ShapeError(
                f"PhaseSteps: expected taps ({n}, ..., C, {n} or {2 * n}, H, W), got {tuple(taps.shape)}: exposures "
                "are phase steps times frequencies."
            )
        each = taps.shape[-3] // n
        return torch.cat([taps[k, ..., k * each : (k + 1) * each, :, :] for k in range(n)], -3)


class Frames(SlowTimes):
    """A video: one output for each time, along a leading dimension.

    Args:
        time_s: times, (K,), seconds; a tensor keeps its gradient.

    Raises:
        ShapeError, UnitError: unless it is one row of finite numbers.
    """

    def __init__(self, time_s: Numbers) -> None:
        self.time_s = number_tensor(time_s, "Frames: expected times in seconds, (K,)").double()
        if self.time_s.ndim != 1 or not len(self.time_s):
            raise ShapeError(f"Frames: expected times in seconds, (K,), got shape {tuple(self.time_s.shape)}.")
        if not holds(self.time_s.isfinite()):
            raise UnitError(f"Frames: expected finite times in seconds, got {shown(time_s)}.")

    def poses_s(self, rows: int = 1) -> Tensor:
        """Return the times, (K,), seconds.

        Args:
            rows: height of the film, pixels; changes nothing.
        """
        return self.time_s

    def combine(self, pictures: Tensor) -> Tensor:
        """Return the pictures as they are, (K, ...).

        Args:
            pictures: pictures of the times, (K, ...).

        Returns:
            (K, ...).
        """
        return pictures

    def __repr__(self) -> str:
        return f"Frames({shown(self.time_s)})"


# ------------------------------------------------------------------------------------------------------- polynomials


def _sum(weights: Tensor, pictures: Tensor) -> Tensor:
    """Return the sum over the first dimension; weights (K, ...) have the last dimensions of the pictures."""
    between = [1] * (pictures.ndim - weights.ndim)
    # Not as a matrix product, which autocast rounds to half precision.
    return (weights.to(pictures).reshape(len(weights), *between, *weights.shape[1:]) * pictures).sum(0)


def _check_poses(name: str, poses: int, least: int = 1) -> None:
    if count(f"{name}: poses", poses, 1, UnitError, _MOST_POSES) < least:
        raise UnitError(f"{name}: expected at least two poses for a beat: one sees no motion.")


@functools.cache
def _nodes(poses: int) -> NDArray[np.float64]:
    return np.polynomial.legendre.leggauss(poses)[0]


def _coefficients(poses: int) -> NDArray[np.float64]:
    """Return Legendre coefficients (degree, node) of the polynomials that are one at a node and zero at the others."""
    x, g = np.polynomial.legendre.leggauss(poses)
    degree = np.arange(poses)[:, None]
    return (degree + 0.5) * g * np.polynomial.legendre.legvander(x, poses - 1).T


@functools.cache
def _nodes_with_ends(poses: int) -> NDArray[np.float64]:
    """Return Gauss-Lobatto nodes of [-1, 1], its middle for one."""
    if poses == 1:
        return np.zeros(1)
    inner = np.polynomial.Legendre.basis(poses - 1).deriv().roots().real
    return np.asarray([-1.0, *np.sort(inner), 1.0])


def _through_ends(poses: int, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights (node, place) of the values at Gauss-Lobatto nodes for places in [-1, 1]."""
    values = np.polynomial.legendre.legvander(_nodes_with_ends(poses), poses - 1)
    return np.asarray(np.linalg.solve(values.T, np.polynomial.legendre.legvander(at, poses - 1).T), dtype=np.float64)


@functools.cache
def _beat_weights(poses: int, turns: float) -> NDArray[np.complex128]:
    """Return the weights (node,) of an average over [-1, 1] with a beat of ``turns`` in all."""
    # The beat is no polynomial: nodes enough for it.
    x, g = np.polynomial.legendre.leggauss(poses + 32 + math.ceil(math.pi * abs(turns)))
    beat = g / 2 * np.exp(1j * math.pi * turns * x)
    weights: NDArray[np.complex128] = beat @ np.polynomial.legendre.legvander(x, poses - 1) @ _coefficients(poses)
    return weights
