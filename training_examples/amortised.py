"""A network proposes, the renderer corrects: six unknowns of a room from photon counts, against each of them alone.

The network has learnt from rendered scenes (`two_walls.py`), for which it needs no gradient of the renderer. What it
says of a new measurement is the start of a fit through renderer and counter, and its prior: the errors that the network
makes on scenes that it has not learnt from are the widths of a normal distribution. The network knows about where; the
renderer knows exactly how. Alone, the network leaves most of what the photons say unused, and the fit ends far away.

    python training_examples/amortised.py --seeds 0 1 2 --output demo_output

Prints mean errors of 24 scenes for each seed by every method, CPU seconds (scenes, training and fit together: what it
takes to have an answer for 24 measurements) and the ratios.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm
from two_walls import (
    AXIS,
    HIGH,
    LOW,
    MIDDLE,
    NAMES,
    SPAN,
    UNITS,
    Fit,
    Network,
    Table,
    in_ranges,
    known_counter,
    renderer,
    roots,
    scenes,
    squares,
    train,
)

import torchtransient as tt

NETWORK, TWICE, BEST = "network", "network, twice the steps", "renderer, best of five starts"
HYBRID = "network, then renderer with prior"


@dataclass(frozen=True)
class Sizes:
    """``learnt``, ``held``, ``test``: scenes. ``network``, ``fit``: steps. ``starts`` of the renderer alone."""

    learnt: int = 2048
    held: int = 128
    test: int = 24
    network: int = 2000
    fit: int = 30
    alone: int = 45
    starts: int = 5
    true_spp: int = 2048


SMOKE = Sizes(learnt=192, held=24, test=4, network=200, fit=12, alone=12, starts=2, true_spp=256)


@dataclass
class Shown:
    """What the picture needs: of the first seed."""

    truth: Tensor
    counts: Tensor
    proposed: Tensor
    corrected: Tensor
    before: Tensor
    after: Tensor


def run(seed: int, sizes: Sizes, table: Table) -> Shown:
    """All methods on one seed's scenes; rows go into the table."""
    torch.manual_seed(seed)
    clock, sensor = time.process_time, known_counter()
    test = scenes(1000 + seed, sizes.test, sizes.true_spp, "test")
    counts, truth = sensor.sample(test.light), test.unknowns
    middle = MIDDLE.expand(sizes.test, 6)

    begin = clock()
    both = scenes(seed, sizes.learnt + sizes.held, 256, "scenes")
    rendered = clock() - begin
    (unknowns, held_truth), (light, held_light) = (x.split([sizes.learnt, sizes.held]) for x in both)

    def supervised(network: Network, numbers: Tensor) -> Tensor:
        """Fresh noise at each step."""
        return in_ranges(network(sensor.sample(light[numbers])), unknowns[numbers]).square().mean()

    def trained(steps: int, name: str) -> tuple[Network, Tensor, float]:
        begin = clock()
        network = train(supervised, sizes.learnt, steps, name)
        with torch.no_grad():
            found = network(counts)
        spent = rendered + clock() - begin
        table.add(name, found, truth, spent)
        return network, found, spent

    table.add("middle of the ranges", middle, truth)
    network, start, spent = trained(sizes.network, NETWORK)
    trained(2 * sizes.network, TWICE)
    with torch.no_grad():  # of scenes that it has not learnt from
        sigma = in_ranges(network(sensor.sample(held_light)), held_truth).square().mean(0).sqrt()

    fit = Fit(renderer(), sensor, counts)
    begin = clock()
    table.add("renderer from the middle, squares", fit(middle, steps=sizes.fit, rate=0.15, misfit=squares), truth, clock() - begin)
    begin = clock()
    table.add("renderer from the middle, sums then roots", fit.from_afar(middle, sizes.fit), truth, clock() - begin)
    begin = clock()
    found, lowest = middle, torch.full((sizes.test,), torch.inf)
    for _ in range(sizes.starts):
        one = fit.from_afar(LOW + SPAN * torch.rand(sizes.test, 6), sizes.alone)
        with torch.no_grad():
            mean = fit.mean(one, 512)
        misfits = torch.stack([roots(*pair) for pair in zip(mean, counts, strict=True)])
        found, lowest = torch.where((misfits < lowest)[:, None], one, found), misfits.minimum(lowest)
    table.add(BEST, found, truth, clock() - begin)

    corrected = start
    for name, options in {
        "  the same without prior": {},
        "  the same, expected roots": {"sigma": sigma, "misfit": roots},
        "  the same, expected roots, 256 spp": {"sigma": sigma, "misfit": roots, "spp": 256},
        HYBRID: {"sigma": sigma},
    }.items():
        begin = clock()
        corrected = fit(start, steps=sizes.fit, label=name, **options)
        table.add(name, corrected, truth, spent + clock() - begin)
    begin = clock()
    table.add("renderer from the truth, 512 spp", fit(truth, steps=sizes.fit, spp=512), truth, clock() - begin)
    with torch.no_grad():
        before, after = fit.mean(start, 512), fit.mean(corrected, 512)
    return Shown(truth, counts, start, corrected, before, after)


def main(argv: Sequence[str] | None = None) -> dict[str, float]:
    """Command line; returns mean errors in percent of the ranges by method."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small enough for half a minute")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="(%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for the picture (%(default)s)")
    options = parser.parse_args(argv)
    tt.threads(1)
    table = Table()
    shown = [run(seed, SMOKE if options.smoke else Sizes(), table) for seed in options.seeds]
    percent = {name: table.percent(name) for name in table.errors}
    print(table)
    for name in (TWICE, BEST):
        print(f"{HYBRID}: {percent[HYBRID] / percent[name]:.2f} x the error of: {name}")
    return percent


if __name__ == "__main__":
    main()
