"""Files of each layout with one entry that is wrong: an error that names it, and what was expected."""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

from support.capture_files import FROM_ZERO, SQUARE, grids, listed, made
from support.sweeps import together
from torchtransient.array_files import plain_texts
from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture
from torchtransient.errors import MissingPackageError, StorageError
from torchtransient.files.captures import formats
from torchtransient.files.captures.matlab import write_mat

LEGS, PLAIN = grids(), grids(legs=False)
SQUARES = grids(legs=False, wall=SQUARE, size=(4, 4))
SQUARES["single"] = replace(SQUARES["single"], laser_points=SQUARES["single"].sensor_points[1, 2])
FILES = {
    "dirac": ("dirac", made(PLAIN["confocal"])),
    "tal": ("tal", made(LEGS["confocal"])),
    "tal single": ("tal", made(LEGS["single"])),
    "tal phasor": ("tal", made(LEGS["confocal"], phasor=True)),
    "zaragoza": ("zaragoza", made(LEGS["confocal"])),
    "zaragoza pairs": ("zaragoza", made(LEGS["exhaustive"])),
    "phasor_field": ("phasor_field", made(listed("exhaustive"))),
    "rect_data": ("rect_data", made(SQUARES["single"], axis=FROM_ZERO)),
}
GONE, EMPTY = object(), object()
assert "tal" in formats.FORMATS  # what reads and writes is registered


def changed(path, layout, capture, entries):
    """A file of a capture, some entries of which are others, gone, or HDF5's nothing."""
    capture.write(path, layout)
    with h5py.File(path, "a") as file:
        for name, value in entries.items():
            given = value(file[name][()]) if callable(value) else value
            attributes = dict(file[name].attrs) if name in file else {}
            if name in file:
                del file[name]
            if value is not GONE:
                file[name] = h5py.Empty(float) if value is EMPTY else given
                file[name].attrs.update(attributes)
    return path


