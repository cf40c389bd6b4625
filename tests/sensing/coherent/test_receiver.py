"""Spectra from fields: means, what neighbours share, chirps simulated in time, and how well places are known."""

from __future__ import annotations

import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.signal import get_window

from torchtransient import Chirps, TimeAxis
from torchtransient.errors import UnitError
from torchtransient.sensing import CoherentReceiver, Compose, GaussianResponse, ImpulseResponse, range_and_speed

CHIRPS = Chirps(1e9, 10e-6, 1550e-9)
LINE = CHIRPS.resolution_opl
AXIS = CHIRPS.time_axis((1.0, 3.0), bins_per_line=8)
WINDOWS = ["rectangular", "hann", "hamming", "blackman", "blackmanharris", "nuttall"]


def light_at(*places, pixels=1):
    """Light of one at the bins nearest to some lengths, (1, T, 1, pixels)."""
    x = torch.zeros(1, AXIS.num_bins, 1, pixels, dtype=torch.float64)
    for place in places:
        x[0, int(AXIS.bin_index(place))] += 1
    return x


def correlation(y, i, j):
    """Of two bins over pixels."""
    return np.corrcoef(y[0, i, 0].numpy(), y[0, j, 0].numpy())[0, 1]


@pytest.mark.parametrize("window", WINDOWS)
def test_mean_is_the_line_and_a_photon(window):
    chirps = Chirps(1e9, 10e-6, 1550e-9, window=window)
    receiver = CoherentReceiver(chirps, AXIS, photons_per_unit=50.0)
    place = float(AXIS.centers_opl[AXIS.bin_index(3.7)])
    mean = receiver.expected(light_at(3.7)).flatten()
    # A density over lines, which the line shape is but for its cut.
    small = 1e-3 * LINE
    edges = receiver.spectrum_axis.centers_opl.numpy()[:, None] + np.array([-small, small])
    wanted = np.diff(chirps.line_shape.shifted(place).cumulative(edges))[:, 0] * LINE / (2 * small)
    np.testing.assert_allclose((mean.numpy() - 1) / 50, wanted, atol=2e-3)
    lost = {"rectangular": 0.02, "hamming": 1e-3}.get(window, 1e-5)  # beyond the axis
    assert (mean - 1).sum().item() == pytest.approx(50.0, rel=lost)


def test_every_bin_has_a_gamma_distribution():
    """Of two surfaces in a line of each other: fields that are added are Gaussian."""
    receiver = CoherentReceiver(CHIRPS, AXIS, photons_per_unit=5.0, looks=3)
    x = light_at(3.0, 3.2, pixels=20_000)
    y = receiver.sample(x, torch.Generator().manual_seed(0))
    mean = receiver.expected(x)[0, :, 0, 0]
    for place in (int(mean.argmax()), int(mean.argmax()) + 2, 0):
        law = stats.gamma(3, scale=float(mean[place]) / 3)
        assert stats.kstest(y[0, place, 0].numpy(), law.cdf).pvalue > 1e-3
    torch.testing.assert_close(receiver.variance(x), receiver.expected(x).square() / 3)


def test_bins_of_one_line_rise_and_fall_together():
    """Many photons: one field. Lines far apart are independent, and noise of a window's neighbours is 2 / 3 alike."""
    n = 4000
    bright = CoherentReceiver(CHIRPS, AXIS, photons_per_unit=1e6)
    y = bright.sample(light_at(2.5, 5.0, pixels=n), torch.Generator().manual_seed(1))
    at = [int(bright.spectrum_axis.bin_index(place)) for place in (2.5, 5.0)]
    assert correlation(y, at[0], at[0] + 1) > 0.999
    assert abs(correlation(y, *at)) < 4 / n**0.5
    dark = bright.sample(torch.zeros(1, AXIS.num_bins, 1, n, dtype=torch.float64), torch.Generator().manual_seed(2))
    # Hann: transforms of neighbours share (1/2 1/4 + 1/4 1/2) / (1/4 + 2/16) of their field, the square of it of power.
    assert correlation(dark, 5, 6) == pytest.approx((2 / 3) ** 2, abs=4 / n**0.5)
    assert correlation(dark, 5, 7) == pytest.approx((1 / 6) ** 2, abs=4 / n**0.5)
    assert dark.mean().item() == pytest.approx(1.0, abs=0.02)


