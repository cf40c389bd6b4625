"""Waves over fields of distances against sines and cosines of double precision."""

import math

import numpy as np
import pytest
import torch

from torchtransient.reconstruction.plane_waves import phase_pairs, waves

F64 = torch.float64
DISTANCES = torch.tensor([[0.5, 0.125, 3.0], [1e4 + 0.3, 0.01, 2.25]], dtype=F64)


@pytest.mark.parametrize("falloff", [0.0, 1.5, -2.0])
@pytest.mark.parametrize("count", [1, 2, 5])
def test_waves_are_those_of_every_frequency(count, falloff):
    frequencies = 3.25 + 0.75 * torch.arange(count, dtype=F64)
    found = waves(DISTANCES, frequencies, falloff, torch.complex128, 0.125)
    assert found.shape == (count, 2, 3)
    r = DISTANCES.numpy()
    for k in range(count):
        expected = np.exp(2j * math.pi * float(frequencies[k]) * r) / np.maximum(r, 0.125) ** falloff
        # Angles of 1e5 radians have 1e-11 of themselves.
        np.testing.assert_allclose(found[k].numpy(), expected, rtol=1e-9)
    single = waves(DISTANCES, frequencies, falloff, torch.complex64, 0.125)
    assert single.dtype == torch.complex64
    torch.testing.assert_close(single.to(found), found, rtol=1e-6, atol=0)


def test_without_a_nearest_distance_waves_grow_without_bound():
    found = waves(torch.tensor([1e-3], dtype=F64), torch.tensor([1.0], dtype=F64), 1.0, torch.complex128)
    assert float(found.abs()) == pytest.approx(1e3)


def test_phases_are_pairs_of_cosine_and_sine():
    turns = torch.tensor([0.0, 0.25, 1e6 + 0.125, -0.3], dtype=F64)
    angle = 2 * math.pi * torch.tensor([0.0, 0.25, 0.125, -0.3], dtype=F64)
    torch.testing.assert_close(phase_pairs(turns), torch.stack([angle.cos(), angle.sin()], -1), rtol=0, atol=1e-9)
