"""Files of other programs: the place of each number, values that a file leaves open, and wrong entries."""

from __future__ import annotations

import math
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

from support.capture_files import FROM_ZERO, SQUARE, grids, listed, made, write_mat
from support.sweeps import together
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture
from torchtransient.errors import StorageError
from torchtransient.reconstruction import PlanarScan

LEGS, PLAIN = grids(), grids(legs=False)


def changed(path, entries):
    """Replace entries of an HDF5 file; None makes one HDF5's nothing, GONE removes it."""
    with h5py.File(path, "a") as file:
        for name, value in entries.items():
            given = value(file[name][()]) if callable(value) else value
            attributes = dict(file[name].attrs) if name in file else {}
            if name in file:
                del file[name]
            if given is not GONE:
                file[name] = h5py.Empty(float) if given is None else given
                file[name].attrs.update(attributes)
    return path


GONE = object()


# ---------------------------------------------------------------------------------------------------------------- tal


def test_what_tal_leaves_open(tmp_path):
    """Origins whose distance does not count are assumed, and left out again; those that count are needed."""
    path = made(PLAIN["single"]).write(tmp_path / "a.h5", "tal")
    left = ("sensor_xyz", "laser_xyz", "t_start", "scene_info", "sensor_grid_normals")
    changed(path, dict.fromkeys(left))
    capture = Capture.read(path)
    assert set(capture.metadata["assumed"]) == {"sensor_origin", "laser_origin", "start_s"}
    assert capture.axis.start_opl == 0 and capture.scan.sensor_normals is None
    again = capture.write(tmp_path / "b.h5", "tal")
    with h5py.File(path) as a, h5py.File(again) as b:
        assert set(a) == set(b)
        for name in a:
            assert a[name].shape == b[name].shape and a[name].dtype == b[name].dtype
            assert a[name].shape is None or np.array_equal(a[name][()], b[name][()])
    origin = torch.tensor([0.3, 0.1, 2.0], dtype=torch.float64)
    known = replace(capture, scan=replace(capture.scan, sensor_origin=origin), axis=TimeAxis(0.5, 0.003, 7))
    found = Capture.read(known.write(tmp_path / "b.h5", "tal"))
    assert found == known and set(found.metadata["assumed"]) == {"laser_origin"}
    filled = Capture.read(path, sensor_origin=(0.1, 0.2, 0.9), laser_origin=(-0.3, 0, 1.1), start_s=1e-9)
    assert "assumed" not in filled.metadata and filled.scan.sensor_origin.tolist() == [0.1, 0.2, 0.9]
    changed(path, {"t_accounts_first_and_last_bounces": True})
    with pytest.raises(StorageError, match="sensor_origin"):
        Capture.read(path)


def test_what_others_took_out_of_a_file_of_ours(tmp_path):
    """Origins are assumed a diagonal before the middle of the points."""
    path = made(PLAIN["confocal"]).write(tmp_path / "a.h5", "tal")
    assert Capture.read(path).metadata == {}
    gone = ("sensor_xyz", "t_start", "t_accounts_first_and_last_bounces")
    found = Capture.read(changed(path, {**dict.fromkeys(gone), "laser_more": 1.0}))
    told, scan, points = found.metadata, found.scan, found.scan.sensor_points.reshape(-1, 3)
    diagonal = float((points.amax(0) - points.amin(0)).norm())
    torch.testing.assert_close(scan.sensor_origin, points.mean(0) + diagonal * scan.sensor_normals[0, 0])
    assert set(told["assumed"]) == {"sensor_origin", "start_s", "t_accounts_first_and_last_bounces"}
    assert told["not_read"] == ["laser_more"]


