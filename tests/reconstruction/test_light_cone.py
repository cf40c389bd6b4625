"""Light cones on grids where squared distances are whole bins: convolutions and resampling in closed form."""

import itertools
import math

import pytest
import torch

from torchtransient.axes import TimeAxis, fast_length
from torchtransient.capture import Scan, Wall
from torchtransient.errors import ShapeError
from torchtransient.reconstruction import LCT, DiffusionDeconvolution, DirectionalLCT

F64 = torch.float64
# v = r^2 from 0 to 4 m^2 in bins of 0.25 m^2; steps of 0.5 m along x are one of them, of 1 m along y four.
AXIS = TimeAxis(0.0, 0.5, 8)
SCAN = Scan.grid(Wall.plane(2.0, 3.0), (4, 3), kind="confocal")
TAPS = torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0], dtype=F64) / 16


def made(kind, **options):
    return kind(SCAN, time_axis=AXIS, v_bins=16, dtype=F64, **options)


@pytest.mark.parametrize("place", [(2, 1, 3), (5, 2, 0)])
@pytest.mark.parametrize("kind", [LCT, DirectionalLCT])
def test_a_point_of_v_lights_the_wall_at_its_squared_distance(kind, place):
    operator = made(kind)
    assert operator.cone.width == 0.25 and operator.grid.pitch == pytest.approx((1.0, 0.5))
    v, j, i = place
    # The components of vectors: along x, along y and towards the wall.
    for component, ((power_y, power_x), scale) in enumerate(zip(operator.moments, operator.scales, strict=True)):
        parts = [torch.zeros(16, 3, 4, dtype=F64) for _ in operator.moments]
        parts[component][v, j, i] = 1.0
        found = operator._convolved(parts, regularised=False)
        expected = torch.zeros(16, 3, 4, dtype=F64)
        for row, column in itertools.product(range(3), range(4)):
            dy, dx = 1.0 * (row - j), 0.5 * (column - i)
            at = v + round((dx**2 + dy**2) / 0.25)
            for tap, weight in zip(range(at - 2, at + 3), TAPS, strict=True):
                if 0 <= tap < 16:
                    expected[tap, row, column] += weight * dy**power_y * dx**power_x * scale
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


def with_kernels(operator, along_y, along_x):
    """The operator with one number at all frequencies for each power of an offset."""
    for name, values in (("along_y", along_y), ("along_x", along_x)):
        for power, value in enumerate(values):
            if hasattr(operator, f"{name}{power}"):
                table = getattr(operator, f"{name}{power}")
                table.copy_(torch.tensor([value, 0.0], dtype=F64).expand_as(table))
    return operator


def test_inverses_of_numbers_are_numbers_over_power_and_noise():
    # Constant light, that of strengths of 1 per m^3 in each bin of u, times 2 z of the depth.
    operator = with_kernels(made(LCT, snr=3.0), [0.5], [1.5])
    middle = operator.depths[:, None, None]
    light = (middle**-4 * (operator.cone.radii**2).diff()[:, None, None] * 0.5).expand(2, 8, 3, 4)
    number = 0.75 / (0.75**2 + operator.mean_power() / 3.0)
    torch.testing.assert_close(operator.reconstruct(light), (number * 2 * middle).expand(2, 8, 3, 4))


def test_inverses_of_vectors_of_numbers_are_vectors():
    wall = Wall.plane(2.0, 3.0, center=(1.0, 2.0, 3.0), normal=(0.6, 0.0, 0.8))
    scan = Scan.grid(wall, (4, 3), kind="confocal")
    operator = DirectionalLCT(scan, time_axis=TimeAxis(0.25, 0.5, 8), v_bins=16, snr=3.0, dtype=F64)
    # The depth in the middle is 1.125 m.
    assert operator.scales == (1.0, 1.0, 1.125)
    with_kernels(operator, [0.5, 0.75], [1.5, 2.0])
    kernels = 0.5 * 2.0, 0.75 * 1.5, 0.5 * 1.5 * 1.125
    over = sum(a**2 for a in kernels) + operator.mean_power() / 3.0
    middle = operator.depths[:, None, None]
    light = (middle**-5 * (operator.cone.radii**2).diff()[:, None, None] * 0.5).expand(8, 3, 4)
    x, y, towards = (a / over * 2 * middle for a in kernels)
    grid = operator.grid
    expected = sum(
        part * axis[:, None, None, None]
        for part, axis in ((x, grid.along_x), (y, grid.along_y), (towards / (middle / 1.125), -grid.normal))
    )
    torch.testing.assert_close(operator.reconstruct(light), expected.expand(3, 8, 3, 4))
    # The model multiplies what points towards the wall by the depth, over that in the middle.
    parts = operator.components(expected.expand(3, 8, 3, 4), "volume")
    alone = operator._resampled((towards * torch.ones(8, 3, 4)), "volume", transposed=False, to_v=True)
    torch.testing.assert_close(parts[2], alone)


def test_transforms_hold_the_cone_behind_the_record():
    # 4 x 0.5 m and 3 x 1 m: 13 m^2 behind 4 m^2, 4.25 times as many bins.
    assert made(LCT).cone.padded == fast_length(68, multiple=2)
    # A narrow wall: twice the record, and no less.
    narrow = Scan.grid(Wall.plane(0.5, 0.75), (4, 3), kind="confocal")
    assert LCT(narrow, time_axis=AXIS, v_bins=16).cone.padded == 32
    # Seven times the record is the most that a wall may be wide: 3 x 3 m^2 and 4.3589 m of 28 m^2.
    for width, taken in ((math.sqrt(19.0) - 1e-9, True), (math.sqrt(19.0) + 1e-6, False)):
        wide = Scan.grid(Wall.plane(width, 3.0), (4, 3), kind="confocal")
        if taken:
            assert LCT(wide, time_axis=AXIS, v_bins=16).cone.padded == 128
            continue
        with pytest.raises(ShapeError, match=r"one of 4 m\^2 .* squared is 28 m\^2"):
            LCT(wide, time_axis=AXIS, v_bins=16)


def test_slabs_that_only_weaken_are_undone_up_to_noise():
    # With the same power at every frequency the inverse is a number: a / (a^2 + 1 / snr).
    operator = DiffusionDeconvolution(SCAN, time_axis=TimeAxis(0.0, 0.25, 8), thickness=0.3, snr=5.0, dtype=F64)
    operator.kernel.copy_(torch.tensor([0.75, 0.0], dtype=F64).expand_as(operator.kernel))
    light = torch.rand(2, *operator.data_shape, dtype=F64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(operator(light), 0.75 * light)
    torch.testing.assert_close(operator.reconstruct(light), 0.75 / (0.75**2 + 0.2) * light)
