"""Captures that a layout can hold come back as they were, bit by bit; what it cannot hold is said."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.capture_files import AXIS, FROM_ZERO, SQUARE, WALL, grids, holdable, listed, made
from support.sweeps import together
from torchtransient.capture import Capture
from torchtransient.capture import capture as files
from torchtransient.errors import ArgumentError, StorageError
from torchtransient.files.captures.formats import FORMATS, LAYOUTS, read_capture, write_capture
from torchtransient.files.captures.matlab import write_mat

ENDINGS = {"torchtransient": "h5"} | {layout.name: layout.endings[0][1:] for layout in LAYOUTS}
HOLDABLE = {f"{layout}-{name}": (layout, capture) for layout, name, capture in holdable()}


@together("name", list(HOLDABLE))
def test_round_trip(tmp_path, name):
    layout, capture = HOLDABLE[name]
    path = capture.write(tmp_path / f"a.{ENDINGS[layout]}", format=layout)
    said = {}
    if layout == "dirac" and capture.scan.first_and_last_leg:
        with pytest.raises(StorageError, match="does not say sensor_origin"):
            Capture.read(path)
        said = {n: getattr(capture.scan, n).tolist() for n in ("sensor_origin", "laser_origin")}
    back = Capture.read(path, **said)
    assert back.metadata.get("format", layout) == layout
    for kind in ("transient", "phasor", "steady"):
        ours, theirs = getattr(capture, kind), getattr(back, kind)
        assert (ours is None) == (theirs is None)
        if ours is not None:
            assert ours.dtype == theirs.dtype and torch.equal(ours, theirs)
    assert (back.channels, back.polarized, back.frequencies) == (
        capture.channels, capture.polarized, capture.frequencies,
    )  # fmt: skip
    same_scan(capture.scan, back.scan, layout)
    if capture.axis is not None:
        assert back.axis.num_bins == capture.axis.num_bins
        # Seconds, and differences of starts of bins, are rounded once.
        exact = layout not in ("rect_data", "dirac")
        tolerance = 0 if exact else 4 * np.spacing(capture.axis.end_opl)
        assert abs(back.axis.start_opl - capture.axis.start_opl) <= tolerance
        assert abs(back.axis.bin_width_opl - capture.axis.bin_width_opl) <= tolerance
    if layout in ("tal", "torchtransient"):
        assert back == capture and (back.metadata == capture.metadata)


def same_scan(ours, theirs, layout):
    assert (ours.kind, ours.first_and_last_leg) == (theirs.kind, theirs.first_and_last_leg)
    names = ["sensor_points", "laser_points", "sensor_normals", "laser_normals"]
    if layout != "rect_data" and (layout != "dirac" or ours.first_and_last_leg):
        names += ["sensor_origin", "laser_origin"]
    for name in names:
        a, b = getattr(ours, name), getattr(theirs, name)
        # Grids of a width and a number of points are computed anew.
        torch.testing.assert_close(a, b, rtol=0, atol=1e-15 if layout == "rect_data" else 0)


def test_every_layout_that_is_written_is_in_the_list():
    assert {layout for layout, _ in HOLDABLE.values()} == {"torchtransient"} | {
        layout.name for layout in LAYOUTS if layout.write is not None
    }
    assert set(FORMATS) == set(ENDINGS)


@pytest.mark.parametrize("layout", [layout.name for layout in LAYOUTS if layout.write is not None])
def test_what_no_foreign_layout_holds(tmp_path, layout):
    path = tmp_path / f"a.{ENDINGS[layout]}"
    capture = made(grids()["confocal"])
    cases = {
        "one channel": replace(capture, transient=capture.transient.expand(3, -1, -1, -1)),
        "no batch": replace(capture, transient=capture.transient[None]),
        " or ": replace(made(grids()["confocal"], phasor=True), transient=capture.transient, axis=AXIS),
    }
    for words, other in cases.items():
        with pytest.raises(StorageError, match=f"{words}|holds"):
            other.write(path, format=layout)
    with pytest.raises(StorageError, match="ends in"):
        capture.write(tmp_path / "a.exr", format=layout)
    with pytest.raises(StorageError, match="does not exist"):
        capture.write(tmp_path / "no" / path.name, format=layout)
    with pytest.raises(ArgumentError, match=r"expected a tt\.nlos\.Capture"):
        write_capture(path, torch.zeros(3), format=layout)
    with pytest.raises(StorageError, match="metadata="):
        write_capture(path, capture, {"a": 1}, format=layout)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("layout", "scan", "axis", "words"),
    [
        ("zaragoza", listed("single"), AXIS, "lists"),
        ("zaragoza", grids(legs=False)["confocal"], AXIS, "first and the last leg"),
        ("zaragoza", replace(grids()["confocal"], sensor_normals=None), AXIS, "normals"),
        ("phasor_field", grids()["confocal"], AXIS, "confocal"),
        ("phasor_field", grids(legs=False)["single"], AXIS, "first and the last leg"),
        ("dirac", grids()["single"], AXIS, "confocal grids"),
        ("dirac", listed("confocal"), AXIS, "confocal grids"),
        ("rect_data", grids()["confocal"], FROM_ZERO, "wall to wall"),
        ("rect_data", grids(legs=False)["confocal"], FROM_ZERO, "square"),
        ("rect_data", grids(legs=False)["exhaustive"], FROM_ZERO, "confocal and single"),
        ("rect_data", grids(legs=False)["confocal"], AXIS, "from 0"),
        ("rect_data", listed("confocal", legs=False), FROM_ZERO, "grids"),
    ],
)
def test_what_a_layout_cannot_hold(tmp_path, layout, scan, axis, words):
    with pytest.raises(StorageError, match=words):
        made(scan, axis).write(tmp_path / f"a.{ENDINGS[layout]}", format=layout)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("layout", ["cdt", "keyhole"])
def test_layouts_that_are_only_read(tmp_path, layout):
    with pytest.raises(StorageError, match=r"only read\. Write one of torchtransient, tal"):
        made(grids()["confocal"]).write(tmp_path / "a.mat", format=layout)


def test_names_of_formats(tmp_path):
    with pytest.raises(ArgumentError, match="expected format to be one of torchtransient, tal"):
        read_capture(tmp_path / "a.h5", "exr")
    with pytest.raises(ArgumentError, match="expected format"):
        made(grids()["confocal"]).write(tmp_path / "a.h5", "exr")
    with pytest.raises(StorageError, match="does not exist"):
        read_capture(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["something"] = 1.0
    with pytest.raises(StorageError, match=r"no known layout.*it holds something"):
        read_capture(tmp_path / "a.h5")
    with pytest.raises(StorageError, match="H_format"):
        read_capture(tmp_path / "a.h5", "tal")


def test_arguments_that_say_what_the_file_says(tmp_path):
    path = made(grids()["confocal"]).write(tmp_path / "a.h5", "tal")
    with pytest.raises(StorageError, match="wall_size= has no meaning"):
        read_capture(path, wall_size=2.0)
    with pytest.raises(StorageError, match="says sensor_origin itself"):
        read_capture(path, sensor_origin=(0, 0, 1))
    own = made(grids()["confocal"]).write(tmp_path / "b.h5")
    with pytest.raises(StorageError, match="wall_size= has no meaning"):
        read_capture(own, wall_size=2.0)


def test_simulated_captures_keep_their_wall(tmp_path):
    scan = replace(grids()["confocal"], wall=dict(WALL.shape))
    back = Capture.read(made(scan).write(tmp_path / "a.h5", "tal"))
    assert back.scan == scan
    back.scan.wall["to_world"][0, 0] = 3.0  # memory of its own


def test_a_capture_without_the_room_of_files(monkeypatch):
    assert tt.nlos.read_capture is read_capture
    monkeypatch.setattr(files, "_files", [])
    with pytest.raises(StorageError, match=r"Import torchtransient\.nlos"):
        Capture.read("a.h5")


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    capture = made(grids()["confocal"])
    path = capture.write(tmp_path / "a.h5", "tal")
    before = path.read_bytes()

    def full(*_args, **_settings):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(h5py.Group, "create_dataset", full)
    with pytest.raises(StorageError, match="No space left"):
        capture.write(path, "tal")
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["a.h5"]


def test_bounces_are_summed_without_overflow(tmp_path):
    capture = made(grids()["confocal"])
    path = capture.write(tmp_path / "a.h5", "zaragoza")
    with h5py.File(path, "r+") as file:
        shape = file["data"].shape
        del file["data"]
        file["data"] = np.full(shape, 60_000, np.uint16)
    back = Capture.read(path)
    assert back.metadata["bounces"] == 6 and back.transient.dtype == torch.int64
    assert bool((back.transient == 6 * 60_000).all())


@pytest.mark.parametrize("kind", ["confocal", "single", "exhaustive"])
def test_zaragoza_files_of_both_orders(tmp_path, kind):
    """`data order`: row-major turns all axes round, of data and of positions."""
    capture = made(grids()[kind])
    path = capture.write(tmp_path / "a.h5", "zaragoza")
    with h5py.File(path, "r+") as file:
        for name in ("data", *(f"{who}Grid{what}" for who in ("camera", "laser") for what in ("Positions", "Normals"))):
            array = file[name][()]
            del file[name]
            file[name] = array.T
        file.attrs["data order"] = "row-major"
    back = Capture.read(path)
    assert torch.equal(back.transient, capture.transient)
    assert torch.equal(back.scan.sensor_points, capture.scan.sensor_points)
    assert torch.equal(back.scan.laser_points, capture.scan.laser_points)
    with h5py.File(path, "r+") as file:  # files without colours
        array = file["data"][()][..., 0]
        del file["data"]
        file["data"] = array
    assert torch.equal(Capture.read(path).transient, capture.transient)


def test_old_matlab_files_are_as_the_new_ones(tmp_path):
    import scipy.io

    capture = made(listed("single"))
    path = capture.write(tmp_path / "new.mat", "phasor_field")
    with h5py.File(path) as file:
        dataset = {name: file["dataset"][name][()].T for name in file["dataset"]}
        others = {name: file[name][()].T for name in file if name != "dataset"}
    for compressed in (False, True):
        scipy.io.savemat(tmp_path / "old.mat", {"dataset": dataset, **others}, do_compression=compressed)
        old, new = Capture.read(tmp_path / "old.mat"), Capture.read(path)
        assert old == new and old.metadata["reciprocal"] is new.metadata["reciprocal"] is True


def test_a_file_of_matlab_is_one_for_matlab(tmp_path):
    """The header that MATLAB looks for, and the class of each array."""
    square = grids(legs=False, wall=SQUARE, size=(4, 4))["confocal"]
    path = made(square, FROM_ZERO).write(tmp_path / "a.mat", "rect_data")
    start = path.read_bytes()[:128]
    assert start.startswith(b"MATLAB 7.3 MAT-file") and start[124:] == b"\x00\x02IM"
    with h5py.File(path) as file:
        assert file["rect_data"].attrs["MATLAB_class"] == b"single" and file["width"].attrs["MATLAB_class"] == b"double"
        assert file["rect_data"].shape == (7, 4, 4) and file["width"].shape == (1, 1) and file["width"][0, 0] == 1.0


def test_rectified_data_say_little(tmp_path):
    """Files of the light-cone transform have half a width and no bins, those of f-k migration neither."""
    data = np.random.default_rng(0).random((9, 4, 4)).astype(np.float32)
    lct, fk = tmp_path / "lct.mat", tmp_path / "fk.mat"
    write_mat(lct, {"rect_data": data, "width": 0.5})
    write_mat(fk, {"meas": data})
    with pytest.raises(StorageError, match="does not say bin_width_s"):
        Capture.read(lct)
    capture = Capture.read(lct, bin_width_s=4e-12)
    assert capture.axis.bin_width_s == pytest.approx(4e-12, rel=1e-15)
    np.testing.assert_allclose(capture.scan.sensor_points[0, :, 0], [-0.375, -0.125, 0.125, 0.375])
    np.testing.assert_array_equal(capture.transient[0], data)  # MATLAB's (x, y, t)
    with pytest.raises(StorageError, match="says wall_size itself"):
        Capture.read(lct, bin_width_s=4e-12, wall_size=1.0)
    capture = Capture.read(fk, bin_width_s=32e-12, wall_size=2.0)
    np.testing.assert_array_equal(capture.transient[0], data.swapaxes(1, 2))  # MATLAB's (y, x, t)
    cube = tmp_path / "cube.mat"
    write_mat(cube, {"meas": data[:4]})
    with pytest.raises(StorageError, match="no known layout"):
        Capture.read(cube)
    for layout, axes in (("rect_data", (0, 2, 1)), ("cdt", (2, 1, 0))):  # both are `meas`
        said = {"bin_width_s": 16e-12, "wall_size": 2.0}
        found = Capture.read(cube, layout, **said)
        assert found.metadata["format"] == layout
        np.testing.assert_array_equal(found.transient[0], data[:4].transpose(axes))


def test_what_tal_leaves_open(tmp_path):
    """Origins whose distance does not count are assumed, and left out again; those that count are needed."""
    path = made(grids(legs=False)["single"]).write(tmp_path / "a.h5", "tal")
    with h5py.File(path, "r+") as file:
        for name in ("sensor_xyz", "laser_xyz", "t_start", "scene_info", "sensor_grid_normals"):
            del file[name]
            file[name] = h5py.Empty(float)
    capture = Capture.read(path)
    assert set(capture.metadata["assumed"]) == {"sensor_origin", "laser_origin", "start_s"}
    assert capture.axis.start_opl == 0 and capture.scan.sensor_normals is None
    again = capture.write(tmp_path / "b.h5", "tal")
    with h5py.File(path) as a, h5py.File(again) as b:
        assert set(a) == set(b)
        for name in a:
            assert a[name].shape == b[name].shape and a[name].dtype == b[name].dtype
            assert a[name].shape is None or np.array_equal(a[name][()], b[name][()])
    filled = Capture.read(path, sensor_origin=(0.1, 0.2, 0.9), laser_origin=(-0.3, 0, 1.1), start_s=1e-9)
    assert "assumed" not in filled.metadata and filled.scan.sensor_origin.tolist() == [0.1, 0.2, 0.9]
    with h5py.File(path, "r+") as file:
        file["t_accounts_first_and_last_bounces"][...] = True
    with pytest.raises(StorageError, match="does not say sensor_origin"):
        Capture.read(path)


def test_frequencies_of_a_render_of_tal(tmp_path):
    """Where only the settings of the render are known, the frequencies follow from them; else they are to be given."""
    capture = made(grids()["confocal"], phasor=True)
    path = capture.write(tmp_path / "a.h5", "tal")
    # Lines are 1 / (2 m) apart, of 4 - 1 to 4 + 1 with sigma 1 m; more with half of it, where H has three.
    config = "config: {histogram_mode: frequency, wl_mean: 0.5, wl_sigma: %g, num_bins: 100, bin_width_opl: 0.02}"

    def replaced(text):
        with h5py.File(path, "r+") as file:
            del file["scene_info"]
            file["scene_info"] = text

    replaced(config % 1.0)
    assert Capture.read(path).frequencies.frequencies == (1.5, 2.0, 2.5)
    for text in (config % 0.5, "config: {}"):
        replaced(text)
        with pytest.raises(StorageError, match="does not say frequencies"):
            Capture.read(path)
        back = Capture.read(path, frequencies=capture.frequencies)
        assert torch.equal(back.phasor, capture.phasor) and back.frequencies == capture.frequencies
        assert Capture.read(back.write(tmp_path / "b.h5", "tal")).frequencies == capture.frequencies


def test_a_steady_image_of_points_that_are_gone(tmp_path):
    """Another program leaves every second column, and `scene_info` as it is."""
    capture = replace(made(grids()["confocal"]), steady=torch.rand(1, 3, 4), metadata={"a": 1})
    path = capture.write(tmp_path / "a.h5", "tal")
    with h5py.File(path, "r+") as file:
        for name in ("H", *(f"{who}_grid_{what}" for who in ("sensor", "laser") for what in ("xyz", "normals"))):
            array = file[name][()]
            del file[name]
            file[name] = array[:, ::2] if name == "H" else array[::2]
    back = Capture.read(path)
    assert back.steady is None and back.metadata == {"a": 1, "not_read": ["steady"]}
    assert torch.equal(back.transient, capture.transient[..., ::2])


def test_metadata_of_anyone(tmp_path):
    """What is added to a capture that was read is written; what makes no sense for writing does no harm."""
    path = made(grids()["confocal"]).write(tmp_path / "a.h5", "tal")
    with h5py.File(path, "r+") as file:
        del file["scene_info"]
        file["scene_info"] = "config: {a: 1}  # theirs"
    capture = Capture.read(path)
    again = Capture.read(capture.write(tmp_path / "b.h5", "tal"))
    assert again.metadata == capture.metadata and again.metadata["tal"]["scene_info_text"].endswith("theirs")
    noted = replace(capture, metadata={**capture.metadata, "note": "mine"})
    back = Capture.read(noted.write(tmp_path / "c.h5", "tal"))
    assert back == noted and back.metadata == noted.metadata
    with h5py.File(tmp_path / "c.h5") as file:
        assert "config" in file["scene_info"].asstr()[()]
    nonsense = {"dtypes": {"H": "O", "sensor_xyz": 3, "laser_xyz": "<b8"}, "volume_format": "x", "scene_info_text": 3}
    for tal in (nonsense, 3, [], {"dtypes": []}):
        other = replace(capture, metadata={"format": "tal", "tal": tal})
        assert torch.equal(Capture.read(other.write(tmp_path / "d.h5", "tal")).transient, capture.transient)