def test_a_steady_image_of_points_that_are_gone(tmp_path):
    """Another program leaves every second column, and `scene_info` as it is."""
    capture = replace(made(LEGS["confocal"]), steady=torch.rand(1, 3, 4), metadata={"a": 1})
    path = capture.write(tmp_path / "a.h5", "tal")
    grid = {f"{who}_grid_{what}": lambda x: x[::2] for who in ("sensor", "laser") for what in ("xyz", "normals")}
    back = Capture.read(changed(path, {"H": lambda h: h[:, ::2], **grid}))
    assert back.steady is None and back.metadata == {"a": 1, "not_read": ["steady"]}
    assert torch.equal(back.transient, capture.transient[..., ::2])


def test_frequencies_of_a_render_of_tal(tmp_path):
    """If only the settings of the render are known, the frequencies follow from them; else they are to be given."""
    capture = made(LEGS["confocal"], phasor=True)
    path = capture.write(tmp_path / "a.h5", "tal")
    # Lines are 1 / (2 m) apart, of 4 - 1 to 4 + 1 with sigma 1 m; more with half of it, where H has three.
    config = "config: {histogram_mode: %s, wl_mean: 0.5, wl_sigma: %s, num_bins: %s, bin_width_opl: 0.02}"
    given = capture.frequencies
    assert Capture.read(changed(path, {"scene_info": config % ("frequency", 1.0, 100)})).frequencies == FrequencyAxis(
        (1.5, 2.0, 2.5), given.start_opl
    )
    for text in (
        config % ("frequency", 0.5, 100), config % ("time", 1.0, 100), config % ("frequency", "'1'", 100),
        config % ("frequency", 1.0, "true"), config % ("frequency", 1e-9, 100), "config: {}", None,
    ):  # fmt: skip
        changed(path, {"scene_info": text})
        with pytest.raises(StorageError, match="frequencies"):
            Capture.read(path)
        back = Capture.read(path, frequencies=given)
        assert torch.equal(back.phasor, capture.phasor) and back.frequencies == given
        assert Capture.read(back.write(tmp_path / "b.h5", "tal")).frequencies == given
    # Phases count from one start: that of the file is none other than that of the frequencies.
    with pytest.raises(StorageError, match=r"start_opl=0\.7"):
        Capture.read(path, frequencies=FrequencyAxis(given.frequencies))
    later = replace(back, frequencies=FrequencyAxis(given.frequencies, 0.25))
    with h5py.File(later.write(tmp_path / "b.h5", "tal")) as file:
        assert file["t_start"][()] == 0.25


def test_scene_infos_that_were_read_are_written_again(tmp_path):
    def text_of(path):
        with h5py.File(path) as file:
            return file["scene_info"].asstr()[()] if file["scene_info"].shape is not None else None

    path = made(LEGS["confocal"]).write(tmp_path / "a.h5", "tal")
    for text in ("name: z  # a comment\n", None):
        read = Capture.read(changed(path, {"scene_info": text}))
        assert text_of(read.write(tmp_path / "b.h5", "tal")) == text
        # Later additions stand beside it.
        for change in (
            {"channels": ("y",)}, {"metadata": {**read.metadata, "more": 1}}, {"steady": torch.ones(1, 3, 4)},
            {"metadata": {**read.metadata, "scene_info": {"name": "other"}}},
        ):  # fmt: skip
            found = text_of(replace(read, **change).write(tmp_path / "b.h5", "tal"))
            assert found != text and Capture.read(tmp_path / "b.h5") == replace(read, **change)
    # Metadata may be anything.
    nonsense = {"dtypes": {"H": "O", "sensor_xyz": 3, "laser_xyz": "<b8"}, "volume_format": "x", "scene_info_text": 3}
    for tal in (nonsense, 3, [], {"dtypes": []}):
        other = replace(read, metadata={"format": "tal", "tal": tal})
        assert torch.equal(Capture.read(other.write(tmp_path / "d.h5", "tal")).transient, read.transient)


def test_simulated_captures_keep_their_wall(tmp_path):
    scan = replace(LEGS["confocal"], wall=dict(SQUARE.shape))
    back = Capture.read(made(scan).write(tmp_path / "a.h5", "tal"))
    assert back.scan == scan
    back.scan.wall["to_world"][0, 0] = 3.0  # memory of its own


