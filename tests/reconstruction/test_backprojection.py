"""Backprojection against sums that are written out, and where light of known points comes out."""

import math

import pytest
import torch

from support.scan_operators import AXIS, DEPTHS, SCANS, WALL, bent_scan, listed_scan, paired_scan, points_anywhere
from support.sweeps import together
from tools.point_captures import point_capture
from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan
from torchtransient.errors import ShapeError, UnitError
from torchtransient.reconstruction import (
    Backprojection,
    FilteredBackprojection,
    LaplacianFilter,
    PhasorField,
    PhasorFilter,
    VoxelGrid,
    backproject,
    backprojection,
    filtered_backproject,
)

F64 = torch.float64
POINTS = points_anywhere()
ALL = {**SCANS, "bent wall": bent_scan(), "lists": listed_scan(), "pairs": paired_scan()}


def written_out(scan, points, axis, falloff):
    """The matrix (T, pairs, V) of linear interpolation at the length of every pair and point."""
    spots, sensors = scan.laser_points.reshape(-1, 3), scan.sensor_points.reshape(-1, 3)
    legs = scan.first_and_last_leg
    first, last = scan.laser_legs.reshape(-1) * legs, scan.sensor_legs.reshape(-1) * legs
    if scan.kind == "exhaustive":
        pairs = [(a, b) for a in range(len(spots)) for b in range(len(sensors))]
    else:
        pairs = [(b if len(spots) > 1 else 0, b) for b in range(len(sensors))]
    matrix = torch.zeros(axis.num_bins, len(pairs), len(points), dtype=F64)
    for row, (a, b) in enumerate(pairs):
        for column, point in enumerate(points):
            to_spot, to_sensor = float((spots[a] - point).norm()), float((sensors[b] - point).norm())
            place = (to_spot + to_sensor + float(first[a] + last[b]) - axis.start_opl) / axis.bin_width_opl - 0.5
            low = math.floor(place)
            for k, share in ((low, 1 - (place - low)), (low + 1, place - low)):
                if 0 <= k < axis.num_bins:
                    matrix[k, row, column] += share * (to_spot * to_sensor) ** -falloff
    return matrix.reshape(axis.num_bins, *scan.shape, len(points))


def lengths_of(scan, points):
    """(V, pairs): laser spot - point - sensor point, with the legs where they count; spots vary slowest."""
    spots, sensors = scan.laser_points.reshape(-1, 3), scan.sensor_points.reshape(-1, 3)
    to_spot, to_sensor = torch.cdist(points, spots), torch.cdist(points, sensors)
    apart = to_spot[:, :, None] + to_sensor[:, None] if scan.kind == "exhaustive" else to_spot + to_sensor
    return (apart + scan.first_and_last_leg * scan.legs.reshape(apart.shape[1:])).flatten(1)


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("falloff", [0.0, 1.5])
def test_is_the_matrix_that_is_written_out(name, falloff):
    scan = ALL[name]
    operator = Backprojection(scan, POINTS, time_axis=AXIS, falloff=falloff, dtype=F64)
    expected = written_out(scan, POINTS, AXIS, falloff)
    found = operator(torch.eye(len(POINTS), dtype=F64)).movedim(0, -1)
    assert expected.abs().sum() > 0
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10 * float(expected.max()))


