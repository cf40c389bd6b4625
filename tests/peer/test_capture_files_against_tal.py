"""Captures on disk against y-tal 0.20 and 0.21: it reads what is written here, and the other way round, bit for bit."""

import os
import subprocess
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from support.capture_files import ENDINGS, holdable
from torchtransient.axes import FrequencyAxis
from torchtransient.files.captures.formats import read_capture

pytestmark = pytest.mark.peer

# y-tal finds axes by equal sizes, reads one camera point, and grids with a fixed point.
NOT_READ_THERE = {"zaragoza-confocal", "phasor_field-exhaustive", "rect_data-confocal"}
HOLDABLE = {f"{layout}-{name}": (layout, c) for layout, name, c in holdable() if layout != "torchtransient"}
BINS, X, Y, LX, LY = 5, 4, 3, 2, 6
SHAPES = {
    "T_Sx_Sy": (BINS, X, Y), "T_Lx_Ly_Sx_Sy": (BINS, LX, LY, X, Y), "T_Si": (BINS, X), "T_Li_Si": (BINS, LX, X),
}  # fmt: skip
NEW = {name.replace("T_", "F_", 1): shape for name, shape in SHAPES.items()}
FREQUENCIES = FrequencyAxis(tuple(float(n) for n in range(BINS)))


@pytest.fixture
def tal(peer_python, tmp_path):
    """`tal(mode, source, target)` runs y-tal; `tal.fields(path)` is what it reads in a file; `tal.version`."""

    def run(mode, source, target):
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        script = Path(__file__).with_name("peer_tal.py")
        done = subprocess.run(
            [peer_python, script, mode, source, target], env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr

    def fields(path):
        run("dump", path, tmp_path / "fields.npz")
        with np.load(tmp_path / "fields.npz") as found:
            return dict(found)

    run.fields = fields
    code = "import tal; print(tal.__version__)"
    run.version = subprocess.run([peer_python, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
    assert run.version.startswith(("0.20", "0.21")), run.version
    return run


def tal_fields(name, kind, dtype):
    """The fields of a capture in y-tal's order."""
    rng = np.random.default_rng(1)
    shape = (SHAPES | NEW)[name]
    values = rng.random(shape).astype(np.float32)
    lists = name.endswith("Si")
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, X), np.linspace(-0.7, 0.9, Y), [0.0], indexing="ij"), -1)[:, :, 0]
    spots = np.stack(np.meshgrid(np.linspace(-1, 0, LX), np.linspace(0.1, 0.9, LY), [0.0], indexing="ij"), -1)[:, :, 0]
    grid, spots = (grid[:, 0], spots[:, 0]) if lists else (grid, spots)
    if kind == "confocal":
        spots = grid
    elif kind == "single":
        spots = spots[:1] if lists else spots[:1, :1]
    up = np.array([0, 0, 1])
    return {
        "H": values.astype(np.complex64) * np.exp(1j).astype(np.complex64) if name.startswith("F") else values,
        "H_format": name, "sensor_xyz": np.array([-0.5, 0.1, 0.25], np.float32), "sensor_grid_xyz": grid.astype(dtype),
        "sensor_grid_normals": np.broadcast_to(up, grid.shape), "sensor_grid_format": "N_3" if lists else "X_Y_3",
        "laser_xyz": np.array([-0.4, 0.1, 0.3], np.float32), "laser_grid_xyz": spots.astype(dtype),
        "laser_grid_normals": np.broadcast_to(up, spots.shape), "laser_grid_format": "N_3" if lists else "X_Y_3",
        "delta_t": np.float64(0.003), "t_start": np.int64(2), "t_accounts_first_and_last_bounces": np.bool_(True),
    }  # fmt: skip


