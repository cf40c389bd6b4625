"""Noise off time-of-flight histograms: a network trained on rendered captures alone, judged by measured photons.

A recipe moves letters behind a corner past a single-photon detector (`sensing.device("mpd_spad_like")`, with a longer
pulse). Measured are two Keyhole tracks of other letters (Metzler, Lindell and Wetzstein 2020), whose photons are dealt
out at random: a few make a short exposure to denoise, all others say how likely a second exposure as short is under its
rates. Thinned Poisson counts are independent Poisson counts, so this needs no ground truth.

    python training_examples/denoise_histograms.py --measured FOLDER --output demo_output

`FOLDER` (or TORCHTRANSIENT_MEASURED_DATA) holds `keyhole/E` and `keyhole/K` as published; without it simulated captures
stand in. Prints the log-likelihood, nats per histogram, that methods lose against the rates of all photons: counts and
a floor; Gaussians with widths that suit the simulated captures; the best Gaussian for what is measured; the network.
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import kornia
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader
from tqdm import tqdm

import torchtransient as tt
from torchtransient import sensing

BIN_S, FIRST, BINS, POSITIONS = 32e-12, 128, 144, 64  # the record begins 4.1 ns after the light of the wall
AXIS = tt.TimeAxis.from_seconds(FIRST * BIN_S, BIN_S, BINS)
Pairs = list[tuple[Tensor, Tensor]]
EXPOSURES = (30, 100, 300, 1000)  # counts of a histogram, means over the positions
CYCLES, GRID = 100_000, list(itertools.product((0, 1, 2, 4, 8), (0, 1, 2, 4), (0.01, 0.03, 0.1, 0.3)))
# Captures to learn from, and to choose widths by and test on; steps, captures of a step, channels of the network.
FULL = argparse.Namespace(train=256, test=32, spp=2048, steps=800, batch=4, channels=16)
SMOKE = argparse.Namespace(train=12, test=4, spp=256, steps=120, batch=2, channels=8)


def moving_letters(spp: int) -> tt.data.Recipe:
    """The recipe: letters but E and K in all sorts of poses, tracks of several forms."""
    data, beside = tt.data, (-3.0, 0.0, 0.3)
    letters = [tt.scenes.nlos_letter(letter, size=0.4, depth=0.8) for letter in "CFHLNTVXZ"]
    t, z = torch.linspace(0, 1, POSITIONS, dtype=torch.float64), torch.zeros(POSITIONS, dtype=torch.float64)
    forms = [(t - 0.5, z), ((6.3 * t).cos() / 2, (6.3 * t).sin() / 7), (z - 0.3, 0.6 * t), (0.7 * t - 0.35, 0.3 * t)]
    at = {"kind": "confocal", "sensor_origin": beside, "laser_origin": beside, "wall": tt.nlos.Wall.plane(4.0, 4.0)}
    tracks = [tt.nlos.Scan.points(torch.stack([x, y, z], -1), **at) for x, y in forms]
    turned = [data.Turn([0, 0, 1], -20, 20), data.Turn([0, 1, 0], -15, 15, about=[0, 0, 0.8])]
    pose = data.Compose([data.Scale(0.7, 1.3), *turned, data.Offset([-0.2, -0.5, -0.1], [0.2, 0.5, 0.15])])
    vary = {"letter": data.Choice([x["letter"] for x in letters]), "letter.to_world": pose, "scan": data.Choice(tracks)}
    return data.Recipe(letters[0], vary, scan=tracks[0], time_axis=AXIS, spp=spp, variant="llvm_ad_mono")


def detector() -> sensing.Compose:
    """From detections per cycle to counts: the named detector without its laser and optics. The measured response of
    Keyhole's set-up stands for its jitter: behind the detector, since the rates have their background already."""
    device = sensing.device("mpd_spad_like")
    pulse = {"kind": "TailedResponse", "fwhm_s": 90e-12, "tails_s": [70e-12], "fractions": [0.5]}
    whole = device.changed("DetectionJitter", response=pulse).changed("Afterpulsing", background=0.0).sensor(AXIS)
    return sensing.Compose(list(whole.stages)[2:])


