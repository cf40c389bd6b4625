"""Depth from a SPAD in too much light: a small network trained on simulated pile-up, against Coates' correction.

Every step makes new scenes (boxes before a slanted wall), their photon rates, and the first-photon histograms that
`tt.sensing.SynchronousSPAD` draws from them. The network sees what a matched filter makes of Coates' estimate, the
histogram, and the share of cycles still armed, of a neighbourhood of pixels, and corrects the scores of the filter.

    python training_examples/spad_depth.py --output demo_output

Prints a table of errors on scenes that were not trained on, in millimetres: matched filter on the raw histogram,
Coates and matched filter, network; for several numbers of photons per laser cycle.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn
from tqdm import tqdm

import torchtransient as tt
from torchtransient import sensing

BINS = 128
AXIS = tt.TimeAxis.from_seconds(0.0, 100e-12, BINS)  # 12.8 ns: walls up to 1.9 m away
PULSE = sensing.GaussianResponse(300e-12)
MM_PER_BIN = AXIS.bin_width_opl / 2 * 1000
PHOTONS = (0.3, 1.0, 3.0, 6.0)  # of signal and background together, per pixel and cycle, in the table


@dataclass
class Scenes:
    """``position`` (B, 1, H, W) of the surface in bins, and ``rate`` (B, 1, T, H, W), detections per cycle and bin."""

    position: Tensor
    rate: Tensor


def make_scenes(count: int, size: int, photons: tuple[float, float], generator: torch.Generator) -> Scenes:
    """Boxes before a slanted wall; ``photons``: range of the mean number of detections per cycle of a scene."""

    def draw(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(count, *shape, generator=generator)

    v, u = torch.meshgrid(torch.linspace(-1, 1, size), torch.linspace(-1, 1, size), indexing="ij")
    wall = draw(70, 110, 1, 1) + draw(-8, 8, 1, 1) * u + draw(-8, 8, 1, 1) * v
    position, albedo = wall, draw(0.3, 1.0, 1, 1).expand(-1, size, size)
    for _ in range(3):
        near = (u - draw(-0.8, 0.8, 1, 1)).abs() < draw(0.15, 0.5, 1, 1)
        near = near & ((v - draw(-0.8, 0.8, 1, 1)).abs() < draw(0.15, 0.5, 1, 1))
        position = torch.where(near, draw(20, 65, 1, 1) + 3 * u, position)
        albedo = torch.where(near, draw(0.1, 1.0, 1, 1), albedo)
    signal = albedo / (position / 60) ** 2  # falls with the square of the distance
    edges = torch.arange(BINS + 1).reshape(-1, 1, 1)
    sigma_bins = float(PULSE.sigma_s) / AXIS.bin_width_s
    shape = torch.special.ndtr((edges - position.unsqueeze(1)) / sigma_bins).diff(dim=1)
    # Half to four fifths of all photons are background, spread over the whole window.
    background = draw(1.0, 4.0, 1, 1, 1) * signal.mean((-2, -1))[:, None, None, None] / BINS
    rate = signal.unsqueeze(1) * shape + background
    total = rate.sum(1).mean((-2, -1)).reshape(-1, 1, 1, 1)
    low, high = (torch.tensor(p).log() for p in photons)
    wanted = draw(float(low), float(high), 1, 1, 1).exp()
    return Scenes(position.unsqueeze(1), (rate * wanted / total).unsqueeze(1))


class DepthNetwork(nn.Module):
    """Scores (B, 1, T, H, W) from features (B, 3, T, H, W): those of the matched filter plus a learnt correction."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv3d(3, channels, (7, 3, 3), padding=(3, 1, 1)),
            nn.SiLU(),
            nn.Conv3d(channels, channels, (5, 3, 3), padding=(4, 1, 1), dilation=(2, 1, 1)),
            nn.SiLU(),
            nn.Conv3d(channels, channels, (3, 3, 3), padding=(4, 1, 1), dilation=(4, 1, 1)),
            nn.SiLU(),
            nn.Conv3d(channels, 1, 1),
        )
        self.gain = nn.Parameter(torch.ones(()))

    def forward(self, features: Tensor) -> Tensor:
        """The corrected scores; a softmax over time makes probabilities of them."""
        return self.gain * features[:, :1] + self.layers(features)


def matched(rate: Tensor) -> Tensor:
    """Scores of the log-matched filter of the pulse."""
    first, kernel = PULSE.kernel(AXIS.bin_width_s)
    return sensing.log_matched_filter(rate, kernel.to(rate), first, signal_to_background=30.0)


def features_of(counts: Tensor, cycles: int) -> Tensor:
    """(B, 3, T, H, W): scores after Coates, root of the histogram, share of the cycles that are still armed."""
    estimate = sensing.coates(counts, cycles)
    scores = matched(estimate.rate * cycles)
    scores = (scores - scores.mean(2, keepdim=True)) / scores.std(2, keepdim=True).clamp_min(1e-3)
    armed = 1 - (counts.cumsum(2) - counts) / cycles
    return torch.cat([scores, (counts / cycles).sqrt() * 5, armed], dim=1)


def position_of(scores: Tensor) -> Tensor:
    """(B, 1, H, W): mean position within three bins of the highest probability."""
    probabilities = torch.softmax(scores, dim=2)
    return sensing.centre_of_mass(probabilities, half_width_bins=3)


