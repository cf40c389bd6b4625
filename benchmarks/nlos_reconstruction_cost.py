"""What accuracy costs in time for hidden volumes: CPU seconds of one thread beside errors against the truth, by method.

A confocal scan of 64 x 64 points, a wall of one metre, 256 bins of 1 cm. The letter E, 0.6 m high and 0.6 m before the
wall, is simulated: Pearson's correlation of the front view (brightest voxel of each column, nothing below zero) with
the share of each column that the letter fills, of all light and of 50 photons a point; error of the brightest voxel's
depth, the median over columns that the letter fills, by `depth_map`. Five isotropic points off the grid, exactly: error
of the brightest voxel within 5 cm of each, between voxels by parabolas, the root of the mean square.

Planes between 0.3 and 0.9 m are looked at: those of the transforms, 5 mm apart, which compute all 256; of the others
every second of these, which they compute alone. Seconds are CPU seconds of a process with one thread, for one capture;
tables, which an operator makes once for a scan, are listed beside. Options are those of `tt.nlos.reconstruct` unless
named.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from _runner import arguments, environment, summary

import torchtransient as tt
from tools.point_captures import point_capture
from torchtransient.nlos import VoxelGrid
from torchtransient.nlos.methods import default_wavelength

RESULTS = Path(__file__).parent / "results" / "nlos_reconstruction_cost.json"
DEPTHS, DISTANCE, PHOTONS = (0.3, 0.9), 0.6, 50
POINTS = [(0.11, -0.16, 0.713), (-0.22, 0.13, 0.497), (0.27, 0.29, 0.606), (-0.31, -0.27, 0.551), (0.03, 0.08, 0.787)]
NEAR = 0.05
HEADER = [
    "| method | seconds | tables, s | correlation | of 50 photons a point | depth, mm | points, mm |",
    "|---|---|---|---|---|---|---|",
]
Make = Callable[[], Any]


def methods(capture: tt.nlos.Capture, planes: VoxelGrid) -> dict[str, Make]:
    """What makes each operator, by the name that it has in the table."""
    scan, axis = capture.scan, capture.axis
    pulse, of = tt.nlos.PhasorFilter(default_wavelength(capture), 4.0), {"time_axis": axis}
    return {
        "fk, 2 taps": lambda: tt.nlos.FK(scan, taps=2, **of),
        "fk": lambda: tt.nlos.FK(scan, **of),
        "lct": lambda: tt.nlos.LCT(scan, **of),
        "lct, twice the v bins": lambda: tt.nlos.LCT(scan, v_bins=2 * axis.num_bins, **of),
        "lct, snr 100": lambda: tt.nlos.LCT(scan, snr=100.0, **of),
        "directional-lct": lambda: tt.nlos.DirectionalLCT(scan, **of),
        "phasor": lambda: tt.nlos.PhasorField(scan, planes, pulse=pulse, **of),
        "fbp": lambda: tt.nlos.FilteredBackprojection(scan, planes, filter=pulse, **of),
        "bp": lambda: tt.nlos.Backprojection(scan, planes, **of),
    }


def clock(function: Callable[[], Any]) -> tuple[Any, float]:
    start = time.process_time()
    result = function()
    return result, time.process_time() - start


def looked_at(depths: torch.Tensor) -> torch.Tensor:
    return (depths >= DEPTHS[0]) & (depths <= DEPTHS[1])


def brightness(operator: Any, light: torch.Tensor) -> torch.Tensor:
    """(Z, Y, X) of a transient (T, Y, X), on the planes that are looked at."""
    volume = operator.reconstruct(light)
    volume = volume.norm(dim=-4) if volume.ndim == 4 else volume
    return volume[looked_at(operator.grid.depths)].double()


def filled(triangles: torch.Tensor, grid: VoxelGrid, samples: int = 8) -> torch.Tensor:
    """(Y, X): the share of each column of voxels that triangles (N, 3, 3) parallel to its planes fill."""
    offsets = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples - 0.5
    dy, dx = grid.pitch
    across = grid.points[0, :, :, None, None, :2] + torch.stack(
        [(offsets * dx).expand(samples, samples), (offsets * dy)[:, None].expand(samples, samples)], -1
    )
    inside = torch.zeros(across.shape[:-1], dtype=torch.bool)
    for corners in triangles[..., :2]:
        sides = []
        for k in range(3):
            (ax, ay), (bx, by) = corners[k], corners[(k + 1) % 3]
            sides.append((bx - ax) * (across[..., 1] - ay) - (by - ay) * (across[..., 0] - ax))
        turned = torch.stack(sides)
        inside |= (turned >= 0).all(0) | (turned <= 0).all(0)
    return inside.double().mean((-2, -1))


def correlation(volume: torch.Tensor, truth: torch.Tensor) -> float:
    return float(tt.metrics.picture_correlation(tt.metrics.front_view(volume), truth))


def depth_error(volume: torch.Tensor, grid: VoxelGrid, truth: torch.Tensor) -> float:
    """Metres."""
    depth = tt.nlos.depth_map(volume, grid).depth
    return float(tt.metrics.depth_median_error(depth, torch.full_like(depth, DISTANCE), mask=truth == 1))


def position_error(volume: torch.Tensor, grid: VoxelGrid) -> float:
    """Metres: the root of the mean square over the points."""
    return float(tt.metrics.localization_rmse(volume, POINTS, radius_m=NEAR, grid=grid))


def main() -> None:
    parser = arguments(__doc__, peer=False)
    parser.set_defaults(variant="llvm_ad_mono")
    options = parser.parse_args()
    torch.set_num_threads(1)
    quick = options.quick
    size, bins, width, spp = (16, 64, 0.04, 64) if quick else (64, 256, 0.01, 4096)
    repeats = options.repeats or (1 if quick else 3)
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(1.0, 1.0, albedo=0.7), size, kind="confocal")
    axis = tt.TimeAxis(0.0, width, bins)
    hidden = tt.scenes.nlos_letter("E", size=0.6, depth=DISTANCE)
    capture = tt.nlos.simulate(hidden, scan, time_axis=axis, spp=spp, variant=options.variant, progress=False)
    letter = capture.transient[0]
    mean = letter * (PHOTONS * size**2 / letter.sum())
    counts = torch.poisson(mean, generator=torch.Generator().manual_seed(0))
    points = point_capture(scan, POINTS, time_axis=axis).transient[0].float()

    depths = axis.centers_opl / 2
    planes = VoxelGrid.before(scan, depths[looked_at(depths)][::2])
    mesh = hidden["letter"]
    truth = filled(torch.as_tensor(mesh["vertices"], dtype=torch.float64)[torch.as_tensor(mesh["faces"])], planes)
    makers = methods(capture, planes)
    operators, rows = {}, {}
    for name, make in makers.items():
        make()
        operator, tables = clock(make)
        operators[name], grid = operator, operator.grid
        seen, volume = grid.at_depths(grid.depths[looked_at(grid.depths)]), brightness(operator, letter)
        rows[name] = {
            "tables_seconds": tables,
            "correlation": correlation(volume, truth),
            "correlation_of_counts": correlation(brightness(operator, counts), truth),
            "depth_error": depth_error(volume, seen, truth),
            "position_error": position_error(brightness(operator, points), seen),
        }
    seconds: dict[str, list[float]] = {name: [] for name in operators}
    for _ in range(repeats):
        for name, operator in operators.items():
            seconds[name].append(clock(lambda operator=operator: operator.reconstruct(letter))[1])
    lines = [*HEADER]
    for name, row in rows.items():
        row["seconds"] = summary(seconds[name])
        lines.append(
            f"| {name} | {row['seconds']['median']:.2g} | {row['tables_seconds']:.2g} | {row['correlation']:.2f} | "
            f"{row['correlation_of_counts']:.2f} | {1e3 * row['depth_error']:.1f} | {1e3 * row['position_error']:.1f} |"
        )
    print("\n".join(lines))
    path = options.json or (None if quick else RESULTS)
    if path is not None:
        settings = {"points": size, "bins": bins, "spp": spp, "repeats": repeats}
        data = {"settings": settings | {"quick": quick}, "methods": rows, "environment": environment(options.variant)}
        path.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
