"""Whether the parts of a scan belong together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchtransient.checks import real_array, shown
from torchtransient.errors import SceneError, ShapeError, UnitError

if TYPE_CHECKING:
    from torchtransient.capture.scan import Scan


def float64_points(name: str, values: Any, device: torch.device | None = None) -> Tensor:
    """Points (..., 3) as float64, with the gradients they carry. Raises ShapeError and UnitError."""
    plain = values if isinstance(values, Tensor) else real_array(values)
    if plain is None:
        raise ShapeError(f"Scan: expected {name} as points of three numbers, got {shown(values)}.")
    tensor = plain if isinstance(plain, Tensor) else torch.from_numpy(plain)
    if (
        tensor.is_complex()
        or tensor.dtype == torch.bool
        or tensor.ndim == 0
        or tensor.shape[-1] != 3
        or tensor.numel() == 0
    ):
        raise ShapeError(f"Scan: expected {name} as points (..., 3), got {tensor.dtype} of {tuple(tensor.shape)}.")
    tensor = tensor.to(device=device or tensor.device, dtype=torch.float64)
    if not bool(torch.isfinite(tensor).all()):
        raise UnitError(f"Scan: expected {name} in finite metres, got NaN or infinity.")
    return tensor


def unit_normals(name: str, normals: Tensor) -> Tensor:
    """Normals (..., 3) of length 1; those that have it keep every digit. Raises UnitError for zero vectors."""
    length: Tensor = torch.linalg.vector_norm(normals, dim=-1, keepdim=True)
    if not bool((length > 0).all()):
        raise UnitError(f"Scan: expected {name} with a direction, got a zero vector.")
    off = (length - 1).abs() > 1e-12
    return torch.where(off, normals / length, normals)


def check_shapes(scan: Scan) -> None:
    """Raise ShapeError or SceneError where points, normals and origins do not have the shapes of the scan's kind."""
    for name in ("sensor_origin", "laser_origin"):
        if getattr(scan, name).shape != (3,):
            raise ShapeError(f"Scan: expected {name} (3,), got {tuple(getattr(scan, name).shape)}.")
    sensor, laser = scan.sensor_points, scan.laser_points
    if sensor.ndim not in (2, 3):
        raise ShapeError(f"Scan: expected sensor_points (Sy, Sx, 3) or (N, 3), got {tuple(sensor.shape)}.")
    each = scan.kind in ("confocal", "pairs")
    allowed = {"single": (1,), "exhaustive": (2, 3)}.get(scan.kind, (sensor.ndim,))
    words = {
        "single": "(3,), the one spot",
        "confocal": f"{tuple(sensor.shape)}, the sensor points",
        "exhaustive": "(Ly, Lx, 3) or (M, 3)",
        "pairs": f"{tuple(sensor.shape)}, one for each sensor point",
    }[scan.kind]
    if laser.ndim not in allowed or (each and laser.shape != sensor.shape):
        raise ShapeError(f"Scan: expected laser_points {words} for kind={scan.kind!r}, got {tuple(laser.shape)}.")
    if scan.kind == "confocal" and not bool(torch.equal(laser, sensor)):
        raise SceneError("Scan: expected the laser points of a confocal scan to be its sensor points, got others.")
    for name in ("sensor", "laser"):
        points, normals = getattr(scan, f"{name}_points"), getattr(scan, f"{name}_normals")
        if normals is not None and normals.shape != points.shape:
            raise ShapeError(
                f"Scan: expected {name}_normals {tuple(points.shape)} as the points, got {tuple(normals.shape)}."
            )


def check_sides(scan: Scan) -> None:
    """Origins must be able to see the points: in front of the wall at each of them."""
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
                f"{heights.numel()} points do not see: it is {_behind(float(heights.min()))}. Move "
                "it to the side that the normals point to, or turn the wall (flip_normals, or the order of corners)."
            )


def _behind(height: float) -> str:
    return f"behind them by up to {-height:.4g} m" if height < 0 else "in the wall itself"
