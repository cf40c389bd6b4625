"""Whatever a layout is given comes back as it was, or is an error when it is written: kinds, shapes, numbers, sides."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

from support.capture_files import FROM_ZERO, ORIGINS, SQUARE, UP, grids, listed, made
from support.sweeps import together
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.errors import StorageError
from torchtransient.files.captures.contents import MatContents
from torchtransient.files.captures.formats import FORMATS, LAYOUTS
from torchtransient.files.captures.matlab import write_mat

ENDINGS = {"torchtransient": "h5"} | {layout.name: layout.endings[0][1:] for layout in LAYOUTS}
WRITTEN = ["torchtransient", *(layout.name for layout in LAYOUTS if layout.write is not None)]
KINDS = ("single", "confocal", "exhaustive", "pairs")


def scans():
    """Of every kind with few points, and with one."""
    for legs in (True, False):
        settings = {**ORIGINS, "first_and_last_leg": legs}
        for size in ((1, 1), (1, 3), (2, 2)) if legs else ((2, 2),):
            for kind in KINDS[:3]:
                for spots in ((1, 1), (2, 1)) if kind == "exhaustive" else (None,):
                    if kind != "exhaustive" or size != (1, 1) or spots != (1, 1):
                        yield Scan.grid(SQUARE, size, kind=kind, laser_grid=spots, **settings)
        one = Scan.grid(SQUARE, 1, kind="confocal", **settings)
        yield replace(one, kind="single", laser_points=one.laser_points[0, 0], laser_normals=UP)
        for kind in KINDS:
            whole = listed(kind, legs)
            yield whole
            points = whole.sensor_points[:1]
            spots = {"single": points[0], "confocal": points, "pairs": points}.get(kind, whole.laser_points)
            normals = {"single": UP, "confocal": UP[None], "pairs": UP[None]}.get(kind, whole.laser_normals)
            yield replace(
                whole, sensor_points=points, sensor_normals=UP[None], laser_points=spots, laser_normals=normals
            )


def back(path, layout, capture):
    """What is read of a capture that was written; None where it was refused. Nothing is left then."""
    try:
        capture.write(path, format=layout)
    except StorageError:
        assert not path.exists() and list(path.parent.iterdir()) == []
        return None
    known = {}
    if layout == "dirac" and capture.scan.first_and_last_leg:
        known = {name: getattr(capture.scan, name).tolist() for name in ("sensor_origin", "laser_origin")}
    found = Capture.read(path, layout, **known)
    path.unlink()
    return found


@pytest.mark.parametrize("layout", WRITTEN)
def test_kinds_and_shapes(tmp_path, layout):
    held = 0
    for scan in scans():
        capture = made(replace(scan, wall=None), FROM_ZERO)
        found = back(tmp_path / f"a.{ENDINGS[layout]}", layout, capture)
        if found is None:
            continue
        held += 1
        ours, theirs = capture.scan, found.scan
        assert (ours.kind, ours.first_and_last_leg) == (theirs.kind, theirs.first_and_last_leg), ours
        if layout == "phasor_field":  # grids become lists
            assert torch.equal(found.transient.reshape(-1), capture.transient.reshape(-1))
        else:
            assert torch.equal(found.transient, capture.transient) and ours.shape == theirs.shape
        if layout != "rect_data":  # says where nothing is
            assert torch.equal(ours.sensor_points.reshape(-1), theirs.sensor_points.reshape(-1))
    assert held > 0


NUMBERS = (
    torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64, torch.uint16, torch.uint32,
    torch.uint64, torch.float16, torch.bfloat16, torch.float8_e5m2, torch.float32, torch.float64,
)  # fmt: skip


@pytest.mark.slow
@together("dtype", NUMBERS)
@together("layout", WRITTEN)
def test_numbers_of_every_kind(tmp_path, layout, dtype):
    """Values come back; types as torch computes with them."""
    kind = "single" if layout == "phasor_field" else "confocal"
    scan = grids(legs=layout != "rect_data", wall=SQUARE, size=(2, 2))[kind]
    values = torch.zeros(1, 7, 2, 2, dtype=torch.float64).to(dtype)
    values[0, 0] = torch.tensor(1.0).to(dtype)
    if dtype not in (torch.bool, torch.uint64):
        limits = torch.finfo(dtype) if dtype.is_floating_point else torch.iinfo(dtype)
        values[0, 1] = torch.tensor(limits.max, dtype=torch.float64 if dtype.is_floating_point else None).to(dtype)
    path = tmp_path / f"a.{ENDINGS[layout]}"
    found = back(path, layout, Capture(values, FROM_ZERO, scan))
    if found is None:
        assert dtype in (torch.bool, torch.bfloat16, torch.float8_e5m2)
    else:
        assert torch.equal(found.transient.double().reshape(-1), values.double().reshape(-1))
    if dtype == torch.uint64:
        huge = torch.from_numpy(np.full(values.shape, 2**63 + 7, np.uint64))
        found = back(path, layout, Capture(huge, FROM_ZERO, scan))
        assert torch.equal(found.transient, huge) if layout == "torchtransient" else found is None


def test_sums_of_bounces_are_those_of_whole_numbers(tmp_path):
    capture = made(grids(size=(2, 2))["confocal"])
    path = capture.write(tmp_path / "a.h5", "zaragoza")

    def read(values):
        with h5py.File(path, "a") as file:
            shape = file["data"].shape
            del file["data"]
            file["data"] = np.broadcast_to(values, shape)
        return Capture.read(path).transient

    assert float(read(np.float16(20000)).max()) == 120000.0
    assert int(read(np.uint64(2**60)).max()) == 6 * 2**60
    assert int(read(np.int64(-(2**60))).max()) == -6 * 2**60
    for values in (np.int64(2**62), np.int64(-(2**62)), np.uint64(2**63)):
        with pytest.raises(StorageError, match="2\\^63"):
            read(values)
    with h5py.File(path, "a") as file:
        del file["data"]
        file.create_dataset("data", (1, 7, 10**6, 2, 2), "f4", chunks=(1, 7, 1000, 2, 2))
    with pytest.raises(StorageError, match="at most 1000 bounces"):
        Capture.read(path)


# -------------------------------------------------------------------------------------------------- the side of a wall


def mirrored(scan, how):
    if how == "hidden side":
        other = {name: -getattr(scan, name) for name in ("sensor_normals", "laser_normals")}
        origins = {n: getattr(scan, n) * torch.tensor([1, 1, -1.0]) for n in ("sensor_origin", "laser_origin")}
        return replace(scan, **other, **origins)
    if how == "hidden side that origins tell":
        return replace(mirrored(scan, "hidden side"), sensor_normals=None, laser_normals=None)
    ways = {"rows": lambda p: p.flip(0), "columns": lambda p: p.flip(1), "exchanged": lambda p: p.transpose(0, 1)}
    sensor = ways[how](scan.sensor_points).contiguous()
    return replace(scan, sensor_points=sensor, laser_points=sensor if scan.kind == "confocal" else scan.laser_points)


@pytest.mark.parametrize("how", ["hidden side", "hidden side that origins tell", "rows", "columns", "exchanged"])
def test_mirror_images_are_not_written(tmp_path, how):
    """The handedness of columns, rows and hidden side is the same in what is read, or it is an error."""
    square = grids(legs=False, wall=SQUARE, size=(4, 4))
    square["single"] = replace(square["single"], laser_points=square["single"].sensor_points[1, 2])
    for layout, kind in (("dirac", "confocal"), ("rect_data", "confocal"), ("rect_data", "single")):
        capture = made(mirrored(square[kind], how), FROM_ZERO)
        found = back(tmp_path / f"a.{ENDINGS[layout]}", layout, capture)
        if found is not None:
            assert handed(found.scan) == handed(capture.scan)
        assert (found is None) == (layout == "rect_data" or "side" in how or how == "exchanged")
        turned = made(mirrored(mirrored(square[kind], "rows"), "columns"), FROM_ZERO)  # a motion
        found = back(tmp_path / f"a.{ENDINGS[layout]}", layout, turned)
        assert found is not None and handed(found.scan) == handed(turned.scan)


def handed(scan):
    x, y = scan.sensor_points[0, -1] - scan.sensor_points[0, 0], scan.sensor_points[-1, 0] - scan.sensor_points[0, 0]
    side = scan.sensor_origin[2].sign() * UP if scan.sensor_normals is None else scan.sensor_normals[0, 0]
    return float(torch.linalg.cross(x, y) @ side) > 0


# --------------------------------------------------------------------------------------------------- files of y-tal


def emptied(path, *names):
    with h5py.File(path, "a") as file:
        for name in names:
            del file[name]
            file[name] = h5py.Empty(float)


def test_origins_that_were_assumed_and_then_known(tmp_path):
    path = made(grids(legs=False)["confocal"]).write(tmp_path / "a.hdf5", "tal")
    emptied(path, "sensor_xyz", "laser_xyz", "scene_info", "t_accounts_first_and_last_bounces", "t_start")
    read = Capture.read(path)
    assert set(read.metadata["assumed"]) >= {"sensor_origin", "laser_origin", "start_s"}
    again = Capture.read(read.write(tmp_path / "b.hdf5", "tal"))
    assert again == read and again.metadata == read.metadata
    origin = torch.tensor([0.3, 0.1, 2.0], dtype=torch.float64)
    for legs in (False, True):
        known = replace(read, scan=replace(read.scan, sensor_origin=origin, first_and_last_leg=legs))
        found = Capture.read(known.write(tmp_path / "b.hdf5", "tal"))
        assert found == known and found.scan.first_and_last_leg == legs
        assert "sensor_origin" not in found.metadata.get("assumed", {})
    later = replace(read, axis=TimeAxis(0.5, 0.003, 7))
    assert Capture.read(later.write(tmp_path / "b.hdf5", "tal")).axis == later.axis


def test_what_others_took_out_of_a_file_of_ours(tmp_path):
    path = made(grids(legs=False)["confocal"]).write(tmp_path / "a.hdf5", "tal")
    assert Capture.read(path).metadata == {}
    emptied(path, "sensor_xyz", "t_start", "t_accounts_first_and_last_bounces")
    with h5py.File(path, "a") as file:
        file["laser_more"] = 1.0
    told = Capture.read(path).metadata
    assert set(told["assumed"]) == {"sensor_origin", "start_s", "t_accounts_first_and_last_bounces"}
    assert told["not_read"] == ["laser_more"]


def test_phases_count_from_one_start(tmp_path):
    capture = made(grids()["confocal"], phasor=True)
    path = capture.write(tmp_path / "a.hdf5", "tal")
    assert Capture.read(path) == capture
    emptied(path, "scene_info")  # as y-tal leaves it
    lines = capture.frequencies.frequencies
    with pytest.raises(StorageError, match=r"start_opl=0\.7"):
        Capture.read(path, frequencies=FrequencyAxis(lines))
    read = Capture.read(path, frequencies=FrequencyAxis(lines, 0.7))
    assert torch.equal(read.phasor, capture.phasor) and read.frequencies == capture.frequencies
    for start in (0.25, 0.0):
        later = replace(read, frequencies=FrequencyAxis(lines, start))
        with h5py.File(later.write(tmp_path / "b.hdf5", "tal")) as file:
            assert file["t_start"][()] == start
        assert Capture.read(tmp_path / "b.hdf5") == later


@pytest.mark.parametrize("value", [np.nan, -1, 2.0, 1j, np.array([False, True]), "False"])
def test_flags_are_no_truth_values_of_anything(tmp_path, value):
    path = made(grids()["confocal"]).write(tmp_path / "a.hdf5", "tal")
    with h5py.File(path, "a") as file:
        del file["t_accounts_first_and_last_bounces"]
        file["t_accounts_first_and_last_bounces"] = value
    with pytest.raises(StorageError):
        Capture.read(path)


@pytest.mark.parametrize("layout", ["tal", "zaragoza"])
def test_confocal_up_to_single_precision_wherever_the_origin_is(tmp_path, layout):
    """Not a share of how far away the origin of coordinates is, nor an absolute length."""
    near = grids(size=(2, 3))["confocal"]
    laser = {"tal": "laser_grid_xyz", "zaragoza": "laserGridPositions"}[layout]
    for scale, away, off, same in ((1.0, 0.0, 1e-7, True), (1.0, 1000.0, 9e-3, False), (1e-9, 0.0, 1e-9, False)):
        moved = {
            name: getattr(near, name) * scale + away
            for name in ("sensor_points", "laser_points", "sensor_origin", "laser_origin")
        }
        path = made(replace(near, **moved)).write(tmp_path / "a.h5", layout)
        with h5py.File(path, "a") as file:
            points = file[laser][()].astype(np.float64) + off
            del file[laser]
            file[laser] = points
        if same:
            found = Capture.read(path)
            assert found.scan.kind == "confocal" and any("aser" in name for name in found.metadata["assumed"])
        elif layout == "tal":
            assert Capture.read(path).scan.kind == "pairs"
        else:
            with pytest.raises(StorageError):
                Capture.read(path)


# ------------------------------------------------------------------------------------------------ words and arguments


@pytest.mark.parametrize("value", [5, {"hiddenVolumeSize": "big", "minimalpos": [1.0]}, None])
@pytest.mark.parametrize(("layout", "kind"), [("zaragoza", "confocal"), ("phasor_field", "single")])
def test_hidden_volumes_of_anyone(tmp_path, layout, kind, value):
    capture = made(listed(kind) if layout == "phasor_field" else grids()[kind], metadata={"hidden_volume": value})
    found = back(tmp_path / f"a.{ENDINGS[layout]}", layout, capture).metadata["hidden_volume"]
    assert all(np.isnan(numbers).all() and np.size(numbers) in (1, 3) for numbers in found.values())


def test_arguments_are_not_damage(tmp_path):
    write_mat(tmp_path / "a.mat", {"meas": np.ones((16, 4, 4), np.float32)})
    for given, words in (
        ({"bin_width_s": 0.0}, "bin_width_s: expected a finite number greater than zero"),
        ({"bin_width_s": 1e-12, "start_s": np.nan}, "start_s: expected a finite number"),
        ({"bin_width_s": 1e-12, "sensor_origin": (0, 0, -1)}, "sensor_origin in front of the wall"),
    ):
        with pytest.raises(StorageError, match=words) as caught:
            Capture.read(tmp_path / "a.mat", wall_size=1.0, **given)
        assert "damaged" not in str(caught.value)


def test_a_width_and_a_spacing_that_differ(tmp_path):
    data = np.ones((9, 4, 4), np.float32)
    for more in ({}, {"SPAD_index": np.array([[1.0], [1.0]])}):
        write_mat(tmp_path / "a.mat", {"rect_data": data, "width": 0.5, "ts": 4e-12, "sampling_spacing": 0.001, **more})
        with pytest.raises(StorageError, match="sampling_spacing"):
            Capture.read(tmp_path / "a.mat")
        write_mat(tmp_path / "a.mat", {"rect_data": data, "width": 0.5, "ts": 4e-12, "sampling_spacing": 0.25, **more})
        assert Capture.read(tmp_path / "a.mat").scan.spacing == pytest.approx((0.25, 0.25))


def test_counts_of_few_photons(tmp_path):
    """MATLAB packs them into less than a bit each; what is unpacked is compared with what is stored."""
    import scipy.io

    counts = np.random.default_rng(0).random((32, 32, 512)) < 1e-4
    for kind in (np.uint8, np.uint16, np.float64):
        scipy.io.savemat(
            tmp_path / "a.mat", {"rect_data": counts.astype(kind), "width": 0.5, "ts": 4e-12}, do_compression=True
        )
        assert float(Capture.read(tmp_path / "a.mat").transient.double().sum()) == counts.sum()


def test_structures_count_for_memory_too(tmp_path, monkeypatch):
    import scipy.io

    from torchtransient.array_files import hdf5

    for compressed in (False, True):
        scipy.io.savemat(tmp_path / "a.mat", {"dataset": {"data": np.ones((50, 50))}}, do_compression=compressed)
        contents = MatContents(tmp_path / "a.mat")
        assert contents.array("dataset/data").shape == (50, 50)
        with monkeypatch.context() as patched:
            patched.setattr(hdf5, "_LARGE_BYTES", 100)
            patched.setattr(hdf5, "available_memory", lambda *_: 10_000)
            with pytest.raises(StorageError, match="of memory are left"):
                MatContents(tmp_path / "a.mat").array("dataset/data")


@pytest.mark.parametrize("compressed", [False, True])
def test_old_matlab_files_against_scipy(tmp_path, compressed):
    """Every kind of numbers, texts, structures; stored in fewer bytes, and in the other order of bytes."""
    import scipy.io

    rng = np.random.default_rng(0)
    kinds = ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8", "c8", "c16")
    given = {kind: (rng.random((2, 3, 4)) * 100).astype(kind) for kind in kinds}
    given |= {"row": np.arange(5.0), "one": 3.5, "structure": {"a": given["f4"], "inner": {"b": given["u2"]}}}
    given |= {"text": "straße", "flag": np.array([[True, False]]), "nothing": np.zeros((0, 3)), "cell": [1.0, "a"]}
    scipy.io.savemat(tmp_path / "a.mat", given, do_compression=compressed)
    contents = MatContents(tmp_path / "a.mat")
    for kind in kinds:
        assert contents.shapes[kind] == (4, 3, 2)
        found = contents.array(kind)
        np.testing.assert_array_equal(found, given[kind].T)
        assert found.dtype == (kind if kind != "c8" else np.complex64) and found.flags.writeable
        np.testing.assert_array_equal(contents.array(kind, (slice(None), 1)), given[kind].T[:, 1])
    np.testing.assert_array_equal(contents.array("structure/inner/b"), given["u2"].T)
    assert contents.fields("structure") == {"a", "inner"} and contents.shapes["structure"] is None
    assert contents.array("structure/c") is None and contents.array("nothing") is None and contents.array("?") is None
    assert contents.text("text") == "straße" and contents.array("flag").tolist() == [[1], [0]]
    assert contents.array("row").shape == (5, 1) and float(contents.array("one")[0, 0]) == 3.5
    for name in ("cell", "structure", "text"):
        with pytest.raises(StorageError, match="expected an array of numbers"):
            contents.array(name)


def old_matlab(order, stored, values, shape=None, kind=6):
    """A variable `m` of class double whose numbers are stored as others, in an order of bytes."""
    import struct

    def element(number, data):
        return struct.pack(f"{order}II", number, len(data)) + data + bytes(-len(data) % 8)

    shape = values.shape if shape is None else shape
    parts = element(6, struct.pack(f"{order}II", kind, 0)) + element(5, struct.pack(f"{order}ii", *shape))
    parts += struct.pack(f"{order}II4s", 1 << 16 | 1, ord("m") if order == "<" else ord("m") << 24, b"")[:8]
    parts += element(stored, values.T.astype(values.dtype.newbyteorder(order)).tobytes())
    version = b"\x00\x01IM" if order == "<" else b"\x01\x00MI"
    return b"MATLAB 5.0".ljust(124) + version + element(14, parts)


def test_old_matlab_files_of_either_order_and_damaged_ones(tmp_path):
    path, values = tmp_path / "a.mat", np.arange(12, dtype=np.uint8).reshape(3, 4)
    for order in "<>":
        path.write_bytes(old_matlab(order, 2, values))
        found = MatContents(path).array("m")
        assert found.dtype == np.float64
        np.testing.assert_array_equal(found, values.T)
        # Types that there are not, or that are no numbers; sizes that are not those of the numbers.
        for stored, shape in ((0, None), (8, None), (14, None), (19, None), (255, None), (2, (3, 5)), (2, (-3, -4))):
            path.write_bytes(old_matlab(order, stored, values, shape))
            with pytest.raises(StorageError):
                Capture.read(path, "rect_data")
            with pytest.raises((ValueError, StorageError)):
                MatContents(path).array("m")
    whole = old_matlab("<", 2, values)
    for end in range(130, len(whole), 7):
        path.write_bytes(whole[:end])
        with pytest.raises(StorageError):
            Capture.read(path)
    path.write_bytes(whole[:132] + b"\xff\xff\xff\x7f" + whole[136:])  # two gigabytes in a file of two hundred bytes
    with pytest.raises(StorageError, match="does not end in a file"):
        Capture.read(path)


@pytest.mark.parametrize("link", [h5py.SoftLink("/there"), h5py.ExternalLink("/etc/passwd", "x")])
def test_links_are_named(tmp_path, link):
    write_mat(tmp_path / "a.mat", {"there": np.ones((9, 4, 4), np.float32)})
    with h5py.File(tmp_path / "a.mat", "a") as file:
        file["rect_data"] = link
    with pytest.raises(StorageError, match=r"rect_data \(a link, which is not followed\), there"):
        Capture.read(tmp_path / "a.mat")


def test_orders_of_axes(tmp_path):
    path = made(grids(wall=SQUARE, size=(3, 3))["confocal"]).write(tmp_path / "a.h5", "zaragoza")
    expected = Capture.read(path)
    for order in ("column-major", b"Column-Major", np.array([b"column-major"])):
        with h5py.File(path, "a") as file:
            file.attrs["data order"] = order if not isinstance(order, str) else np.bytes_(order)
        assert Capture.read(path) == expected
    with h5py.File(path, "a") as file:
        file.attrs["data order"] = np.bytes_(b"sideways")
    with pytest.raises(StorageError, match="sideways"):
        Capture.read(path)


def test_no_layout_is_forgotten():
    assert {*WRITTEN, "cdt", "keyhole", "tmf8828", "vl53l8"} == set(FORMATS)
