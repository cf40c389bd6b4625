"""Depth from histograms that can be counted by hand: asymmetric ones, at the ends of what they may be."""

from __future__ import annotations

import math

import pytest
import torch

from torchtransient.errors import ShapeError, UnitError
from torchtransient.sensing import depth
from torchtransient.units import SPEED_OF_LIGHT


def histogram(*rows):
    """(1, T, 1, P) of the pixels' histograms."""
    return torch.tensor(rows, dtype=torch.float64).T.reshape(1, -1, 1, len(rows))


def flat(x):
    return x.flatten().tolist()


def test_matched_filter_by_hand():
    """score[t] = sum_j h[t + first + j] log(1 + s k[j]), what lies outside being empty or, periodic, the other end."""
    h, kernel, ratio = histogram([1, 0, 2, 0, 5]), torch.tensor([0.2, 0.7, 0.1], dtype=torch.float64), 6.0
    weights = [math.log(1 + ratio * k) for k in (0.2, 0.7, 0.1)]
    for first in (-1, 0, 2):
        for boundary, at in (("zero", lambda i: i), ("periodic", lambda i: i % 5)):
            wanted = [sum(w * dict(enumerate([1, 0, 2, 0, 5])).get(at(t + first + j), 0) for j, w in enumerate(weights))
                      for t in range(5)]  # fmt: skip
            found = depth.log_matched_filter(h, kernel, first, signal_to_background=ratio, boundary=boundary)
            assert flat(found) == pytest.approx(wanted)
    for wrong, said in ((torch.ones(0), r"\(0,\)"), ([0.5, 0.5], "list")):
        with pytest.raises(ShapeError, match=f"expected a kernel .* got {said}"):
            depth.log_matched_filter(h, wrong)


def test_top_of_a_parabola():
    """1, 4, 2: (2 - 1) / (2 (2 4 - 1 - 2)) of a bin late. None at the ends and on a plateau; half a bin at most."""
    rows = [1, 4, 2, 0, 0], [5, 4, 2, 0, 0], [0, 1, 2, 4, 5], [3, 3, 3, 3, 3], [0, 2, 2, 2, 0]
    assert flat(depth.peak_position(histogram(*rows))) == [1.5 + 0.1, 0.5, 4.5, 0.5, 1.5 + 0.5]
    assert flat(depth.peak_position(histogram(*rows), refine=False)) == [1.5, 0.5, 4.5, 0.5, 1.5]
    eps = torch.finfo(torch.float64).eps
    # what rounding makes of 2 here - left - right is less than the slope here
    steep = histogram([0, 2 - 6 * eps - eps, 2 - eps, 2 - eps, 0])
    assert flat(depth.peak_position(steep)) == [3.0]
    found = depth.peak_position(histogram([1, 4, 2], [1, math.nan, 9]))
    assert flat(found)[0] == pytest.approx(1.6) and math.isnan(flat(found)[1])


def test_mass_by_hand():
    """(2 0.5 + 3 1.5 + 1 2.5) / 6; less a background of each pixel; of the bins near the largest one."""
    h = histogram([2, 3, 1, 0], [0, 0, 4, 12])
    assert flat(depth.center_of_mass(h)) == pytest.approx([8 / 6, (4 * 2.5 + 12 * 3.5) / 16])
    background = torch.tensor([0.5, 1.0], dtype=torch.float64).reshape(1, 1, 2)
    moments = [1.5 * 0.5 + 2.5 * 1.5 + 0.5 * 2.5 - 0.5 * 3.5, -1 * 0.5 - 1 * 1.5 + 3 * 2.5 + 11 * 3.5]
    assert flat(depth.center_of_mass(h, background=background)) == pytest.approx([moments[0] / 4, moments[1] / 12])
    assert flat(depth.center_of_mass(h, half_width_bins=0)) == [1.5, 3.5]
    wide = histogram([1, 9, 2, 5, 7, 0, 3])
    near = [(1 * 0.5 + 9 * 1.5 + 2 * 2.5) / 12, (1 * 0.5 + 9 * 1.5 + 2 * 2.5 + 5 * 3.5) / 17]
    assert flat(depth.center_of_mass(wide, half_width_bins=1)) == pytest.approx(near[:1])
    assert flat(depth.center_of_mass(wide, half_width_bins=2)) == pytest.approx(near[1:])
    with pytest.raises(ShapeError, match=r"center_of_mass: expected background to be a number or \(1, 1, 2\)"):
        depth.center_of_mass(h, background=torch.ones(4, 1, 2))


def test_mass_of_weak_light_by_hand():
    """S = 1 of N^2 = 4 + 1 + 4: the mean is drawn to the middle by S^2 / N^2, and stays in the window."""
    h = histogram([2, 1, -2])
    assert flat(depth.center_of_mass(h)) == pytest.approx([1.5 + 1 * (2 * -1 + 1 * 0 - 2 * 1) / 9])
    # of a sum of exactly its noise nothing is drawn
    assert flat(depth.center_of_mass(histogram([0, 0, 3]))) == [2.5]
    # S = 3 = N: the mean itself, 31/6, would be behind the window
    for row, end in (([-1, 0, 0, 2, 2], 5.0), ([2, 2, 0, 0, -1], 0.0)):
        assert flat(depth.center_of_mass(histogram(row))) == [end]
    # within one bin of the largest one: 5, -2 and -2 have S = 1, N^2 = 33
    assert flat(depth.center_of_mass(histogram([-2, 5, -2, 4]), half_width_bins=1)) == pytest.approx([1.5])
    assert flat(depth.center_of_mass(histogram([3, 5, -7, 4]), half_width_bins=1)) == pytest.approx(
        [1.5 + 1 * (3 * -1 - 7 * 1) / 83]
    )


