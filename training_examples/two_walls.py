"""The scene, the unknowns and the photon counter that the two hybrid examples share.

A camera with a flash beside it looks at a wall. A second wall at its side is never in the picture: it shows in light
of two and three bounces alone. Six numbers are unknown: distance, yaw and pitch of the wall, distance of the hidden
wall, both albedos. 8 x 8 pixels, 64 bins of 8 cm of path, about 100 counts of the flash and 6 others a pixel.
"""

from __future__ import annotations

import math
import warnings
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from tqdm import tqdm

import torchtransient as tt
from torchtransient import sensing
from torchtransient.parametrize import Bounded, pose_from_axis_angle
from torchtransient.scenes import look_at, rotate, scale
from torchtransient.scenes.parts import diffuse, perspective, transient_film, transient_path

PIXELS, SIZE, CYCLES = 8, 6.0, 20_000
AXIS = tt.TimeAxis(1.9, 0.08, 64)
NAMES = ("distance, mm", "yaw, deg", "pitch, deg", "hidden, mm", "albedo", "hidden albedo")
UNITS = torch.tensor([1e3, 180 / math.pi, 180 / math.pi, 1e3, 1.0, 1.0])  # of metres, radians, shares
LOW = torch.tensor([1.2, -0.35, -0.25, 0.75, 0.30, 0.30])
HIGH = torch.tensor([2.4, 0.35, 0.25, 1.50, 0.90, 0.90])
SPAN, MIDDLE = HIGH - LOW, (LOW + HIGH) / 2
KEYS = ("wall.to_world", "side.to_world", "wall.bsdf.reflectance.value", "side.bsdf.reflectance.value")
BOUNDS = Bounded(LOW - 0.15 * SPAN, HIGH + 0.13 * SPAN, margin=1e-4)  # a little beyond the ranges
# Both walls before they are moved: squares of 12 m, which have no silhouette in the picture.
WALL, SIDE = (torch.tensor(m).float() for m in (scale(SIZE), rotate([0, 1, 0], -90) @ scale(SIZE)))
# The corner in which they meet is out of the picture, and each wall sees it at a grazing angle, without light.
warnings.filterwarnings("ignore", "the derivative by .* run into each other", tt.errors.GradientWarning)


def values_of(unknowns: Tensor) -> dict[str, Tensor]:
    """(B, 6) -> what the renderer takes: poses (B, 4, 4) of the wall and of the hidden wall, two albedos (B,)."""
    distance, yaw, pitch, hidden, albedo, other = unknowns.unbind(1)
    zero = torch.zeros_like(distance)
    moved, tilted, aside = (
        pose_from_axis_angle(torch.stack(six, 1))
        for six in ((zero, yaw, zero, zero, zero, -distance), (pitch, *5 * [zero]), (*3 * [zero], hidden, zero, zero))
    )
    return dict(zip(KEYS, (moved @ tilted @ WALL, aside @ SIDE, albedo, other), strict=True))


def described() -> dict[str, Any]:
    """The scene, with all unknowns in the middle of their ranges."""
    wall, side, albedo, other = (value[0].numpy() for value in values_of(MIDDLE[None]).values())
    film = transient_film(PIXELS, AXIS.num_bins, AXIS.start_opl, AXIS.bin_width_opl)
    return {
        "type": "scene",
        "integrator": transient_path(4),
        "sensor": perspective(look_at([0, 0, 0], [0, 0, -1]), 30.0, film, 64),
        "light": {"type": "point", "position": [0.1, 0, 0], "intensity": 10.0},
        "wall": {"type": "rectangle", "to_world": wall, "bsdf": diffuse(float(albedo))},
        "side": {"type": "rectangle", "to_world": side, "bsdf": diffuse(float(other))},
    }


def renderer() -> tt.TransientRenderer:
    """Renders any values of the unknowns, with gradients."""
    scene = tt.load(described(), variant="llvm_ad_mono")
    # Light that took many bounces comes after the window, as it does where one measures.
    return tt.TransientRenderer(scene, parameters=list(KEYS), spp=64, temporal_filter="tent", physics="ignore")


class Scenes(NamedTuple):
    """``unknowns``: (N, 6). ``light``: (N, 1, T, H, W), rendered."""

    unknowns: Tensor
    light: Tensor


def scenes(seed: int, count: int, spp: int, label: str) -> Scenes:
    """``count`` scenes of a recipe; another seed makes others."""
    data, (depth, yaw, pitch, aside, *_) = tt.data, (SPAN / 2).tolist()
    turned = [data.Turn(axis, -math.degrees(a), math.degrees(a)) for axis, a in (([1, 0, 0], pitch), ([0, 1, 0], yaw))]
    vary = {
        "wall.to_world": data.Compose([*turned, data.Offset([0, 0, -depth], [0, 0, depth])]),
        "side.to_world": data.Offset([-aside, 0, 0], [aside, 0, 0]),
        "wall.bsdf.reflectance.value": data.Uniform(float(LOW[4]), float(HIGH[4])),
        "side.bsdf.reflectance.value": data.Uniform(float(LOW[5]), float(HIGH[5])),
    }
    recipe = data.Recipe(
        described(), vary, spp=spp, temporal_filter="tent", keep=["transient"], variant="llvm_ad_mono", seed=seed
    )
    samples = [recipe.sample(number) for number in tqdm(range(count), desc=label, unit="scene", leave=False)]
    wall, side, albedo, other = (torch.stack([torch.tensor(s.values[key]) for s in samples]) for key in KEYS)
    turns = torch.atan2(wall[:, 0, 2], wall[:, 2, 2]), -torch.asin(wall[:, 1, 2] / SIZE)
    unknowns = torch.stack([-wall[:, 2, 3], *turns, side[:, 0, 3], albedo, other], 1)
    return Scenes(unknowns, torch.stack([torch.tensor(s.arrays["transient"]) for s in samples]))


def bins(number: float) -> float:
    """So many bins in seconds."""
    return number * AXIS.bin_width_s


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


def known_counter() -> sensing.Compose:
    """A core of 2.1 bins (FWHM), a tenth of the light in a short tail, 0.1 other counts a bin."""
    return counter(sensing.TailedResponse(bins(2.1), [bins(0.3)], [0.1]), Background(0.1)).requires_grad_(False)
