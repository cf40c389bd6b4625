"""A counter whose response and background nobody knows: networks before and behind the renderer, trained together.

A network proposes the scene of a capture (`two_walls.py`), the renderer makes light of it, and a model of the counter
makes counts of that: a core of unknown width, a network for the light that follows it, a network for the background
over the film. Nothing has labels: the loss says how badly the counts of 256 captures are explained. What a network that
was trained on many random counters says of the captures is the prior. Known are the gain and the core's time zero.

    python training_examples/self_calibration.py --seeds 0 1 2 --output demo_output

Prints mean errors of 24 scenes for each seed by every method, CPU seconds (of training, or of fitting the 24), ratios,
and how wrong response and background are in the end. Draws what each part corrects.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm
from two_wall_fits import Fit, Network, Table, draw_errors, draw_histograms, in_ranges, options_of, train, weighted
from two_walls import MIDDLE, known_counter, renderer, scenes
from unknown_counters import LAGS, kernel_of, learnable_counter, level_of, random_counter, true_counter

import torchtransient as tt
from torchtransient import sensing

RANDOM, WRONG = "network, random counters", "network, then renderer, wrong counter"
TRUE, TOGETHER = "network, then renderer, true counter", "trained together, then renderer"
WRONG_MEAN, TOGETHER_MEAN, FITTED_MEAN = "network, wrong counter", "trained together", "then renderer"


@dataclass(frozen=True)
class Sizes:
    """``learnt``, ``held``, ``captures``, ``test``: scenes. ``network``, ``together``, ``fit``: steps."""

    learnt: int = 1024
    held: int = 96
    captures: int = 256
    test: int = 24
    network: int = 1500
    together: int = 250
    fit: int = 30
    true_spp: int = 2048


SMOKE = Sizes(learnt=64, held=12, captures=12, test=3, network=40, together=10, fit=8, true_spp=256)


def train_together(fit: Fit, first: Network, sigma: Tensor, steps: int) -> Network:
    """Counts -> network -> renderer -> counter -> counts, without labels. Returns the network; the counter learns."""
    network, captures = deepcopy(first), fit.counts
    with torch.no_grad():
        anchor = first(captures)
    learnt = [parameter for parameter in fit.sensor.parameters() if parameter.requires_grad]
    groups = [{"params": list(network.parameters()), "lr": 3e-4}, {"params": learnt, "lr": 0.05}]
    optimizer = torch.optim.Adam(groups)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: min(1, (step + 1) / 10) * (1 - step / steps) ** 0.7
    )
    for _ in tqdm(range(steps), desc="trained together", unit="step", leave=False):
        numbers = torch.randint(0, len(captures), (8,))
        found = network(captures[numbers])
        with torch.no_grad():
            variance = fit.mean(found)  # another render than the one that is compared
        prior = 0.5 * (in_ranges(found, anchor[numbers]) / sigma).square().sum()
        optimizer.zero_grad()
        ((weighted(fit.mean(found), captures[numbers], variance) + prior) / 8000).backward()
        optimizer.step()
        schedule.step()
    fit.sensor.requires_grad_(False)
    return network


@dataclass
class Shown:
    """What the picture shows of one seed: two counters, counts (B, 1, T, H, W) and what is expected of them."""

    true: sensing.Compose
    learnt: sensing.Compose
    counts: Tensor
    means: dict[str, Tensor]


def run(seed: int, sizes: Sizes, table: Table) -> Shown:
    """All methods on one seed's scenes; rows go into the table."""
    torch.manual_seed(seed)
    now, known, real, model = time.process_time, known_counter(), true_counter(), renderer()
    both = scenes(seed, sizes.learnt + sizes.held, 256, "scenes")
    (unknowns, held), (light, held_light) = (x.split([sizes.learnt, sizes.held]) for x in both)
    captures = real.sample(scenes(2000 + seed, sizes.captures, 512, "captures").light)
    truth, test_light = scenes(1000 + seed, sizes.test, sizes.true_spp, "test")
    counts = real.sample(test_light)

    def timed(name: str, method: Callable[[], Any], answer: Callable[[Any], Tensor] = lambda found: found) -> Any:
        begin = now()
        found = method()
        with torch.no_grad():
            table.add(name, answer(found), truth, now() - begin)
        return found

    def supervised(sensor_of: Callable[[], sensing.Compose]) -> Network:
        def loss(network: Network, numbers: Tensor) -> Tensor:
            return in_ranges(network(sensor_of().sample(light[numbers])), unknowns[numbers]).square().mean()

        return train(loss, sizes.learnt, sizes.network, "network")

    timed("network, wrong counter", lambda: supervised(lambda: known), lambda network: network(counts))
    first = timed(RANDOM, lambda: supervised(random_counter), lambda network: network(counts))
    with torch.no_grad():
        start, seen = first(counts), torch.cat([random_counter().sample(one[None]) for one in held_light])
        sigma = in_ranges(first(seen), held).square().mean(0).sqrt()
    middle, wrong, right = MIDDLE.expand(sizes.test, 6), Fit(model, known, counts), Fit(model, real, counts)
    timed("renderer from the middle, wrong counter", lambda: wrong.from_afar(middle, sizes.fit))
    timed(WRONG, lambda: wrong(start, sizes.fit, sigma=sigma))
    for kind, neural in {TOGETHER + ", parameters": False, TOGETHER: True}.items():
        sensor = learnable_counter(neural, captures)
        together = Fit(model, sensor, captures)
        tuned = timed(
            kind.replace(", then renderer", ""),
            lambda fit=together: train_together(fit, first, sigma, sizes.together),
            lambda network: network(counts),
        )
        with torch.no_grad():
            proposed = tuned(counts)
            off = float((kernel_of(sensor) - kernel_of(real)).abs().sum() / 2)
            level = float((level_of(sensor) - level_of(real)).abs().mean() / level_of(real).mean())
        tqdm.write(f"{100 * off:.1f} % of the response in wrong bins, background wrong by {100 * level:.1f} %")
        fit = Fit(model, sensor, counts)
        found = timed(kind, lambda fit=fit, proposed=proposed: fit(proposed, sizes.fit, sigma=sigma))
    timed(TRUE, lambda: right(start, sizes.fit, sigma=sigma))
    with torch.no_grad():
        means = {WRONG_MEAN: wrong.mean(start, 512), TOGETHER_MEAN: fit.mean(proposed, 512)}
        return Shown(real, sensor, counts, means | {FITTED_MEAN: fit.mean(found, 512)})


