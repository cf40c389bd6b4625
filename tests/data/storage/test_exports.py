"""Exports: WebDataset tars that its package and our decoder read, captures that y-tal's layout holds."""

from __future__ import annotations

import io
import json
import sys
import tarfile
from dataclasses import replace

import numpy as np
import pytest
import torch
import zstandard

import torchtransient as tt
from support.capture_files import grids, made
from support.stored_samples import AXIS, cube, folder, header, sample, write
from torchtransient.data import TransientDataset, export_tal, export_web_dataset, read_web_dataset
from torchtransient.data.exports import decode_web_sample
from torchtransient.errors import ArgumentError, MissingPackageError, StorageError
from torchtransient.files.plain_data import scan_data
from torchtransient.tensor_record import same


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return folder(tmp_path_factory.mktemp("data") / "set")


def export(data, place, **options):
    place.mkdir(exist_ok=True)
    return export_web_dataset(data, place, progress=False, **options)


def test_our_decoder(data, tmp_path, monkeypatch):
    monkeypatch.setattr("torchtransient.data.exports._TAR_BYTES", 0.3e6)
    paths = export(data, tmp_path / "a")
    assert len(paths) > 2 and [path.name for path in paths][:2] == ["samples-000000.tar", "samples-000001.tar"]
    found = [item for path in paths for item in read_web_dataset(path)]
    assert [item["index"] for item in found] == list(range(10))
    source = TransientDataset(data)
    for i, item in enumerate(found):
        assert same(dict(sorted(item.items())), dict(sorted(source[i].items())))
    about = json.loads((tmp_path / "a" / "about.json").read_text())
    assert about["axis"] == AXIS and about["about"]["spp"] == 16
    again = export(data, tmp_path / "b")
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in paths]


def test_the_package_webdataset(data, tmp_path):
    wds = pytest.importorskip("webdataset")
    paths = export(data, tmp_path, window=slice(0, 64))
    stream = wds.WebDataset([str(path) for path in paths], shardshuffle=False).map(decode_web_sample)
    found = list(torch.utils.data.DataLoader(stream, batch_size=5))
    assert [batch["index"].tolist() for batch in found] == [[0, 1, 2, 3, 4], [5, 6, 7, 8, 9]]
    assert np.array_equal(found[1]["transient"][2].numpy(), cube(7)[:, :64])
    assert found[0]["values"]["red.reflectance.value"].shape == (5, 3)


def test_counts(tmp_path):
    write(tmp_path / "shard-000000.h5", [sample(0, counts=True)], "counts")
    path = export(tmp_path, tmp_path / "out")[0]
    assert next(read_web_dataset(path, as_stored=True))["measurement"].dtype == torch.uint8
    found = next(read_web_dataset(path))["measurement"]
    assert found.dtype == torch.float32 and np.array_equal(found.numpy(), sample(0, counts=True).arrays["measurement"])


def test_what_cannot_be_exported(data, tmp_path, monkeypatch):
    with pytest.raises(StorageError, match="expected a folder"):
        export_web_dataset(data, tmp_path / "none")
    # Members of a sample end in their names.
    path = write(tmp_path / "a.h5", [replace(sample(0), arrays={"a.b": np.ones((2, 3))})])
    with pytest.raises(StorageError, match=r"expected 'a\.b' as a tensor, under a name without points"):
        export(path, tmp_path / "out")
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(MissingPackageError, match="zstandard"):
        export(data, tmp_path / "other")
    assert list((tmp_path / "other").iterdir()) == []


def tar_of(path, members):
    with tarfile.open(path, "w") as tar:
        for name, content in members.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))
    return path


def npy(array):
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def test_damaged_tars(tmp_path):
    whole = npy(np.zeros(3))
    unsized = zstandard.ZstdCompressor(write_content_size=False).compress(whole)
    for name, content in (
        ("0.transient.npy.zst", b"x" * 40),
        ("0.transient.npy.zst", b"\x28\xb5\x2f\xfd\xe0" + (2**60).to_bytes(8, "little") + b"\x00" * 40),
        ("0.depth.npy.zst", unsized), ("0.depth.npy", whole[:-1]), ("0.depth.npy", b"x"),
        ("0.depth.npy", whole.replace(b"(3,)", b"(9,)")), ("0.depth.npy", npy(np.array(["a"]))),
        ("0.depth.npy", whole.replace(b"NUMPY\x01\x00", b"NUMPY\x03\x00")),
        ("0.sample.json", b"{"),
        ("0.sample.json", b'{"index": 0, "values": {"a": 1}, "dtypes": {"a": "O"}}'),
        ("0.code.pickle", b"cos\nsystem\n(S'true'\ntR."),
    ):  # fmt: skip
        with pytest.raises(StorageError, match="WebDataset"):
            list(read_web_dataset(tar_of(tmp_path / "a.tar", {name: content})))


