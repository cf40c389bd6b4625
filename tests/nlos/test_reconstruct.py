"""Captures of every kind from the simulation to the volume, the choice of a method, and docs/nlos_reconstruction.md."""

from __future__ import annotations

import re

import pytest
import torch
from click.testing import CliRunner

import torchtransient as tt
from support.marks import long_rows
from support.pages import Page
from tools.point_captures import point_capture
from torchtransient.cli.main import main
from torchtransient.errors import ArgumentError, SceneError, ShapeError, StorageError, UnitError
from torchtransient.volume_methods import METHODS

RECONSTRUCTION = Page("docs/nlos_reconstruction.md")
PAGE, TEXT = RECONSTRUCTION.path, RECONSTRUCTION.text
WALL = tt.nlos.Wall.plane(1.0, 1.0, albedo=0.7)
AXIS = tt.TimeAxis(0.0, 0.02, 128)
PLATE = (0.15, -0.1, 0.6)


def scanned(kind, size=12, **more):
    return tt.nlos.Scan.grid(WALL, size, kind=kind, **({"laser_grid": 3} if kind == "exhaustive" else {}), **more)


@pytest.mark.parametrize(
    ("kind", "method"),
    long_rows(
        [("confocal", "fk"), ("single", "phasor"), ("exhaustive", "midpoint-fk")],
        [("exhaustive", "midpoint-fk")],
    ),
)
def test_from_the_simulation_through_a_file_to_the_volume(tmp_path, kind, method):
    moves = tt.scenes.transforms
    plate = moves.translate(PLATE) @ moves.rotate([0, 1, 0], 180) @ moves.scale(0.05)
    hidden = {"plate": {"type": "rectangle", "to_world": plate, "bsdf": {"type": "diffuse"}}}
    simulated = tt.nlos.simulate(hidden, scanned(kind), time_axis=AXIS, spp=64, variant="llvm_ad_mono", progress=False)
    read = tt.nlos.Capture.read(simulated.write(tmp_path / "capture.h5"))
    assert torch.equal(read.transient, simulated.transient)
    volume = tt.nlos.reconstruct(read, None if method != "midpoint-fk" else method, depths=(0.3, 0.9))
    assert volume.method == method
    back = tt.nlos.read_volume(tt.nlos.write_volume(tmp_path / "volume.npz", volume))
    assert torch.equal(back.values, volume.values) and back.grid == volume.grid and back.method == method
    brightest = back.grid.points.reshape(-1, 3)[int(back.picture().argmax())]
    # A pitch of the scan; half a wavelength in depth.
    torch.testing.assert_close(brightest, torch.tensor(PLATE, dtype=torch.float64), rtol=0, atol=0.085)


def test_every_method_of_the_command_is_known():
    told = re.findall(r"^\| `([\w-]+)` \| `(\w+)`", TEXT, flags=re.MULTILINE)
    assert {name for name, _ in told} == set(METHODS) and all(hasattr(tt.nlos, operator) for _, operator in told)


def test_curved_walls_are_backprojected():
    corners = [[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.1], [-0.5, 0.5, 0.0]]
    scan = tt.nlos.Scan.grid((corners, [[0, 1, 2], [0, 2, 3]]), 10, kind="confocal")
    capture = point_capture(scan, [(0.1, 0.0, 0.6)], time_axis=AXIS)
    choice = tt.nlos.choose_method(capture)
    assert choice.name == "fbp" and "not a regular grid" in choice.reason
    volume = tt.nlos.reconstruct(capture, depths=(0.4, 0.8))
    assert volume.grid.size == (10, 10) and float(volume.values.max()) > 0
    with pytest.raises(ArgumentError, match="flat wall"):
        tt.nlos.reconstruct(capture, "phasor")


def test_stokes_components_are_left_out():
    capture = point_capture(scanned("confocal"), [PLATE], time_axis=AXIS)
    light = capture.transient
    polarized = tt.nlos.Capture(torch.stack([light, 9 * light, light, light]), AXIS, capture.scan, polarized=True)
    expected = tt.nlos.reconstruct(capture).values
    assert torch.equal(tt.nlos.reconstruct(polarized).values, expected)


