"""Results on disk come back as they were; what cannot be written or read is said."""

from __future__ import annotations

import builtins
import json
import os

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.sealed_files import as_first_version
from torchtransient.array_files import array_file
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.errors import ArgumentError, MissingPackageError, StorageError
from torchtransient.files.result_file import check_target, read_result, write_result
from torchtransient.rendering.output import RenderOutput, RenderStats

AXIS = TimeAxis(3.5, 0.02, 5)
STATS = RenderStats(
    spp=16,
    seconds=0.5,
    samples_per_second=1e4,
    variant="llvm_ad_rgb",
    integrator="transient_path",
    temporal_filter="box",
    seeds=(0,),
    energy_before=(0.0,),
    energy_after=(0.25,),
    energy_total=(1.0,),
)
ENDINGS = ("h5", "hdf5", "npz")


def output(leading=()):
    generator = torch.Generator().manual_seed(0)
    film = torch.rand(*leading, 4, 6, 5, 3, generator=generator)  # the film's order: H, W, T, C
    transient = film.movedim((-1, -2), (-4, -3))
    return RenderOutput(transient, transient.sum(-3), None, axis=AXIS, stats=STATS)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("leading", [(), (2, 3)])
def test_round_trip(tmp_path, ending, leading):
    made = output(leading)
    path = write_result(tmp_path / f"a.{ending}", made, {"scene": "box.xml"})
    back = read_result(path)
    assert torch.equal(back.transient, made.transient)
    assert torch.equal(back.steady, made.steady)
    assert back.axis == AXIS
    assert back.metadata["scene"] == "box.xml"
    assert back.metadata["stats"]["energy_after"] == [0.25]


def phasors(leading=()):
    generator = torch.Generator().manual_seed(1)
    film = torch.rand(*leading, 4, 6, 3, 2, 2, generator=generator)  # the film's order: H, W, F, C, parts
    phasor = torch.view_as_complex(film).movedim((-1, -2), (-4, -3))
    return RenderOutput(
        None,
        phasor[..., 0, :, :].real,
        phasor,
        axis=None,
        stats=STATS,
        frequencies=FrequencyAxis((0.0, 0.5, -2.0), 1.5),
    )


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("leading", [(), (2,)])
def test_round_trip_of_phasors(tmp_path, monkeypatch, ending, leading):
    monkeypatch.setattr(array_file, "_PART_BYTES", 100)
    made = phasors(leading)
    back = read_result(write_result(tmp_path / f"a.{ending}", made, {"scene": "box.xml"}))
    assert back.phasor.dtype == torch.complex64 and torch.equal(back.phasor, made.phasor)
    assert torch.equal(back.steady, made.steady)
    assert back.frequencies == made.frequencies and back.transient is None and back.axis is None


def test_a_phasor_file_that_does_not_fit_together(tmp_path):
    made = phasors()
    path = write_result(tmp_path / "a.npz", made)
    with np.load(path) as file:
        changed = {name: file[name] for name in file.files} | {"frequencies_per_metre": np.array([1.0])}
    np.savez(path, **changed)
    with pytest.raises(StorageError, match="'frequencies_per_metre' is not what was written"):
        read_result(path)
    as_first_version(path)
    with pytest.raises(StorageError, match="F = 1"):
        read_result(path)


def test_a_cube_written_in_many_parts(tmp_path, monkeypatch):
    monkeypatch.setattr(array_file, "_PART_BYTES", 100)
    made = output((2,))
    assert torch.equal(read_result(write_result(tmp_path / "a.h5", made)).transient, made.transient)