def test_what_is_no_tar(data, tmp_path):
    path = tmp_path / "a.tar"
    for content in (b"x" * 2000, export(data, tmp_path / "out")[0].read_bytes()[:100_000]):
        path.write_bytes(content)
        with pytest.raises(StorageError):
            list(read_web_dataset(path))
    with tarfile.open(path, "w") as tar:
        entry = tarfile.TarInfo("0.depth.npy")
        entry.type, entry.linkname = tarfile.SYMTYPE, "/etc/passwd"
        tar.addfile(entry)
    with pytest.raises(StorageError, match="no plain file"):
        list(read_web_dataset(path))


# ----------------------------------------------------------------------------------------------------------------- TAL


def captures(place, scan, capture, name="transient", **about):
    """A shard of a scan whose two samples are once and twice the capture."""
    axis = capture.axis
    entries = {"scan": json.loads(json.dumps(scan_data(scan))), "channels": [], **about}
    if axis is not None:
        entries["axis"] = {"start_opl": axis.start_opl, "bin_width_opl": axis.bin_width_opl, "num_bins": axis.num_bins}
    measured = getattr(capture, name)
    samples = []
    for i in range(2):
        one = sample(i)
        samples.append(replace(one, arrays={name: (measured * (i + 1)).numpy()}))
    return write(place / "shard-000000.h5", samples, about={**header()["about"], **entries})


@pytest.mark.parametrize("kind", ["single", "exhaustive"])
def test_captures_of_y_tal(tmp_path, kind):
    scan = grids()[kind]
    capture = made(scan)
    captures(tmp_path, scan, capture)
    (tmp_path / "out").mkdir()
    paths = export_tal(tmp_path, tmp_path / "out", progress=False)
    assert [path.name for path in paths] == ["capture-00000000.hdf5", "capture-00000001.hdf5"]
    for i, path in enumerate(paths):
        found = tt.nlos.read_capture(path)
        assert found == replace(capture, transient=capture.transient * (i + 1))
        assert found.metadata["values"]["box.filename"] == f"größe_{i}.ply" and found.metadata["index"] == i


def test_phasors(tmp_path):
    scan = grids()["confocal"]
    capture = made(scan, phasor=True)
    numbers = [float(number) for number in capture.frequencies.per_metre]
    frequencies = {"per_metre": numbers, "start_opl": capture.frequencies.start_opl}
    captures(tmp_path, scan, capture, "phasor", axis=None, frequencies=frequencies)
    (tmp_path / "out").mkdir()
    found = tt.nlos.read_capture(export_tal(tmp_path, tmp_path / "out", progress=False)[0])
    assert torch.equal(found.phasor, capture.phasor) and found.frequencies == capture.frequencies


@pytest.mark.slow
def test_each_capture_of_a_recipe_has_its_own_scan(tmp_path):
    """What its maker says about itself is what the export reads."""
    walls = [tt.nlos.Wall.plane(width=width, height=width) for width in (1.0, 2.0)]
    scans = [tt.nlos.Scan.grid(wall, (3, 2), kind="confocal") for wall in walls]
    recipe = tt.data.Recipe(
        tt.scenes.nlos_letter("K"), {"scan": tt.data.Choice(scans)}, scan=scans[0], spp=4, variant="llvm_ad_mono",
        frequencies=tt.FrequencyAxis((0.5, 1.5), start_opl=2.0),
    )  # fmt: skip
    maker = recipe.maker()
    about = json.loads(json.dumps(maker.about()))
    made = [maker.sample(i) for i in range(8)]
    write(tmp_path / "shard-000000.h5", made, about=about)
    (tmp_path / "out").mkdir()
    paths = export_tal(tmp_path, tmp_path / "out", progress=False)
    told = [int(one.values["scan"].removeprefix("#")) for one in made]
    assert set(told) == {0, 1}
    for path, number, one in zip(paths, told, made, strict=True):
        found = tt.nlos.read_capture(path)
        points, expected = (torch.as_tensor(scan.sensor_points) for scan in (found.scan, scans[number]))
        assert torch.allclose(points, expected) and found.frequencies == recipe.settings.frequencies
        assert np.array_equal(found.phasor, one.arrays["phasor"])
    write(tmp_path / "shard-000000.h5", [replace(made[0], values={"scan": "#2"})], about=about)
    with pytest.raises(StorageError, match="sample 0: expected the value 'scan' as one of #0 to #1, got '#2'"):
        export_tal(tmp_path, tmp_path / "out", progress=False)


def test_what_is_no_capture(data, tmp_path):
    with pytest.raises(StorageError, match="these have none"):
        export_tal(data, tmp_path)
    scan = grids()["confocal"]
    path = captures(tmp_path, scan, made(scan))
    with pytest.raises(ArgumentError, match="expected field"):
        export_tal(path, tmp_path, field="gated")
    with pytest.raises(StorageError, match="expected a folder"):
        export_tal(path, tmp_path / "none")