@pytest.mark.parametrize("name", ALL)
def test_pieces_do_not_show(name, monkeypatch):
    scan = ALL[name]
    operator = Backprojection(scan, POINTS, time_axis=AXIS, falloff=1.0, dtype=F64)
    light = torch.randn(2, *operator.data_shape, dtype=F64, generator=torch.Generator().manual_seed(0))
    whole, forward = operator.adjoint(light), operator(operator.adjoint(light))
    for setting, value in (("CPU_TILE", 3), ("CPU_BLOCK", 6), ("GROUP_NUMBERS", 60), ("MOST_SPOTS", 2)):
        monkeypatch.setattr(backprojection, setting, value)
    torch.testing.assert_close(operator.adjoint(light), whole, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(operator(whole), forward, rtol=1e-12, atol=1e-12)


def test_far_from_the_origin_and_late_single_precision_keeps_its_digits():
    # The same hidden point 300 m away from the origin, with legs of 500 m: 1e9 float32 ulp of a bin otherwise.
    shift = torch.tensor([300.0, -200.0, 100.0], dtype=F64)
    near = Scan.grid(WALL, 4, kind="confocal")
    origin = near.sensor_points.mean((0, 1)) + torch.tensor([0.0, 0.0, 500.0], dtype=F64)
    far = Scan.points(
        near.sensor_points + shift, kind="confocal", sensor_origin=origin + shift, laser_origin=origin + shift,
        first_and_last_leg=True,
    )  # fmt: skip
    axis = TimeAxis(1000.1, 0.02, 24)
    double = Backprojection(far, POINTS + shift, time_axis=axis, dtype=F64)
    single = Backprojection(far, POINTS + shift, time_axis=axis)
    ones = torch.ones(len(POINTS), dtype=F64)
    assert double(ones).sum() > 0
    assert (single(ones.float()) - double(ones)).abs().max() < 1e-5


def test_distances_below_half_a_bin_do_not_grow_without_bound():
    scan = SCANS["confocal"]
    operator = Backprojection(scan, scan.sensor_points, time_axis=TimeAxis(-0.05, 0.02, 24), falloff=2.0, dtype=F64)
    light = operator(torch.ones(operator.volume_shape, dtype=F64))
    assert torch.isfinite(light).all()
    assert light.max() <= 4 * (0.01**2) ** -2.0


def test_a_point_is_brightest_where_it_is():
    scan = Scan.grid(WALL, 8, kind="exhaustive", laser_grid=3)
    axis = TimeAxis(0.1, 0.01, 50)
    grid = VoxelGrid.before(scan, torch.linspace(0.1, 0.2, 11), size=9, extent=0.2)
    place = grid.points[6, 2, 5]
    capture = point_capture(scan, place[None], time_axis=axis)
    volume = backproject(capture, grid)
    assert volume.shape == (1, 11, 9, 9)
    assert volume.dtype == F64
    assert int(volume.argmax()) == (6 * 9 + 2) * 9 + 5
    for sharpened in (PhasorFilter(0.04, 3.0), LaplacianFilter()):
        picture = filtered_backproject(capture, grid, filter=sharpened)
        assert int(picture.argmax()) == (6 * 9 + 2) * 9 + 5


def pulse_at(pulse, lengths, width):
    """The pulse's value at lengths from the middle of a bin of that width."""
    height = torch.exp(-(lengths**2) / (2 * pulse.sigma**2)) * width / (pulse.sigma * math.sqrt(2 * math.pi))
    return torch.polar(height, 2 * math.pi * lengths / pulse.wavelength)


@together("wavelength, cycles", [(0.02, 4.0), (0.16, 40.0), (30.0, 0.5)])
@together("samples", [1, 2, 3])
def test_rows_are_convolved_with_the_whole_pulse_and_do_not_wrap(wavelength, cycles, samples):
    pulse, width, bins = PhasorFilter(wavelength, cycles), 0.01, 45
    rows = torch.randn(2, bins, dtype=F64, generator=torch.Generator().manual_seed(0))
    # From end to end of the record.
    at = width * torch.arange(-(samples // 2), (bins - 1) * samples + samples // 2 + 1, dtype=F64) / samples
    matrix = pulse_at(pulse, at[:, None] - width * torch.arange(bins, dtype=F64), width)
    found, expected = pulse.rows(rows, width, samples), rows.to(matrix) @ matrix.T
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12 * float(expected.abs().max()))
    back = torch.randn(2, len(at), dtype=torch.complex128, generator=torch.Generator().manual_seed(1))
    expected = (back @ matrix.conj()).real
    found = pulse.rows_adjoint(back, width, samples)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12 * float(expected.abs().max()))


@pytest.mark.parametrize("bins, cycles", [(2.0, 4.0), (3.0, 3.0), (6.0, 0.5), (16.0, 0.25), (40.0, 4.0)])
@pytest.mark.parametrize("scan", ["confocal", "exhaustive, legs"])
def test_filtered_light_is_the_pulse_at_every_length(scan, bins, cycles):
    # Lines between samples of a wave lose (pi / n)^2 / 2 of it at most, n of them: 16 and more.
    axis, scan, pulse = TimeAxis(0.02, 0.01, 90), SCANS[scan], PhasorFilter(0.01 * bins, cycles)
    operator = FilteredBackprojection(scan, POINTS, time_axis=axis, filter=pulse, dtype=F64)
    light = torch.rand(operator.data_shape, dtype=F64, generator=torch.Generator().manual_seed(0))
    lengths = lengths_of(scan, POINTS)
    assert float(lengths.min()) > 0.03 and float(lengths.max()) < 0.9
    matrix = pulse_at(pulse, lengths[..., None] - axis.centers_opl, 0.01)
    expected = torch.einsum("vpt,tp->v", matrix, light.flatten(1).to(matrix))
    lost, picture = (math.pi / 16) ** 2 / 2, expected.abs().square()
    assert (operator.adjoint(light) - expected).norm() < lost * expected.norm()
    assert (operator.reconstruct(light) - picture).norm() < 2 * lost * picture.norm()


@pytest.mark.parametrize("kind", [Backprojection, FilteredBackprojection])
def test_light_at_the_ends_of_a_record_does_not_reach_beyond_them(kind):
    # Before and behind the record there is nothing, not even nothing times NaN.
    pulse = {} if kind is Backprojection else {"filter": PhasorFilter(0.2)}
    for start in (4.0, -3.0):
        operator = kind(SCANS["confocal"], POINTS, time_axis=TimeAxis(start, 0.05, 20), dtype=F64, **pulse)
        light = torch.full(operator.data_shape, math.nan, dtype=F64)
        assert not operator.adjoint(light).abs().any()
        assert not operator(torch.full_like(operator.adjoint(light), math.nan)).any()


@pytest.mark.parametrize("falloff", [4.0, -4.0])
def test_falloffs_of_long_records(falloff):
    # Distances in metres and in bins are far apart: neither overflows.
    scan, axis = SCANS["confocal"], TimeAxis(0.0, 1e-5, 60000)
    operator = Backprojection(scan, POINTS, falloff=falloff, time_axis=axis)
    r = lengths_of(scan, POINTS) / 2
    found = operator.adjoint(torch.ones(operator.data_shape))
    torch.testing.assert_close(found.double(), (r ** (-2 * falloff)).sum(1), rtol=1e-4, atol=0)


def test_laplacian_of_quadratic_brightness():
    # -(a + b + c) times two inside, whatever the smoothing; zero for a linear one.
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=F64) for n in (15, 16, 17)), indexing="ij")
    laplacian = LaplacianFilter(0.7)
    inside = (slice(6, -6),) * 3
    quadratic = laplacian.volume(1.0 * z**2 - 0.5 * y**2 + 2.0 * x**2)[inside]
    torch.testing.assert_close(quadratic, torch.full_like(quadratic, -2 * 2.5), rtol=1e-9, atol=1e-9)
    assert laplacian.volume(1 + z - 2 * y + 3 * x)[inside].abs().max() < 1e-9


