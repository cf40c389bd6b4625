"""A network that reads where a wall is from photon counts, taught by the renderer alone, in any number of processes.

Nobody tells the network where the wall is. It proposes a distance and a tilt, the renderer makes the histograms that
such a wall would give, and the loss compares them with the counts that were measured: 6 x 6 pixels, about 4 photons of
the laser and 13 of ambient light in each. Ranks share every batch; samples, seeds and noise depend on the step and the
sample alone, so that 1 and 2 ranks learn the same. A run that was killed goes on where its last checkpoint was.

    python training_examples/train_ddp.py --output demo_output
    torchrun --nproc-per-node 2 training_examples/train_ddp.py --output demo_output

Prints the mean errors of distance and tilt on walls that the network has not learnt from: by a matched filter and a
plane through its depths, by the untrained network, and by the trained one.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader, Subset
from tqdm import tqdm

import torchtransient as tt

KEY = "wall.to_world"
CAMERA_HEIGHT, FURTHEST_M, STEEPEST_DEG = 4.0, 0.3, 20.0
AXIS = tt.TimeAxis(7.0, 0.03, 64)
SIZE, SIGNAL, AMBIENT = 6, 4.0, 13.0  # pixels per side; photons of a pixel, in the mean
FIELD_DEG, LIGHT_X = 10.0, 0.5
FWHM_OPL = 0.1  # of the response of the detector
RESPONSE = tt.Pulse.gaussian(FWHM_OPL)


@dataclass(frozen=True)
class Sizes:
    """``train``, ``test``: walls. ``batch``: walls of a step, of all ranks together. ``spp``: of the renders in it."""

    train: int = 512
    test: int = 128
    steps: int = 400
    batch: int = 16
    spp: int = 16
    test_spp: int = 256


SMOKE = Sizes(train=32, test=16, steps=20, batch=4, spp=4)


def walls(spp: int) -> tt.data.Recipe:
    """Walls 3.7 to 4.3 m before the camera, tilted by up to 20 degrees."""
    data = tt.data
    shifted = data.Offset([0.0, 0.0, -FURTHEST_M], [0.0, 0.0, FURTHEST_M])
    pose = data.Compose([data.Turn([0, 1, 0], -STEEPEST_DEG, STEEPEST_DEG), shifted])
    return data.Recipe(scene(), {KEY: pose}, time_axis=AXIS, spp=spp, variant="llvm_ad_mono", irf=RESPONSE)


def scene() -> dict[str, object]:
    return tt.scenes.moving_wall(resolution=SIZE, max_depth=2)


def wall_to_world(distance: Tensor, tilt_deg: Tensor) -> Tensor:
    """(B,) metres and degrees -> (B, 4, 4): a wall so far before the camera, turned about the y axis."""
    angle = torch.deg2rad(tilt_deg)
    c, s, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    entries = [c, zero, s, zero, zero, one, zero, zero, -s, zero, c, CAMERA_HEIGHT - distance, zero, zero, zero, one]
    return torch.stack(entries, dim=1).reshape(-1, 4, 4)


def truth_of(to_world: Tensor) -> tuple[Tensor, Tensor]:
    """The inverse: distances and tilts of walls."""
    tilt = torch.rad2deg(torch.atan2(to_world[:, 0, 2], to_world[:, 0, 0]))
    return CAMERA_HEIGHT - to_world[:, 2, 3], tilt


def expected_counts(transient: Tensor) -> Tensor:
    """Photons a bin, ambient light included, of transients (B, 1, T, H, W) of any brightness."""
    share = transient / transient.sum((2, 3, 4), keepdim=True)
    return SIGNAL * SIZE**2 * share + AMBIENT / AXIS.num_bins


class Reader(nn.Module):
    """Distances, tilts and the counts that they would give, of counts (B, 1, T, H, W)."""

    def __init__(self, spp: int) -> None:
        super().__init__()
        described = tt.load(scene(), variant="llvm_ad_mono")
        self.renderer = tt.TransientRenderer(described, [KEY], spp=spp, time_axis=AXIS, irf=RESPONSE)
        # The pose that the scene is described with is replaced at each call, and learns nothing.
        self.renderer.requires_grad_(False)
        inner = nn.Linear(AXIS.num_bins * SIZE**2, 128)
        self.network = nn.Sequential(nn.Flatten(), inner, nn.SiLU(), nn.Linear(128, 2), nn.Tanh())

    def propose(self, counts: Tensor) -> tuple[Tensor, Tensor]:
        found = self.network(counts.sqrt() - 0.4)
        return CAMERA_HEIGHT + 1.2 * FURTHEST_M * found[:, 0], 1.2 * STEEPEST_DEG * found[:, 1]

    def forward(self, counts: Tensor, seeds: list[int]) -> Tensor:
        out = self.renderer({KEY: wall_to_world(*self.propose(counts))}, seed=seeds)
        return expected_counts(out.transient)


def measured(batch: dict[str, Tensor], seeds: tt.training.Seeds, step: int) -> Tensor:
    """Counts of a batch: each wall has noise of its own, whichever rank has it."""
    mean = expected_counts(batch["transient"])
    drawn = [torch.poisson(m, seeds.generator(step, int(n))) for m, n in zip(mean, batch["index"], strict=True)]
    return torch.stack(drawn)


def plane_fit(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Distances and tilts of the plane through the peaks of a matched filter, by least squares: no network."""
    bins = torch.arange(-4, 5) * AXIS.bin_width_opl * 2.355 / FWHM_OPL
    kernel = torch.exp(-0.5 * bins.square()).reshape(1, 1, -1)
    histograms = counts[:, 0].permute(0, 2, 3, 1).reshape(-1, 1, AXIS.num_bins)
    highest = nn.functional.conv1d(histograms, kernel, padding=4).argmax(-1).reshape(len(counts), -1)
    opl = AXIS.start_opl + AXIS.bin_width_opl * (highest + 0.5)
    tangent = (2 * torch.arange(SIZE) + 1 - SIZE) / SIZE * torch.tan(torch.deg2rad(torch.tensor(FIELD_DEG / 2)))
    across, along = tangent.repeat(SIZE), tangent.repeat_interleave(SIZE)
    forward = 1 / (1 + across.square() + along.square()).sqrt()
    # A point at range r in the direction u has the length r + |r u - b|, with the light at b beside the camera.
    length = (opl.square() - LIGHT_X**2) / (2 * (opl - LIGHT_X * across * forward))
    depth = length * forward
    rows = torch.stack([torch.ones_like(depth), depth * across], dim=2)
    found = torch.linalg.lstsq(rows, depth.unsqueeze(2)).solution[:, :, 0]
    return found[:, 0], torch.rad2deg(torch.atan(found[:, 1]))


