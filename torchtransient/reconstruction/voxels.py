"""Grids and the data on them: points of a flat wall, voxels before it, hidden volumes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from torchtransient.capture import Scan, Wall
from torchtransient.capture.capture import metadata_text, summed
from torchtransient.capture.scan import bounds_of
from torchtransient.capture.wall import triple
from torchtransient.checks import Numbers, count, positive, real_array, shown
from torchtransient.errors import SceneError, ShapeError, UnitError
from torchtransient.tensor_record import TensorRecord, same

# Share of a pitch that points may be off the grid: single precision of a scan that is metres away from the origin.
OFF_GRID = 1e-3


@dataclass(frozen=True, eq=False, repr=False)
class PlanarScan:
    """A regular grid of points on a flat wall. Made by :meth:`of`.

    Attributes:
        size: (Y, X) points.
        pitch: distances (dy, dx) between the points, metres.
        first: (3,), the point (0, 0), metres, float64 on the CPU as all vectors.
        along_x, along_y: (3,), unit vectors along rows and columns.
        normal: (3,), unit vector to the hidden side.
    """

    size: tuple[int, int]
    pitch: tuple[float, float]
    first: Tensor
    _: KW_ONLY
    along_x: Tensor
    along_y: Tensor
    normal: Tensor

    @staticmethod
    def of(points: Tensor, *, who: str) -> PlanarScan:
        """Return the grid of points, whose normal is ``along_x`` times ``along_y``.

        Args:
            points: (Y, X, 3), two along each side at least, metres.
            who: begins the message.

        Raises:
            ShapeError: for a list of points, and for grids that are not regular, not at right angles, or not flat.
        """
        p = points.detach().to("cpu", torch.float64, copy=True)
        if p.ndim != 3 or p.shape[-1] != 3 or min(p.shape[:2]) < 2:
            raise ShapeError(
                f"{who}: expected sensor points as a grid (Y, X, 3) of 2 x 2 at least, got {tuple(p.shape)}."
            )
        rows, columns = p.shape[:2]
        x, y = (p[0, -1] - p[0, 0]) / (columns - 1), (p[-1, 0] - p[0, 0]) / (rows - 1)
        dx, dy = float(x.norm()), float(y.norm())
        i, k = (torch.arange(n, dtype=torch.float64, device="cpu")[:, None] for n in (columns, rows))
        expected = p[0, 0] + (k * y)[:, None] + (i * x)[None]
        slack = OFF_GRID * min(dx, dy)
        off = float((p - expected).norm(dim=-1).max())
        if not (slack > 0 and off <= slack and abs(float(x @ y)) <= OFF_GRID * dx * dy):
            raise ShapeError(
                f"{who}: expected sensor points on a regular, rectangular grid of a flat wall, got some {off:.3g} m off"
            )
        along_x = x / dx
        # At right angles to rounding, where the points are to a share of their pitch.
        along_y = y - (y @ along_x) * along_x
        along_y = along_y / along_y.norm()
        normal = torch.linalg.cross(along_x, along_y)
        return PlanarScan((rows, columns), (dy, dx), p[0, 0], along_x=along_x, along_y=along_y, normal=normal)

    @staticmethod
    def of_scan(scan: Scan, who: str) -> PlanarScan:
        """Return the grid of a scan's sensor points, with its :func:`hidden_side`.

        Args:
            scan: scan on a regular grid of a flat wall.
            who: begins the message.

        Raises:
            ShapeError: for other scans.
        """
        wall = PlanarScan.of(scan.sensor_points, who=who)
        return replace(wall, normal=hidden_side(scan, wall.normal))

    @property
    def points(self) -> Tensor:
        """Points of the grid in world coordinates, (Y, X, 3) float64 on the CPU, metres."""
        rows, columns = (torch.arange(n, dtype=torch.float64, device="cpu") for n in self.size)
        wall = self.first + (rows[:, None, None] * self.pitch[0]) * self.along_y
        return wall + (columns[None, :, None] * self.pitch[1]) * self.along_x

    def matches(self, other: PlanarScan) -> bool:
        """Return True for the same grid with the same hidden side, to a thousandth of the smallest pitch.

        Args:
            other: the grid to compare with.
        """
        if self.size != other.size or float(self.normal @ other.normal) <= 0:
            return False
        off = float((self.points - other.points).norm(dim=-1).max())
        return off <= OFF_GRID * min(*self.pitch, *other.pitch)

    def __repr__(self) -> str:
        (rows, columns), (dy, dx) = self.size, self.pitch
        return f"PlanarScan({columns} x {rows} points, {dx:.4g} x {dy:.4g} m apart)"

    def local(self, points: Tensor) -> Tensor:
        """Return coordinates along x, y and the normal, from the first point.

        Args:
            points: (..., 3) in world coordinates, metres.

        Returns:
            (..., 3) float64 on the CPU, metres.
        """
        off = points.detach().to("cpu", torch.float64) - self.first
        return torch.stack([off @ self.along_x, off @ self.along_y, off @ self.normal], -1)


def hidden_side(scan: Scan, normal: Tensor) -> Tensor:
    """Return the normal of a scan's wall or its opposite, whichever points to the hidden side.

    That is the side of the scan's normals; without them, the side on which its sensor and its laser stand. Where they
    stand in the wall or on both sides of it, ``normal`` as given.

    Args:
        scan: scan of any kind.
        normal: unit normal of the wall, (3,).
    """
    if scan.sensor_normals is not None:
        mean = scan.sensor_normals.detach().to("cpu", torch.float64).reshape(-1, 3).mean(0)
        return normal if float(mean @ normal) >= 0 else -normal
    points = scan.sensor_points.detach().to("cpu", torch.float64).reshape(-1, 3)
    middle, extent = points.mean(0), float((points.amax(0) - points.amin(0)).norm())
    origins = (origin.detach().to("cpu", torch.float64) for origin in (scan.sensor_origin, scan.laser_origin))
    heights = [float((origin - middle) @ normal) for origin in origins]
    return -normal if max(heights) < -1e-6 * extent else normal


# How far points are off one line at most, as a share of its length.
ON_ONE_LINE = 1e-6


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """Planes of voxels, one behind another. Make one with :meth:`before`, :meth:`bounds` or :meth:`of_wall`.

    Voxel (k, j, i) stands at ``first + j pitch[0] along_y + i pitch[1] along_x + depths[k] normal``.

    Args:
        depths: depths of the planes (Z,), metres, increasing, not necessarily evenly.
        size: (Y, X) voxels of a plane.
        pitch: distances (dy, dx) between the points, metres.
        first: (3,), the voxel (0, 0) of a plane at depth zero, metres.
        along_x, along_y, normal: (3,), unit vectors at right angles.

    Raises:
        ShapeError: for other shapes, and vectors that are no such axes.
        UnitError: for numbers that are not finite, and depths that do not increase.

    Vectors and depths are float64 on the CPU.
    """

    depths: Tensor
    size: tuple[int, int]
    pitch: tuple[float, float]
    _: KW_ONLY
    first: Tensor
    along_x: Tensor
    along_y: Tensor
    normal: Tensor

    def __post_init__(self) -> None:
        depths = checked_depths(self.depths, "VoxelGrid")
        size = tuple(count("VoxelGrid: size", n) for n in self.size)
        pitch = tuple(positive("VoxelGrid: pitch", p) for p in self.pitch)
        if len(size) != 2 or len(pitch) != 2:
            raise ShapeError(f"VoxelGrid: expected size and pitch along (Y, X), got {size} and {pitch}.")
        for name, value in {"depths": depths, "size": size, "pitch": pitch}.items():
            object.__setattr__(self, name, value)
        for name in ("first", "along_x", "along_y", "normal"):
            object.__setattr__(self, name, torch.from_numpy(triple(f"VoxelGrid: {name}", getattr(self, name))))
        axes = torch.stack([self.along_x, self.along_y, self.normal])
        if not torch.allclose(axes @ axes.T, torch.eye(3, dtype=torch.float64, device="cpu"), atol=1e-6):
            raise ShapeError(
                f"VoxelGrid: expected along_x, along_y and normal of length one at right angles, got {axes.tolist()}."
            )

    @classmethod
    def before(
        cls,
        scan: Scan,
        depths: Any,
        *,
        size: int | Sequence[int] | None = None,
        extent: float | Numbers | None = None,
    ) -> VoxelGrid:
        """Make planes before the wall of a scan, parallel to it, along its rows and columns.

        Without ``size`` and ``extent`` a voxel stands before each sensor point of a flat, regular grid, which is what
        :class:`PhasorField` takes at its fastest. The planes of a curved wall are parallel to its mean plane, depths
        count from the mean of its points. Planes of a list of points that knows no wall lie across its mean normal,
        without normals along the plane that fits the points best (of points on one line: across the way to the sensor);
        columns run upwards, along the world's y as far as it lies in them (z where the wall lies flat).

        Before the wall is where its normals point. A scan that knows none has its voxels where its sensor and its laser
        stand; where those stand in the wall or on both sides of it, in the direction of along_x times along_y.

        Args:
            scan: scan of any kind.
            depths: depths of the planes (Z,), metres before the wall, increasing.
            size: (X, Y) voxels or one number for both, None for as many as sensor points.
            extent: (width, height) of the planes in metres from the outer edges of the voxels, or one number for both,
                around the middle of the sensor points; None for the area of the sensor points, each with a cell of its
                own around it.

        Raises:
            ShapeError: where size and extent are missing and the wall is not flat or the points are a list, where the
                sensor of a list without normals stands on its one line, and for other sizes.
            UnitError: for depths that do not increase.
            SceneError: where points on one line, or one point, do not say an extent.
        """
        depths = checked_depths(depths, "VoxelGrid.before")
        if size is None and extent is None:
            wall = PlanarScan.of_scan(scan, "VoxelGrid.before without size and extent")
            return cls.of_wall(wall, depths)
        points = scan.sensor_points.detach().to("cpu", torch.float64)
        along_x, along_y, normal = _wall_axes(scan, points)
        if size is None and points.ndim != 3:
            raise ShapeError("VoxelGrid.before: expected size= for a list of points, got none.")
        shape = reversed(points.shape[:-1]) if size is None else _numbers("VoxelGrid.before: size", size, 2)
        columns, rows = (count("VoxelGrid.before: size", n) for n in shape)
        flat = points.reshape(-1, 3)
        spans = []
        for axis, n in ((along_x, points.shape[-2]), (along_y, points.shape[0] if points.ndim == 3 else 1)):
            along = flat @ axis
            spread = float(along.max() - along.min())
            # Each sensor point of a grid has a cell around it.
            cells = n / (n - 1) if points.ndim == 3 and n > 1 else 1.0
            spans.append((float(along.max() + along.min()) / 2, spread * cells))
        if extent is None and min(span for _, span in spans) <= ON_ONE_LINE * max(span for _, span in spans):
            raise SceneError(
                f"VoxelGrid.before: the points of {scan!r} lie on one line. Give extent=(width, height) in metres."
            )
        given = (spans[0][1], spans[1][1]) if extent is None else _numbers("VoxelGrid.before: extent", extent, 2)
        width, height = (positive("VoxelGrid.before: extent", value) for value in given)
        dx, dy = width / columns, height / rows
        first = (
            (spans[0][0] - (columns - 1) / 2 * dx) * along_x
            + (spans[1][0] - (rows - 1) / 2 * dy) * along_y
            + (flat.mean(0) @ normal) * normal
        )
        return cls(depths, (rows, columns), (dy, dx), first=first, along_x=along_x, along_y=along_y, normal=normal)

    @classmethod
    def of_wall(cls, wall: PlanarScan, depths: Any) -> VoxelGrid:
        """Make a voxel before each point of a regular grid, at each depth.

        Args:
            wall: the grid.
            depths: depths of the planes (Z,), metres, increasing.

        Raises:
            ShapeError, UnitError: as the class.
        """
        return cls(depths, **vars(wall))

    @classmethod
    def bounds(cls, bounds: Any, size: int | Sequence[int]) -> VoxelGrid:
        """Make voxels that fill a box: the middles of equal cells, rows along y, columns along x, planes along z.

        Args:
            bounds: (2, 3), the lowest and highest corner in world coordinates, metres.
            size: (X, Y, Z) voxels, or one number for the three.

        Raises:
            ShapeError, UnitError: for other bounds and sizes.
        """
        low, high = bounds_of(bounds, "VoxelGrid.bounds")
        sizes = [count("VoxelGrid.bounds: size", n) for n in _numbers("VoxelGrid.bounds: size (X, Y, Z)", size, 3)]
        dx, dy, dz = (
            positive("VoxelGrid.bounds: a side", (b - a) / n) for a, b, n in zip(low, high, sizes, strict=True)
        )
        eye = torch.eye(3, dtype=torch.float64, device="cpu")
        first = torch.stack([low[0] + dx / 2, low[1] + dy / 2, torch.zeros((), dtype=torch.float64, device="cpu")])
        depths = low[2] + dz * (torch.arange(sizes[2], dtype=torch.float64, device="cpu") + 0.5)
        return cls(depths, (sizes[1], sizes[0]), (dy, dx), first=first, along_x=eye[0], along_y=eye[1], normal=eye[2])

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels (Z, Y, X)."""
        return (len(self.depths), *self.size)

    @property
    def points(self) -> Tensor:
        """Voxels in world coordinates, (Z, Y, X, 3) float64 on the CPU, metres."""
        j, i = (torch.arange(n, dtype=torch.float64, device="cpu") for n in self.size)
        plane = self.first + (j[:, None, None] * self.pitch[0]) * self.along_y
        plane = plane + (i[None, :, None] * self.pitch[1]) * self.along_x
        return plane + self.depths[:, None, None, None] * self.normal

    @property
    def extent(self) -> tuple[float, float]:
        """Size (width, height) of a plane from the outer edges of its voxels, metres."""
        return self.size[1] * self.pitch[1], self.size[0] * self.pitch[0]

    def at_depths(self, depths: Any) -> VoxelGrid:
        """Return the grid with other planes.

        Args:
            depths: depths of the planes (Z,), metres, increasing.

        Raises:
            ShapeError, UnitError: for other depths.
        """
        return replace(self, depths=depths)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, VoxelGrid):
            return NotImplemented
        return all(same(a, b) for a, b in zip(vars(self).values(), vars(other).values(), strict=True))

    def __hash__(self) -> int:
        return hash((self.shape, self.pitch))

    def __repr__(self) -> str:
        near, far = float(self.depths[0]), float(self.depths[-1])
        dy, dx = self.pitch
        return f"VoxelGrid({self.shape}, {dy:.4g} x {dx:.4g} m apart, depths {near:.4g} to {far:.4g} m)"


