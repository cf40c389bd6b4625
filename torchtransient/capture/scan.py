"""Scans of a relay wall: points that a laser lights and a sensor sees, and the lengths that are counted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture.wall import Wall, grid_size, triple
from torchtransient.checks import Numbers, as_whole, positive, real_array, shown
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.tensor_record import same

# Kinds of a regular grid; "pairs" are given point by point.
GRID_KINDS = ("single", "confocal", "exhaustive")
KINDS = (*GRID_KINDS, "pairs")
_TENSORS = ("sensor_points", "laser_points", "sensor_origin", "laser_origin", "sensor_normals", "laser_normals")
# Where origins stand unless they are given: aside of the wall's middle and close to it, as parts of its width.
_ASIDE, _BEFORE = 0.25, 0.125


@dataclass(frozen=True, eq=False)
class Scan:
    """Points of a capture around a corner. Most scans are made by :meth:`grid` or :meth:`points`.

    Args:
        kind: "single", one laser spot for all sensor points; "confocal", each sensor point is lit itself; "exhaustive",
            all pairs of a spot and a sensor point; "pairs", a spot of its own for each sensor point.
        sensor_points: (Sy, Sx, 3) or a list (N, 3), on the wall, metres, as all lengths.
        laser_points: (3,) for single, equal to the sensor points for confocal, (Ly, Lx, 3) or (M, 3) for exhaustive, in
            the shape of the sensor points for pairs.
        sensor_origin, laser_origin: places of the sensor and the laser, (3,) each.
        sensor_normals, laser_normals: unit normals of the wall in the shapes of the points, None until they are known.
        first_and_last_leg: optical path lengths count from the laser's origin to the sensor's; False: from the spot to
            the sensor point.
        wall: Mitsuba's dictionary of the relay wall, None when a scene holds it.

    Raises:
        ShapeError: for shapes that do not belong together.
        UnitError: for numbers that are not finite.
        ArgumentError: for an unknown kind, points off the wall and origins behind it.

    Tensors are float64. Points may carry gradients; float64 tensors are kept, not copied: do not change them in place.
    Frozen and picklable; two scans are equal when all of this is.
    """

    kind: str
    sensor_points: Tensor
    laser_points: Tensor
    _: KW_ONLY
    sensor_origin: Tensor
    laser_origin: Tensor
    sensor_normals: Tensor | None = None
    laser_normals: Tensor | None = None
    first_and_last_leg: bool = False
    wall: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ArgumentError(f"Scan: expected kind to be one of {', '.join(KINDS)}, got {shown(self.kind)}.")
        device = self.sensor_points.device if isinstance(self.sensor_points, Tensor) else torch.device("cpu")
        for name in _TENSORS[:4]:
            object.__setattr__(self, name, _float64_points(name, getattr(self, name), device))
        for name in _TENSORS[4:]:
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _unit_normals(name, _float64_points(name, getattr(self, name), device)))
        _check_shapes(self)
        _check_sides(self)

    @classmethod
    def grid(
        cls,
        wall: Any,
        size: int | Sequence[int],
        *,
        kind: str,
        laser: Any = None,
        sensor_origin: Any = None,
        laser_origin: Any = None,
        laser_grid: int | Sequence[int] | None = None,
        cell_centers: bool = True,
        extent: Numbers | None = None,
        first_and_last_leg: bool = False,
    ) -> Scan:
        """Return a regular grid of nx x ny sensor points on a wall.

        Args:
            wall: a :class:`Wall`, a Mitsuba dictionary of a rectangle, or (vertices, faces) of a curved wall, on which
                points are found along its mean normal. Rows of the grid run along v, columns along u.
            size: (nx, ny), or one number for both.
            kind: "single", "confocal" or "exhaustive".
            laser: spot of a single scan: a point (3,) on the wall, or its coordinates (u, v); None is the middle of the
                wall.
            sensor_origin: place of the sensor (3,), metres; None: a quarter of the wall's width to the -u side of its
                middle and an eighth of it before the wall, from where all of a flat wall is seen.
            laser_origin: place of the laser (3,), metres; None: the same default as for the sensor.
            laser_grid: size of an exhaustive scan's grid of spots, None for the sensor's.
            cell_centers: points are the middles of grid cells, for both grids, see :meth:`Wall.grid`.
            extent: part of the wall that both grids scan, (u0, v0, u1, v1), None for all of it, see :meth:`Wall.grid`.
            first_and_last_leg: lengths count from the laser's origin to the sensor's.

        Raises:
            SceneError: for a spot that misses the wall, a laser or a laser grid that the kind has no use for, and an
                exhaustive scan of one pair, which is a single one.
            ArgumentError: for pairs, which :meth:`points` takes; otherwise as the class and :meth:`Wall.grid`.
        """
        if kind not in GRID_KINDS:
            raise ArgumentError(
                f"Scan.grid: expected kind single, confocal or exhaustive, got {shown(kind)}. Scan.points takes pairs."
            )
        surface = Wall.of(wall)
        nx, ny = grid_size(size, "Scan.grid")
        points, normals = surface.grid((nx, ny), extent, cell_centers=cell_centers)
        if kind == "single":
            _refuse("laser_grid", laser_grid, kind, "its spot is laser=(u, v) or a point (3,)")
            spots, spot_normals = _spot(surface, laser)
        else:
            _refuse("laser", laser, kind, "laser= is for kind='single'")
            spots, spot_normals = points, normals
        if kind == "confocal":
            _refuse("laser_grid", laser_grid, kind, "it lights its sensor points, size= says how many")
        if kind == "exhaustive":
            if laser_grid is not None:
                spots, spot_normals = surface.grid(laser_grid, extent, cell_centers=cell_centers)
            if spots.size == 3 and points.size == 3:
                raise SceneError(
                    "Scan.grid: expected several pairs, got a grid of one point. Give kind='single' with laser=."
                )
        aside: Any = surface.center - _ASIDE * 2 * surface.half_u + _BEFORE * surface.width * surface.normal
        return cls(
            kind=kind,
            sensor_points=torch.from_numpy(points),
            laser_points=spots,
            sensor_origin=aside if sensor_origin is None else sensor_origin,
            laser_origin=aside if laser_origin is None else laser_origin,
            sensor_normals=torch.from_numpy(normals),
            laser_normals=torch.from_numpy(spot_normals),
            first_and_last_leg=first_and_last_leg,
            wall=surface.shape,
        )

    @classmethod
    def points(
        cls,
        sensor_points: Any,
        *,
        kind: str,
        laser_points: Any = None,
        sensor_origin: Any,
        laser_origin: Any,
        wall: Any = None,
        normals: Any = None,
        laser_normals: Any = None,
        first_and_last_leg: bool = False,
    ) -> Scan:
        """Return a scan of given points.

        Args:
            sensor_points: sensor points (N, 3) or (Sy, Sx, 3), metres, with or without gradients.
            kind: "single", "confocal", "exhaustive" or "pairs", see the class.
            laser_points: laser spots in the shape that the kind asks for, see the class; left out for confocal scans.
            sensor_origin: place of the sensor (3,), metres.
            laser_origin: place of the laser (3,), metres.
            wall: relay wall, as :meth:`grid` takes it. All points must lie on it, to 1e-4 of its diagonal, and get its
                normals; None for points on a wall of a scene, or of a measured one.
            normals: wall normals at the sensor points, in their shape; only without a ``wall``.
            laser_normals: wall normals at the laser spots, in their shape; confocal scans use those of the sensor
                points.
            first_and_last_leg: lengths count from the laser's origin to the sensor's, see the class.

        Raises:
            ShapeError, UnitError, SceneError, ArgumentError: as the class.
        """
        sensor, shape = _float64_points("sensor_points", sensor_points), None
        if wall is not None and not (normals is None and laser_normals is None):
            raise ArgumentError("Scan.points: normals and wall= both say how the wall is turned; give one of them.")
        if kind == "confocal":
            _refuse("laser_points", laser_points, kind, "its spots are its sensor points")
            _refuse("laser_normals", laser_normals, kind, "its spots are its sensor points")
            laser, laser_normals = sensor, normals
        elif laser_points is None:
            raise SceneError(f"Scan.points: expected laser_points for kind={kind!r}, got None. Give the laser's spots.")
        else:
            laser = _float64_points("laser_points", laser_points, sensor.device)
        if wall is not None:
            surface = Wall.of(wall)
            normals = _normals_on(surface, sensor, "Scan.points sensor_points")
            laser_normals, shape = _normals_on(surface, laser, "Scan.points laser_points"), surface.shape
        return cls(
            kind,
            sensor,
            laser,
            sensor_origin=sensor_origin,
            laser_origin=laser_origin,
            sensor_normals=normals,
            laser_normals=laser_normals,
            first_and_last_leg=first_and_last_leg,
            wall=shape,
        )

    # ------------------------------------------------------------------------------------------------------- sizes

    @property
    def sensor_shape(self) -> tuple[int, ...]:
        """(Sy, Sx) or (N,)."""
        return tuple(self.sensor_points.shape[:-1])

    @property
    def laser_shape(self) -> tuple[int, ...]:
        """(Ly, Lx) or (M,); () for a single spot."""
        return tuple(self.laser_points.shape[:-1])

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape behind (C, T) in a capture: (Sy, Sx) or (N,); for exhaustive scans the laser's dimensions before it."""
        return (*self.laser_shape, *self.sensor_shape) if self.kind == "exhaustive" else self.sensor_shape

    @property
    def pairs(self) -> int:
        """Number of histograms in a capture: pairs of a laser spot and a sensor point."""
        return math.prod(self.shape)

    @property
    def sensor_legs(self) -> Tensor:
        """Distances from the sensor points to the sensor's origin, in the points' shape, metres."""
        legs: Tensor = torch.linalg.vector_norm(self.sensor_points - self.sensor_origin, dim=-1)
        return legs

    @property
    def laser_legs(self) -> Tensor:
        """Distances from the laser's origin to its spots, in the spots' shape, metres."""
        legs: Tensor = torch.linalg.vector_norm(self.laser_points - self.laser_origin, dim=-1)
        return legs

    @property
    def legs(self) -> Tensor:
        """Lengths that :attr:`first_and_last_leg` adds to each pair, in the scan's :attr:`shape`, metres."""
        laser = self.laser_legs
        if self.kind == "exhaustive":
            laser = laser.reshape(*self.laser_shape, *(1,) * len(self.sensor_shape))
        return laser + self.sensor_legs

    def default_axis(self, hidden_bounds: Any, bin_width_opl: float) -> TimeAxis:
        """Return an axis that holds all light of three bounces off things in a box.

        Args:
            hidden_bounds: (2, 3), the corners of lowest and of highest coordinates, metres.
            bin_width_opl: width of a bin, metres.

        Returns:
            Axis that starts and ends on multiples of the width. Lengths follow :attr:`first_and_last_leg`.

        Raises:
            ShapeError, UnitError: for other bounds, and as TimeAxis.
        """
        low, high = bounds_of(hidden_bounds, "Scan.default_axis")
        width = positive("Scan.default_axis: bin_width_opl", bin_width_opl)
        shortest, longest = _span(self, low, high)
        first, last = math.floor(shortest / width), math.ceil(longest / width)
        return TimeAxis(first * width, width, max(1, last - first))

    # ------------------------------------------------------------------------------------------------- other scans

    def to(self, device: Any) -> Self:
        """Return the scan with its tensors on a device; they stay float64.

        Args:
            device: target device, as `torch.Tensor.to` takes it.

        Raises:
            ShapeError: for a dtype.
        """
        if isinstance(device, torch.dtype):
            raise ShapeError(f"Scan.to: expected a device, got {device}; points are float64 throughout.")
        moved = {name: getattr(self, name).to(device) for name in _TENSORS if getattr(self, name) is not None}
        return replace(self, **moved)

    def detach(self) -> Self:
        """Return the scan without gradients in its points."""
        return replace(self, **{n: getattr(self, n).detach() for n in _TENSORS if getattr(self, n) is not None})

    def single(self, laser: int | tuple[int, ...]) -> Scan:
        """Return the single scan of one spot of an exhaustive one.

        Args:
            laser: index in the laser's list or grid.

        Raises:
            SceneError: for other kinds.
            ShapeError: for an index out of range.
        """
        if self.kind != "exhaustive":
            raise SceneError(f"Scan.single: expected an exhaustive scan, got a {self.kind} one.")
        index = laser_index(self, laser)
        normals = None if self.laser_normals is None else self.laser_normals[index]
        return replace(self, kind="single", laser_points=self.laser_points[index], laser_normals=normals)

    def confocal(self) -> Scan:
        """Return the confocal scan in an exhaustive one whose spots are its sensor points. Raises SceneError for
        others.
        """
        same = self.laser_points.shape == self.sensor_points.shape and bool(
            torch.allclose(self.laser_points, self.sensor_points, rtol=0, atol=1e-9)
        )
        if self.kind != "exhaustive" or not same:
            raise SceneError(
                f"Scan.confocal: expected an exhaustive scan whose spots are its sensor points, got a {self.kind} one "
                f"of spots {self.laser_shape} and sensor points {self.sensor_shape}."
            )
        return replace(self, kind="confocal", laser_points=self.sensor_points, laser_normals=self.sensor_normals)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Scan):
            return NotImplemented
        return all(same(a, b) for a, b in zip(vars(self).values(), vars(other).values(), strict=True))

    def __hash__(self) -> int:
        return hash((self.kind, self.shape, self.first_and_last_leg))

    def __repr__(self) -> str:
        points = self.sensor_points.detach().reshape(-1, 3)
        size = (points.amax(0) - points.amin(0)).norm()
        sensor = " x ".join(map(str, reversed(self.sensor_shape)))
        spots = " x ".join(map(str, reversed(self.laser_shape)))
        lasers = {"single": ", 1 spot", "exhaustive": f", {spots} spots", "pairs": ", a spot each"}.get(self.kind, "")
        legs = ", with first and last leg" if self.first_and_last_leg else ""
        return f"Scan({self.kind}, {sensor} points over {float(size):.4g} m{lasers}{legs})"


