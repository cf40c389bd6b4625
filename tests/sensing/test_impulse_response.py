"""Responses against closed forms, SciPy and conservation; convolution against numpy."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
import torch
from scipy import stats

from support.sweeps import together
from torchtransient import sensing

FWHM_PER_SIGMA = 2.3548200450309493  # 2 sqrt(2 log 2)
PS = 1e-12


def moments(first, weights, width):
    lags = (torch.arange(weights.numel(), dtype=torch.float64) + first) * width
    mean = (weights * lags).sum()
    return float(mean), float((weights * (lags - mean) ** 2).sum())


def f64(*values):
    return tuple(torch.tensor(v, dtype=torch.float64) for v in values)


@pytest.mark.parametrize("sigma, tau", [(30.0, 0.02), (30.0, 39.0), (0.5, 400.0)])
def test_emg_against_fifty_digits(sigma, tau):
    """SciPy itself is 7e-10 of the peak away for (30, 0.02)."""
    t = torch.linspace(-5 * sigma, 5 * sigma + 10 * tau, 41, dtype=torch.float64)
    with mpmath.workdps(50):
        s, e = mpmath.mpf(sigma), mpmath.mpf(tau)
        z = [(s / e - mpmath.mpf(x) / s) / mpmath.sqrt(2) for x in t.tolist()]
        exact = [
            float(mpmath.ncdf(-x / s) + mpmath.exp(s * s / (2 * e * e) - mpmath.mpf(x) / e) * mpmath.erfc(v) / 2)
            for x, v in zip(t.tolist(), z, strict=True)
        ]
    np.testing.assert_allclose(sensing.emg_survival(t, *f64(0.0, sigma, tau)).numpy(), exact, rtol=1e-11, atol=1e-300)


def test_emg_derivatives_are_finite_and_right():
    t = torch.linspace(-200.0, 900.0, 23, dtype=torch.float64)
    args = [a.requires_grad_() for a in f64(3.0, 30.0, 39.0)]
    assert torch.autograd.gradcheck(lambda *a: sensing.emg_cdf(t, *a), args)
    assert torch.autograd.gradcheck(lambda *a: sensing.emg_survival(t, *a), args)
    args = [a.requires_grad_() for a in f64(0.0, 30.0, 0.02)]
    for value in torch.autograd.grad(sensing.emg_cdf(t, *args).sum(), args):
        assert bool(torch.isfinite(value))


def test_central_gaussian_kernel_is_the_difference_of_error_functions():
    first, weights = sensing.GaussianResponse(60 * PS, delay_s=13 * PS).kernel(16 * PS, within_bin="center")
    edges = (np.arange(first, first + weights.numel() + 1) - 0.5) * 16
    wanted = np.diff(stats.norm(13, 60 / FWHM_PER_SIGMA).cdf(edges))
    np.testing.assert_allclose(weights.numpy(), wanted / wanted.sum(), atol=1e-13)
    # far out, the digits of the tails survive
    assert float(weights[-2]) == pytest.approx(
        np.diff(stats.norm(13, 60 / FWHM_PER_SIGMA).sf(edges))[-2] * -1, rel=1e-6
    )


SHAPES = {
    "gaussian": sensing.GaussianResponse(60 * PS, 13 * PS),
    "narrow": sensing.GaussianResponse(1 * PS, 5 * PS),
    "emg": sensing.emg_response(40 * PS, 70 * PS, -9 * PS),
    "tails": sensing.TailedResponse(27 * PS, [60 * PS, 200 * PS], [0.3, 0.05]),
    "uniform": sensing.UniformResponse(50 * PS, 3 * PS),
    "measured": sensing.MeasuredResponse(torch.tensor([0.0, 2, 9, 30, 12, 5, 3, 1, 0, 0, 0, 0, 0]), 7 * PS, 4 * PS),
    "composed": sensing.ComposedResponse(
        [sensing.GaussianResponse(30 * PS), sensing.emg_response(20 * PS, 50 * PS, 6 * PS)]
    ),
}


@pytest.mark.parametrize("name", SHAPES)
def test_kernels_against_photons_anywhere_in_their_bin(name):
    """The shares that photons at 1024 places of a bin leave in later bins; a midpoint rule: 1e-5 at corners."""
    response, width = SHAPES[name], 16.0
    first, weights = response.kernel(width * PS)
    lags = torch.arange(first, first + weights.numel() + 1, dtype=torch.float64)
    place = (torch.arange(1024, dtype=torch.float64) + 0.5) / 1024
    single = sensing.ComposedResponse([response]) if name != "composed" else None
    edges = (lags.unsqueeze(1) - place) * width * PS
    if single is None:  # normal cores add up to one
        core = (30**2 + 20**2) ** 0.5
        response = sensing.emg_response(core * PS, 50 * PS, 6 * PS)
    else:
        assert torch.equal(single.kernel(width * PS)[1], weights)
    shares = response.cdf(edges.flatten()).view(edges.shape).mean(1).diff()
    corners = name in ("uniform", "measured")
    np.testing.assert_allclose(weights.numpy(), shares.numpy(), atol=3e-7 + 1e-5 * corners)
    assert float(weights.min()) >= 0 and float(weights.sum()) == pytest.approx(1, abs=1e-12)


def test_late_and_early_tails_keep_their_digits():
    """Against 40 digits, where the share is below 1e-7: normal on one side, exponential on the other."""
    sigma, tau, width = 27 / FWHM_PER_SIGMA, 60.0, 16.0
    first, weights = sensing.emg_response(27 * PS, tau * PS).kernel(width * PS)
    with mpmath.workdps(40):
        s, e = mpmath.mpf(sigma), mpmath.mpf(tau)

        def integral(t):
            u = t / s
            normal = s * (u * mpmath.ncdf(u) + mpmath.npdf(u))
            tail = mpmath.exp(s * s / (2 * e * e) - t / e) * mpmath.ncdf(u - s / e)
            return normal - e * (mpmath.ncdf(u) - tail)

        for k in (1, weights.numel() - 3):
            t = mpmath.mpf(width) * (first + k)
            exact = (integral(t + width) - 2 * integral(t) + integral(t - width)) / width
            assert 0 < exact < 1e-7
            assert float(weights[k]) == pytest.approx(float(exact), rel=1e-8)


class Triangle(sensing.Response):
    """A user's own: nothing but the cumulative of a triangle, 2 h wide, around 20 ps."""

    def __init__(self, half_s):
        super().__init__(20 * PS, learnable=True)
        self.half_s = half_s

    def cdf(self, time_s):
        u = ((time_s - self.delay_s) / self.half_s).clamp(-1, 1)
        return 0.5 + u - 0.5 * u * u.abs()

    def support_s(self):
        middle = float(self.delay_s.detach())
        return middle - self.half_s, middle + self.half_s


