"""Tiles of scan points with densities of their own, where hidden geometry is near beside the width of the scan.

What a scan point sees falls by the fourth power of the distance: with one density for all of them, an arm 10 cm before
a scan of 1 m is drawn where most points see little. With 16 tiles there, the standard deviation is a sixth.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

# Widths of a tile over the distance of the nearest hidden geometry; tiles along an edge of the scan at most.
_RATIO = 2.0
_MOST = 4
# Points that stand for a tile.
_POINTS = 25


class ScanTiles:
    """Tiles of a scan's ``points`` and ``normals`` ``(P, 3)``, for geometry at ``distance`` (metres) from the nearest.

    ``count``; ``tile`` ``(P,)``: of each point; ``points``, ``normals`` ``(count, 25, 3)``: what ``HiddenElements`` is
    given. There is one tile where the scan is not wider than twice the distance.
    """

    def __init__(self, points: Any, normals: Any, distance: float) -> None:
        points, normals = (np.asarray(a, dtype=np.float64).reshape(-1, 3) for a in (points, normals))
        local = points - points.mean(0)
        # The two directions in which the scan is widest.
        _, vectors = np.linalg.eigh(local.T @ local)
        across = local @ vectors[:, 1:]
        width = np.ptp(across, axis=0)
        along = np.clip(np.ceil(width / (_RATIO * max(distance, 1e-9))), 1, _MOST).astype(int)
        cell = np.minimum((across - across.min(0)) / np.maximum(width, 1e-12) * along, along - 1).astype(int)
        _, self.tile = np.unique(cell[:, 0] * along[1] + cell[:, 1], return_inverse=True)
        self.count = int(self.tile.max()) + 1
        chosen = [_spread(np.flatnonzero(self.tile == t)) for t in range(self.count)]
        self.points, self.normals = points[chosen], normals[chosen]

    def of_points(self) -> Any:
        """The tile of every scan point, ``UInt32`` in memory."""
        tile = mi.UInt32(self.tile.astype(np.uint32))
        dr.make_opaque(tile)
        return tile


def distance_to(vertices: np.ndarray, points: np.ndarray) -> float:
    """Distance of the vertices ``(V, 3)`` nearest to any of the points ``(P, 3)``, metres."""
    nearest = np.inf
    for p in points:
        nearest = min(nearest, float(((vertices - p) ** 2).sum(1).min()))
    return nearest**0.5


def _spread(numbers: np.ndarray) -> np.ndarray:
    """25 of these, in equal steps; some more than once where there are fewer."""
    return numbers[np.linspace(0, len(numbers) - 1, _POINTS).round().astype(int)]