def train(steps: int, batch: int, size: int, cycles: int, channels: int) -> tuple[DepthNetwork, list[float]]:
    """Train on scenes of 0.2 to 8 detections per cycle; cross-entropy against a narrow bump at the true bin."""
    network = DepthNetwork(channels)
    spad = sensing.SynchronousSPAD(cycles)
    generator = torch.Generator().manual_seed(1)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 6e-3, total_steps=steps)
    bins = torch.arange(BINS).reshape(-1, 1, 1) + 0.5
    losses = []
    for _ in (bar := tqdm(range(steps), desc="spad_depth", unit="step")):
        scenes = make_scenes(batch, size, (0.2, 8.0), generator)
        counts = spad.sample(scenes.rate, generator)
        target = torch.softmax(-0.5 * (bins - scenes.position.unsqueeze(2)).square(), dim=2)
        log_probability = torch.log_softmax(network(features_of(counts, cycles)), dim=2)
        loss = -(target * log_probability).sum(2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(float(loss.detach()))
        bar.set_postfix(loss=f"{losses[-1]:.3f}")
    return network, losses


def estimates(network: DepthNetwork, counts: Tensor, cycles: int) -> dict[str, Tensor]:
    """Positions (B, 1, H, W) in bins by the three methods."""
    with torch.no_grad():
        return {
            "matched filter": sensing.peak_position(matched(counts)),
            "Coates + matched filter": sensing.peak_position(matched(sensing.coates(counts, cycles).rate * cycles)),
            "network": position_of(network(features_of(counts, cycles))),
        }


def table(network: DepthNetwork, size: int, cycles: int, scenes: int) -> dict[str, list[float]]:
    """Mean absolute errors in millimetres, per method and number of photons."""
    spad = sensing.SynchronousSPAD(cycles)
    errors: dict[str, list[float]] = {}
    for k, photons in enumerate(PHOTONS):
        generator = torch.Generator().manual_seed(1000 + k)
        made = make_scenes(scenes, size, (photons, photons), generator)
        counts = spad.sample(made.rate, generator)
        for name, found in estimates(network, counts, cycles).items():
            errors.setdefault(name, []).append(float((found - made.position).abs().mean()) * MM_PER_BIN)
    return errors


def draw(network: DepthNetwork, losses: list[float], errors: dict[str, list[float]], cycles: int, path: Path) -> None:
    """One scene in much light by every method, the loss, and the errors."""
    from matplotlib.figure import Figure

    generator = torch.Generator().manual_seed(5)
    scene = make_scenes(1, 40, (4.0, 4.0), generator)
    counts = sensing.SynchronousSPAD(cycles).sample(scene.rate, generator)
    found = {"truth": scene.position, **estimates(network, counts, cycles)}
    figure = Figure(figsize=(11.5, 6.4), layout="constrained")
    upper, lower = figure.subfigures(2, 1)
    for axes, (name, position) in zip(upper.subplots(1, 4), found.items(), strict=True):
        image = axes.imshow(position[0, 0] * MM_PER_BIN / 1000, vmin=0.3, vmax=1.8, cmap="viridis")
        axes.set(title=name, xticks=[], yticks=[])
    upper.colorbar(image, ax=upper.axes, label="distance in m")
    upper.suptitle("4 photons per laser cycle")
    curve, bars, histogram = lower.subplots(1, 3)
    curve.plot(losses, color="0.4")
    curve.set(title="training", xlabel="step", ylabel="cross-entropy")
    for name, values in errors.items():
        bars.plot(PHOTONS, values, marker="o", label=name)
    bars.set(title="errors on new scenes", xlabel="photons per cycle", ylabel="mm", xscale="log", yscale="log")
    bars.set_xticks(PHOTONS, [f"{p:g}" for p in PHOTONS])
    bars.minorticks_off()
    bars.legend(fontsize=8)
    histogram.step(range(BINS), counts[0, 0, :, 20, 20], color="0.5", label="histogram")
    histogram.step(range(BINS), scene.rate[0, 0, :, 20, 20] * cycles, color="tab:blue", label="photons")
    histogram.set(title="middle pixel", xlabel="bin", ylabel="counts")
    histogram.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def main(argv: Sequence[str] | None = None) -> dict[str, list[float]]:
    """Command line; returns the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=400, help="steps of training (%(default)s)")
    parser.add_argument("--batch", type=int, default=4, help="scenes of a step (%(default)s)")
    parser.add_argument("--size", type=int, default=16, help="pixels per side of a scene (%(default)s)")
    parser.add_argument("--cycles", type=int, default=300, help="laser cycles of an exposure (%(default)s)")
    parser.add_argument("--channels", type=int, default=8, help="channels of the network (%(default)s)")
    parser.add_argument("--test-scenes", type=int, default=32, help="scenes of each column (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for the picture (%(default)s)")
    options = parser.parse_args(argv)
    torch.manual_seed(0)
    network, losses = train(options.steps, options.batch, options.size, options.cycles, options.channels)
    errors = table(network, options.size, options.cycles, options.test_scenes)
    print("mean error in mm       " + "".join(f"{p:>8g}" for p in PHOTONS) + "  photons per cycle")
    for name, values in errors.items():
        print(f"{name:<23}" + "".join(f"{v:8.1f}" for v in values))
    picture = options.output / "spad_depth.png"
    draw(network, losses, errors, options.cycles, picture)
    print(f"spad_depth: {picture}")
    return errors


if __name__ == "__main__":
    main()
