"""f-k migration against the transform that it stands for, written out, and light of known points."""

import math

import pytest
import torch

from support.grid_operators import confocal_points
from support.marks import long
from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan, Wall
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.reconstruction import FK, PlanarScan, fk

F64 = torch.float64
BINS, SIDE, WIDTH = 128, 16, 0.04
AXIS = TimeAxis(0.0, WIDTH, BINS)
SCAN = Scan.grid(Wall.plane(1.0, 1.0), SIDE, kind="confocal")


def direct(wavefield, axis, pitch):
    """Migration of (T, Y, X) with transforms in time and depth at the exact frequencies, padded twice."""
    bins, rows, columns = wavefield.shape
    t, jz = axis.centers_opl / axis.bin_width_opl, torch.arange(bins, dtype=F64)
    depth = bins * axis.bin_width_opl
    ky, kx = (
        torch.fft.fftfreq(2 * n, 1 / (2 * n), dtype=F64) * depth / (2 * n * p)
        for n, p in zip((rows, columns), pitch, strict=True)
    )
    over_wall = torch.fft.fft2(wavefield, s=(2 * rows, 2 * columns))
    out = torch.zeros(bins, 2 * rows, 2 * columns, dtype=torch.complex128)
    to_depth = torch.polar(torch.ones(bins, bins, dtype=F64), math.pi / bins * t[:, None] * jz) / (2 * bins)
    for y in range(2 * rows):
        jt = torch.sqrt(jz**2 + ky[y] ** 2 + kx[:, None] ** 2)  # (2 X, T)
        weight = torch.where(jz > 0, jz / jt.clamp_min(1.0), 0.0) * (jt <= bins)
        turns = torch.polar(weight[..., None].expand(-1, -1, bins), -math.pi / bins * jt[..., None] * t)
        spectrum = torch.einsum("xjt,tx->xj", turns, over_wall[:, y])
        out[:, y] = torch.einsum("zj,xj->zx", to_depth, spectrum)
    return torch.fft.ifft2(out)[:, :rows, :columns]


@pytest.mark.parametrize("z", long([0.46, 2.2], [2.2]))
def test_field_is_that_of_the_direct_transform(z):
    # In parts of the record: 18 and 86 %.
    operator = FK(SCAN, time_axis=AXIS, dtype=F64)
    psi = operator.wavefield(confocal_points([(0.1, -0.15, z)], SCAN, AXIS))
    exact, found = direct(psi, AXIS, operator.grid.pitch), operator.adjoint(psi)
    # Two errors of interpolation, at the ends of the record and in its middle, are below 5e-4.
    assert float((found - exact).abs().max()) < 1e-3 * float(exact.abs().max())
    linear = FK(SCAN, time_axis=AXIS, taps=2, dtype=F64).adjoint(psi)
    assert float((linear - exact).norm()) < 0.1 * float(exact.norm())


def test_start_and_unequal_sides_are_those_of_the_direct_transform():
    axis = TimeAxis(0.7, 0.03, 64)
    scan = Scan.grid(Wall.plane(1.0, 0.7), (12, 9), kind="confocal")
    operator = FK(scan, time_axis=axis, target="retroreflective", dtype=F64)
    psi = operator.wavefield(confocal_points([(0.1, -0.1, 0.9)], scan, axis, power=2))
    exact = direct(psi, axis, operator.grid.pitch)
    assert float((operator.adjoint(psi) - exact).abs().max()) < 1e-3 * float(exact.abs().max())


def test_pictures_are_linear_in_the_light():
    # |psi|^2 is linear in the light: one quarter of the albedo shows one quarter. y-tal 0.20 shows a sixteenth.
    operator = FK(SCAN, time_axis=AXIS, dtype=F64)
    light = confocal_points([(0.1, -0.15, 1.0)], SCAN, AXIS)
    ratio = float(operator.reconstruct(light / 4).max() / operator.reconstruct(light).max())
    assert ratio == pytest.approx(0.25, rel=1e-12)


