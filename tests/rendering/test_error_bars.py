"""Standard errors of renders: calibrated for sums, whatever sampler, film and variant; kept with the output."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.errors import ShapeError

BINS = 40


def room(variant="llvm_ad_rgb", resolution=8):
    return tt.load(tt.scenes.cornell_box(resolution=resolution, num_bins=BINS, bin_width_opl=0.225), variant=variant)


def ratio(renderer, weights, truth, runs, spp, errors=True):
    """Mean squared residual of sums over the mean estimate of their variance, row by row of ``weights``."""
    residual, estimate = np.zeros(len(weights)), np.zeros(len(weights))
    with torch.no_grad():
        for seed in range(runs):
            out = renderer(seed=seed, spp=spp, errors=errors)
            x = measured(out)
            for i, w in enumerate(weights):
                residual[i] += float(((x * w).sum() - truth[i]).abs() ** 2)
                estimate[i] += float(out.standard_error(w) ** 2)
    return residual / estimate


def measured(out):
    """Mean over channels."""
    x = next(y for y in (out.transient, out.phasor, out.gated) if y is not None)
    return x.mean(-4)


def regions(bins=BINS, size=8):
    """Everything, the second half of the time, twelve bins of a quarter of the picture, a cosine over time."""
    t, y = torch.arange(bins), torch.arange(size)
    everything = torch.ones(bins, size, size)
    return [
        everything,
        everything * (t >= bins // 2)[:, None, None],
        everything * ((t >= 11) & (t < 23))[:, None, None] * (y < 4)[:, None] * (y < 4),
        everything * torch.cos(2 * torch.pi * t / bins)[:, None, None],
    ]


# A ratio of n squares of normal numbers deviates by sqrt(2 / n) from 1: .22 for 40 runs. Four times that.
@pytest.mark.parametrize("sampler", ["owen", "independent"])
@pytest.mark.parametrize("errors", [True, "bins"])
def test_sums_have_the_error_that_is_claimed(sampler, errors):
    renderer = tt.TransientRenderer(room(), spp=32, sampler=sampler, physics="ignore")
    weights = regions()
    with torch.no_grad():
        long = torch.stack([measured(renderer(seed=900 + k, spp=1024)) for k in range(4)]).mean(0)
    truth = [float((long * w).sum()) for w in weights]
    found = ratio(renderer, weights, truth, 40, 32, errors)
    assert (found > 0.3).all() and (found < 1.9).all()


@pytest.mark.soak
@pytest.mark.parametrize("errors, size, starts", [("bins", 10, (5, 15, 25)), (True, 8, (8, 16, 24))])
def test_calibration(errors, size, starts):
    """Of 12 regions, 200 runs: 1 +- .1. A mean of 2400 squares deviates by .03 if they are normal, and these have
    heavier tails. Of cells of 8 bins a window that begins within one takes the variance of its neighbours, too.
    """
    renderer = tt.TransientRenderer(room(resolution=16), spp=64, physics="ignore")
    t, y = torch.arange(BINS), torch.arange(16)
    weights = [
        torch.ones(BINS, 16, 16) * ((t >= a) & (t < a + size))[:, None, None] * (y // 8 == b)[:, None] * (y // 8 == c)
        for a in starts for b in (0, 1) for c in (0, 1)
    ]  # fmt: skip
    with torch.no_grad():
        long = torch.stack([measured(renderer(seed=900 + k, spp=8192)) for k in range(8)]).mean(0)
    truth = [float((long * w).sum()) for w in weights]
    found = ratio(renderer, weights, truth, 200, 64, errors)
    assert abs(found.mean() - 1) < 0.1


def test_the_map_of_errors_adds_up_to_the_squared_error():
    """Sum over bins of squared residuals over the sum of squared errors; the sum of some 10^3 bins, 20 runs."""
    renderer = tt.TransientRenderer(room(), spp=64, physics="ignore")
    with torch.no_grad():
        long = torch.stack([measured(renderer(seed=900 + k, spp=1024)) for k in range(4)]).mean(0)
        for errors in (True, "bins"):
            outs = [renderer(seed=seed, errors=errors) for seed in range(20)]
            residual = sum(float((measured(out) - long).square().sum()) for out in outs)
            assert 0.7 < residual / sum(float(out.error_map().square().sum()) for out in outs) < 1.4
            assert outs[0].error_map().shape == (BINS, 8, 8)
            assert outs[0].error_map(steady=True).shape == (8, 8)


def test_the_mean_is_that_of_the_batches():
    """The render is unbiased and differs from one without error bars by noise alone; odd numbers of samples too."""
    renderer = tt.TransientRenderer(room(), spp=33, physics="ignore")
    with torch.no_grad():
        plain, batched = (
            torch.stack([renderer(seed=seed, errors=errors).steady.mean() for seed in range(24)])
            for errors in (False, True)
        )
    out = renderer(seed=0, errors=True)
    assert out.stats.spp == 33 and out.stats.seeds == (0,)
    error = torch.sqrt((plain.var() + batched.var()) / 24)
    assert abs(plain.mean() - batched.mean()) < 4 * error
    total = sum(out.stats.energy_total)
    assert total == pytest.approx(float(out.steady.mean(0).sum()), rel=1e-5)


@pytest.mark.parametrize("settings", [
    {"frequencies": [0.0, 0.3, 0.9]}, {"gates": [tt.Gate.gaussian(5.0, 1.0), tt.Gate.gaussian(8.0, 1.0)]},
])  # fmt: skip
def test_other_films(settings):
    renderer = tt.TransientRenderer(room(), spp=32, physics="ignore", **settings)
    with torch.no_grad():
        long = torch.stack([measured(renderer(seed=900 + k, spp=1024)) for k in range(2)]).mean(0)
        residual = estimate = 0.0
        for seed in range(40):
            out = renderer(seed=seed, errors=True)
            assert out.standard_error().shape == long.shape[:-3]
            residual = residual + (measured(out) - long).sum((-3, -2, -1)).abs() ** 2
            estimate = estimate + out.standard_error() ** 2
    found = (residual / estimate).reshape(-1)[0]
    assert 0.3 < float(found) < 1.9


@pytest.mark.slow
def test_pixels_that_share_light():
    """Confocal points of the wall share what is sampled of the hidden scene: the whole functional is squared, and noise
    of pixels is not their share of the noise of a cell. 40 runs against 8 batches each.
    """
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(2.0, 2.0, albedo=0.7), 4, kind="confocal")
    capture = tt.nlos.CaptureRenderer(tt.scenes.nlos_z(), scan, time_axis=tt.TimeAxis(1.5, 0.05, 40), spp=16)
    with torch.no_grad():
        outs = [capture.renderer(seed=seed, spp=64, errors=True) for seed in range(40)]
    assert outs[0].differences.shape[-1] == 8
    for rows in (torch.ones(4, 1), (torch.arange(4) < 2).float()[:, None]):
        found = torch.stack([(out.transient.mean(-4) * rows).sum() for out in outs]).var()
        assert 0.3 < float(found / torch.stack([out.standard_error(rows) ** 2 for out in outs]).mean()) < 2.5


@pytest.mark.parametrize("power", [-24, 18])
def test_light_that_is_far_from_one(power):
    """Sums scale with the radiance; squares of it have no room in single precision."""
    key = "light.emitter.radiance.value"
    renderer = tt.TransientRenderer(room(), [key], spp=8, physics="ignore")
    plain = renderer.values[key].detach()
    with torch.no_grad():
        one, far = (renderer({key: plain * 10.0**n}, seed=0, errors=True).standard_error() for n in (0, power))
    assert float(far) == pytest.approx(float(one) * 10.0**power, rel=1e-4)


FILMS_OF_ROWS = {
    "rates": {"rates": tt.RateAxis(-6.0, 1.0, 12)},
    "beats": {"chirps": tt.Chirps(1e9, 1e-6, 1550e-9)},
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "errors"), [("rates", True), ("beats", "bins")])
def test_histograms_of_several_rows(name, errors):
    """Rows of a pixel see the same paths: the error of a sum over them is that of the sum."""
    scene = room("llvm_ad_mono").moving({"small-box": tt.Motion(linear=(0.0, 0.0, 2.0), angular=(0.0, 3.0, 0.0))})
    renderer = tt.TransientRenderer(scene, spp=32, physics="ignore", **FILMS_OF_ROWS[name])
    rows = renderer.film.shape[0]
    weights = torch.ones(rows, BINS, 8, 8), torch.linspace(-1, 1, rows)[:, None, None, None] * torch.ones(BINS, 8, 8)
    with torch.no_grad():
        long = torch.stack([getattr(renderer(seed=900 + k, spp=1024), name)[0] for k in range(2)]).mean(0)
        residual, estimate = np.zeros(2), np.zeros(2)
        for seed in range(40):
            out = renderer(seed=seed, errors=errors)
            for i, w in enumerate(weights):
                residual[i] += float(((getattr(out, name)[0] - long) * w).sum() ** 2)
                estimate[i] += float(out.standard_error(w) ** 2)
    assert ((residual / estimate > 0.3) & (residual / estimate < 1.9)).all()
    assert out.error_map().shape == (rows, BINS, 8, 8) and out.error_map(steady=True).shape == (8, 8)
    assert 0 < out.relative_error() < 0.2
    with pytest.raises(ShapeError, match="weights that broadcast"):
        out.standard_error(torch.ones(rows + 1, BINS, 8, 8))
