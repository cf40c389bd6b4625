"""Bands, fronts and recommended settings of reports whose errors are known in closed form."""

import dataclasses
import json
import math
import time

import numpy as np
import pytest

from torchtransient.accuracy import AccuracyReport
from torchtransient.accuracy.cost import Estimates, Task, measure
from torchtransient.accuracy.errors_of_estimates import Tail
from torchtransient.accuracy.report import Choice, CostPoint
from torchtransient.accuracy.statistics import student_t_quantile
from torchtransient.errors import ArgumentError, StorageError

SLOW, BIASED = Choice("independent", "box"), Choice("owen", "tent", "transient_path", 4, 0.1)
SPP = (4, 16, 64, 256)


def point(choice, spp, seconds, error, bias=None, spread=0.1, **changes):
    """Of power 1: relative and squared errors say the same. `spread`: relative standard error of the squared error."""
    total = {} if bias is None else {
        "total_squared_error": error**2 + bias**2,
        "total_squared_error_standard_error": spread * (error**2 + bias**2),
        "total_error": math.hypot(error, bias), "bias": bias,
    }  # fmt: skip
    given = {"repeats": 100, "comparisons": 50, "cpu_seconds": 2 * seconds} | total | changes
    return CostPoint(choice, "transient", spp, seconds, error**2, spread * error**2, error, error, **given)


@pytest.fixture
def report():
    """Errors of n^-1/2 in n ms, and a fifth of them with a bias of 0.1 in 5 n ms."""
    slow = [point(SLOW, n, n / 1e3, n**-0.5, bias=0.0) for n in SPP]
    return AccuracyReport(slow + [point(BIASED, n, 5 * n / 1e3, 0.2 * n**-0.5, bias=0.1) for n in SPP], "in pairs")


def test_the_quickest_setting_that_reaches_an_error(report):
    found = report.recommend(0.2)
    assert (found.choice, found.spp, found.quantity) == (BIASED, 4, "transient")
    assert found.error == pytest.approx(math.hypot(0.1, 0.1)) and found.seconds == pytest.approx(0.02)
    found = report.recommend(0.1, quantity="transient")
    # The bias alone is as large: the other one has that error at 100 samples, a power of them between its points.
    assert (found.choice, found.spp) == (SLOW, 100)
    assert found.error == pytest.approx(0.1) and found.seconds == pytest.approx(0.1)
    assert found.cpu_seconds == pytest.approx(0.2)
    factor = pytest.approx(math.exp(0.5 * 1.96 * 0.1), rel=0.01)
    assert found.error / found.low == factor and found.high / found.error == factor
    assert "independent, box, 100 spp: error 10.00%" in str(found)
    assert report.recommend(0.099).spp == 103  # 1 / 0.099^2 = 102.03


@pytest.mark.parametrize("error, spp", [(0.3, 16), (0.2, 32), (0.15, 50), (0.14, 64)])
def test_samplers_that_spread_points_get_powers_of_two(error, spp):
    """Or what was measured, where that is less; errors of n^-1/2 here."""
    report = AccuracyReport([point(Choice("owen", "box"), n, n / 1e3, n**-0.5) for n in (4, 20, 50, 64)], "")
    found = report.recommend(error)
    assert found.spp == spp and found.error == pytest.approx(spp**-0.5) and found.seconds == pytest.approx(spp / 1e3)


def test_what_no_setting_reaches(report):
    with pytest.raises(ArgumentError, match=r"got 1\.00%; the least is 6\.25%, of 256 spp \[independent, box\]\."):
        report.recommend(0.01)
    biased = AccuracyReport([p for p in report.points if p.choice == BIASED], "")
    with pytest.raises(ArgumentError, match=r"of it 10\.00% bias, which more samples do not lower"):
        biased.recommend(0.05)
    unknown = AccuracyReport([point(SLOW, 4, 1.0, math.nan)], "")
    with pytest.raises(ArgumentError, match="no curve of transient has an error that is known"):
        unknown.recommend(0.1)


