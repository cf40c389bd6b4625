"""Distances of records and pictures, by closed forms."""

import math
from types import SimpleNamespace

import pytest
import torch

from torchtransient import TimeAxis, losses, metrics, units
from torchtransient.errors import ArgumentError, ShapeError, UnitError

AXIS = TimeAxis(1.0, 0.02, 64)


def pulse(places, bins=64):
    """(1, T, 1, N) a photon in one bin of each pixel."""
    found = torch.zeros(1, bins, 1, len(places))
    for k, place in enumerate(places):
        found[0, place, 0, k] = 1
    return found


def test_pulses_apart():
    x, y = 3 * pulse([10, 63, 5]), 7 * pulse([13, 0, 5])
    each = metrics.histogram_wasserstein_opl(x, y, AXIS, reduction="none")
    torch.testing.assert_close(each, torch.tensor([[[3 * 0.02, 63 * 0.02, 0.0]]]))
    seconds = metrics.histogram_wasserstein_s(x, y, AXIS)
    assert float(seconds) == pytest.approx(22 * 0.02 / units.SPEED_OF_LIGHT, rel=1e-5)
    assert metrics.histogram_total_variation(x, y, reduction="none").flatten().tolist() == [1, 1, 0]
    assert metrics.histogram_kl(x, y, reduction="none").flatten().tolist() == [math.inf, math.inf, 0]
    smooth = metrics.histogram_kl(x, y, smoothing=0.64, reduction="none").flatten()
    torch.testing.assert_close(smooth, torch.tensor([-math.log(0.01), -math.log(0.01), -math.log(0.37)]))


def test_distributions_by_hand():
    x, y = torch.tensor([1.0, 1.0, 2.0, 0.0]), torch.tensor([0.0, 3.0, 3.0, 0.0])
    x, y = (one.view(1, 4, 1, 1) for one in (x, y))
    assert float(metrics.histogram_total_variation(x, y)) == pytest.approx(0.25)
    assert float(metrics.histogram_kl(x, y)) == pytest.approx(0.5 * math.log(2))
    assert float(metrics.histogram_wasserstein_opl(x, y, TimeAxis(0.0, 2.0, 4))) == pytest.approx(0.5)
    bins = torch.tensor([False, True, True, True]).view(4, 1, 1)
    assert float(metrics.histogram_total_variation(x, y, mask=bins)) == pytest.approx(1 / 6)
    half = metrics.histogram_kl(x, y, mask=bins, smoothing=1.0)
    assert float(half) == pytest.approx(math.log(1.5))


def test_as_the_loss_where_all_pixels_are_lit():
    x, y = torch.rand(2, 1, 64, 3, 4, dtype=torch.float64) + 0.1, torch.rand(2, 1, 64, 3, 4, dtype=torch.float64) + 0.1
    wanted = losses.wasserstein_loss(x, y, AXIS.bin_width_opl)
    torch.testing.assert_close(metrics.histogram_wasserstein_opl(x, y, AXIS), wanted)


def test_dark_pixels():
    x, y = torch.rand(1, 64, 2, 2) + 0.1, torch.rand(1, 64, 2, 2) + 0.1
    y[..., 0, 0] = 0
    each = metrics.histogram_total_variation(x, y, reduction="none")
    assert each.isnan().tolist() == [[[True, False], [False, False]]]
    assert float(metrics.histogram_total_variation(x, y)) == pytest.approx(float(each[each.isfinite()].mean()))
    with pytest.raises(UnitError, match="light in the input wherever the target has some, got 1 pixels"):
        metrics.histogram_kl(y, x)
    x[0, 5, 1, 1] = -1.0
    with pytest.raises(UnitError, match="negative bins, got 1"):
        metrics.histogram_kl(x, y)


def test_bins_near_the_highest_number():
    """Their sum is more than single precision holds, their shares are not."""
    x = torch.tensor([0.0, 3e38, 3e38, 3e38]).reshape(1, 4, 1, 1)
    y = torch.tensor([3e38, 3e38, 0.0, 0.0]).reshape(1, 4, 1, 1)
    for a, b in ((x, y), (x, y / 1e38), (x / 1e38, y)):
        assert metrics.histogram_total_variation(a, b).item() == pytest.approx(2 / 3)


