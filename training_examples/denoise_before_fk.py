"""A small network that takes the noise off captures before f-k migration, and learns it from the pictures behind.

Bars of points hang before a scanned wall, at random places and tilts. A SPAD sees some ten photons of them at each
point of the scan, and two thirds as many of background: f-k migration makes a fog of that. `tt.nlos.FK` is a linear
operator whose backward pass is its adjoint, so the error of the *volume* trains the network in front of it: it learns
to keep what becomes a surface. The same network, trained for as many steps to give back the transient without noise,
is compared (given sixteen times as many it comes near), and the plain remedy, a Gaussian blur of the capture (kornia).

    python training_examples/denoise_before_fk.py --output demo_output

Prints the errors of volumes that were not trained on, relative to the power of the true ones, writes them to
denoise_before_fk.json, and draws one of the scenes from the front.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor, nn
from tqdm import tqdm

import torchtransient as tt
from torchtransient.reconstruction import stabilized_root

SIGNAL, BACKGROUND = 10.0, 0.05  # counts a scan point, and a scan point and bin
PULSE_BINS = 1.5  # standard deviation

Denoise = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Captures:
    """Roots of noisy captures (N, T, Y, X), those without noise, and the volumes (N, Z, Y, X) of the latter."""

    noisy: Tensor
    clean: Tensor
    volumes: Tensor


class Denoiser(nn.Module):
    """Roots of counts (..., T, Y, X) to roots of light: the input plus a learnt correction, never negative."""

    def __init__(self, channels: int = 8) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv3d(1, channels, 3, padding=1),
            nn.ReLU(),
            nn.Conv3d(channels, channels, 3, padding=1),
            nn.ReLU(),
            nn.Conv3d(channels, 1, 3, padding=1),
        )
        # Begins as the identity.
        nn.init.zeros_(self.layers[-1].weight)
        nn.init.zeros_(self.layers[-1].bias)

    def forward(self, root: Tensor) -> Tensor:
        return torch.relu(root + self.layers(root[:, None])[:, 0])


def make_operator(points: int, bins: int) -> tt.nlos.FK:
    """Of a wall of 1 m, scanned at points x points; records up to 2.56 m of path."""
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(1.0, 1.0), points, kind="confocal")
    return tt.nlos.FK(scan, time_axis=tt.TimeAxis(0.0, 2.56 / bins, bins), taps=2, floor=0.25)


def bar(fk: tt.nlos.FK, generator: torch.Generator) -> Tensor:
    """Mean signal counts (T, Y, X) of a bar of points: `1 / r^4`, and a Gaussian pulse in every bin."""
    number = 6 * int(torch.randint(3, 9, (), generator=generator))
    ends = torch.rand(2, 3, generator=generator, dtype=torch.float64)
    ends = ends * torch.tensor([0.7, 0.7, 0.3]) + torch.tensor([-0.35, -0.35, 0.6])
    along = torch.linspace(0, 1, number, dtype=torch.float64)[:, None]
    # The wall faces +z and its middle is the origin.
    places = ends[0] * (1 - along) + ends[1] * along
    wall = fk.wall.points
    edges = fk.axis.edges_opl / (PULSE_BINS * fk.axis.bin_width_opl)
    light = torch.zeros(fk.data_shape, dtype=torch.float64)
    for place in places:
        r = (wall - place).norm(dim=-1)
        arrival = 2 * r / (PULSE_BINS * fk.axis.bin_width_opl)
        light += torch.special.ndtr(edges[:, None, None] - arrival).diff(dim=0) / r**4
    return (SIGNAL * wall.shape[0] * wall.shape[1] / light.sum() * light).float()


def volume(fk: tt.nlos.FK, root: Tensor) -> Tensor:
    """Squared migrated field (N, Z, Y, X) of roots of counts, of sum one: brightness is not compared."""
    field = fk.adjoint(root * fk.depths.to(root)[:, None, None])
    power = field.real.square() + field.imag.square()
    return power / power.sum((-3, -2, -1), keepdim=True)


def make_captures(fk: tt.nlos.FK, number: int, generator: torch.Generator) -> Captures:
    signal = torch.stack([bar(fk, generator) for _ in range(number)])
    noisy = torch.poisson(signal + BACKGROUND, generator=generator)
    return Captures(stabilized_root(noisy), stabilized_root(signal), volume(fk, signal.sqrt()))


def volume_error(fk: tt.nlos.FK, roots: Tensor, truth: Tensor) -> Tensor:
    """Squared error of volumes relative to the power of the true ones."""
    error = tt.losses.squared_loss(volume(fk, roots), truth, reduction="sum")
    return error / truth.square().sum()


def root_error(fk: tt.nlos.FK, roots: Tensor, truth: Tensor) -> Tensor:
    """Squared error of roots of transients."""
    return tt.losses.squared_loss(roots, truth)


def train(fk: tt.nlos.FK, captures: Captures, *, through_fk: bool, steps: int, batch: int, seed: int) -> Denoiser:
    torch.manual_seed(seed)
    network = Denoiser()
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    generator = torch.Generator().manual_seed(seed)
    loss_of, target = (volume_error, captures.volumes) if through_fk else (root_error, captures.clean)
    name = "through f-k" if through_fk else "on transients alone"
    for _ in (progress := tqdm(range(steps), desc=name, unit="step")):
        chosen = torch.randint(len(captures.noisy), (batch,), generator=generator)
        loss = loss_of(fk, network(captures.noisy[chosen]), target[chosen])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        progress.set_postfix(loss=f"{float(loss.detach()):.4f}")
    return network


def blur(sigma: float) -> Denoise:
    """A Gaussian over the wall, the standard deviation in points of the scan."""
    return lambda root: gaussian_blur2d(root, 2 * round(3 * sigma) + 1, (sigma, sigma))


def best_blur(fk: tt.nlos.FK, captures: Captures) -> float:
    """The width that suits the captures of the training best."""
    widths = (0.5, 0.7, 1.0, 1.4, 2.0)
    with torch.no_grad():
        errors = [float(volume_error(fk, blur(w)(captures.noisy), captures.volumes)) for w in widths]
    return widths[errors.index(min(errors))]


def draw(path: Path, views: dict[str, Tensor]) -> None:
    """Front maxima side by side, each on its own scale."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.6 * len(views), 2.9), layout="constrained")
    for place, (name, view) in zip(figure.subplots(1, len(views)), views.items(), strict=True):
        place.imshow(view.numpy(), cmap="inferno", origin="lower", extent=(-0.5, 0.5, -0.5, 0.5))
        place.set_title(name, fontsize=9)
        place.set_xlabel("x / m")
    figure.savefig(path, dpi=120)


