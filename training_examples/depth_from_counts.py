"""Depth from a few photons: a small network trained on a data set of rendered rooms, against a matched filter.

A recipe moves two boxes in a Cornell box, changes its paint, and has a flash beside the camera seen by a photon counter
in ambient light of unknown strength. The data set is generated on disk (again only where it is missing) and read by a
`DataLoader`; with `--online` the scenes that the network learns from are rendered while it learns, and each is new.

    python training_examples/depth_from_counts.py --seeds 0 1 2 --output demo_output
    python training_examples/depth_from_counts.py --online

Prints the mean error of the depth in millimetres, and how many pixels are more than 10 cm off, on scenes that the
network has not learnt from, for each seed: the highest bin, the matched filter, the network before and after.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Subset
from tqdm import tqdm

import torchtransient as tt
from torchtransient import sensing

AXIS = tt.TimeAxis(5.0, 0.05, 160)  # 167 ps a bin, there and back: 2.5 to 6.5 m
RESPONSE_FWHM_S = 250e-12
CYCLES = 1000
FAR_OFF_M = 0.1


@dataclass(frozen=True)
class Sizes:
    """``train``, ``test``: scenes. ``resolution``: pixels per side. ``batch``: scenes of a step."""

    train: int = 480
    test: int = 32
    resolution: int = 32
    spp: int = 64
    steps: int = 600
    batch: int = 4
    channels: int = 64


SMOKE = Sizes(train=24, test=4, resolution=12, spp=16, steps=60, batch=4, channels=16)


@dataclass(frozen=True)
class Errors:
    """Mean absolute error in millimetres, of all pixels and of the moving boxes; share of the pixels far off."""

    all_mm: float
    boxes_mm: float
    far_off: float


def counter() -> sensing.Device:
    """What looks at the room: about 10 photons of the flash and as many of the ambient light in a pixel."""
    stages = [
        {"kind": "ImpulseResponse", "axis": "@axis",
         "response": {"kind": "GaussianResponse", "fwhm_s": RESPONSE_FWHM_S}},
        {"kind": "PhotonBudget", "optics": {"kind": "Optics", "f_number": 2.0, "pixel_area_m2": 1e-10},
         "pulse_energy_j": 1e-9, "wavelength_m": 940e-9, "repetition_rate_hz": 1e6, "cycles": CYCLES,
         "quantum_efficiency": 0.2, "ambient_rate_hz": 2e6, "axis": "@axis"},
        {"kind": "SynchronousSPAD", "cycles": CYCLES},
    ]  # fmt: skip
    return sensing.Device(
        "counter",
        description="A first-photon counter behind a small lens.",
        sources=["assumed: all numbers"],
        stages=stages,
    )


def room(sizes: Sizes) -> tt.data.Recipe:
    """The recipe. Samples 0 to ``test`` - 1 are for the test, those after them for the training."""
    data = tt.data
    scene = tt.scenes.cornell_box(resolution=sizes.resolution, max_depth=4)
    scene["light"] = {"type": "point", "position": [0.0, 0.0, 3.9], "intensity": 60.0}
    moved = data.Compose([data.Turn(), data.Offset([-0.4, 0.0, -0.4], [0.4, 0.0, 0.6])])
    return data.Recipe(
        scene,
        {
            "small-box.to_world": moved,
            "large-box.to_world": moved,
            "white.reflectance.value": data.Uniform(0.2, 0.9),
            "device.PhotonBudget.ambient_rate_hz": data.LogUniform(5e5, 5e6),
        },
        time_axis=AXIS, spp=sizes.spp, labels=["depth", "shape"], device=counter(),
        keep=["measurement", "depth", "shape"], variant="llvm_ad_mono",
    )  # fmt: skip


class DepthNetwork(nn.Module):
    """Scores (B, 1, T, H, W) of every bin from counts (B, 1, T, H, W): those of the matched filter, and what the
    network adds to them, which is nothing in the beginning. Bins are channels of images.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        last = nn.Conv2d(channels, AXIS.num_bins, 1)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(
            nn.Conv2d(2 * AXIS.num_bins, channels, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(channels, channels, 3, padding=2, dilation=2),
            nn.SiLU(),
            nn.Conv2d(channels, channels, 3, padding=4, dilation=4),
            nn.SiLU(),
            last,
        )

    def forward(self, counts: Tensor) -> Tensor:
        """A softmax over time makes probabilities of them."""
        scores = matched(counts)
        relative = scores - scores.mean(2, keepdim=True)
        relative = relative / relative.std(2, keepdim=True).clamp_min(1e-3)
        return scores + self.layers(torch.cat([relative, counts.sqrt()], dim=2).squeeze(1)).unsqueeze(1)


def matched(counts: Tensor) -> Tensor:
    """Log-likelihood of a return at every bin, for the counter's response."""
    first, kernel = sensing.GaussianResponse(fwhm_s=RESPONSE_FWHM_S).kernel(AXIS.bin_width_s)
    return sensing.log_matched_filter(counts, kernel.to(counts), first, signal_to_background=1.0)


def depth_at(position: Tensor) -> Tensor:
    """Metres from the camera, of a position in bins (first bin: 0 to 1)."""
    return (AXIS.start_opl + AXIS.bin_width_opl * position) / 2


def depth_of(scores: Tensor) -> Tensor:
    """(B, 1, H, W) metres: the mean within three bins of the likeliest one."""
    return depth_at(sensing.center_of_mass(torch.softmax(scores, dim=2), half_width_bins=3))


def estimates(network: DepthNetwork, counts: Tensor) -> dict[str, Tensor]:
    """Depths (B, H, W) by every method."""
    with torch.no_grad():
        found = {
            "highest bin": depth_at(counts.argmax(2) + 0.5),
            "matched filter": depth_at(sensing.peak_position(matched(counts))),
            "network": depth_of(network(counts)),
        }
    return {name: depth.squeeze(1) for name, depth in found.items()}


def loss_of(network: DepthNetwork, counts: Tensor, depth: Tensor) -> Tensor:
    """Cross-entropy against a narrow bump at the true bin, of pixels that look at something."""
    there = depth.isfinite()
    position = (2 * depth.nan_to_num(AXIS.start_opl) - AXIS.start_opl) / AXIS.bin_width_opl
    bins = torch.arange(AXIS.num_bins).reshape(-1, 1, 1) + 0.5
    target = torch.softmax(-0.5 * (bins - position.unsqueeze(1)).square(), dim=1)
    log_probability = torch.log_softmax(network(counts).squeeze(1), dim=1)
    return -(target * log_probability).sum(1)[there].mean()


def train(network: DepthNetwork, batches: Iterator[dict[str, Tensor]], steps: int) -> list[float]:
    """Adam; returns the losses."""
    optimizer = torch.optim.Adam(network.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, total_steps=steps)
    losses = []
    for batch in (bar := tqdm(itertools.islice(batches, steps), desc="depth_from_counts", unit="step", total=steps)):
        loss = loss_of(network, batch["measurement"], batch["depth"])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
        bar.set_postfix(loss=f"{losses[-1]:.3f}")
    return losses


def errors_of(found: dict[str, Tensor], depth: Tensor, on_boxes: Tensor) -> dict[str, Errors]:
    """By method. ``depth``, ``on_boxes``: (B, H, W)."""
    errors = {}
    for name, estimate in found.items():
        everywhere, boxes = (tt.metrics.depth_mae(estimate, depth, mask=mask) for mask in (None, on_boxes))
        far = tt.metrics.depth_gross_errors(estimate, depth, beyond_m=FAR_OFF_M)
        errors[name] = Errors(1000 * float(everywhere), 1000 * float(boxes), float(far))
    return errors


def draw(found: dict[str, Tensor], batch: dict[str, Tensor], losses: list[float], path: Path) -> None:
    """Three scenes by every method, and the loss."""
    from matplotlib.figure import Figure

    shown = {"counts": batch["measurement"].sum(2).squeeze(1), "depth": batch["depth"], **found}
    rows = min(3, len(batch["depth"]))
    figure = Figure(figsize=(2.3 * len(shown), 2.3 * rows + 2.2), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=[rows, 1])
    for n, line in enumerate(upper.subplots(rows, len(shown), squeeze=False)):
        for axes, (name, image) in zip(line, shown.items(), strict=True):
            limits = {"cmap": "gray"} if name == "counts" else {"vmin": 2.7, "vmax": 5.2, "cmap": "viridis"}
            drawn = axes.imshow(image[n], **limits)
            axes.set(title=name if n == 0 else "", xticks=[], yticks=[])
    upper.colorbar(drawn, ax=upper.axes, label="depth in m")
    curve, histogram = lower.subplots(1, 2)
    curve.plot(losses, color="0.4")
    curve.set(title="training", xlabel="step", ylabel="cross-entropy")
    middle = batch["depth"].shape[-1] // 2
    histogram.step(AXIS.centers_opl / 2, batch["measurement"][0, 0, :, middle, middle], where="mid", color="0.4")
    histogram.axvline(batch["depth"][0, middle, middle].item(), color="tab:red", lw=1)
    histogram.set(title="middle pixel of the first scene, and its depth", xlabel="half the path in m", ylabel="counts")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)


