"""Depth from a SPAD in too much light: a small network trained on simulated pile-up, against Coates' correction.

A recipe puts three boxes before a slanted wall, with a flash beside the camera; its scenes are rendered once. Every
step gives some of them new photon rates, signal and background, and draws first-photon histograms from them
(`tt.sensing.SynchronousSPAD`). The network sees what a matched filter makes of Coates' estimate, the histogram, and
the share of cycles still armed, of a neighbourhood of pixels, and corrects the scores of the filter.

    python training_examples/spad_depth.py --output demo_output

Prints a table of errors on scenes that were not trained on, in millimetres, of pixels that see one surface and of all
(edges of boxes too): matched filter on the raw histogram, Coates and matched filter, network; by photons per cycle.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader
from tqdm import tqdm

import torchtransient as tt
from torchtransient import sensing

BINS = 128
AXIS = tt.TimeAxis.from_seconds(0.0, 100e-12, BINS)  # 12.8 ns: walls up to 1.9 m away
PULSE = sensing.GaussianResponse(300e-12)
MM_PER_BIN = AXIS.bin_width_opl / 2 * 1000
CYCLES = 300
SPAD = sensing.SynchronousSPAD(CYCLES)
PHOTONS = (0.3, 1.0, 3.0, 6.0)  # of signal and background together, per pixel and cycle, in the table
# Scenes to learn from and for the test, pixels per side, steps, scenes of a step, channels of the network.
FULL = argparse.Namespace(train=400, test=64, resolution=16, steps=400, batch=4, channels=8)
SMOKE = argparse.Namespace(train=24, test=8, resolution=12, steps=20, batch=2, channels=4)


def boxes_before_a_wall(resolution: int) -> tt.data.Recipe:
    """The recipe. Direct light and what came over one more surface, as the box filter of a histogram has it."""
    data, at = tt.data, tt.scenes.transforms
    scene = tt.scenes.moving_wall(resolution=resolution, max_depth=3)  # the camera looks down from z = 4
    scene["sensor"]["fov"], scene["light"]["position"] = 45.0, [0.01, 0.0, 4.0]
    scene["wall"]["to_world"] = at.translate([0, 0, 2.75]) @ at.scale(3.0)
    tilted = [data.Turn([1, 0, 0], -8, 8), data.Turn([0, 1, 0], -8, 8), data.Offset([0, 0, -0.2], [0, 0, 0.2])]
    vary = {"wall.to_world": data.Compose(tilted), "wall.bsdf.reflectance.value": data.Uniform(0.3, 0.95)}
    anywhere = data.Offset([-0.3, -0.3, -0.2], [0.3, 0.3, 0.3])
    for name in ("box-1", "box-2", "box-3"):
        grey = {"type": "diffuse", "reflectance": 0.5}
        scene[name] = {"type": "cube", "to_world": at.translate([0, 0, 3.25]) @ at.scale(0.1), "bsdf": grey}
        vary[f"{name}.to_world"] = data.Compose([data.Scale(0.6, 1.6, same=False), data.Turn([0, 1, 0]), anywhere])
        vary[f"{name}.bsdf.reflectance.value"] = data.Uniform(0.1, 0.95)
    return data.Recipe(scene, vary, time_axis=AXIS, spp=64, labels=["depth"], variant="llvm_ad_mono")


def rendered(sizes: argparse.Namespace, folder: Path, workers: int) -> tuple[Tensor, Tensor]:
    """Light (N, 1, T, H, W) of all scenes as the detector's response leaves it, and (N, 1, H, W) the place of the
    surface in bins. Scenes 0 to ``test`` - 1 are for the test.
    """
    recipe, count = boxes_before_a_wall(sizes.resolution), sizes.test + sizes.train
    print(tt.data.generate(recipe, folder := folder / f"spad_depth-{recipe.key()[:8]}-{count}", count, workers=workers))
    whole = next(iter(DataLoader(tt.data.TransientDataset(folder), batch_size=count)))
    position = 1000 * whole["depth"].unsqueeze(1) / MM_PER_BIN
    return sensing.ImpulseResponse(PULSE, AXIS).expected(whole["transient"]), position


def rates(light: Tensor, photons: tuple[float, float], generator: torch.Generator) -> Tensor:
    """Detections per cycle and bin. ``photons``: range of a scene's mean number per pixel and cycle, of which half to
    four fifths are background, spread over the whole window.
    """
    shape = (len(light), 1, 1, 1, 1)
    signal = light / light.sum(2, keepdim=True).mean((-2, -1), keepdim=True)
    background = torch.empty(shape).uniform_(1.0, 4.0, generator=generator)
    wanted = torch.empty(shape).uniform_(*map(math.log, photons), generator=generator).exp()
    return (signal + background / BINS) / (1 + background) * wanted


def matched(rate: Tensor) -> Tensor:
    """Scores of the log-matched filter of the pulse."""
    first, kernel = PULSE.kernel(AXIS.bin_width_s)
    return sensing.log_matched_filter(rate, kernel.to(rate), first, signal_to_background=30.0)


class DepthNetwork(nn.Module):
    """Scores (B, 1, T, H, W) from counts: those of Coates and matched filter plus what is learnt."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Conv3d(3, channels, (7, 3, 3), padding=(3, 1, 1)), nn.SiLU()]
        for length, dilation in ((5, 2), (3, 4)):
            shape = {"padding": (4, 1, 1), "dilation": (dilation, 1, 1)}
            layers += [nn.Conv3d(channels, channels, (length, 3, 3), **shape), nn.SiLU()]
        self.layers = nn.Sequential(*layers, nn.Conv3d(channels, 1, 1))
        self.gain = nn.Parameter(torch.ones(()))

    def forward(self, counts: Tensor) -> Tensor:
        """A softmax over time makes probabilities of them."""
        scores = matched(sensing.coates(counts, CYCLES).rate * CYCLES)
        scores = (scores - scores.mean(2, keepdim=True)) / scores.std(2, keepdim=True).clamp_min(1e-3)
        armed = 1 - (counts.cumsum(2) - counts) / CYCLES
        features = torch.cat([scores, (counts / CYCLES).sqrt() * 5, armed], dim=1)
        return self.gain * scores + self.layers(features)


