"""Contract of the library's own files: results, captures and volumes come back bit by bit, and changes are noticed."""

from __future__ import annotations

import io
import json
import os
import shutil
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.capture_files import FREQUENCIES, grids, listed, made, volume
from support.hostile_captures import WAYS, lead_elsewhere
from support.killed_writers import output
from support.sealed_files import as_first_version
from support.sweeps import together
from torchtransient.array_files import array_file, hdf5
from torchtransient.errors import MissingPackageError, ShapeError, StorageError, UnitError
from torchtransient.files import read_result, write_result

SEED = 3
SCAN = grids()["confocal"]


KINDS = {
    "result": (lambda path: write_result(path, output(SEED), {"scene": "box.xml"}), read_result),
    "capture": (lambda path: made(SCAN, metadata={"a": "b"}).write(path), tt.nlos.Capture.read),
    "volume": (lambda path: tt.nlos.write_volume(path, volume()), tt.nlos.read_volume),
}
MEASURED = {"result": "transient", "capture": "transient", "volume": "values"}
each_kind = pytest.mark.parametrize("kind", KINDS)


def members(path):
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist()}


def packed(path, entries, method=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", method) as file:
        for name, data in entries.items():
            file.writestr(name, data)
    return path


def as_npy(value):
    stream = io.BytesIO()
    np.save(stream, value)
    return stream.getvalue()


# ---------------------------------------------------------------------------------------------------------- round trip


def outputs():
    """Renders of every film, with and without a batch."""
    generator = torch.Generator().manual_seed(0)
    out = output(SEED)
    yield out
    yield type(out).stack([out, out])
    film = torch.rand(2, 4, 6, 3, 2, 2, generator=generator)  # the film's order: H, W, F, C, parts
    phasor = torch.view_as_complex(film).movedim((-1, -2), (-4, -3))
    yield replace(out, transient=None, axis=None, steady=phasor[..., 0, :, :].real, phasor=phasor,
                  frequencies=tt.FrequencyAxis((0.0, 0.5, -2.0), 1.5))  # fmt: skip
    scene = tt.load(tt.scenes.cornell_box(resolution=4, num_bins=12, start_opl=3.5, bin_width_opl=0.5))
    axis = tt.TimeAxis(3.5, 0.5, 12)
    for film in ({"rates": tt.RateAxis(-10.0, 4.0, 5)}, {"chirps": tt.Chirps(1e9, 1e-5, 1.55e-6)}):
        with pytest.warns(tt.errors.TorchTransientWarning, match="nothing moves"):
            yield tt.TransientRenderer(scene, spp=4, time_axis=axis, **film)(seed=0).detach()


def captures():
    curved = tt.nlos.Wall.mesh([[-1, -1, 0], [1, -1, 0.1], [1, 1, 0], [-1, 1, 0.1]], [[0, 1, 2], [0, 2, 3]])
    wall = {"type": "rectangle", "to_world": np.eye(4), "tuple": (1, 2), "bsdf": {"reflectance": [0.1, 0.2, 0.3]}}
    scan = replace(SCAN, wall=wall)
    capture = made(scan, channels=("a",), metadata={"spp": 3, "nested": {"numbers": [0.1, 2]}})
    yield capture
    yield made(tt.nlos.Scan.grid(curved, (4, 3), kind="confocal"))
    yield from (made(listed(kind)) for kind in ("single", "confocal", "exhaustive", "pairs"))
    for kind in grids():
        yield made(grids()[kind], polarized=True, steady=torch.rand(4, 1, *grids()[kind].shape))
    both = torch.randn(1, 3, *SCAN.shape, dtype=torch.complex64, generator=torch.Generator().manual_seed(1)).conj()
    yield replace(capture, phasor=both, frequencies=FREQUENCIES)
    yield type(capture).stack([capture, capture])
    values = capture.transient.double()
    values[0, 0, 0, :3] = torch.tensor([torch.nan, -0.0, torch.inf], dtype=torch.float64)
    for other in (values, values.half(), values.nan_to_num(0, 0, 0).to(torch.int32)):
        yield replace(capture, transient=other)


def volumes():
    yield volume()
    yield replace(volume(), values=torch.rand(1, 2, 4, 5, 6), times=torch.tensor([0.1, 0.4], dtype=torch.float64))
    yield replace(volume(), directions=torch.rand(1, 3, 4, 5, 6))


ALL = {
    "result": (outputs, lambda path, value: write_result(path, value, {"scene": "box.xml"})),
    "capture": (captures, lambda path, value: value.write(path)),
    "volume": (volumes, tt.nlos.write_volume),
}


@pytest.mark.parametrize("ending", ["h5", "npz"])
@each_kind
def test_round_trip(tmp_path, monkeypatch, kind, ending):
    """In one part and in many, which the reader takes from the file."""
    make, write = ALL[kind]
    for number, value in enumerate(make()):
        with monkeypatch.context() as patched:
            if number % 2:
                patched.setattr(array_file, "_PART_BYTES", 100)
            path = write(tmp_path / f"a.{ending}", value)
        found = KINDS[kind][1](path)
        given = value.__dict__ if kind != "result" else value.tensors()
        for name in given:
            ours, theirs = getattr(value, name), getattr(found, name)
            if isinstance(ours, torch.Tensor):
                assert ours.dtype == theirs.dtype and ours.shape == theirs.shape
                assert ours.detach().resolve_conj().numpy().tobytes() == theirs.numpy().tobytes(), name
        for name in ("axis", "frequencies", "rate_axis", "chirps", "channels", "scan", "grid", "method"):
            assert getattr(found, name, None) == getattr(value, name, None), name
        assert kind == "result" or found.metadata == value.metadata
        again = KINDS[kind][1](write(tmp_path / f"b.{ending}", found))
        assert again == found and again.metadata == found.metadata


def test_walls_of_captures(tmp_path):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 0.5]), "tuple": (1, 2)}
    back = tt.nlos.Capture.read(made(replace(SCAN, wall=wall)).write(tmp_path / "a.npz")).scan.wall
    np.testing.assert_array_equal(back["to_world"][:3, 3], [0, 0, 0.5])
    assert back["tuple"] == (1, 2)
    with pytest.raises(StorageError, match=r"wall\.bsdf\.reflectance"):
        made(replace(SCAN, wall={"bsdf": {"reflectance": object()}})).write(tmp_path / "b.h5")
    assert not (tmp_path / "b.h5").exists()