@pytest.mark.parametrize("layout", ["tal", "zaragoza"])
def test_confocal_up_to_single_precision_wherever_the_origin_is(tmp_path, layout):
    """Not a share of how far away the origin of coordinates is, nor an absolute length."""
    near = grids(size=(2, 3))["confocal"]
    laser = {"tal": "laser_grid_xyz", "zaragoza": "laserGridPositions"}[layout]
    for scale, away, off, same in ((1.0, 0.0, 1e-7, True), (1.0, 1000.0, 9e-3, False), (1e-9, 0.0, 1e-9, False)):
        names = ("sensor_points", "laser_points", "sensor_origin", "laser_origin")
        moved = replace(near, **{name: getattr(near, name) * scale + away for name in names})
        path = made(moved).write(tmp_path / "a.h5", layout)
        changed(path, {laser: lambda points, off=off: points.astype(np.float64) + off})
        if same:
            found = Capture.read(path)
            assert found.scan.kind == "confocal" and any("aser" in name for name in found.metadata["assumed"])
        elif layout == "tal":
            assert Capture.read(path).scan.kind == "pairs"
        else:
            with pytest.raises(StorageError):
                Capture.read(path)


# ----------------------------------------------------------------------------------------------------------- zaragoza


@together("kind", ["confocal", "single", "exhaustive"])
def test_zaragoza_files_of_both_orders(tmp_path, kind):
    """`data order`: row-major turns all axes round, of data and of positions."""
    capture = made(LEGS[kind])
    path = capture.write(tmp_path / "a.h5", "zaragoza")
    for order in ("column-major", "Column-Major"):
        with h5py.File(path, "a") as file:
            file.attrs["data order"] = np.bytes_(order)
        assert torch.equal(Capture.read(path).transient, capture.transient)
    grid = [f"{who}Grid{what}" for who in ("camera", "laser") for what in ("Positions", "Normals")]
    changed(path, dict.fromkeys(("data", *grid), lambda array: array.T))
    with h5py.File(path, "a") as file:
        file.attrs["data order"] = "row-major"
    back = Capture.read(path)
    assert torch.equal(back.transient, capture.transient)
    assert torch.equal(back.scan.sensor_points, capture.scan.sensor_points)
    assert torch.equal(back.scan.laser_points, capture.scan.laser_points)
    changed(path, {"data": lambda array: array[..., 0]})  # files without colours
    assert torch.equal(Capture.read(path).transient, capture.transient)
    with h5py.File(path, "a") as file:
        file.attrs["data order"] = "sideways"
    with pytest.raises(StorageError, match="sideways"):
        Capture.read(path)


def test_sums_of_bounces_are_those_of_whole_numbers(tmp_path):
    path = made(grids(size=(2, 2))["confocal"]).write(tmp_path / "a.h5", "zaragoza")

    def read(values):
        return Capture.read(changed(path, {"data": lambda data: np.broadcast_to(values, data.shape)}))

    assert read(np.uint16(60_000)).metadata["bounces"] == 6
    for value, total in (
        (np.uint16(60_000), 6 * 60_000), (np.float16(20000), 120000.0), (np.uint64(2**60), 6 * 2**60),
        (np.int64(-(2**60)), -6 * 2**60),
    ):  # fmt: skip
        assert bool((read(value).transient == total).all())
    for value in (np.int64(2**62), np.int64(-(2**62)), np.uint64(2**63)):
        with pytest.raises(StorageError):
            read(value)
    with h5py.File(path, "a") as file:
        del file["data"]
        file.create_dataset("data", (1, 7, 10**6, 2, 2), "f4", chunks=(1, 7, 1000, 2, 2))
    with pytest.raises(StorageError, match="bounces"):
        Capture.read(path)