def main(argv: Sequence[str] | None = None) -> list[dict[str, Errors]]:
    """Command line; returns the errors by method, of every seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds")
    parser.add_argument("--online", action="store_true", help="render the scenes to learn from meanwhile")
    parser.add_argument("--scenes", type=int, help=f"to learn from ({Sizes.train})")
    parser.add_argument("--steps", type=int, help=f"steps of training ({Sizes.steps})")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="weights and order of scenes (%(default)s)")
    parser.add_argument("--workers", type=int, default=2, help="processes that render (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for all files (%(default)s)")
    options = parser.parse_args(argv)
    base = SMOKE if options.smoke else Sizes()
    sizes = Sizes(**vars(base) | {
        "train": options.scenes or base.train, "steps": options.steps or base.steps,
    })  # fmt: skip

    recipe = room(sizes)
    count = sizes.test if options.online else sizes.test + sizes.train
    folder = options.output / f"depth_from_counts-{recipe.key()[:8]}-{count}"
    print(tt.data.generate(recipe, folder, count, workers=options.workers, store="counts"))
    dataset = tt.data.TransientDataset(folder)
    is_test = dataset.index < sizes.test
    test = next(iter(DataLoader(Subset(dataset, is_test.nonzero()[:, 0].tolist()), batch_size=sizes.test)))
    boxes = [number for number, name in enumerate(dataset.about["shapes"]) if name in ("small-box", "large-box")]
    on_boxes = torch.isin(test["shape"], torch.tensor(boxes))

    tables = []
    for seed in options.seeds:
        torch.manual_seed(seed)
        network = DepthNetwork(sizes.channels)
        before = errors_of(estimates(network, test["measurement"]), test["depth"], on_boxes)
        with ExitStack() as stack:
            if options.online:
                online = stack.enter_context(tt.data.OnlineDataset(
                    recipe, capacity=256, workers=options.workers, seed=seed, warm=sizes.batch, first=sizes.test,
                ))  # fmt: skip
                batches = iter(DataLoader(online, batch_size=sizes.batch))
            else:
                learnt_from = Subset(dataset, (~is_test).nonzero()[:, 0].tolist())
                loader = DataLoader(learnt_from, batch_size=sizes.batch, shuffle=True, drop_last=True)
                batches = itertools.chain.from_iterable(itertools.repeat(loader))
            losses = train(network, batches, sizes.steps)
        found = estimates(network, test["measurement"])
        errors = errors_of(found, test["depth"], on_boxes) | {"untrained": before["network"]}
        tables.append(errors)

        print(f"seed {seed}, {sizes.test} new scenes: error in mm, on boxes, off by more than {100 * FAR_OFF_M:.0f} cm")
        for name in ("highest bin", "matched filter", "untrained", "network"):
            of = errors[name]
            print(f"{name:<15}{of.all_mm:12.1f}{of.boxes_mm:10.1f}{of.far_off:12.1%}")
    picture = options.output / "depth_from_counts.png"
    draw(found, test, losses, picture)
    print(f"depth_from_counts: {picture}")
    return tables


if __name__ == "__main__":
    main()
