"""Small operators of confocal grids, in double precision, and light of known points. What stands in the list runs the
tests of the contract.
"""

import torch

from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan, Wall
from torchtransient.reconstruction import FK, LCT, DiffusionDeconvolution, DirectionalLCT, MidpointFK

AXIS = TimeAxis(0.1, 0.04, 16)
# Neither square nor of equal pitch.
WALL = Wall.plane(0.15, 0.24)
SCAN = Scan.grid(WALL, (5, 6), kind="confocal")
SINGLE = Scan.grid(WALL, (4, 3), kind="single", laser=(0.3, 0.6))
EXHAUSTIVE = Scan.grid(WALL, (4, 3), kind="exhaustive", laser_grid=(2, 3))


def operators(dtype=torch.float64):
    """Name -> operator."""
    of = {"time_axis": AXIS, "dtype": dtype}
    cone, finer = LCT(SCAN, **of), LCT(SCAN, v_bins=23, target="retroreflective", **of)
    directional = DirectionalLCT(SCAN, **of)
    slab = DiffusionDeconvolution(SCAN, **of)
    return {
        "fk": FK(SCAN, **of),
        "fk, retroreflective, 2 taps, floor": FK(SCAN, taps=2, target="retroreflective", floor=0.25, **of),
        "lct": cone,
        "lct, finer": finer,
        "directional lct": directional,
        "slab": slab,
        "midpoint fk, single": MidpointFK(SINGLE, **of),
        "midpoint fk, exhaustive": MidpointFK(EXHAUSTIVE, **of),
        "inverse of lct": cone.inverse,
        "inverse of finer lct": finer.inverse,
        "inverse of directional lct": directional.inverse,
        "inverse of slab": slab.inverse,
    }


def confocal_points(points, scan, axis, *, power=4, sigma_bins=2.0):
    """(T, Y, X) float64: light r^-power of isotropic points, Gaussian pulses integrated over the bins."""
    wall = scan.sensor_points
    light = torch.zeros(axis.num_bins, *scan.sensor_shape, dtype=torch.float64)
    for point in points:
        r = (wall - torch.tensor(point, dtype=torch.float64)).norm(dim=-1)
        steps = (axis.edges_opl[:, None, None] - 2 * r) / (sigma_bins * axis.bin_width_opl)
        light += r**-power * torch.special.ndtr(steps).diff(dim=0)
    return light