def train(light: Tensor, position: Tensor, sizes: argparse.Namespace) -> DepthNetwork:
    """Train at 0.2 to 8 detections per cycle; cross-entropy against a narrow bump at the true bin."""
    network = DepthNetwork(sizes.channels)
    generator = torch.Generator().manual_seed(torch.initial_seed())
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 6e-3, total_steps=sizes.steps)
    bins = torch.arange(BINS).reshape(-1, 1, 1) + 0.5
    for _ in (bar := tqdm(range(sizes.steps), desc="spad_depth", unit="step")):
        taken = torch.randint(len(light), (sizes.batch,), generator=generator)
        counts = SPAD.sample(rates(light[taken], (0.2, 8.0), generator), generator)
        target = torch.softmax(-0.5 * (bins - position[taken].unsqueeze(2)).square(), dim=2)
        log_probability = torch.log_softmax(network(counts), dim=2)
        loss = -(target * log_probability).sum(2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        bar.set_postfix(loss=f"{loss.item():.3f}")
    return network


@torch.no_grad()
def estimates(network: DepthNetwork, counts: Tensor) -> dict[str, Tensor]:
    """Positions (B, 1, H, W) in bins by the three methods."""
    return {
        "matched filter": sensing.peak_position(matched(counts)),
        "Coates + matched filter": sensing.peak_position(matched(sensing.coates(counts, CYCLES).rate)),
        "network": sensing.center_of_mass(network(counts).softmax(2), half_width_bins=3),
    }


def table(network: DepthNetwork, light: Tensor, position: Tensor) -> dict[str, list[float]]:
    """Mean absolute errors in millimetres, per method and number of photons; of all pixels under "all: ..."."""
    bins = torch.arange(BINS).reshape(-1, 1, 1) + 0.5
    single = (light * ((bins - position.unsqueeze(2)).abs() < 9)).sum(2) > 0.9 * light.sum(2)  # within three pulses
    errors: dict[str, list[float]] = {}
    generator = torch.Generator().manual_seed(1000)
    for photons in PHOTONS:
        counts = SPAD.sample(rates(light, (photons, photons), generator), generator)
        for name, found in estimates(network, counts).items():
            off = (found - position).abs() * MM_PER_BIN
            errors.setdefault(name, []).append(float(off[single].mean()))
            errors.setdefault(f"all: {name}", []).append(float(off.mean()))
    return errors


def draw(found: dict[str, Tensor], errors: dict[str, list[float]], path: Path) -> None:
    """A scene by every method, and the errors."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.5, 3.2), layout="constrained")
    *pictures, lines = figure.subplots(1, 5, width_ratios=[1, 1, 1, 1, 1.5])
    for axes, (name, position) in zip(pictures, found.items(), strict=True):
        image = axes.imshow(position[0, 0].numpy() * MM_PER_BIN / 1000, vmin=0.3, vmax=1.8, cmap="viridis")
        axes.set(title=name, xticks=[], yticks=[])
    figure.colorbar(image, ax=pictures, label="distance in m", shrink=0.8)
    for name, colour in zip(list(found)[1:], ("tab:blue", "tab:orange", "tab:green"), strict=True):
        lines.plot(PHOTONS, errors[name], marker="o", label=name, color=colour)
        lines.plot(PHOTONS, errors[f"all: {name}"], marker="o", ls=":", mfc="none", color=colour)
    lines.set(title="mean error in mm (dotted: edges too)", xlabel="photons per cycle", xscale="log", yscale="log")
    lines.set_xticks(PHOTONS, [f"{p:g}" for p in PHOTONS])
    lines.minorticks_off()
    lines.legend(fontsize=7)
    figure.savefig(path, dpi=90)
    print(f"spad_depth: {path}")


def main(argv: Sequence[str] | None = None) -> list[dict[str, list[float]]]:
    """Command line; returns the table of every seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="weights and noise (%(default)s)")
    parser.add_argument("--workers", type=int, default=2, help="processes that render (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for all files (%(default)s)")
    options = parser.parse_args(argv)
    sizes = SMOKE if options.smoke else FULL
    light, position = rendered(sizes, options.output, options.workers)
    tables = []
    for seed in options.seeds:
        torch.manual_seed(seed)
        network = train(light[sizes.test :], position[sizes.test :], sizes)
        tables.append(table(network, light[: sizes.test], position[: sizes.test]))
        print(f"seed {seed}: mean error in mm" + "".join(f"{p:>16g}" for p in PHOTONS) + "  photons per cycle")
        for name, values in tables[-1].items():
            print(f"{name:<28}" + "".join(f"{v:16.1f}" for v in values))
    generator = torch.Generator().manual_seed(5)
    counts = SPAD.sample(rates(light[:1], (4.0, 4.0), generator), generator)
    draw({"truth": position[:1], **estimates(network, counts)}, tables[-1], options.output / "spad_depth.png")
    return tables


if __name__ == "__main__":
    main()
