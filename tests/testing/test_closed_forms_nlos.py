"""The plane against its patches summed up, and the patch against what its distances and angles must do."""

import math

import numpy as np
import pytest

from torchtransient.errors import ShapeError, UnitError
from torchtransient.testing.closed_forms import confocal_plane, hidden_patch

DOWN = (0.0, 0.0, -1.0)


def test_a_plane_is_the_sum_of_its_patches():
    """Rings around the foot of the scan point, each of one distance: the integral by the midpoint rule."""
    depth, edges = 0.8, np.linspace(1.5, 2.4, 10)
    rho = np.linspace(0, 1.2, 6001)
    middles, areas = (rho[1:] + rho[:-1]) / 2, math.pi * np.diff(rho**2)
    lengths, values = np.array([
        hidden_patch([0, 0, 0], [0, 0, 0], [x, 0, depth], DOWN, area, 0.6, 0.9, energy=2.0)
        for x, area in zip(middles, areas, strict=True)
    ]).T  # fmt: skip
    found, _ = np.histogram(lengths, edges, weights=values)
    expected = confocal_plane(edges, depth, 0.6, 0.9, energy=2.0)
    # A bin of 0.1 m holds 250 rings of 2e-4 m at least, of which one at each end may fall into the neighbour.
    np.testing.assert_allclose(found, expected, rtol=2 / 250)
    assert found.sum() == pytest.approx(expected.sum(), rel=1e-3)


def test_all_the_light_of_a_plane_and_of_a_disk():
    everything = confocal_plane([0.0, 1e9], 0.8, 0.6, 0.9)
    strength = 0.9**2 * 0.6 / math.pi**3
    assert everything[0] == pytest.approx(math.pi * strength / (3 * 0.8**2), rel=1e-12)
    disk = confocal_plane([0.0, 1.7, 1e9], 0.8, 0.6, 0.9, radius=0.3)
    reach = math.hypot(0.8, 0.3)
    assert disk.sum() == pytest.approx(everything[0] * (1 - (0.8 / reach) ** 6), rel=1e-12)
    assert confocal_plane([2 * reach, 9.0], 0.8, 0.6, 0.9, radius=0.3)[0] == 0


def test_how_a_patch_falls_off():
    def value(x, z, **changes):
        return hidden_patch([x, 0, 0], [x, 0, 0], [0, 0, z], DOWN, 1e-4, 0.5, 0.8, **changes)

    length, near = value(0.0, 1.0)
    assert length == 2.0 and near == pytest.approx((0.8 / math.pi) ** 2 * 0.5 / math.pi * 1e-4)
    assert value(0.0, 2.0)[1] == pytest.approx(near / 2**4)
    # at one depth z the light goes by z^4 / r^8
    assert value(1.0, 1.0)[1] == pytest.approx(near / math.sqrt(2) ** 8)
    assert hidden_patch([0, 0, 0], [0, 0, 0], [0, 0, 1], (0, 0, 1), 1e-4, 0.5, 0.8)[1] == 0
    assert value(0.0, 1.0, wall_normal=DOWN)[1] == 0
    there = hidden_patch([0.3, 0, 0], [-0.2, 0.1, 0], [0, 0, 1], (0.2, 0, -1), 1e-4, 0.5, 0.8)
    back = hidden_patch([-0.2, 0.1, 0], [0.3, 0, 0], [0, 0, 1], (0.2, 0, -1), 1e-4, 0.5, 0.8)
    assert there == pytest.approx(back)


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda: confocal_plane([1.0, 2.0], 0.0, 0.5, 0.5), UnitError),
        (lambda: confocal_plane([1.0, 2.0], 1.0, 1.5, 0.5), UnitError),
        (lambda: confocal_plane([1.0], 1.0, 0.5, 0.5), ShapeError),
        (lambda: confocal_plane([1.0, 2.0], 1.0, 0.5, 0.5, radius=-1.0), UnitError),
        (lambda: hidden_patch([0, 0], [0, 0, 0], [0, 0, 1], DOWN, 1.0, 0.5, 0.5), ShapeError),
        (lambda: hidden_patch([0, 0, 0], [0, 0, 0], [0, 0, np.inf], DOWN, 1.0, 0.5, 0.5), UnitError),
        (lambda: hidden_patch([0, 0, 0], [0, 0, 0], [0, 0, 1], (0, 0, 0), 1.0, 0.5, 0.5), UnitError),
    ],
)
def test_what_is_refused(make, error):
    with pytest.raises(error, match="expected"):
        make()
