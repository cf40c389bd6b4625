"""Captures that a layout can hold come back as they were, bit by bit; what it cannot hold is said."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.capture_files import AXIS, FROM_ZERO, WALL, grids, holdable, listed, made
from torchtransient.capture import Capture, files
from torchtransient.data.captures.formats import FORMATS, LAYOUTS, read_capture, write_capture
from torchtransient.errors import StorageError

ENDINGS = {"torchtransient": "h5"} | {layout.name: layout.endings[0][1:] for layout in LAYOUTS}
HOLDABLE = {f"{layout}-{name}": (layout, capture) for layout, name, capture in holdable()}


@pytest.mark.parametrize("name", list(HOLDABLE))
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
    with pytest.raises(StorageError, match=r"expected a tt\.nlos\.Capture"):
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
    with pytest.raises(StorageError, match="expected format to be one of torchtransient, tal"):
        read_capture(tmp_path / "a.h5", "exr")
    with pytest.raises(StorageError, match="expected format"):
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