def laser_index(scan: Scan, laser: int | tuple[int, ...]) -> tuple[int, ...]:
    """Return an index into the spots of a scan.

    Args:
        scan: an exhaustive scan.
        laser: whole number, or one for each dimension.

    Raises:
        ShapeError: for an index out of range.
    """
    index = laser if isinstance(laser, tuple) else (laser,)
    whole = tuple(number for i in index if (number := as_whole(i)) is not None)
    inside = len(whole) == len(index) == len(scan.laser_shape)
    if not inside or not all(-n <= i < n for i, n in zip(whole, scan.laser_shape, strict=True)):
        raise ShapeError(f"laser: expected an index into spots {scan.laser_shape}, got {shown(laser)}.")
    return whole


def _spot(surface: Wall, laser: Any) -> tuple[Any, np.ndarray]:
    if laser is None:
        return surface.at(0.5, 0.5)
    plain = real_array(laser)
    if plain is None or plain.shape not in ((2,), (3,)):
        raise ShapeError(f"Scan.grid laser: expected (u, v) on the wall or a point (3,), got {shown(laser)}.")
    if plain.shape == (2,):
        return surface.at(plain[0], plain[1])
    point = triple("Scan.grid laser", laser)
    return laser, surface.normals_at(point[None], "Scan.grid laser")[0]


