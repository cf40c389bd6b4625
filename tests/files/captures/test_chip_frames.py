"""Frames of consumer time-of-flight chips: JSON of an ams TMF8828, `.npz` of an ST VL53L8."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.capture_files import chip_frames, zone_frame
from support.sweeps import together
from torchtransient.errors import StorageError
from torchtransient.units import SPEED_OF_LIGHT

F64 = torch.float64


def written(path, data):
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


def frame(**changes):
    (found,) = chip_frames(1)
    return {name: value for name, value in (found | changes).items() if value is not None}


def test_a_frame_of_several(tmp_path):
    path = written(tmp_path / "a.json", chip_frames(3))
    with pytest.raises(StorageError, match=r"holds 3 frames\. Give frame= to read_capture, 0 to 2"):
        tt.nlos.Capture.read(path)
    for wrong in (3, 0.5):
        with pytest.raises(StorageError, match="from 0 to 2"):
            tt.nlos.Capture.read(path, frame=wrong)
    capture = tt.nlos.Capture.read(path, frame=1)
    hists = torch.tensor(chip_frames(3)[1]["hists"])
    assert torch.equal(capture.transient, hists.T.reshape(1, 12, 3, 3))
    assert capture.metadata["format"] == "tmf8828" and capture.metadata["frame"] == 1
    assert capture.metadata["reference_hist"] == chip_frames(3)[1]["reference_hist"]
    assert capture.metadata["not_read"] == ["joint_angles"]
    # Times as texts, of the frame that was chosen.
    dated = [one | {"time_captured": f"2025-07-0{day}"} for day, one in enumerate(chip_frames(3))]
    assert tt.nlos.Capture.read(written(path, dated), frame=2).metadata["time_captured"] == "2025-07-02"


def test_a_mark_of_the_encoding(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(frame()), encoding="utf-8-sig")
    assert tt.nlos.Capture.read(tmp_path / "a.json").metadata["format"] == "tmf8828"
    written(tmp_path / "a.json", " \n" * 100 + json.dumps(frame()))
    assert tt.nlos.Capture.read(tmp_path / "a.json").metadata["format"] == "tmf8828"


def test_files_that_are_of_no_known_kind(tmp_path):
    """Cut ones, too."""
    np.savez(tmp_path / "whole.npz", **zone_frame())
    for name, data in (("a.npz", (tmp_path / "whole.npz").read_bytes()[:-100]), ("a.json", b" " * 300), ("a", b"")):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(StorageError, match="is no JSON, NumPy, MATLAB or HDF5 file"):
            tt.nlos.Capture.read(tmp_path / name)


def test_zones_meet_the_plane_before_the_chip(tmp_path):
    capture = tt.nlos.Capture.read(written(tmp_path / "a.json", frame()))
    scan = capture.scan
    assert (scan.kind, scan.shape, scan.first_and_last_leg) == ("confocal", (3, 3), True)
    # The chip looks down from 0.3 m, at a plane 0.25 m below.
    torch.testing.assert_close(scan.sensor_points[1, 1], torch.tensor([0.1, 0.2, 0.05], dtype=F64))
    torch.testing.assert_close(scan.sensor_points[..., 2], torch.full((3, 3), 0.05, dtype=F64))
    torch.testing.assert_close(scan.sensor_normals, torch.tensor([0.0, 0.0, 1.0], dtype=F64).expand(3, 3, 3))
    torch.testing.assert_close(scan.sensor_origin, torch.tensor([0.1, 0.2, 0.3], dtype=F64))
    # Zones divide a field of two tangents evenly: thirds of it apart.
    away, across = capture.metadata["assumed"]["half_field_tangents"]
    steps = (scan.sensor_points.diff(dim=0).norm(dim=-1), scan.sensor_points.diff(dim=1).norm(dim=-1))
    for step, half in zip(steps, (away, across), strict=True):
        torch.testing.assert_close(step, torch.full_like(step, 0.25 * 2 * half / 3))


def test_walls_that_the_chip_has_measured_zone_by_zone(tmp_path):
    capture = tt.nlos.Capture.read(written(tmp_path / "a.json", frame(dist_to_plane=None, pose=None)))
    assert capture.scan.sensor_normals is None and capture.metadata["assumed"]["pose"] == np.eye(4).tolist()
    expected = 1e-3 * torch.arange(240, 249, dtype=F64).reshape(3, 3)
    torch.testing.assert_close(capture.scan.sensor_points[..., 2], expected)


def test_bins_and_their_zero(tmp_path):
    path = written(tmp_path / "a.json", frame())
    axis = tt.nlos.Capture.read(path).axis
    assert axis.bin_width_opl == pytest.approx(93e-12 * SPEED_OF_LIGHT) and axis.num_bins == 12
    assert axis.start_opl == pytest.approx(-13.56 * axis.bin_width_opl)
    said = tt.nlos.Capture.read(path, bin_width_s=88e-12, start_s=-13 * 88e-12).axis
    assert said.start_opl == pytest.approx(-13 * said.bin_width_opl)
    assert tt.nlos.Capture.read(path, bin_width_s=88e-12).axis.start_opl == pytest.approx(-13.56 * said.bin_width_opl)


@together("zones, shape", [(16, (4, 4)), (18, (3, 6)), (5, (5,))])
def test_numbers_of_zones(tmp_path, zones, shape):
    capture = tt.nlos.Capture.read(written(tmp_path / "a.json", chip_frames(1, zones)))
    assert capture.scan.shape == shape and capture.scan.sensor_points.unique(dim=0).numel() == 3 * zones


@together("data", [
    frame(dist_to_plane=None, distances=None), frame(dist_to_plane=0.0), frame(dist_to_plane=float("nan")),
    frame(dist_to_plane=None, distances=[{"depths_1": [240] * 4}]), frame(hists=[[1, 2], [3]]),
    frame(hists=[1, 2, 3]), frame(hists=[[10**400]]), frame(pose=np.diag([1, 1, -1, 1]).tolist()),
    frame(pose=[[1, 0], [0, 1]]), {"a": 1}, [1, 2], "[]",
    json.dumps(frame())[:-20], "[" * 100_000, '{"hists": ' + "9" * 10_000 + "}",
], lambda data: str(data)[:40])  # fmt: skip
def test_wrong_json(tmp_path, data):
    with pytest.raises(StorageError):
        tt.nlos.Capture.read(written(tmp_path / "a.json", data))


def test_a_frame_of_zones(tmp_path):
    arrays = zone_frame()
    np.savez(tmp_path / "a.npz", **arrays, particles=np.zeros((3, 3)))
    capture = tt.nlos.Capture.read(tmp_path / "a.npz")
    assert (capture.scan.kind, capture.scan.shape, capture.scan.first_and_last_leg) == ("confocal", (4, 4), False)
    assert torch.equal(capture.transient[0].flatten(1).T, torch.from_numpy(arrays["hists"]))
    assert torch.equal(capture.scan.sensor_points.reshape(16, 3), torch.from_numpy(arrays["pt_cloud"]))
    assert capture.scan.sensor_origin.tolist() == [0.0, 0.0, 0.5] == capture.scan.laser_origin.tolist()
    assert capture.axis.bin_width_opl == pytest.approx(250e-12 * SPEED_OF_LIGHT) and capture.axis.start_opl == 0
    assert capture.metadata["not_read"] == ["particles"]
    # No regular grid: what takes points of measured walls is named, and takes them.
    assert tt.nlos.choose_method(capture).name == "fbp"
    with pytest.raises(tt.errors.ArgumentError, match="Take bp or fbp"):
        tt.nlos.reconstruct(capture, "fk")
    grid = tt.nlos.default_grid(capture, depths=(0.1, 0.3), size=4, planes=2)
    assert tt.nlos.reconstruct(capture, "bp", grid=grid, progress=False).values.shape == (1, 2, 4, 4)
    del arrays["cam_z"]
    np.savez(tmp_path / "b.npz", **arrays)
    assert "sensor_origin" in tt.nlos.Capture.read(tmp_path / "b.npz").metadata["assumed"]
    assert tt.nlos.Capture.read(tmp_path / "b.npz", sensor_origin=(0, 0, 1)).scan.sensor_origin.tolist() == [0, 0, 1]


def test_wrong_zones(tmp_path):
    for changes in (
        {"pt_cloud": np.zeros((4, 3))}, {"hists": np.zeros(16)}, {"cam_z": np.zeros(3)},
        {"hists": np.full((16, 8), "a")}, {"pt_cloud": np.full((16, 3), np.nan)}, {"hists": np.zeros((16, 8), object)},
    ):  # fmt: skip
        np.savez(tmp_path / "a.npz", **(zone_frame() | changes))
        with pytest.raises(StorageError):
            tt.nlos.Capture.read(tmp_path / "a.npz")