def checked_depths(values: Any, who: str) -> Tensor:
    """Return depths of planes, float64 on the CPU.

    Args:
        values: (Z,) metres, a tensor, an array or a list.
        who: begins the message.

    Raises:
        ShapeError: for other shapes.
        UnitError: for depths that are not finite or do not increase.
    """
    plain = real_array(values)
    if plain is None or plain.ndim != 1 or len(plain) == 0:
        raise ShapeError(f"{who}: expected depths (Z,) in metres, got {shown(values)}.")
    depths = torch.from_numpy(plain)
    if not bool(torch.isfinite(depths).all()) or not bool((depths.diff() > 0).all()):
        raise UnitError(f"{who}: expected finite depths that increase, got {shown(plain.tolist())}.")
    return depths


def _numbers(name: str, value: Any, many: int) -> list[float]:
    """``many`` numbers, or one that stands for all. Raises ShapeError."""
    plain = real_array(value)
    if plain is None or plain.shape not in ((many,), ()):
        raise ShapeError(f"{name}: expected {many} numbers or one for all, got {shown(value)}.")
    numbers: list[float] = np.broadcast_to(plain, many).tolist()
    return numbers


def _mean_normal(scan: Scan, points: Tensor) -> Tensor:
    """The normal (3,) of a list of points, towards the sensor where the scan says none."""
    if scan.sensor_normals is not None:
        mean: Tensor = scan.sensor_normals.detach().to("cpu", torch.float64).reshape(-1, 3).mean(0)
        return mean
    towards = scan.sensor_origin.detach().to("cpu", torch.float64) - points.mean(0)
    _, spread, axes = torch.linalg.svd(points - points.mean(0), full_matrices=True)
    if len(spread) > 1 and spread[1] > ON_ONE_LINE * spread[0]:
        normal: Tensor = axes[2]
        return normal if float(normal @ towards) >= 0 else -normal
    across: Tensor = towards - (towards @ axes[0]) * axes[0] if len(points) > 1 else towards
    if float(across.norm()) <= ON_ONE_LINE * float(towards.norm()):
        raise ShapeError(
            "VoxelGrid.before: the sensor stands on the one line of its points. Give their normals to Scan.points."
        )
    return across


