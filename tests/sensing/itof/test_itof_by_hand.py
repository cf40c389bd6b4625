"""Taps, phases and what is claimed of them, for numbers that can be worked out on paper."""

from __future__ import annotations

import math

import pytest
import torch

from torchtransient import sensing
from torchtransient.errors import UnitError
from torchtransient.units import SPEED_OF_LIGHT

TURN = 2 * math.pi
F = 30e6


def frames(*values):
    """(1, F N, 1, 1)."""
    return torch.tensor(values, dtype=torch.float64).reshape(1, -1, 1, 1)


def flat(x):
    return x.flatten().tolist()


# -------------------------------------------------------------------------------------------------------- readings


def test_contrast():
    """amplitude / offset of each pixel; zero without light, none of differences."""
    taps = torch.stack([frames(4, 3, 2, 3), frames(0, 0, 0, 0), frames(7, 7, 3, 3)]).squeeze(-1).movedim(0, -1)
    reading = sensing.read_itof(taps, F, 4)
    assert flat(reading.amplitude) == pytest.approx([1.0, 0.0, 2 * 2**0.5])
    assert flat(reading.offset) == [3.0, 0.0, 5.0]
    assert flat(reading.contrast) == pytest.approx([1 / 3, 0.0, 2 * 2**0.5 / 5])
    assert reading.contrast.shape == reading.amplitude.shape
    assert sensing.read_itof(taps, F, 4, readout="differential").contrast is None
    dark = taps.clone().requires_grad_()
    (slope,) = torch.autograd.grad(sensing.read_itof(dark, F, 4).contrast.sum(), dark)
    assert bool(slope.isfinite().all())


def test_phase_amplitude_and_deviation_of_four_taps():
    """X = (9, 6, 1, 4): z = (8 + 2 i) / 2; Var phi = sum g^2 X, g_n = 2 sin(theta_n - phi) / (4 a)."""
    x = frames(9, 6, 1, 4)
    phi, amplitude = math.atan2(2, 8), math.hypot(8, 2) / 2
    reading = sensing.read_itof(x, F, 4, noise=sensing.ItofNoise(read_noise_e=3.0))
    assert flat(reading.phase) == pytest.approx([phi]) and flat(reading.amplitude) == pytest.approx([amplitude])
    metres = SPEED_OF_LIGHT / (4 * math.pi * F)
    assert flat(reading.depth_m) == pytest.approx([metres * phi])
    slopes = [2 * math.sin(n * TURN / 4 - phi) / (4 * amplitude) for n in range(4)]

    def std(*variances):
        return metres * math.sqrt(sum(g**2 * v for g, v in zip(slopes, variances, strict=True)))

    assert flat(reading.depth_std_m) == pytest.approx([std(18, 15, 10, 13)])
    given = sensing.read_itof(x, F, 4, noise=sensing.ItofNoise(std_e=2.0))
    assert flat(given.depth_std_m) == pytest.approx([std(4, 4, 4, 4)])
    # 5 electrons a number: variances of (5 X + 9) / 25 numbers; of a converter, the deviation is the same
    gain = sensing.ItofNoise(read_noise_e=3.0, electrons_per_unit=5.0)
    wanted = std(*((5 * v + 9) / 25 for v in (9, 6, 1, 4)))
    for kind in (torch.float64, torch.int16):
        found = sensing.read_itof(x.to(kind), F, 4, noise=gain)
        assert flat(found.depth_std_m) == pytest.approx([wanted], rel=1e-6)
    offset = sensing.ItofNoise(read_noise_e=3.0, offset_e=20.0)
    found = sensing.read_itof(x, F, 4, readout="differential", noise=offset)
    assert flat(found.depth_std_m) == pytest.approx([std(38, 38, 38, 38)])
    two = sensing.read_itof(frames(9, 2, 6, 3, 1, 5, 4, 1), F, 4, readout="two_tap",
                            noise=sensing.ItofNoise(read_noise_e=3.0))  # fmt: skip
    z = complex(2 * (7 + 4) / 4, 2 * (3 - 3) / 4)
    slopes = [2 * math.sin(n * TURN / 4 - math.atan2(z.imag, z.real)) / (4 * abs(z)) for n in range(4)]
    assert flat(two.depth_std_m) == pytest.approx([std(11 + 18, 9 + 18, 6 + 18, 5 + 18)])
    assert flat(two.offset) == [31 / 4]


# ----------------------------------------------------------------------------------------------------------- depth


def test_turns_that_are_added():
    """d = 7.3 m seen by 15 and 18 MHz, between limits; half open, and no place beyond them."""
    frequencies = (15e6, 18e6)
    periods = [SPEED_OF_LIGHT / (2 * f) for f in frequencies]

    def phases(d):
        return torch.tensor([TURN * (d / p % 1.0) for p in periods], dtype=torch.float64).reshape(1, 2, 1, 1)

    longest = SPEED_OF_LIGHT / 6e6
    assert sensing.unambiguous_range_m(frequencies) == pytest.approx(longest)
    for d in (0.2, 7.3, 26.0, 49.0):
        assert flat(sensing.unwrap_depth(phases(d), frequencies)) == pytest.approx([d])
        for low in (-30.0, -3.0, 12.0):
            found = sensing.unwrap_depth(phases(d), frequencies, min_depth_m=low)
            away = (float(found) - d) / longest
            assert low <= float(found) < low + longest and away == pytest.approx(round(away), abs=1e-9)
    # off by 0.1 and 0.4 turns of a phase each: the depth is between, by w / period^2
    off = phases(7.3) + torch.tensor([0.02, -0.03]).double().reshape(1, 2, 1, 1)
    for weights in (None, (4.0, 1.0)):
        w = [v / p**2 for v, p in zip(weights or (1.0, 1.0), periods, strict=True)]
        parts = [(7.3 + e * p / TURN) * v for e, p, v in zip((0.02, -0.03), periods, w, strict=True)]
        found = sensing.unwrap_depth(off, frequencies, weights=weights)
        assert flat(found) == pytest.approx([sum(parts) / sum(w)])
    with pytest.raises(UnitError, match=r"at most 49\.97 m, after which"):
        sensing.unwrap_depth(off, frequencies, max_depth_m=1.11 * longest)
    assert float(sensing.unwrap_depth(off, frequencies, max_depth_m=1.09 * longest)) > 0
    for low, high in ((3.0, 3.0), (3.0, math.inf), (3.0, math.nan)):
        with pytest.raises(UnitError, match="expected min_depth_m < max_depth_m"):
            sensing.unwrap_depth(off, frequencies, min_depth_m=low, max_depth_m=high)