def draw(table: Table, shown: Shown, path: Path) -> None:
    """Errors by unknown, one scene's histogram, response and background."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 7.6), layout="constrained")
    upper, lower = figure.subfigures(2, 1)
    by_unknown, histogram = upper.subfigures(1, 2)
    colours = {RANDOM: "tab:orange", WRONG: "tab:red", TOGETHER: "tab:blue", TRUE: "0.6"}
    draw_errors(by_unknown.subplots(), table, colours)
    colour = {WRONG_MEAN: "tab:red", TOGETHER_MEAN: "tab:green", FITTED_MEAN: "tab:blue"}
    # The scene in which the renderer corrects most.
    moved = (shown.means[FITTED_MEAN] - shown.means[TOGETHER_MEAN]).abs().sum((1, 2, 3, 4))
    scene = int(moved.argmax())
    panels = histogram.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    draw_histograms(*panels, shown.counts[scene], {n: (mean[scene], colour[n]) for n, mean in shown.means.items()})
    response, true_level, learnt_level = lower.subplots(1, 3)
    for name, sensor, style in (("true", shown.true, "k-"), ("learnt", shown.learnt, "tab:blue")):
        response.plot(LAGS, kernel_of(sensor).detach().clamp_min(1e-6), style, label=name)
    response.plot(LAGS, kernel_of(known_counter()).clamp_min(1e-6), color="tab:red", linestyle=":", label="assumed")
    response.set(yscale="log", ylim=(1e-4, 1), xlabel="bins after the time zero", ylabel="share", title="response")
    response.legend(fontsize=8)
    for axes, sensor, title in ((true_level, shown.true, "true"), (learnt_level, shown.learnt, "learnt")):
        image = axes.imshow(level_of(sensor).detach(), vmin=0, vmax=float(level_of(shown.true).max()), cmap="magma")
        axes.set(title=f"background, {title}", xticks=[], yticks=[])
    lower.colorbar(image, ax=[true_level, learnt_level], label="counts a bin")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def main(argv: Sequence[str] | None = None) -> Table:
    """Command line; returns the errors."""
    options = options_of(__doc__, argv)
    tt.threads(1)
    table = Table()
    shown = [run(seed, SMOKE if options.smoke else Sizes(), table) for seed in options.seeds]
    print(table)
    for name in (RANDOM, WRONG, TRUE):
        print(f"{TOGETHER}: {table.percent(TOGETHER) / table.percent(name):.2f} of the error of {name}")
    picture = options.output / "self_calibration.png"
    draw(table, shown[0], picture)
    print(f"self_calibration: {picture}")
    return table


if __name__ == "__main__":
    main()