DIRAC = [
    ({"xg": lambda x: x[:-1]}, r"data_t \(T, X, Y\), xg and yg \(X, Y\).* got \(7, 4, 3\), \(3, 3\)"),
    ({"yg": lambda y: y[:, :-1]}, "expected data_t"), ({"da": lambda t: t[:-1]}, "expected data_t"),
    ({"da": lambda t: t[:1], "data_t": lambda d: d[:1]}, "T of 2 or more"),
    ({"da": lambda t: t + 1.1e-3 * 0.003 * (np.arange(7) == 3)}, "equal steps in da, got 0.0029967 to 0.0030033 m"),
    ({"da": lambda t: t[::-1]}, "bin_width"), ({"data_t": lambda d: d[0]}, "data_t as real numbers with 3 dimensions"),
    ({"data_t": lambda d: d + 1j}, "data_t as real numbers with 3 dimensions, got complex"),
    ({"xg": lambda x: x[None]}, "xg as real numbers with 2 dimensions"),
    ({"offset_laser": EMPTY}, "offset_laser as real"),
]  # fmt: skip
TAL = [
    ({"H": EMPTY}, "H is missing or empty"), ({"H": lambda h: h[0]}, "H with 3 dimensions as H_format says"),
    ({"H": lambda h: h[..., None, None]}, "H with 3 dimensions"), ({"H": lambda h: h[..., None]}, "H with 3 dim"),
    ({"H": lambda h: h + 1j}, "real numbers in H, got complex"), ({"H_format": 7}, "H_format to be one of T_Sx_Sy"),
    ({"H_format": 1.0}, "one whole number as H_format, got float64"), ({"H_format": EMPTY}, "as H_format, got None"),
    ({"H_format": np.array([1, 1])}, "one whole number as H_format"),
    ({"sensor_grid_format": 1}, r"sensor_grid_format says 1, the points are \(3, 4, 3\)"),
    ({"laser_grid_format": 3}, "laser_grid_format says 3"), ({"sensor_grid_xyz": lambda p: p[0, 0]}, "sensor_grid_xyz"),
    ({"sensor_grid_xyz": lambda p: p[..., :2]}, r"sensor_grid_xyz \(X, Y, 3\) or \(N, 3\), got \(4, 3, 2\)"),
    ({"sensor_grid_xyz": lambda p: p[None]}, "expected sensor_grid_xyz"), ({"sensor_grid_xyz": EMPTY}, "got None"),
    ({"sensor_grid_normals": lambda n: n[:-1]}, "sensor_grid_normals in the shape of the points"),
    ({"laser_grid_xyz": lambda p: p[:2], "laser_grid_normals": EMPTY},
     r"expected one laser point, or those of the sensor \(3, 4, 3\).* got \(3, 2, 3\)"),
    ({"laser_grid_xyz": lambda p: p + 0.1}, None),  # pairs
    ({"sensor_xyz": lambda p: p + 0j}, "expected real numbers in 'sensor_xyz', got complex"),
    ({"delta_t": np.array([0.1, 0.2])}, r"expected one number as delta_t, got \(2,\)"),
    ({"t_start": np.array([[0.1, 0.2]])}, "expected one number as t_start"),
    ({"sensor_xyz": np.zeros(4)}, r"expected sensor_origin \(3,\)"),
    ({"volume_format": 2.0}, None), ({"scene_info": EMPTY, "volume_format": 2.0}, "one whole number as volume_format"),
]  # fmt: skip
ZARAGOZA = [
    ({"cameraGridPositions": EMPTY}, "cameraGridPositions and laserGridPositions, got an empty one"),
    ({"laserGridPositions": EMPTY}, "got an empty one"), ({"deltaT": GONE}, "expected deltaT, got cameraGrid"),
    ({"data": lambda d: d[0, 0, 0]}, r"data with 4 to 7 dimensions, got \(4, 3\)"),
    ({"data": lambda d: d[0, 0]}, r"data with 4 to 7 dimensions, got \(6, 4, 3\)"),
    ({"data": lambda d: d[..., None, None, None]}, "data with 4 to 7 dimensions"),
    ({"data": lambda d: d + 1j}, "expected real numbers in data, got complex"),
    ({"data": lambda d: d[:, :0]}, "data is empty"), ({"data": lambda d: d[:, :, :0]}, "data is empty"),
    ({"cameraGridPositions": lambda p: p[:2]}, "cameraGridPositions as a grid of points"),
    ({"cameraGridPositions": lambda p: p[..., None]}, "cameraGridPositions as a grid of points"),
    ({"cameraGridPositions": lambda p: p + 0j}, "cameraGridPositions as a grid of points, got complex128"),
    ({"cameraGridNormals": lambda n: n[..., :-1]}, r"cameraGridNormals for each of the points \(3, 4\), got \(2, 4\)"),
    ({"laserGridNormals": lambda n: n[:, :-1]}, "laserGridNormals for each of the points"),
    ({"deltaT": np.array([0.1, 0.2])}, r"one number as deltaT, got float64 of \(2,\)"),
    ({"t0": 1j}, "one number as t0, got complex128"), ({"cameraPosition": np.zeros(2)}, r"sensor_origin \(3,\)"),
    ({"laserGridPositions": lambda p: p + 0.1}, "laserGridPositions one, or those of the camera"),
]  # fmt: skip
FIELD = [
    ({"dataset/data": lambda d: d[0]}, r"dataset.data \(t, cameras, lasers\), got \(3, 2\)"),
    ({"dataset/data": EMPTY}, "dataset.data .* got None"), ({"dataset/t": 8.0}, "dataset.t says 8 bins, dataset.data"),
    ({"dataset/data": lambda d: d + 1j}, "expected real numbers in dataset.data, got complex"),
    ({"dataset/laserPos": lambda p: p[:2]}, r"dataset.laserPos \(3, N\), got \(2, 2\)"),
    ({"dataset/laserPos": lambda p: p[..., None]}, r"dataset.laserPos \(3, N\), got \(3, 2, 1\)"),
    ({"dataset/laserPos": EMPTY}, "dataset.laserPos .* got None"),
    ({"dataset/cameraNorm": lambda n: n[:, :2]}, r"cameraNorm one, or for each of the points \(3, 3\), got \(2, 3\)"),
    ({"dataset/deltat": np.array([0.1, 0.2])}, "expected one number as dataset.deltat"),
    ({"dataset/laserOrigin": np.zeros((4, 1))}, r"laser_origin \(3,\)"),
    # One normal for all of them, bins that nobody counted.
    ({"dataset/cameraNorm": lambda n: n[:, :1], "dataset/t": GONE}, None),
]  # fmt: skip
RECT = [
    ({"SPAD_index": np.array([[4.0], [0.0]])}, r"SPAD_index \(x, y\) below \(4, 4\), got \[4\.0, 0\.0\]"),
    ({"SPAD_index": np.array([[0.0], [4.0]])}, "SPAD_index"), ({"SPAD_index": np.array([[-1.0], [0.0]])}, "SPAD_index"),
    ({"SPAD_index": np.array([[0.0], [-1.0]])}, "SPAD_index"), ({"SPAD_index": np.array([[0.5], [0.0]])}, "SPAD_index"),
    ({"SPAD_index": np.array([[0.0]])}, "SPAD_index"), ({"SPAD_index": np.zeros((3, 1))}, "SPAD_index"),
    ({"SPAD_index": np.array([[3.0], [0.0]])}, None), ({"ts": 0.0}, "ts as one number above zero"),
    ({"ts": np.array([1.0, 2.0])}, "ts as one number above zero"), ({"ts": math.inf}, "ts as one number above zero"),
    ({"sampling_spacing": -0.1}, "sampling_spacing as one number above zero"),
    ({"rect_data": lambda d: d[0]}, "rect_data of real numbers on three axes"),
    ({"rect_data": lambda d: d + 1j}, "rect_data of real numbers on three axes, got complex"),
]  # fmt: skip
CASES = [
    (name, *case) for name, cases in (
        ("dirac", DIRAC), ("tal", TAL), ("zaragoza", ZARAGOZA), ("phasor_field", FIELD), ("rect_data", RECT),
        ("tal phasor", [({"H": lambda h: h.real}, "complex numbers in H"), ({"scene_info": EMPTY}, "not say freq")]),
        ("tal single", [({"laser_grid_xyz": lambda p: np.repeat(p, 2, 0), "laser_grid_normals": EMPTY}, "one laser")]),
        ("zaragoza pairs", [({"laserGridPositions": lambda p: p[:, :-1], "laserGridNormals": GONE}, "5, 1, 3, 4")]),
    ) for case in cases
]  # fmt: skip


