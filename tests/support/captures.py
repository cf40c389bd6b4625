"""Captures whose light is known: a hidden plane in closed form."""

from __future__ import annotations

import torch

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan, Wall
from torchtransient.testing import closed_forms

WALL = Wall.plane(2.0, 1.6, albedo=0.9)
AXIS = TimeAxis(1.2, 0.02, 100)


def confocal_plane(depth=0.8, size=(16, 12), wall_albedo=0.9, albedo=0.7):
    """Confocal capture of an infinite plane `depth` metres before a wall and parallel to it, the same everywhere."""
    scan = Scan.grid(WALL, size, kind="confocal")
    bins = torch.from_numpy(closed_forms.confocal_plane(AXIS.edges_opl, depth, albedo, wall_albedo)).float()
    return Capture(bins[None, :, None, None].expand(1, -1, *scan.shape).clone(), AXIS, scan)


def tilted(size=(16, 12), near=0.7, slope=0.2):
    """Confocal capture of a mirror-like plane: all light of a point in the bin of twice its distance, which grows by
    `slope` metres per metre in x.
    """
    scan = Scan.grid(WALL, size, kind="confocal")
    length = 2 * (near + slope * (scan.sensor_points[..., 0] + 1))
    index = AXIS.bin_index(length)
    transient = torch.zeros(1, AXIS.num_bins, *scan.shape)
    transient.scatter_(1, index[None, None], 1.0)
    return Capture(transient, AXIS, scan), index
