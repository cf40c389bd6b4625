"""`renderer.to_tolerance`: the mean of numbered passes, its error, and when it ends."""

import math
import pickle
import time

import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.errors import ArgumentError

VARIANT = "llvm_ad_rgb"
KEY = "red.reflectance.value"
SPP = 16


@pytest.fixture(scope="module")
def scene():
    return tt.load(tt.scenes.cornell_box(8, num_bins=60, bin_width_opl=0.1), variant=VARIANT)


@pytest.fixture(scope="module")
def renderer(scene):
    return tt.TransientRenderer(scene, [KEY], physics="ignore")


def to_tolerance(renderer, values=None, **settings):
    return renderer.to_tolerance(values, **{"rtol": 0.5, "batch_spp": SPP, "progress": False, **settings})


@pytest.fixture(scope="module")
def result(renderer):
    return to_tolerance(renderer, seed=3)


@pytest.fixture(scope="module")
def passes(renderer, result):
    """The passes of the result, rendered one by one; channels averaged in the second array."""
    with torch.no_grad():
        outs = [renderer(seed=seed, spp=SPP) for seed in result.output.stats.seeds]
    return outs, np.stack([out.transient.double().mean(0).numpy() for out in outs])


def near_mean(values):
    """Mean over 3 x 3 x 3 neighbours that exist."""
    padded = np.pad(values, 1, constant_values=np.nan)
    shifts = [padded[i : i + values.shape[0], j : j + values.shape[1], k : k + values.shape[2]]
              for i in range(3) for j in range(3) for k in range(3)]  # fmt: skip
    return np.nanmean(shifts, axis=0)


def same_mean(a, b):
    return torch.allclose(a.output.transient, b.output.transient, rtol=1e-5, atol=1e-9)


def test_it_is_the_mean_of_its_passes(result, passes):
    outs, _ = passes
    assert result.passes == len(outs) == len(set(result.output.stats.seeds))
    mean = torch.stack([out.transient.double() for out in outs]).mean(0)
    steady = torch.stack([out.steady.double() for out in outs]).mean(0)
    assert torch.allclose(result.output.transient.double(), mean, rtol=1e-4, atol=1e-9)
    assert torch.allclose(result.output.steady.double(), steady, rtol=1e-4)
    assert result.output.transient.dtype == torch.float32 and not result.output.transient.requires_grad
    assert result.output.axis == outs[0].axis and result.output.channels == outs[0].channels
    stats = result.output.stats
    assert stats.spp == result.spp == SPP * result.passes
    assert 0 < stats.seconds <= result.seconds
    assert np.allclose(result.output.outside, np.mean([out.outside for out in outs], axis=0), rtol=0.1)


