"""Captures that each layout can hold, and files with them."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import h5py
import numpy as np
import torch

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan, Wall
from torchtransient.errors import StorageError
from torchtransient.files.captures.formats import LAYOUTS
from torchtransient.files.captures.matlab import write_mat as write_mat
from torchtransient.nlos import HiddenVolume, VoxelGrid

# Endings of files by layout, and the layouts that are written.
ENDINGS = {"torchtransient": ".h5"} | {name: layout.ENDINGS[0] for name, layout in LAYOUTS.items()}
WRITTEN = ["torchtransient", *(name for name, layout in LAYOUTS.items() if hasattr(layout, "write"))]

AXIS = TimeAxis(1.1, 0.003, 7)
FROM_ZERO = TimeAxis(0.0, 0.003, 7)
FREQUENCIES = FrequencyAxis((1.0, 2.1, 30.3), 0.7)
WALL = Wall.plane(2.0, 1.6)
SQUARE = Wall.plane(2.0, 2.0)
ORIGINS = {"sensor_origin": (0.1, 0.2, 0.9), "laser_origin": (-0.3, 0.0, 1.1)}
LIST = torch.tensor([[0.0, 0.1, 0.0], [0.1, 0.3, 0.0], [0.2, -0.1, 0.0]], dtype=torch.float64)
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def listed(kind, legs=True):
    apart = LIST.flip(0) + 0.05 * UP.roll(1)
    spots = {"single": LIST[1], "confocal": LIST, "exhaustive": LIST[:2], "pairs": apart}[kind]
    up = UP.expand(3, 3)
    return Scan(
        kind, LIST, spots, **{name: torch.tensor(origin) for name, origin in ORIGINS.items()},
        sensor_normals=up, laser_normals=up[: len(spots)] if spots.ndim == 2 else UP, first_and_last_leg=legs,
    )  # fmt: skip


def grids(legs=True, wall=WALL, size=(4, 3)):
    settings = {**ORIGINS, "first_and_last_leg": legs}
    scans = {
        "single": Scan.grid(wall, size, kind="single", laser=(0.625, 0.5), **settings),
        "confocal": Scan.grid(wall, size, kind="confocal", **settings),
        "exhaustive": Scan.grid(wall, size, kind="exhaustive", laser_grid=(2, 5), **settings),
    }
    return {kind: replace(scan, wall=None) for kind, scan in scans.items()}


def made(scan, axis=AXIS, polarized=False, phasor=False, **settings):
    """A capture of one channel whose numbers are all different, its points first in memory as films have them."""
    generator = torch.Generator().manual_seed(0)
    front = (*((4,) if polarized else ()), 1)
    count = FREQUENCIES.num_frequencies if phasor else axis.num_bins
    values = torch.rand(*scan.shape, *front, count, generator=generator)
    dims = len(scan.shape)
    values = values.permute(*range(dims, values.ndim), *range(dims))
    if phasor:
        values = torch.complex(values, values.flip(-1))
        settings |= {"phasor": values, "frequencies": FREQUENCIES, "transient": None, "axis": None}
    return Capture(**{"transient": values, "axis": axis, "scan": scan, "polarized": polarized, **settings})


def holdable():
    """Captures by layout and name that the layout holds without loss (but metadata)."""
    with_legs, without = grids(), grids(legs=False)
    yield "torchtransient", "confocal", made(with_legs["confocal"])
    yield "torchtransient", "pairs", made(listed("pairs"))
    grid = with_legs["confocal"]
    grid = replace(grid, kind="pairs", laser_points=grid.laser_points.flip(0))
    for name, scan in (("pairs", grid), ("pairs list", listed("pairs"))):
        yield "tal", name, made(scan)
        yield "tal", f"{name} phasor", made(scan, phasor=True)
    for kind in with_legs:
        yield "tal", kind, made(with_legs[kind])
        yield "tal", f"{kind} from wall to wall", made(without[kind])
        yield "tal", f"{kind} list", made(listed(kind))
        yield "tal", f"{kind} phasor", made(with_legs[kind], phasor=True)
        yield "tal", f"{kind} phasor list", made(listed(kind), phasor=True)
        yield "tal", f"{kind} polarized", made(with_legs[kind], polarized=True)
        yield "zaragoza", kind, made(with_legs[kind])
    whole = made(replace(with_legs["confocal"], wall=dict(WALL.shape)), channels=("y",), metadata={"a": [1, 0.1]})
    yield "tal", "all of it", replace(whole, steady=torch.rand(1, 3, 4))
    yield "zaragoza", "confocal square", made(grids(wall=SQUARE, size=(4, 4))["confocal"])
    yield "dirac", "confocal from wall to wall", made(without["confocal"])
    yield "dirac", "confocal", made(with_legs["confocal"])
    yield "phasor_field", "single", made(listed("single"))
    yield "phasor_field", "exhaustive", made(listed("exhaustive"))
    square = grids(legs=False, wall=SQUARE, size=(4, 4))
    square["single"] = replace(square["single"], laser_points=square["single"].sensor_points[1, 2])
    for kind in ("single", "confocal"):
        yield "rect_data", kind, made(square[kind], axis=FROM_ZERO)


def chip_frames(frames=2, zones=9, bins=12):
    """Frames of a chip as JSON has them: counts, the pulse, where the chip stands, how far away the wall is."""
    rng = np.random.default_rng(1)
    pose = [[0.0, -1.0, 0.0, 0.1], [-1.0, 0.0, 0.0, 0.2], [0.0, 0.0, -1.0, 0.3], [0.0, 0.0, 0.0, 1.0]]
    return [
        {
            "hists": rng.poisson(5.0, (zones, bins)).tolist(), "reference_hist": rng.poisson(9.0, bins).tolist(),
            "pose": pose, "dist_to_plane": 0.25 * (frame + 1), "time_captured": 0, "joint_angles": [0.5] * 6,
            "distances": [{"temperature": 24, "depths_1": [240 + zone for zone in range(zones)]}],
        }
        for frame in range(frames)
    ]  # fmt: skip


def zone_frame():
    """Arrays of a chip's 4 x 4 zones."""
    rng = np.random.default_rng(2)
    points = np.concatenate([rng.uniform(-0.5, 0.5, (16, 2)), rng.normal(0, 0.01, (16, 1))], 1)
    return {"hists": rng.poisson(5.0, (16, 8)).astype(np.float64), "pt_cloud": points, "cam_z": np.array(0.5)}


