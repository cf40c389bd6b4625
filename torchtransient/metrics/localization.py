"""Localization error of points of a hidden scene: distances between peaks of a volume and the truth."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchtransient.checks import numbers, positive
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.losses.results import Volume
from torchtransient.metrics.tally import Finish, Kind, Reduction, Tally, check_finite
from torchtransient.reconstruction.voxels import VoxelGrid


def localization_rmse(
    input: Volume, points: Any, *, radius_m: float, grid: VoxelGrid | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Compute the root mean square distance of points from the peaks of volumes near them, metres.

    The peak of a point is the highest voxel within the radius, moved along each axis of the grid by the parabola
    through it and its neighbors, at most half a voxel. A search near the truth finds something near it: take a radius
    below half the distance of two points, and look at the picture. A point without a value above zero within the radius
    counts with the radius.

    Args:
        input: volumes (..., Z, Y, X) or a `HiddenVolume`.
        points: world coordinates (N, 3), metres.
        radius_m: radius of the search, metres.
        grid: grid of the voxels; None: that of a `HiddenVolume`.
        reduction: "mean" of all points, "item" of each volume, or "none", the distance of each point.

    Returns:
        Metres, without gradient; scalar, (...) for "item", (..., N) for "none".

    Raises:
        UnitError: for a point without a voxel within the radius.
        ArgumentError: for a tensor without a grid.
        ShapeError: for a volume of another shape than its grid.
    """
    where = "localization_rmse"
    radius = positive(f"{where}: radius_m", radius_m)
    grid = getattr(input, "grid", None) if grid is None else grid
    if grid is None:
        raise ArgumentError(f"{where}: expected grid=, a VoxelGrid, with a tensor, got None.")
    volume = input if isinstance(input, Tensor) else input.values
    if tuple(volume.shape[-3:]) != tuple(grid.shape) or volume.is_complex():
        raise ShapeError(
            f"{where}: expected a real volume (..., {', '.join(map(str, grid.shape))}) on its grid, got "
            f"{tuple(volume.shape)} {volume.dtype}."
        )
    check_finite(volume, None, "input", where)
    truth = torch.from_numpy(numbers(f"{where}: points", points))
    if truth.ndim != 2 or truth.shape[-1] != 3:
        raise ShapeError(f"{where}: expected points (N, 3), metres, got {tuple(truth.shape)}.")
    check_finite(truth, None, "points", where)
    flat = volume.detach().double().reshape(-1, *grid.shape)
    distances = torch.stack([_distances(flat, grid, point, radius, where) for point in truth], -1)
    squares = distances.square().reshape(*volume.shape[:-3], len(truth))
    return Tally(squares, None, 1, Finish(Kind.ROOT)).result(reduction, where)


def _distances(volumes: Tensor, grid: VoxelGrid, point: Tensor, radius: float, where: str) -> Tensor:
    """Distances (B,), metres, of a point (3,) from its peak in each volume (B, Z, Y, X)."""
    offset = point - grid.first
    rows, columns = (torch.arange(n, dtype=torch.float64) * step for n, step in zip(grid.size, grid.pitch, strict=True))
    places = grid.depths, rows, columns
    away = [
        along - float(offset @ direction)
        for along, direction in zip(places, (grid.normal, grid.along_y, grid.along_x), strict=True)
    ]
    # voxels of the ball among those of a cube around it, since the volume may be large
    box = [torch.nonzero(one.abs() <= radius).flatten() for one in away]
    z, y, x = (one[kept].square() for one, kept in zip(away, box, strict=True))
    near = z[:, None, None] + y[:, None] + x <= radius**2
    if not bool(near.any()):
        raise UnitError(
            f"{where}: expected a voxel within {radius:.4g} m of each point, got none near {point.tolist()} m. Take a "
            "larger radius, or look whether the point is inside of the grid."
        )
    first = [int(one[0]) for one in box]
    around = volumes[:, *(slice(start, start + len(one)) for start, one in zip(first, box, strict=True))]
    peaks, indices = torch.where(near.to(volumes.device), around, -torch.inf).flatten(1).max(1)
    found = []
    for volume, peak, index in zip(volumes, peaks, indices, strict=True):
        if float(peak) <= 0:
            found.append(radius)
            continue
        inside = torch.unravel_index(index.cpu(), tuple(near.shape))
        place = [start + int(k) for start, k in zip(first, inside, strict=True)]
        parts = [float(away[k][place[k]]) + _step(volume, away[k], place, k) for k in range(3)]
        found.append(math.hypot(*parts))
    return volumes.new_tensor(found)


def _step(volume: Tensor, along: Tensor, place: list[int], axis: int) -> float:
    """Distance, metres, from a voxel to the top of the parabola through its neighbors along an axis; 0 at borders."""
    i = place[axis]
    if not 0 < i < len(along) - 1:
        return 0.0
    low, middle, high = (float(volume[(*place[:axis], i + step, *place[axis + 1 :])]) for step in (-1, 0, 1))
    before, after = float(along[i] - along[i - 1]), float(along[i + 1] - along[i])
    # slopes to both sides: the top is where the line between them is zero
    rise, fall = (middle - low) / before, (middle - high) / after
    if rise + fall <= 0:
        return 0.0
    return min(max((rise * after - fall * before) / (2 * (rise + fall)), -before / 2), after / 2)