def test_sizes_of_grids_stand_beside_their_points(tmp_path):
    with h5py.File(made(LEGS["exhaustive"]).write(tmp_path / "a.h5", "zaragoza")) as file:
        # Four by three sensor points of 0.5 m and 1.6 / 3 m, two by five spots of 1 m and 0.32 m.
        assert file["cameraGridPoints"][()].tolist() == [4, 3] and file["laserGridPoints"][()].tolist() == [2, 5]
        np.testing.assert_allclose(file["cameraGridSize"][()], [1.5, 3.2 / 3])
        np.testing.assert_allclose(file["laserGridSize"][()], [1.0, 1.28])
        assert file["data"].shape == (1, 7, 6, 4, 3, 2, 5) and file["isConfocal"][()] == 0
        # All light stands in the second of the bounces.
        assert not file["data"][:, :, [0, 2, 3, 4, 5]].any() and file["data"][:, :, 1].all()
        assert file["t"][()] == 7 and file["t0"][()] == 1.1 and file["deltaT"][()] == 0.003


@together("value", [5, {"hiddenVolumeSize": "big", "minimalpos": [1.0]}, None])
@together("layout, scan", [("zaragoza", LEGS["confocal"]), ("phasor_field", listed("single"))])
def test_hidden_volumes_of_any_metadata(tmp_path, layout, scan, value):
    path = made(scan, metadata={"hidden_volume": value}).write(
        tmp_path / ("a.h5" if layout == "zaragoza" else "a.mat"), layout
    )
    found = Capture.read(path).metadata["hidden_volume"]
    assert all(np.isnan(numbers).all() and np.size(numbers) in (1, 3) for numbers in found.values())


# -------------------------------------------------------------------------------------------------------------- MATLAB


def test_old_matlab_files_are_as_the_new_ones(tmp_path):
    import scipy.io

    path = made(listed("single")).write(tmp_path / "new.mat", "phasor_field")
    with h5py.File(path) as file:
        dataset = {name: file["dataset"][name][()].T for name in file["dataset"]}
        others = {name: file[name][()].T for name in file if name != "dataset"}
    for compressed in (False, True):
        scipy.io.savemat(tmp_path / "old.mat", {"dataset": dataset, **others}, do_compression=compressed)
        old, new = Capture.read(tmp_path / "old.mat"), Capture.read(path)
        assert old == new and old.metadata["reciprocal"] is new.metadata["reciprocal"] is True


