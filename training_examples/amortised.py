"""A network proposes, the renderer corrects: six unknowns of a room from photon counts, against each of them alone.

The network has learnt from rendered scenes (`two_walls.py`), for which it needs no gradient of the renderer. What it
says of a new measurement is where a fit through renderer and counter starts, and its prior: the errors that the network
makes on scenes that it has not learnt from are the widths of a normal distribution. Alone, the network leaves most of
what the photons say unused, and the fit does not find the hidden wall.

    python training_examples/amortised.py --seeds 0 1 2 --output demo_output

Prints mean errors of 24 scenes for each seed by every method; CPU seconds of all that it takes to have answers for
these (scenes and training included, where there are any); and ratios. Draws what the renderer corrects.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from two_wall_fits import (
    Fit,
    Network,
    Table,
    draw_errors,
    draw_histograms,
    in_ranges,
    options_of,
    plain_ticks,
    roots,
    train,
)
from two_walls import LOW, MIDDLE, SPAN, known_counter, renderer, scenes

import torchtransient as tt

NETWORK, TWICE, BEST = "network", "network, twice the steps", "renderer, best of five starts"
HYBRID = "network, then renderer with prior"


@dataclass(frozen=True)
class Sizes:
    """``learnt``, ``held``, ``test``: scenes. ``network``, ``fit``: steps."""

    learnt: int = 2048
    held: int = 128
    test: int = 24
    network: int = 2000
    fit: int = 30
    starts: int = 5
    true_spp: int = 2048


SMOKE = Sizes(learnt=128, held=16, test=4, network=120, fit=12, starts=1, true_spp=256)


@dataclass
class Shown:
    """What the picture shows of one seed: unknowns (B, 6), counts and their means (B, 1, T, H, W)."""

    truth: Tensor
    counts: Tensor
    proposed: Tensor
    corrected: Tensor
    mean_proposed: Tensor
    mean_corrected: Tensor


def squares(mean: Tensor, counts: Tensor) -> Tensor:
    """Squared errors over the mean counts of each scene."""
    return ((mean - counts).square() / counts.mean((1, 2, 3, 4), keepdim=True)).sum()


def best_of(fit: Fit, starts: int, steps: int) -> Tensor:
    """Of fits from random starts, for each scene the one that explains the counts best."""
    found, lowest = MIDDLE.expand(len(fit.counts), 6), torch.full((len(fit.counts),), torch.inf)
    for _ in range(starts):
        one = fit.from_afar(LOW + SPAN * torch.rand_like(found), steps)
        with torch.no_grad():
            misfits = torch.stack([roots(*pair) for pair in zip(fit.mean(one, 512), fit.counts, strict=True)])
        found = torch.where((misfits < lowest)[:, None], one, found)
        lowest = torch.minimum(misfits, lowest)
    return found


def run(seed: int, sizes: Sizes, table: Table) -> Shown:
    """All methods on one seed's scenes; rows go into the table."""
    torch.manual_seed(seed)
    sensor, now = known_counter(), time.process_time
    truth, light = scenes(1000 + seed, sizes.test, sizes.true_spp, "test")
    counts, middle = sensor.sample(light), MIDDLE.expand(sizes.test, 6)
    begin = now()
    both = scenes(seed, sizes.learnt + sizes.held, 256, "scenes")
    rendered = now() - begin
    (unknowns, held), (light, held_light) = (x.split([sizes.learnt, sizes.held]) for x in both)

    def supervised(network: Network, numbers: Tensor) -> Tensor:
        """With fresh noise at each step."""
        return in_ranges(network(sensor.sample(light[numbers])), unknowns[numbers]).square().mean()

    def trained(steps: int, name: str) -> tuple[Network, Tensor, float]:
        begin = now()
        network = train(supervised, sizes.learnt, steps, name)
        with torch.no_grad():
            found = network(counts)
        spent = rendered + now() - begin
        table.add(name, found, truth, spent)
        return network, found, spent

    table.add("middle of the ranges", middle, truth)
    network, start, spent = trained(sizes.network, NETWORK)
    trained(2 * sizes.network, TWICE)
    with torch.no_grad():
        sigma = in_ranges(network(sensor.sample(held_light)), held).square().mean(0).sqrt()

    fit = Fit(renderer(), sensor, counts)

    def timed(name: str, method: Callable[[], Tensor], before: float = 0.0) -> Tensor:
        begin = now()
        found = method()
        table.add(name, found, truth, before + now() - begin)
        return found

    timed("renderer from the middle, squares", lambda: fit(middle, sizes.fit, squares, rate=0.15))
    timed("renderer from the middle, sums then roots", lambda: fit.from_afar(middle, sizes.fit))
    timed(BEST, lambda: best_of(fit, sizes.starts, sizes.fit))
    timed("  twice the steps", lambda: best_of(fit, sizes.starts, 2 * sizes.fit))
    corrected = timed(HYBRID, lambda: fit(start, sizes.fit, sigma=sigma), spent)
    timed("  without prior", lambda: fit(start, sizes.fit), spent)
    timed("  expected roots", lambda: fit(start, sizes.fit, roots, sigma=sigma), spent)
    timed("  expected roots, 256 spp", lambda: fit(start, sizes.fit, roots, sigma=sigma, spp=256), spent)
    timed("renderer from the truth, 512 spp", lambda: fit(truth, sizes.fit, spp=512))
    with torch.no_grad():
        return Shown(truth, counts, start, corrected, fit.mean(start, 512), fit.mean(corrected, 512))