def test_others_can_read_it_without_the_library(tmp_path):
    import h5py

    made = output()
    with h5py.File(write_result(tmp_path / "a.h5", made)) as file:
        np.testing.assert_array_equal(file["transient"][:], made.transient.numpy())
        np.testing.assert_array_equal(file["edges_opl"][:], AXIS.edges_opl.numpy())
        assert file.attrs["start_opl"] == 3.5
        assert json.loads(file.attrs["metadata"])["stats"]["spp"] == 16
    with np.load(write_result(tmp_path / "a.npz", made)) as file:
        np.testing.assert_array_equal(file["steady"], made.steady.numpy())
        assert file["num_bins"] == 5


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = write_result(tmp_path / "a.npz", output())
    before = path.read_bytes()

    def full(*_args, **_arrays):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(StorageError, match="No space left"):
        write_result(path, output((2,)))
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.npz"]


@pytest.mark.parametrize("name", ["a.exr", "a", "missing/a.h5"])
def test_places_that_cannot_be_written(tmp_path, name):
    with pytest.raises(StorageError, match=r"ends in|does not exist"):
        check_target(tmp_path / name)


def test_a_folder_in_the_way(tmp_path):
    (tmp_path / "a.h5").mkdir()
    with pytest.raises(StorageError, match="is a folder"):
        write_result(tmp_path / "a.h5", output())


def test_metadata_that_is_not_plain(tmp_path):
    with pytest.raises(StorageError, match="plain data"):
        write_result(tmp_path / "a.npz", output(), {"scene": object()})


@pytest.mark.parametrize("ending", ENDINGS)
def test_files_that_are_no_results(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    with pytest.raises(StorageError, match="does not exist"):
        read_result(path)
    path.write_bytes(b"something else")
    with pytest.raises(StorageError, match="not a result"):
        read_result(path)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_truncated_result(tmp_path, ending):
    path = write_result(tmp_path / f"a.{ending}", output())
    path.write_bytes(path.read_bytes()[:700])
    with pytest.raises(StorageError, match="not a result"):
        read_result(path)


def test_pickles_inside_are_not_executed(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, transient=np.array([{"a": 1}], dtype=object), format=np.array("torchtransient result 1"))
    with pytest.raises(StorageError, match="No pickle is read"):
        read_result(path)


def test_another_format_version(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, format=np.array("torchtransient result 99"))
    with pytest.raises(StorageError, match="result 99"):
        read_result(path)


def test_hdf5_without_its_package(tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "h5py":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingPackageError, match=r"torchtransient\[data\]"):
        check_target(tmp_path / "a.h5")


def test_what_is_no_render_is_refused(tmp_path):
    with pytest.raises(ArgumentError, match=r"expected what a render returned, .*got Tensor.*torch\.save"):
        write_result(tmp_path / "out.npz", torch.zeros(3, 4, 2, 2))


def test_a_result_that_was_read_is_written_again(tmp_path):
    first = read_result(write_result(tmp_path / "a.npz", output(), {"name": "first"}))
    again = read_result(write_result(tmp_path / "b.npz", first))
    assert torch.equal(again.transient, first.transient) and again.axis == first.axis
    assert again.metadata == first.metadata and again.metadata["name"] == "first"


@pytest.mark.parametrize("ending", ["h5", "npz"])
@pytest.mark.parametrize("kind", ["rates", "beats"])
def test_rates_and_beats(tmp_path, kind, ending):
    axis = tt.TimeAxis(3.5, 0.5, 12)
    film = {
        "rates": {"rates": tt.RateAxis(-10.0, 4.0, 5)},
        "beats": {"chirps": tt.Chirps(bandwidth_hz=1e9, duration_s=1e-5, wavelength_m=1.55e-6)},
    }[kind]
    scene = tt.load(tt.scenes.cornell_box(resolution=4, num_bins=12, start_opl=3.5, bin_width_opl=0.5))
    out = tt.TransientRenderer(scene, spp=4, time_axis=axis, **film)(seed=0)
    read = read_result(write_result(tmp_path / f"moving.{ending}", out))
    torch.testing.assert_close(getattr(read, kind), getattr(out, kind).detach(), rtol=0, atol=0)
    assert (read.axis, read.rate_axis, read.chirps) == (out.axis, out.rate_axis, out.chirps)