def test_chirps_simulated_in_time():
    """Covariance of the powers of all bins against that of windowed signals with random phases and white noise."""
    samples, runs, photons = 64, 4000, np.array([30.0, 12.0])
    places = AXIS.centers_opl[AXIS.bin_index(torch.tensor([2.9, 3.35]))].numpy()
    rng = np.random.default_rng(0)
    t = (np.arange(samples) + 0.5) / samples - 0.5
    field = rng.normal(size=(runs, 2, 2)) @ np.array([1, 1j]) * np.sqrt(photons / 2)
    signal = field @ np.exp(2j * np.pi * places[:, None] / LINE * t)
    # White noise of one photon in each of as many modes as samples.
    signal = signal + (rng.normal(size=(runs, samples, 2)) @ np.array([1, 1j])) * np.sqrt(samples / 2)
    w = get_window("hann", samples)
    spectra = np.abs(np.fft.fft(signal * w, axis=1)) ** 2 / (samples * (w**2).sum())
    receiver = CoherentReceiver(CHIRPS, AXIS)
    x = torch.zeros(1, AXIS.num_bins, 1, runs, dtype=torch.float64)
    for place, n in zip(places, photons, strict=True):
        x[0, int(AXIS.bin_index(float(place)))] = n
    drawn = receiver.sample(x, torch.Generator().manual_seed(3))[0, :, 0].T.numpy()
    first = round(float(receiver.spectrum_axis.centers_opl[0]) / LINE)
    both = [spectra[:, 6:20], drawn[:, 6 - first : 20 - first]]
    (mean, cov), (mean_drawn, cov_drawn) = ((y.mean(0), np.cov(y.T)) for y in both)
    error = np.sqrt(np.diag(cov) / runs)
    assert (np.abs(mean - mean_drawn) < 4.5 * np.sqrt(2) * error).all()
    # Of exponential variables the standard error of a covariance is at most sqrt(8 / n) of both deviations.
    scale = np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    assert (np.abs(cov - cov_drawn) < 4.5 * np.sqrt(2 * 8 / runs) * scale).all()


def test_places_are_known_as_photons_allow():
    """The error of a flat surface goes with the root of its photons; independent bins leave a sixth of a line."""
    distance = []
    for photons in (1e3, 1e5):
        receiver = CoherentReceiver(CHIRPS, AXIS, photons_per_unit=photons, looks=8)
        x = light_at(3.6, pixels=500)
        y = receiver.sample(torch.stack([x, x], 1), torch.Generator().manual_seed(4))
        found, _ = range_and_speed(y[0], CHIRPS, receiver.spectrum_axis, bins="samples")
        truth = float(AXIS.centers_opl[AXIS.bin_index(3.6)]) / 2
        distance.append((found - truth).square().mean().sqrt().item())
    assert distance[0] < 0.02 * LINE
    assert distance[1] == pytest.approx(distance[0] / 10, rel=0.25)


def test_gradient_of_the_same_draw():
    receiver = CoherentReceiver(CHIRPS, TimeAxis(1.0, LINE / 4, 6), photons_per_unit=30.0, looks=2, grad="gaussian")
    x = 0.1 + torch.rand(1, 6, 1, 1, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: receiver(x, torch.Generator().manual_seed(6)), x.requires_grad_())


def test_longer_chirps_have_the_same_beats():
    longer = CHIRPS.longer(16)
    assert longer.rate_scale_s == pytest.approx(CHIRPS.rate_scale_s, rel=1e-12)
    assert longer.hertz_per_metre == pytest.approx(CHIRPS.hertz_per_metre, rel=1e-12)
    assert longer.resolution_opl == pytest.approx(LINE / 16) and longer.window == "hann"


def test_stages_behind_have_the_bins_of_the_spectra():
    receiver = CoherentReceiver(CHIRPS, AXIS)
    later = ImpulseResponse(GaussianResponse(1e-9), receiver.spectrum_axis)
    assert Compose([receiver, later]).expected(light_at(3.0)).shape[1] == receiver.spectrum_axis.num_bins


def test_beats_with_a_line_are_refused():
    receiver = CoherentReceiver(CHIRPS, AXIS)
    chain = Compose([receiver])
    beats = torch.rand(1, 2, AXIS.num_bins, 1, 1)
    found = chain(SimpleNamespace(transient=None, phasor=None, beats=beats, axis=AXIS, chirps=CHIRPS.longer(16)))
    torch.testing.assert_close(found, receiver.expected(beats))
    with pytest.raises(UnitError, match=r"longer\(16\)"):
        chain(SimpleNamespace(transient=None, phasor=None, beats=beats, axis=AXIS, chirps=CHIRPS))
    assert torch.equal(pickle.loads(pickle.dumps(receiver)).transform, receiver.transform)
