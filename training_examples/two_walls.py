"""The scene, the unknowns, the photon counter, the network and the fits that the two hybrid examples share.

A camera with a flash beside it looks at a wall. A second wall at its side is never in the picture: it shows in light
of two and three bounces alone. Six numbers are unknown: distance, yaw and pitch of the wall, distance of the hidden
wall, both albedos. 8 x 8 pixels, 64 bins of 8 cm of path, about 100 counts of the flash and 6 others a pixel.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from tqdm import tqdm

import torchtransient as tt
from torchtransient import losses, sensing
from torchtransient.parametrize import Bounded, pose_from_axis_angle
from torchtransient.scenes.parts import diffuse, perspective, transient_film, transient_path
from torchtransient.scenes.transforms import look_at, rotate, scale

PIXELS, SIZE, CYCLES = 8, 6.0, 20_000
AXIS = tt.TimeAxis(1.9, 0.08, 64)
NAMES = ("distance mm", "yaw deg", "pitch deg", "hidden mm", "albedo", "hidden albedo")
UNITS = torch.tensor([1e3, 180 / math.pi, 180 / math.pi, 1e3, 1.0, 1.0])
LOW = torch.tensor([1.2, -0.35, -0.25, 0.75, 0.30, 0.30])  # metres, radians, radians, metres, of 1, of 1
HIGH = torch.tensor([2.4, 0.35, 0.25, 1.50, 0.90, 0.90])
SPAN, MIDDLE = HIGH - LOW, (LOW + HIGH) / 2
KEYS = ("wall.to_world", "side.to_world", "wall.bsdf.reflectance.value", "side.bsdf.reflectance.value")
# A little beyond the ranges on both sides.
BOUNDS = Bounded(LOW - 0.15 * SPAN, HIGH + 0.13 * SPAN, margin=1e-4)
# Both walls before they are moved: 12 m squares, which meet outside of the picture and have no silhouette in it.
WALL, SIDE = (torch.tensor(m).float() for m in (scale(SIZE), rotate([0, 1, 0], -90) @ scale(SIZE)))


def described() -> dict[str, Any]:
    """The scene, with all unknowns in the middle of their ranges."""
    film = transient_film(PIXELS, AXIS.num_bins, AXIS.start_opl, AXIS.bin_width_opl)
    wall, side = (values_of(MIDDLE[None])[key][0].numpy() for key in KEYS[:2])
    return {
        "type": "scene",
        "integrator": transient_path(4),
        "sensor": perspective(look_at([0, 0, 0], [0, 0, -1]), 30.0, film, 64),
        "light": {"type": "point", "position": [0.1, 0, 0], "intensity": 10.0},
        "wall": {"type": "rectangle", "to_world": wall, "bsdf": diffuse(float(MIDDLE[4]))},
        "side": {"type": "rectangle", "to_world": side, "bsdf": diffuse(float(MIDDLE[5]))},
    }


class Scenes(NamedTuple):
    """``unknowns``: (N, 6). ``light``: (N, 1, T, H, W), rendered."""

    unknowns: Tensor
    light: Tensor


def scenes(seed: int, count: int, spp: int, label: str) -> Scenes:
    """``count`` scenes of a recipe, which decides about them with its seed alone."""
    data, half, (yaw, pitch) = tt.data, (SPAN / 2).tolist(), (SPAN[1:3] / 2 * UNITS[1:3]).tolist()
    turned = [data.Turn([1, 0, 0], -pitch, pitch), data.Turn([0, 1, 0], -yaw, yaw)]
    vary = {
        "wall.to_world": data.Compose([*turned, data.Offset([0, 0, -half[0]], [0, 0, half[0]])]),
        "side.to_world": data.Offset([-half[3], 0, 0], [half[3], 0, 0]),
        "wall.bsdf.reflectance.value": data.Uniform(float(LOW[4]), float(HIGH[4])),
        "side.bsdf.reflectance.value": data.Uniform(float(LOW[5]), float(HIGH[5])),
    }
    recipe = data.Recipe(
        described(), vary, spp=spp, temporal_filter="tent", keep=["transient"], variant="llvm_ad_mono", seed=seed
    )
    samples = [recipe.sample(number) for number in tqdm(range(count), desc=label, unit="scene")]
    wall, side, albedo, other = (torch.stack([torch.tensor(s.values[key]) for s in samples]) for key in KEYS)
    yaw, pitch = torch.atan2(wall[:, 0, 2], wall[:, 2, 2]), -torch.asin(wall[:, 1, 2] / SIZE)
    unknowns = torch.stack([-wall[:, 2, 3], yaw, pitch, side[:, 0, 3], albedo, other], 1)
    return Scenes(unknowns, torch.stack([torch.tensor(s.arrays["transient"]) for s in samples]))


def values_of(unknowns: Tensor) -> dict[str, Tensor]:
    """(B, 6) -> what the renderer takes: poses (B, 4, 4) of the wall and of the hidden wall, two albedos (B,)."""
    distance, yaw, pitch, hidden, albedo, other = unknowns.unbind(1)
    zero = torch.zeros_like(distance)
    turned, first, moved = (
        pose_from_axis_angle(torch.stack(six, 1))
        for six in ((zero, yaw, zero, zero, zero, -distance), (pitch, *5 * [zero]), (*3 * [zero], hidden, zero, zero))
    )
    return dict(zip(KEYS, (turned @ first @ WALL, moved @ SIDE, albedo, other), strict=True))


def renderer() -> tt.TransientRenderer:
    """Renders any values of the unknowns, with gradients."""
    scene = tt.load(described(), variant="llvm_ad_mono")
    return tt.TransientRenderer(scene, parameters=list(KEYS), spp=64, temporal_filter="tent")


class Background(sensing.Sensor):
    """Counts of an exposure, of detections per cycle: those of the flash and ``level()`` others in each bin."""

    def __init__(self, counts: float) -> None:
        super().__init__()
        self.log_counts = nn.Parameter(torch.tensor(math.log(counts)))

    def level(self) -> Tensor:
        """Counts per bin, of all pixels or (H, W)."""
        return self.log_counts.exp()

    def expected(self, x: Tensor) -> Tensor:
        return CYCLES * x + self.level()


def counter(response: sensing.Response, background: Background) -> sensing.Compose:
    """Laser, lens and detector; response; counts of the exposure. So few a cycle that their noise is Poisson's."""
    optics = sensing.Optics(f_number=2.0, pixel_area_m2=1.1e-10)
    budget = sensing.PhotonBudget(
        optics, pulse_energy_j=1e-9, wavelength_m=940e-9, repetition_rate_hz=1e6, cycles=CYCLES,
        quantum_efficiency=0.08, axis=AXIS,
    )  # fmt: skip
    return sensing.Compose([budget, sensing.ImpulseResponse(response, AXIS), background, sensing.ShotNoise()])