@together("compressed", [False, True])
def test_numbers_of_old_matlab_files_against_scipy(tmp_path, compressed):
    """Every kind of numbers, stored in fewer bytes; counts of few photons, packed into less than a bit each."""
    import scipy.io

    rng = np.random.default_rng(0)
    kinds = {kind: (rng.random((3, 3, 4)) * 100).astype(kind) for kind in ("i1", "u1", "i2", "u2", "i4", "u4", "i8")}
    kinds |= {kind: rng.random((3, 3, 4)).astype(kind) for kind in ("f4", "f8")}
    kinds |= {"sparse": (rng.random((32, 32, 512)) < 1e-4).astype(np.uint8), "whole": np.full((3, 3, 4), 7.0)}
    for given in kinds.values():
        scipy.io.savemat(tmp_path / "a.mat", {"rect_data": given, "width": 0.5, "ts": 4e-12}, do_compression=compressed)
        found = Capture.read(tmp_path / "a.mat").transient[0]
        # MATLAB's (x, y, t), each as it was written.
        np.testing.assert_array_equal(found.numpy(), given.transpose(2, 1, 0))
    for wrong in (1j * np.ones((3, 3, 4)), "text", np.array([1, "a"], object), {"a": 1.0}, np.zeros((0, 3, 4))):
        scipy.io.savemat(tmp_path / "a.mat", {"rect_data": wrong, "width": 0.5, "ts": 4e-12})
        with pytest.raises(StorageError):
            Capture.read(tmp_path / "a.mat")


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
    path = tmp_path / "a.mat"
    write_mat(path, {"rect_data": data, "width": 0.5})
    with pytest.raises(StorageError, match="bin_width_s"):
        Capture.read(path)
    capture = Capture.read(path, bin_width_s=4e-12)
    assert capture.axis.bin_width_s == pytest.approx(4e-12, rel=1e-15)
    np.testing.assert_allclose(capture.scan.sensor_points[0, :, 0], [-0.375, -0.125, 0.125, 0.375])
    np.testing.assert_array_equal(capture.transient[0], data)  # MATLAB's (x, y, t)
    with pytest.raises(StorageError, match="wall_size"):
        Capture.read(path, bin_width_s=4e-12, wall_size=1.0)
    write_mat(path, {"meas": data})
    capture = Capture.read(path, bin_width_s=32e-12, wall_size=2.0)
    np.testing.assert_array_equal(capture.transient[0], data.swapaxes(1, 2))  # MATLAB's (y, x, t)
    write_mat(path, {"meas": data[:4]})  # a cube may be either
    with pytest.raises(StorageError, match="no known layout"):
        Capture.read(path)
    for layout, axes in (("rect_data", (0, 2, 1)), ("cdt", (2, 1, 0))):
        found = Capture.read(path, layout, bin_width_s=16e-12, wall_size=2.0)
        np.testing.assert_array_equal(found.transient[0], data[:4].transpose(axes))
    # Arguments are no damage.
    for given in ({"bin_width_s": 0.0}, {"bin_width_s": 1e-12, "start_s": np.nan},
                  {"bin_width_s": 1e-12, "sensor_origin": (0, 0, -1)}):  # fmt: skip
        with pytest.raises(StorageError) as caught:
            Capture.read(path, "rect_data", wall_size=1.0, **given)
        assert "damaged" not in str(caught.value)
    for size in (0.0, (1.0, 0.0), (1.0, math.inf), (1.0, 2.0, 3.0), "wide", math.nan):
        with pytest.raises(StorageError, match="wall_size"):
            Capture.read(path, "cdt", wall_size=size)


@together("off, taken", [(1.0, True), (-1.0, True), (1.05, False), (-1.05, False)])
def test_widths_and_spacings_differ_by_a_cell(tmp_path, off, taken):
    # Four cells, or three or five: what some take for the width of a scan.
    said = {"rect_data": np.ones((9, 4, 4)), "width": (4 + off) * 0.25 / 2, "ts": 4e-12, "sampling_spacing": 0.25}
    write_mat(tmp_path / "a.mat", said)
    if not taken:
        with pytest.raises(StorageError, match="sampling_spacing"):
            Capture.read(tmp_path / "a.mat")
        return
    # A confocal scan goes by its width.
    assert PlanarScan.of_scan(Capture.read(tmp_path / "a.mat").scan, "test").pitch[::-1] == pytest.approx(
        ((4 + off) / 16,) * 2
    )


def test_a_fixed_point_by_its_index(tmp_path):
    data = np.arange(9 * 2 * 3.0).reshape(9, 2, 3)
    said = {"rect_data": data, "ts": 4e-12, "sampling_spacing": 0.5}
    write_mat(tmp_path / "a.mat", said | {"SPAD_index": np.array([[1], [2]])})
    found = Capture.read(tmp_path / "a.mat")
    # (t, x, y) in the file: three rows of two columns, lit at x = 1, y = 2.
    assert found.scan.kind == "single" and found.scan.sensor_shape == (3, 2)
    assert PlanarScan.of_scan(found.scan, "test").pitch[::-1] == pytest.approx((0.5, 0.5))
    torch.testing.assert_close(found.scan.laser_points, torch.tensor([0.25, 0.5, 0.0], dtype=torch.float64))
    np.testing.assert_array_equal(found.transient[0].numpy(), data.swapaxes(1, 2))
    write_mat(tmp_path / "a.mat", said | {"more": np.ones(1)})
    plain = Capture.read(tmp_path / "a.mat")
    assert plain.scan.kind == "confocal" and plain.scan.sensor_shape == (2, 3)
    assert plain.metadata["not_read"] == ["more"] and plain.axis == TimeAxis.from_seconds(0.0, 4e-12, 9)


