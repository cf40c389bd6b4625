"""Backprojection and phasor fields beside y-tal's: CPU seconds of one thread, and how alike the volumes are.

Three points before a wall of one metre, 512 bins of 9.6 mm, 16 planes. Ratios are over y-tal's backprojection (`bp`)
at 32 x 32 points and its filtered backprojection (`fbp`) at 64 x 64. A `T` of points, facing the wall and tilted,
seen by one laser and by 4 x 4 lasers and 16 x 16 sensor points: correlation of the front view with the truth. Peak
memory beyond operands: a volume of 64^3 by 64 x 64 points, and 16 x 16 lasers by 16 x 16 points.

y-tal 0.20 runs in the environment of `--peer-python`, or of the variable TORCHTRANSIENT_TAL_PYTHON; without it our own
rows are timed alone. Seconds are CPU seconds of processes with one thread: other load does not count.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _runner import arguments, environment, ratio, report, summary
from _tal import Tal

import torchtransient as tt
from tools.point_captures import point_capture
from torchtransient.reconstruction import (
    Backprojection,
    FilteredBackprojection,
    PhasorField,
    PhasorFilter,
    TransientCamera,
    VoxelGrid,
)

BINS, WIDTH = 512, 0.0096
PLANES = [0.8 + 0.025 * k for k in range(16)]
POINTS = [(0.1, -0.15, 1.0), (-0.2, 0.1, 0.85), (0.3, 0.3, 1.1)]
BARS = {(64, "phasor planes"): 1 / 50, (64, "fbp"): 1 / 10, (32, "bp"): 1 / 10}


def correlation(a: torch.Tensor, b: torch.Tensor) -> float:
    """Of two pictures as they are: sum of products over the root of the sums of squares."""
    a, b = (x.abs().double().reshape(1, -1) for x in (a, b))
    return float(tt.metrics.picture_correlation(a, b, centered=False))


def clock(function: Callable[[], Any]) -> tuple[Any, float]:
    start = time.process_time()
    result = function()
    return result, time.process_time() - start


def axis() -> tt.TimeAxis:
    return tt.TimeAxis(0.0, WIDTH, BINS)


def scan_of(size: int, kind: str, **settings: Any) -> tt.nlos.Scan:
    return tt.nlos.Scan.grid(tt.nlos.Wall.plane(1.0, 1.0), size, kind=kind, **settings)


def speed(size: int, kind: str, peer: Tal | None, repeats: int, planes: list[float]) -> dict[str, Any]:
    """Seconds of every method and correlations with the peer's volume."""
    capture = point_capture(scan_of(size, kind), POINTS, time_axis=axis())
    grid = VoxelGrid.before(capture.scan, planes)
    wavelength = 6 / size
    sigma = wavelength / 2**0.5
    pulse = PhasorFilter(wavelength, 6 * sigma / wavelength)
    of = {"time_axis": axis()}
    operators = {
        "bp": Backprojection(capture.scan, grid, **of),
        "fbp": FilteredBackprojection(capture.scan, grid, filter=pulse, **of),
        "phasor planes": PhasorField(capture.scan, grid, pulse=pulse, **of),
    }
    light = capture.transient[0].float()
    seconds: dict[str, list[float]] = {}
    volumes: dict[str, torch.Tensor] = {}
    if peer is not None:
        peer.load(capture)
        for method, options in (("bp", {}), ("fbp", {"wl_mean": wavelength, "wl_sigma": sigma})):
            volumes[f"y-tal: {method}"], taken = peer.solve(method, planes, **options)
            seconds[f"y-tal: {method}"] = [taken] * repeats
    for name, operator in operators.items():
        operator.adjoint(light)
        seconds[f"ours: {name}"] = []
        for _ in range(repeats):
            volumes[f"ours: {name}"], taken = clock(lambda operator=operator: operator.adjoint(light))
            seconds[f"ours: {name}"].append(taken)
    where = f"{size} x {size} {kind}, "
    named = {where + name: runs for name, runs in seconds.items()}
    result: dict[str, Any] = {"cases": {name: summary(runs) for name, runs in named.items()}, "ratios": [], "alike": {}}
    if peer is not None:
        for name in operators:
            ours, theirs = f"ours: {name}", f"y-tal: {'bp' if name == 'bp' else 'fbp'}"
            bar = BARS[size, name] if kind == "confocal" and (size, name) in BARS else None
            result["ratios"].append(ratio(named, where + ours, where + theirs, bar))
            result["alike"][f"{where}{ours} and {theirs}"] = correlation(volumes[ours], volumes[theirs])
    return result