def test_migration_of_the_model_is_the_cosine_of_the_wave():
    # A wave packet whose direction has the cosine J: model, then migration, give J / 2 of it, the half since of the
    # real wavefield each of the two signs of frequency has one half.
    axis = TimeAxis(0.0, 0.04, 128)
    scan = Scan.grid(Wall.plane(2.0, 2.0), 48, kind="confocal")
    operator = FK(scan, time_axis=axis, dtype=F64)
    tilt, off = 0.5, operator.points - torch.tensor([0.2, 0.0, 1.0], dtype=F64)
    turns = 5.0 * off[..., 2] + 5.0 * tilt * off[..., 0]
    packet = torch.polar(torch.exp(-off.square().sum(-1) / (2 * 0.2**2)), 2 * math.pi * turns)
    again = operator.adjoint(operator(packet))
    product = (packet.conj() * again).sum() / packet.norm() ** 2
    assert float(product.abs() * packet.norm() / again.norm()) > 0.99
    assert float(product.real) == pytest.approx(0.5 / math.hypot(1, tilt), rel=0.02)
    assert abs(float(product.imag)) < 1e-3


def test_gradients_of_pictures():
    operator = FK(SCAN, time_axis=TimeAxis(0.5, 0.1, 12), floor=0.25, dtype=F64)
    counts = torch.poisson(
        torch.full(operator.data_shape, 0.7, dtype=F64), generator=torch.Generator().manual_seed(0)
    ).requires_grad_()
    assert (counts == 0).any()
    scale = 1 / float(operator.reconstruct(counts).detach().max())
    assert torch.autograd.gradcheck(lambda h: scale * operator.reconstruct(h), counts, fast_mode=True)
    assert torch.autograd.gradgradcheck(lambda h: scale * operator.reconstruct(h), counts, fast_mode=True)


def test_captures_and_planar_scans():
    axis = TimeAxis(0.0, 0.04, 64)
    light = confocal_points([(0.1, -0.15, 0.8)], SCAN, axis)
    operator = FK(SCAN, time_axis=axis)
    expected = operator.reconstruct(light)
    capture = Capture(torch.stack([light, 2 * light]).float(), axis, SCAN)
    volume = fk(capture)
    assert volume.shape == (2, 64, SIDE, SIDE) and volume.dtype == torch.float32
    torch.testing.assert_close(volume[0], expected, rtol=1e-5, atol=1e-6 * float(expected.max()))
    torch.testing.assert_close(operator.reconstruct(capture), volume)
    assert fk(Capture(light[None], axis, SCAN)).dtype == F64
    planar = FK(PlanarScan.of_scan(SCAN, "test"), time_axis=axis)
    torch.testing.assert_close(planar.reconstruct(light), expected)
    assert operator.points.shape == (64, SIDE, SIDE, 3)
    torch.testing.assert_close(operator.points[5, ..., 2], torch.full((SIDE, SIDE), 0.11, dtype=F64))
    torch.testing.assert_close(operator.points[0, ..., :2], SCAN.sensor_points[..., :2])


def test_what_it_cannot_take_is_refused():
    wall = Wall.plane(1.0, 1.0)
    with pytest.raises(ShapeError, match="expected a confocal scan, got a single one"):
        FK(Scan.grid(wall, 8, kind="single"), time_axis=AXIS)
    with pytest.raises(ShapeError, match="first and last leg"):
        FK(Scan.grid(wall, 8, kind="confocal", first_and_last_leg=True), time_axis=AXIS)
    with pytest.raises(ShapeError, match="grid"):
        FK(Scan.points(SCAN.sensor_points.reshape(-1, 3), kind="confocal", sensor_origin=(0, 0, 1),
                       laser_origin=(0, 0, 1)), time_axis=AXIS)  # fmt: skip
    for settings, error, words in (
        ({"time_axis": TimeAxis(0, 0.1, 3)}, ShapeError, "4 bins at least, got 3"),
        ({"target": "mirror"}, ArgumentError, "target"), ({"taps": 3}, ArgumentError, "taps"),
        ({"floor": -1.0}, UnitError, "floor"), ({"dtype": torch.float16}, UnitError, "dtype"),
    ):  # fmt: skip
        with pytest.raises(error, match=words):
            FK(SCAN, **{"time_axis": AXIS, **settings})
