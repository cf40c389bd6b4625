"""Statistics of `cost_of_accuracy` on a renderer whose variance is known, and its arithmetic, number by number."""

import dataclasses
import math
import time

import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.accuracy.cost import Estimates, Task, cosine_over_the_window, measure
from torchtransient.accuracy.errors_of_estimates import ErrorTally, Reference, Tail
from torchtransient.accuracy.report import AccuracyReport, Choice, CostPoint
from torchtransient.errors import StorageError, UnitError

TRUTH = np.array([0.0, 4.0, 1.0, 0.25])[:, None, None]  # (C*T, H, W): a dark bin, a bright one and two dimmer ones


def synthetic(variance, salt=0):
    """Runs normal with `variance / spp` per entry where there is light."""

    def values(spp, seed):
        rng = np.random.default_rng([seed, spp, salt])
        noise = rng.normal(0, np.sqrt(variance / spp), (4, 32, 32)) * (TRUTH > 0)
        return Estimates({"transient": TRUTH + noise}, spp)

    def gradient(spp, seed):
        rng = np.random.default_rng([seed, spp, salt, 1])
        return Estimates({"key": 3.0 + rng.normal(0, np.sqrt(9 * variance / spp), 4000)}, spp)

    return {"values": Task(values, {"transient": 0}), "gradients": Task(gradient)}


SPP = (16, 64, 256, 1024)
INDEPENDENT, OTHER = Choice("independent", "box"), Choice("multijitter", "box")


@pytest.mark.parametrize("reference_spp", [None, 8192])
def test_magnitude_and_slope(reference_spp):
    report = measure({INDEPENDENT: synthetic(2.0)}, SPP, reference_spp=reference_spp, repeats=4, progress=False)
    assert report.quantities() == ["transient", "key"]
    for quantity, variance in (("transient", 2.0 * 3 / 4), ("key", 18.0)):
        points = [p for p in report.points if p.quantity == quantity]
        assert [p.spp for p in points] == list(SPP)
        for p in points:
            # the mean square of n normal deviates scatters by sqrt(2 / n); pairs or runs give at least 2 x 3072 of them
            assert abs(p.squared_error * p.spp / variance - 1) < 5 * np.sqrt(2 / 6144)
        slope = report.slope(quantity, INDEPENDENT)
        assert abs(slope.slope + 1) < 0.02
        assert slope.factor == pytest.approx(variance, rel=0.1)
    relative = [p.relative_error for p in report.points if p.quantity == "transient"]
    expected = np.sqrt(2.0 * 3 / 4 / np.array(SPP) / np.mean(TRUTH**2))
    np.testing.assert_allclose(relative, expected, rtol=0.05)
    # the median over lit bins is the bin of height 1
    median = [p.median_bin_error for p in report.points if p.quantity == "transient"]
    np.testing.assert_allclose(median, np.sqrt(2.0 / np.array(SPP)), rtol=0.1)


def drawn_gradient(draw):
    """Runs of one derivative, `draw` the noise of a run of one sample."""

    def run(spp, seed):
        return Estimates({"key": np.array([3.0 + draw(np.random.default_rng([seed, spp])) / spp**0.5])}, spp)

    return {"gradients": Task(run, tails=True)}


@pytest.mark.parametrize(("index", "reference_spp"), [(0.7, None), (1.3, None), (1.3, 8192)])
def test_a_heavy_tail_has_no_error(index, reference_spp):
    """Two pairs of runs look as precise as any."""
    task = drawn_gradient(lambda rng: 0.1 * rng.standard_t(index))
    report = measure({INDEPENDENT: task}, SPP, reference_spp=reference_spp, progress=False)
    for point in report.points:
        assert point.tail.heavy and np.isnan([point.squared_error, point.relative_error, point.median_bin_error]).all()
        assert point.seconds > 0
    assert "heavy tailed: no error" in report.table() and "nan" not in report.table()
    assert report.slope("key", INDEPENDENT) is None and np.isnan(report.gain("key", INDEPENDENT))
    assert report.to_dict()["points"][0]["relative_error"] is None


def test_runs_that_are_not_finite_have_no_error():
    """They are rare: all runs but one in thirty are fine."""
    task = drawn_gradient(lambda rng: rng.normal() if rng.random() < 0.97 else np.nan)
    report = measure({INDEPENDENT: task}, SPP[:1], progress=False)
    assert np.isnan(report.points[0].squared_error)
    assert "some are not finite" in report.table() and "nan" not in report.table()


def test_the_standard_error_of_a_derivative_is_that_of_many_runs():
    """The square of one normal deviate scatters by sqrt(2) of its mean: two pairs know their error up to its size."""
    report = measure({INDEPENDENT: drawn_gradient(lambda rng: rng.normal())}, SPP, repeats=4, progress=False)
    for point in report.points:
        assert not point.tail.heavy
        # The spread of 96 squares of normal deviates scatters by some 20 %.
        assert point.squared_error_standard_error / point.squared_error == pytest.approx(2**0.5 / 2**0.5, rel=0.6)
        assert f"+- {point.squared_error_standard_error:.1e}" in report.table()