def test_the_error_is_the_formula(result, passes):
    _, cubes = passes
    n = len(cubes)
    variance, even, odd = cubes.var(0, ddof=1), cubes[::2].var(0, ddof=1), cubes[1::2].var(0, ddof=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        freedom = 2 * near_mean((even + odd) ** 2) / near_mean((even - odd) ** 2)
    freedom = np.clip(np.nan_to_num(freedom, nan=n - 1, posinf=n - 1), 1, n - 1)
    moderated = (freedom * variance + 8 * near_mean(variance)) / (freedom + 8)
    assert np.allclose(result.standard_error.numpy(), np.sqrt(moderated / n), rtol=1e-3, atol=1e-9)
    mean = near_mean(cubes.mean(0))
    lit = mean > 0.02 * cubes.mean(0).mean()
    errors = np.sqrt(moderated / n)[lit] / mean[lit]
    assert result.error >= 0.999 * np.quantile(errors, 0.9, method="lower")
    assert result.reached and result.error <= 0.5 and not result.heavy_tailed
    assert str(result.passes) in result.reason


@pytest.mark.parametrize("spp", [1, 9])
def test_resuming_is_one_go(renderer, result, spp):
    """Cut anywhere, the passes and the looks are those of one go."""
    part = to_tolerance(renderer, seed=3, max_spp=SPP * spp)
    assert not part.reached and part.passes == spp and "max_spp" in part.reason
    again = to_tolerance(renderer, seed=3, resume=pickle.loads(pickle.dumps(part)))
    assert again.passes == result.passes and again.reached
    assert same_mean(again, result)
    assert again.output.stats.seeds == result.output.stats.seeds
    assert again.error == pytest.approx(result.error, rel=1e-4)
    assert part.passes == spp  # as it was


def test_time_ends_it(renderer):
    begin = time.perf_counter()
    part = to_tolerance(renderer, rtol=1e-4, max_seconds=0.5)
    assert time.perf_counter() - begin < 10
    assert not part.reached and part.passes >= 1 and "max_seconds" in part.reason
    # A pass is made in any case, and of a single one no error is known.
    least = to_tolerance(renderer, max_seconds=1e-9)
    assert least.passes == 1 and least.error == math.inf and bool(torch.isinf(least.standard_error).all())
    assert to_tolerance(renderer, max_seconds=1e-9, resume=least).passes >= 1


class Interrupted:
    """A loss, the energy, which is interrupted at a pass once."""

    def __init__(self, at):
        self.left = at

    def __call__(self, out):
        self.left -= 1
        if self.left == 0:
            raise KeyboardInterrupt
        return out.transient.sum()


def test_an_interrupt_keeps_what_there_is(renderer):
    loss = Interrupted(5)
    part = to_tolerance(renderer, rtol=0.03, on=loss)
    assert not part.reached and part.passes == 4 and "interrupted" in part.reason
    again, whole = to_tolerance(renderer, rtol=0.03, on=loss, resume=part), to_tolerance(renderer, rtol=0.03, on=energy)
    assert again.passes == whole.passes and same_mean(again, whole)
    with pytest.raises(KeyboardInterrupt):
        to_tolerance(renderer, on=Interrupted(1))


def energy(out):
    return out.transient.sum()


def test_a_loss(renderer):
    result = to_tolerance(renderer, rtol=0.02, on=energy)
    with torch.no_grad():
        values = [energy(renderer(seed=seed, spp=SPP)).item() for seed in result.output.stats.seeds]
    error = np.std(values, ddof=1) / math.sqrt(len(values)) / np.mean(values)
    assert result.reached and result.error == pytest.approx(error, rel=1e-3)
    # A variance of few values is hardly known: it has to be the smaller, the fewer there are.
    assert result.error < 0.95 * 0.02
    lit = to_tolerance(renderer, rtol=0.02, on=lambda out: float(out.steady[0, 4, 4]))
    assert lit.passes > result.passes


def test_a_mask(renderer, result):
    steady = torch.zeros(8, 8, dtype=torch.bool)
    steady[4, 4] = True
    first = torch.zeros(60, 1, 1, dtype=torch.bool)
    first[20:30] = True
    channels = torch.zeros(3, 60, 8, 8, dtype=torch.bool)
    channels[1, 20:30] = True
    of_bins, of_channels = (to_tolerance(renderer, on=mask) for mask in (first, channels))
    assert of_bins.error == pytest.approx(of_channels.error) and of_bins.passes == of_channels.passes
    assert to_tolerance(renderer, on=steady.numpy()).reached
    # Bins that see no light are left out, and alone they are no light.
    before = torch.arange(60).reshape(60, 1, 1) < 2
    dark = to_tolerance(renderer, on=before)
    assert not dark.reached and math.isnan(dark.error) and "no light" in dark.reason and dark.passes <= 128


def test_phasors(scene):
    renderer = tt.TransientRenderer(scene, frequencies=[0.0, 0.2, 0.5], physics="ignore")
    result = to_tolerance(renderer, rtol=0.2)
    with torch.no_grad():
        runs = np.stack([renderer(seed=s, spp=SPP).phasor.mean(0).numpy() for s in result.output.stats.seeds])
    assert result.reached and result.output.phasor.dtype == torch.complex64
    assert np.allclose(result.output.phasor.mean(0).numpy(), runs.mean(0), rtol=1e-3, atol=1e-6)
    error = runs.std(0, ddof=1) / math.sqrt(len(runs))  # of complex numbers: the root of both parts' variances
    assert result.standard_error.square().mean().item() == pytest.approx(np.square(error).mean(), rel=0.1)
    assert not result.standard_error.is_complex() and result.standard_error.shape == (3, 8, 8)


def test_batches(renderer):
    """Each entry counts its own bins with light, a dim one like a bright one. Passes have no gradient."""
    values = {KEY: torch.tensor([[0.6, 0.1, 0.1], [0.0, 0.0, 0.0]], requires_grad=True)}
    result = to_tolerance(renderer, values)
    assert result.output.transient.shape == (2, 3, 60, 8, 8) and result.standard_error.shape == (2, 60, 8, 8)
    assert not result.output.transient.requires_grad
    assert result.output.transient[1].sum() < result.output.transient[0].sum()
    assert len(result.output.stats.seeds) == 2 * result.passes == len(set(result.output.stats.seeds))
    with pytest.raises(ArgumentError, match="same values"):
        to_tolerance(renderer, {KEY: torch.zeros(2, 3)}, resume=result)


def test_a_loss_with_a_heavy_tail(renderer):
    """One pass with most of the squared deviations: twice as many do not help, and it ends by itself."""

    def outlier(out):
        return next(numbers)

    numbers = iter([1.0, 1.01, 0.99, 1.0, 3.0] + [1.0, 1.01, 0.99] * 200)
    result = to_tolerance(renderer, rtol=0.1, on=outlier, max_spp=SPP * 500)
    met = next(look.passes for look in result.looks if look.small)
    assert result.error < 0.1 and result.heavy_tailed and not result.reached
    assert result.reason.startswith("heavy tailed") and 2 * met <= result.passes < 4 * met
    # Asked again, it goes on.
    again = to_tolerance(renderer, rtol=0.1, on=outlier, resume=result, max_spp=result.spp + 40 * SPP)
    assert again.passes > result.passes


def test_going_on_for_other_bins(renderer, result):
    """Sums are of all bins: another mask, or all bins after a loss, need no new passes."""
    late = torch.arange(60).reshape(60, 1, 1) > 25
    other = to_tolerance(renderer, seed=3, resume=result, on=late, max_spp=result.spp)
    assert other.passes == result.passes and other.error != result.error and same_mean(other, result)
    of_loss = to_tolerance(renderer, seed=3, on=energy, max_spp=SPP * result.passes, rtol=0.001)
    assert of_loss.passes == result.passes
    assert to_tolerance(renderer, seed=3, resume=of_loss).error == pytest.approx(result.error, rel=1e-4)


@pytest.mark.slow
def test_errors_are_calibrated(scene):
    """Against a long reference squared deviations are what they are said to be, and 90 % of the bins keep to rtol."""
    renderer = tt.TransientRenderer(scene, physics="ignore")
    with torch.no_grad():
        truth = renderer(spp=2**16, seed=77).transient.double().mean(0).numpy()
    found = [to_tolerance(renderer, seed=seed) for seed in range(100, 106)]
    assert all(one.reached for one in found)
    cubes = np.stack([one.output.transient.double().mean(0).numpy() for one in found])
    errors = np.stack([one.standard_error.double().numpy() for one in found])
    mean = near_mean(truth)
    lit = mean > 0.02 * truth.mean()
    squares = (cubes - truth) ** 2
    assert squares[:, lit].mean() / (errors**2)[:, lit].mean() == pytest.approx(1.0, abs=0.4)
    assert np.mean(np.sqrt(squares.mean(0))[lit] / mean[lit] <= 0.5) > 0.85
    energies = cubes.sum((1, 2, 3)) / truth.sum() - 1
    assert abs(energies.mean()) < 4 * energies.std(ddof=1) / math.sqrt(6)