def bins(number: float) -> float:
    """So many bins in seconds."""
    return number * AXIS.bin_width_s


def known_counter() -> sensing.Compose:
    """A core of 2.1 bins (FWHM), a tenth of the light in a short tail, 0.1 other counts a bin."""
    response = sensing.TailedResponse(bins(2.1), [bins(0.3)], [0.1])
    return counter(response, Background(0.1)).requires_grad_(False)


class Network(nn.Module):
    """Counts (B, 1, T, H, W) -> unknowns (B, 6). 0.19 million weights; bins are channels of images."""

    def __init__(self, width: int = 48) -> None:
        super().__init__()
        sizes = [(AXIS.num_bins, width, 1), (width, width, 3), (width, 16, 3)]
        convolutions = [nn.Conv2d(a, b, k, padding=k // 2) for a, b, k in sizes]
        self.body = nn.Sequential(*(m for c in convolutions for m in (c, nn.SiLU())), nn.Flatten())
        self.head = nn.Sequential(nn.Linear(16 * PIXELS**2, 128), nn.SiLU(), nn.Linear(128, 6))

    def forward(self, counts: Tensor) -> Tensor:
        return BOUNDS(self.head(self.body(losses.anscombe(counts)[:, 0] / 2 - 1)))


def train(loss_of: Callable[[Network, Tensor], Tensor], count: int, steps: int, label: str) -> Network:
    """A new network after ``steps`` of Adam on ``loss_of(network, numbers of 32 of count scenes)``."""
    network = Network()
    optimizer = torch.optim.Adam(network.parameters(), fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, total_steps=steps)
    for _ in tqdm(range(steps), desc=label, unit="step"):
        optimizer.zero_grad()
        loss_of(network, torch.randint(0, count, (32,))).backward()
        optimizer.step()
        schedule.step()
    return network


def in_ranges(found: Tensor, truth: Tensor) -> Tensor:
    """Errors (B, 6) as shares of the ranges."""
    return (found - truth) / SPAN


Misfit = Callable[[Tensor, Tensor], Tensor]


def roots(mean: Tensor, counts: Tensor) -> Tensor:
    """Nearly minus the log-likelihood of counts, up to a constant, without a logarithm of a noisy render."""
    return losses.expected_root_loss(mean, counts, reduction="sum") / 2


def running_sums(mean: Tensor, counts: Tensor) -> Tensor:
    """Has a slope however far away the truth is."""
    return losses.cumulative_loss(mean, counts, 1.0, per_root_count=True, reduction="sum")


def squares(mean: Tensor, counts: Tensor) -> Tensor:
    """Squared errors over the mean counts of each scene."""
    return ((mean - counts).square() / counts.mean((1, 2, 3, 4), keepdim=True)).sum()


def weighted(mean: Tensor, counts: Tensor, variance: Tensor) -> Tensor:
    """Squares over a variance that knows nothing of this render's noise: quadratic in the render, so that its noise
    biases nothing, since the layer draws the samples of a gradient anew. Near the truth as good as the likelihood.
    """
    return 0.5 * ((mean - counts).square() / variance).sum()


@dataclass(frozen=True)
class Fit:
    """Adam through renderer and sensor. ``misfit`` None: weighted squares, of the variance of the start. ``spp``: of
    the first three fifths of the steps; ``late``: of the others.
    """

    model: tt.TransientRenderer
    sensor: sensing.Compose
    counts: Tensor

    def __call__(
        self, start: Tensor, *, steps: int = 30, rate: float = 0.05, misfit: Misfit | None = None, spp: int = 64,
        late: int | None = None, sigma: Tensor | None = None, label: str = "fit",
    ) -> Tensor:  # fmt: skip
        """(B, 6) from (B, 6). ``sigma`` (6,): the start is a normal prior of that width, in shares of the ranges."""
        start = start.detach()
        if misfit is None:
            with torch.no_grad():
                misfit = partial(weighted, variance=self.mean(start, 512))
        free = nn.Parameter(BOUNDS.right_inverse(start))
        optimizer = torch.optim.Adam([free], betas=(0.8, 0.95))
        for step in tqdm(range(steps), desc=label, unit="step", leave=False):
            optimizer.param_groups[0]["lr"] = rate * (1 - step / steps) ** 0.7
            found, samples = BOUNDS(free), spp if late is None or step < 0.6 * steps else late
            loss = misfit(self.mean(found, samples), self.counts)
            if sigma is not None:
                loss = loss + 0.5 * (in_ranges(found, start) / sigma).square().sum()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        return BOUNDS(free.detach())

    def mean(self, unknowns: Tensor, spp: int) -> Tensor:
        """Expected counts (B, 1, T, H, W)."""
        return self.sensor.expected(self.model(values_of(unknowns), spp=spp).transient)

    def from_afar(self, start: Tensor, steps: int = 30) -> Tensor:
        """Running sums first, then roots, which fit well near the truth."""
        near = self(start, steps=steps // 2, rate=0.2, misfit=running_sums)
        return self(near, steps=steps - steps // 2, misfit=roots, late=512)


@dataclass
class Table:
    """Errors of several methods, of some scenes and seeds, and CPU seconds."""

    errors: dict[str, list[Tensor]] = field(default_factory=dict)
    seconds: dict[str, list[float]] = field(default_factory=dict)

    def add(self, name: str, found: Tensor, truth: Tensor, seconds: float = 0.0) -> None:
        self.errors.setdefault(name, []).append(in_ranges(found.detach(), truth).abs())
        self.seconds.setdefault(name, []).append(seconds)
        tqdm.write(self.row(name, last=True))

    def percent(self, name: str) -> float:
        """Mean error of the six unknowns, in percent of their ranges."""
        return 100 * float(torch.cat(self.errors[name]).mean())

    def row(self, name: str, last: bool = False) -> str:
        errors, seconds = self.errors[name][-1:] if last else self.errors[name], self.seconds[name]
        mean = (torch.cat(errors) * SPAN * UNITS).mean(0).tolist()
        shown = "".join(f"{x:10.2f}" for x in mean[:4]) + "".join(f"{x:10.3f}" for x in mean[4:])
        percent = 100 * float(torch.cat(errors).mean())
        return f"{name:<46}{shown}{percent:9.2f}{seconds[-1] if last else sum(seconds) / len(seconds):9.1f}"

    def __str__(self) -> str:
        head = "".join(f"{name[-9:]:>10}" for name in NAMES)
        return "\n".join([f"{'':<46}{head}{'all %':>9}{'CPU s':>9}", *(self.row(name) for name in self.errors)])
