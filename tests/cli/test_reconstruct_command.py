"""`torchtransient reconstruct`: captures of all kinds and layouts in, volumes and pictures out."""

from __future__ import annotations

import inspect
import re
import shutil

import h5py
import pytest
import torch
from click.testing import CliRunner

import torchtransient as tt
from support.capture_files import ANSWERS
from support.marks import long_rows
from support.sweeps import together
from tools.point_captures import point_capture
from torchtransient.__main__ import main

POINT = (0.15, -0.1, 0.7)
AXIS = tt.TimeAxis(0.0, 0.02, 128)
WALL = tt.nlos.Wall.plane(1.0, 1.0)
# Each method once.
EVERY = [
    ("confocal", "fk"), ("confocal", "lct"), ("confocal", "directional-lct"), ("single", "bp"), ("exhaustive", "fbp"),
    ("exhaustive", "phasor"), ("single", "midpoint-fk"),
]  # fmt: skip


def captured(kind, legs=False, axis=AXIS):
    """Light of one point, 12 x 12 sensor points."""
    more = {"laser_grid": 3} if kind == "exhaustive" else {}
    scan = tt.nlos.Scan.grid(WALL, 12, kind=kind, first_and_last_leg=legs, **more)
    return point_capture(scan, [POINT], time_axis=axis)


@pytest.fixture(scope="module")
def confocal(tmp_path_factory):
    return captured("confocal").write(tmp_path_factory.mktemp("captured") / "a.h5")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments):
    return CliRunner().invoke(main, ["reconstruct", *map(str, arguments)])


def brightest(volume):
    index = int(volume.picture().argmax())
    return volume.grid.points.reshape(-1, 3)[index]


@pytest.mark.parametrize(("kind", "method"), long_rows(EVERY, EVERY[::2]))
def test_a_point_is_found_by_every_method(folder, kind, method):
    captured(kind).write("a.h5")
    result = run("a.h5", "--method", method, "--depths", 0.4, 1.0, "--quiet", "--no-picture")
    assert result.exit_code == 0, result.output
    volume = tt.nlos.read_volume(f"a_{method}.h5")
    assert volume.method == method and volume.values.shape[-3:] == volume.grid.shape
    assert float(volume.grid.depths[0]) >= 0.4 and float(volume.grid.depths[-1]) <= 1.0
    # One pitch of the scan, and two planes.
    torch.testing.assert_close(brightest(volume), torch.tensor(POINT, dtype=torch.float64), rtol=0, atol=0.085)


def test_without_a_method_the_one_that_suits_is_taken(folder):
    captured("single").write("a.npz")
    result = run("a.npz", "-o", "v.npz", "--depths", 0.4, 1.0)
    assert result.exit_code == 0, result.output
    assert "--method phasor: a single scan" in result.stderr and "volume: 100%" in result.stderr
    volume = tt.nlos.read_volume("v.npz")
    assert volume.method == "phasor" and volume.metadata["reason"].startswith("a single scan")
    assert volume.metadata["capture"] == "a.npz"
    assert "v.npz: 1 x " in result.stdout and (folder / "v.png").stat().st_size > 5000


def test_what_a_file_leaves_open_has_an_option(folder):
    """Every argument of `read_capture` but `frequencies`, of which a volume is not made."""
    named = inspect.signature(tt.nlos.read_capture).parameters.values()
    arguments = {one.name for one in named if one.kind is one.KEYWORD_ONLY} - {"frequencies"}
    assert arguments == set(ANSWERS), "tests/support/capture_files.py: a value for each"
    captured("confocal").write("a.h5")
    for name in arguments:
        value = ANSWERS[name]
        option = f"--{name.replace('_', '-')}"
        # The library's own files leave nothing open.
        said = run("a.h5", option, *(value if isinstance(value, tuple) else (value,)))
        assert said.exit_code and f"{option} has no meaning" in said.output, said.output


