"""Multipath off an indirect time-of-flight camera: a small U-Net trained on rendered rooms, against the phase alone.

Light that came over two or more walls is late, and an amplitude-modulated camera cannot tell it from the light of its
pixel: corners are rounded off and everything is too far by centimetres, by less at high frequencies. A recipe builds
rooms of many sizes and paints with two boxes, seen by `tt.sensing.device("kinect_v2_like")` (differences of two taps,
three frequencies with three phase steps, noise, 10 bits). The network sees phases and amplitudes of all frequencies
and corrects the unwrapped depth.

    python training_examples/itof_multipath.py --output demo_output

Prints errors of the depth in millimetres in rooms that the network has not learnt from: the lowest frequency alone, all
three (the phase depth that a driver reports), that minus its mean error in the rooms to learn from, the network, and
the same camera in rooms whose light ends after one bounce, where only noise is left.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.data import DataLoader
from tqdm import tqdm

import torchtransient as tt
from torchtransient import sensing

AXIS = tt.TimeAxis(1.0, 0.05, 400)  # 0.5 to 10.5 m
FREQUENCIES = (120e6, 80e6, 16e6)
EYE, FARTHEST_M = [0.0, 0.0, 3.0], 5.5
# Rooms to learn from and for the test, pixels per side and samples of one; steps, rooms of a step, channels.
FULL = argparse.Namespace(train=600, test=64, resolution=32, spp=128, steps=1000, batch=16, channels=16)
SMOKE = argparse.Namespace(train=24, test=8, resolution=16, spp=32, steps=80, batch=8, channels=12)


def rooms(sizes: argparse.Namespace, max_depth: int = 6) -> tt.data.Recipe:
    """The recipe; ``max_depth=2`` has the same rooms without multipath."""
    data, at = tt.data, tt.scenes.transforms
    scene = tt.scenes.cornell_box(sizes.resolution, max_depth=max_depth)
    scene["light"] = {"type": "point", "position": EYE, "intensity": 1.0}
    moved = data.Compose([data.Turn(), data.Offset([-0.5, 0.0, -0.4], [0.5, 0.0, 0.8])])
    vary = {
        "sensor.to_world": data.LookAt(EYE, data.Uniform([-0.7, -0.6, -1.0], [0.7, 0.5, -1.0])),
        "light.intensity.value": data.LogUniform(40.0, 160.0),
        "small-box.to_world": moved,
        "large-box.to_world": moved,
        **{f"{paint}.reflectance.value": data.Uniform(0.2, 0.9) for paint in ("white", "red", "green")},
    }
    for name, low, high in (
        ("floor", [0, 0, 0], [0, 0, 0]), ("ceiling", [0, 0, 0], [0, 0.6, 0]), ("back", [0, 0, -0.8], [0, 0, 0]),
        ("green-wall", [0, 0, 0], [0.6, 0, 0]), ("red-wall", [-0.6, 0, 0], [0, 0, 0]),
    ):  # fmt: skip
        scene[name]["to_world"] = scene[name]["to_world"] @ at.scale([3.0, 3.0, 1.0])  # no gaps where walls have moved
        vary[f"{name}.to_world"] = data.Offset(low, high)
    return data.Recipe(
        scene, vary, time_axis=AXIS, temporal_filter="tent", spp=sizes.spp, labels=["depth"], device="kinect_v2_like",
        keep=["measurement", "depth"], variant="llvm_ad_mono",
    )  # fmt: skip


def generated(recipe: tt.data.Recipe, count: int, options: argparse.Namespace) -> tuple[Tensor, Tensor]:
    """Differences (N, 1, 9, H, W) in electrons, and depth (N, 1, H, W) in metres."""
    folder = options.output / f"itof_multipath-{recipe.key()[:8]}-{count}"
    print(tt.data.generate(recipe, folder, count, workers=options.workers))
    whole = next(iter(DataLoader(tt.data.TransientDataset(folder), batch_size=count)))
    return whole["measurement"], whole["depth"].unsqueeze(1)


def read(taps: Tensor) -> sensing.ItofReading:
    """Phases and amplitudes of three frequencies, unwrapped to one depth."""
    return sensing.read_itof(taps, FREQUENCIES, 3, readout="differential", max_depth_m=FARTHEST_M)


def convolution(before: int, after: int) -> nn.Module:
    """Of 3 x 3 pixels, and its activation."""
    return nn.Sequential(nn.Conv2d(before, after, 3, padding=1), nn.SiLU())


class Coarser(nn.Sequential):
    """Layers at half the resolution; what they make stands behind what they were given."""

    def forward(self, x: Tensor) -> Tensor:
        made = super().forward(functional.avg_pool2d(x, 2))
        return torch.cat([x, functional.interpolate(made, x.shape[-2:])], 1)


class MultipathNetwork(nn.Module):
    """Depth (B, 1, H, W) from differences (B, 1, 9, H, W): the unwrapped depth and what a U-Net adds to it."""

    def __init__(self, c: int) -> None:
        super().__init__()
        inmost = Coarser(convolution(4 * c, 4 * c), convolution(4 * c, 4 * c))
        inner = Coarser(convolution(2 * c, 4 * c), inmost, convolution(8 * c, 4 * c))
        middle = Coarser(convolution(c, 2 * c), inner, convolution(6 * c, 2 * c))
        self.layers = nn.Sequential(convolution(10, c), middle, convolution(3 * c, c), nn.Conv2d(c, 1, 1))
        nn.init.zeros_(self.layers[-1].weight)
        nn.init.zeros_(self.layers[-1].bias)

    def forward(self, taps: Tensor) -> Tensor:
        """What frequencies say beyond the depth: how far their phases are from its own, amplitudes."""
        reading = read(taps)
        depth = reading.depth_m
        frequencies = reading.phase.new_tensor(FREQUENCIES).reshape(-1, 1, 1)
        late = reading.phase.squeeze(1) - 2 * torch.pi * frequencies * tt.units.opl_to_seconds(2 * depth)
        amplitude = reading.amplitude.squeeze(1).clamp_min(1.0).log()
        ratios = amplitude[:, 1:] - amplitude[:, :1]
        features = [late.cos(), late.sin(), ratios, amplitude[:, :1] - 7, depth - 3]
        return depth + self.layers(torch.cat(features, 1)) / 10


def train(taps: Tensor, depth: Tensor, sizes: argparse.Namespace, generator: torch.Generator) -> MultipathNetwork:
    """Absolute error of the depth; rooms and their mirror images."""
    network = MultipathNetwork(sizes.channels)
    optimizer = torch.optim.Adam(network.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, total_steps=sizes.steps)
    for step in (bar := tqdm(range(sizes.steps), desc="itof_multipath", unit="step")):
        taken = torch.randint(len(taps), (sizes.batch,), generator=generator)
        side = [-1] if step % 2 else []
        loss = (network(taps[taken].flip(side)) - depth[taken].flip(side)).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)  # wrong turns of a phase are errors of metres
        optimizer.step()
        schedule.step()
        bar.set_postfix(error_mm=f"{1000 * loss.item():.1f}")
    return network


def phase_depth(taps: Tensor) -> Tensor:
    """What a driver reports: three frequencies, unwrapped."""
    return read(taps).depth_m


def lowest(taps: Tensor) -> Tensor:
    """Depth of the only frequency that needs no unwrapping."""
    return sensing.depth_of_phase(read(taps).phase[:, :, 2], FREQUENCIES[2])


def errors_of(found: Tensor, depth: Tensor) -> list[float]:
    """Mean and median in millimetres, per cent off by more than 10 cm."""
    pair = (found, depth)
    mean, median = tt.metrics.depth_mae(*pair), tt.metrics.depth_median_error(*pair)
    return [1000 * float(mean), 1000 * float(median), 100 * float(tt.metrics.depth_gross_errors(*pair, beyond_m=0.1))]


def draw(found: dict[str, Tensor], depth: Tensor, path: Path) -> None:
    """Depth, and errors of every method, in three rooms."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.5 * len(found) + 2.7, 6.6), layout="constrained")
    for row, line in enumerate(figure.subplots(3, len(found) + 1)):
        images = {"depth": depth, **{name: 1000 * (estimate - depth) for name, estimate in found.items()}}
        for axes, (name, image) in zip(line, images.items(), strict=True):
            limits = {"vmin": 1.0, "vmax": 5.0} if name == "depth" else {"cmap": "RdBu_r", "vmin": -150, "vmax": 150}
            drawn = axes.imshow(image[row, 0].numpy(), **limits)
            axes.set(title=name if row == 0 else "", xticks=[], yticks=[])
            if row == 2 and name in ("depth", list(images)[-1]):
                label = "m" if name == "depth" else "error in mm"
                figure.colorbar(drawn, ax=line[0] if name == "depth" else line[1:], label=label, location="bottom")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
    print(f"itof_multipath: {path}")