@pytest.mark.slow
@together("name, entries, words", CASES)
def test_entries_that_are_wrong(tmp_path, name, entries, words):
    layout, capture = FILES[name]
    ending = "mat" if layout in ("phasor_field", "rect_data") else "h5"
    path = changed(tmp_path / f"a.{ending}", layout, capture, entries)
    if words is None:
        assert isinstance(Capture.read(path, layout), Capture)
        return
    with pytest.raises(StorageError):
        Capture.read(path, layout)


@pytest.mark.parametrize("share, taken", [(0.9, True), (-0.9, True), (1.1, False)])
def test_steps_of_dirac_are_even_to_a_thousandth(tmp_path, share, taken):
    moved = {"da": lambda t: t + 1e-3 * share * 0.003 * (np.arange(7) == 3)}
    path = changed(tmp_path / "a.h5", *FILES["dirac"], moved)
    if taken:
        axis = Capture.read(path).axis
        assert (axis.start_opl, axis.bin_width_opl) == pytest.approx((1.1, 0.003), rel=1e-12)
        return
    with pytest.raises(StorageError, match="expected equal steps in da"):
        Capture.read(path)


KEYHOLE = {"data": np.arange(45.0).reshape(5, 9), "xpos": np.arange(5.0), "zpos": np.arange(5.0) / 8}


