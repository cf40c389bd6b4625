"""What the two hybrid examples do with `two_walls.py`: a network, fits through the renderer, tables and panels."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm
from two_walls import AXIS, BOUNDS, NAMES, PIXELS, SPAN, UNITS, values_of

import torchtransient as tt
from torchtransient import losses, sensing


class Network(nn.Module):
    """Counts (B, 1, T, H, W) -> unknowns (B, 6). 0.16 million weights; bins are channels of images."""

    def __init__(self, width: int = 48) -> None:
        super().__init__()
        sizes = [(AXIS.num_bins, width, 1), (width, width, 3), (width, 16, 3)]
        layers = [m for a, b, k in sizes for m in (nn.Conv2d(a, b, k, padding=k // 2), nn.SiLU())]
        head = [nn.Flatten(), nn.Linear(16 * PIXELS**2, 128), nn.SiLU(), nn.Linear(128, 6)]
        self.layers = nn.Sequential(*layers, *head)

    def forward(self, counts: Tensor) -> Tensor:
        return BOUNDS(self.layers(losses.anscombe(counts)[:, 0] / 2 - 1))


def train(loss_of: Callable[[Network, Tensor], Tensor], count: int, steps: int, label: str) -> Network:
    """A new network after ``steps`` of Adam on ``loss_of(network, numbers of 32 of count scenes)``."""
    network = Network()
    optimizer = torch.optim.Adam(network.parameters(), fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, total_steps=steps)
    for _ in tqdm(range(steps), desc=label, unit="step", leave=False):
        optimizer.zero_grad()
        loss_of(network, torch.randint(0, count, (32,))).backward()
        optimizer.step()
        schedule.step()
    return network


def in_ranges(found: Tensor, truth: Tensor) -> Tensor:
    """Errors (B, 6) as shares of the ranges."""
    return (found - truth) / SPAN


def weighted(mean: Tensor, counts: Tensor, variance: Tensor) -> Tensor:
    """Squares over a variance that is no function of this render: its noise then biases nothing, since the layer draws
    the samples of a gradient anew. Near the truth as good as the likelihood.
    """
    return 0.5 * ((mean - counts).square() / variance).sum()


def roots(mean: Tensor, counts: Tensor) -> Tensor:
    """Nearly minus the log-likelihood of counts, from wherever; biased by noise of the render."""
    return losses.expected_root_loss(mean, counts, reduction="sum") / 2


def running_sums(mean: Tensor, counts: Tensor) -> Tensor:
    """Has a slope however far away the truth is."""
    return losses.cumulative_loss(mean, counts, 1.0, per_root_count=True, reduction="sum")


@dataclass(frozen=True)
class Fit:
    """Fits of scenes to counts (B, 1, T, H, W), through renderer and sensor, by Adam."""

    model: tt.TransientRenderer
    sensor: sensing.Compose
    counts: Tensor

    def mean(self, unknowns: Tensor, spp: int = 64) -> Tensor:
        """Expected counts."""
        return self.sensor.expected(self.model(values_of(unknowns), spp=spp).transient)

    def __call__(
        self, start: Tensor, steps: int, misfit: Callable[[Tensor, Tensor], Tensor] | None = None, *,
        rate: float = 0.05, spp: int = 64, late: int | None = None, sigma: Tensor | None = None,
    ) -> Tensor:  # fmt: skip
        """(B, 6) from (B, 6). ``misfit`` None: weighted squares. ``late``: samples of the last two fifths. ``sigma``
        (6,): the start is a normal prior of that width, in shares of the ranges.
        """
        start = start.detach()
        if misfit is None:
            with torch.no_grad():
                misfit = partial(weighted, variance=self.mean(start, 512))
        free = nn.Parameter(BOUNDS.right_inverse(start))
        optimizer = torch.optim.Adam([free], betas=(0.8, 0.95))
        for step in tqdm(range(steps), desc="fit", unit="step", leave=False):
            optimizer.param_groups[0]["lr"] = rate * (1 - step / steps) ** 0.7
            found = BOUNDS(free)
            loss = misfit(self.mean(found, spp if late is None or step < 0.6 * steps else late), self.counts)
            if sigma is not None:
                loss = loss + 0.5 * (in_ranges(found, start) / sigma).square().sum()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        return BOUNDS(free.detach())

    def from_afar(self, start: Tensor, steps: int) -> Tensor:
        """Running sums first, then roots, which fit well near the truth."""
        near = self(start, steps // 2, running_sums, rate=0.2)
        return self(near, steps - steps // 2, roots, late=512)


@dataclass
class Table:
    """Errors (as shares of the ranges) and CPU seconds of several methods; a list has an entry for each seed."""

    errors: dict[str, list[Tensor]] = field(default_factory=dict)
    seconds: dict[str, list[float]] = field(default_factory=dict)

    def add(self, name: str, found: Tensor, truth: Tensor, seconds: float = 0.0) -> None:
        self.errors.setdefault(name, []).append(in_ranges(found.detach(), truth).abs())
        self.seconds.setdefault(name, []).append(seconds)
        tqdm.write(f"{name:<46}{self.percent(name, -1):9.2f} %{seconds:9.1f} s")

    def percent(self, name: str, first: int = 0) -> float:
        """Mean error of the six unknowns, in percent of their ranges, of the seeds from ``first`` on."""
        return 100 * float(torch.cat(self.errors[name][first:]).mean())

    def __str__(self) -> str:
        """Means over scenes and seeds."""
        lines = [f"{'':<46}" + "".join(f"{name:>14}" for name in NAMES) + f"{'all, %':>9}{'CPU s':>8}"]
        for name, errors in self.errors.items():
            mean = (torch.cat(errors).mean(0) * SPAN * UNITS).tolist()
            shown = "".join(f"{x:14.{2 if n < 4 else 3}f}" for n, x in enumerate(mean))
            seconds = sum(self.seconds[name]) / len(self.seconds[name])
            lines.append(f"{name:<46}{shown}{self.percent(name):9.2f}{seconds:8.1f}")
        return "\n".join(lines)


def plain_ticks(axis: Any) -> None:
    """1, 3, 10 instead of powers."""
    from matplotlib.ticker import FixedLocator, NullLocator

    axis.set_major_locator(FixedLocator([m * 10.0**e for e in range(-3, 4) for m in (1, 3)]))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_locator(NullLocator())


def draw_errors(axes: Any, table: Table, names: dict[str, str]) -> None:
    """Mean errors by unknown, in percent of the ranges, of several methods with a colour each."""
    for number, (name, colour) in enumerate(names.items()):
        errors = (100 * torch.cat(table.errors[name]).mean(0)).tolist()
        places = [k + (number - (len(names) - 1) / 2) * 0.8 / len(names) for k in range(6)]
        axes.bar(places, errors, 0.8 / len(names), color=colour, label=name.strip())
    axes.set(yscale="log", ylabel="mean error, % of the range", title="errors by unknown")
    plain_ticks(axes.yaxis)
    axes.set_xticks(range(6), [name.split(",")[0].replace(" ", "\n") for name in NAMES], fontsize=8)
    axes.set_ylim(top=8 * axes.get_ylim()[1])  # room for the legend
    axes.legend(fontsize=8, loc="upper left")


def draw_histograms(upper: Any, lower: Any, counts: Tensor, means: dict[str, tuple[Tensor, str]]) -> None:
    """Counts of one scene (1, T, H, W), all pixels together, with what is expected; below, what is not explained."""
    total = counts.sum((0, 2, 3))
    upper.step(AXIS.centers_opl, total, where="mid", color="0.5", linewidth=1, label="measured")
    for name, (mean, colour) in means.items():
        expected = mean.sum((0, 2, 3))
        upper.plot(AXIS.centers_opl, expected, color=colour, linewidth=1.3, label=name)
        lower.plot(AXIS.centers_opl, (total - expected) / expected.sqrt(), color=colour, linewidth=1)
    upper.set(yscale="log", ylabel="counts a bin", title="histogram of one scene, all pixels")
    upper.set_ylim(top=12 * float(total.max()))
    upper.legend(fontsize=8, loc="upper left")
    lower.axhspan(-2, 2, color="0.9")
    lower.set(xlabel="path, m", ylabel="residual,\nstd. dev.")
    lower.set_yscale("symlog", linthresh=5)
    lower.set_yticks([-30, -5, 0, 5, 30], ["-30", "-5", "0", "5", "30"])
    lower.set_ylim(min(-6, lower.get_ylim()[0]), max(6, lower.get_ylim()[1]))


def options_of(doc: str | None, argv: Sequence[str] | None) -> argparse.Namespace:
    """The command line of both examples."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="(%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for the picture (%(default)s)")
    return parser.parse_args(argv)
