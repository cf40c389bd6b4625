"""Find axis, speed and pose of a turning fan in a frame of a coherent lidar: a network guesses, the renderer corrects.

The frame is what an FMCW lidar records in one pair of chirps: for each of 32 x 32 pixels the spectrum of the beat of
the up chirp and that of the down chirp, in which 1 m/s looks like 1.9 m of path. Unknown are the angular velocity,
three numbers, and the pose of the fan at that instant, six numbers. The axis is free and need not be the normal of the
fan, as that of a rotor is not that tumbles with its drone.

A lidar cannot see a turn about its line of sight. With its light elsewhere it cannot see, but for perspective, a turn
about the bisector of both lines. So there are two lights, one beside the sensor and one apart from it: their blind
directions differ. Both beats lie in the same spectra, and nothing says which line is whose.

The loss is the unbalanced Wasserstein distance over the spectra of each pixel, which has a slope where lines do not
overlap, then the squared difference.

    python training_examples/fit_spin.py --output demo_output

Prints errors of every seed before and after, and how many end within 1 degree and 1 %. `--off` says how far the true
fans are from the middle of those that are known to occur, `--no-network` starts there, `--one-light` leaves out the
light beside the sensor, `--looks` has speckle in the measured frames, `--distance 0` takes squares from the first step.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from tqdm import tqdm

import torchtransient as tt
from torchtransient.parametrize import AxisAnglePose, axis_angle_from_pose
from torchtransient.scenes import look_at, rotate, scale, translate
from torchtransient.scenes.meshes import triangle_mesh
from torchtransient.scenes.parts import diffuse, perspective, transient_film, transient_path
from torchtransient.vis.files import figure_type, save_figure

KEYS = ["fan.to_world", "fan.velocity.angular", "fan.velocity.center"]
RESOLUTION = 32
CHIRPS = tt.Chirps(bandwidth_hz=1e9, duration_s=10e-6, wavelength_m=1550e-9)
AXIS = CHIRPS.time_axis((1.5, 4.5), (-6.5, 6.5))
RATES, LENGTHS = tt.RateAxis(-10.0, 0.2, 100), tt.TimeAxis(4.0, 0.08, 70)
MIDDLE = translate([0.0, 0.0, 0.2]) @ rotate([1.0, 0.5, 0.2], 20.0)
POSE = AxisAnglePose(torch.tensor(MIDDLE).float())
NORMAL = torch.tensor(MIDDLE[:3, 2]).float()
SPEED = 10.0  # rad/s
# Where the truths are for `--off 1`: radians, metres, share of the speed.
UNIT = torch.tensor([math.radians(50.0)] * 3 + [0.25] * 3 + [1.0] * 3)
RATE = torch.tensor([0.02] * 3 + [0.01] * 3 + [0.02] * 3)  # of Adam's first steps
CREATION_OPL = 2.0  # light that far away, 1 m/s, is rather missing than at a wrong rate
GOOD_DEG, GOOD_PERCENT = 1.0, 1.0
TARGET_SEED, LEARNT_SEED = 1_000_003, 50_000


@dataclass
class Fit:
    """Values of the scene, frames (1, 2, T, H, W), and errors before the first step and after each one."""

    values: dict[str, dict[str, Tensor]]
    frames: dict[str, Tensor]
    errors: list[tuple[float, float, float, float]] = field(default_factory=list)

    @property
    def good(self) -> bool:
        degrees, percent = self.errors[-1][:2]
        return degrees < GOOD_DEG and percent < GOOD_PERCENT


def fan() -> tuple[np.ndarray, np.ndarray]:
    """Three blades, 8 to 50 cm from the axis and pitched by 15 degrees: vertices (12, 3), metres, and faces (6, 3)."""
    blade = np.array([(0.08, -0.08, 0.0), (0.5, -0.22, 0.0), (0.5, 0.22, 0.0), (0.08, 0.08, 0.0)])
    turns = [(rotate([0, 0, 1], 120.0 * k) @ rotate([1, 0, 0], 15.0))[:3, :3] for k in range(3)]
    faces = [(4 * k + a, 4 * k + b, 4 * k + c) for k in range(3) for a, b, c in ((0, 1, 2), (0, 2, 3))]
    return np.concatenate([blade @ turn.T for turn in turns]), np.array(faces)


def scene_of(one_light: bool) -> tt.Scene:
    """A fan before a wall, light of one reflection."""
    sensor = look_at([-1.2, 0.0, 2.4], [0, 0, 0])
    film = transient_film(RESOLUTION, AXIS.num_bins, AXIS.start_opl, AXIS.bin_width_opl)
    lights = {"apart": [1.6, 0.6, 2.2]} | ({} if one_light else {"beside": [-1.2, 0.05, 2.4]})
    scene = {
        "type": "scene",
        "integrator": transient_path(2),
        "sensor": perspective(sensor, 32.0, film, 16, "multijitter"),
        "wall": {"type": "rectangle", "to_world": translate([0, 0, -0.8]) @ scale(2.5), "bsdf": diffuse(0.4)},
        "fan": triangle_mesh(*fan(), reflectance=0.8, to_world=MIDDLE) | {"face_normals": True},
    } | {name: {"type": "point", "position": place, "intensity": 10.0} for name, place in lights.items()}
    turning = tt.Motion(angular=SPEED * NORMAL, center=MIDDLE[:3, 3])
    return tt.load(scene, variant="llvm_ad_mono").moving({"fan": turning})


def renderer_of(scene: tt.Scene, spp: int) -> tt.TransientRenderer:
    """Up and down beats of 32 x 32 pixels, bins of 30 cm."""
    return tt.TransientRenderer(scene, KEYS, chirps=CHIRPS, time_axis=AXIS, spp=spp, spp_boundary=spp)


def values_of(numbers: Tensor) -> dict[str, Tensor]:
    """Pose and velocity of nine numbers, from the middle: turn and shift of the fan, change of the angular velocity."""
    pose = POSE(numbers[:6])
    angular = SPEED * (NORMAL + numbers[6:])
    return dict(zip(KEYS, (pose, angular, pose[:3, 3]), strict=True))


def angular_numbers(speed: Tensor, sine: Tensor, direction: Tensor) -> Tensor:
    """Change of the angular velocity (3,) to another speed and an axis off by that sine, towards a direction."""
    sideways = functional.normalize(direction - (direction @ NORMAL) * NORMAL, dim=0)
    return speed * ((1 - sine**2).sqrt() * NORMAL + sine * sideways) - NORMAL


def true_numbers(seed: int, off: float) -> Tensor:
    """(9,): a speed off by that share, an axis off by that sine, and a pose by 25 cm and 50 degrees times it."""
    generator = torch.Generator().manual_seed(seed)
    turn, shift, direction = functional.normalize(torch.randn(3, 3, generator=generator), dim=1)
    sign = 2.0 * torch.randint(2, (), generator=generator) - 1
    angular = angular_numbers(1 + off * sign, torch.tensor(off), direction)
    return torch.cat([off * UNIT[:3] * turn, off * UNIT[3:6] * shift, angular])


def random_numbers(count: int, off: float, generator: torch.Generator) -> Tensor:
    """(count, 9): poses and velocities around the middle, a little farther than where the truths are."""
    reach = 1.2 * off
    drawn = []
    for _ in range(count):
        turn, shift, direction = functional.normalize(torch.randn(3, 3, generator=generator), dim=1)
        radii = reach * torch.rand(2, generator=generator) ** (1 / 3)
        speed = 1 + reach * (2 * torch.rand((), generator=generator) - 1)
        angular = angular_numbers(speed, reach * torch.rand((), generator=generator).sqrt(), direction)
        drawn.append(torch.cat([radii[0] * UNIT[:3] * turn, radii[1] * UNIT[3:6] * shift, angular]))
    return torch.stack(drawn)


def seen(frames: Tensor) -> Tensor:
    """Input of the network (B, 2 T / 4, H / 2, W / 2) of frames (B, 2, T, H, W). Roots make dark and bright alike."""
    return functional.avg_pool3d(frames, (4, 2, 2)).flatten(1, 2).sqrt()


class Guess(nn.Module):
    """Pose and angular velocity from a frame: (B, C, H, W) -> (B, 9). Bins are channels."""

    def __init__(self, channels: int, level: float, unit: Tensor) -> None:
        super().__init__()
        self.level, self.unit = level, unit
        self.layers = nn.Sequential(
            nn.Conv2d(channels, 48, 3, padding=1), nn.ReLU(),
            nn.Conv2d(48, 48, 3, stride=2, padding=1), nn.ReLU(),
            nn.Conv2d(48, 48, 3, stride=2, padding=1), nn.ReLU(),
            nn.Flatten(), nn.Linear(48 * (RESOLUTION // 8) ** 2, 96), nn.ReLU(), nn.Linear(96, 9),
        )  # fmt: skip

    def forward(self, roots: Tensor) -> Tensor:
        return self.layers(roots / self.level) * self.unit


def frame_of(
    renderer: tt.TransientRenderer, numbers: Tensor, looks: int, *, seed: int, spp: int | None = None
) -> Tensor:  # fmt: skip
    """A measured frame (1, 2, T, H, W), with speckle of so many looks."""
    with torch.no_grad():
        beats = renderer(values_of(numbers), seed=seed, spp=spp).beats
    return tt.sensing.Speckle(looks).sample(beats, torch.Generator().manual_seed(seed)) if looks else beats


def trained(renderer: tt.TransientRenderer, *, off: float, looks: int, frames: int, steps: int) -> Guess:
    """The network, after it has seen so many simulated frames."""
    numbers = random_numbers(frames, off, torch.Generator().manual_seed(0))
    renders = tqdm(numbers, desc="fit_spin, frames", unit="frame", leave=False)
    roots = torch.cat([seen(frame_of(renderer, nine, looks, seed=LEARNT_SEED + i)) for i, nine in enumerate(renders)])
    torch.manual_seed(0)
    network = Guess(roots.shape[1], float(roots.square().mean().sqrt()), off * UNIT)
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, steps)
    for _ in tqdm(range(steps), desc="fit_spin, network", unit="step", leave=False):
        drawn = torch.randint(frames, (32,))
        optimizer.zero_grad()
        ((network(roots[drawn]) - numbers[drawn]) / network.unit).square().mean().backward()
        optimizer.step()
        schedule.step()
    return network


def errors(found: dict[str, Tensor], truth: dict[str, Tensor]) -> tuple[float, float, float, float]:
    """Axis in degrees, speed in per cent, position of the fan in millimetres and its turn in degrees."""
    a, b = found["fan.velocity.angular"].detach(), truth["fan.velocity.angular"]
    axis = math.degrees(math.atan2(float(torch.linalg.cross(a, b).norm()), float(a @ b)))
    pose, true_pose = found["fan.to_world"].detach(), truth["fan.to_world"]
    off = axis_angle_from_pose(pose @ torch.linalg.inv(true_pose))
    shift = 1e3 * float((pose - true_pose)[:3, 3].norm())
    return axis, 100 * abs(float(a.norm() / b.norm()) - 1), shift, math.degrees(float(off[:3].norm()))


def fit_spin(
    renderer: tt.TransientRenderer, network: Guess | None, seed: int, *, off: float, looks: int, steps: int,
    distance: float, target_spp: int,
) -> Fit:  # fmt: skip
    """Run the fit of a seed, from the network's guess or, without one, from the middle."""
    truth = values_of(true_numbers(seed, off))
    target = frame_of(renderer, true_numbers(seed, off), looks, seed=TARGET_SEED + seed, spp=target_spp)
    with torch.no_grad():
        start = torch.zeros(9) if network is None else network(seen(target))[0]
        guess = values_of(start)
        first = renderer(guess, seed=0).beats
    # In units of the rates, so that turns, shifts and velocities have rates of their own.
    numbers = torch.nn.Parameter(start / RATE)
    result = Fit({"guess": guess, "truth": truth}, {"guess": first, "measured": target})
    optimizer = torch.optim.Adam([numbers], 1.0, betas=(0.8, 0.95))
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.01 ** (1 / steps))
    progress = tqdm(range(steps), desc=f"fit_spin, seed {seed}", unit="step", leave=False)
    for step in progress:
        values = values_of(RATE * numbers)
        result.errors.append(errors(values, truth))
        degrees, percent, *_ = result.errors[-1]
        progress.set_postfix(axis=f"{degrees:.2f} deg", speed=f"{percent:.2f} %")
        optimizer.zero_grad()
        beats = renderer(values, seed=seed * 100_000 + step).beats
        if step < distance * steps:
            loss = tt.losses.wasserstein_loss(beats, target, AXIS.bin_width_opl, creation_cost_opl=CREATION_OPL)
        else:
            loss = (beats - target).square().sum()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        found = values_of(RATE * numbers)
        result.values["found"] = found
        result.frames["found"] = renderer(found, seed=TARGET_SEED - 1).beats
    result.errors.append(errors(found, truth))
    return result


