"""The statistics of `cost_of_accuracy` on a renderer whose variance is known."""

import time

import numpy as np
import pytest

from torchtransient.accuracy.cost import Estimates, Task, measure
from torchtransient.accuracy.errors_of_estimates import ErrorTally, Reference
from torchtransient.accuracy.report import Choice
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


def test_pairs_do_not_see_a_bias_and_a_reference_does():
    tally = ErrorTally(None, None)
    rng = np.random.default_rng(0)
    runs = 1.0 + 0.3 + rng.normal(0, 0.01, (6, 5000))
    for run in runs:
        tally.add(run)
    assert tally.result().squared == pytest.approx(1e-4, rel=0.1)
    reference = Reference(*(1.0 + rng.normal(0, 0.1, (2, 5000))))
    tally = ErrorTally(None, reference)
    for run in runs:
        tally.add(run)
    # bias^2 + variance; the noise of the reference (0.005 before correction) is taken out
    assert tally.result().squared == pytest.approx(0.09 + 1e-4, abs=5 * 2 * 0.3 * np.sqrt(0.005 / 5000))


def test_runs_take_turns_and_warm_up_is_not_timed():
    calls = []

    def task(name):
        def run(spp, seed):
            calls.append((name, spp, seed))
            time.sleep(0.05 if len([c for c in calls if c[0] == name]) == 1 else 0.0)
            return Estimates({"transient": np.random.default_rng(seed).normal(size=8)}, spp)

        return {"values": Task(run)}

    report = measure({INDEPENDENT: task("a"), OTHER: task("b")}, (4, 8), repeats=2, progress=False)
    assert [c[0] for c in calls] == ["a", "b"] * 6
    assert max(p.seconds for p in report.points) < 0.04
    timed = [c for c in calls if c[0] == "a"]
    assert len({seed for _, _, seed in timed}) == len(timed)  # no two runs share a seed


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