KEYHOLE = {"data": np.arange(45.0).reshape(5, 9), "xpos": np.arange(5.0), "zpos": np.arange(5.0) / 8}


def test_keyhole_points_are_the_walls_in_the_frame_of_the_object(tmp_path):
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


# ------------------------------------------------------------------------------------------------------- wrong entries

FILES = {
    "dirac": ("dirac", made(PLAIN["confocal"])),
    "tal": ("tal", made(LEGS["confocal"])),
    "tal single": ("tal", made(LEGS["single"])),
    "tal phasor": ("tal", made(LEGS["confocal"], phasor=True)),
    "zaragoza": ("zaragoza", made(LEGS["confocal"])),
    "zaragoza pairs": ("zaragoza", made(LEGS["exhaustive"])),
    "phasor_field": ("phasor_field", made(listed("exhaustive"))),
    "rect_data": ("rect_data", made(replace(
        grids(legs=False, wall=SQUARE, size=(4, 4))["single"],
        laser_points=grids(legs=False, wall=SQUARE, size=(4, 4))["single"].sensor_points[1, 2]), axis=FROM_ZERO)),
}  # fmt: skip
LEG = "t_accounts_first_and_last_bounces"
WRONG = {
    "dirac": [
        {"xg": lambda x: x[:-1]}, {"da": lambda t: t[:-1]}, {"da": lambda t: t[:1], "data_t": lambda d: d[:1]},
        {"da": lambda t: t + 1.1e-3 * 0.003 * (np.arange(7) == 3)}, {"da": lambda t: t[::-1]},
        {"data_t": lambda d: d[0]}, {"data_t": lambda d: d + 1j}, {"offset_laser": None},
    ],
    "tal": [
        {"H": None}, {"H": lambda h: h[0]}, {"H": lambda h: h[..., None, None]}, {"H": lambda h: h + 1j},
        {"H_format": 7}, {"H_format": 1.5}, {"H_format": np.array([1, 1])}, {"sensor_grid_format": 1},
        {"sensor_grid_xyz": lambda p: p[0, 0]}, {"sensor_grid_xyz": lambda p: p[..., :2]}, {"sensor_grid_xyz": None},
        {"sensor_grid_normals": lambda n: n[:-1]}, {"laser_grid_xyz": lambda p: p[:2], "laser_grid_normals": None},
        {"sensor_xyz": lambda p: p + 0j}, {"delta_t": np.array([0.1, 0.2])}, {"sensor_xyz": np.zeros(4)},
        {"scene_info": None, "volume_format": 2.5}, *({LEG: value} for value in (np.nan, 2.0, 1j, "False")),
    ],
    "tal phasor": [{"H": lambda h: h.real}, {"scene_info": None}],
    "tal single": [{"laser_grid_xyz": lambda p: np.repeat(p, 2, 0), "laser_grid_normals": None}],
    "zaragoza": [
        {"cameraGridPositions": None}, {"deltaT": GONE}, {"data": lambda d: d[0, 0, 0]}, {"data": lambda d: d[0, 0]},
        {"data": lambda d: d + 1j}, {"data": lambda d: d[:, :0]}, {"cameraGridPositions": lambda p: p[:2]},
        {"cameraGridNormals": lambda n: n[..., :-1]}, {"deltaT": np.array([0.1, 0.2])}, {"t0": 1j},
        {"cameraPosition": np.zeros(2)}, {"laserGridPositions": lambda p: p + 0.1},
    ],
    "zaragoza pairs": [{"laserGridPositions": lambda p: p[:, :-1], "laserGridNormals": GONE}],
    "phasor_field": [
        {"dataset/data": lambda d: d[0]}, {"dataset/data": None}, {"dataset/t": 8.0},
        {"dataset/data": lambda d: d + 1j}, {"dataset/laserPos": lambda p: p[:2]}, {"dataset/laserPos": None},
        {"dataset/cameraNorm": lambda n: n[:, :2]}, {"dataset/deltat": np.array([0.1, 0.2])},
        {"dataset/laserOrigin": np.zeros((4, 1))},
    ],
    "rect_data": [
        *({"SPAD_index": np.array(index)} for index in ([[4.0], [0.0]], [[-1.0], [0.0]], [[0.5], [0.0]], [[0.0]])),
        {"ts": 0.0}, {"ts": np.array([1.0, 2.0])}, {"ts": math.inf}, {"sampling_spacing": -0.1},
        {"rect_data": lambda d: d[0]}, {"rect_data": lambda d: d + 1j},
    ],
}  # fmt: skip
TAKEN = [
    ("tal", {"laser_grid_xyz": lambda p: p + 0.1}), ("tal", {"volume_format": 2.5}),  # pairs; not needed
    ("phasor_field", {"dataset/cameraNorm": lambda n: n[:, :1], "dataset/t": GONE}),  # one normal for all of them
    ("rect_data", {"SPAD_index": np.array([[3.0], [0.0]])}),
    ("dirac", {"da": lambda t: t + 0.9e-3 * 0.003 * (np.arange(7) == 3)}),
]  # fmt: skip