def cameras(peer: Tal, planes: list[float]) -> dict[str, float]:
    """A transient camera at four moments, beside the peer's video at those bins."""
    capture = point_capture(scan_of(16, "single"), POINTS[:2], time_axis=tt.TimeAxis(0.0, 4 * WIDTH, BINS // 4))
    moments, wavelength = [20, 24, 28, 32], 0.3
    camera = TransientCamera([4 * WIDTH * k for k in moments])
    grid = VoxelGrid.before(capture.scan, planes)
    operator = PhasorField(capture.scan, grid, time_axis=capture.axis, pulse=PhasorFilter(wavelength), camera=camera)
    peer.load(capture)
    options = {"wl_mean": wavelength, "wl_sigma": PhasorFilter(wavelength).sigma}
    video, _ = peer.solve("fbp", planes, camera="TRANSIENT", **options)
    ours = operator.adjoint(capture.transient[0].float())
    return {"ours: transient camera and y-tal: fbp": correlation(ours, video[moments])}


# ------------------------------------------------------------------------------------------------------ not confocal

OFF = torch.tensor([0.05, -0.05, 0.0], dtype=torch.float64)


def letter(tilt: float) -> torch.Tensor:
    """A T of points 1 cm apart, 0.8 m before the wall, off its middle; `tilt`: metres of depth per metre of x."""
    bar = [(x, 0.25, 0.8 + tilt * x) for x in np.arange(-0.25, 0.26, 0.01)]
    stem = [(0.0, y, 0.8) for y in np.arange(-0.25, 0.25, 0.01)]
    return torch.tensor(bar + stem, dtype=torch.float64) + OFF


def truth(points: torch.Tensor, grid: VoxelGrid) -> torch.Tensor:
    """The letter as seen from the wall, its points 25 mm wide."""
    across = grid.points[0, :, :, None, :2] - points[:, :2]
    return torch.exp(-across.square().sum(-1) / (2 * 0.025**2)).sum(-1)


def not_confocal(quick: bool) -> dict[str, float]:
    """Correlation of front views with the truth, by capture and method."""
    bins = tt.TimeAxis(0.0, WIDTH, 384)
    single = scan_of(32, "single")
    exhaustive = scan_of(16, "exhaustive", laser_grid=4)
    grid = VoxelGrid.before(single, [0.6 + 0.0125 * k for k in range(33)][:: 8 if quick else 1])
    pulse = PhasorFilter(0.09, 4.0)
    found = {}
    for tilt in (0.0, 0.5):
        points = letter(tilt)
        expected = truth(points, grid)
        for name, scan in (("one laser", single), ("4 x 4 lasers", exhaustive)):
            capture = point_capture(scan, points, time_axis=bins)
            light = capture.transient[0].float()
            methods = {"fbp": FilteredBackprojection(scan, grid, time_axis=bins, filter=pulse)}
            if scan is single:
                methods["phasor planes"] = PhasorField(scan, grid, time_axis=bins, pulse=pulse)
            for method, operator in methods.items():
                front = operator.reconstruct(light).amax(0)
                found[f"{name}, tilt {tilt}, {method}"] = correlation(front, expected)
    return found


# ------------------------------------------------------------------------------------------------------------ memory

MEMORY = {
    "64 x 64 points, 64^3 voxels": (64, "confocal", 64),
    "16^2 lasers by 16^2 points, 16^3 voxels": (16, "exhaustive", 16),
}


def memory_case(name: str) -> dict[str, float]:
    """Peak memory of an adjoint and its backward pass, which is a forward map, beyond transient and gradient, in MB."""
    size, kind, depth = MEMORY[name]
    scan = scan_of(size, kind)
    grid = VoxelGrid.before(scan, np.linspace(0.6, 1.4, depth))
    pulse = PhasorFilter(6 / size, 4.0)
    of = {"time_axis": axis()}
    operators = {
        "bp": Backprojection(scan, grid, **of),
        "fbp": FilteredBackprojection(scan, grid, filter=pulse, **of),
        "phasor planes": PhasorField(scan, grid, pulse=pulse, **of),
    }
    light = torch.rand(BINS, *scan.shape, requires_grad=True)
    found = {"transient": light.numel() * 4 / 2**20, "volume": math.prod(grid.shape) * 4 / 2**20}
    for label, operator in operators.items():
        # The gradient is an operand too.
        light.grad = torch.zeros_like(light)
        before = resident("VmRSS")
        Path("/proc/self/clear_refs").write_text("5")  # Linux: the peak begins anew
        operator.adjoint(light).abs().square().sum().backward()
        found[label] = resident("VmHWM") - before
    return found


def resident(name: str) -> float:
    """Memory of this process, MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name)) / 2**10


def memory() -> dict[str, Any]:
    """Each case in a process of its own."""
    found = {}
    for name in MEMORY:
        done = subprocess.run(
            [sys.executable, __file__, "--memory-case", name], capture_output=True, text=True, check=True
        )
        found[name] = json.loads(done.stdout.splitlines()[-1])
    return found


def main() -> None:
    parser = arguments(__doc__)
    parser.set_defaults(peer_python=os.environ.get("TORCHTRANSIENT_TAL_PYTHON"))
    parser.add_argument("--memory-case", choices=list(MEMORY), help="one case of the memory rows, as JSON")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.memory_case:
        print(json.dumps(memory_case(options.memory_case)))
        return
    sizes = (8,) if options.quick else (32, 64)
    planes = PLANES[::8] if options.quick else PLANES
    repeats = options.repeats or (1 if options.quick else 3)
    results: dict[str, Any] = {"cases": {}, "ratios": [], "alike": {}}
    for size in sizes:
        peer = Tal(options.peer_python, 64 if size == 64 else 1) if options.peer_python else None
        for kind in ("confocal", "single") if size < 64 else ("confocal",):
            found = speed(size, kind, peer, repeats, planes)
            results["cases"] |= found["cases"]
            results["ratios"] += found["ratios"]
            results["alike"] |= found["alike"]
        if peer is not None and size == sizes[0]:
            results["alike"] |= cameras(peer, planes)
        if peer is not None:
            results["peer"] = peer.greeting
            peer.close()
    results["front view against the truth"] = not_confocal(options.quick)
    if not options.quick:
        results["memory beyond operands, MB"] = memory()
    results["environment"] = environment()
    report("nlos_fields", {"bins": BINS, "planes": len(planes), "quick": options.quick}, results, options.json)


if __name__ == "__main__":
    main()
