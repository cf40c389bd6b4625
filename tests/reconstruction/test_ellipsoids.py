"""How rows and voxels are cut into pieces, samples of filters, and lengths that numbers can tell apart."""

import math

import pytest
import torch

from support.scan_operators import AXIS, DEPTHS, SCANS, listed_scan, points_anywhere
from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan
from torchtransient.errors import ShapeError, UnitError
from torchtransient.reconstruction import (
    Backprojection,
    FilteredBackprojection,
    LaplacianFilter,
    PhasorFilter,
    VoxelGrid,
    ellipsoids,
)
from torchtransient.reconstruction.filters import check_sampling, sample_places

F64 = torch.float64
POINTS = points_anywhere(11)


@pytest.mark.parametrize("name", [*SCANS, "lists"])
@pytest.mark.parametrize("numbers, most_spots", [(1, 64), (60, 64), (150, 2), (1 << 19, 3), (1 << 19, 64)])
def test_groups_hold_every_row_once_and_no_more_numbers_than_they_may(name, numbers, most_spots, monkeypatch):
    monkeypatch.setattr(ellipsoids, "GROUP_NUMBERS", numbers)
    monkeypatch.setattr(ellipsoids, "MOST_SPOTS", most_spots)
    scan = listed_scan() if name == "lists" else SCANS[name]
    operator = Backprojection(scan, POINTS, time_axis=AXIS)
    spots = math.prod(scan.laser_shape) if scan.kind == "exhaustive" else 1
    sensors = math.prod(scan.sensor_shape)
    seen, rows = torch.zeros(spots, sensors), []
    for group in operator.groups():
        seen[group.lasers, group.sensors] += 1
        rows.append(math.prod(group.size))
        assert group.size[0] <= most_spots
    assert (seen == 1).all()
    # Four zeros stand around each row of 24 bins.
    most = max(1, numbers // 28)
    assert max(rows) <= most
    assert len(rows) == 1 if most >= spots * sensors and most_spots >= spots else len(rows) > 1


@pytest.mark.parametrize("name", ["single", "exhaustive", "confocal, legs"])
@pytest.mark.parametrize("block, tile", [(1, 3), (12, 4), (100, 100), (1 << 17, 1 << 14)])
def test_blocks_are_as_large_as_they_may_be(name, block, tile, monkeypatch):
    monkeypatch.setattr(ellipsoids, "CPU_BLOCK", block)
    monkeypatch.setattr(ellipsoids, "CPU_TILE", tile)
    monkeypatch.setattr(ellipsoids, "GPU_BLOCK", 7)
    operator = Backprojection(SCANS[name], POINTS, time_axis=AXIS)
    (group,) = operator.groups()
    sensors, size = group.size[1], min(11, tile)
    rows, found = max(1, block // size), torch.zeros(11, dtype=torch.int64)
    for part, index, fraction, weight in operator._blocks(group):
        assert index.shape == fraction.shape and weight is None
        assert index.shape[0] <= rows and index.shape[1] == part.stop - part.start <= size
        found[part] += index.shape[0]
    assert (found == math.prod(group.size)).all() and max(rows, sensors) >= 1


def test_boxes_are_apart_by_the_gaps_between_them():
    a = torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]], dtype=F64)
    for off, expected in (
        ((4.0, 0.0, 0.0), 3.0), ((4.0, 6.0, 0.0), 5.0), ((-4.0, -6.0, -15.0), 13.0), ((0.5, 1.0, 1.0), 0.0),
        ((1.0, 2.0, 3.0), 0.0), ((0.0, -6.0, 6.0), 5.0),
    ):  # fmt: skip
        b = a + torch.tensor(off, dtype=F64)
        assert ellipsoids.apart(a, b) == pytest.approx(expected) == ellipsoids.apart(b, a)


def test_points_are_within_a_thousand_million_bins():
    scan = Scan.points([[0, 0, 0]], kind="confocal", sensor_origin=(0, 0, 1), laser_origin=(0, 0, 1))
    axis = TimeAxis(0.0, 1e-7, 400_000_000)
    Backprojection(scan, torch.tensor([[0.0, 0.0, 49.0]], dtype=F64), time_axis=axis)
    with pytest.raises(UnitError, match=r"within 1e9 bins of each other, got some 1\.02e\+09 bins away"):
        Backprojection(scan, torch.tensor([[0.0, 0.0, 51.0]], dtype=F64), time_axis=axis)


