"""Examples that train a network: each by one small run, after which it is better than what it starts from."""

from __future__ import annotations

import re

import pytest
import torch

import torchtransient as tt
from support.examples import example, measured_data, small_run


@pytest.fixture(autouse=True)
def one_thread():
    """Convolutions of this size wait for their threads more than they compute."""
    with tt.threads(1):
        yield


# ------------------------------------------------------------------------------------------- histograms and volumes


@pytest.mark.slow
def test_a_network_trained_through_fk(tmp_path):
    sizes = ("--steps", 20, "--points", 10, "--bins", 48, "--scenes", 6, "--test-scenes", 3)
    errors = small_run("denoise_before_fk", tmp_path, *sizes)
    assert errors["trained through f-k"] < 0.5 * errors["as measured"]
    assert errors["trained through f-k"] < errors["trained on transients"]


@pytest.mark.soak
def test_five_times_better_where_transients_alone_are_not(tmp_path):
    errors = example("denoise_before_fk").main(["--output", str(tmp_path)])
    assert errors["trained through f-k"] < errors["as measured"] / 5
    assert errors["trained through f-k"] < errors["blurred"] / 2


def test_captures_are_what_they_are_said_to_be():
    module = example("denoise_before_fk")
    fk = module.make_operator(12, 64)
    signal = module.bar(fk, torch.Generator().manual_seed(3))
    assert float(signal.sum()) == pytest.approx(module.SIGNAL * 12 * 12, rel=1e-5)
    captures = module.make_captures(fk, 2, torch.Generator().manual_seed(3))
    assert captures.noisy.shape == captures.volumes.shape == (2, 64, 12, 12)
    torch.testing.assert_close(captures.volumes.sum((1, 2, 3)), torch.ones(2))
    # the brightest voxel is one of the bar: 0.6 to 0.9 m before the wall
    depth = fk.depths[captures.volumes.amax((2, 3)).argmax(1)]
    assert bool(((depth > 0.55) & (depth < 0.95)).all())


@pytest.mark.slow
def test_simulated_captures_lose_their_noise(tmp_path, monkeypatch):
    monkeypatch.delenv("TORCHTRANSIENT_MEASURED_DATA", raising=False)
    (nats,) = small_run("denoise_histograms", tmp_path)
    # Neighbours in time and position each tell something. A smoke run's network has not gone past them yet.
    names = ("counts and a floor", "Gaussian over time", "... and positions")
    assert all(a > b > c for a, b, c in zip(*(nats[name] for name in names), strict=True))
    assert all(n < g for n, g in zip(nats["network"], nats["Gaussian over time"], strict=True))


def test_the_likelihood_that_is_lost():
    lost = example("denoise_histograms").lost
    mean = torch.tensor([3.0, 0.0, 1.5]).reshape(1, 1, 3, 1)
    assert lost(mean + 1e-9, mean).item() == pytest.approx(0.0, abs=1e-6)
    rate = torch.tensor([2.0, 0.5, 4.0]).reshape(1, 1, 3, 1)
    # The difference of two Poisson log-likelihoods of these counts.
    likely = [tt.losses.poisson_nll(of, mean, reduction="sum") for of in (rate, mean)]
    assert lost(rate, mean).item() == pytest.approx((likely[0] - likely[1]).item(), abs=1e-6)


def test_a_folder_without_files_is_said(tmp_path):
    with pytest.raises(tt.errors.TorchTransientError, match=r"direct_after\.mat"):
        example("denoise_histograms").measured(tmp_path)


@pytest.mark.measured
def test_measured_captures_lose_their_noise(tmp_path):
    folder, run = measured_data(), example("denoise_histograms")
    tracks = [run.measured(folder / "keyhole" / letter) for letter in "EK"]
    assert [tuple(track.shape) for track in tracks] == [(1, 1, 144, 100), (1, 1, 144, 66)]
    assert all(bool((track == track.round()).all()) for track in tracks)
    (nats,) = small_run("denoise_histograms", tmp_path, "--measured", folder)
    assert all(n < g for n, g in zip(nats["network"], nats["Gaussian over time"], strict=True))


# ------------------------------------------------------------------------------------------------- depths and speeds


@pytest.mark.parametrize(
    "way",
    [
        pytest.param([], id="on disk", marks=pytest.mark.slow),
        pytest.param(["--online"], id="online", marks=pytest.mark.soak),
    ],
)
def test_depth_from_counts(tmp_path, way):
    (errors,) = small_run("depth_from_counts", tmp_path, *way)
    # It begins as the filter that it corrects.
    assert errors["untrained"].far_off == pytest.approx(errors["matched filter"].far_off, abs=0.05)
    assert errors["network"].far_off < 0.9 * errors["matched filter"].far_off
    # What is learnt from online is on no disk.
    (folder,) = (path for path in tmp_path.iterdir() if path.is_dir())
    assert tt.data.verify(folder).samples == (4 if way else 28)