def test_lists_of_points_go_to_filtered_backprojection(folder):
    scan = captured("confocal").scan
    points = scan.sensor_points.reshape(-1, 3)[::2]
    some = tt.nlos.Scan.points(
        points, kind="confocal", sensor_origin=scan.sensor_origin, laser_origin=scan.laser_origin
    )
    point_capture(some, [POINT], time_axis=AXIS).write("list.h5")
    box = ("--bounds", -0.5, -0.5, 0.4, 0.5, 0.5, 1.0, "--voxels", "20,20,16")
    result = run("list.h5", *box)
    assert result.exit_code == 0 and "--method fbp" in result.stderr, result.output
    found = brightest(tt.nlos.read_volume("list_fbp.h5"))
    torch.testing.assert_close(found, torch.tensor(POINT, dtype=torch.float64), rtol=0, atol=0.06)


def test_lists_on_one_line_are_asked_for_an_extent_and_take_it(folder):
    scan = captured("confocal").scan
    line = tt.nlos.Scan.points(
        scan.sensor_points[3], kind="confocal", sensor_origin=scan.sensor_origin, laser_origin=scan.laser_origin
    )
    point_capture(line, [POINT], time_axis=AXIS).write("line.h5")
    result = run("line.h5", "--quiet")
    assert result.exit_code == 2 and "Give --extent" in result.stderr
    options = ("--extent", "0.6,0.5", "--voxels", "5,4,3", "--depths", 0.4, 1.0, "--quiet", "--no-picture")
    result = run("line.h5", *options)
    assert result.exit_code == 0, result.stderr
    grid = tt.nlos.read_volume("line_fbp.h5").grid
    assert grid.extent == pytest.approx((0.6, 0.5)) and grid.shape == (3, 4, 5)


def test_legs_do_not_matter(folder):
    captured("confocal", legs=True, axis=tt.TimeAxis(0.3, 0.02, 160)).write("legs.h5")
    for method in ("fk", "fbp"):
        assert run("legs.h5", "--method", method, "--depths", 0.4, 1.0, "--quiet", "--no-picture").exit_code == 0
        found = brightest(tt.nlos.read_volume(f"legs_{method}.h5"))
        torch.testing.assert_close(found, torch.tensor(POINT, dtype=torch.float64), rtol=0, atol=0.085)


def test_options_are_those_of_the_function(folder):
    capture = captured("single")
    capture.write("a.h5")
    options = ("--wavelength", 0.3, "--cycles", 5, "--falloff", 1, "--voxels", "10,8,6", "--extent", "0.8,0.6")
    result = run("a.h5", "--method", "fbp", *options, "--depths", 0.5, 0.9, "--quiet", "--no-picture")
    assert result.exit_code == 0, result.output
    found = tt.nlos.read_volume("a_fbp.h5")
    grid = tt.nlos.default_grid(capture, depths=(0.5, 0.9), size=(10, 8), extent=(0.8, 0.6), planes=6)
    operator = tt.nlos.FilteredBackprojection(
        capture.scan, grid, time_axis=capture.axis, filter=tt.nlos.PhasorFilter(0.3, 5), falloff=1.0,
        dtype=torch.float64,
    )  # fmt: skip
    expected = operator.reconstruct(capture)
    assert found.grid == grid
    torch.testing.assert_close(found.values, expected, rtol=1e-4, atol=1e-6 * float(expected.max()))
    assert found.metadata["settings"] == {
        "wavelength": 0.3, "cycles": 5.0, "falloff": 1.0, "filter": "phasor",
    }  # fmt: skip


def test_cut_and_summed_bins(folder):
    capture = captured("confocal")
    capture.write("a.h5")
    result = run("a.h5", "--record", 0.4, 2.4, "--sum-bins", 3, "--quiet", "--no-picture", "--floor", 0.1)
    assert result.exit_code == 0, result.output
    cut = tt.nlos.sum_bins(capture.crop(0.4, 2.4), 3)
    expected = tt.nlos.fk(cut, floor=0.1)
    assert torch.equal(tt.nlos.read_volume("a_fk.h5").values, expected)