def test_axes_and_results():
    x, y = torch.rand(1, 64, 2, 2), torch.rand(1, 64, 2, 2)
    results = [SimpleNamespace(transient=one, axis=AXIS, scan=None) for one in (x, y)]
    wanted = metrics.histogram_wasserstein_opl(x, y, AXIS)
    torch.testing.assert_close(metrics.histogram_wasserstein_opl(*results), wanted, rtol=0, atol=0)
    torch.testing.assert_close(metrics.histogram_wasserstein_opl(results[0], y), wanted, rtol=0, atol=0)
    results[1].axis = TimeAxis(0.0, 0.02, 64)
    with pytest.raises(UnitError, match="one axis"):
        metrics.histogram_total_variation(*results)
    with pytest.raises(ArgumentError, match="axis="):
        metrics.histogram_wasserstein_s(x, y)
    with pytest.raises(ShapeError, match="the 63 bins"):
        metrics.histogram_wasserstein_s(x, y, TimeAxis(0.0, 0.02, 63))
    with pytest.raises(UnitError, match="smoothing"):
        metrics.histogram_kl(x, y, smoothing=1.1)


# ----------------------------------------------------------------------------------------------------------- pictures


def test_decibels_by_hand():
    y = torch.full((2, 1, 4, 4), 0.5)
    y[:, 0, 0, 0] = 2.0
    x = y + torch.tensor([0.1, 0.01]).view(2, 1, 1, 1)
    assert metrics.psnr(x, y, value_range=10.0, reduction="item").tolist() == pytest.approx([40, 60], abs=1e-3)
    assert float(metrics.psnr(x, y, value_range=10.0)) == pytest.approx(50, abs=1e-3)
    assert float(metrics.psnr(x, y)) == pytest.approx(50 - 20 * math.log10(5), abs=1e-3)
    mask = torch.ones(2, 1, 4, 4, dtype=torch.bool)
    mask[1] = False
    mask[0, 0, 0, 0] = False
    found = metrics.psnr(x, y, value_range=10.0, mask=mask, reduction="item")
    assert float(found[0]) == pytest.approx(40, abs=1e-3) and math.isnan(float(found[1]))


def test_range_is_checked():
    y = torch.rand(1, 8, 8) + 0.1
    for function in (metrics.psnr, metrics.ssim):
        with pytest.raises(UnitError, match=r"within value_range 1\.0, got values over 255"):
            function(y, torch.full_like(y, 255.0), value_range=1.0)
        with pytest.raises(UnitError, match="over 2"):
            function(y, torch.linspace(-1, 1, 64).view(1, 8, 8), value_range=1.0)
        with pytest.raises(UnitError, match="targets with light"):
            function(y, 0 * y)
        with pytest.raises(UnitError, match="value_range"):
            function(y, y, value_range=0.0)
        with pytest.raises(ShapeError, match=r"\(\.\.\., C, Y, X\)"):
            function(y[0], y[0])
        assert math.isfinite(float(function(3 * y, y, value_range=2.0)))  # an estimate may overshoot


def test_similarity_is_that_of_the_loss():
    x, y = torch.rand(2, 3, 16, 16), torch.rand(2, 3, 16, 16)
    wanted = 1 - losses.ssim_loss(x, y)
    torch.testing.assert_close(metrics.ssim(x, y), wanted)
    torch.testing.assert_close(metrics.ssim(7 * x, 7 * y), wanted)
    rendered = SimpleNamespace(steady=x, transient=None)
    torch.testing.assert_close(metrics.ssim(rendered, y), wanted)


def test_transients_as_pictures():
    x, y = torch.rand(2, 1, 6, 8, 8), torch.rand(2, 1, 6, 8, 8)
    y[:, :, 3] = 0
    for ours, plain, options in (
        (metrics.transient_psnr, metrics.psnr, {}), (metrics.transient_ssim, metrics.ssim, {"window": 5})
    ):  # fmt: skip
        found = ours(x, y, **options)
        torch.testing.assert_close(found, plain(x.sum(2), y.sum(2), **options))
        found = ours(x, y, view="bins", reduction="item", **options)
        tops = y.amax((1, 2, 3, 4))
        assert found.shape == (2, 6)
        for k in range(2):
            bins = [plain(x[k, :, t], y[k, :, t], value_range=float(tops[k]), **options) for t in range(6)]
            torch.testing.assert_close(found[k], torch.stack(bins), rtol=1e-4, atol=1e-5)
    results = [SimpleNamespace(transient=one, axis=None) for one in (x, y)]
    torch.testing.assert_close(metrics.transient_psnr(*results), metrics.transient_psnr(x, y))
    with pytest.raises(ArgumentError, match="view"):
        metrics.transient_psnr(x, y, view="all")
    captured = SimpleNamespace(transient=x[..., 0], axis=None, scan=SimpleNamespace(shape=(8,)))
    with pytest.raises(ShapeError, match="which are pictures"):
        metrics.transient_ssim(captured, captured)