@pytest.mark.slow
def test_spad_depth_beats_the_filters_in_much_light(tmp_path):
    (errors,) = small_run("spad_depth", tmp_path, "--workers", 1)
    # At 3 photons per cycle pile-up hides most surfaces from the filter, and its correction finds them.
    assert errors["Coates + matched filter"][2] < 0.5 * errors["matched filter"][2]
    assert errors["network"][2] < 0.8 * errors["Coates + matched filter"][2]
    # A pixel of two surfaces has no depth that all could agree on.
    assert errors["all: network"][1] > errors["network"][1]


@pytest.mark.slow
def test_itof_multipath_is_taken_off(tmp_path):
    (errors,) = small_run("itof_multipath", tmp_path)
    mean, median = ({name: row[n] for name, row in errors.items()} for n in (0, 1))
    # Low frequencies suffer most; a camera in rooms without a second bounce hardly errs.
    assert mean["16 MHz alone"] > 3 * mean["three frequencies"]
    assert median["no multipath"] < 0.3 * median["three frequencies"]
    assert median["network"] < 0.8 * median["three frequencies"]
    assert mean["network"] < mean["less their bias"]


@pytest.mark.slow
def test_multipath_is_no_speed(tmp_path):
    """No network: the renderer's fit knows the speeds better than the formula."""
    (errors,) = small_run("doppler_tof", tmp_path)
    # Of 1.7 m/s (rms); the formula errs by its detours, noise or not.
    assert errors["formula without noise"] > 0.3
    assert errors["fit"] < 0.5 * min(errors[name] for name in ("formula without noise", "formula", "formula, bodies"))


# ------------------------------------------------------------------------------------ network and renderer together


@pytest.mark.soak
def test_the_renderer_corrects_the_network(tmp_path):
    module = example("amortised")
    table = small_run("amortised", tmp_path, "--seeds", 0)
    network, hybrid = table.percent(module.NETWORK), table.percent(module.HYBRID)
    assert hybrid < 0.9 * network
    assert hybrid < 0.7 * table.percent(module.BEST)
    # It ends near what the counts can say only where it starts there.
    assert table.percent("renderer from the truth, 512 spp") < 0.5 * hybrid


@pytest.mark.soak
def test_counter_and_scenes_are_learnt_together(tmp_path):
    table = small_run("self_calibration", tmp_path, "--seeds", 0)
    assert table.percent(example("self_calibration").TOGETHER) < table.percent("network, wrong counter")


@pytest.mark.slow
def test_unknowns_are_those_of_the_recipe():
    walls = example("two_walls")
    unknowns, light = walls.scenes(7, 3, 1024, "test")
    assert bool(((unknowns >= walls.LOW) & (unknowns <= walls.HIGH)).all())
    assert len(torch.unique(unknowns, dim=0)) == 3
    with torch.no_grad():
        again = walls.renderer()(walls.values_of(unknowns), spp=1024, seed=5).transient
    # The noise of both renders, some per cent of the bins with light.
    off = (again - light).abs().sum((1, 2, 3, 4)) / light.sum((1, 2, 3, 4))
    other = (again - light.roll(1, 0)).abs().sum((1, 2, 3, 4)) / light.sum((1, 2, 3, 4))
    assert float(off.max()) < 0.1
    assert float(other.min()) > 0.3


def test_responses_of_all_counters_sum_to_one():
    counters = example("unknown_counters")
    torch.manual_seed(0)
    captures = torch.rand(2, 1, 64, 8, 8)
    learnt = counters.learnable_counter(True, captures)
    for sensor in (counters.true_counter(), counters.random_counter(), learnt):
        kernel = counters.kernel_of(sensor)
        assert kernel.shape == counters.LAGS.shape
        assert float(kernel.detach().sum()) == pytest.approx(1, abs=2e-3)
        assert bool((counters.level_of(sensor) > 0).all())
    # A response that begins as a core in its place, and whose every part learns.
    assert abs(float(counters.LAGS[counters.kernel_of(learnt).argmax()])) == 0
    light = torch.rand(1, 1, 64, 8, 8)
    learnt.expected(light).square().sum().backward()
    for name, parameter in learnt.named_parameters():
        # The last layers of both networks begin at zero, and hide those before them.
        moved = not name.endswith("delay_ps") and not re.search(r"network\.[02]\.", name)
        assert (parameter.grad is not None and bool(parameter.grad.ne(0).any())) == moved, name


@pytest.mark.soak
def test_errors_are_as_low_as_said(tmp_path):
    """One seed of three; the docs have the means of three."""
    amortised = example("amortised")
    table = amortised.main(["--seeds", "1", "--output", str(tmp_path)])
    assert table.percent(amortised.HYBRID) < 0.7 * table.percent(amortised.TWICE)
    assert table.percent(amortised.HYBRID) < 0.25 * table.percent(amortised.BEST)


@pytest.mark.soak
def test_an_unknown_counter_costs_little(tmp_path):
    """One seed of three."""
    script = example("self_calibration")
    table = script.main(["--seeds", "0", "--output", str(tmp_path)])
    assert table.percent(script.TOGETHER) < 0.7 * table.percent(script.RANDOM)
    assert table.percent(script.TOGETHER) < 0.5 * table.percent(script.WRONG)
    assert table.percent(script.TOGETHER) < 1.4 * table.percent(script.TRUE)
