"""A scan as a regular grid on a flat wall: what methods by Fourier transforms need of it."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass, replace

import torch
from torch import Tensor

from torchtransient.capture import Scan
from torchtransient.checks import of_class
from torchtransient.errors import ShapeError

# Share of a pitch that points may be off the grid: single precision of a scan that is metres away from the origin.
OFF_GRID = 1e-3


@dataclass(frozen=True, eq=False, repr=False)
class PlanarScan:
    """``size`` (Y, X) points, ``pitch`` (dy, dx) metres apart along the unit vectors ``along_y`` and ``along_x`` from
    ``first``; ``normal`` points to the hidden side. Vectors are (3,) float64 on the CPU.
    """

    size: tuple[int, int]
    pitch: tuple[float, float]
    first: Tensor
    _: KW_ONLY
    along_x: Tensor
    along_y: Tensor
    normal: Tensor

    @staticmethod
    def of(points: Tensor, normals: Tensor | None = None, *, who: str, what: str = "sensor points") -> PlanarScan:
        """Of points (Y, X, 3), two along each side at least. ``normals`` (Y, X, 3): of the wall, which say where the
        hidden side is; without them it is that of ``along_x`` times ``along_y``. Raises ShapeError for a list of
        points, and for grids that are not regular, not at right angles, or not flat: ``who`` cannot take them.
        """
        check_real(points, f"{who}: {what}")
        p = points.detach().to("cpu", torch.float64, copy=True)
        if p.ndim != 3 or p.shape[-1] != 3 or min(p.shape[:2]) < 2:
            raise ShapeError(f"{who}: expected {what} as a grid (Y, X, 3) of 2 x 2 at least, got {tuple(p.shape)}.")
        rows, columns = p.shape[:2]
        x, y = (p[0, -1] - p[0, 0]) / (columns - 1), (p[-1, 0] - p[0, 0]) / (rows - 1)
        dx, dy = float(x.norm()), float(y.norm())
        i, k = (torch.arange(n, dtype=torch.float64, device="cpu")[:, None] for n in (columns, rows))
        expected = p[0, 0] + (k * y)[:, None] + (i * x)[None]
        slack = OFF_GRID * min(dx, dy)
        off = float((p - expected).norm(dim=-1).max())
        if not (slack > 0 and off <= slack and abs(float(x @ y)) <= OFF_GRID * dx * dy):
            raise ShapeError(
                f"{who}: expected {what} on a regular, rectangular grid of a flat wall, got some {off:.3g} m off it "
                f"(pitch {dy:.3g} x {dx:.3g} m, angle {_angle(x, y)}). Use Backprojection, which takes any points."
            )
        along_x = x / dx
        # At right angles to rounding, where the points are to a share of their pitch.
        along_y = y - (y @ along_x) * along_x
        along_y = along_y / along_y.norm()
        normal = torch.linalg.cross(along_x, along_y)
        if normals is not None:
            normal = _with_normals(normal, normals)
        return PlanarScan((rows, columns), (dy, dx), p[0, 0], along_x=along_x, along_y=along_y, normal=normal)

    @staticmethod
    def of_scan(scan: Scan, who: str) -> PlanarScan:
        """The sensor points of a scan, and its :func:`hidden_side`. Raises ShapeError."""
        of_class(f"{who}: scan", scan, Scan, error=ShapeError)
        wall = PlanarScan.of(scan.sensor_points, who=who)
        return replace(wall, normal=hidden_side(scan, wall.normal))

    @property
    def points(self) -> Tensor:
        """(Y, X, 3) float64 on the CPU: its points in world coordinates, metres."""
        rows, columns = (torch.arange(n, dtype=torch.float64, device="cpu") for n in self.size)
        wall = self.first + (rows[:, None, None] * self.pitch[0]) * self.along_y
        return wall + (columns[None, :, None] * self.pitch[1]) * self.along_x

    def matches(self, other: PlanarScan) -> bool:
        """Whether it is the same grid with the same hidden side, to what points of a grid may be off it."""
        if self.size != other.size or float(self.normal @ other.normal) <= 0:
            return False
        off = float((self.points - other.points).norm(dim=-1).max())
        return off <= OFF_GRID * min(*self.pitch, *other.pitch)

    def __repr__(self) -> str:
        (rows, columns), (dy, dx) = self.size, self.pitch
        return f"PlanarScan({columns} x {rows} points, {dx:.4g} x {dy:.4g} m apart)"

    def local(self, points: Tensor) -> Tensor:
        """Coordinates (..., 3) along x, y and the normal, from the first point, metres, float64."""
        off = points.detach().to("cpu", torch.float64) - self.first
        return torch.stack([off @ self.along_x, off @ self.along_y, off @ self.normal], -1)


def hidden_side(scan: Scan, normal: Tensor) -> Tensor:
    """``normal`` (3,) of a scan's wall or its opposite, whichever points to the hidden side: that of the scan's
    normals; without them, that on which its sensor and its laser stand. Where they stand in the wall or on both sides
    of it nothing says which it is: ``normal`` as given.
    """
    if scan.sensor_normals is not None:
        return _with_normals(normal, scan.sensor_normals)
    points = scan.sensor_points.detach().to("cpu", torch.float64).reshape(-1, 3)
    middle, extent = points.mean(0), float((points.amax(0) - points.amin(0)).norm())
    origins = (origin.detach().to("cpu", torch.float64) for origin in (scan.sensor_origin, scan.laser_origin))
    heights = [float((origin - middle) @ normal) for origin in origins]
    return -normal if max(heights) < -1e-6 * extent else normal


def check_real(points: Tensor, what: str) -> None:
    """Raises ShapeError for complex tensors and truth values, which a conversion would make real numbers of."""
    if points.is_complex() or points.dtype == torch.bool:
        raise ShapeError(f"{what}: expected real numbers, got {points.dtype}.")


def _with_normals(normal: Tensor, normals: Tensor) -> Tensor:
    mean = normals.detach().to("cpu", torch.float64).reshape(-1, 3).mean(0)
    return normal if float(mean @ normal) >= 0 else -normal


def _angle(x: Tensor, y: Tensor) -> str:
    cos = float(x @ y) / max(float(x.norm() * y.norm()), 1e-300)
    return f"{math.degrees(math.acos(max(-1.0, min(1.0, cos)))):.2f} degrees"