def test_runs_take_turns_and_warm_up_is_not_timed():
    calls = []

    def task(name):
        def run(spp, seed):
            calls.append((name, spp, seed))
            time.sleep(0.5 if len([c for c in calls if c[0] == name]) == 1 else 0.0)
            return Estimates({"transient": np.random.default_rng(seed).normal(size=8)}, spp)

        return {"values": Task(run)}

    report = measure({INDEPENDENT: task("a"), OTHER: task("b")}, (4, 8), repeats=2, progress=False)
    assert [c[0] for c in calls] == ["a", "b"] * 6
    assert max(p.seconds for p in report.points) < 0.4


@pytest.mark.slow
def test_table_and_plot(tmp_path):
    report = measure({INDEPENDENT: synthetic(2.0), OTHER: synthetic(0.5, salt=3)}, SPP, repeats=2, progress=False)
    table = report.table()
    assert "transient [independent, box]" in table and "key [multijitter, box]" in table and "slope -1.0" in table
    assert np.isnan(report.points[0].squared_error_standard_error)  # a single pair has no spread
    report.plot(tmp_path / "report.png")
    assert (tmp_path / "report.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    for write in (report.to_json, report.plot):
        with pytest.raises(StorageError, match=r"the folder '.*missing' does not exist\. Create it first\.$"):
            write(tmp_path / "missing" / "file.png")


def test_noise_without_a_signal_has_no_relative_error():
    def run(spp, seed):
        sign = 1.0 if seed % 2 else -1.0
        return Estimates({"transient": np.array([sign])}, spp)

    report = measure({INDEPENDENT: {"values": Task(run)}}, (4,), repeats=2, progress=False)
    (point,) = report.points
    assert point.squared_error == 2.0 and np.isnan(point.relative_error)
    assert "nan" not in report.table() and "hides the quantity" in report.table()


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"spp": (4, 4)}, "different"),
        ({"spp": (4,), "repeats": 3}, "even"),
        ({"spp": (64,), "reference_spp": 128}, "four times"),
    ],
)
def test_errors(arguments, words):
    with pytest.raises(UnitError, match=words):
        measure({INDEPENDENT: synthetic(1.0)}, **arguments, progress=False)


# --------------------------------------------------------------------------------------------- figures of given numbers


@pytest.fixture(scope="module")
def renders():
    """One of a histogram, one of phasors."""
    scene = tt.load(tt.scenes.moving_wall(resolution=2, num_bins=64, bin_width_opl=0.05), variant="llvm_ad_mono")
    with torch.no_grad():
        return [tt.TransientRenderer(scene, spp=1, **film)(seed=0) for film in ({}, {"frequencies": [0.0, 0.4, 0.8]})]