@pytest.mark.parametrize("half, error", [(16.0, 1e-4), (4.0, 1e-4), (0.01, 1e-4), (900.0, 1e-7)])
def test_a_response_that_gives_its_cumulative_alone(half, error):
    """Its integral is a cubic: the numerical default against it, wide and narrow, and through gradients."""
    response, width = Triangle(half * PS), 16.0
    first, weights = response.kernel(width * PS)
    t = (torch.arange(first - 1, first + weights.numel() + 1, dtype=torch.float64) * width - 20) / half
    u = t.clamp(-1, 1)
    area = half * (0.5 * u + 0.5 * u * u - u.abs() ** 3 / 6 + 1 / 6 + (t - u).clamp_min(0))
    np.testing.assert_allclose(weights.detach().numpy(), (area.diff().diff() / width).numpy(), atol=error)
    weights[0].backward()
    assert bool(torch.isfinite(response.delay_ps.grad))


def test_very_long_responses_lose_no_digits():
    """100 000 bins of width: second differences would leave 1e-4 of noise on every share."""
    first, weights = sensing.GaussianResponse(1e5 * PS).kernel(1 * PS)
    sigma = 1e5 / FWHM_PER_SIGMA
    t = np.arange(first, first + weights.numel())
    np.testing.assert_allclose(weights.numpy(), stats.norm(0, sigma).pdf(t), rtol=1e-8)


