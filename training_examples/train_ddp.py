"""A network that reads where a wall is from photon counts, taught by the renderer alone, in any number of processes.

Nobody tells the network where the wall is. It proposes a distance and a tilt, the renderer makes the counts that such
a wall would give, and the loss compares them with those that were measured (`tilted_walls.py`). Ranks share every
batch; samples, seeds and noise depend on the step and the sample alone, so that 1 and 2 ranks learn the same. A run
that was killed goes on where its last checkpoint was.

    python training_examples/train_ddp.py --seeds 0 1 2
    torchrun --standalone --nproc-per-node 2 training_examples/train_ddp.py

Prints the mean errors of distance and tilt on walls that the network has not learnt from: by a matched filter and a
plane through its depths, by the untrained network, and by the trained one.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from tilted_walls import (
    KEY,
    NETWORK,
    PLANE,
    SMOKE,
    UNTRAINED,
    Planes,
    Reader,
    Sizes,
    draw,
    folder_of,
    loss_of,
    measured,
    plane_fit,
    report,
    truth_of,
)
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader, Subset
from tqdm import tqdm

import torchtransient as tt


@dataclass
class Run:
    """``found``: distances and tilts of the walls of the test, by method. ``seconds``: of the CPU, of this process."""

    truth: Planes
    found: dict[str, Planes] = field(default_factory=dict)
    losses: list[float] = field(default_factory=list)
    seconds: float = 0.0


def train(options: argparse.Namespace, sizes: Sizes, ranks: tt.training.Ranks, seed: int) -> Run:
    """One run, or what is left of it."""
    begin = time.process_time()
    if ranks.is_first:
        folder_of(options.output, sizes)  # generates it
    ranks.wait()
    data = tt.data.TransientDataset(folder_of(options.output, sizes, generate=False))
    is_test = data.index < sizes.test
    learnt_from = Subset(data, (~is_test).nonzero()[:, 0].tolist())
    test = next(iter(DataLoader(Subset(data, is_test.nonzero()[:, 0].tolist()), batch_size=sizes.test)))
    counts, run = measured(test, tt.training.Seeds(0, "test"), 0), Run(truth_of(test["values"][KEY]))

    torch.manual_seed(seed)
    model = Reader(sizes.spp)
    with torch.no_grad():
        run.found |= {PLANE: plane_fit(counts), UNTRAINED: model.propose(counts)}
    optimizer = torch.optim.Adam(model.propose.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=sizes.steps)
    batches = tt.training.Batches(
        len(learnt_from), sizes.batch, seed=seed, rank=ranks.rank, world_size=ranks.size
    )
    parts = {"model": model, "optimizer": optimizer, "schedule": schedule, "batches": batches}
    path = options.output / f"train_ddp-{sizes.steps}-{seed}.pt"
    if path.exists():
        # Nothing here draws from torch's own generators: any number of ranks may go on.
        run.losses = tt.training.load_checkpoint(path, parts, random=False).values["losses"]
    wrapped = DistributedDataParallel(model) if ranks.size > 1 else model
    seeds = tt.training.Seeds(seed)
    left, loader = range(batches.step, sizes.steps), batches.loader(learnt_from)
    bar = tqdm(zip(left, loader, strict=False), f"seed {seed}", len(left), disable=not ranks.is_first)
    for step, batch in bar:
        seen = measured(batch, seeds, step)
        loss = loss_of(step / sizes.steps, wrapped(seen, seeds(step, batch["index"])), seen)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        run.losses.append(ranks.mean(loss.item()))
        batches.step = step + 1
        if batches.step % options.every == 0 or batches.step == sizes.steps:
            tt.training.save_checkpoint(path, parts, step=batches.step, values={"losses": run.losses})
        bar.set_postfix(loss=f"{run.losses[-1]:.4f}")
    with torch.no_grad():
        run.found[NETWORK] = model.propose(counts)
    run.seconds = time.process_time() - begin
    return run


def main(argv: Sequence[str] | None = None) -> Run:
    """Command line; returns the last run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="a run for each (0)")
    parser.add_argument("--every", type=int, default=100, help="steps between checkpoints (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for all files (%(default)s)")
    options = parser.parse_args(argv)
    picture = options.output / "train_ddp.png"
    with tt.training.ranks(threads=1) as ranks:  # films so small are not worth several
        for seed in options.seeds:
            run = train(options, SMOKE if options.smoke else Sizes(), ranks, seed)
            if ranks.is_first:
                report(f"seed {seed}", run.found, run.truth)
                print(f"seed {seed}, {run.seconds:.0f} s of the CPU of this process")
        if ranks.is_first:
            draw(run.found, run.truth, run.losses, picture)
            print(f"train_ddp: {picture}")
    return run


if __name__ == "__main__":
    main()