@pytest.mark.parametrize("shape, per_bin", [
    ((16.0, 4.0), 1), ((15.9, 4.0), 2), ((8.0, 4.0), 2), ((2.0, 1.0), 8), ((2.5, 1.0), 7), ((16.0, 0.5), 2),
    ((16.0, 0.25), 4), ((1000.0, 4.0), 1),
])  # fmt: skip
def test_waves_have_sixteen_samples(shape, per_bin):
    # Wavelengths in bins; pulses of less than a cycle are steeper than their wave.
    wavelength, cycles = shape
    assert PhasorFilter(0.25 * wavelength, cycles).samples(0.25) == per_bin
    assert LaplacianFilter().samples(0.25) == 1


@pytest.mark.parametrize(
    "bins, samples, places", [(5, 1, (0, 5)), (5, 2, (-1, 10)), (5, 3, (-1, 14)), (2, 8, (-4, 13))]
)
def test_samples_reach_from_end_to_end(bins, samples, places):
    assert sample_places(bins, samples) == places


def test_pulses_of_two_bins_and_a_fourth():
    check_sampling(PhasorFilter(1.0, 0.75), 0.5, "Method")
    with pytest.raises(UnitError, match=r"two bins at least, 1 m, got 0\.9375 m"):
        check_sampling(PhasorFilter(0.9375, 4.0), 0.5, "Method")
    with pytest.raises(UnitError, match=r"at least, 0\.125 m, got 0\.1172 m of 0\.703125 cycles"):
        check_sampling(PhasorFilter(1.0, 0.703125), 0.5, "Method")
    assert PhasorFilter(1.5, 4.0).sigma == 1.0


def test_laplacians_take_planes_that_are_even_to_a_thousandth():
    scan = SCANS["confocal"]
    grid = VoxelGrid.before(scan, DEPTHS)
    of = {"time_axis": AXIS, "filter": LaplacianFilter()}
    for share, taken in ((0.9, True), (-0.9, True), (1.1, False), (-1.1, False)):
        depths = [0.1, 0.15, 0.2 + 5e-5 * share]
        if taken:
            FilteredBackprojection(scan, grid.at_depths(depths), **of)
            continue
        with pytest.raises(ShapeError, match="evenly spaced planes"):
            FilteredBackprojection(scan, grid.at_depths(depths), **of)
    FilteredBackprojection(scan, grid.at_depths([0.1]), **of)
    assert LaplacianFilter(0.2).sigma == 0.2 and LaplacianFilter(1e3).sigma == 1e3


@pytest.mark.parametrize("sigma, reach", [(0.2, 1), (0.5, 2), (0.75, 3), (0.8, 4)])
def test_laplacians_of_a_voxel_end_four_sigmas_from_it(sigma, reach):
    volume = torch.zeros(2, 9, 11, 13, dtype=F64)
    volume[1, 4, 5, 6] = 1.0
    found = LaplacianFilter(sigma).volume(volume)
    assert not found[0].any()
    at = torch.nonzero(found[1]) - torch.tensor([4, 5, 6])
    assert at.amin(0).tolist() == [-reach] * 3 and at.amax(0).tolist() == [reach] * 3
    # Alike in all directions, of sum zero; minus the second derivative of one that is nearly one voxel is above zero.
    cube = found[1, 4 - reach : 5 + reach, 5 - reach : 6 + reach, 6 - reach : 7 + reach]
    for other in (cube.permute(1, 2, 0), cube.flip(0), cube.flip(1), cube.flip(2)):
        torch.testing.assert_close(other, cube, rtol=0, atol=1e-14)
    assert abs(float(cube.sum())) < 1e-11 and float(cube[reach, reach, reach]) > 0
    assert LaplacianFilter(sigma).image(volume) is volume


def test_kernels_of_a_laplacian_are_gaussians_and_their_second_derivatives():
    smooth, curved = LaplacianFilter(1.5)._kernels(torch.zeros(1, dtype=F64))
    t = torch.arange(-6, 7, dtype=F64)
    gauss = torch.exp(-(t**2) / 4.5) / (1.5 * math.sqrt(2 * math.pi))
    # Sampled finely enough and cut off where 6e-5 of it is left.
    torch.testing.assert_close(smooth, gauss, rtol=2e-4, atol=0)
    torch.testing.assert_close(curved, (1 / 2.25 - t**2 / 2.25**2) * gauss, rtol=0, atol=1e-3)
    assert float(smooth.sum()) == pytest.approx(1.0, abs=1e-15) and abs(float(curved.sum())) < 1e-15
    assert float((curved * t**2).sum()) == pytest.approx(-2.0, rel=1e-14)