@pytest.mark.slow
def test_films_and_normals(folder):
    captured("single").write("a.h5")
    film = ("--method", "phasor", "--camera", "transient", "--times", 0.6, 1.0, 5)
    result = run("a.h5", *film, "--voxels", "12,12,4", "--depths", 0.5, 0.9, "--quiet")
    assert result.exit_code == 0, result.output
    volume = tt.nlos.read_volume("a_phasor.h5")
    assert volume.values.shape == (1, 5, 4, 12, 12) and torch.equal(
        volume.times, torch.linspace(0.6, 1, 5, dtype=torch.float64)
    )
    captured("confocal").write("b.h5")
    result = run("b.h5", "--method", "directional-lct", "--snr", 100, "--flip", "xy", "--quiet")
    assert result.exit_code == 0, result.output
    volume = tt.nlos.read_volume("b_directional-lct.h5")
    assert volume.directions.shape == (1, 3, *volume.grid.shape)
    assert torch.equal(volume.directions.norm(dim=-4), volume.values)
    length = tt.nlos.normals_of(volume).norm(dim=0)
    torch.testing.assert_close(length, torch.ones_like(length))


def test_what_a_file_leaves_open_is_asked_for(folder):
    counts = torch.poisson(torch.full((6, 6, 40), 5.0), generator=torch.Generator().manual_seed(0))
    with h5py.File("foam.mat", "w") as file:
        file["meas"] = counts.numpy()
    result = run("foam.mat", "--quiet")
    assert result.exit_code == 2 and "Give --wall-size." in result.stderr and "wall_size=" not in result.stderr
    slab = ("--slab", 0.01, "--slab-snr", 100, "--target", "retroreflective")
    result = run("foam.mat", "--wall-size", 0.6, "--format", "cdt", *slab, "--quiet")
    assert result.exit_code == 0, result.output
    volume = tt.nlos.read_volume("foam_fk.h5")
    assert volume.metadata["assumed"]["bin_width_s"] == 16e-12 and volume.metadata["prepared"]["slab"] == 0.01
    told = run("foam.mat", "--wall-size", 0.6, "--format", "cdt", "--taps", 2, "--no-picture").stderr
    assert "assumed, since the file does not say it: " in told
    assert "--start-s 0" in told and "--bin-width-s 1.6e-11" in told
    assert tt.nlos.read_volume("foam_fk.h5").metadata["settings"]["taps"] == 2


@together("arguments, word", [
    (("missing.h5",), "missing.h5"), (("a.h5", "--method", "midpoint-fk"), "method 'midpoint-fk'"),
    (("a.h5", "--method", "fk", "--snr", 3), "--snr"), (("a.h5", "--method", "fk", "--voxels", 8), "--voxels"),
    (("a.h5", "--method", "fbp", "--filter", "laplacian", "--cycles", 3), "--cycles"),
    (("a.h5", "--method", "bp", "--voxels", "4,x"), "X,Y[,Z]"),
    (("a.h5", "--method", "bp", "--bounds", 0, 0, 0, 1, 1, 1), "--voxels"),
    (("a.h5", "--bounds", 0, 0, 0, 1, 1, 1, "--depths", 0, 1), "--depths"),
    (("a.h5", "--method", "phasor", "--camera", "confocal"), "--times"), (("a.h5", "--times", 0, 1, 3), "--camera"),
    (("a.h5", "--method", "phasor", "--camera", "transient", "--times", 0, 1, 3), "one laser spot"),
    (("a.h5", "--slab-snr", 3), "--slab"), (("a.h5", "--gamma", 0), "--gamma"),
    (("a.h5", "--threshold", 5), "--threshold"), (("a.h5", "--record", 0, 2000), "--record"),
    (("a.h5", "--method", "fbp", "--wavelength", 60), "wavelength of"),
    (("a.h5", "--method", "bp", "--voxels", "9000,9000,9000"), "TiB"), ((".",), "is a directory"),
    (("a.h5", "--depths", 5, 6), "within the record"), (("a.h5", "--sum-bins", 500), "128 bins"),
    (("a.h5", "--wall-size", 1), "--wall-size"), (("a.h5", "-o", "v.txt"), ".npz"),
    (("a.h5", "--picture", "nowhere/a.png"), "nowhere"), (("a.h5", "--device", "abacus"), "abacus"),
    (("a.h5", "--picture", "a.png", "--no-picture"), "--no-picture"),
])  # fmt: skip
def test_mistakes_are_said_in_options(confocal, folder, arguments, word):
    shutil.copyfile(confocal, "a.h5")
    result = run(*arguments, "--quiet")
    assert result.exit_code == 2 and word in result.stderr, result.output
    assert not re.search(r"Traceback|reconstruct:", result.stderr)
    assert sorted(path.name for path in folder.iterdir()) == ["a.h5"]