def read_only():
    """Content of files that other programs write, each with the name of its layout: arrays by name, or JSON."""
    rng = np.random.default_rng(0)
    along = {"xpos": np.linspace(1, 0, 5)[:, None], "zpos": np.linspace(0.15, 0, 5)[:, None]}
    return [
        ("cdt", {"meas": rng.poisson(3.0, (4, 4, 9)).astype(np.float32)}),
        ("cdt", {"out": rng.poisson(3.0, (9, 1)).astype(np.float64)}),
        ("keyhole", {"data": rng.poisson(3.0, (5, 9)).astype(np.float64), **along}),
        ("keyhole", {"direct_before": rng.poisson(3.0, (9, 1)).astype(np.uint32)}),
        ("rect_data", {"meas": rng.poisson(3.0, (9, 4, 4)).astype(np.uint16)}),
        ("tmf8828", chip_frames(1)),
        ("tmf8828", chip_frames(2)),
        ("vl53l8", zone_frame()),
    ]


def write_content(path, content):
    """Write arrays by name, or JSON, to a file as its ending says."""
    if path.suffix == ".json":
        path.write_text(json.dumps(content))
    elif path.suffix == ".npz":
        np.savez_compressed(path, **content)
    elif path.suffix == ".mat":
        write_mat(path, content)
    else:
        with h5py.File(path, "w") as file:
            for name, value in content.items():
                file[name] = value
    return path


# Values of arguments of `read_capture` that fit the small files.
ANSWERS = {
    "wall_size": 0.6, "bin_width_s": 1e-11, "start_s": 0.0, "sensor_origin": (0.0, 0.0, 1.0),
    "laser_origin": (0.0, 0.0, 1.0), "frame": 0,
}  # fmt: skip


def read_answered(path):
    """Return a capture of any layout, and the arguments without which it is not read."""
    given = {}
    while True:
        try:
            return Capture.read(path, **given), given
        except StorageError as error:
            asked = re.search(r"Give (\w+)=", str(error))
            if asked is None or asked[1] in given or asked[1] not in ANSWERS:
                raise
            given[asked[1]] = ANSWERS[asked[1]]


def sound_files(folder, layouts=tuple(ENDINGS)):
    """(layout, path) of small files that are written to a folder: of every capture that a layout holds, and of every
    content of layouts that other programs write.
    """
    found = []
    for number, (layout, _, capture) in enumerate(holdable()):
        if layout in layouts:
            found.append((layout, capture.write(folder / f"{number}{ENDINGS[layout]}", layout)))
    for number, (layout, content) in enumerate(read_only()):
        if layout in layouts:
            found.append((layout, write_content(folder / f"only{number}{ENDINGS[layout]}", content)))
    return found


def volume():
    """A hidden volume of whole numbers, 4 planes of 5 x 6 voxels."""
    eye = torch.eye(3, dtype=torch.float64)
    axes = dict(zip(("along_x", "along_y", "normal"), eye, strict=True))
    grid = VoxelGrid(torch.linspace(0.1, 1, 4), (5, 6), (0.1, 0.2), first=eye[0] * 0, **axes)
    return HiddenVolume(torch.arange(120.0).reshape(1, 4, 5, 6), grid, "fk", metadata={"a": 1})
