"""Arguments that are numbers, in every room: those of NumPy, torch and `fractions` are taken, anything else is a typed
error of one sentence.
"""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from torchtransient.errors import TorchTransientError

LIGHT = torch.rand(1, 8, 4, 4, generator=torch.Generator().manual_seed(0))
WHOLE = {
    "TimeAxis": lambda n: tt.TimeAxis(1.0, 0.5, n),
    "Gate.sequence": lambda n: tt.Gate.rectangular(1.0, 2.0).sequence(0.5, n),
    "geometry.ray_directions": lambda n: tt.geometry.ray_directions(torch.eye(3), size=(n, 5)),
    "losses.armed_periods": lambda n: tt.losses.armed_periods(LIGHT, n, 2.0),
    "losses.SSIMLoss": lambda n: tt.losses.SSIMLoss(window=n)(LIGHT[:, 0], LIGHT[:, 1]),
    "nlos.Scan.grid": lambda n: tt.nlos.Scan.grid(tt.nlos.Wall.plane(2.0, 2.0), n, kind="confocal"),
    "scenes.cornell_box": lambda n: tt.scenes.cornell_box(resolution=n),
    "training.Batches": lambda n: tt.training.Batches(9, n),
}
REAL = {
    "TimeAxis": lambda x: tt.TimeAxis(x, 0.5, 3),
    "Pulse.gaussian": lambda x: tt.Pulse.gaussian(x),
    "Chirps.longer": lambda x: tt.Chirps(1e9, 1e-5, 1550e-9).longer(x),
    "geometry.distance_from_opl": lambda x: tt.geometry.distance_from_opl(LIGHT, index=x),
    "losses.cumulative_loss": lambda x: tt.losses.cumulative_loss(LIGHT, LIGHT.flip(1), x),
    "metrics.wrapped_difference": lambda x: tt.metrics.wrapped_difference(LIGHT, LIGHT + 1, period=x),
    "nlos.LaplacianFilter": lambda x: tt.nlos.LaplacianFilter(x),
    "parametrize.Positive": lambda x: tt.parametrize.Positive(scale=x),
    "scenes.furnace": lambda x: tt.scenes.furnace(x, 0.5, 1.0),
}
NONE = ["x", "3", b"3", True, np.bool_(True), torch.tensor(True), 1j, torch.tensor(1j), [], {}, object(), [1, [2]],
        np.timedelta64(3, "ns"), np.array(["3"]), np.ma.masked, math.nan, torch.tensor(math.nan)]  # fmt: skip
NO_WHOLE = [*NONE, 0.5, math.inf, 1e300, torch.tensor(1.5), 10**30, -1, torch.tensor([1.5, 2.5])]
NO_REAL = [*NONE, math.inf, -math.inf, 10**400]


def check_refused(call, values):
    for value in values:
        with pytest.raises(TorchTransientError) as caught:
            call(value)
        assert "\n" not in str(caught.value)


@together("call", WHOLE.items(), lambda item: item[0])
def test_whole_numbers(call):
    for make in (int, np.int64, np.uint8, np.array, torch.tensor):
        call[1](make(3))
    check_refused(call[1], NO_WHOLE)


@together("call", REAL.items(), lambda item: item[0])
def test_real_numbers(call):
    for make in (int, float, np.float32, np.array, torch.tensor, Fraction):
        call[1](make(2))
    check_refused(call[1], NO_REAL)