def errors_of(found: tuple[Tensor, Tensor], truth: tuple[Tensor, Tensor]) -> tuple[float, float]:
    """Mean absolute errors: of the distance in millimetres, of the tilt in degrees."""
    distance, tilt = ((a - b).abs().mean().item() for a, b in zip(found, truth, strict=True))
    return 1e3 * distance, tilt


def train(options: argparse.Namespace, sizes: Sizes, ranks: tt.training.Ranks, seed: int) -> dict[str, object]:
    """One run, or what is left of it; returns errors by method, and the losses."""
    recipe, count = walls(sizes.test_spp), sizes.test + sizes.train
    folder = options.output / f"train_ddp-{recipe.key()[:8]}-{count}"
    if ranks.is_first:
        tt.data.generate(recipe, folder, count, workers=1)
    ranks.wait()
    data = tt.data.TransientDataset(folder)
    is_test = data.index < sizes.test
    seeds = tt.training.Seeds(seed)
    test = next(iter(DataLoader(Subset(data, is_test.nonzero()[:, 0].tolist()), batch_size=sizes.test)))
    counts, truth = measured(test, tt.training.Seeds(0, "test"), 0), truth_of(test["values"][KEY])

    torch.manual_seed(seed)
    model = Reader(sizes.spp)
    with torch.no_grad():
        found = {"plane fit": plane_fit(counts), "untrained": model.propose(counts)}
    learnt_from = Subset(data, (~is_test).nonzero()[:, 0].tolist())
    optimizer = torch.optim.Adam(model.network.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=sizes.steps)
    batches = tt.training.Batches(
        len(learnt_from), sizes.batch, seed=seed, rank=ranks.rank, world_size=ranks.size
    )
    parts = {"model": model, "optimizer": optimizer, "schedule": schedule, "batches": batches}
    path, losses = options.output / f"train_ddp-{sizes.steps}-{seed}.pt", []
    if path.exists():
        # Nothing here draws from torch's own generators: any number of ranks may go on.
        kept = tt.training.load_checkpoint(path, parts, random=False)
        losses = kept.values["losses"]
    wrapped = DistributedDataParallel(model) if ranks.size > 1 else model
    left, loader = range(batches.step, sizes.steps), DataLoader(learnt_from, batch_sampler=batches)
    bar = tqdm(zip(left, loader, strict=False), f"train_ddp {seed}", len(left), disable=not ranks.is_first)
    for step, batch in bar:
        seen = measured(batch, seeds, step)
        loss = tt.losses.wasserstein_loss(wrapped(seen, seeds(step, batch["index"])), seen, AXIS.bin_width_opl)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(ranks.mean(loss.item()))
        batches.step = step + 1
        if batches.step % options.every == 0 or batches.step == sizes.steps:
            tt.training.save_checkpoint(path, parts, step=batches.step, values={"losses": losses})
        bar.set_postfix(loss=f"{losses[-1]:.4f}")
    with torch.no_grad():
        found["trained by the renderer"] = model.propose(counts)
    errors = {name: errors_of(of, truth) for name, of in found.items()}
    return {"errors": errors, "losses": losses, "found": found, "truth": truth}


