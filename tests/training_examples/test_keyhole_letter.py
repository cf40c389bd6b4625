"""The training example finds a letter in a track: a made one always, the measured ones where their folder is named."""

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.examples import example, measured_data
from tools.point_captures import point_capture
from torchtransient.capture import Scan


def write_track(folder, letter, seed=0):
    """Files as published, of a letter made of points, with Poisson counts."""
    import h5py

    module = example("keyhole_letter")
    columns, rows = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 0.15, 5))
    x, z = columns.ravel(), rows.ravel()
    points = np.stack([0.5 - x, np.full_like(x, module.TRACK_Y), z], -1)
    scan = Scan.points(points, kind="confocal", sensor_origin=(0, 0, 2), laser_origin=(0, 0, 2))
    shape = torch.nn.functional.interpolate(module.alphabet()[letter][None, None], (20, 22), mode="area")[0, 0]
    plane = module.plane(40)[8:28, 9:31]
    lit = shape > 0.3

    axis = tt.TimeAxis.from_seconds(0.0, module.BIN_S, 1000)
    light = point_capture(
        scan, plane[lit], time_axis=axis, strength=shape[lit], falloff=module.FALLOFF, pulse_sigma_opl=0.01
    ).transient[0]
    rng = np.random.default_rng(seed)
    zero = 30
    counts = np.zeros((len(x), 1100))
    counts[:, zero : zero + 1000] = light.T.numpy() / float(light.max()) * 3000
    dark = np.full(1100, 20.0)
    bins = (np.arange(1100) + 0.5 - zero) * axis.bin_width_opl
    direct = np.round(60000 * np.exp(-(bins**2) / (2 * 0.01**2)))
    with h5py.File(folder / "scan_made.mat", "w") as file:
        file["data"] = rng.poisson(counts + dark).astype(np.float64)
        file["xpos"], file["zpos"] = x[:, None], z[:, None]
    for name, values in (("LongExpNoObject_after", rng.poisson(dark)), ("direct_after", direct)):
        with h5py.File(folder / f"{name}.mat", "w") as file:
            file[name] = values.astype(np.uint32)[:, None]


def test_a_made_letter_is_found(tmp_path):
    write_track(tmp_path, "E")
    found = example("keyhole_letter").main([str(tmp_path), "--smoke", "--output", str(tmp_path)])
    assert found["positions"] == 45
    assert found["picture"].shape == (24, 24)
    assert next(iter(found["scores"])) == "E"
    assert found["scores"]["E"] > 0.7
    assert (tmp_path / "keyhole_letter.png").read_bytes().startswith(b"\x89PNG")


def test_a_folder_without_files_is_said(tmp_path):
    with pytest.raises(SystemExit, match="Give the folder of one letter"):
        example("keyhole_letter").read_track(tmp_path)


@pytest.mark.measured
@pytest.mark.parametrize("letter", ["E", "K"])
def test_measured_letters_are_found(tmp_path, letter):
    found = example("keyhole_letter").main([str(measured_data() / "keyhole" / letter), "--output", str(tmp_path)])
    (first, value), (_, second) = list(found["scores"].items())[:2]
    assert first == letter
    assert value >= 0.6
    assert value - second >= 0.1