def _normals_on(surface: Wall, points: Tensor, what: str) -> Tensor:
    flat = points.detach().cpu().numpy().reshape(-1, 3)
    return torch.from_numpy(surface.normals_at(flat, what)).reshape(points.shape).to(points.device)


def _refuse(name: str, value: Any, kind: str, instead: str) -> None:
    if value is not None:
        raise ArgumentError(f"Scan: {name} has no meaning for kind={kind!r}: {instead}. Leave it out.")


def _float64_points(name: str, values: Any, device: torch.device | None = None) -> Tensor:
    """Return points (..., 3) as float64, with their gradients. Raises ShapeError and UnitError."""
    plain = values if isinstance(values, Tensor) else real_array(values)
    if plain is None:
        raise ShapeError(f"Scan: expected {name} as points of three numbers, got {shown(values)}.")
    tensor = plain if isinstance(plain, Tensor) else torch.from_numpy(plain)
    if tensor.is_complex() or tensor.ndim == 0 or tensor.shape[-1] != 3 or tensor.numel() == 0:
        raise ShapeError(f"Scan: expected {name} as points (..., 3), got {tensor.dtype} of {tuple(tensor.shape)}.")
    tensor = tensor.to(device=device or tensor.device, dtype=torch.float64)
    if not bool(torch.isfinite(tensor).all()):
        raise UnitError(f"Scan: expected {name} in finite metres, got NaN or infinity.")
    return tensor