def exposed(light: Tensor, counts: tuple[float, float], generator: torch.Generator) -> Tensor:
    """Detections per cycle (B, 1, T, 1, N) of captures (B, 1, T, N): ``counts`` a histogram on average, of which a
    tenth to two thirds are background, flat and with a tail of the wall's own light. Tracks are uneven as motors are.
    """
    u = torch.rand(5, len(light), 1, 1, 1, generator=generator)
    steps = torch.randint(0, 3, (len(light), 1, 1, POSITIONS), generator=generator).cumsum(3) + (64 * u[0]).long()
    place = POSITIONS - 1 - (steps % (2 * POSITIONS - 2) - POSITIONS + 1).abs()  # to the end of the track and back
    signal = light.gather(3, place.expand_as(light))
    tail = torch.exp(-torch.arange(BINS).reshape(-1, 1) / (2 + 3 * u[1]).exp())
    background = torch.lerp(torch.ones(()), tail / tail.mean(2, keepdim=True), u[2]) * (0.1 + 1.9 * u[3])
    rate = signal / signal.mean((2, 3), keepdim=True) + background
    level = counts[0] * (counts[1] / counts[0]) ** u[4] / CYCLES
    return (rate / rate.mean((2, 3), keepdim=True) * level / BINS).unsqueeze(3)


def blurred(counts: Tensor, time: float, positions: float, floor: float) -> Tensor:
    """Rates (B, 1, T, N): a Gaussian over bins and positions, and a share of the mean so that no bin is impossible."""
    size, sigma = (2 * int(3 * time) + 1, 2 * int(3 * positions) + 1), (time + 1e-3, positions + 1e-3)
    return (1 - floor) * kornia.filters.gaussian_blur2d(counts, size, sigma) + floor * counts.mean((2, 3), keepdim=True)


