"""Range and speed from the beats of two chirps, folded and not, with and without noise."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchtransient import Chirps, TimeAxis
from torchtransient.errors import ShapeError
from torchtransient.sensing import BeatNoise, Compose, Speckle, fold_beats, range_and_speed

WINDOWS = ["rectangular", "hann", "hamming", "blackman", "blackmanharris", "nuttall"]


def chirps_of(window="hann"):
    return Chirps(1e9, 10e-6, 1550e-9, window=window)


def line(chirps, axis, opl):
    """Shares of bins of a single line, (T,)."""
    return torch.from_numpy(np.diff(chirps.line_shape.shifted(opl).cumulative(axis.edges_opl.numpy())))


def pair(chirps, axis, distance, speed):
    """Up and down spectra of surfaces, (2, T, 1, N): distances in metres, speeds of approach in m/s."""
    rows = []
    for sign in (1, -1):
        places = 2 * np.asarray(distance) - sign * chirps.rate_scale_s * 2 * np.asarray(speed)
        rows.append(torch.stack([line(chirps, axis, float(place)) for place in places], -1))
    return torch.stack(rows).unsqueeze(-2)


DISTANCE, SPEED = [3.217, 12.9, 5.0, 0.6], [1.83, -2.71, 0.0, 3.9]


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize("parts", [1, 2, 4])
def test_one_surface_to_a_tenth_of_a_millimetre(window, parts):
    """Lines of 0.15 m of distance, 0.08 m/s of speed."""
    chirps = chirps_of(window)
    axis = chirps.time_axis((0.5, 13.0), (-4.0, 4.0), bins_per_line=parts)
    found, approach = range_and_speed(5 * pair(chirps, axis, DISTANCE, SPEED), chirps, axis)
    assert found.shape == approach.shape == (1, 4)
    np.testing.assert_allclose(found[0], DISTANCE, atol=1e-4)
    np.testing.assert_allclose(approach[0], SPEED, atol=1e-4)


@pytest.mark.parametrize(("parts", "bins"), [(1, 1 / 20), (2, 1 / 40), (4, 1 / 150)])
def test_samples_of_a_spectrum(parts, bins):
    """Of a transform, which has values at frequencies in place of averages over bins."""
    chirps = chirps_of()
    axis = chirps.time_axis((1.0, 3.0), bins_per_line=parts)
    places = 4.0 + np.linspace(0, axis.bin_width_opl, 21)
    small = 1e-3 * axis.bin_width_opl
    sampled = []
    for place in places:
        edges = axis.centers_opl.numpy()[:, None] + np.array([-small, small])
        sampled.append(np.diff(chirps.line_shape.shifted(place).cumulative(edges))[:, 0])
    beats = torch.from_numpy(np.stack(sampled, -1))[None, :, None].expand(2, -1, -1, -1)
    found, _ = range_and_speed(beats, chirps, axis)
    error = np.abs(2 * found[0].numpy() - places).max() / axis.bin_width_opl
    assert 0.5 * bins < error < bins
    found, _ = range_and_speed(beats, chirps, axis, bins="samples")
    np.testing.assert_allclose(2 * found[0], places, atol=2e-3 * axis.bin_width_opl)


def test_gradient_follows_the_line():
    """d distance of the power that moves a line by one part of a bin."""
    chirps = chirps_of()
    axis = chirps.time_axis((0.5, 4.0), (-1.0, 1.0))
    step = 1e-4
    before, after = (pair(chirps, axis, [2.03 + d], [0.4]) for d in (-step, step))
    middle = pair(chirps, axis, [2.03], [0.4]).requires_grad_()
    found, speed = range_and_speed(middle, chirps, axis)
    (to_distance,) = torch.autograd.grad(found.sum(), middle, retain_graph=True)
    (to_speed,) = torch.autograd.grad(speed.sum(), middle)
    slope = (after - before) / (2 * step)
    # The table is linear between its values: the derivative is that of a step of it.
    assert (to_distance * slope).sum().item() == pytest.approx(1.0, abs=0.01)
    assert (to_speed * slope).sum().item() == pytest.approx(0.0, abs=0.01)


def test_symmetric_lines_have_a_gradient():
    chirps = chirps_of()
    axis = chirps.time_axis((0.5, 4.0), (-1.0, 1.0))
    beats = torch.zeros(2, axis.num_bins, 1, 1, dtype=torch.float64)
    beats[:, 7:10] = torch.tensor([0.3, 1.0, 0.3], dtype=torch.float64).view(3, 1, 1)
    beats.requires_grad_()
    (found,) = torch.autograd.grad(range_and_speed(beats, chirps, axis)[0].sum(), beats)
    leaning = beats.detach().clone()
    leaning[:, 9] += 1e-6
    step = (range_and_speed(leaning, chirps, axis)[0] - range_and_speed(beats, chirps, axis)[0]) / 1e-6
    assert found[:, 9].sum().item() == pytest.approx(step.item(), rel=1e-4)


def test_nothing_is_nan():
    chirps = chirps_of()
    axis = chirps.time_axis((0.5, 4.0), (-1.0, 1.0))
    beats = pair(chirps, axis, [2.0, 3.0, 3.0, 2.0], [0.0] * 4)
    beats[..., 1] = 0
    beats[0, ..., 2] *= 0.01
    beats[1, 3, 0, 3] = math.nan
    for found in range_and_speed(beats, chirps, axis, threshold=0.05):
        assert found.isnan().tolist() == [[False, True, True, True]]


def test_noisy_spectra_know_the_speed():
    """A thousand photons, four looks: a fraction of a line."""
    chirps = chirps_of()
    axis = chirps.time_axis((0.5, 8.0), (-4.0, 4.0))
    beats = pair(chirps, axis, [3.217] * 200, [1.83] * 200)
    measured = Compose([Speckle(4), BeatNoise(1000.0, 4)]).sample(beats[None], torch.Generator().manual_seed(0))
    found, speed = range_and_speed(measured, chirps, axis, threshold=10.0)
    assert (found[0] - 3.217).abs().quantile(0.9).item() < chirps.resolution_opl / 4
    assert (speed[0] - 1.83).abs().quantile(0.9).item() < chirps.resolution_opl / (2 * chirps.rate_scale_s)


def test_folded_beats():
    """A surface that comes near: its up beat is negative, and at the positive frequency without quadratures."""
    chirps = chirps_of()
    axis = chirps.time_axis((0.5, 4.0), (-4.0, 4.0), bins_per_line=2)
    beats = pair(chirps, axis, [1.0], [3.0])
    folded, positive = fold_beats(beats, axis)
    assert positive.start_opl == pytest.approx(-positive.bin_width_opl / 2)
    assert positive.end_opl == pytest.approx(axis.end_opl)
    torch.testing.assert_close(folded.sum(), beats.sum())
    place = 2.0 - chirps.rate_scale_s * 6.0
    assert place < -8
    wanted = line(chirps, positive, -place)
    torch.testing.assert_close(folded[0, :, 0, 0], wanted, atol=1e-12, rtol=0)
    away = line(chirps, positive, 2.0 + chirps.rate_scale_s * 6.0)
    torch.testing.assert_close(folded[1, :, 0, 0], away, atol=1e-12, rtol=0)


@pytest.mark.parametrize(
    ("start", "bins", "wanted", "sums"),
    [(-2.0, 5, (0.0, 3), [5.0, 5.0, 5.0]), (-1.5, 4, (-0.5, 3), [2.0, 4.0, 4.0]),
     (1.0, 2, (1.0, 2), [1.0, 2.0]), (-3.0, 2, (1.0, 2), [2.0, 1.0])],
)  # fmt: skip
def test_folded_bins(start, bins, wanted, sums):
    """Bins of one metre that hold 1, 2, 3, ...: edges at whole numbers, and middles."""
    folded, axis = fold_beats(torch.arange(1.0, bins + 1).reshape(1, -1, 1, 1), TimeAxis(start, 1.0, bins))
    assert axis == TimeAxis(wanted[0], 1.0, wanted[1])
    assert folded.flatten().tolist() == sums


def test_results_without_beats_say_how_to_get_them():
    beats = torch.ones(2, 8, 1, 1)
    with pytest.raises(ShapeError, match="chirps="):
        range_and_speed(SimpleNamespace(beats=None, transient=beats, chirps=None, axis=TimeAxis(0.0, 1.0, 8)))