def test_others_can_read_it_without_the_library(tmp_path):
    capture, out = made(SCAN), output(SEED)
    with h5py.File(tt.nlos.write_capture(tmp_path / "a.h5", capture, {"by": "me"})) as file:
        np.testing.assert_array_equal(file["transient"][:], capture.transient.numpy())
        np.testing.assert_array_equal(file["laser_legs"][:], capture.scan.laser_legs.numpy())
        assert file.attrs["kind"] == "confocal" and file.attrs["first_and_last_leg"] == 1
        assert file.attrs["bin_width_opl"] == 0.003 and json.loads(file.attrs["metadata"]) == {"by": "me"}
    with np.load(write_result(tmp_path / "a.npz", out)) as file:
        np.testing.assert_array_equal(file["steady"], out.steady.numpy())
        np.testing.assert_array_equal(file["edges_opl"], out.axis.edges_opl.numpy())
        assert file["num_bins"] == out.axis.num_bins and json.loads(str(file["metadata"]))["stats"]["spp"]


# ----------------------------------------------------------------------------------------------------- what is refused


@each_kind
def test_what_is_none_of_these(tmp_path, kind):
    (tmp_path / "folder.h5").mkdir()
    for name in ("a.exr", "a", "missing/a.h5", "folder.h5"):
        with pytest.raises(StorageError):
            KINDS[kind][0](tmp_path / name)
    assert os.listdir(tmp_path) == ["folder.h5"]