def main(argv: Sequence[str] | None = None) -> dict[str, float]:
    """Run the command line; returns what it writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("demo_output"))
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument("--batch", type=int, default=2)
    parser.add_argument("--points", type=int, default=24, help="scan points along each side of the wall")
    parser.add_argument("--bins", type=int, default=128)
    parser.add_argument("--scenes", type=int, default=32, help="to train on")
    parser.add_argument("--test-scenes", type=int, default=8, help="to measure errors on")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds: coarse, shows that it runs")
    if parser.parse_known_args(argv)[0].smoke:
        parser.set_defaults(steps=12, points=12, bins=64, scenes=4, test_scenes=2)
    options = parser.parse_args(argv)
    options.output.mkdir(parents=True, exist_ok=True)

    fk = make_operator(options.points, options.bins)
    generator = torch.Generator().manual_seed(1 + options.seed)
    training = make_captures(fk, options.scenes, generator)
    test = make_captures(fk, options.test_scenes, generator)
    how = {"steps": options.steps, "batch": options.batch, "seed": options.seed}
    methods: dict[str, Denoise] = {
        "as measured": lambda root: root,
        "blurred": blur(best_blur(fk, training)),
        "trained on transients": train(fk, training, through_fk=False, **how),
        "trained through f-k": train(fk, training, through_fk=True, **how),
    }
    errors, views = {}, {}
    # The bar that is spread out the most.
    shown = int(test.volumes.square().sum((1, 2, 3)).argmin())
    with torch.no_grad():
        for name, method in methods.items():
            cleaned = method(test.noisy)
            errors[name] = float(volume_error(fk, cleaned, test.volumes))
            views[f"{name}: {errors[name]:.3f}"] = tt.losses.maximum_projections(volume(fk, cleaned[shown]))[0]
            print(f"{name:22} {errors[name]:.4f}")
    (options.output / "denoise_before_fk.json").write_text(json.dumps(errors, indent=2) + "\n")
    views["without noise"] = tt.losses.maximum_projections(test.volumes[shown])[0]
    draw(options.output / "denoise_before_fk.png", views)
    return errors


if __name__ == "__main__":
    main()