def draw(table: Table, shown: Shown, path: Path) -> None:
    """Errors by unknown, one scene's histogram, and errors over CPU seconds."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4.2), layout="constrained")
    by_unknown, histogram, over_time = figure.subfigures(1, 3, width_ratios=[1.1, 1, 1])
    colours = {BEST: "tab:green", NETWORK: "tab:orange", TWICE: "tab:red", HYBRID: "tab:blue"}
    draw_errors(by_unknown.subplots(), table, colours)
    # The one of which the renderer changes the answer most.
    scene = int(in_ranges(shown.corrected, shown.proposed).abs().mean(1).argmax())
    means = {"proposed by the network": (shown.mean_proposed[scene], "tab:orange")}
    means["after the renderer"] = (shown.mean_corrected[scene], "tab:blue")
    draw_histograms(*histogram.subplots(2, 1, sharex=True, height_ratios=[2, 1]), shown.counts[scene], means)
    axes = over_time.subplots()
    for name in table.errors:
        seconds = sum(table.seconds[name]) / len(table.seconds[name])
        if seconds > 0 and "truth" not in name:
            colour = colours.get(name, "0.6")
            axes.plot(seconds, table.percent(name), "o", color=colour, label=name.strip() if name in colours else None)
    axes.plot([], [], "o", color="0.6", label="other fits")
    axes.set(xscale="log", yscale="log", xlabel="CPU seconds until 24 answers", ylabel="mean error, % of the range")
    axes.set_title("error and cost")
    for axis in (axes.xaxis, axes.yaxis):
        plain_ticks(axis)
    axes.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def main(argv: Sequence[str] | None = None) -> Table:
    """Command line; returns the errors."""
    options = options_of(__doc__, argv)
    tt.threads(1)
    table = Table()
    shown = [run(seed, SMOKE if options.smoke else Sizes(), table) for seed in options.seeds]
    print(table)
    for name in (TWICE, BEST):
        print(f"{HYBRID}: {table.percent(HYBRID) / table.percent(name):.2f} of the error of {name}")
    picture = options.output / "amortised.png"
    draw(table, shown[0], picture)
    print(f"amortised: {picture}")
    return table


if __name__ == "__main__":
    main()