def test_channels_and_batches():
    capture = point_capture(scanned("confocal"), [PLATE], time_axis=AXIS)
    light = capture.transient[0]
    many = tt.nlos.Capture(
        torch.stack([torch.stack([light, 2 * light]), torch.stack([3 * light, light])]), AXIS, capture.scan
    )
    for method in ("fk", "directional-lct", "bp", "phasor"):
        volume = tt.nlos.reconstruct(many, method, depths=(0.4, 0.8))
        one = tt.nlos.reconstruct(capture, method, depths=(0.4, 0.8)).values
        assert volume.values.shape == (2, 2, *one.shape[1:])
        power = 2 if method == "phasor" else 1
        torch.testing.assert_close(volume.values[1, 0], 3**power * one[0], rtol=1e-6, atol=1e-9 * float(one.max()))
        assert volume.picture().shape == one.shape[1:]


def test_mistakes_have_types(tmp_path):
    capture = point_capture(scanned("confocal"), [PLATE], time_axis=AXIS)
    grid = tt.nlos.default_grid(capture)
    for error, message, arguments in (
        (ArgumentError, "one of fk", {"method": "magic"}), (ArgumentError, "has no snr=", {"method": "fk", "snr": 1.0}),
        (ArgumentError, "takes no grid=", {"method": "fk", "grid": grid}),
        (ArgumentError, "takes no grid=", {"method": "bp", "grid": grid, "depths": (0, 1)}),
        (ArgumentError, "filter: expected one of", {"method": "fbp", "filter": "sobel"}),
        (ArgumentError, "'midpoint-fk' takes single and exhaustive scans, not confocal", {"method": "midpoint-fk"}),
        (UnitError, "near, far", {"depths": 1.0}),
    ):  # fmt: skip
        with pytest.raises(error, match=message):
            tt.nlos.reconstruct(capture, **arguments)
    with pytest.raises(StorageError, match="volume"):
        tt.nlos.read_volume(capture.write(tmp_path / "capture.npz"))
    with pytest.raises(ShapeError, match="directions"):
        tt.nlos.normals_of(tt.nlos.reconstruct(capture))


@pytest.mark.parametrize("size", [(1, 1), (5, 1)])
def test_scans_of_one_line_are_asked_how_large_the_volume_is(size):
    capture = point_capture(tt.nlos.Scan.grid(WALL, size, kind="confocal"), [PLATE], time_axis=AXIS)
    with pytest.raises(SceneError, match=r"one line.*extent=\(width, height\)"):
        tt.nlos.reconstruct(capture)
    volume = tt.nlos.reconstruct(capture, grid=tt.nlos.default_grid(capture, extent=1.0, size=6, depths=(0.4, 0.8)))
    assert volume.values.shape[-2:] == (6, 6) and float(volume.values.max()) > 0


@pytest.mark.slow
def test_the_page(tmp_path, monkeypatch):
    """Its blocks run, its command reads what they wrote, its links lead somewhere."""
    monkeypatch.chdir(tmp_path)
    names = RECONSTRUCTION.names({r"\(48, 48\)": "(8, 8)", "spp=4096": "spp=8, progress=False"})
    assert float(names["counts"].grad.abs().sum()) > 0 and (tmp_path / "letter.png").exists()
    for line in re.findall(r"```sh\n(.*?)```", TEXT, flags=re.DOTALL)[0].splitlines():
        result = CliRunner().invoke(main, line.split("#")[0].split()[1:])
        assert result.exit_code == 0, result.output
    assert tt.nlos.read_volume("letter.npz").method == "lct"
    options = {option for parameter in main.get_command(None, "reconstruct").params for option in parameter.opts}
    assert set(re.findall(r"--[a-z][\w-]+", TEXT)) <= options
    for picture in (PAGE.parent / "images" / "reconstruction").iterdir():
        assert picture.stat().st_size < 150_000