@pytest.mark.parametrize("seed", range(2))
def test_the_front_is_what_nothing_beats(seed):
    rng = np.random.default_rng(seed)
    errors, seconds, biases = np.exp(rng.normal(size=(3, 40)))
    points = [
        point(Choice(f"s{k % 5}", "box"), k + 1, s, e, bias=b)
        for k, (e, s, b) in enumerate(zip(errors, seconds, biases, strict=True))
    ]
    front = AccuracyReport(points, "").pareto()
    beaten = [any(q.seconds < p.seconds and q.total_error < p.total_error for q in points) for p in points]
    assert [p.seconds for p in front] == sorted(p.seconds for p, held in zip(points, beaten, strict=True) if not held)


def test_the_error_is_at_least_that_of_the_noise():
    """Of little bias a reference says nothing, or a squared error below zero."""
    few = {"total_squared_error": -0.01, "total_squared_error_standard_error": 0.2, "total_error": 0.0}
    lucky = point(SLOW, 4, 1.0, 0.5, **few)
    assert lucky.error == 0.5
    report = AccuracyReport([lucky, point(BIASED, 4, 2.0, 0.4, bias=0.0)], "")
    assert [p.error for p in report.pareto()] == [0.5, 0.4]
    assert report.recommend(0.45).choice == BIASED and report.recommend(0.5).low > 0.4
    unknown = dataclasses.replace(lucky, squared_error=-0.01, relative_error=0.0)
    assert math.isnan(unknown.error) and dataclasses.replace(unknown, squared_error=0.0).error == 0.0


@pytest.mark.parametrize("degrees, t", [(1, 12.706), (4, 2.7764), (10, 2.2281), (math.inf, 1.95996)])
def test_quantiles_of_student(degrees, t):
    """Tables of the two-sided 95 %."""
    assert student_t_quantile(1.959964, degrees) == pytest.approx(t, rel=1e-4)


def test_bands_by_their_formula(report):
    """Factors of the squared error's relative standard error, pooled over a curve, times Student's t."""
    given = [point(SLOW, n, n, 1.0, bias=1.0, spread=s, comparisons=2, repeats=4)
             for n, s in zip((4, 16, 64), (0.1, 0.2, 0.4), strict=True)]  # fmt: skip
    few = AccuracyReport(given, "")
    pooled = math.sqrt((0.01 + 0.04 + 0.16) / 3)
    for p in few.points:
        low, high = few.band(p)
        # Three points of two comparisons each: three degrees of freedom.
        assert high == pytest.approx(1 / low) == pytest.approx(math.exp(0.5 * 3.1824 * pooled), rel=1e-3)
    low, high = few.band(few.points[0], total=True)
    assert low * high == pytest.approx(2.0) and high / low == pytest.approx(math.exp(3.1824 * 0.1), rel=1e-3)
    tail = Tail(index=3.0, largest=0.1, spread=1.4)
    one = AccuracyReport([point(SLOW, 4, 1.0, 1.0, spread=0.3, comparisons=2, tail=tail)], "")
    assert one.band(one.points[0])[1] == pytest.approx(math.exp(0.5 * 1.96 * 0.3), rel=1e-3)
    nothing = AccuracyReport([point(SLOW, 4, 1.0, 1.0, spread=math.nan)], "")
    assert np.isnan(nothing.band(nothing.points[0])).all()


def test_the_error_of_a_slope_is_that_of_the_points_where_they_scatter_less():
    """Exactly on a line: what a spread of the squared errors makes of it."""
    points = [point(SLOW, n, n, n**-0.5, spread=0.3) for n in SPP]
    slope = AccuracyReport(points, "").slope("transient", SLOW)
    u = np.log(SPP) - np.log(SPP).mean()
    assert slope.slope == pytest.approx(-1) and slope.standard_error == pytest.approx(0.3 / math.sqrt((u**2).sum()))


ENTRIES, VARIANCE = 40, 2.0


def candidate(bias=0.0, salt=0):
    """Runs normal around 3 and a bias, of variance 2 / spp."""

    def run(spp, seed):
        noise = np.random.default_rng([seed, spp, salt]).normal(0, math.sqrt(VARIANCE / spp), ENTRIES)
        return Estimates({"transient": 3.0 + bias + noise}, spp)

    return {"values": Task(run)}


