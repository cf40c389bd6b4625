"""What losses make of numbers that can be counted by hand, at the ends of what they take."""

from __future__ import annotations

import dataclasses
import warnings
from types import SimpleNamespace

import pytest
import torch

from torchtransient import FrequencyAxis, TimeAxis, losses
from torchtransient.errors import ShapeError, TorchTransientWarning, UnitError
from torchtransient.floating import is_true
from torchtransient.losses import phasors as losses_of_phasors
from torchtransient.losses.comparison import check_level
from torchtransient.losses.dead_time_likelihoods import armed_periods
from torchtransient.losses.likelihoods import LEAST_MEAN
from torchtransient.losses.mesh_smoothness import _edges
from torchtransient.losses.results import _same_axis
from torchtransient.losses.surface_distance import _middles
from torchtransient.losses.triangles import SHARPEST
from torchtransient.reconstruction.hidden_volume import HiddenVolume
from torchtransient.reconstruction.voxels import VoxelGrid


def volume(planes, depth=1.0):
    grid = VoxelGrid.bounds([[-1, -1, 0.5], [1, 1, 0.5 + depth]], (4, 5, planes))
    return HiddenVolume(torch.rand(1, planes, 5, 4, generator=torch.Generator().manual_seed(0)), grid, "f-k migration")


@pytest.mark.parametrize("planes", [1, 2, 3])
def test_volumes_of_few_planes(planes):
    """Two planes are evenly spaced, whatever lies between them, and one plane has no spacing: voxels are cubes then."""
    given = volume(planes)
    spacing = (1.0 / planes if planes > 1 else 0.4, 0.4, 0.5)
    expected = losses.total_variation(given.values, spacing=spacing)
    torch.testing.assert_close(losses.total_variation(given), expected)
    if planes == 3:
        uneven = dataclasses.replace(given.grid, depths=given.grid.depths + torch.tensor([0.0, 0.0, 1e-3]))
        with pytest.raises(ShapeError, match="evenly spaced planes"):
            losses.total_variation(dataclasses.replace(given, grid=uneven))


@pytest.mark.parametrize("cells", [1, 2, 5])
def test_middles_of_the_parts_of_a_triangle(cells):
    """As many as there are parts, the same whichever corner comes first, and exact for what is linear."""
    weights = _middles(cells)
    assert weights.shape == (cells**2, 3) and bool((weights > 0).all())
    torch.testing.assert_close(weights.sum(1), torch.ones(cells**2, dtype=torch.float64))
    torch.testing.assert_close(weights.mean(0), torch.full((3,), 1 / 3, dtype=torch.float64))
    rows = {tuple(row) for row in (weights * 3 * cells).round(decimals=6).tolist()}
    assert rows == {(b, c, a) for a, b, c in rows} == {(b, a, c) for a, b, c in rows}
    # Parts are upright or turned: their middles are whole thirds of a cell.
    assert all(float(x).is_integer() for row in rows for x in row)


def test_the_root_of_counts_has_no_gradient():
    """bin sum |C| / sqrt(n): by the target, that of the running sum alone."""
    a = torch.tensor([1.0, 0.0, 5.0]).reshape(1, 3, 1, 1)
    b = torch.tensor([4.0, 8.0, 4.0]).reshape(1, 3, 1, 1).requires_grad_()
    found = losses.cumulative_loss(a, b, 0.5, per_root_count=True, dim=-3)
    # running sums of the difference: -3, -11, -10, over the root of 16
    assert found.item() == pytest.approx(0.5 * 24 / 4)
    found.backward()
    torch.testing.assert_close(b.grad.flatten(), torch.tensor([3.0, 2.0, 1.0]) * 0.5 / 4)


def phasors(frequencies, start):
    axis = FrequencyAxis(frequencies, start)
    return SimpleNamespace(
        transient=None, gated=None, steady=None, axis=None, frequencies=axis, phasor=torch.ones(1, 2, 2, 2) + 0j
    )


@pytest.mark.parametrize(("frequencies", "shift", "one"), [((0.5, 900.0), 1e-4, False), ((1e-4, 1e-3), 0.5, True)])
def test_starts_of_frequency_axes_are_told_apart_by_phase(frequencies, shift, one):
    """What a start turns is the start times the highest frequency, in cycles."""
    a, b = phasors(frequencies, 1.0), phasors(frequencies, 1.0 + shift)
    if one:
        assert losses.phasor_loss(a, b).item() == 0
        return
    with pytest.raises(UnitError, match="one axis"):
        losses.phasor_loss(a, b)