def _upright(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Vectors along rows and along columns of planes across ``normal``: the latter upwards, along y or else z."""
    up = torch.eye(3, dtype=torch.float64, device="cpu")[1]
    if float(torch.linalg.cross(up, normal).norm()) <= ON_ONE_LINE * float(normal.norm()):
        up = up.roll(1)
    along_x = torch.linalg.cross(up, normal)
    return along_x, torch.linalg.cross(normal, along_x)


def _wall_axes(scan: Scan, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Unit vectors along rows, along columns and towards the hidden side, at right angles."""
    if points.ndim == 3 and min(points.shape[:2]) > 1:
        x, y = (points[:, -1] - points[:, 0]).mean(0), (points[-1] - points[0]).mean(0)
    elif scan.wall is not None:
        surface = Wall.of(scan.wall)
        x, y = torch.from_numpy(surface.half_u), torch.from_numpy(surface.half_v)
    else:
        x, y = _upright(_mean_normal(scan, points.reshape(-1, 3)))
    along_x = x / x.norm()
    y = y - (y @ along_x) * along_x
    along_y = y / y.norm()
    normal = torch.linalg.cross(along_x, along_y)
    return along_x, along_y, hidden_side(scan, normal)


@dataclass(frozen=True, eq=False, repr=False)
class HiddenVolume(TensorRecord):
    """A hidden volume as a record of tensors: the result of a method, its voxels, and its settings.

    Args:
        values: (..., C, Z, Y, X) real, on the voxels of ``grid``; with ``times`` a film (..., C, N, Z, Y, X).
        grid: the voxels.
        method: name of the method.
        metadata: settings of the method and the reason for choosing it, as plain data; that of a batch is a list under
            ``batch``.
        times: (N,), finite metres of optical path, None without a film.
        directions: (..., C, 3, Z, Y, X), vectors in world coordinates whose lengths are the values, of methods that
            find normals.

    Raises:
        ShapeError: where tensors and grid do not fit.
        UnitError: for times that are not finite.
        StorageError: for metadata that is not plain.

    Two volumes are equal when all but ``metadata`` is. ``to``, ``detach``, ``clone``, ``map``, ``stack`` and ``cat`` as
    in captures and results of renders: they concern values and directions; grid and times stay on the CPU, and are the
    same in a batch.
    """

    notes: ClassVar[tuple[str, ...]] = ("metadata",)

    values: Tensor
    grid: VoxelGrid
    method: str
    _: KW_ONLY
    metadata: Mapping[str, Any] = field(default_factory=dict)
    times: Tensor | None = None
    directions: Tensor | None = None

    def __post_init__(self) -> None:
        _check_volume(self)

    def tensors(self) -> dict[str, Tensor]:
        """Values and directions."""
        return {name: tensor for name, tensor in super().tensors().items() if name != "times"}

    def _settings(self) -> dict[str, Any]:
        # One by one: torch 2.6 makes no list inside of `torch.func.grad`.
        times = None if self.times is None else tuple(time.item() for time in self.times.unbind())
        return {**super()._settings(), "times": times}

    @classmethod
    def merged_notes(cls, records: Sequence[HiddenVolume]) -> dict[str, Any]:
        return {"metadata": {"batch": [dict(record.metadata) for record in records]}}

    def _shown(self) -> dict[str, str]:
        frames = {} if self.times is None else {"times": f"{len(self.times)} of them"}
        return {**{name: text for name, text in super()._shown().items() if name != "times"}, **frames}

    def picture(self) -> Tensor:
        """(Z, Y, X): the first item of a batch, summed over its channels; of a film the highest value of all times."""
        per_item = 4 if self.times is None else 5
        values = self.values.detach()
        while values.ndim > per_item:
            values = values[0]
        together = summed(values, 0)
        return together if self.times is None else together.amax(0)


def _check_volume(volume: HiddenVolume) -> None:
    """Raise ShapeError unless values, times and directions are real and fit the grid and each other."""
    frames = () if volume.times is None else tuple(volume.times.shape)
    if volume.times is not None and (
        len(frames) != 1 or volume.times.is_complex() or not bool(torch.isfinite(volume.times).all())
    ):
        error = UnitError if len(frames) == 1 else ShapeError
        raise error(f"HiddenVolume: expected finite times (N,) in metres of optical path, got {volume.times}.")
    _check_values("values", volume.values, (*frames, *volume.grid.shape))
    if volume.directions is not None:
        _check_values("directions", volume.directions, (3, *volume.grid.shape))
        if volume.directions.shape[:-4] != volume.values.shape[: -3 - len(frames)]:
            raise ShapeError("HiddenVolume: expected directions for each of the values, got other leading dimensions.")
    metadata_text(volume.metadata, "HiddenVolume")


def _check_values(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    real = not tensor.is_complex() and tensor.dtype != torch.bool and tensor.numel() > 0
    if not real or tensor.ndim <= len(shape) or tuple(tensor.shape[-len(shape) :]) != shape:
        sizes = ", ".join(map(str, shape))
        raise ShapeError(
            f"HiddenVolume: expected {name} (..., C, {sizes}), real, got {tuple(tensor.shape)} {tensor.dtype}."
        )
