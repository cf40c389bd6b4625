"""f-k migration and light-cone transforms beside y-tal's f-k migration and the transforms that they consist of.

Confocal captures of two points before a wall of one metre, 512 bins of 9.6 mm, 64 x 64 points: CPU seconds of one
thread, ratios over y-tal's `fk` and over one padded `rfftn` and `ifftn`. How far one point comes out from where it is,
at 18 to 86 % of the record, by every method. Peak memory of f-k with 4 taps, forward and backward, two captures at
once, beyond tables, captures and their gradient.

y-tal 0.20 runs in the environment of `--peer-python`, or of the variable TORCHTRANSIENT_TAL_PYTHON; without it our own
rows are timed alone. Seconds are CPU seconds of processes with one thread: other load does not count.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from _runner import arguments, environment, interleave, ratio, report, summary
from _tal import Tal
from torch import Tensor

import torchtransient as tt
from torchtransient.reconstruction import FK, LCT, DirectionalLCT

BINS, WIDTH = 512, 0.0096
OVER_PEER = {"fk": 1 / 40, "fk, 2 taps": 1 / 40, "fk and backward": 1 / 15, "lct": 1 / 50, "directional lct": None}
DEPTHS = {"18 %": 0.45, "39 %": 0.95, "63 %": 1.55, "86 %": 2.1}


def points(places: list[tuple[float, float, float]], scan: tt.nlos.Scan, axis: tt.TimeAxis) -> Tensor:
    """(T, Y, X) float64: isotropic points whose light falls with r^-4, Gaussian pulses of two bins."""
    light = torch.zeros(axis.num_bins, *scan.shape, dtype=torch.float64)
    for place in places:
        r = (scan.sensor_points - torch.tensor(place, dtype=torch.float64)).norm(dim=-1)
        steps = (axis.edges_opl[:, None, None] - 2 * r) / (2 * axis.bin_width_opl)
        light += r**-4 * torch.special.ndtr(steps).diff(dim=0)
    return light


def setting(size: int, bins: int) -> tuple[tt.nlos.Scan, tt.TimeAxis]:
    width = WIDTH * BINS / bins
    return tt.nlos.Scan.grid(tt.nlos.Wall.plane(1.0, 1.0), size, kind="confocal"), tt.TimeAxis(0.0, width, bins)


def clock(function: Callable[[], object]) -> float:
    start = time.process_time()
    function()
    return time.process_time() - start


def speed(size: int, bins: int, repeats: int, peer: Tal | None) -> dict[str, Any]:
    """Seconds of every method in turns."""
    scan, axis = setting(size, bins)
    light = points([(0.1, -0.15, 1.0), (-0.2, 0.1, 0.8)], scan, axis)
    data = light.float()
    padded = torch.zeros(2 * bins, 2 * size, 2 * size)
    padded[:bins, :size, :size] = data
    spectrum = padded.to(torch.complex64)
    fk, linear, trained = (FK(scan, time_axis=axis, **options) for options in ({}, {"taps": 2}, {"floor": 1e-3}))
    lct, directional = LCT(scan, time_axis=axis), DirectionalLCT(scan, time_axis=axis)

    def backward() -> None:
        x = data.clone().requires_grad_()
        trained.reconstruct(x).sum().backward()

    cases: dict[str, Callable[[int], float]] = {
        "padded rfftn and ifftn": lambda _: clock(lambda: (torch.fft.rfftn(padded), torch.fft.ifftn(spectrum))),
        "fk": lambda _: clock(lambda: fk.reconstruct(data)),
        "fk, 2 taps": lambda _: clock(lambda: linear.reconstruct(data)),
        "fk and backward": lambda _: clock(backward),
        "lct": lambda _: clock(lambda: lct.reconstruct(data)),
        "directional lct": lambda _: clock(lambda: directional.reconstruct(data)),
    }
    if peer is not None:
        peer.load(tt.nlos.Capture(light[None], axis, scan))
        cases["y-tal: fk"] = lambda _: peer.migrate()[1]
    seconds = interleave(cases, repeats, warm_up=1)
    ratios = [ratio(seconds, "fk", "padded rfftn and ifftn", 1.2)]
    if peer is not None:
        ratios += [ratio(seconds, name, "y-tal: fk", bar) for name, bar in OVER_PEER.items()]
    return {"cases": {name: summary(runs) for name, runs in seconds.items()}, "ratios": ratios}


def peak_off(volume: Tensor, place: tuple[float, float, float], step: tuple[float, float, float], z0: float) -> float:
    """Millimetres between the highest voxel, between samples by a parabola of logarithms, and where the point is."""
    index = [int(i) for i in torch.unravel_index(volume.argmax(), volume.shape)]
    off = 0.0
    for dim, (k, h, true) in enumerate(zip(index, step, reversed(place), strict=True)):
        # At the border there is nothing to interpolate with.
        near = [min(max(k + i, 0), volume.shape[dim] - 1) for i in (-1, 0, 1)]
        around = [float(volume[(*index[:dim], n, *index[dim + 1 :])].clamp_min(1e-30).log()) for n in near]
        bend = around[0] - 2 * around[1] + around[2]
        at = k + 0.5 * (around[0] - around[2]) / bend if bend else float(k)
        first = z0 if dim == 0 else -(volume.shape[dim] - 1) / 2 * h
        off = max(off, abs(first + at * h - true))
    return 1e3 * off


def positions(size: int, bins: int, peer: Tal | None) -> dict[str, Any]:
    """Millimetres of the worst coordinate, by method and depth."""
    scan, axis = setting(size, bins)
    pitch, dz = 1 / size, axis.bin_width_opl / 2
    operators = {
        "fk": FK(scan, time_axis=axis),
        "fk, 2 taps": FK(scan, time_axis=axis, taps=2),
        "lct": LCT(scan, time_axis=axis),
        "lct, twice the bins of v": LCT(scan, time_axis=axis, v_bins=2 * bins),
    }
    found: dict[str, Any] = {}
    for share, z in DEPTHS.items():
        place = ((size // 2 + 3.5) * pitch - 0.5, -((size // 2 + 3.5) * pitch - 0.5), z)
        light = points([place], scan, axis)
        row = {
            name: peak_off(operator.reconstruct(light).double(), place, (dz, pitch, pitch), dz / 2)
            for name, operator in operators.items()
        }
        if peer is not None:
            peer.load(tt.nlos.Capture(light[None], axis, scan))
            row["y-tal: fk"] = peak_off(peer.migrate()[0].double(), place, (dz, pitch, pitch), 0.0)
        found[f"{share} of the record"] = row
    return found


# ------------------------------------------------------------------------------------------------------------ memory


def memory_case(size: int, bins: int) -> dict[str, float]:
    """Peak of two captures through f-k and back, in MB beyond the tables, the captures and their gradient.

    What the process held before is no part of it: large blocks are mapped one by one and go back when they are freed,
    since a heap keeps what was freed, now for the operator and now beside it; pages of the captures and of their
    gradient have been written to, and a small operator has loaded the code.
    """
    libc = ctypes.CDLL(None)
    libc.mallopt(-3, 1 << 16)  # M_MMAP_THRESHOLD of glibc; it stays what it is set to
    scan, axis = setting(8, 64)
    small = FK(scan, time_axis=axis, floor=0.25)
    small.reconstruct(torch.rand(2, 64, 8, 8, requires_grad=True)).sum().backward()
    scan, axis = setting(size, bins)
    operator = FK(scan, time_axis=axis, floor=0.25)
    light = torch.rand(2, bins, size, size, requires_grad=True)
    light.grad = torch.ones_like(light)  # zeros have no pages yet
    tables = sum(buffer.numel() * buffer.element_size() for buffer in operator.buffers()) / 2**20
    gc.collect()
    libc.malloc_trim(0)
    before = resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # Linux: the peak begins anew
    operator.reconstruct(light).sum().backward()
    return {"tables": tables, "captures": light.numel() * 4 / 2**20, "beyond": resident("VmHWM") - before}


def resident(name: str) -> float:
    """Memory of this process, MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name)) / 2**10


def main() -> None:
    parser = arguments(__doc__)
    parser.set_defaults(peer_python=os.environ.get("TORCHTRANSIENT_TAL_PYTHON"))
    parser.add_argument("--memory-case", nargs=2, type=int, metavar=("SIZE", "BINS"), help="the memory row, as JSON")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.memory_case:
        print(json.dumps(memory_case(*options.memory_case)))
        return
    size, bins = (8, 64) if options.quick else (64, BINS)
    peer = Tal(options.peer_python) if options.peer_python else None
    results = speed(size, bins, options.repeats or (1 if options.quick else 5), peer)
    results["millimetres off"] = positions(16 if options.quick else 32, bins, peer)
    command = [sys.executable, __file__, "--memory-case", str(size), str(bins)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    results["memory, MB"] = {**json.loads(done.stdout.splitlines()[-1]), "bar": 200}
    if peer is not None:
        results["peer"] = peer.greeting
        peer.close()
    results["environment"] = environment()
    report("nlos_operators", {"size": size, "bins": bins, "quick": options.quick}, results, options.json)


if __name__ == "__main__":
    main()
