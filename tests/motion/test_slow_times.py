"""Times of poses and the weights of their pictures: exact for what is smooth in time."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from torchtransient.errors import ShapeError

DURATION_S = 1.5e-3


def moment(degree, beat_hz):
    """Average of (t / duration)^degree exp(2 pi i beat t) over the exposure, by 40 nodes in each of 40 parts."""
    x, g = np.polynomial.legendre.leggauss(40)
    edges = np.linspace(-DURATION_S / 2, DURATION_S / 2, 41)
    t = ((edges[1:, None] + edges[:-1, None]) + np.diff(edges)[:, None] * x) / 2
    return ((t / DURATION_S) ** degree * np.exp(2j * np.pi * beat_hz * t) * g).sum() / 80


BEATS = [0.0, 1 / DURATION_S, -2.3 / DURATION_S, 0.01, 97.5 / DURATION_S]


@together("poses, beat_hz", [(poses, beat) for poses in (2, 3, 4, 8, 20) for beat in BEATS])
def test_polynomials_with_a_beat_are_averaged_exactly(poses, beat_hz):
    """Weights are as large as the polynomials that they are made of, a few times one, and rounded as those are."""
    exposure = tt.Exposure(DURATION_S, beat_hz=beat_hz, poses=poses)
    t = exposure.poses_s()
    for degree in range(poses):
        pictures = ((t / DURATION_S) ** degree).to(torch.complex128)
        assert abs(complex(exposure.combine(pictures)) - moment(degree, beat_hz)) < 1e-13


@pytest.mark.parametrize("beat_hz", [1 / DURATION_S, -1 / DURATION_S])
def test_the_beat_is_the_light_over_the_sensor(beat_hz):
    """Light of a path that changes, times a sensor's sine, averaged by steps of 1/40 of a period: the tap of the
    sensor's phase is half the real part of the beat's phasor, turned by it. Of 150 periods of the modulation, which is
    slow here, a few 1e-4 of the amplitude are left over.
    """
    frequency, opl_per_s, start, speed_of_light = 1e5, 2e5, 700.0, 299792458.0
    t = (np.arange(int(40 * frequency * DURATION_S)) + 0.5) / (40 * frequency) - DURATION_S / 2
    delay = (start + opl_per_s * t) / speed_of_light
    light = 1 + np.cos(2 * np.pi * frequency * (t - delay))
    exposure = tt.Exposure(DURATION_S, beat_hz=beat_hz, poses=12)
    opl = start + opl_per_s * exposure.poses_s().numpy()
    phasor = complex(exposure.combine(torch.tensor(np.exp(-2j * np.pi * frequency * opl / speed_of_light))))
    for phase in (0.0, 1.0, 2.5):
        sensor = np.cos(2 * np.pi * (frequency - beat_hz) * t + phase)
        tap = (light * sensor).mean()
        assert tap == pytest.approx(0.5 * (phasor * np.exp(-1j * phase)).real, abs=3e-4)


@together("row_s, rows, poses", [(2e-5, 16, 3), (-2e-5, 7, 4), (1e-3, 1, 3), (2e-5, 5, 1)])
def test_rows_see_their_own_times(row_s, rows, poses):
    shutter = tt.RollingShutter(row_s, poses=poses)
    t = shutter.poses_s(rows) / 1e-3
    coefficients = torch.arange(1.0, poses + 1).double()
    polynomial = lambda t: (coefficients * t[:, None] ** torch.arange(poses)).sum(-1)  # noqa: E731
    pictures = polynomial(t).reshape(-1, 1, 1, 1).expand(-1, 2, rows, 3)
    at = shutter.rows_s(rows) / 1e-3
    assert at[0] == pytest.approx(-1e3 * row_s * (rows - 1) / 2, abs=1e-12)
    expected = polynomial(at)[:, None].expand(2, rows, 3)
    torch.testing.assert_close(shutter.combine(pictures), expected, atol=1e-11, rtol=0)


def test_phase_steps_take_each_tap_from_its_own_exposure():
    steps = tt.PhaseSteps(4, 2e-3)
    assert steps.poses_s().tolist() == pytest.approx([-3e-3, -1e-3, 1e-3, 3e-3])
    ones = torch.arange(4.0)[:, None, None, None, None].expand(4, 1, 4, 2, 2)
    tap = steps.taps(ones + 10 * torch.arange(4.0)[:, None, None])
    assert tap.shape == (1, 4, 2, 2) and tap[0, :, 0, 0].tolist() == [0.0, 11.0, 22.0, 33.0]
    two = steps.taps(torch.arange(4.0)[:, None, None, None, None].expand(4, 1, 8, 2, 2))
    assert two[0, :, 0, 0].tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    for shape in ((3, 1, 4, 2, 2), (4, 1, 6, 2, 2), (4, 4, 2, 2)):
        with pytest.raises(ShapeError, match=r"expected taps \(4, \.\.\., C, 4 or 8, H, W\), got"):
            steps.taps(torch.ones(shape))


def test_autocast_leaves_the_weights_as_they_are():
    """Weighted sums are no matrix products, which autocast rounds to 3e-3."""
    pictures = torch.rand(3, 2, 4, 4, generator=torch.Generator().manual_seed(0))
    exact = tt.Exposure(1e-3).combine(pictures.double())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert (tt.Exposure(1e-3).combine(pictures) - exact).abs().max() < 1e-6
        moved = tt.Motion(angular=(0.1, 0.2, 0.3)).matrices(torch.tensor([0.7]))
    assert torch.equal(moved, tt.Motion(angular=(0.1, 0.2, 0.3)).matrices(torch.tensor([0.7])))


# ------------------------------------------------------------------------------------------------------------ motions


def test_a_motion_has_its_velocity():
    """Of a material point, `linear + angular x (p - center)` at t = 0; distances to the center stay."""
    linear, angular, center = (1.0, -2.0, 0.5), (0.3, 2.0, -1.0), (0.2, 0.1, 3.0)
    motion, p = tt.Motion(linear=linear, angular=angular, center=center), np.array([1.0, 2.0, -0.5, 1.0])
    still, near, far, _ = motion.matrices(torch.tensor([0.0, 1e-6, 0.7, -1e-6])).numpy()
    np.testing.assert_allclose(still, np.eye(4), atol=1e-15)
    velocity = linear + np.cross(angular, p[:3] - center)
    np.testing.assert_allclose((near @ p - p)[:3] / 1e-6, velocity, atol=1e-5)
    moved_center = np.add(center, np.multiply(linear, 0.7))
    assert np.linalg.norm((far @ p)[:3] - moved_center) == pytest.approx(np.linalg.norm(p[:3] - center), rel=1e-7)