@each_kind
def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, kind):
    write, _ = KINDS[kind]
    path = write(tmp_path / "a.npz")
    before = path.read_bytes()

    def full(*_args, **_arrays):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(StorageError):
        write(path)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["a.npz"]


def test_hdf5_without_its_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(MissingPackageError, match=r"torchtransient\[data\]"):
        write_result(tmp_path / "a.h5", output(SEED))


@together("metadata", [{1: "a"}, {"a": {2.0: 1}}, {"a": [{None: 1}]}, {"a": {1, 2}}, {"a": object()}])
def test_metadata_are_plain_and_their_names_texts(tmp_path, metadata):
    """JSON would make texts of other names, two of the same one."""
    for call in (
        lambda: replace(made(SCAN), metadata=metadata), lambda: replace(volume(), metadata=metadata),
        lambda: tt.nlos.write_capture(tmp_path / "a.h5", made(SCAN), metadata),
        lambda: write_result(tmp_path / "a.npz", output(SEED), metadata),
    ):  # fmt: skip
        with pytest.raises(StorageError, match="metadata"):
            call()


def test_tensors_without_numbers_in_memory(tmp_path):
    with pytest.raises(ShapeError, match="dense"):
        replace(made(SCAN), transient=made(SCAN).transient.to_sparse())
    with pytest.raises(StorageError, match="to_dense"):
        tt.nlos.write_volume(tmp_path / "a.h5", replace(volume(), values=volume().values.to_sparse()))
    for capture in (made(SCAN).to("meta"), made(SCAN).to(torch.bfloat16)):
        for layout in ("torchtransient", "tal", "zaragoza", "dirac"):
            with pytest.raises(StorageError):
                capture.write(tmp_path / "a.h5", format=layout)
    assert list(tmp_path.iterdir()) == []


@together("changes, error", [
    ({"times": torch.zeros(3, 2)}, ShapeError),
    ({"times": torch.tensor([torch.nan])}, UnitError), ({"directions": torch.zeros(7, 3, 4, 5, 6)}, ShapeError),
    ({"values": torch.zeros(0, 1, 4, 5, 6)}, ShapeError),
    ({"values": torch.ones(1, 4, 5, 6) > 0}, ShapeError),
])  # fmt: skip
def test_what_is_no_volume(changes, error):
    with pytest.raises(error):
        replace(volume(), **changes)


# ------------------------------------------------------------------------------------------------- files that changed


def flipped(path: Path, place: int, bit: int) -> None:
    with path.open("r+b") as file:
        file.seek(place)
        (old,) = file.read(1)
        file.seek(place)
        file.write(bytes([old ^ 1 << bit]))


