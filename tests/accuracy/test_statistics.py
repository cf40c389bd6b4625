"""The statistical tests: calibrated on right results, sharp on wrong ones."""

import numpy as np
import pytest
from scipy import stats

from torchtransient.accuracy import statistics as st
from torchtransient.errors import ShapeError, UnitError
from torchtransient.testing.finite_differences import central_difference


@pytest.mark.parametrize("t, dof", [(1.0, 1), (12.0, 7), (-4.0, 250), (2.2, 3.7)])
def test_student_t_deviate(t, dof):
    expected = np.copysign(-stats.norm.ppf(stats.t.sf(abs(t), dof)), t)
    np.testing.assert_allclose(st.student_t_deviate(t, dof), expected, rtol=0, atol=1e-9)


def test_scores_are_standard_normal_for_few_runs():
    runs = np.random.default_rng(1).normal(3.0, 0.2, (4, 20_000))
    result = st.z_test(runs, 3.0)
    assert abs(result.z.mean()) < 5 / np.sqrt(20_000)
    assert abs(result.z.std() - 1) < 5 / np.sqrt(2 * 20_000)
    assert stats.kstest(result.z, "norm").pvalue > 1e-3
    assert abs(result.chi2_z) < 4


def test_false_alarms_come_as_often_as_promised():
    rng = np.random.default_rng(2)
    alarms = sum(not st.z_test(rng.normal(size=(5, 50)), 0.0, alpha=0.1).passed for _ in range(600))
    assert abs(alarms - 60) < 4 * np.sqrt(60 * 0.9)


def test_two_sample_scores_and_alarms():
    rng = np.random.default_rng(3)
    a, b = rng.normal(0, 1, (6, 5000)), rng.normal(0, 3, (9, 5000))
    right = st.two_sample_z_test(a, b)
    assert right.passed and abs(right.z.std() - 1) < 0.05 and abs(right.chi2_z) < 4
    assert not st.two_sample_z_test(a, b + 30 * (np.arange(5000) == 77)).passed


def test_a_single_wrong_entry_is_found():
    runs = np.random.default_rng(4).normal(1.0, 0.01, (16, 300))
    assert st.z_test(runs, 1.0).passed
    runs[:, 123] += 0.03
    result = st.z_test(runs, 1.0)
    assert not result.passed and np.argmax(np.abs(result.z)) == 123 and "(123,)" in str(result)


def test_a_common_shift_is_seen_by_chi2():
    runs = np.random.default_rng(5).normal(1.0, 0.01, (16, 3000)) + 0.0025  # one standard error, in every entry
    result = st.z_test(runs, 1.0)
    assert result.chi2_z > 10


def test_entries_without_noise():
    runs = np.array([[1.0, 2.0, 0.0], [1.0, 2.0, 0.0], [1.0, 2.0, 0.0]])
    assert st.z_test(runs, [1.0, 2.0, 0.0]).passed
    wrong = st.z_test(runs, [1.0, 2.0, 1e-9])
    assert not wrong.passed and np.isinf(wrong.z[2])
    assert st.z_test(runs, [1.0, 2.0, 1e-9], rounding=1e-8).passed
    assert not st.z_test([[1.0, np.nan], [1.1, 1.0]], [1.05, 1.0]).passed


def test_pooling_keeps_the_energy_and_fills_every_group():
    energy = np.array([0.0, 0.0, 3.0, 0.5, 0.6, 0.0, 0.1, 5.0, 0.2, 0.0])
    starts = st.pool_small_bins(energy, 1.0)
    np.testing.assert_array_equal(starts, [0, 3, 5])
    np.testing.assert_allclose(np.add.reduceat(energy, starts), [3.0, 1.1, 5.3])
    with pytest.raises(UnitError):
        st.pool_small_bins(energy, 100.0)
    with pytest.raises(ShapeError):
        st.pool_small_bins(energy[None], 1.0)


def test_variance_slope():
    rng = np.random.default_rng(6)
    spp = np.array([4, 16, 64, 256, 1024])
    mse = [np.mean((rng.normal(0, 2.0, (200, n)).mean(axis=1)) ** 2) for n in spp]
    line = st.log_log_slope(spp, mse)
    # the variance of each mse is 2/200 of its square: an error of 0.1 in log y over a spread of 2.77^2 * 10 / 2
    assert abs(line.slope + 1) < 4 * 0.1 / np.sqrt(np.sum((np.log(spp) - np.log(spp).mean()) ** 2))
    assert 3.0 < line.factor < 5.3
    exact = st.log_log_slope([1, 10, 100], [5, 0.5, 0.05])
    np.testing.assert_allclose([exact.slope, exact.factor, exact.standard_error], [-1, 5, 0], atol=1e-12)


def test_central_difference_cancels_common_noise():
    def render(x, seed):
        noise = np.random.default_rng(seed).normal(size=3)
        return np.sin(x) + 100 * noise + 0.01 * x * noise

    derivative = central_difference(render, 0.5, 1e-2, range(8))
    assert derivative.mean.shape == (3,)
    truncation = 1e-4 / 6
    assert np.all(np.abs(derivative.mean - np.cos(0.5)) < 5 * derivative.standard_error + truncation)
    assert np.all(derivative.standard_error < 0.01)
    gradients = np.cos(0.5) + 0.01 * np.random.default_rng(99).normal(size=(8, 3))
    assert derivative.compare(gradients, rounding=truncation).passed
    assert not derivative.compare(gradients + 0.1).passed


def test_richardson_cancels_the_second_order():
    plain = central_difference(lambda x, _: x**3, 1.0, 0.1, [0, 1])
    better = central_difference(lambda x, _: x**3, 1.0, 0.1, [0, 1], richardson=True)
    np.testing.assert_allclose(plain.mean, 3.01, rtol=1e-12)
    np.testing.assert_allclose(better.mean, 3.0, rtol=1e-12)


@pytest.mark.parametrize(
    "call, error",
    [
        (lambda: st.z_test(np.zeros((3, 4)), np.zeros(5)), ShapeError),
        (lambda: st.log_log_slope([1, 2], [1, 2]), ShapeError),
        (lambda: central_difference(lambda x, _: x, 1.0, 0.1, [0, 0]), UnitError),
    ],
)
def test_errors(call, error):
    with pytest.raises(error):
        call()
