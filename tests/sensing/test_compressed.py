"""Binary frames, equi-depth and coded histograms."""

from __future__ import annotations

import math

import pytest
import torch

from torchtransient import sensing
from torchtransient.errors import ShapeError, UnitError


def test_binary_frames_and_their_inverse():
    rate = torch.tensor([0.0, 0.1, 1.0, 3.0], dtype=torch.float64).view(1, 4, 1, 1)
    sensor = sensing.BinaryFrames(1000)
    torch.testing.assert_close(sensing.frames_to_rate(sensor(rate), 1000), rate, atol=1e-12, rtol=1e-9)
    for frames in (1000, 3 * 10**7):  # all of them fired: the rate of a share 1 - 1/(2 frames)
        full = sensing.frames_to_rate(torch.tensor(float(frames)), frames)
        assert float(full) == pytest.approx(math.log(2 * frames), rel=1e-6)
    h = sensor.sample(rate.expand(1, 4, 100, 100), torch.Generator().manual_seed(0))
    p = -torch.expm1(-rate)
    z = (h.mean((-1, -2)) - 1000 * p.mean((-1, -2))) / (1000 * p * (1 - p) / 1e4).sqrt().clamp_min(1e-9).squeeze()
    assert float(z.abs().max()) < 4.5


def test_equi_depth_edges_cut_equal_shares():
    h = torch.rand(1, 1, 50, 3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) ** 4
    edges = sensing.equi_depth_edges(h, 8)
    assert edges.shape == (1, 1, 7, 3, 4)
    cumulative = torch.nn.functional.pad(h.cumsum(2), (0, 0, 0, 0, 1, 0))
    low = edges.floor().long()
    at = cumulative.gather(2, low) + (edges - low) * h.gather(2, low)
    shares = torch.arange(1, 8, dtype=torch.float64).view(-1, 1, 1) / 8
    torch.testing.assert_close(at / h.sum(2, keepdim=True), shares.expand_as(at))
    assert torch.autograd.gradcheck(lambda v: sensing.equi_depth_edges(v, 4), (h[..., :1, :1] + 0.1).requires_grad_())
    empty = sensing.equi_depth_edges(torch.zeros(1, 8, 1, 1), 4)
    torch.testing.assert_close(empty.flatten(), torch.tensor([2.0, 4.0, 6.0]))
    with pytest.raises(UnitError, match="counts >= 0"):
        sensing.equi_depth_edges(-torch.ones(1, 8, 1, 1), 4)


def test_a_pixel_with_nan_has_no_edges():
    counts = torch.tensor([[1.0, 2.0, math.nan, 1.0], [3.0, 1.0, 1.0, 3.0]], dtype=torch.float64).T.reshape(1, 4, 1, 2)
    found = sensing.equi_depth_edges(counts, 4).squeeze()
    assert bool(found[:, 0].isnan().all()) and found[:, 1].tolist() == pytest.approx([2 / 3, 2.0, 10 / 3])


def test_probabilities_of_binary_frames():
    """Binomials of independent bins: mean, variance, and logarithms that add up to one over all counts."""
    rate = torch.tensor([[0.0, 2.5], [0.4, 1e-3]], dtype=torch.float64).reshape(1, 2, 1, 2)
    sensor, p = sensing.BinaryFrames(5), 1 - torch.exp(-rate)
    torch.testing.assert_close(sensor.expected(rate), 5 * p)
    torch.testing.assert_close(sensor.variance(rate), 5 * p * (1 - p))
    k = torch.arange(6, dtype=torch.float64).reshape(6, 1, 1, 1, 1).expand(6, 1, 1, 1, 2)
    for one in rate.split(1, 1):
        logs = sensor.log_prob(k, one.expand(6, 1, 1, 1, 2))
        assert logs.shape == (6, 1, 1, 2)
        torch.testing.assert_close(logs.exp().sum(0), torch.ones(1, 1, 2, dtype=torch.float64))
        exact = torch.distributions.Binomial(5, (1 - torch.exp(-one)).clamp_min(1e-300)).log_prob(k).squeeze(2)
        torch.testing.assert_close(logs.exp(), exact.exp(), rtol=1e-12, atol=2e-15)  # torch takes no p below 2e-16
    both = sensor.log_prob(torch.tensor([[0.0, 4.0], [1.0, 0.0]]).reshape(1, 2, 1, 2).double(), rate)
    wanted = torch.distributions.Binomial(5, p[0, :, 0, 1]).log_prob(torch.tensor([4.0, 0.0]).double()).sum()
    torch.testing.assert_close(both[0, 0, 1], wanted)
    # a bin without light that has counts is impossible
    assert float(sensor.log_prob(torch.ones(1, 1, 1, 1).double(), rate[:, :1, :, :1])) < -1e2


def test_coded_histograms():
    codes = sensing.fourier_codes(64, 8)
    torch.testing.assert_close(codes @ codes.T, torch.eye(8, dtype=torch.float64), atol=1e-12, rtol=0)
    sensor = sensing.CodedHistogram(codes)
    g = torch.Generator().manual_seed(0)
    x = torch.rand(2, 1, 64, 3, 2, dtype=torch.float64, generator=g)
    y = torch.rand(2, 1, 8, 3, 2, dtype=torch.float64, generator=g)
    torch.testing.assert_close((sensor(x) * y).sum(), (x * sensing.adjoint(sensor, y, x.shape)).sum())
    # the phase of the first harmonic is the delay
    delta = torch.zeros(1, 64, 1, 1, dtype=torch.float64)
    delta[0, 20] = 1.0
    phase = torch.atan2(sensor(delta)[0, 1], sensor(delta)[0, 0]).item()
    assert phase / (2 * torch.pi) * 64 == pytest.approx(20.5)
    with pytest.raises(ShapeError, match="at most"):
        sensing.fourier_codes(4, 9)
    with pytest.raises(ShapeError, match="as in codes"):
        sensor(torch.ones(1, 3, 1, 1))