CASES = [
    (name, kind) for name in (*SHAPES, *NEW) for kind in (("exhaustive",) if "L" in name else ("single", "confocal"))
]


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_what_tal_writes(tal, tmp_path, name, kind):
    if name in NEW and tal.version.startswith("0.20"):
        assert name not in SHAPES  # 0.20 has no captures in the frequency domain
        return
    fields = tal_fields(name, kind, np.float32 if kind == "confocal" else np.float64)
    np.savez(tmp_path / "in.npz", **fields)
    theirs, ours = tmp_path / "theirs.hdf5", tmp_path / "ours.hdf5"
    tal("make", tmp_path / "in.npz", theirs)
    said = {"frequencies": replace(FREQUENCIES, start_opl=2.0)} if name in NEW else {}
    capture = read_capture(theirs, **said)
    assert capture.scan.kind == kind and capture.scan.first_and_last_leg
    measured = capture.phasor if name in NEW else capture.transient
    H, grid, spots = fields["H"], fields["sensor_grid_xyz"], fields["laser_grid_xyz"]
    points, lasers = capture.scan.sensor_points.numpy(), capture.scan.laser_points.numpy()
    for index in np.ndindex(*H.shape[1:]):
        # The pair's index in both, x and y in the other order.
        pairs = [index] if name.endswith("Si") else [index[i : i + 2][::-1] for i in range(0, len(index), 2)]
        place = sum(pairs, ()) if not name.endswith("Si") else index
        np.testing.assert_array_equal(measured[(0, slice(None), *place)], H[(slice(None), *index)])
        rank = grid.ndim - 1
        np.testing.assert_array_equal(points[place[-rank:]], grid[index[-rank:]])
        if kind == "exhaustive":
            np.testing.assert_array_equal(lasers[place[:rank]], spots[index[:rank]])
    np.testing.assert_array_equal(capture.scan.sensor_origin, fields["sensor_xyz"].astype(np.float64))
    assert capture.metadata["scene_info"]["config"]["name"] == "ä"
    if name in SHAPES:
        assert (capture.axis.start_opl, capture.axis.bin_width_opl) == (2.0, 0.003)
        capture.write(ours, "tal")
        same_file(theirs, ours)
        first, second = tal.fields(theirs), tal.fields(ours)
        assert first.keys() == second.keys()
        for key, value in first.items():
            np.testing.assert_array_equal(value, second[key])
            assert value.dtype == second[key].dtype


def same_file(one, two):
    """Every dataset, bit by bit, in the kind of numbers that it had; texts as they were."""
    with h5py.File(one) as a, h5py.File(two) as b:
        assert set(a) == set(b)
        for name in a:
            assert a[name].shape == b[name].shape and a[name].dtype == b[name].dtype, name
            if a[name].shape is not None:
                assert np.asarray(a[name][()]).tobytes() == np.asarray(b[name][()]).tobytes() or a[name].dtype == object
                assert np.array_equal(a[name][()], b[name][()])


@pytest.mark.parametrize("name", sorted(HOLDABLE.keys() - NOT_READ_THERE))
def test_what_tal_reads(tal, tmp_path, name):
    layout, capture = HOLDABLE[name]
    if capture.phasor is not None and tal.version.startswith("0.20"):
        return  # 0.20 has no captures in the frequency domain
    found = tal.fields(capture.write(tmp_path / f"a{ENDINGS[layout]}", layout))
    scan = capture.scan
    H, grid = found["H"], found["sensor_grid_xyz"]
    ours = (capture.transient if capture.phasor is None else capture.phasor).numpy()
    ours = np.moveaxis(ours[:, 0], 0, -1) if capture.polarized else ours[0]
    points = scan.sensor_points.numpy()
    # The same number stands for the same point, whatever the order.
    pairs = dict(zip(map(tuple, rounded(points)), np.ndindex(*scan.sensor_shape), strict=True))
    moved = grid.reshape(-1, 3)
    if layout == "rect_data":  # y-tal puts the grid half a point to the side
        moved = moved - moved.mean(0) + points.reshape(-1, 3).mean(0)
    theirs = dict(zip(map(tuple, rounded(moved)), np.ndindex(*grid.shape[:-1]), strict=True))
    assert pairs.keys() == theirs.keys()
    lasers = {(): ()}
    if scan.kind == "exhaustive":
        here = rounded(scan.laser_points.numpy())
        ours_at = dict(zip(map(tuple, here), np.ndindex(*scan.laser_shape), strict=True))
        spots = found["laser_grid_xyz"]
        lasers = {ours_at[tuple(p)]: i for p, i in zip(rounded(spots), np.ndindex(*spots.shape[:-1]), strict=True)}
    for point, index in pairs.items():
        for laser, their_laser in lasers.items():
            np.testing.assert_array_equal(
                ours[(slice(None), *laser, *index)], H[(slice(None), *their_laser, *theirs[point])]
            )
    if capture.axis is not None:
        np.testing.assert_allclose(found["delta_t"], capture.axis.bin_width_opl, rtol=1e-13)
    assert bool(found["t_accounts_first_and_last_bounces"]) == scan.first_and_last_leg
    if layout in ("tal", "zaragoza", "phasor_field"):
        for ours_name, name_there in (("sensor_origin", "sensor_xyz"), ("laser_origin", "laser_xyz")):
            np.testing.assert_array_equal(found[name_there], getattr(scan, ours_name))
        assert found["t_start"] == (capture.axis.start_opl if capture.axis else capture.frequencies.start_opl)


def rounded(points):
    return np.round(np.asarray(points, np.float64).reshape(-1, 3), 9) + 0.0