@pytest.mark.parametrize("bins", [1, 6])
def test_default_loss_bin_by_bin(renders, bins):
    """cos(2 pi (k + 1/2) / T) for light in bin k alone, mean over pixels."""
    for k in {0, bins // 3, bins - 1}:
        cube = torch.zeros(2, bins, 3, 5)
        cube[1, k, 2, 4] = 30.0
        found = cosine_over_the_window(dataclasses.replace(renders[0], transient=cube))
        assert found.item() == pytest.approx(2.0 * math.cos(2 * math.pi * (k + 0.5) / bins), abs=1e-6)


def test_default_loss_of_phasors(renders):
    cube = torch.complex(torch.ones(1, 3, 2, 5), torch.full((1, 3, 2, 5), 7.0))
    found = cosine_over_the_window(dataclasses.replace(renders[1], phasor=cube))
    assert found.item() == pytest.approx(3.0)


@pytest.mark.parametrize("time_dim", [None, 0, -3])
def test_errors_of_given_numbers(time_dim):
    """By the formulas of the module: against two halves, their own noise taken out, and in pairs."""
    rng = np.random.default_rng(0)
    a, b, *runs = rng.normal(3.0, 1.0, (6, 4, 2, 3)).astype(np.float32).astype(float)
    bins = (lambda x: x.mean((1, 2))) if time_dim is not None else (lambda x: np.array([x.mean()]))
    for reference in (None, Reference(a, b)):
        tally = ErrorTally(time_dim, reference)
        for run in runs:
            tally.add(run)
        if reference is None:
            pairs = list(zip(runs[::2], runs[1::2], strict=True))
            squared = np.stack([bins((x - y) ** 2 / 2) for x, y in pairs])
            power = np.stack([bins(x * y) for x, y in pairs])
        else:
            squared = np.stack([bins((x - (a + b) / 2) ** 2 - (a - b) ** 2 / 4) for x in runs])
            power = np.stack([bins(a * b)] * len(runs))
        found = tally.result()
        assert found.squared == pytest.approx(squared.mean(), rel=1e-5)
        totals = squared.mean(1)
        error = totals.std(ddof=1) / len(totals) ** 0.5
        if reference is not None:
            # That of the reference: of its product with the distance of the runs, and of its own square.
            noise, distance = (a - b) ** 2 / 4, (np.mean(runs, 0) - (a + b) / 2) ** 2
            error = math.hypot(error, math.sqrt((4 * distance * noise + 4 / 3 * noise**2).sum()) / noise.size)
        assert found.squared_standard_error == pytest.approx(error, rel=1e-4) and found.comparisons == len(totals)
        assert found.relative == pytest.approx(math.sqrt(squared.mean() / power.mean()), rel=1e-5)
        of_bins = np.sqrt(np.maximum(squared.mean(0), 0) / power.mean(0))
        assert found.median_bin == pytest.approx(np.median(of_bins[power.mean(0) > 0]), rel=1e-5)


@pytest.mark.parametrize("alpha", [0.5, 1.5, 2.5, 6.0])
def test_tails_of_given_runs(alpha):
    """Distances at the quantiles of a power law, on either side of 3; Hill's index by its formula."""
    distances = (np.arange(1, 101) / 101) ** (-1 / alpha)
    runs = [np.array([3.0 + side * d], np.float32) for d in distances for side in (-1, 1)]
    found = Tail.of(runs)
    top = np.repeat(distances, 2)[:9]
    assert found.index == pytest.approx(1 / np.log(top[:8] / top[8]).mean(), rel=1e-4)
    assert found.index == pytest.approx(alpha, rel=0.5)
    assert found.largest == pytest.approx(distances[0] ** 2 / (2 * (distances**2).sum()), rel=1e-4)
    assert found.heavy == (alpha < 2)
    squared = np.repeat(distances**2, 2)
    assert found.spread == pytest.approx(squared.std(ddof=1) / squared.mean(), rel=1e-4)


def test_one_run_that_is_far_off_is_a_heavy_tail():
    runs = np.random.default_rng(0).normal(size=(96, 5)).astype(np.float32)
    assert not Tail.of(list(runs)).heavy
    runs[7] += 30
    assert Tail.of(list(runs)).heavy
    still = Tail.of([np.ones(3, np.float32)] * 96)
    assert not still.heavy and still.spread == 0


def test_few_runs_that_differ_at_all_are_a_heavy_tail():
    """A derivative that most runs do not meet: 5 of 96, each a fifth of the squared deviations."""
    runs = [np.full(3, float(n < 5), np.float32) for n in range(96)]
    assert Tail.of(runs).heavy and Tail.of(runs).index == 0


def test_no_light_at_all():
    tally = ErrorTally(0)
    for _ in range(2):
        tally.add(np.zeros((3, 2, 2)))
    found = tally.result()
    assert found.squared == 0 and math.isnan(found.relative) and math.isnan(found.median_bin)


def points(choice, figures, quantity="transient"):
    return [CostPoint(choice, quantity, spp, seconds, error, 0.0, 0.1, 0.1, 2) for spp, seconds, error in figures]


def test_gain_and_slope_of_given_points():
    first = points(INDEPENDENT, [(64, 4.0, 0.25), (16, 1.0, 1.0), (256, 16.0, 0.0625)])
    other = points(OTHER, [(16, 0.5, 0.5), (64, 4.0, 0.03125), (256, 8.0, 0.0)])
    elsewhere = points(OTHER, [(16, 9.0, 9.0)], "d loss / d x")
    report = AccuracyReport(first + other + elsewhere, "in pairs")
    assert report.quantities() == ["transient", "d loss / d x"]
    assert report.gain("transient", INDEPENDENT) == 1
    # (1 x 1) / (0.5 x 0.5) = 4 and (0.25 x 4) / (0.03125 x 4) = 8; the third one has no error to compare
    assert report.gain("transient", OTHER) == pytest.approx(math.sqrt(4 * 8))
    assert math.isnan(report.gain("transient", Choice("stratified", "box")))
    slope = report.slope("transient", INDEPENDENT)
    assert slope.slope == pytest.approx(-1) and slope.factor == pytest.approx(16)
    assert report.slope("transient", OTHER) is None  # two points with an error
    noiseless = AccuracyReport(points(INDEPENDENT, [(4, 1.0, 0.0), (8, 1.0, 1.0), (16, 1.0, 0.5), (32, 1.0, 0.25)]), "")
    assert noiseless.slope("transient", INDEPENDENT).slope == pytest.approx(-1)


def test_no_two_runs_share_a_seed():
    """Nor do those of different counts, the reference and the warm-up, however many there are."""
    calls = []

    def run(spp, seed):
        calls.append((spp, seed))
        return Estimates({"transient": np.random.default_rng(seed).normal(size=4)}, spp)

    options = {"reference_spp": 4096, "repeats": 400, "seed": 5, "progress": False}
    measure({INDEPENDENT: {"values": Task(run)}}, (4, 8, 16, 32), **options)
    counts, seeds = zip(*calls, strict=True)
    assert len(seeds) == len(set(seeds)) == 4 * 401 + 2 and min(seeds) >= 5
    assert counts.count(8) == 401 and counts.count(2048) == 2