def test_predictions_that_are_whole_here_and_there_are_no_counts():
    """A model that is dark in most bins: every bin is looked at before anybody is warned."""
    model = torch.zeros(4, 1, 64, 8, 8)
    model[..., 1::2] = 0.37
    target = torch.rand(model.shape) + 0.5
    with warnings.catch_warnings():
        warnings.simplefilter("error", TorchTransientWarning)
        losses.poisson_nll(model.clamp_min(1e-6), target)
        losses.poisson_nll(model, target, floor=1e-3)
    with pytest.warns(TorchTransientWarning, match="holds counts"):
        losses.poisson_nll((10 * model).round(), target, floor=1e-3)


@pytest.mark.parametrize("spacing", [(0.1, 0.5, 0.2), (0.4, 0.2, 0.1), (0.3, 0.2, 0.7)])
def test_smoothing_that_is_not_given(spacing):
    """A thousandth of the mean modulus of each volume over the smallest spacing."""
    both = torch.rand(2, 4, 5, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    both[1] *= 30
    found = losses.total_variation(both, spacing=spacing, reduction="none")
    for volume, own in zip(both, found, strict=True):
        given = 1e-3 * float(volume.mean()) / min(spacing)
        wanted = losses.total_variation(volume, spacing=spacing, smoothing=given, reduction="none")
        torch.testing.assert_close(own, wanted, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("other", "one"),
    [
        (TimeAxis(1.0, 0.1, 10), True),
        (TimeAxis(1.00005, 0.1, 10), True),
        (TimeAxis(1.0, 0.101, 10), False),  # ends later
        (TimeAxis(0.99, 0.101, 10), False),  # begins sooner, ends alike
        (TimeAxis(1.01, 0.1, 10), False),
        (TimeAxis(1.0005, 0.1, 10), False),
        (TimeAxis(1.0, 0.1, 11), False),
        (TimeAxis(1.0, 1.0 / 11, 11), False),  # as long, in other bins
    ],
)
def test_axes_that_are_one(other, one):
    """Start, end and number of bins, each to a thousandth of a bin."""
    cubes = [torch.rand(1, axis.num_bins, 2, 2) for axis in (TimeAxis(1.0, 0.1, 10), other)]
    a, b = (
        SimpleNamespace(transient=cube, phasor=None, gated=None, steady=None, frequencies=None, gates=None, axis=axis)
        for cube, axis in zip(cubes, (TimeAxis(1.0, 0.1, 10), other), strict=True)
    )
    if one:
        assert losses.wasserstein_loss(a, b).item() > 0
    else:
        with pytest.raises((UnitError, ShapeError), match=r"one axis|shape"):
            losses.wasserstein_loss(a, b)


@pytest.mark.parametrize("corner", [0, 1, 2])
@pytest.mark.parametrize("short", [1e-3, 1e-12])
def test_cotangents_of_sides_of_all_lengths(corner, short):
    """An angle of 45 degrees between a short side and one of 1: of a triangle whose area is less than a limit, over the
    longest side squared, the limit takes its place. In any unit.
    """
    index = torch.tensor([[0, 1, 2]]).roll(corner, 1)
    for unit in (1e-9, 1.0, 1e9):
        places = unit * torch.tensor([[0.0, 0, 0], [short, 0, 0], [1, 1, 0]], dtype=torch.float64)
        first, second, weight = _edges(places, index, "cotangent")
        opposite = (first == 1) & (second == 2)
        assert weight[opposite].item() == pytest.approx(min(1.0, short / SHARPEST))


def test_counts_in_the_dark_have_the_gradient_of_the_tangent():
    """n log m goes on below a level l as n (log l + (m - l) / l): by n, at m = 0, that is log l - 1. The level follows
    the counts, without gradient.
    """
    mean = torch.zeros(1, 4, 1, 1, dtype=torch.float64, requires_grad=True)
    counts = torch.tensor([1.5, 2.0, 3.5, 8.0], dtype=torch.float64).reshape(1, 4, 1, 1).requires_grad_()
    losses.poisson_nll(mean, counts, reduction="sum").backward()
    torch.testing.assert_close(counts.grad, 1 - (LEAST_MEAN * counts.detach()).log())
    torch.testing.assert_close(mean.grad, torch.full_like(mean, 1 - 1 / LEAST_MEAN))


def test_the_range_of_a_target_has_no_gradient():
    """A range that is not given is the largest modulus of each target, and held fixed: as one that is given."""
    generator = torch.Generator().manual_seed(3)
    a, b = (torch.rand(2, 1, 9, 9, dtype=torch.float64, generator=generator) for _ in range(2))
    b[1] *= 7
    peaks = b.abs().amax((-3, -2, -1), keepdim=True)
    slopes = []
    for value_range in (None, peaks):
        target = b.clone().requires_grad_()
        losses.ssim_loss(a, target, window=3, value_range=value_range).backward()
        slopes.append(target.grad)
    torch.testing.assert_close(*slopes, rtol=1e-9, atol=1e-12)


def test_what_cannot_be_looked_at_for_another_reason_is_an_error():
    """Out of memory, say: in `torch.vmap` alone a question is left open."""

    class Condition:
        is_meta = False

        def all(self):
            raise RuntimeError(self.words)

    condition = Condition()
    condition.words = "vmap: it looks like you are calling .item() on a Tensor"
    assert is_true(condition)
    condition.words = "not enough memory"
    with pytest.raises(RuntimeError, match="not enough memory"):
        is_true(condition)


def test_histograms_of_detectors_that_run_free():
    """Of (2, 0, 1) in 10 periods, dead for 1.5 bins: the rest of the bin, the next, and a part of the one behind."""
    counts = torch.tensor([2.0, 0.0, 1.0], dtype=torch.float64).reshape(3, 1, 1)
    found = armed_periods(counts, 10, 1.5).flatten().tolist()
    y = (torch.arange(10_000, dtype=torch.float64) + 0.5) / 10_000
    wanted = [10.0] * 3
    for k, n in ((0, 2.0), (2, 1.0)):
        for ahead in range(4):
            shut = (torch.clamp(y + 1.5 - ahead, 0, 1) - torch.clamp(y - ahead, 0, 1)).mean().item()
            wanted[(k + ahead) % 3] -= n * shut
    assert found == pytest.approx(wanted, abs=1e-3)
    with pytest.raises(ShapeError, match=r"armed_periods: expected counts \(\.\.\., T, H, W\), got \(3, 1\)"):
        armed_periods(counts[..., 0], 10, 1.5)
    with pytest.raises(UnitError, match="armed_periods: expected counts, got complex numbers"):
        armed_periods(counts + 0j, 10, 1.5)


def test_frequencies_that_are_none():
    with pytest.raises(UnitError, match="TransientPhasorLoss: expected frequencies, a FrequencyAxis, got 2"):
        losses.TransientPhasorLoss(frequencies=20e6)


def test_axes_of_two_kinds_are_two():
    """And so are those of other numbers of frequencies."""
    time, two, three = TimeAxis(0.0, 0.1, 2), FrequencyAxis((1.0, 2.0), 0.0), FrequencyAxis((1.0, 2.0, 3.0), 0.0)
    for a, b in ((time, two), (two, time), (two, three), (three, two)):
        assert not _same_axis(a, b)
    for one in (time, two, three):
        assert _same_axis(one, dataclasses.replace(one))


def test_how_many_counts_fit_into_periods():
    """100 detections that are dead for a whole period each: 61 more than there are is noise, 63 more are not."""
    counts = torch.tensor([100.0, 0.0, 0.0], dtype=torch.float64).reshape(1, 3, 1, 1)
    rate = torch.full_like(counts, 0.3)
    assert losses.free_running_nll(rate, counts, periods=39, dead_bins=3.0, dim=-3).isfinite()
    with pytest.raises(UnitError, match="fit into"):
        losses.free_running_nll(rate, counts, periods=37, dead_bins=3.0, dim=-3)


def test_numbers_at_the_ends_of_a_precision():
    """Its largest and its least normal number are taken, what is beyond them is not; zero where it is allowed."""
    like = torch.ones(2)
    limits = torch.finfo(torch.float32)
    for value in (limits.max, limits.tiny):
        for given in (value, torch.tensor(value)):
            assert float(check_level("floor", given, like, "here")) == value
    for value in (float("inf"), limits.tiny / 2, 0.0, -1.0):
        for given in (value, torch.tensor(value)):
            with pytest.raises(UnitError, match="floor"):
                check_level("floor", given, like, "here")
    assert float(check_level("floor", torch.tensor(0.0), like, "here", zero=True)) == 0


def test_frequencies_that_bins_just_tell():
    """One wavelength of two bins, to a rounding."""
    axis = TimeAxis(0.0, 0.3, 4)
    most = 0.5 / axis.bin_width_opl * (1 + losses_of_phasors._ROUNDING)
    assert losses_of_phasors._check_axes(axis, FrequencyAxis((-most,), 0.0), "here")[0] == axis
    with pytest.raises(UnitError, match="a wavelength of two bins at least"):
        losses_of_phasors._check_axes(axis, FrequencyAxis((0.0, 1.00001 * most), 0.0), "here")
