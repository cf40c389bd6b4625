"""Fit wall, beam and detector to measured histograms of a time-of-flight chip, and predict the zone that is left out.

A consumer chip of nine zones (ams TMF88xx, 128 bins of 88 ps) looks at a wall 23 cm away. Eight histograms are fitted
through renderer and sensor: distance and tilts of the wall, beam, width of the zones, impulse response, pile-up. Gain,
delay and background are each zone's own, and small. The ninth histogram judges; each zone is left out once.

    python training_examples/fit_measured_histograms.py --measured FOLDER --seeds 0 1 2 --output demo_output

`FOLDER` (or TORCHTRANSIENT_MEASURED_DATA) holds `consumer_lidar/ams_U_iter_0.npy` as published (sidsoma, MIT licence);
without it a simulated chip stands in. No response of five numbers is right to the root of a million counts, so for all
methods n counts have the variance n + (3 % n)^2 + (0.3 % of the highest bin)^2. Prints, of the zone left out, squared
errors over this variance and per cent of the light in wrong bins: as predicted, and with delay, gain and background of
its own, which leaves the shape to be judged.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from nine_zones import BIN_S, CENTRES, FIRST, LAST, SPREAD, ZERO, Chip, deviation, measured, simulated
from scipy.ndimage import shift
from torch import Tensor
from tqdm import tqdm

import torchtransient as tt
from torchtransient.vis.files import figure_type, save_figure

COLUMNS = ("squares", "wrong, %", "peak, ps", "with its own: squares", "wrong, %")
Rows = dict[str, list[list[float]]]  # by method, COLUMNS of every zone that was left out


def fit(counts: Tensor, left: int, seed: int, steps: int, narrow: bool = False) -> list[Callable[[float], Tensor]]:
    """Adam on the zones (9, T) but one. Predictions of that one, as functions of a delay in bins: the model's, and the
    same times what the model leaves over in the other zones, bin by bin."""
    seen, zone = torch.arange(9) != left, torch.eye(9)[left]
    chip = Chip(float(counts[seen].sum(1).mean()), float(counts[seen].amin(1).mean()), narrow)
    rates = {"pose": 0.01, "log_width": 0.02, "beam": 0.1, "levels": 0.03, "own": 0.03, "response": 0.03}
    groups = [{"params": [p for n, p in chip.named_parameters() if n.startswith(k)], "lr": r} for k, r in rates.items()]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.95))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for step in tqdm(range(steps), desc=f"zone {left} left out", unit="step", leave=False):
        error = (chip.counts(chip.light(step + 10_000 * seed), chip.own[1]) - counts) / deviation(counts)
        loss = error[seen].square().sum() + (chip.own / SPREAD).square().sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        light, own = chip.requires_grad_(False).light(10_000 * seed - 1, spp=1024), chip.own[1]
        over = (counts / chip.counts(light, own))[seen].log().mean(0).exp()
    predicted = torch.no_grad()(lambda delay: chip.counts(light, own + delay * zone)[left])
    return [predicted, lambda delay: over * predicted(delay)]


def peak(histogram: Tensor) -> float:
    """Position in bins: the mean over five bins about the highest."""
    near = torch.arange(-2, 3) + int(histogram.argmax())
    return float((histogram[near] * near).sum() / histogram[near].sum())


def shifted(counts: Tensor, left: int, near: Sequence[int]) -> Callable[[float], Tensor]:
    """The mean of histograms, cubic splines, shifted to where a plane through the peaks of all eight has the ninth; a
    parabola through the logarithms of the sums says how bright it is."""
    seen, slant = torch.arange(9) != left, (1 + CENTRES.square().sum(1)).sqrt()
    peaks, ones = torch.tensor([peak(zone) for zone in counts]), torch.ones(9, 1)
    plane, curve = torch.cat([CENTRES, ones], 1), torch.cat([CENTRES, CENTRES.square(), ones], 1)
    inverse = torch.linalg.lstsq(plane[seen], (slant / (peaks + FIRST - ZERO))[seen, None]).solution
    target = float(slant[left] / (plane[left] @ inverse)) - FIRST + ZERO
    total = (curve[left] @ torch.linalg.lstsq(curve[seen], counts[seen].sum(1).log()[:, None]).solution).exp()

    def moved(delay: float) -> Tensor:
        rows = [shift(counts[n].numpy(), target + delay - float(peaks[n]), order=3, mode="nearest") for n in near]
        return total * torch.stack([torch.tensor(r).clamp_min(0) / r.sum() for r in rows]).mean(0)

    return moved


def judge(predict: Callable[[float], Tensor], counts: Tensor) -> tuple[list[float], Tensor]:
    """COLUMNS of a prediction for counts (T,), and the histogram with the best delay, factor and background."""
    weight = 1 / deviation(counts).square()

    def figures(histogram: Tensor) -> list[float]:
        wrong = (histogram / histogram.sum() - counts / counts.sum()).abs().sum() / 2
        return [float((weight * (histogram - counts).square()).mean()), 100 * float(wrong)]

    def fitted(histogram: Tensor) -> Tensor:
        design = torch.stack([histogram, torch.ones_like(histogram)], 1)
        root = weight.sqrt().to(design)[:, None]
        return (design @ torch.linalg.lstsq(root * design, root * counts.to(design)[:, None]).solution)[:, 0]

    delays, place = torch.arange(-1.5, 1.5, 0.02).tolist(), predict(0.0)
    best = min((fitted(predict(delay)) for delay in delays), key=lambda one: figures(one)[0])
    return [*figures(place), 1e12 * BIN_S * abs(peak(place) - peak(counts)), *figures(best)], best


def draw(path: Path, counts: Tensor, zones: list[int], best: dict[str, list[Tensor]], rows: Rows) -> None:
    """Histograms of two zones that were left out, and squared errors of all."""
    figure = figure_type()(figsize=(12, 3.6), layout="constrained")
    *panels, bars = figure.subplots(1, 3)
    lines = {"neighbours, shifted": "tab:orange", "fit, with what is left over": "tab:blue"}
    for panel, place in zip(panels, (0, len(zones) // 2), strict=True):
        for name, colour in lines.items():
            panel.semilogy(range(FIRST, LAST), best[name][place], color=colour, label=name)
        panel.semilogy(range(FIRST, LAST), counts[zones[place]], "k.", markersize=4, label="measured")
        panel.set(xlabel="bin", ylabel="counts", title=f"zone {zones[place]} left out", ylim=(100, None))
        panel.legend(fontsize=8)
    for offset, (name, colour) in zip((-0.2, 0.2), lines.items(), strict=True):
        bars.bar(torch.arange(len(zones)) + offset, [row[3] for row in rows[name]], 0.4, color=colour, label=name)
    bars.set(xlabel="zone left out", title="squared error of the shape, mean of bins", xticks=range(len(zones)))
    bars.set_xticklabels(zones)
    bars.legend(fontsize=8)
    save_figure(figure, path, "fit_measured_histograms")


def main(argv: Sequence[str] | None = None) -> list[Rows]:
    """Command line. Returns the table of each seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="one seed, two zones, few steps")
    folder = os.environ.get("TORCHTRANSIENT_MEASURED_DATA")
    parser.add_argument("--measured", default=folder, help="folder of measured data (%(default)s)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="of the renders (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="of the picture (%(default)s)")
    options = parser.parse_args(argv)
    seeds, steps, zones = (options.seeds[:1], 100, [0, 5]) if options.smoke else (options.seeds, 300, list(range(9)))
    tt.threads(1)
    print("measured counts" if options.measured else "no folder of measured data: a simulated chip stands in")
    counts = measured(options.measured) if options.measured else simulated(0)
    tables = []
    for seed in seeds:
        rows: Rows = {}
        best: dict[str, list[Tensor]] = {}
        began = time.process_time()
        for left in zones:
            near = [n for n in range(9) if abs(n // 3 - left // 3) + abs(n % 3 - left % 3) == 1]
            methods: dict[str, Callable[[float], Tensor]] = {"neighbours, shifted": shifted(counts, left, near)}
            methods["all eight, shifted"] = shifted(counts, left, [n for n in range(9) if n != left])
            methods["fit, zones as directions"] = fit(counts, left, seed, steps, narrow=True)[0]
            methods["fit"], methods["fit, with what is left over"] = fit(counts, left, seed, steps)
            for name, predict in methods.items():
                figures, histogram = judge(predict, counts[left])
                rows.setdefault(name, []).append(figures)
                best.setdefault(name, []).append(histogram)
        print(f"seed {seed}, {time.process_time() - began:.0f} s:", *COLUMNS, sep="  ")
        for name, row in rows.items():
            print(f"{name:28}", *(f"{np.mean(column):9.2f}" for column in zip(*row, strict=True)))
        if seed == seeds[0]:
            options.output.mkdir(parents=True, exist_ok=True)
            draw(options.output / "fit_measured_histograms.png", counts, zones, best, rows)
        tables.append(rows)
    return tables


if __name__ == "__main__":
    main()