@together("name, entries, taken", [*((name, entries, False) for name in WRONG for entries in WRONG[name]),
                                   *((name, entries, True) for name, entries in TAKEN)])  # fmt: skip
def test_entries_that_are_wrong(tmp_path, name, entries, taken):
    layout, capture = FILES[name]
    path = capture.write(tmp_path / f"a.{'mat' if layout in ('phasor_field', 'rect_data') else 'h5'}", layout)
    changed(path, entries)
    if taken:
        assert isinstance(Capture.read(path, layout), Capture)
        return
    with pytest.raises(StorageError):
        Capture.read(path, layout)


@together("layout, entries", [
    ("keyhole", KEYHOLE | {"xpos": np.arange(4.0)}), ("keyhole", KEYHOLE | {"zpos": np.arange(6.0)}),
    ("keyhole", KEYHOLE | {"zpos": np.arange(5) * 1j}), ("keyhole", KEYHOLE | {"data": np.zeros((5, 9, 2))}),
    ("keyhole", KEYHOLE | {"data": np.ones((5, 9)) * 1j}), ("cdt", {"meas": np.ones((3, 5))}),
    ("cdt", {"meas": 1j * np.ones((3, 3, 5))}), ("cdt", {"out": np.ones((3, 3, 5))}),
])  # fmt: skip
def test_layouts_that_are_only_read_with_a_wrong_entry(tmp_path, layout, entries):
    write_mat(tmp_path / "a.mat", entries)
    with pytest.raises(StorageError):
        Capture.read(tmp_path / "a.mat", layout, **({"wall_size": 1.0} if layout == "cdt" else {}))


@together("given", [
    {"frequencies": (1.0, 2.0, 3.0)}, {"wall_size": 1.0}, {"sensor_origin": (0, 0, 1)},
])  # fmt: skip
def test_arguments_that_a_file_has_no_use_for(tmp_path, given):
    path = FILES["tal phasor"][1].write(tmp_path / "a.h5", "tal")
    changed(path, {"scene_info": None})
    with pytest.raises(StorageError, match=next(iter(given))):
        Capture.read(path, "tal", **{"frequencies": FILES["tal phasor"][1].frequencies, **given})
    own = made(LEGS["confocal"]).write(tmp_path / "b.h5")
    with pytest.raises(StorageError, match="wall_size"):
        Capture.read(own, wall_size=2.0)