@pytest.mark.parametrize(("entries", "words"), [
    ({"xpos": np.arange(4.0)}, "expected xpos for each of the 5 rows of data"),
    ({"zpos": np.arange(6.0)}, "expected zpos"), ({"zpos": np.arange(5) * 1j}, "expected zpos"),
    ({"data": np.zeros((5, 9, 2))}, "expected data"),
    ({"data": np.ones((5, 9)) * 1j}, "expected data"),
])  # fmt: skip
def test_keyhole_files_with_a_wrong_entry(tmp_path, entries, words):
    write_mat(tmp_path / "a.mat", KEYHOLE | entries)
    with pytest.raises(StorageError, match=words):
        Capture.read(tmp_path / "a.mat", "keyhole")


def test_keyhole_points_are_the_walls_in_the_frame_of_the_thing(tmp_path):
    write_mat(tmp_path / "a.mat", KEYHOLE | {"more": np.ones(1)})
    found = Capture.read(tmp_path / "a.mat")
    assert found.scan.sensor_points.tolist() == [[-float(k), 0.0, k / 8] for k in range(5)]
    assert found.transient.shape == (1, 9, 5) and found.transient[0, 2].tolist() == [2.0, 11.0, 20.0, 29.0, 38.0]
    assert found.axis.bin_width_s == pytest.approx(16e-12) and found.metadata["not_read"] == ["more"]
    assert found.metadata["xpos"] == [0.0, 1.0, 2.0, 3.0, 4.0] and found.metadata["assumed"]["start_s"] == 0.0
    write_mat(tmp_path / "a.mat", {"direct_after": np.arange(9.0)[:, None], "direct_before": np.ones((9, 1))})
    one = Capture.read(tmp_path / "a.mat", start_s=1e-9)
    # The first of its names; the other is not read.
    assert one.transient.flatten().tolist() == [1.0] * 9 and one.metadata["not_read"] == ["direct_after"]
    assert one.axis.start_s == pytest.approx(1e-9)


def test_confocal_diffuse_tomography_says_little(tmp_path):
    counts = np.arange(3 * 3 * 5.0).reshape(3, 3, 5)
    write_mat(tmp_path / "a.mat", {"meas": counts})
    found = Capture.read(tmp_path / "a.mat", "cdt", wall_size=(0.6, 0.3))
    # (x, y, t) in the file; columns along x.
    np.testing.assert_array_equal(found.transient[0].numpy(), counts.transpose(2, 1, 0))
    np.testing.assert_allclose(found.scan.sensor_points[0, :, 0], [-0.2, 0.0, 0.2], atol=1e-15)
    np.testing.assert_allclose(found.scan.sensor_points[:, 0, 1], [-0.1, 0.0, 0.1], atol=1e-15)
    assert found.axis == TimeAxis.from_seconds(0.0, 16e-12, 5)
    write_mat(tmp_path / "a.mat", {"out": np.arange(5.0)[:, None], "x": np.ones(2)})
    slab = Capture.read(tmp_path / "a.mat", "cdt")
    assert slab.transient.flatten().tolist() == [0.0, 1.0, 2.0, 3.0, 4.0] and slab.metadata["not_read"] == ["x"]
    assert slab.axis == TimeAxis.from_seconds(0.0, 8e-12, 5)
    for entries, words in (({"meas": counts[0]}, "expected meas"), ({"meas": counts * 1j}, "expected meas"),
                           ({"out": counts}, "expected out")):  # fmt: skip
        write_mat(tmp_path / "a.mat", entries)
        with pytest.raises(StorageError, match=words):
            Capture.read(tmp_path / "a.mat", "cdt", wall_size=1.0)