@each_kind
def test_a_bit_of_each_array_and_text(tmp_path, kind):
    write, read = KINDS[kind]
    path = write(tmp_path / "a.h5")
    with h5py.File(path) as file:
        places = {name: data.id.get_offset() + data.nbytes // 2 for name, data in file.items()}
        text = file.attrs["metadata"].encode()
        arrays = json.loads(file.attrs["checksums"])["arrays"]
    assert path.read_bytes().count(text) == 1
    places["metadata"] = path.read_bytes().index(text) + text.index(b'"') + 1
    for name in [*arrays, "metadata"]:
        changed = shutil.copyfile(path, tmp_path / "b.h5")
        flipped(changed, places[name], 0 if name == "metadata" else 7)
        if name in ("sensor_legs", "laser_legs"):
            read(changed)  # which are for others, and not read
            continue
        with pytest.raises(StorageError, match=f"'{name}' is not what was written"):
            read(changed)


@each_kind
def test_members_of_an_archive(tmp_path, kind):
    """With checksums of the archive's own that are right, as of a program that has written it anew."""
    write, read = KINDS[kind]
    path = write(tmp_path / "a.npz")
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    changed = arrays[MEASURED[kind]].copy()
    changed.flat[5] += 1
    for name, value in {MEASURED[kind]: changed, "metadata": np.array('{"a": 2}')}.items():
        np.savez(tmp_path / "b.npz", **arrays | {name: value})
        with pytest.raises(StorageError, match=f"'{name}' is not what was written"):
            read(tmp_path / "b.npz")
    np.savez(tmp_path / "b.npz", **{name: value for name, value in arrays.items() if name != "metadata"})
    with pytest.raises(StorageError, match="metadata"):
        read(tmp_path / "b.npz")
    with zipfile.ZipFile(path, "a") as file, pytest.warns(UserWarning, match="Duplicate"):
        file.writestr(f"{MEASURED[kind]}.npy", as_npy(changed))
    with pytest.raises(StorageError, match="stands twice"):
        read(path)
    if kind == "capture":  # what was put there later
        with h5py.File(write(tmp_path / "a.h5"), "r+") as file:
            file["steady"] = np.zeros((1, 3, 4), np.float32)
        with pytest.raises(StorageError, match="'steady'"):
            read(tmp_path / "a.h5")


@pytest.mark.parametrize("kind, ending", list(zip(KINDS, ("h5", "npz", "h5"), strict=False)))
def test_files_of_the_first_version(tmp_path, recwarn, kind, ending):
    """They have no checksums, and are read without a word; those of the second one do not lose them."""
    write, read = KINDS[kind]
    path = write(tmp_path / f"a.{ending}")
    expected = read(path)
    assert read(as_first_version(path)) == expected and not recwarn.list
    path = write(tmp_path / "a.h5")
    wrong_arrays = '{"entries": {}, "arrays": {"a": ["x", "y"]}}'
    for text in (None, "", "[]", "{", '{"entries": 1, "arrays": {}}', wrong_arrays, "1" * 9999, "[" * 9999):
        with h5py.File(path, "r+") as file:
            del file.attrs["checksums"]
            if text is not None:
                file.attrs["checksums"] = text
        with pytest.raises(StorageError, match="checksums"):
            read(path)
        with h5py.File(path, "r+") as file:
            file.attrs["checksums"] = ""


@pytest.mark.parametrize("ending", ["h5", "npz"])
@each_kind
def test_files_that_are_none(tmp_path, kind, ending):
    write, read = KINDS[kind]
    path = tmp_path / f"a.{ending}"
    with pytest.raises(StorageError):
        read(path)
    whole = write(path).read_bytes()
    for cut in (b"something else", whole[:700], whole[: len(whole) // 2]):
        path.write_bytes(cut)
        with pytest.raises(StorageError):
            read(path)
    other = KINDS["capture" if kind == "result" else "result"][0](tmp_path / f"b.{ending}")
    with pytest.raises(StorageError, match="of format"):
        read(other)
    np.savez(tmp_path / "c.npz", format=np.array(f"torchtransient {kind} 99"))
    with pytest.raises(StorageError, match=f"{kind} 99"):
        read(tmp_path / "c.npz")
    np.savez(tmp_path / "c.npz", **{MEASURED[kind]: np.array([{"a": 1}], object)}, format=f"torchtransient {kind} 1")
    with pytest.raises(StorageError, match="pickle"):
        read(tmp_path / "c.npz")


@each_kind
def test_what_others_put_beside_is_left_alone(tmp_path, kind):
    write, read = KINDS[kind]
    expected = read(write(tmp_path / "a.h5"))
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file.create_group("theirs")["x"] = 1.0
        file["linked"] = h5py.ExternalLink("/etc/passwd", "x")
        file.attrs["notes"] = ["a", "b"]
    assert read(tmp_path / "a.h5") == expected
    entries = members(write(tmp_path / "a.npz")) | {"theirs.npy": b"no array", "README": b"a text"}
    assert read(packed(tmp_path / "b.npz", entries)) == expected


@each_kind
def test_archives_of_other_programs(tmp_path, kind):
    write, read = KINDS[kind]
    entries = members(write(tmp_path / "a.npz"))
    expected = read(tmp_path / "a.npz")
    turned = {}
    for entry, data in entries.items():
        array = np.load(io.BytesIO(data))
        turned[entry] = as_npy(array.astype(array.dtype.newbyteorder(">")))
    for other, method in ((entries, zipfile.ZIP_DEFLATED), (turned, zipfile.ZIP_STORED)):
        assert read(packed(tmp_path / "b.npz", other, method)) == expected
    for method in (zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2):
        with pytest.raises(StorageError, match=r"np\.savez"):
            read(packed(tmp_path / "c.npz", entries, method))
    # An array that declares what nothing stores.
    big = f"{MEASURED[kind]}.npy"
    shape = b"'shape': (" + str(np.load(io.BytesIO(entries[big])).shape[0]).encode()
    changed = entries[big].replace(shape, b"'shape': (9000000000", 1)
    with pytest.raises(StorageError):
        read(packed(tmp_path / "d.npz", entries | {big: changed}))


@pytest.mark.parametrize("ending", ["h5", "npz"])
@each_kind
def test_the_memory_that_is_left(tmp_path, monkeypatch, ending, kind):
    write, read = KINDS[kind]
    path = write(tmp_path / f"a.{ending}")
    monkeypatch.setattr(hdf5, "_LARGE_BYTES", 100)
    monkeypatch.setattr(hdf5, "available_memory", lambda *_: 300)
    with pytest.raises(StorageError, match="of memory are left"):
        read(path)


@each_kind
def test_bytes_from_elsewhere(tmp_path, kind):
    write, read = KINDS[kind]
    path = as_first_version(write(tmp_path / "a.h5"))
    for number in range(WAYS):
        with h5py.File(path, "r+") as file:
            del file[MEASURED[kind]]
            lead_elsewhere(file, MEASURED[kind], number)
        with pytest.raises(StorageError):
            read(path)


WRONG = {
    "result": {
        "transient": (np.zeros((3, 40, 32, 32), "i8") > 0, np.zeros((3, 40, 32, 32), "c8"), np.zeros((3, 40, 32), "f4"),
                      np.zeros((3, 39, 32, 32), "f4"), "text"),
        "steady": (np.zeros((3, 32, 31), "f4"), np.zeros((4, 32, 32), "f4"), None),
        "channels": ('["a", "b"]', "[1, 2, 3]", 3), "metadata": ("[1]", "{", 3, "[" * 9000),
        "num_bins": (40.5, -40, "40", 2**62), "bin_width_opl": (np.nan, 0.0), "start_opl": (1e300,),
        "format": ("torchtransient result 3", np.zeros(0), None),
    },
    "capture": {
        "first_and_last_leg": ("False", np.nan, 2, [0, 1]), "polarized": ("True", -1),
        "num_bins": (7.5, "7", [7, 7], 3), "start_opl": ("0.5", np.inf, 1j), "channels": ('"a"', "[1]", "{}", 5),
        "metadata": ("[1]", "5", 5), "kind": (3,),
    },
    "volume": {"metadata": ("[1]", 5), "method": (5,)},
}  # fmt: skip


@together("kind, entry", [(kind, entry) for kind in WRONG for entry in WRONG[kind]])
def test_entries_that_do_not_fit(tmp_path, kind, entry):
    """One short line, in files without checksums too."""
    write, read = KINDS[kind]
    entries = members(as_first_version(write(tmp_path / "a.npz")))
    for value in WRONG[kind][entry]:
        others = {name: data for name, data in entries.items() if name != f"{entry}.npy"}
        others |= {} if value is None else {f"{entry}.npy": as_npy(np.array(value))}
        with pytest.raises(StorageError) as found:
            read(packed(tmp_path / "b.npz", others))
        assert len(str(found.value)) < 400 + len(str(tmp_path)) and "\n" not in str(found.value)