def test_soft_argmax_by_hand():
    h = histogram([math.log(1), math.log(4), math.log(9)])
    assert flat(depth.soft_argmax(h)) == pytest.approx([(1 * 0.5 + 4 * 1.5 + 9 * 2.5) / 14])
    assert flat(depth.soft_argmax(h, 2.0)) == pytest.approx([(1 * 0.5 + 2 * 1.5 + 3 * 2.5) / 6])
    assert flat(depth.soft_argmax(h, 0.5)) == pytest.approx([(1 * 0.5 + 16 * 1.5 + 81 * 2.5) / 98])


def test_first_return_by_hand():
    """On the line between the middles of two bins, of the threshold of each pixel; at the threshold is a return."""
    h = histogram([0, 1, 5, 9], [7, 8, 9, 10], [1, 1, 1, 1])
    threshold = torch.tensor([3.0, 9.0, 2.0], dtype=torch.float64).reshape(1, 1, 3)
    found = depth.first_return(h, threshold)
    assert flat(found.position) == [2.0, 2.5, 0.0] and flat(found.strength) == [5.0, 9.0, 0.0]
    assert flat(found.valid) == [True, True, False]
    assert found.position.shape == (1, 1, 1, 3)
    with pytest.raises(ShapeError, match="first_return: expected threshold"):
        depth.first_return(h, torch.ones(1, 3))
    broken = depth.first_return(histogram([0, math.nan, 5]), 3.0)
    assert flat(broken.valid) == [True] and math.isnan(float(broken.position))
    leaf = h.clone().requires_grad_()
    slopes = torch.autograd.grad(depth.first_return(leaf, threshold).position.sum(), leaf)[0]
    # (3 - 1) / (5 - 1): by the entry before -(5 - 3) / 4^2, by the one there -(3 - 1) / 4^2
    assert flat(slopes[..., 0]) == [0.0, -2 / 16, -2 / 16, 0.0]


def test_several_returns_by_hand():
    """Maxima of at least the threshold, no closer than the separation to a stronger one; in order of time."""
    h = histogram([0, 4, 1, 9, 0, 2, 0, 3, 1])
    for threshold, separation, number, positions in (
        (2.0, 1, 4, [1.5, 3.5, 5.5, 7.5]),
        (2.0, 1, 2, [1.5, 3.5]),
        (2.0, 2, 4, [1.5, 3.5, 5.5, 7.5]),
        (2.0, 3, 4, [3.5, 7.5]),
        (2.0, 5, 4, [3.5]),
        (2.1, 1, 4, [1.5, 3.5, 7.5]),
        (4.0, 1, 4, [1.5, 3.5]),
    ):
        found = depth.multi_return(h, number, threshold=threshold, min_separation_bins=separation)
        places = [math.floor(p) + 0.5 for p in flat(found.position) if p]
        assert places == positions, (threshold, separation, number)
        assert flat(found.valid) == [k < len(positions) for k in range(number)]
        assert flat(found.strength) == [float(h[0, int(p)]) for p in places] + [0.0] * (number - len(positions))
    # at both ends, and of equal neighbours the later one
    ends = depth.multi_return(histogram([5, 1, 3, 3, 0, 2]), 3, threshold=1.0)
    assert flat(ends.position) == [0.5, 3.5 - 0.5, 5.5]
    broken = depth.multi_return(histogram([0, 4, 0, math.nan], [0, 4, 0, 0]), 2, threshold=1.0)
    assert flat(broken.valid) == [False, True, False, False]
    assert [math.isnan(p) for p in flat(broken.position)] == [math.isnan(p) for p in flat(broken.strength)]
    assert [math.isnan(p) for p in flat(broken.position)] == [True, False, True, False]


def test_bound_of_a_distance_by_hand():
    """100 ps wide, 25 detections: c 100 ps / 2.3548 / (2 5)."""
    found = depth.range_deviation_m(100e-12, torch.tensor([25.0, 0.0], dtype=torch.float64))
    assert float(found[0]) == pytest.approx(SPEED_OF_LIGHT * 100e-12 / (2 * math.sqrt(2 * math.log(2))) / 10)
    assert float(found[1]) == math.inf
    for wrong in (0.0, 2e-3):
        with pytest.raises(UnitError, match="response_fwhm_s"):
            depth.range_deviation_m(wrong, torch.ones(1))


@pytest.mark.parametrize(
    "distance, intrinsics",
    [((5,), (3, 3)), ((2, 4, 5), (3, 3, 3)), ((4, 5), (2, 3, 3)), ((4, 5), (3, 4)), ((4, 5), (1, 1, 3, 3))],
)
def test_shapes_that_are_no_camera(distance, intrinsics):
    with pytest.raises(ShapeError, match=r"^distance_to_points: expected"):
        depth.distance_to_points(torch.ones(distance), torch.ones(intrinsics))