@pytest.mark.parametrize("size", [0.0, -1.0, (1.0, 0.0), (1.0, math.inf), (1.0, 2.0, 3.0), "wide", math.nan])
def test_sizes_of_walls_that_are_none(tmp_path, size):
    write_mat(tmp_path / "a.mat", {"meas": np.ones((3, 3, 5))})
    with pytest.raises(StorageError, match=r"wall_size in metres, one number or \(width, height\)"):
        Capture.read(tmp_path / "a.mat", "cdt", wall_size=size)


@pytest.mark.parametrize(("given", "words"), [
    ({"frequencies": (1.0, 2.0, 3.0)}, "expected frequencies as a FrequencyAxis"),
    ({"sensor_origin": (0.0, 1.0)}, r"the file says sensor_origin itself\. Leave sensor_origin= out"),
    ({"wall_size": 1.0}, "wall_size= has no meaning for this layout"),
])  # fmt: skip
def test_what_is_said_beside_a_file(tmp_path, given, words):
    path = changed(tmp_path / "a.h5", *FILES["tal phasor"], {"scene_info": EMPTY})
    with pytest.raises(StorageError, match=words):
        Capture.read(path, "tal", **{"frequencies": FILES["tal phasor"][1].frequencies, **given})


@pytest.mark.parametrize(("layout", "capture", "words"), [
    ("dirac", made(PLAIN["confocal"], axis=TimeAxis(0.0, 0.003, 1)), "two bins or more, .* got one"),
    ("dirac", made(replace(PLAIN["confocal"], sensor_points=PLAIN["confocal"].sensor_points + 0.1,
                           laser_points=PLAIN["confocal"].sensor_points + 0.1)), "on the wall z = 0"),
    ("phasor_field", made(replace(listed("single"), sensor_normals=None)), "normals of all points, got none"),
    ("phasor_field", made(replace(listed("exhaustive"), laser_normals=None)), "normals of all points, got none"),
    ("tal", made(replace(LEGS["exhaustive"], laser_points=LEGS["exhaustive"].laser_points.reshape(-1, 3),
                         laser_normals=None)), r"grids or lists, got spots \(10,\) and sensor points \(3, 4\)"),
    ("zaragoza", made(replace(LEGS["confocal"], laser_normals=None)), "normals of all points, got none"),
])  # fmt: skip
def test_what_cannot_be_written(tmp_path, layout, capture, words):
    with pytest.raises(StorageError, match=words):
        capture.write(tmp_path / ("a.mat" if layout == "phasor_field" else "a.h5"), layout)
    assert list(tmp_path.iterdir()) == []


def stretched(scan, dx=1.0, dy=1.0, off=0.0, lean=0.0):
    """A square scan whose columns and rows are otherwise apart, one point of which is off, in parts of its pitch."""
    points = scan.sensor_points * torch.tensor([dx, dy, 1.0], dtype=torch.float64)
    points = points + lean * points[..., 1:2] * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    points[1, 1, 0] += off * 0.5
    spot = points if scan.kind == "confocal" else points[1, 2]
    return made(replace(scan, sensor_points=points, laser_points=spot), axis=FROM_ZERO)


@together("kind", ["confocal", "single"])
@together("how, words", [
    ({"dy": 1.0}, None), ({"dy": 1 + 0.9e-3}, None), ({"dy": 1 - 0.9e-3}, None), ({"dx": 1 - 0.9e-3}, None),
    ({"dy": 1 + 1.1e-3}, "(square confocal scans|one distance between points)"),
    ({"dx": 1 + 1.2e-3}, "(square|one dist)"), ({"off": 0.9e-3}, None), ({"off": -0.9e-3}, None),
    ({"off": 1.1e-3}, "regular grids at right angles, got points up to"),
    ({"lean": 0.9e-3}, None), ({"lean": 1.1e-3}, "at right angles"), ({"lean": -1.1e-3}, "at right angles"),
])  # fmt: skip
def test_rectified_grids_are_regular_to_a_thousandth(tmp_path, kind, how, words):
    capture = stretched(SQUARES[kind], **how)
    if words is None:
        assert Capture.read(capture.write(tmp_path / "a.mat", "rect_data")).scan.kind == kind
        return
    with pytest.raises(StorageError, match=words):
        capture.write(tmp_path / "a.mat", "rect_data")


