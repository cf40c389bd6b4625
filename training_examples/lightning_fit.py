"""The renderer in a LightningModule: the network of `train_ddp.py`, trained by Lightning.

Lightning has the loop, the progress bar, checkpoints and the gradients of several batches in one step. The order of
samples (`tt.training.Batches`), seeds of renders and noise (`tt.training.Seeds`) are functions of the step, so that a
run that goes on from a checkpoint ends with the weights of one that was not stopped. Its batches are quarters of those
of `train_ddp.py`, four of them to a step: it learns from the same walls with the same random numbers.

    python training_examples/lightning_fit.py --seeds 0 1 2
    python training_examples/lightning_fit.py --stop 200; python training_examples/lightning_fit.py   # goes on

Prints the mean errors of distance and tilt on walls that the network has not learnt from: by a matched filter and a
plane through its depths, by the untrained network, and by the trained one. Needs `torchtransient[lightning]`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import ModelCheckpoint, TQDMProgressBar
from tilted_walls import (
    AXIS,
    KEY,
    NETWORK,
    PIXELS,
    PLANE,
    SMOKE,
    UNTRAINED,
    Reader,
    Sizes,
    folder_of,
    loss_of,
    measured,
    plane_fit,
    report,
    truth_of,
    wall_to_world,
)
from torch import Tensor
from torch.utils.data import DataLoader, Subset

import torchtransient as tt

PARTS = 4  # batches of a step


class WallReader(lightning.LightningModule):
    """Network and renderer; ``losses`` by step."""

    def __init__(self, sizes: Sizes, data: tt.data.TransientDataset, seed: int) -> None:
        super().__init__()
        self.sizes, self.seeds = sizes, tt.training.Seeds(seed)
        is_test = data.index < sizes.test
        self.learnt_from = Subset(data, (~is_test).nonzero()[:, 0].tolist())
        self.batches = tt.training.Batches(len(self.learnt_from), sizes.batch // PARTS, seed=seed)
        self.reader = Reader(sizes.spp)
        self.losses: list[float] = []

    def train_dataloader(self) -> DataLoader[Any]:
        return self.batches.loader(self.learnt_from)

    def training_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        # The loader has no end, and Lightning counts batches through restarts.
        step = batch_idx // PARTS
        seen = measured(batch, self.seeds, step)
        loss = loss_of(step / self.sizes.steps, self.reader(seen, self.seeds(step, batch["index"])), seen)
        if batch_idx % PARTS == 0:
            self.losses.append(0.0)
        self.losses[-1] += loss.item() / PARTS
        self.log("loss", loss.detach(), prog_bar=True, batch_size=len(seen))
        return loss

    def configure_optimizers(self) -> dict[str, Any]:
        optimizer = torch.optim.Adam(self.reader.propose.parameters(), lr=3e-3)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=self.sizes.steps)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.batches.step = self.global_step * PARTS
        checkpoint |= {"batches": self.batches.state_dict(), "losses": self.losses}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Lightning calls this before it asks for an iterator of the loader."""
        self.batches.load_state_dict(checkpoint["batches"])
        self.losses = list(checkpoint["losses"])


def train(options: argparse.Namespace, sizes: Sizes, seed: int) -> WallReader:
    """One run, or what is left of it."""
    data = tt.data.TransientDataset(folder_of(options.output, sizes))
    torch.manual_seed(seed)
    module = WallReader(sizes, data, seed)
    test = DataLoader(Subset(data, (data.index < sizes.test).nonzero()[:, 0].tolist()), batch_size=sizes.test)
    batch = next(iter(test))
    counts, truth = measured(batch, tt.training.Seeds(0, "test"), 0), truth_of(batch["values"][KEY])
    with torch.no_grad():
        found = {PLANE: plane_fit(counts), UNTRAINED: module.reader.propose(counts)}

    name = f"lightning_fit-{sizes.steps}-{seed}"
    path = options.output / f"{name}.ckpt"
    writer = ModelCheckpoint(
        options.output, name, every_n_train_steps=options.every, save_top_k=1, enable_version_counter=False
    )
    trainer = lightning.Trainer(
        accelerator="cpu", devices=1, max_steps=min(options.stop or sizes.steps, sizes.steps), max_epochs=-1,
        accumulate_grad_batches=PARTS, callbacks=[writer, TQDMProgressBar()], logger=False,
        use_distributed_sampler=False, default_root_dir=options.output, enable_model_summary=False,
    )  # fmt: skip
    begin = time.process_time()
    trainer.fit(module, ckpt_path=path if path.exists() else None)
    with torch.no_grad():
        found[NETWORK] = module.reader.propose(counts)
    report(f"seed {seed}", found, truth)
    print(f"seed {seed}, {time.process_time() - begin:.0f} s of the CPU for {trainer.global_step} steps")
    draw(batch["transient"], counts, module.reader, options.output / "lightning_fit.png")
    return module


def columns(transient: Tensor) -> Tensor:
    """Mean optical path (B, W) of the light of each column of pixels, of transients (B, 1, T, H, W)."""
    light = transient.sum((1, 3))
    times = AXIS.start_opl + AXIS.bin_width_opl * (torch.arange(AXIS.num_bins) + 0.5)
    return (light * times[:, None]).sum(1) / light.sum(1)


def draw(light: Tensor, counts: Tensor, reader: Reader, path: Path) -> None:
    """Four walls: counts by column and time, where their light is, and where that of the proposed wall is."""
    from matplotlib.figure import Figure

    chosen = torch.arange(4)
    with torch.no_grad():
        pose = wall_to_world(*reader.propose(counts[chosen]))
        proposed = columns(reader.renderer({KEY: pose}, seed=0, spp=256).transient)
    figure = Figure(figsize=(10, 3.3), layout="constrained")
    end = AXIS.start_opl + AXIS.bin_width_opl * AXIS.num_bins
    for n, axes in enumerate(figure.subplots(1, len(chosen), sharey=True)):
        image = counts[n].sum((0, 2))
        extent = (-0.5, PIXELS - 0.5, AXIS.start_opl, end)
        drawn = axes.imshow(image, cmap="gray_r", vmin=0, vmax=12, aspect="auto", origin="lower", extent=extent)
        axes.plot(columns(light[n : n + 1])[0], color="tab:orange", lw=3, label="true wall")
        axes.plot(proposed[n], color="tab:blue", ls="--", label="network's wall")
        axes.set(xlabel="column of pixels", ylim=(7.1, 8.9))
    figure.axes[0].set_ylabel("optical path length [m]")
    figure.axes[0].legend(fontsize=8, loc="lower left")
    figure.colorbar(drawn, ax=figure.axes, label="counts of a column")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def main(argv: Sequence[str] | None = None) -> WallReader:
    """Command line; returns the module of the last run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="a run for each (0)")
    parser.add_argument("--stop", type=int, help="end after so many steps, as if it had been killed there")
    parser.add_argument("--every", type=int, default=100, help="steps between checkpoints (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for all files (%(default)s)")
    options = parser.parse_args(argv)
    options.output.mkdir(parents=True, exist_ok=True)
    with tt.threads(1):  # films so small are not worth several
        for seed in options.seeds:
            module = train(options, SMOKE if options.smoke else Sizes(), seed)
    print(f"lightning_fit: {options.output / 'lightning_fit.png'}")
    return module


if __name__ == "__main__":
    main()
