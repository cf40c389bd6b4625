"""The shortest and longest way from spots over a box to sensor points: what a time axis has to cover."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchtransient.checks import real_array, shown
from torchtransient.errors import ShapeError, UnitError

if TYPE_CHECKING:
    from torchtransient.capture.scan import Scan


def bounds_of(bounds: Any, who: str) -> tuple[Tensor, Tensor]:
    """The corners (3,) of a box of lowest and highest coordinates, float64. Raises ShapeError and UnitError."""
    plain = real_array(bounds)
    if plain is None or plain.shape != (2, 3):
        raise ShapeError(f"{who}: expected bounds (2, 3), the lowest and the highest corner, got {shown(bounds)}.")
    box = torch.from_numpy(plain)
    if not bool(torch.isfinite(box).all()) or not bool((box[0] <= box[1]).all()):
        raise UnitError(f"{who}: expected finite bounds, the lowest corner first, got {box.tolist()}.")
    return box[0], box[1]


def shortest(scan: Scan, low: Tensor, high: Tensor) -> float:
    """A length that no three-bounce path over the box falls short of, metres.

    The sum of the distances of spot and sensor point to the box, each to its own nearest point: exact for confocal
    scans, at most too short otherwise.
    """
    first, last = _legs(scan)
    near = [torch.linalg.vector_norm(p - p.clamp(low, high), dim=-1) for p in _points(scan)]
    return _combined(scan, near[0] + first, near[1] + last, longest=False)


def longest(scan: Scan, low: Tensor, high: Tensor) -> float:
    """A length that no three-bounce path over the box exceeds, metres. Sums of distances are convex: the longest way
    goes over a corner.
    """
    laser, sensor = _points(scan)
    first, last = _legs(scan)
    found = 0.0
    for corner in itertools.product(*zip(low.tolist(), high.tolist(), strict=True)):
        point = torch.tensor(corner, dtype=torch.float64, device="cpu")
        to_spot, to_sensor = (torch.linalg.vector_norm(p - point, dim=-1) for p in (laser, sensor))
        found = max(found, _combined(scan, to_spot + first, to_sensor + last, longest=True))
    return found


def _points(scan: Scan) -> tuple[Tensor, Tensor]:
    return scan.laser_points.detach().cpu().reshape(-1, 3), scan.sensor_points.detach().cpu().reshape(-1, 3)


def _legs(scan: Scan) -> tuple[Tensor, Tensor]:
    if not scan.first_and_last_leg:
        zero = torch.zeros((), dtype=torch.float64, device="cpu")
        return zero, zero
    return scan.laser_legs.detach().cpu().reshape(-1), scan.sensor_legs.detach().cpu().reshape(-1)


def _combined(scan: Scan, first: Tensor, last: Tensor, *, longest: bool) -> float:
    if scan.kind in ("confocal", "pairs"):
        both = first + last
        return float(both.max() if longest else both.min())
    return float(first.max() + last.max()) if longest else float(first.min() + last.min())