def main(argv: Sequence[str] | None = None) -> list[dict[str, list[float]]]:
    """Command line; returns the table of every seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="weights and order (%(default)s)")
    parser.add_argument("--workers", type=int, default=2, help="processes that render (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for all files (%(default)s)")
    options = parser.parse_args(argv)
    sizes = SMOKE if options.smoke else FULL
    taps, depth = generated(rooms(sizes), sizes.test + sizes.train, options)
    direct, _ = generated(rooms(sizes, max_depth=2), sizes.test, options)
    test, truth, taps, depth = taps[: sizes.test], depth[: sizes.test], taps[sizes.test :], depth[sizes.test :]
    bias = (phase_depth(taps) - depth).median()
    known = {"16 MHz alone": lowest(test), "three frequencies": phase_depth(test)}
    known |= {"less their bias": known["three frequencies"] - bias, "no multipath": phase_depth(direct)}
    tables = []
    for seed in options.seeds:
        torch.manual_seed(seed)
        network = train(taps, depth, sizes, torch.Generator().manual_seed(seed))
        with torch.no_grad():
            found = {**known, "network": network(test)}
        tables.append({name: errors_of(estimate, truth) for name, estimate in found.items()})
        print(f"seed {seed:<16}mean error  median, mm  > 10 cm, %")
        for name, row in tables[-1].items():
            print(f"{name:<18}" + "".join(f"{value:12.1f}" for value in row))
    draw({name: found[name] for name in ("three frequencies", "network")}, truth, options.output / "itof_multipath.png")
    return tables


if __name__ == "__main__":
    main()