def mean_speeds(rates: Tensor) -> Tensor:
    """Mean speed of approach (H, W) of the light of each pixel, m/s, of (1, R, T, H, W)."""
    spectrum = rates.sum((0, 2))
    return -torch.einsum("rhw,r->hw", spectrum, RATES.centers.float()) / (2 * spectrum.sum(0))


def draw(scene: tt.Scene, fits: Sequence[Fit], folder: Path) -> None:
    """Speeds and spectra of the worst guess of a speed, errors of all seeds; range-Doppler maps in their own files."""
    renderer = tt.TransientRenderer(scene, KEYS, rates=RATES, time_axis=LENGTHS, spp=64)
    shown = max(fits, key=lambda fit: fit.errors[0][1])
    figure = figure_type()(figsize=(13, 5.4), layout="constrained")
    images, curves = figure.subfigures(1, 2, width_ratios=[1.7, 1])
    rows = images.subplots(2, 3)
    names = {"guess": "guess", "found": "found", "truth": "measured"}
    with torch.no_grad():
        rates = {name: renderer(shown.values[name], seed=TARGET_SEED - 2) for name in names}
    fastest = float(mean_speeds(rates["truth"].rates).abs().max())
    measured = shown.frames["measured"][0, 0, :, RESOLUTION // 2].sqrt()
    lit = (measured.amax(1) > 0.05 * measured.max()).nonzero()
    edges = AXIS.edges_opl
    first, last = max(int(lit[0]) - 8, 0), min(int(lit[-1]) + 8, AXIS.num_bins)
    extent = (-0.5, RESOLUTION - 0.5, float(edges[first]), float(edges[last]))
    for (above, below), (name, frame) in zip(rows.T, names.items(), strict=True):
        tt.vis.range_doppler(rates[name], folder / f"fit_spin_range_doppler_{name}.png", title=name)
        picture = above.imshow(mean_speeds(rates[name].rates), cmap="RdBu", vmin=-fastest, vmax=fastest)
        above.set(xticks=[], yticks=[], title=name)
        spectra = shown.frames[frame][0, 0, first:last, RESOLUTION // 2].sqrt()
        below.imshow(
            spectra, cmap="magma", vmin=0, vmax=float(measured.max()), extent=extent, aspect="auto", origin="lower",
            interpolation="none",
        )  # fmt: skip
        below.set(xlabel="column", title=frame)
    rows[0, 0].set_ylabel("mean speed")
    rows[1, 0].set_ylabel("up chirp: path + k rate [m]")
    images.colorbar(picture, ax=list(rows[0]), shrink=0.8, label="approach [m/s]")
    for axes, number, limit, unit in zip(
        curves.subplots(2, 1), (0, 1), (GOOD_DEG, GOOD_PERCENT), ("axis [degrees]", "speed [%]"), strict=True
    ):
        for fit in fits:
            axes.semilogy([four[number] for four in fit.errors], linewidth=1)
        axes.axhline(limit, color="0.6", linewidth=0.8, linestyle="--")
        axes.set(xlabel="step", ylabel=unit, ylim=(3e-3, 60), title=f"error, dashes: {limit:g}")
        axes.label_outer()
    save_figure(figure, folder / "fit_spin.png", "fit_spin")


def main(argv: Sequence[str] | None = None) -> list[Fit]:
    """Command line. Prints a line for every seed, and how many are good."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="how many true fans (%(default)s)")
    parser.add_argument("--off", type=float, default=0.4, help="how far the true ones are, 0.2: 20 %% (%(default)s)")
    parser.add_argument("--looks", type=int, default=0, help="speckle of so many looks; 0: none (%(default)s)")
    parser.add_argument("--steps", type=int, default=100, help="steps of Adam (%(default)s)")
    parser.add_argument("--distance", type=float, default=0.4, help="share of them by Wasserstein (%(default)s)")
    parser.add_argument("--spp", type=int, default=16, help="samples per pixel of a step (%(default)s)")
    parser.add_argument("--target-spp", type=int, default=1024, help="samples per pixel of the frame (%(default)s)")
    parser.add_argument("--frames", type=int, default=400, help="frames that the network learns from (%(default)s)")
    parser.add_argument("--network-steps", type=int, default=300, help="steps of the network (%(default)s)")
    parser.add_argument("--no-network", action="store_true", help="start in the middle")
    parser.add_argument("--one-light", action="store_true", help="no light beside the sensor")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for pictures (%(default)s)")
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds: coarse, shows that it runs")
    if parser.parse_known_args(argv)[0].smoke:
        parser.set_defaults(seeds=1, off=0.2, steps=60, target_spp=256, frames=100, network_steps=100)
    options = parser.parse_args(argv)
    tt.threads(1)  # a film so small is not worth several
    scene = scene_of(options.one_light)
    renderer = renderer_of(scene, options.spp)
    network = None
    if not options.no_network:
        network = trained(
            renderer, off=options.off, looks=options.looks, frames=options.frames, steps=options.network_steps
        )
    fits = []
    for seed in range(options.seeds):
        fit = fit_spin(
            renderer, network, seed, off=options.off, looks=options.looks, steps=options.steps,
            distance=options.distance, target_spp=options.target_spp,
        )  # fmt: skip
        fits.append(fit)
        before, after = fit.errors[0], fit.errors[-1]
        print(
            f"fit_spin, seed {seed}: axis from {before[0]:.1f} to {after[0]:.3f} degrees, "
            f"speed from {before[1]:.1f} to {after[1]:.3f} %, "
            f"fan from {before[2]:.1f} mm and {before[3]:.1f} degrees to {after[2]:.2f} mm and {after[3]:.3f} degrees",
            flush=True,
        )
    good = sum(fit.good for fit in fits)
    print(f"fit_spin: {good} of {len(fits)} within {GOOD_DEG:g} degree and {GOOD_PERCENT:g} %")
    options.output.mkdir(parents=True, exist_ok=True)
    draw(scene, fits, options.output)
    return fits


if __name__ == "__main__":
    main()