def _unit_normals(name: str, normals: Tensor) -> Tensor:
    """Return normals (..., 3) of length 1; normalized ones keep every digit. Raises UnitError for zero vectors."""
    length: Tensor = torch.linalg.vector_norm(normals, dim=-1, keepdim=True)
    if not bool((length > 0).all()):
        raise UnitError(f"Scan: expected {name} with a direction, got a zero vector.")
    off = (length - 1).abs() > 1e-12
    return torch.where(off, normals / length, normals)


def _check_shapes(scan: Scan) -> None:
    """Raise ShapeError or SceneError unless points, normals and origins have the shapes of the scan's kind."""
    for name in ("sensor_origin", "laser_origin"):
        if getattr(scan, name).shape != (3,):
            raise ShapeError(f"Scan: expected {name} (3,), got {tuple(getattr(scan, name).shape)}.")
    sensor, laser = scan.sensor_points, scan.laser_points
    if sensor.ndim not in (2, 3):
        raise ShapeError(f"Scan: expected sensor_points (Sy, Sx, 3) or (N, 3), got {tuple(sensor.shape)}.")
    expected = (3,) if scan.kind == "single" else tuple(sensor.shape)
    if laser.ndim not in (2, 3) if scan.kind == "exhaustive" else laser.shape != expected:
        words = "(Ly, Lx, 3) or (M, 3)" if scan.kind == "exhaustive" else expected
        raise ShapeError(f"Scan: expected laser_points {words} for kind={scan.kind!r}, got {tuple(laser.shape)}.")
    if scan.kind == "confocal" and not bool(torch.equal(laser, sensor)):
        raise SceneError("Scan: expected the laser points of a confocal scan to be its sensor points, got others.")
    for name in ("sensor", "laser"):
        points, normals = getattr(scan, f"{name}_points"), getattr(scan, f"{name}_normals")
        if normals is not None and normals.shape != points.shape:
            raise ShapeError(
                f"Scan: expected {name}_normals {tuple(points.shape)} as the points, got {tuple(normals.shape)}."
            )