def test_rectified_points_are_off_by_a_length_in_space(tmp_path):
    some, far = (SQUARES["confocal"].sensor_points.clone() for _ in range(2))
    some[1, 1:3, 0] += 0.8e-3 * 0.5
    far[1, 1, :2] += 0.8e-3 * 0.5
    for points, taken in ((some, True), (far, False)):
        capture = made(replace(SQUARES["confocal"], sensor_points=points, laser_points=points), axis=FROM_ZERO)
        if taken:
            capture.write(tmp_path / "a.mat", "rect_data")
            continue
        with pytest.raises(StorageError, match="regular grids at right angles"):
            capture.write(tmp_path / "a.mat", "rect_data")


def test_sizes_of_grids_stand_beside_their_points(tmp_path):
    with h5py.File(FILES["zaragoza pairs"][1].write(tmp_path / "a.h5", "zaragoza")) as file:
        # Four by three sensor points of 0.5 m and 1.6 / 3 m, two by five spots of 1 m and 0.32 m.
        assert file["cameraGridPoints"][()].tolist() == [4, 3] and file["laserGridPoints"][()].tolist() == [2, 5]
        np.testing.assert_allclose(file["cameraGridSize"][()], [1.5, 3.2 / 3])
        np.testing.assert_allclose(file["laserGridSize"][()], [1.0, 1.28])
        assert file["data"].shape == (1, 7, 6, 4, 3, 2, 5) and file["isConfocal"][()] == 0
        # All light stands in the second of the bounces.
        assert not file["data"][:, :, [0, 2, 3, 4, 5]].any() and file["data"][:, :, 1].all()
        assert file["t"][()] == 7 and file["t0"][()] == 1.1 and file["deltaT"][()] == 0.003
        assert np.isnan(file["hiddenVolumeSize"][()]).all()


def test_spots_are_sensor_points_to_a_thousandth(tmp_path):
    for off, taken in ((0.9e-3, True), (1.1e-3, False)):
        spot = SQUARES["single"].sensor_points[1, 2] + torch.tensor([0.0, off * 0.5, 0.0], dtype=torch.float64)
        capture = made(replace(SQUARES["single"], laser_points=spot), axis=FROM_ZERO)
        if taken:
            with h5py.File(capture.write(tmp_path / "a.mat", "rect_data")) as file:
                assert file["SPAD_index"][()].ravel().tolist() == [2.0, 1.0] and file["ts"].size == 1
            continue
        with pytest.raises(StorageError, match=r"a spot that is a sensor point, got one 0\.00055 m away"):
            capture.write(tmp_path / "a.mat", "rect_data")


# ------------------------------------------------------------------------------------------------------- YAML in files


def test_texts_of_yaml_have_a_length(monkeypatch):
    monkeypatch.setattr(plain_texts, "_CHARACTERS", 6)
    assert plain_texts.read_plain_yaml("a: 123", "scene_info") == {"a": 123}
    with pytest.raises(StorageError, match="scene_info: expected a YAML text below 6 characters, got 7"):
        plain_texts.read_plain_yaml("a: 1234", "scene_info")


def test_yaml_needs_its_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "yaml", None)
    for call in (lambda: plain_texts.read_plain_yaml("a: 1", "x"), lambda: plain_texts.write_plain_yaml({}, "x")):
        with pytest.raises(MissingPackageError, match=r"x: YAML needs PyYAML.*torchtransient\[yaml\]"):
            call()