@pytest.mark.parametrize("bins", [0, 5000])
def test_composition_of_gaussians_is_a_gaussian(bins):
    """Wherever it stands: a delay is no length."""
    delay = bins * 10 * PS
    together = sensing.ComposedResponse([sensing.GaussianResponse(30 * PS, delay), sensing.GaussianResponse(40 * PS)])
    # (10/9)^2/12 of variance twice on the grid; none in the closed form
    for within, error in (("center", 3e-4), ("uniform", 1e-8)):
        first, weights = together.kernel(10 * PS, within)
        begin, wanted = sensing.GaussianResponse(50 * PS, delay).kernel(10 * PS, within)
        inner = weights[begin - first :][: wanted.numel()]
        assert float((inner - wanted).abs().max()) < error


def test_measured_response_keeps_counts_and_centre():
    g = torch.Generator().manual_seed(0)
    t = torch.arange(400, dtype=torch.float64)
    truth = torch.from_numpy(stats.exponnorm.pdf(t.numpy(), K=9.0 / 4.0, loc=120.0, scale=4.0))
    counts = torch.poisson(truth * 1e8 + 50, generator=g)
    for width in (8 * PS, 3 * PS, 5.5 * PS, 31 * PS):
        first, weights = sensing.MeasuredResponse(counts, 8 * PS, delay_s=40 * PS).kernel(width)
        mean, variance = moments(first, weights, width / PS)
        assert float(weights.sum()) == pytest.approx(1, abs=1e-12)
        assert mean == pytest.approx(40, abs=0.02 * width / PS)
        # even spreading inside the bins of the measurement, and inside source and target bins, adds all three
        spread = (8**2 + 2 * (width / PS) ** 2) / 12
        assert variance == pytest.approx(64 * (4.0**2 + 9.0**2) + spread, rel=0.02)
    # the highest bin, not the mean, would be off by about tau
    peak = int(counts.argmax())
    assert abs((peak - 120) - 9.0) > 2


def test_resampling_conserves_counts():
    counts = torch.rand(57, dtype=torch.float64, generator=torch.Generator().manual_seed(1), requires_grad=True)
    edges = torch.tensor([-3.0, 0.0, 0.3, 7.77, 20.0, 56.0, 60.0], dtype=torch.float64)
    out = sensing.resample_counts(counts, 1.0, edges)
    assert out.sum().item() == pytest.approx(counts.sum().item(), abs=1e-12)
    assert float(out[0]) == 0.0
    assert float(out[1]) == pytest.approx(0.3 * float(counts[0]))
    assert torch.autograd.gradcheck(lambda c: sensing.resample_counts(c, 1.0, edges), (counts,))


def numpy_convolution(x, kernel, first, boundary):
    bins = x.shape[-3]
    y = np.zeros(x.shape)
    for t in range(bins):
        for j, weight in enumerate(kernel):
            s = t - first - j
            if boundary == "periodic":
                s %= bins
            elif not 0 <= s < bins:
                continue
            y[..., t, :, :] += weight * x[..., s, :, :]
    return y


# kernels of more than 192 bins are applied by a transform
LONG = [(200, 195, -7), (200, 195, 9), (200, 300, -150)]
SHORT = [(16, *k) for k in ((1, 0), (5, -2), (5, 3), (5, -9), (20, -7), (20, 4), (40, -20), (3, 15), (3, -15))]


@together("boundary", ["zero", "periodic"])
@together("bins, taps, first", SHORT + LONG)
def test_convolution_against_plain_loops(boundary, bins, taps, first):
    g = torch.Generator().manual_seed(taps)
    x = torch.rand(2, 1, bins, 2, 2, dtype=torch.float64, generator=g)
    kernel = torch.rand(taps, dtype=torch.float64, generator=g)
    found = sensing.convolve_time(x, kernel, first, boundary=boundary)
    np.testing.assert_allclose(found.numpy(), numpy_convolution(x.numpy(), kernel.numpy(), first, boundary), atol=1e-12)


@pytest.mark.parametrize("bins, taps", [(9, 4), (200, 195)])
@pytest.mark.parametrize("boundary", ["zero", "periodic"])
def test_convolution_gradients(bins, taps, boundary):
    g = torch.Generator().manual_seed(0)
    x = torch.rand(1, 1, bins, 1, 2, dtype=torch.float64, generator=g, requires_grad=True)
    kernel = torch.rand(taps, dtype=torch.float64, generator=g, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda x, k: sensing.convolve_time(x, k, -1, boundary=boundary), (x, kernel), fast_mode=True
    )
