"""Pixels without noise, and budgets: numbers that can be worked out on paper, at the limits of what is taken."""

from __future__ import annotations

import math

import pytest
import torch

from torchtransient import TimeAxis, sensing
from torchtransient.errors import UnitError


def light(*values):
    return torch.tensor(values, dtype=torch.float64).reshape(1, -1, 1, 1)


def flat(x):
    return x.flatten().tolist()


# ------------------------------------------------------------------------------------------------------ electronics


def test_the_order_of_a_pixel():
    """Gain, dark electrons, full well, offset, black level, rounding, range: one after the other."""
    gain = torch.tensor([[[2.0]], [[0.5]], [[1.0]], [[1.0]]], dtype=torch.float64)
    offset = torch.tensor([[[3.0]], [[-4.0]], [[7.0]], [[0.0]]], dtype=torch.float64)
    pixel = sensing.PixelElectronics(shot_noise=False, dark_e=5.0, full_well_e=60.0, gain_e_per_dn=4.0, bits=4,
                                     black_level_dn=2.0, gain_map=gain, offset_map_e=offset)  # fmt: skip
    x = light(10.0, 8.0, 90.0, 20.0)
    # 25 + 3 = 28; 9 - 4 = 5; 60 + 7 = 67, of at most 13 steps; 25
    assert flat(pixel.collected(x)) == [25.0, 9.0, 95.0, 25.0]
    assert flat(pixel.sample(x)) == [28.0, 4.0, 52.0, 24.0]
    assert pixel.range_dn == (0.0, 15.0) and pixel.range_e == (-8.0, 52.0)
    signed = sensing.PixelElectronics(shot_noise=False, gain_e_per_dn=4.0, bits=4, signed=True, black_level_dn=2.0)
    assert signed.range_dn == (-8.0, 7.0) and signed.range_e == (-40.0, 20.0)
    bare = sensing.PixelElectronics(full_well_e=60.0)
    assert bare.range_e == (-math.inf, 60.0) and sensing.PixelElectronics().range_e == (-math.inf, math.inf)
    for black in (-0.01, 15.01):
        with pytest.raises(UnitError, match="black_level_dn"):
            sensing.PixelElectronics(gain_e_per_dn=4.0, bits=4, black_level_dn=black)
    sensing.PixelElectronics(gain_e_per_dn=4.0, bits=4, black_level_dn=15.0)


def test_variances_by_hand():
    x = light(50.0, 20.0)
    given = {"read_noise_e": 3.0, "ktc_noise_e": 4.0, "dark_e": 6.0}
    assert flat(sensing.PixelElectronics(**given).variance(x)) == [56 + 25, 26 + 25]
    assert flat(sensing.PixelElectronics(**given, excess_noise=1.5).variance(x)) == [1.5 * 56 + 25, 1.5 * 26 + 25]
    drawn = sensing.PixelElectronics(**given, excess_noise=1.5, shot_noise=False)
    assert flat(drawn.variance(x)) == [0.5 * 56 + 25, 0.5 * 26 + 25]
    rounded = sensing.PixelElectronics(gain_e_per_dn=6.0, bits=8)
    assert flat(rounded.variance(x)) == [50 + 3.0, 20 + 3.0]
    assert flat(sensing.PixelElectronics(**given).expected(x)) == [56.0, 26.0]


@pytest.mark.parametrize("policy", ["gaussian", "score"])
def test_gradients_through_a_converter(policy):
    """One where the code is inside of the range, zero beyond it, whatever the rounding."""
    pixel = sensing.PixelElectronics(shot_noise=False, gain_e_per_dn=4.0, bits=4, grad=policy)
    x = light(-9.0, 13.0, 30.5, 90.0).requires_grad_()
    y = pixel(x, generator=torch.Generator().manual_seed(0))
    assert flat(y) == [0.0, 12.0, 32.0, 60.0]
    assert flat(torch.autograd.grad(y.sum(), x)[0]) == [0.0, 1.0, 1.0, 0.0]


# ---------------------------------------------------------------------------------------------------------- budgets

AXIS = TimeAxis.from_seconds(0.0, 1e-9, 10)


def budget(optics=None, **changes):
    given = {"pulse_energy_j": 2e-9, "wavelength_m": 600e-9, "repetition_rate_hz": 20e6, "cycles": 3000, "axis": AXIS}
    return sensing.PhotonBudget(optics or sensing.Optics(f_number=1.5), **(given | changes))


def test_pile_up_is_said_above_five_percent():
    model = budget(dark_count_rate_hz=1e6)
    per_unit = float(model.detections_per_unit)
    x = torch.zeros(1, 10, 1, 2, dtype=torch.float64)
    x[:, 3] = torch.tensor([0.039, 0.041], dtype=torch.float64) / per_unit
    assert flat(model.report(x).piles_up) == [False, True]