@pytest.mark.parametrize("reference_spp", [None, pytest.param(4096, marks=pytest.mark.slow)])
def test_bands_hold_the_error(reference_spp):
    """Of the noise, and of noise and bias: 95 of 100, within what 200 reports can tell."""
    held = np.zeros(3)
    candidates = {SLOW: candidate(), BIASED: candidate(bias=0.2, salt=1)}
    for n in range(200):
        report = measure(candidates, (16, 64, 256), reference_spp=reference_spp, repeats=4, seed=10**4 * n,
                         progress=False, finest={"values": SLOW})  # fmt: skip
        at = [p for p in report.points if p.spp == 64]
        for k, (p, bias) in enumerate([(at[0], 0.0), (at[0], 0.0), (at[1], 0.2)]):
            low, high = report.band(p, total=k > 0)
            held[k] += low**2 < (VARIANCE / 64 + bias**2) / 9.0 < high**2
    assert (held > 180).all() and (held[:1] < 200).all()


def test_the_total_error_is_noise_and_bias():
    candidates = {SLOW: candidate(), BIASED: candidate(bias=0.2, salt=1)}
    report = measure(candidates, (16, 256), repeats=40, progress=False, finest={"values": SLOW})
    for p in report.points:
        bias = 0.2 if p.choice == BIASED else 0.0
        expected = VARIANCE / p.spp + bias**2
        assert abs(p.total_squared_error - expected) < 4 * p.total_squared_error_standard_error
        assert p.total_error == pytest.approx(math.sqrt(expected) / 3, rel=0.1)
        assert p.error == max(p.total_error, p.relative_error)
        assert p.relative_error == pytest.approx(math.sqrt(VARIANCE / p.spp) / 3, rel=0.1)
        assert p.bias == pytest.approx(bias / 3, rel=0.1)


def test_time_of_the_processor_is_told_apart():
    def run(spp, seed):
        time.sleep(0.05)
        return Estimates({"transient": np.random.default_rng(seed).normal(size=4)}, spp)

    (p,) = measure({SLOW: {"values": Task(run)}}, (4,), repeats=2, progress=False).points
    assert p.seconds >= 0.05 and p.cpu_seconds < 0.02


def test_a_file_and_back(tmp_path, report):
    still = Tail(index=math.inf, largest=0.0, spread=0.0)
    report.points.append(point(SLOW, 512, 1.0, 0.01, spread=math.nan, tail=still))
    report.settings = {"spp": [4, 16], "time_axis": None}
    report.to_json(tmp_path / "report.json")
    json.loads((tmp_path / "report.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)
    back = AccuracyReport.from_json(tmp_path / "report.json")
    assert back.table() == report.table() and back.method == "in pairs" and back.settings == report.settings
    assert back.recommend(0.15) == report.recommend(0.15)
    assert back.points[-1].tail == still and not back.points[-1].tail.heavy
    assert [p.choice for p in back.points] == [p.choice for p in report.points]


def test_files_that_are_no_reports(tmp_path):
    for text in ("{", '{"points": [{}], "method": "", "settings": {}}'):
        (tmp_path / "other.json").write_text(text)
        with pytest.raises(StorageError, match=r"expected a file of AccuracyReport\.to_json"):
            AccuracyReport.from_json(tmp_path / "other.json")


def test_files_of_earlier_versions(tmp_path, report):
    """Points without integrator, depth, bin width, total error and CPU seconds."""
    new = ("integrator", "max_depth", "bin_width_opl", "cpu_seconds", "comparisons", "bias")
    data = report.to_dict()
    data["points"] = [
        {k: v for k, v in p.items() if k not in new and "total" not in k} for p in data["points"][: len(SPP)]
    ]
    (tmp_path / "old.json").write_text(json.dumps(data))
    old = AccuracyReport.from_json(tmp_path / "old.json")
    assert old.points[0].choice == SLOW and math.isnan(old.points[0].total_error)
    assert old.recommend(0.1).spp == 100 and "slope -1.00" in old.table()
