"""What is taken where a file says nothing, and what counts as the same: places, sizes, points, frequencies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from support.capture_files import LIST, grids, listed, made
from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture
from torchtransient.errors import StorageError
from torchtransient.files.captures import formats, gaps
from torchtransient.files.captures.matlab import write_mat

assert "tal" in formats.FORMATS  # what reads and writes is registered


def of(**given):
    return gaps.Gaps(given, "layout", Path("a.h5"))


def test_what_a_file_says_what_is_given_and_what_is_assumed():
    asked = of(bin_width_s=1e-12, start_s=None, more=3)
    assert asked.fill("name", 5) == 5 and asked.fill("other", None, np.arange(2.0)).tolist() == [0.0, 1.0]
    assert of(bin_width_s=1e-12).width(None) == pytest.approx(299792458e-12, rel=1e-12) and of().width(0.25) == 0.25
    assert of().start(None) == 0.0 and of().start(-0.5) == -0.5
    assert of(start_s=2e-9).start(None) == pytest.approx(0.599584916, rel=1e-12)
    assumed = of()
    assert assumed.width(None, 4e-12) == pytest.approx(4 * 299792458e-12) and assumed.start(None) == 0.0
    assert assumed.assumed == {"bin_width_s": 4e-12, "start_s": 0.0}
    assert assumed.metadata(a=1, b=None) == {"format": "layout", "assumed": assumed.assumed, "a": 1}
    assert of().metadata() == {"format": "layout"}
    assert asked.assumed == {"other": [0.0, 1.0]}
    with pytest.raises(StorageError, match=r"'a\.h5', layout 'layout': the file does not say x\. Give x= to read"):
        of().fill("x", None)
    with pytest.raises(StorageError, match=r"the file says bin_width_s itself\. Leave bin_width_s= out"):
        of(bin_width_s=1e-12).width(0.1)
    with pytest.raises(StorageError, match="b=, c= has no meaning for this layout"):
        of(c=1, b=2, d=None).check_all_used()
    used = of(start_s=1e-9)
    used.start(None)
    used.check_all_used()


@pytest.mark.parametrize(("normals", "expected"), [
    # Around (1, 2, 0), 5 m across: that far along the mean normal, or along z.
    (None, [1.5, 2.0, 5.0]), ([[0, 0, -2.0], [0, 0, -1.0]], [1.5, 2.0, -5.0]),
    ([[3, 0, 0.0], [0, 0, 4.0]], [4.5, 2.0, 4.0]), ([[0, 0, 1.0], [0, 0, -1.0]], [1.5, 2.0, 0.0]),
])  # fmt: skip
def test_places_that_nobody_knows(normals, expected):
    points = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]])
    np.testing.assert_allclose(gaps.before(points, normals), expected)
    asked = of()
    found = asked.origin("sensor_origin", None, points, normals, False)
    np.testing.assert_allclose(found, expected)
    assert asked.assumed == {"sensor_origin": pytest.approx(expected)}
    # One point is a metre before itself; where legs count somebody has to know.
    np.testing.assert_allclose(gaps.before(points[:1], None), [0, 0, 1])
    with pytest.raises(StorageError, match="does not say sensor_origin"):
        of().origin("sensor_origin", None, points, normals, True)
    assert of(sensor_origin=[1, 2, 3]).origin("sensor_origin", None, points, normals, True).tolist() == [1, 2, 3]
    assert of().origin("sensor_origin", np.array([[1.0], [2], [3]]), points, normals, True).tolist() == [1, 2, 3]


def test_points_are_the_same_to_a_millionth_of_the_largest_coordinate():
    points = np.array([[0.0, -8.0, 1.0], [2.0, 3.0, 4.0]])
    for share, same in ((0.9, True), (-0.9, True), (1.1, False), (-1.1, False)):
        moved = points.copy()
        moved[1, 0] += share * 8e-6
        assert gaps.same_points(points, moved) is same
    assert not gaps.same_points(points, points[:1]) and not gaps.same_points(points, points.T)


def test_cells_of_an_area_around_the_origin():
    points = gaps.grid_points((2, 3), (6.0, 1.0))
    np.testing.assert_allclose(points[..., 0], [[-2, 0, 2]] * 2)
    np.testing.assert_allclose(points[..., 1], [[-0.25] * 3, [0.25] * 3])
    assert not points[..., 2].any()
    assert of(wall_size=2).extent(None) == (2.0, 2.0) and of(wall_size=(1, 3)).extent(None) == (1.0, 3.0)
    assert of().extent((0.5, 0.25)) == (0.5, 0.25)


@pytest.mark.parametrize("kind", ["u2", "u4", "u8", ">f4", "i1", "?"])
def test_numbers_that_torch_computes_with(kind):
    array = np.array([0, 1, 1], kind)
    found = gaps.tensor_of(array)
    wider = {"u2": torch.int32, "u4": torch.int64, "u8": torch.int64}
    assert found.tolist() == array.tolist() and found.dtype == wider.get(kind, found.dtype)
    assert gaps.tensor_of(np.array([2**63 - 1], np.uint64)).item() == 2**63 - 1
    with pytest.raises(StorageError, match=r"expected counts below 2\^63, got 9223372036854775808"):
        gaps.tensor_of(np.array([2**63, 1], np.uint64))
    assert gaps.tensor_of(np.zeros(0, np.uint64)).shape == (0,)


def test_what_was_assumed_and_still_is():
    assumed = {"start_s": 0.0, "origin": [1.0, 2.0], "legs": False, "x": "a"}
    capture = made(grids()["confocal"], metadata={"assumed": assumed})
    for name, value, same in (
        ("start_s", 0.0, True), ("start_s", 0.1, False), ("origin", torch.tensor([1.0, 2.0]), True),
        ("origin", np.array([1.0, 2.5]), False), ("origin", [1.0], False), ("legs", False, True), ("legs", True, False),
        ("other", 0.0, False), ("x", "a", True), ("x", "b", False), ("x", 1.0, False),
    ):  # fmt: skip
        assert gaps.assumed_in(capture, name, value) is same
    for metadata in ({}, {"assumed": 3}, {"assumed": None}):
        assert not gaps.assumed_in(made(grids()["confocal"], metadata=metadata), "start_s", 0.0)


def test_hidden_sides_are_those_of_normals_or_of_the_sensor():
    scan = listed("confocal")
    np.testing.assert_allclose(gaps.hidden_side(scan), [0, 0, 1])
    bare = replace(scan, sensor_normals=None, laser_normals=None)
    expected = bare.sensor_origin.numpy() - LIST.mean(0).numpy()
    np.testing.assert_allclose(gaps.hidden_side(bare), expected, rtol=0, atol=1e-15)


def test_numbers_of_hidden_volumes():
    said = {"a": [1.0, 2.0], "b": [[3.0]], "c": "x", "d": [1.0]}
    capture = made(grids()["confocal"], metadata={"hidden_volume": said})
    found = gaps.hidden_volume(capture, {"a": 2, "b": 1, "c": 1, "d": 3, "e": 2})
    assert found["a"].tolist() == [1.0, 2.0] and found["b"].tolist() == [3.0]
    for name, size in (("c", 1), ("d", 3), ("e", 2)):
        assert np.isnan(found[name]).all() and found[name].size == size


@pytest.mark.parametrize(("off", "taken"), [(1.0, True), (-1.0, True), (1.05, False), (-1.05, False)])
def test_widths_and_spacings_differ_by_a_cell(tmp_path, off, taken):
    # Four cells, or three or five: what some take for the width of a scan.
    write_mat(tmp_path / "a.mat", {
        "rect_data": np.ones((9, 4, 4)), "width": (4 + off) * 0.25 / 2, "ts": 4e-12, "sampling_spacing": 0.25,
    })  # fmt: skip
    if not taken:
        with pytest.raises(StorageError, match=r"width says that the scan is .* m wide, sampling_spacing 1 m"):
            Capture.read(tmp_path / "a.mat")
        return
    # A confocal scan goes by its width.
    assert Capture.read(tmp_path / "a.mat").scan.spacing == pytest.approx(((4 + off) / 16,) * 2)


def test_sizes_of_scans_by_spacing(tmp_path):
    data = np.arange(9 * 2 * 3.0).reshape(9, 2, 3)
    said = {"rect_data": data, "ts": 4e-12, "sampling_spacing": 0.5}
    write_mat(tmp_path / "a.mat", said | {"SPAD_index": np.array([[1], [2]])})
    found = Capture.read(tmp_path / "a.mat")
    # (t, x, y) in the file: three rows of two columns, lit at x = 1, y = 2.
    assert found.scan.kind == "single" and found.scan.sensor_shape == (3, 2)
    assert found.scan.spacing == pytest.approx((0.5, 0.5))
    torch.testing.assert_close(found.scan.laser_points, torch.tensor([0.25, 0.5, 0.0], dtype=torch.float64))
    np.testing.assert_array_equal(found.transient[0].numpy(), data.swapaxes(1, 2))
    write_mat(tmp_path / "a.mat", said | {"more": np.ones(1)})
    plain = Capture.read(tmp_path / "a.mat")
    assert plain.scan.kind == "confocal" and plain.scan.sensor_shape == (2, 3)
    assert plain.metadata["not_read"] == ["more"]
    assert plain.axis == TimeAxis.from_seconds(0.0, 4e-12, 9)


def test_scene_infos_that_were_read_are_written_again(tmp_path):
    import h5py

    def text_of(path):
        with h5py.File(path) as file:
            return file["scene_info"].asstr()[()] if file["scene_info"].shape is not None else None

    path = made(grids()["confocal"]).write(tmp_path / "a.hdf5", "tal")
    for text in ("name: z  # a comment\n", None):
        with h5py.File(path, "a") as file:
            del file["scene_info"]
            file["scene_info"] = h5py.Empty(float) if text is None else text
        read = Capture.read(path)
        assert text_of(read.write(tmp_path / "b.hdf5", "tal")) == text
        # What was added since has its place in it, beside what stood there.
        for change in (
            {"channels": ("y",)}, {"metadata": {**read.metadata, "more": 1}}, {"steady": torch.ones(1, 3, 4)},
            {"metadata": {**read.metadata, "scene_info": {"name": "other"}}},
        ):  # fmt: skip
            found = text_of(replace(read, **change).write(tmp_path / "b.hdf5", "tal"))
            assert found is not None and "torchtransient:" in found and found != text
            assert Capture.read(tmp_path / "b.hdf5") == replace(read, **change)


NEEDED = {
    "tal": ("H", "H_format", "sensor_grid_xyz"), "dirac": ("data_t", "xg", "yg", "da", "offset_laser"),
    "zaragoza": ("data", "cameraGridPositions", "laserGridPositions", "deltaT"), "keyhole": ("data", "xpos", "zpos"),
}  # fmt: skip


class Names:
    """Contents of which the names alone are known."""

    def __init__(self, shapes, fields=()):
        self.shapes, self._fields = shapes, frozenset(fields)

    def fields(self, name):
        return self._fields


@pytest.mark.parametrize("layout", NEEDED)
def test_layouts_are_known_by_what_they_need(layout):
    (module,) = (one for one in formats.LAYOUTS if one.name == layout)
    names = NEEDED[layout]
    assert module.recognises(Names(dict.fromkeys(names))) and module.recognises(Names(dict.fromkeys((*names, "more"))))
    for left_out in names:
        assert not module.recognises(Names(dict.fromkeys(set(names) - {left_out})))


def test_layouts_are_known_by_the_shapes_of_their_arrays():
    by_name = {layout.name: layout.recognises for layout in formats.LAYOUTS}
    fields = ("data", "laserPos", "cameraPos", "deltat")
    assert by_name["phasor_field"](Names({"dataset": None}, fields))
    assert not by_name["phasor_field"](Names({"dataset": None}, fields[1:]))
    assert not by_name["phasor_field"](Names({}, fields)) and by_name["keyhole"](Names({"direct_after": (9, 1)}))
    assert by_name["rect_data"](Names({"rect_data": (1,)})) and not by_name["rect_data"](Names({"data": (9, 4, 4)}))
    for shape, cdt, rect in (
        ((4, 4, 9), True, False), ((9, 4, 4), False, True), ((4, 4, 4), False, False), ((4, 9, 4), False, False),
        ((4, 4), False, False), (None, False, False),
    ):  # fmt: skip
        assert by_name["cdt"](Names({"meas": shape})) is cdt and by_name["rect_data"](Names({"meas": shape})) is rect
    for shape, cdt in (((9, 1), True), ((9, 2), False), ((9, 1, 1), False), (None, False)):
        assert by_name["cdt"](Names({"out": shape})) is cdt
