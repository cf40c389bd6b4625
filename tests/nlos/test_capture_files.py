"""What was simulated comes back from the files of this and of other programs."""

from __future__ import annotations

import pytest
import torch

import torchtransient as tt
from support.marks import long
from torchtransient.nlos import Capture, Scan, Wall

VARIANT = "llvm_ad_mono"


@pytest.mark.parametrize("kind", long(["single", "confocal", "exhaustive"], ["exhaustive"]))
def test_simulated_captures(tmp_path, kind):
    scan = Scan.grid(Wall.plane(1.0, 1.0), (3, 2), kind=kind, first_and_last_leg=True)
    axis = tt.TimeAxis(1.0, 0.05, 60)
    capture = tt.nlos.simulate(tt.scenes.nlos_letter("L", depth=0.8), scan, time_axis=axis, spp=4, seed=1)
    for layout in ("torchtransient", "tal"):
        back = Capture.read(capture.write(tmp_path / f"{layout}.h5", layout))
        assert back == capture and back.metadata == capture.metadata
    back = Capture.read(capture.write(tmp_path / "zaragoza.h5", "zaragoza"))
    assert torch.equal(back.transient, capture.transient)
    for name in ("sensor_points", "laser_points", "sensor_normals", "sensor_origin", "laser_origin", "legs"):
        assert torch.equal(getattr(back.scan, name), getattr(scan, name))