def test_filters_that_cannot_be_taken():
    scan, grid = SCANS["confocal"], VoxelGrid.before(SCANS["confocal"], DEPTHS)
    of = {"time_axis": AXIS}
    with pytest.raises(UnitError, match="falloff"):
        Backprojection(scan, grid, falloff=math.nan, **of)
    for kind, name in ((FilteredBackprojection, "filter"), (PhasorField, "pulse")):
        with pytest.raises(UnitError, match="two bins"):
            kind(scan, grid, **{name: PhasorFilter(0.03)}, **of)
        with pytest.raises(UnitError, match="fourth of a bin"):
            kind(scan, grid, **{name: PhasorFilter(0.1, 1e-6)}, **of)
    with pytest.raises(ShapeError, match="a VoxelGrid for a LaplacianFilter"):
        FilteredBackprojection(scan, POINTS, filter=LaplacianFilter(), **of)
    with pytest.raises(ShapeError, match="evenly spaced"):
        FilteredBackprojection(scan, grid.at_depths([0.1, 0.2, 0.4]), filter=LaplacianFilter(), **of)
    for make in (lambda: PhasorFilter(0.0), lambda: PhasorFilter(1.0, -1.0), lambda: LaplacianFilter(math.inf),
                 lambda: LaplacianFilter(0.1)):  # fmt: skip
        with pytest.raises(UnitError):
            make()
