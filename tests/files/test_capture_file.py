"""Captures on disk come back as they were, bit by bit; what cannot be written or read is said."""

from __future__ import annotations

import itertools
import json
import os
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.sealed_files import as_first_version
from torchtransient.array_files import array_file
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan, Wall
from torchtransient.errors import ArgumentError, StorageError
from torchtransient.files.capture_file import read_capture, write_capture

ENDINGS = ("h5", "hdf5", "npz")
AXIS = TimeAxis(1.1, 0.003, 7)
FREQUENCIES = FrequencyAxis((0.0, 0.1, -2.3), 0.7)


def scans():
    wall = Wall.plane(2.0, 1.6, center=(0.1, 0, 0), albedo=(0.1, 0.2, 0.3))
    curved = Wall.mesh([[-1, -1, 0], [1, -1, 0.1], [1, 1, 0], [-1, 1, 0.1]], [[0, 1, 2], [0, 2, 3]])
    origin = {"sensor_origin": [0.1, 0.2, 0.9], "laser_origin": [-0.3, 0, 1.1]}
    listed = [[0, 0, 0], [0.1, 0.3, 0.0], [0.2, -0.1, 0]]
    return {
        "single": Scan.grid(wall, (4, 3), kind="single", laser=(0.3, 0.4)),
        "confocal": Scan.grid(wall, (4, 3), kind="confocal", first_and_last_leg=True),
        "exhaustive": Scan.grid(wall, (4, 3), kind="exhaustive", laser_grid=(2, 1)),
        "curved": Scan.grid(curved, (4, 3), kind="confocal"),
        "list": Scan.points(listed, kind="confocal", **origin),
        "all pairs of a list": Scan.points(listed, kind="exhaustive", laser_points=listed[:2], **origin, wall=wall),
    }


def made(scan, leading=(), channels=2, polarized=False, what=("transient", "steady")):
    generator = torch.Generator().manual_seed(0)
    front = (*leading, *((4,) if polarized else ()), channels)
    transient = torch.rand(*scan.shape, *front, AXIS.num_bins, generator=generator)
    dims = len(scan.shape)
    transient = transient.permute(*range(dims, transient.ndim), *range(dims))  # as films are: points first in memory
    phasor = torch.randn(*front, 3, *scan.shape, generator=generator, dtype=torch.complex64).conj()
    tensors = {"transient": transient, "phasor": phasor, "steady": torch.rand(*front, *scan.shape, generator=generator)}
    tensors = {name: tensors[name] for name in what}
    return Capture(
        **({"transient": None} | tensors), axis=AXIS if "transient" in what else None, scan=scan,
        frequencies=FREQUENCIES if "phasor" in what else None, channels=("a", "b")[:channels], polarized=polarized,
        metadata={"spp": 3, "nested": {"numbers": [0.1, 2]}},
    )  # fmt: skip


def same_bits(a, b):
    assert a.tensors().keys() == b.tensors().keys()
    for name, tensor in a.tensors().items():
        other = b.tensors()[name]
        assert tensor.dtype == other.dtype and tensor.shape == other.shape
        assert tensor.resolve_conj().numpy().tobytes() == other.numpy().tobytes()
    assert (a.axis, a.frequencies, a.channels, a.polarized) == (b.axis, b.frequencies, b.channels, b.polarized)
    assert a.scan == b.scan and a.metadata == b.metadata


@pytest.mark.parametrize("kind, ending", list(zip(scans(), itertools.cycle(ENDINGS), strict=False)))
def test_round_trip(tmp_path, ending, kind):
    capture = made(scans()[kind])
    same_bits(capture, read_capture(write_capture(tmp_path / f"a.{ending}", capture)))


@pytest.mark.parametrize("ending", ["h5", "npz"])
@pytest.mark.parametrize(
    "settings",
    [{"what": ("phasor",)}, {"what": ("transient", "phasor", "steady")}, {"leading": (3,)},
     {"polarized": True, "channels": 1}],
)  # fmt: skip
def test_other_captures(tmp_path, monkeypatch, ending, settings):
    monkeypatch.setattr(array_file, "_PART_BYTES", 100)
    capture = made(scans()["exhaustive"], **settings)
    same_bits(capture, read_capture(write_capture(tmp_path / f"a.{ending}", capture)))


