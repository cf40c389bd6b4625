"""Compare losses on the shift of a peak: `python docs/make_loss_pictures.py` writes the table of docs/losses.md and its
picture, four minutes of one core; `--draws 8` a quick look.

One pixel whose pulse is somewhere else: 200 photons in 1000 cycles of a detector without pile-up (of a SPAD with it,
for the likelihood of first photons), over a background of 0.1 per bin, 256 bins of 2 cm. The model knows the background
and the shape of the pulse, not its place, nor its light.
"""

from __future__ import annotations

import argparse
import functools
import math
import time
from collections.abc import Callable
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

import torchtransient as tt
from torchtransient import losses, sensing

PAGE, PICTURE = Path(__file__).parent / "losses.md", Path(__file__).parent / "images" / "loss_shifts.png"
BEGIN, END = "<!-- shifts:begin -->", "<!-- shifts:end -->"
BINS, WIDTH, CYCLES, PHOTONS, BACKGROUND, HOME = 256, 0.02, 1000, 200.0, 0.1, 2.56
AXIS = tt.TimeAxis(0.0, WIDTH, BINS)
PULSES = {"narrow": 0.01, "wide": 0.1}  # standard deviation, metres of path
OFFSETS = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
STEPS, RATE = 150, 0.04
LOW = tt.FrequencyAxis.uniform(0.2, 0.2, 8)
first_photon = functools.partial(losses.first_photon_nll, cycles=CYCLES)

# (name, what a pixel's loss is, of rates per cycle and of a SPAD's histogram instead of mean counts and counts)
Pixel = Callable[[Tensor, Tensor], Tensor]


def by_bin(loss: Callable[..., Tensor], **options: object) -> Pixel:
    return lambda x, y: loss(x, y, reduction="none", **options).sum(1)


def by_record(loss: Callable[..., Tensor], *more: object, **options: object) -> Pixel:
    return lambda x, y: loss(x, y, *more, reduction="none", **options)


CASES: dict[str, tuple[Pixel, bool]] = {
    "`squared_loss`": (by_bin(losses.squared_loss), False),
    "`root_loss`": (by_bin(losses.root_loss), False),
    "`expected_root_loss`": (by_bin(losses.expected_root_loss), False),
    "`log_ratio_loss`, background 0.1": (by_bin(losses.log_ratio_loss, background=BACKGROUND), False),
    "`poisson_nll`": (by_bin(losses.poisson_nll), False),
    "`first_photon_nll`": (by_bin(first_photon), True),
    "`transient_phasor_loss`, 0.2 to 1.6 per m": (
        lambda x, y: losses.transient_phasor_loss(x, y, axis=AXIS, frequencies=LOW, reduction="none").sum(1), False),
    "the same, `phase_only`": (
        lambda x, y: losses.transient_phasor_loss(x, y, axis=AXIS, frequencies=LOW, phase_only=True, floor=1.0,
            reduction="none").sum(1),
        False),
    "`wasserstein_loss`": (by_record(losses.wasserstein_loss, WIDTH), False),
    "`cumulative_loss`": (by_record(losses.cumulative_loss, WIDTH), False),
    "`multiscale_loss` of `squared_loss`": (by_record(losses.multiscale_loss), False),
    "`multiscale_loss` of `expected_root_loss`": (
        by_record(losses.multiscale_loss, losses.expected_root_loss), False),
    "`multiscale_loss` of `poisson_nll`": (
        by_record(losses.multiscale_loss, losses.poisson_nll), False),
    "`multiscale_loss` of `first_photon_nll`": (
        by_record(losses.multiscale_loss, first_photon), True),
}  # fmt: skip
DRAWN = {
    "squared": "`squared_loss`",
    "Poisson": "`poisson_nll`",
    "expected root": "`expected_root_loss`",
    "Wasserstein": "`wasserstein_loss`",
    "running sums": "`cumulative_loss`",
    "Poisson,\nmany scales": "`multiscale_loss` of `poisson_nll`",
}


def mean_counts(place: Tensor, light: Tensor, sigma: float) -> Tensor:
    """(1, T, 1, N): expected counts of N pixels by place and light of their pulses."""
    edges = AXIS.edges_opl - place[:, None]
    return (light[:, None] * (0.5 * torch.erf(edges / (sigma * math.sqrt(2)))).diff() + BACKGROUND).T[None, :, None]


def measured(sigma: float, number: int, spad: bool) -> Tensor:
    """(1, T, 1, N) noisy records of the pulse at home."""
    g = torch.Generator().manual_seed(0)
    mean = mean_counts(*(torch.full((number,), x, dtype=torch.float64) for x in (HOME, PHOTONS)), sigma)
    if spad:
        return sensing.SynchronousSPAD(CYCLES).sample(mean / CYCLES, generator=g)
    return torch.poisson(mean, generator=g)


def values(case: tuple[Pixel, bool], place: Tensor, light: Tensor, sigma: float, target: Tensor) -> Tensor:
    """(N,) of each pixel."""
    loss, spad = case
    model = mean_counts(place, light, sigma)
    return loss(model / CYCLES if spad else model, target).flatten()


