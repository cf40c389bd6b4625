"""First mistakes of a user: arguments by another name, times for lengths, files of another kind, no tensors."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch

import torchtransient as tt
from torchtransient.errors import (
    StorageError,
    UnitError,
)  # fmt: skip
from torchtransient.files import read_result, write_result

AXIS = tt.TimeAxis(0.0, 0.05, 40)
LIGHT = torch.rand(1, 40, 4, 4, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def scene():
    return tt.load(tt.scenes.cornell_box(resolution=4, num_bins=20), variant="llvm_ad_rgb")


@pytest.fixture(scope="module")
def capture():
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(1.0, 1.0), 4, kind="confocal")
    return tt.nlos.Capture(LIGHT.clone(), AXIS, scan)


def test_functions_that_hand_arguments_on_say_what_was_called(scene, capture):
    with pytest.raises(TypeError, match=r"^fk\(\) .*'targe'\. Did you mean 'target'\?"):
        tt.nlos.fk(capture, targe="diffuse")
    with pytest.raises(TypeError, match=r"^render\(\) .*Did you mean 'temporal_filter'\?"):
        tt.render(scene, spp=1, temporal_filte="box")


@pytest.mark.parametrize("width", [1e-10, torch.tensor(1e-10)], ids=["number", "tensor"])
def test_widths_of_bins_in_seconds(width):
    with pytest.raises(UnitError, match=r"bin_width_opl in metres of optical path, .* Seconds\?"):
        tt.losses.wasserstein_loss(LIGHT, LIGHT, bin_width_opl=width)


def test_files_of_another_kind_say_what_reads_them(scene, capture, tmp_path):
    write_result(tmp_path / "render.npz", tt.render(scene, spp=1, physics="ignore"))
    capture.write(tmp_path / "capture.npz")
    with pytest.raises(StorageError, match=r"capture 2', not .*result 2'\. tt.nlos.Capture.read reads it"):
        read_result(tmp_path / "capture.npz")
    for read in (tt.nlos.Capture.read, tt.nlos.read_volume):
        with pytest.raises(StorageError, match=r"result 2', not .*\. torchtransient\.\S+\.read_result reads it"):
            read(tmp_path / "render.npz")


@pytest.mark.parametrize(("format", "name"), [("tal", "wall.hdf5"), ("rect_data", "wall.mat")])
def test_captures_of_other_programs_lead_to_their_reader(capture, tmp_path, format, name):
    place = capture.write(tmp_path / name, format=format)
    for look in (read_result, tt.vis.peak_time_picture, tt.vis.frame_grid, tt.vis.view):
        with pytest.raises(StorageError, match=r"another program tt\.nlos\.Capture\.read\(path\)\.write"):
            look(place)
    assert tt.nlos.Capture.read(place).scan.kind == capture.scan.kind


def test_bounds_of_numbers_are_those_of_tensors():
    sensing, hundred = tt.sensing, torch.tensor(100.0)
    assert sensing.range_deviation_m(300e-12, 100) == sensing.range_deviation_m(300e-12, hundred)
    assert sensing.phase_noise_rad(100.0, 200.0, 4) == sensing.phase_noise_rad(hundred, 2 * hundred, 4)


def test_a_function_of_torch_in_wrap_is_told_of_arrays():
    for function in (torch.sin, lambda x: x.mean()):
        with pytest.raises((TypeError, AttributeError)) as told:
            tt.wrap(function)(torch.ones(3))
        assert any("arrays of Dr.Jit" in note and "dr.sin(x)" in note for note in told.value.__notes__)

    def wrong(x):
        return x + len(3)

    with pytest.raises(TypeError) as told:
        tt.wrap(wrong)(torch.ones(3))
    assert not hasattr(told.value, "__notes__")


def test_a_record_that_is_taken_for_a_tensor(scene, capture):
    out = tt.render(scene, spp=1, physics="ignore")
    for wrong in (lambda: torch.nn.functional.mse_loss(out, out), lambda: out.numpy(), lambda: out.backward()):
        with pytest.raises(AttributeError, match=r"it is no tensor, it holds some \(transient, steady"):
            wrong()
    with pytest.raises(AttributeError, match=r"'Capture' .* 'mean': it is no tensor, it holds some \(transient"):
        capture.mean()
    with pytest.raises(AttributeError, match=r"^'RenderOutput' object has no attribute 'transients'$") as told:
        out.transients  # noqa: B018
    assert told.value.name == "transients" and told.value.obj is out  # of which Python makes its suggestion
    assert copy.deepcopy(out) == out and pickle.loads(pickle.dumps(out)) == out
