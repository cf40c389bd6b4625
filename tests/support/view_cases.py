"""Small results of every kind that a page shows, with numbers that differ from pixel to pixel and bin to bin."""

from __future__ import annotations

import math
from types import SimpleNamespace

import torch

import torchtransient as tt
from torchtransient.reconstruction import HiddenVolume, VoxelGrid

AXIS = tt.TimeAxis(2.0, 0.1, 24)
H, W = 10, 14


def noise(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def front(channels=3, height=H, width=W, axis=AXIS, seed=0, speed=12.0):
    """A front of light that crosses the picture, with noise, and a faint tail."""
    times = torch.arange(axis.num_bins)[:, None, None].float()
    rows, columns = torch.meshgrid(torch.arange(height).float(), torch.arange(width).float(), indexing="ij")
    late = times - 3 - torch.hypot(rows - height / 2, columns) * speed / 12.0
    light = torch.where(late >= 0, torch.exp(-late / 3), torch.zeros(()))
    colour = torch.linspace(1.0, 0.4, channels)[:, None, None, None]
    return colour * light * (0.7 + 0.6 * noise(channels, *light.shape, seed=seed))


def stokes():
    s0 = front(1)[0] + 0.01
    angle = 0.3 * torch.arange(W)
    degree = 0.2 + 0.07 * torch.arange(H)[:, None]
    parts = [s0, s0 * degree * torch.cos(angle), s0 * degree * torch.sin(angle), 0.1 * s0 * degree]
    return torch.stack([part.expand_as(s0) for part in parts])[:, None]


def phasors(count=5):
    frequencies = tt.FrequencyAxis.uniform(1.0, 0.5, count)
    lengths = AXIS.centers_opl.float()
    wave = torch.exp(-2j * math.pi * frequencies.per_metre[:, None].float() * lengths)
    return torch.einsum("ft,cthw->cfhw", wave, front(1).to(torch.complex64)), frequencies


def slow_phasors(times=16):
    """Phasors that turn from pulse to pulse, the faster the further to the right."""
    cube, frequencies = phasors(3)
    turns = torch.arange(times)[:, None] * torch.linspace(0.0, 0.2, W)
    wave = torch.exp(2j * math.pi * turns)[None, :, None, None, :]
    return result(slow_phasor=cube[:, None] * wave, frequencies=frequencies,
                  slow_times=tuple(1e-3 * n for n in range(times)))  # fmt: skip


def rates():
    rate_axis = tt.RateAxis(-20.0, 4.0, 10)
    speeds = 0.1 + 0.8 * torch.arange(W) / W
    share = torch.softmax(-((rate_axis.centers[:, None].float() - (40 * speeds - 20)) ** 2) / 30, 0)
    return share[None, :, None, None, :] * front(1)[:, None], rate_axis


def capture(kind="confocal", size=(8, 6), bins=24):
    grids = {"laser_grid": (4, 3)} if kind == "exhaustive" else {}
    grids |= {"laser": (0.4, 0.3)} if kind == "single" else {}
    scan = tt.nlos.Scan.grid(
        {"type": "rectangle"},
        kind=kind,
        size=size,
        sensor_origin=(0.2, 0.0, 2.0),
        laser_origin=(-0.2, 0.0, 2.0),
        **grids,
    )
    axis = tt.TimeAxis(1.0, 0.05, bins)
    cube = noise(1, bins, *scan.shape, seed=4) * (1 + torch.arange(scan.shape[-1]))
    return tt.nlos.Capture(cube, axis, scan)


def volume(rows=10):
    depths = torch.linspace(0.4, 1.0, 12)
    grid = VoxelGrid(
        depths, (rows, 14), (0.1, 0.1), first=(-0.65, -0.45, 0.0), along_x=(1.0, 0.0, 0.0), along_y=(0.0, 1.0, 0.0),
        normal=(0.0, 0.0, 1.0),
    )  # fmt: skip
    z, y, x = torch.meshgrid(torch.arange(12), torch.arange(rows), torch.arange(14), indexing="ij")
    ball = torch.exp(-((z - 6.0) ** 2 + (y - 6.0) ** 2 + (x - 4.0) ** 2) / 4) + 0.05 * noise(12, rows, 14)
    # More light in all than in any slice of the ball.
    ball[:3] += 0.3 * noise(3, rows, 14, seed=3)
    return HiddenVolume(ball[None], grid, "ball")


def counts(most=20):
    return torch.poisson(most * front(1), generator=torch.Generator().manual_seed(5))


def result(**tensors):
    return SimpleNamespace(axis=AXIS, **tensors)
