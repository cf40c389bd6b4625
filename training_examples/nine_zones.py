"""A consumer time-of-flight chip of nine zones before a wall: its model, and counts of it.

The chip (ams TMF88xx) has 3 x 3 zones and 128 bins of 88 ps. Light goes from the chip to the wall and back; zones look
into directions with normal weights, and overlap. Behind the light come impulse response, ambient light and pile-up.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

import torchtransient as tt
from torchtransient import sensing
from torchtransient.scenes import look_at, scale
from torchtransient.scenes.parts import diffuse, perspective, transient_film, transient_path

BIN_S, ZERO, FIRST, LAST, FINE = 88e-12, 13, 24, 73, 4  # bins behind the cross-talk and before what else is in the room
AXIS = tt.TimeAxis.from_seconds((FIRST - ZERO) * BIN_S, BIN_S / FINE, (LAST - FIRST) * FINE)
PIXELS, REACH, WALL, KEY = 24, 0.8, torch.tensor(scale(3.0)).float(), "wall.to_world"  # REACH: tangent of the picture
# Tangents of the zones' directions, (9, 2) rows and columns: those of the published point cloud.
CENTRES = torch.cartesian_prod(*(torch.tensor([-1.0, 0.0, 1.0]) * math.tan(math.radians(a)) for a in (16.59, 13.29)))
SPREAD = torch.tensor([[0.3], [0.3], [0.2]])  # of what zones have for themselves: log gain, delay in bins, log ambient


class Chip(nn.Module):
    """Mean counts (9, T) of the zones. `narrow`: they look into one direction each, as without a renderer."""

    def __init__(self, total: float, ambient: float, narrow: bool = False) -> None:
        super().__init__()
        film = transient_film(PIXELS, AXIS.num_bins, AXIS.start_opl, AXIS.bin_width_opl)
        scene = {
            "type": "scene", "integrator": transient_path(2),
            "sensor": perspective(look_at([0, 0, 0], [0, 0, -1]), 2 * math.degrees(math.atan(REACH)), film, 16),
            "light": {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": 1.0},
            "wall": {"type": "rectangle", "to_world": WALL.numpy(), "bsdf": diffuse(0.8)},
        }  # fmt: skip
        self.renderer = tt.TransientRenderer(tt.load(scene, variant="llvm_ad_mono"), [KEY], temporal_filter="tent")
        response = sensing.TailedResponse(150e-12, [120e-12, 500e-12], [0.6, 0.2], learnable=True)
        response.delay_ps.requires_grad_(False)  # the distance is it
        self.response, self.spad = sensing.ImpulseResponse(response, AXIS), sensing.SynchronousSPAD(1)
        self.pose = nn.Parameter(torch.tensor([0.0, 0.0, 0.23]))  # two turns, radians, and the distance, metres
        self.log_width = nn.Parameter(torch.full((2,), math.log(0.03 if narrow else 0.15)), requires_grad=not narrow)
        self.beam = nn.Parameter(torch.tensor([0.0, 0.0, -3.0, -3.0]))  # log of it, a parabola
        self.levels = nn.Parameter(torch.tensor([total / 3, ambient, 3e7]).log())  # the last: cycles times SPADs
        self.own = nn.Parameter(torch.zeros(3, 9))
        place = REACH * ((torch.arange(PIXELS) + 0.5) / PIXELS * 2 - 1)
        self.places = torch.cartesian_prod(place, place)

    def light(self, seed: int, spp: int = 16) -> Tensor:
        """(9, FINE T): what the zones get of the wall, response included."""
        (pitch, yaw, distance), zero = self.pose, torch.zeros(())
        pose = tt.parametrize.pose_from_axis_angle(torch.stack([pitch, yaw, zero, zero, zero, -distance])) @ WALL
        seen = self.renderer({KEY: pose}, seed=seed, spp=spp).transient[0].flatten(1)
        zones = ((self.places - CENTRES[:, None]) / self.log_width.exp()).square().sum(2).div(-2).softmax(1)
        lit = torch.cat([self.places, self.places.square()], 1) @ self.beam
        zones = zones * (lit + self.levels[0] + self.own[0, :, None]).exp()
        return self.response((zones @ seen.T).T[None, :, None])[0, :, 0].T

    def counts(self, light: Tensor, delays: Tensor) -> Tensor:
        """(9, T), of the light, delays (9,) in bins, ambient light and pile-up."""
        edges, (_, ambient, cycles) = torch.arange(LAST - FIRST + 1) * BIN_S, self.levels
        parts = zip(light, delays * BIN_S, strict=True)
        rate = torch.stack([sensing.resample_counts(part, BIN_S / FINE, edges, start_s=late) for part, late in parts])
        rate = rate + (ambient + self.own[2]).exp()[:, None]
        return self.spad((rate / cycles.exp()).T[None, :, None])[0, :, 0].T * cycles.exp()


def deviation(counts: Tensor) -> Tensor:
    """What a model may be off by: Poisson noise, 3 % of the bin, 0.3 % of the highest one."""
    return (counts + (0.03 * counts).square() + (0.003 * counts.amax(-1, keepdim=True)).square()).sqrt()


def measured(folder: str) -> Tensor:
    """Counts (9, T) of the published frame."""
    frame = np.load(Path(folder, "consumer_lidar", "ams_U_iter_0.npy"), allow_pickle=True).item()
    return torch.tensor(frame["histogram"]).reshape(9, 128)[:, FIRST:LAST].float()


def simulated(seed: int) -> Tensor:
    """Counts (9, T) of such a chip before such a wall."""
    chip, generator = Chip(1.5e6, 400.0), torch.Generator().manual_seed(seed)
    with torch.no_grad():
        chip.pose.copy_(torch.tensor([0.06, -0.04, 0.235]))
        chip.own.copy_(SPREAD * torch.randn(3, 9, generator=generator))
        return sensing.poisson(chip.counts(chip.light(seed, spp=4096), chip.own[1]), generator).float()