def draw(result: dict[str, object], path: Path) -> None:
    """Distance and tilt found over true, and the loss."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.2), layout="constrained")
    axes = figure.subplots(1, 3)
    shown = {"plane fit": "0.6", "trained by the renderer": "tab:blue"}
    for n, (name, unit, low, high) in enumerate((("distance", "m", 3.65, 4.35), ("tilt", "degrees", -23, 23))):
        for method, colour in shown.items():
            axes[n].plot(result["truth"][n], result["found"][method][n], ".", color=colour, ms=4, label=method)
        axes[n].plot([low, high], [low, high], color="black", lw=0.8)
        axes[n].set(xlim=(low, high), ylim=(low, high), xlabel=f"true {name} [{unit}]", ylabel=f"found [{unit}]")
    axes[0].legend(fontsize=8)
    axes[2].plot(result["losses"], color="tab:blue", lw=0.8)
    axes[2].set(xlabel="step", ylabel="Wasserstein-1 to the counts [m]", title="no labels in the loss")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def main(argv: Sequence[str] | None = None) -> dict[str, tuple[float, float]]:
    """Command line; returns the errors by method of the last run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="a run for each (0)")
    parser.add_argument("--every", type=int, default=100, help="steps between checkpoints (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for all files (%(default)s)")
    options = parser.parse_args(argv)
    with tt.training.ranks(threads=1) as ranks:  # films so small are not worth several
        for seed in options.seeds:
            result = train(options, SMOKE if options.smoke else Sizes(), ranks, seed)
            if ranks.is_first:
                for name, (millimetres, degrees) in result["errors"].items():
                    print(f"seed {seed}, {name:<24}{millimetres:8.1f} mm{degrees:8.2f} degrees")
        if ranks.is_first:
            draw(result, options.output / "train_ddp.png")
            print(f"train_ddp: {options.output / 'train_ddp.png'}")
    return result["errors"]


if __name__ == "__main__":
    main()