class Denoiser(nn.Module):
    """Rates (B, 1, T, N) of counts (B, 1, T, N): a Gaussian's times the exponential of what convolutions say."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Conv2d(3, channels, 3, padding=1), nn.SiLU()]
        for wide in (1, 2, 4, 8, 16):
            layers += [nn.Conv2d(channels, channels, 3, padding=wide, dilation=wide), nn.SiLU()]
        self.layers = nn.Sequential(*layers, nn.Conv2d(channels, 1, 1))
        nn.init.zeros_(self.layers[-1].weight)

    def forward(self, counts: Tensor) -> Tensor:
        fine, coarse = blurred(counts, 2, 1, 0.05), blurred(counts, 8, 4, 0.05)
        return fine * self.layers(torch.cat([fine.log(), (coarse / fine).log(), counts.sqrt()], 1)).exp()


def lost(rate: Tensor, mean: Tensor) -> Tensor:
    """Log-likelihood in nats per histogram that rates lose against the mean of the counts."""
    return (rate - mean + torch.special.xlogy(mean, mean / rate)).sum(2).mean()


def train(light: Tensor, sizes: argparse.Namespace, generator: torch.Generator) -> Denoiser:
    network, measure = Denoiser(sizes.channels), detector()
    optimizer = torch.optim.Adam(network.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, total_steps=sizes.steps)
    for _ in tqdm(range(sizes.steps), desc="denoise_histograms", unit="step"):
        rate = exposed(light[torch.randint(len(light), (sizes.batch,), generator=generator)], (20, 1500), generator)
        counts, mean = measure.sample(rate, generator).squeeze(3), measure.expected(rate).squeeze(3)
        unit = mean.sum(2, keepdim=True).mean(3, keepdim=True).sqrt()  # makes short and long exposures count alike
        loss = lost(network(counts) / unit, mean / unit)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return network


def measured(folder: Path) -> Tensor:
    """Counts (1, 1, T, N) of a Keyhole track, time zero when light is back from the wall."""
    direct = tt.nlos.Capture.read(folder / "direct_after.mat", start_s=0.0).transient[0, :, 0]
    path = next(folder.glob("scan_*.mat"), folder / "scan_*.mat")
    track = tt.nlos.Capture.read(path, start_s=-int(direct.argmax()) * BIN_S / 2)
    return tt.nlos.sum_bins(track.crop(*AXIS.edges_opl[[0, -1]].tolist()), 2).transient[None].float()


def compared(network: Denoiser, simulated: Pairs, real: Pairs) -> tuple[dict[str, float], partial[Tensor]]:
    """Nats by method, and the Gaussian that suits the simulated captures best."""

    def best(pairs: Pairs, frozen: int = 0) -> partial[Tensor]:
        kept = [widths for widths in GRID if not any(widths[2 - frozen : 2])]
        gaussians = [partial(blurred, time=t, positions=p, floor=f) for t, p, f in kept]
        return min(gaussians, key=lambda gaussian: sum(lost(gaussian(counts), mean) for counts, mean in pairs))

    methods = {"counts and a floor": best(simulated, 2), "Gaussian over time": best(simulated, 1)}
    methods |= {"... and positions": best(simulated), "best Gaussian here": best(real), "network": network}
    nats = {name: float(sum(lost(f(n), mean) for n, mean in real)) / len(real) for name, f in methods.items()}
    return nats, methods["... and positions"]


def draw(rows: dict[str, list[Tensor]], path: Path) -> None:
    """What becomes of a short exposure."""
    from matplotlib.figure import Figure
    from PIL import Image

    figure = Figure(figsize=(11, 2.8 * len(rows)), layout="constrained")
    for line, (name, images) in zip(figure.subplots(len(rows), 4, squeeze=False), rows.items(), strict=True):
        for axes, title, image in zip(line, ("counts", "Gaussian", "network", "all photons"), images, strict=True):
            axes.imshow(image[0, 0].T.sqrt().numpy(), aspect="auto", vmin=0, vmax=images[-1][0].max().sqrt().item())
            axes.set(title=f"{name}, {title}", xticks=[], yticks=[], xlabel="time", ylabel="position")
    figure.savefig(path, dpi=80)
    # Smooth pictures hardly compress: 256 colours are a fifth of the file.
    few = Image.open(path).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(path, optimize=True)


def main(argv: Sequence[str] | None = None) -> list[dict[str, list[float]]]:
    """Command line; returns the table of every seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds")
    folder = os.environ.get("TORCHTRANSIENT_MEASURED_DATA")
    parser.add_argument("--measured", default=folder, help="folder of measured data (%(default)s)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="weights and photons (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for all files (%(default)s)")
    options = parser.parse_args(argv)
    sizes, measure = SMOKE if options.smoke else FULL, detector()
    recipe, count = moving_letters(sizes.spp), sizes.test + sizes.train
    where = options.output / f"denoise_histograms-{recipe.key()[:8]}-{count}"
    print(tt.data.generate(recipe, where, count))
    light = next(iter(DataLoader(tt.data.TransientDataset(where), batch_size=count)))["transient"]
    tables: list[dict[str, list[float]]] = []
    for seed in options.seeds:
        network = train(light[sizes.test :], sizes, generator := torch.manual_seed(seed)).requires_grad_(False)
        rates = {level: exposed(light[: sizes.test], (level, level), generator) for level in EXPOSURES}
        if options.measured:
            whole = {letter: measured(Path(options.measured, "keyhole", letter)) for letter in "EK"}
        else:
            print("no folder of measured data: simulated captures stand in for them")
            whole = {"simulated": torch.poisson(200 * measure.expected(rates[1000]).squeeze(3), generator)}
        tables.append({})
        for level, rate in rates.items():
            simulated = [(measure.sample(rate, generator).squeeze(3), measure.expected(rate).squeeze(3))]
            real = {}  # of all photons a few are the exposure; the others say how likely a second one is
            for name, photons in whole.items():
                share = torch.full_like(photons, level / photons.sum(2).mean().item())
                short = torch.binomial(photons, share, generator=generator)
                real[name] = short, (photons - short) * share / (1 - share)
            nats, gaussian = compared(network, simulated, list(real.values()))
            tables[-1] = {name: [*tables[-1].get(name, []), value] for name, value in nats.items()}
            if level == 100:
                pictures = {name: [c, gaussian(c), network(c), mean] for name, (c, mean) in real.items()}
        print(f"seed {seed:<15}" + "".join(f"{level:>8}" for level in EXPOSURES) + "  counts of a histogram")
        print("\n".join(f"{name:<20}" + "".join(f"{v:8.2f}" for v in row) for name, row in tables[-1].items()))
    draw(pictures, options.output / "denoise_histograms.png")
    return tables


if __name__ == "__main__":
    main()