def _check_sides(scan: Scan) -> None:
    """Raise SceneError unless the origins are in front of the wall at each point."""
    for name in ("sensor", "laser"):
        normals = getattr(scan, f"{name}_normals")
        if normals is None:
            continue
        origin, points = getattr(scan, f"{name}_origin"), getattr(scan, f"{name}_points")
        heights = ((origin - points) * normals).sum(-1).detach()
        behind = int((heights <= 0).sum())
        if behind:
            raise SceneError(
                f"Scan: expected {name}_origin in front of the wall, got {origin.tolist()}, which {behind} of "
                f"{heights.numel()} points do not see, {-float(heights.min()):.4g} m behind them at most. Move it to "
                "the side that the normals point to, or turn the wall (flip_normals, or the order of corners)."
            )


# ------------------------------------------------------------------------------
# Shortest and longest path from spots over a box to sensor points: the span of a time axis.


def bounds_of(bounds: Any, who: str) -> tuple[Tensor, Tensor]:
    """Return the corners (3,) of a box of lowest and highest coordinates, float64.

    Args:
        bounds: corners of lowest and highest coordinates (2, 3), metres.
        who: subject of messages.

    Raises:
        ShapeError, UnitError: for other bounds.
    """
    plain = real_array(bounds)
    if plain is None or plain.shape != (2, 3):
        raise ShapeError(f"{who}: expected bounds (2, 3), the lowest and the highest corner, got {shown(bounds)}.")
    box = torch.from_numpy(plain)
    if not bool(torch.isfinite(box).all()) or not bool((box[0] <= box[1]).all()):
        raise UnitError(f"{who}: expected finite bounds, the lowest corner first, got {box.tolist()}.")
    return box[0], box[1]


def _span(scan: Scan, low: Tensor, high: Tensor) -> tuple[float, float]:
    """Bounds of the lengths of three-bounce paths over a box, metres.

    From below: the sum of the distances of spot and sensor point to the box, each to its own nearest point, exact for
    confocal scans. From above: sums of distances are convex, the longest path goes over a corner.
    """
    corners = torch.cartesian_prod(*torch.stack([low, high], 1))
    near, far = [], []
    for points, legs in ((scan.laser_points, scan.laser_legs), (scan.sensor_points, scan.sensor_legs)):
        flat = points.detach().cpu().reshape(-1, 3)
        leg = legs.detach().cpu().reshape(-1) * scan.first_and_last_leg
        near.append(torch.linalg.vector_norm(flat - flat.clamp(low, high), dim=-1) + leg)
        far.append(torch.linalg.vector_norm(flat[:, None] - corners, dim=-1) + leg[:, None])
    if scan.kind in ("confocal", "pairs"):
        return float((near[0] + near[1]).min()), float((far[0] + far[1]).max())
    return float(near[0].min() + near[1].min()), float((far[0].amax(0) + far[1].amax(0)).max())
