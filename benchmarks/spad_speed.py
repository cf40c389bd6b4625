"""Seconds of a sampled SPAD image with every effect, and of the free-running solve, beside one torch.poisson.

The first case is 64 x 64 pixels, 1024 bins, 1e5 laser cycles: dark and hot pixels, unequal converter codes, a gate,
first-photon pile-up, afterpulses and crosstalk, sampled. `torch.poisson` draws independent counts of the same means.
The two take turns; medians and quartiles are printed. The second case is the stationary state of a free-running
detector, 32 x 32 pixels, 512 bins, for several fluxes, forward and backward. The third one is a detector in step with
the laser that fires several times in a cycle: mean, mean and gradient, draws, and what training holds in memory.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from torchtransient import sensing


def pulse_image(bins: int, size: int, flux: float) -> Tensor:
    """Detections per cycle and bin, (1, T, H, W): a pulse whose place varies over the image, and ambient light."""
    t = torch.arange(bins, dtype=torch.float32).view(-1, 1, 1)
    place = bins * (0.3 + 0.4 * torch.linspace(0, 1, size).view(1, -1, 1)) + torch.linspace(0, 20, size).view(1, 1, -1)
    shape = 0.5 / bins + 0.5 * torch.exp(-0.5 * ((t - place) / 6) ** 2) / 15
    return (flux * shape).unsqueeze(0)


def effects(bins: int, size: int, cycles: int) -> tuple[Tensor, list[sensing.Sensor]]:
    """Dark counts per cycle and bin, and the modules from rates to counts."""
    width_s = 50e-12
    g = torch.Generator().manual_seed(0)
    dark = sensing.hot_pixel_rates(size, size, median_hz=1e3, generator=g).float() * width_s
    chain: list[sensing.Sensor] = [
        sensing.TDC(sensing.random_code_widths(bins, 0.05, g), dither=True, acts_on="rates"),
        sensing.SynchronousSPAD(cycles, gate=torch.linspace(0, 1, bins).mul(20).clamp(max=1), grad="straight_through"),
        sensing.Afterpulsing(0.01, 30e-9, 75e-9, bin_width_s=width_s, period_s=100e-9, grad="straight_through"),
        sensing.Crosstalk(0.005, grad="straight_through"),
    ]
    return dark, chain


def seconds(call: Callable[[], object]) -> float:
    """Wall time of one call."""
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def cpu_seconds(call: Callable[[], object]) -> float:
    """CPU time of one call."""
    begin = time.process_time()
    call()
    return time.process_time() - begin


def spread(values: list[float]) -> dict[str, float]:
    """Median and quartiles."""
    low, middle, high = statistics.quantiles(values, n=4) if len(values) > 1 else [values[0]] * 3
    return {"median_s": middle, "q1_s": low, "q3_s": high}


def synchronous(bins: int, size: int, cycles: int, repeats: int) -> dict[str, object]:
    """Chain and torch.poisson in turns."""
    rate = pulse_image(bins, size, 0.3)
    dark, chain = effects(bins, size, cycles)
    converter, _, afterpulses, crosstalk = chain
    g = torch.Generator().manual_seed(1)

    def run() -> Tensor:
        x = rate + dark
        for module in chain:
            x = module(x, generator=g)
        return x

    with torch.no_grad():
        mean = sensing.SynchronousSPAD(cycles).expected(rate)
        pile_up = sensing.SynchronousSPAD(cycles, grad="straight_through")
        counts = pile_up(rate, generator=g)
        cases = {
            "all effects, sampled": run,
            "pile-up alone, sampled": lambda: pile_up(rate, generator=g),
            "pile-up alone, expected": lambda: pile_up.expected(rate),
            "converter": lambda: converter(rate),
            "afterpulses, sampled": lambda: afterpulses(counts, generator=g),
            "crosstalk, sampled": lambda: crosstalk(counts, generator=g),
            "torch.poisson": lambda: torch.poisson(mean, generator=g),
        }
        times: dict[str, list[float]] = {name: [] for name in cases}
        for turn in range(repeats + 1):
            for name, call in cases.items():
                value = seconds(call)
                if turn:  # the first turn warms up
                    times[name].append(value)
    anchor = times["torch.poisson"]
    report: dict[str, object] = {}
    for name, values in times.items():
        ratio = statistics.median(a / b for a, b in zip(values, anchor, strict=True))
        report[name] = {**spread(values), "over_poisson": ratio}
        row = spread(values)
        print(
            f"{name:28s} {row['median_s']:7.3f} s [{row['q1_s']:.3f}, {row['q3_s']:.3f}]   {ratio:5.2f} x torch.poisson"
        )
    return report


def free_running(bins: int, size: int, repeats: int) -> dict[str, object]:
    """Forward and backward of the stationary state."""
    report: dict[str, object] = {}
    for flux in (0.3, 3.0, 30.0, 300.0, 1000.0, 3000.0):
        rate = pulse_image(bins, size, flux).requires_grad_()
        forward, backward = [], []
        for turn in range(repeats + 1):
            begin = time.perf_counter()
            detected = sensing.nonparalyzable_histogram(rate, 1.4 * bins)
            middle = time.perf_counter()
            detected.square().sum().backward()
            if turn:
                forward.append(middle - begin)
                backward.append(time.perf_counter() - middle)
        report[f"{flux:g} photons per period"] = {"forward": spread(forward), "backward": spread(backward)}
        print(
            f"free-running, {flux:4g} photons per period: {spread(forward)['median_s']:.2f} s forward, "
            f"{spread(backward)['median_s']:.2f} s backward"
        )
    return report


def several_hits(bins: int, size: int, repeats: int) -> dict[str, object]:
    """CPU seconds of this process, and MiB that the graph holds beside light and result."""
    report: dict[str, object] = {}
    width_s = 50e-12
    for dead_bins in (400.3, 20.5, 1.3):
        for flux in (0.3, 3.0):
            light = pulse_image(bins, size, flux)
            sensor = sensing.SynchronousSPAD(1000, dead_time_s=dead_bins * width_s, bin_width_s=width_s)
            g = torch.Generator().manual_seed(1)
            leaf = light.clone().requires_grad_()
            held: dict[int, int] = {}

            def hold(t: Tensor, held: dict[int, int] = held) -> Tensor:
                held[t.untyped_storage().data_ptr()] = t.untyped_storage().nbytes()
                return t

            cases: dict[str, Callable[[], object]] = {
                "mean": lambda x=light, s=sensor: s.expected(x),  # type: ignore[misc]
                "mean and gradient": lambda x=leaf, s=sensor: s.expected(x).square().sum().backward(),  # type: ignore[misc]
                "draws": lambda x=light, s=sensor, g=g: s.sample(x, g),  # type: ignore[misc]
            }
            times = {name: [cpu_seconds(call) for _ in range(repeats + 1)][1:] for name, call in cases.items()}
            with torch.autograd.graph.saved_tensors_hooks(hold, lambda t: t):
                sensor.expected(leaf)
            held.pop(leaf.untyped_storage().data_ptr(), None)
            mib = sum(held.values()) / 2**20
            name = f"dead for {dead_bins:g} bins, {flux:g} photons per cycle"
            report[name] = {**{k: spread(v) for k, v in times.items()}, "held_mib": mib}
            row = ", ".join(f"{spread(v)['median_s']:.4f} s {k}" for k, v in times.items())
            print(f"{name}: {row}, {mib:.0f} MiB held")
    return report


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--quick", action="store_true", help="tiny sizes: checks that the script runs, measures nothing"
    )
    parser.add_argument("--repeats", type=int, default=5, help="timed runs of every case")
    parser.add_argument("--threads", type=int, default=2, help="torch threads")
    parser.add_argument("--json", type=Path, default=None, help="write the report to this file")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    size, bins = (8, 64) if options.quick else (64, 1024)
    repeats = 1 if options.quick else options.repeats
    print(f"{size} x {size} x {bins}, 1e5 cycles, {options.threads} threads, load {os.getloadavg()[0]:.1f}")
    report = {"synchronous": synchronous(bins, size, 100_000, repeats)}
    size, bins = (4, 64) if options.quick else (32, 512)
    print(f"{size} x {size} x {bins}")
    report["free_running"] = free_running(bins, size, repeats)
    size, bins = (4, 64) if options.quick else (64, 1024)
    print(f"{size} x {size} x {bins}, several hits")
    report["several_hits"] = several_hits(bins, size, repeats)
    report["peak_memory_gib"] = {"whole run": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20}
    report["load"] = {"one minute": os.getloadavg()[0]}
    if options.json:
        options.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
