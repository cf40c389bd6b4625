"""Small reconstruction operators of every kind: what stands here runs the tests of the contract."""

import torch

from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan, Wall
from torchtransient.reconstruction import (
    Backprojection,
    ConfocalCamera,
    FilteredBackprojection,
    LaplacianFilter,
    PhasorField,
    PhasorFilter,
    TransientCamera,
    VoxelGrid,
)

AXIS = TimeAxis(0.1, 0.02, 24)
WALL = Wall.plane(0.24, 0.2)
SCANS = {
    "confocal": Scan.grid(WALL, (4, 3), kind="confocal"),
    "single": Scan.grid(WALL, (4, 3), kind="single", laser=(0.3, 0.6)),
    "exhaustive": Scan.grid(WALL, (3, 2), kind="exhaustive", laser_grid=(2, 2)),
    "confocal, legs": Scan.grid(WALL, (4, 3), kind="confocal", first_and_last_leg=True),
    "exhaustive, legs": Scan.grid(WALL, (3, 2), kind="exhaustive", laser_grid=(1, 2), first_and_last_leg=True),
}
PULSE = PhasorFilter(0.09, 3.0)
DEPTHS = (0.1, 0.16, 0.22)


def points_anywhere(count=7, seed=0):
    """Points (N, 3) before the wall."""
    generator = torch.Generator("cpu").manual_seed(seed)
    low, size = (torch.tensor(x, device="cpu") for x in ([-0.1, -0.1, 0.06], [0.2, 0.2, 0.15]))
    return (low + size * torch.rand(count, 3, generator=generator, device="cpu")).double()


def bent_scan():
    """Confocal points on a wall that is bent around y."""
    across, along = (torch.linspace(-0.1, 0.1, n, device="cpu") for n in (4, 3))
    x, y = torch.meshgrid(across, along, indexing="xy")
    points = torch.stack([x, y, 0.05 * (x / 0.1) ** 2], -1).double()
    return Scan.points(points, kind="confocal", sensor_origin=(0.0, 0.0, 0.5), laser_origin=(0.0, 0.0, 0.5))


def listed_scan():
    """Three spots and four sensor points that stand anywhere on the wall."""
    generator = torch.Generator("cpu").manual_seed(1)
    points = 0.2 * torch.rand(7, 2, generator=generator, device="cpu") - 0.1
    points = torch.nn.functional.pad(points, (0, 1)).double()
    return Scan.points(
        points[:4], kind="exhaustive", laser_points=points[4:], sensor_origin=(0.0, 0.0, 0.06),
        laser_origin=(0.05, 0.0, 0.05), first_and_last_leg=True,
    )  # fmt: skip


def paired_scan():
    """A spot of its own for each of five sensor points of a wall that is measured point by point, with its normals."""
    generator = torch.Generator("cpu").manual_seed(2)
    points = 0.2 * torch.rand(10, 3, generator=generator, device="cpu").double() - 0.1
    points[:, 2] *= 0.2
    normals = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, device="cpu") + points
    return Scan.points(
        points[:5], kind="pairs", laser_points=points[5:], normals=normals[:5], laser_normals=normals[5:],
        sensor_origin=(0.0, 0.0, 0.06), laser_origin=(0.05, 0.0, 0.05), first_and_last_leg=True,
    )  # fmt: skip


def operators(dtype=torch.float64):
    """Name -> operator."""
    of = {"time_axis": AXIS, "dtype": dtype}
    found = {}
    for name, scan in SCANS.items():
        grid = VoxelGrid.before(scan, DEPTHS)
        found |= {
            f"backprojection, {name}": Backprojection(scan, grid, falloff=1.0, **of),
            f"filtered backprojection, {name}": FilteredBackprojection(scan, grid, filter=PULSE, **of),
            f"phasor field, {name}": PhasorField(scan, grid, pulse=PULSE, falloff=1.0, **of),
        }
    single, confocal = SCANS["single"], SCANS["confocal"]
    grid = VoxelGrid.before(confocal, DEPTHS)
    larger = VoxelGrid.before(single, DEPTHS, size=(6, 4), extent=(6 * 0.06, 4 * 0.2 / 3))
    moments = torch.tensor([0.1, 0.16, 0.3, 0.31], device="cpu")
    return found | {
        "backprojection, bent wall": Backprojection(bent_scan(), points_anywhere(), **of),
        "backprojection, lists": Backprojection(listed_scan(), points_anywhere(), falloff=2.0, **of),
        "backprojection, pairs": Backprojection(paired_scan(), points_anywhere(), falloff=1.0, **of),
        "filtered backprojection, pairs": FilteredBackprojection(
            paired_scan(), points_anywhere(), filter=PULSE, falloff=1.0, **of
        ),
        "backprojection, compensated": Backprojection(confocal, grid, falloff=-2.0, **of),
        "laplacian": FilteredBackprojection(confocal, grid, filter=LaplacianFilter(0.8), **of),
        "filtered backprojection, lists": FilteredBackprojection(
            listed_scan(), points_anywhere(), filter=PULSE, falloff=1.0, **of
        ),
        "phasor field, larger planes": PhasorField(single, larger, pulse=PULSE, falloff=0.5, **of),
        "confocal camera": PhasorField(confocal, grid, pulse=PULSE, camera=ConfocalCamera(moments - 0.1), **of),
        "confocal camera, single": PhasorField(single, grid, pulse=PULSE, camera=ConfocalCamera(moments - 0.1), **of),
        "transient camera": PhasorField(single, grid, pulse=PULSE, camera=TransientCamera(moments), **of),
    }