def slopes(case: tuple[Pixel, bool], shifts: Tensor, sigma: float, draws: int) -> tuple[Tensor, Tensor]:
    """Loss and its slope by shift of the model (draws, S), at half the light, since that is not known either."""
    number = len(shifts)
    place = (HOME + shifts.repeat(draws)).requires_grad_()
    target = measured(sigma, draws, case[1]).repeat_interleave(number, -1)
    value = values(case, place, torch.full_like(place, 0.5 * PHOTONS), sigma, target)
    (slope,) = torch.autograd.grad(value.sum(), place)
    return value.detach().reshape(draws, number), slope.reshape(draws, number)


def come_home(case: tuple[Pixel, bool], sigma: float, draws: int) -> list[float]:
    """Share of descents that end within a bin of home, by distance of the start (half of the draws on either side)."""
    each = torch.tensor(OFFSETS, dtype=torch.float64).repeat_interleave(draws)
    side = torch.where(torch.arange(len(each)) % 2 == 0, 1.0, -1.0)
    place = (HOME + side * each).requires_grad_()
    light = torch.full_like(each, math.log(0.5 * PHOTONS)).requires_grad_()
    target = measured(sigma, draws, case[1]).repeat(1, 1, 1, len(OFFSETS))
    optimizer = torch.optim.Adam([place, light], RATE, betas=(0.8, 0.95))
    for k in range(STEPS):
        optimizer.param_groups[0]["lr"] = RATE * (1 - k / STEPS) ** 0.7
        optimizer.zero_grad()
        values(case, place, light.exp(), sigma, target).sum().backward()
        optimizer.step()
    home = (place.detach() - HOME).abs() < WIDTH
    return home.reshape(len(OFFSETS), draws).double().mean(1).tolist()


def reach(distances: list[float], shares: list[float], least: float) -> str:
    """The last distance up to which all shares are large enough."""
    good = 0.0
    for distance, share in zip(distances, shares, strict=True):
        if share < least:
            break
        good = distance
    return "-" if good == 0 else f"{good:g}" if good < 1 else f"{good:.1f}"


def row(name: str, draws: int) -> str:
    grid = torch.cat([torch.arange(1, 10) * 0.02, torch.arange(10, 101, 5) * 0.02]).double()  # 2 cm to 2 m
    cells, began = [], time.process_time()
    for sigma in PULSES.values():
        _, slope = slopes(CASES[name], torch.cat([grid, -grid]), sigma, draws)
        right = (slope * torch.cat([grid, -grid]).sign() > 0).double().mean(0).reshape(2, -1).mean(0)
        cells.append(reach([round(x, 2) for x in grid.tolist()], right.tolist(), 0.95))
        cells.append(reach(list(OFFSETS), come_home(CASES[name], sigma, draws), 0.9))
    descents = 2 * len(OFFSETS) * draws * STEPS
    micro = 1e6 * (time.process_time() - began) / descents
    return f"| {name} | {cells[0]} | {cells[1]} | {cells[2]} | {cells[3]} | {micro:.0f} |"


def table(draws: int) -> str:
    head = (
        "| loss | narrow: slope | narrow: descents | wide: slope | wide: descents | CPU us a record and step |\n"
        "|---|---|---|---|---|---|\n"
    )
    return head + "\n".join(row(name, draws) for name in tqdm(CASES, desc="losses")) + "\n"


def draw(path: Path) -> None:
    """Loss and slope against the shift, for a record with noise (lines) and the spread of others (bands)."""
    shifts = torch.linspace(-1.5, 1.5, 301, dtype=torch.float64)
    figure = Figure(figsize=(2.15 * len(DRAWN), 4.2), layout="constrained")
    axes = figure.subplots(2, len(DRAWN), sharex=True)
    for k, (title, name) in enumerate(DRAWN.items()):
        for colour, (pulse, sigma) in zip(("tab:blue", "tab:orange"), PULSES.items(), strict=True):
            value, slope = slopes(CASES[name], shifts, sigma, 24)
            value = (value - value.amin(1, keepdim=True)) / (value.amax() - value.amin())
            for axis, what in ((axes[0, k], value), (axes[1, k], slope / slope.abs().amax())):
                low, high = torch.quantile(what, torch.tensor([0.05, 0.95], dtype=torch.float64), dim=0)
                axis.fill_between(shifts, low, high, color=colour, alpha=0.25, linewidth=0)
                axis.plot(shifts, what[0], color=colour, linewidth=1.2, label=pulse)
        axes[0, k].set_title(title, fontsize=10)
        axes[1, k].axhline(0, color="grey", linewidth=0.6)
        axes[1, k].set_xlabel("shift, m")
        axes[1, k].set_ylim(-1.05, 1.05)
        for axis in axes[:, k]:
            axis.tick_params(labelsize=8)
            if k:
                axis.set_yticklabels([])
    axes[0, 0].set_ylabel("loss, of its range")
    axes[1, 0].set_ylabel("slope, of its largest")
    axes[0, 0].legend(fontsize=8, loc="lower right", frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=24, help="noisy records of each case")
    parser.add_argument("--page", type=Path, default=PAGE, help="the page whose table is written")
    parser.add_argument("--picture", type=Path, default=PICTURE)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    draw(arguments.picture)
    text = arguments.page.read_text(encoding="utf-8")
    found = table(arguments.draws)
    before, after = text.split(BEGIN)[0], text.split(END)[1]
    arguments.page.write_text(f"{before}{BEGIN}\n{found}{END}{after}", encoding="utf-8")
    print(found)


if __name__ == "__main__":
    main()