def test_numbers_that_are_none_and_of_other_kinds(tmp_path):
    capture = made(scans()["confocal"])
    values = capture.transient.double()
    values[0, 0, 0, :3] = torch.tensor([float("nan"), -0.0, float("inf")], dtype=torch.float64)
    for other in (values, values.half(), values.nan_to_num(0, 0, 0).to(torch.int32), values.clone().requires_grad_()):
        kept = replace(capture, transient=other, steady=None)
        same_bits(kept.detach(), read_capture(write_capture(tmp_path / "a.h5", kept)))
    with pytest.raises(StorageError, match="bfloat16"):
        write_capture(tmp_path / "b.h5", replace(capture, transient=values.bfloat16()))


def test_others_can_read_it_without_the_library(tmp_path):
    import h5py

    capture = made(scans()["confocal"])
    with h5py.File(write_capture(tmp_path / "a.h5", capture, {"by": "me"})) as file:
        np.testing.assert_array_equal(file["transient"][:], capture.transient.numpy())
        np.testing.assert_array_equal(file["sensor_points"][:], capture.scan.sensor_points.numpy())
        np.testing.assert_array_equal(file["laser_legs"][:], capture.scan.laser_legs.numpy())
        assert file.attrs["kind"] == "confocal" and file.attrs["first_and_last_leg"] == 1
        assert file.attrs["bin_width_opl"] == 0.003
        assert json.loads(file.attrs["metadata"]) == {"by": "me", **capture.metadata}
        assert json.loads(file.attrs["wall"])["bsdf"]["reflectance"]["value"] == [0.1, 0.2, 0.3]


def test_a_wall_that_is_mitsubas_transform(tmp_path):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    scan = scans()["list"]
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 0.5]), "tuple": (1, 2)}
    back = read_capture(write_capture(tmp_path / "a.npz", made(replace(scan, wall=wall)))).scan.wall
    np.testing.assert_array_equal(back["to_world"][:3, 3], [0, 0, 0.5])
    assert back["tuple"] == (1, 2)


def test_what_is_refused(tmp_path):
    capture = made(scans()["list"])
    wall = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": object()}}
    with pytest.raises(StorageError, match=r"wall\.bsdf\.reflectance is a object.*plain data"):
        write_capture(tmp_path / "a.h5", replace(capture, scan=replace(capture.scan, wall=wall)))
    with pytest.raises(ArgumentError, match=r"expected a tt\.nlos\.Capture, got Tensor"):
        write_capture(tmp_path / "a.h5", torch.zeros(3))
    with pytest.raises(StorageError, match="plain data"):
        write_capture(tmp_path / "a.h5", capture, {"scene": object()})
    for name in ("a.exr", "missing/a.h5"):
        with pytest.raises(StorageError, match=r"ends in|does not exist"):
            write_capture(tmp_path / name, capture)
    assert os.listdir(tmp_path) == []


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    capture = made(scans()["single"])
    path = write_capture(tmp_path / "a.npz", capture)
    before = path.read_bytes()

    def full(*_args, **_arrays):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(StorageError, match="No space left"):
        write_capture(path, capture)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["a.npz"]


@pytest.mark.parametrize("ending", ENDINGS)
def test_files_that_are_no_captures(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    with pytest.raises(StorageError, match="does not exist"):
        read_capture(path)
    whole = write_capture(path, made(scans()["single"])).read_bytes()
    for cut in (b"something else", whole[: len(whole) // 2]):
        path.write_bytes(cut)
        with pytest.raises(StorageError, match="not a capture of torchtransient, or is damaged"):
            read_capture(path)


def test_a_result_of_a_render_is_no_capture(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, format=np.array("torchtransient result 1"))
    with pytest.raises(StorageError, match=r"format 'torchtransient result 1'.*capture 2"):
        read_capture(path)


def test_parts_that_do_not_fit_together(tmp_path):
    path = write_capture(tmp_path / "a.npz", made(scans()["confocal"]))
    with np.load(path) as file:
        changed = {name: file[name] for name in file.files} | {"num_bins": np.array(3)}
    np.savez(path, **changed)
    with pytest.raises(StorageError, match=r"'num_bins' is not what was written"):
        read_capture(path)
    as_first_version(path)
    with pytest.raises(StorageError, match=r"damaged.*axis"):
        read_capture(path)
