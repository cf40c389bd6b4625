"""Light-cone transforms against planes and points in closed form."""

import math

import pytest
import torch

from tools.point_captures import point_capture
from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan, Wall
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.reconstruction import LCT, DirectionalLCT

F64 = torch.float64
AXIS = TimeAxis(0.0, 0.0192, 192)
SIDE = 24
SCAN = Scan.grid(Wall.plane(1.0, 1.0), SIDE, kind="confocal")


def slab_of(operator, z, sigma=0.03):
    """A plate of one per m^2 at a depth, spread over sigma metres: strength per m^3, (Z, 1, 1)."""
    profile = torch.exp(-(((operator.depths - z) / sigma) ** 2) / 2)
    return (profile / (profile.sum() * float(operator.depths.diff()[0])))[:, None, None]


@pytest.mark.parametrize("target, power, z", [("diffuse", 4, 1.2), ("retroreflective", 2, 0.6)])
def test_plane_in_closed_form(target, power, z):
    # Isotropic points of one per m^2 on an infinite plane: H = int r^-p dA, dA = 2 pi r dr, from r_a to r_b >= z.
    scan = Scan.grid(Wall.plane(2.0, 2.0), 32, kind="confocal")
    operator = LCT(scan, time_axis=AXIS, target=target, v_bins=768, dtype=F64)
    plate = slab_of(operator, z)
    found = operator(plate.expand(-1, 32, 32))[:, 16, 16]
    radii, expected = AXIS.edges_opl / 2, torch.zeros(AXIS.num_bins, dtype=F64)
    for depth, share in zip(operator.depths, plate.flatten() * 0.0096, strict=True):
        r = radii.clamp_min(depth)
        part = (r[:-1] ** -2 - r[1:] ** -2) if power == 4 else 2 * (r[1:] / r[:-1]).log()
        expected += share * math.pi * part
    # The grid ends at a metre: later light of the closed form comes from beside it. The plate begins 3 sigma before z.
    seen = radii[1:] < math.hypot(z - 0.09, 0.95)
    assert int(seen.sum()) > 20
    # Bins of v of 4.4e-3 m^2 and depth steps of 1 cm, on an edge that rises over 3 cm.
    assert float((found - expected)[seen].abs().max()) < 0.03 * float(expected.max())
    assert float(found[seen].sum()) == pytest.approx(float(expected[seen].sum()), rel=5e-3)


def rim(operator, light):
    """The brightest voxel of the two outermost rows and columns over the brightest inside."""
    strength = operator.reconstruct(light).norm(dim=-4)
    border = torch.ones(strength.shape[-2:], dtype=torch.bool)
    border[2:-2, 2:-2] = False
    return float(strength[..., border].max() / strength[..., ~border].max())


@pytest.mark.parametrize("outside", [(0.75, 0.0, 0.6), (1.0, 0.0, 0.6)])
def test_light_of_things_beside_the_scan_makes_no_rim(outside):
    light = point_capture(SCAN, [(0.0, 0.1, 0.6), outside], time_axis=AXIS).transient[0]
    bare, faded = (rim(DirectionalLCT(SCAN, time_axis=AXIS, dtype=F64, **of), light) for of in ({"taper": 0.0}, {}))
    assert bare > 0.2 and faded < 0.6 * bare


def test_fading_is_of_the_inverse_alone_and_from_none_to_half():
    bare, faded = (DirectionalLCT(SCAN, time_axis=AXIS, dtype=F64, taper=taper) for taper in (0.0, 0.25))
    light = torch.rand(bare.data_shape, dtype=F64, generator=torch.Generator().manual_seed(0))
    assert torch.equal(bare.adjoint(light), faded.adjoint(light))
    # A quarter of 24 points: none are changed from the seventh on, the outermost keeps sin^2 of 7.5 degrees.
    weight = faded.inverse.adjoint(bare.adjoint(light)) / bare.inverse.adjoint(bare.adjoint(light))
    along = weight[50, 12]
    torch.testing.assert_close(along[6:18], torch.ones(12, dtype=F64))
    assert float(along[0]) == pytest.approx(math.sin(math.pi / 24) ** 2, rel=1e-9)
    for taper in (-0.1, 0.6, math.nan, "wide"):
        with pytest.raises(UnitError, match="taper"):
            DirectionalLCT(SCAN, time_axis=AXIS, taper=taper)


@pytest.mark.parametrize("target, power", [("diffuse", 4), ("retroreflective", 2)])
def test_a_point_sends_all_its_light(target, power):
    operator = LCT(SCAN, time_axis=AXIS, target=target, v_bins=768, dtype=F64)
    volume = torch.zeros(operator.volume_shape, dtype=F64)
    # Spread over some depth: a voxel alone is sharper than the band, and rings.
    volume[:, 10, 13] = slab_of(operator, 1.0, 0.02).flatten() * SIDE**2
    light = operator(volume)
    r = (torch.tensor([*operator.points[0, 10, 13][:2], 1.0]) - SCAN.sensor_points).norm(dim=-1)
    torch.testing.assert_close(light.sum(0), r**-power, rtol=0.01, atol=0)
    mean = (light * AXIS.centers_opl[:, None, None]).sum(0) / light.sum(0)
    torch.testing.assert_close(mean, 2 * r, rtol=0, atol=0.005)


def test_plates_come_back():
    operator = LCT(SCAN, time_axis=AXIS, dtype=F64)
    volume = torch.zeros(operator.volume_shape, dtype=F64)
    for (y, x), z in {(5, 5): 0.8, (14, 10): 0.9, (9, 16): 1.1}.items():
        volume[:, y : y + 4, x : x + 4] = slab_of(operator, z, 0.01)
    light, front = operator(volume), volume.amax(0)

    def correlation(snr):
        found = LCT(SCAN, time_axis=AXIS, snr=snr, dtype=F64).reconstruct(light).amax(0).clamp_min(0)
        return float((found * front).sum() / (found.norm() * front.norm()))

    assert correlation(10.0) > 0.85
    # What is beyond the scan is missing: the ratio has an optimum without any noise.
    assert correlation(10.0) > correlation(0.01) + 0.1 and correlation(10.0) > correlation(1e4) + 0.1
    found = operator.reconstruct(light)
    for (y, x), z in {(5, 5): 0.8, (14, 10): 0.9, (9, 16): 1.1}.items():
        column = found[:, y : y + 4, x : x + 4].sum((1, 2))
        assert float(operator.depths[column.argmax()]) == pytest.approx(z, abs=0.012)


def test_cones_do_not_come_round():
    # A wall of twice the record: what leaves the record at its end does not come in at its beginning.
    axis = TimeAxis(0.5, 0.02, 48)
    scan = Scan.grid(Wall.plane(1.2, 1.2), 12, kind="confocal")
    operator = LCT(scan, time_axis=axis, target="retroreflective", dtype=F64)
    assert operator.cone.padded > 3 * operator.v_bins
    volume = torch.zeros(operator.volume_shape, dtype=F64)
    volume[44, 0, 0] = 1.0
    light = operator(volume)
    r = (operator.points[44, 0, 0] - scan.sensor_points).norm(dim=-1)
    beyond = 2 * r > axis.end_opl + 0.2
    assert int(beyond.sum()) > 100
    assert float(light[:, beyond].abs().max()) < 2e-3 * float(light.max())
    with pytest.raises(ShapeError, match="short beside the wall"):
        LCT(scan, time_axis=TimeAxis(0.5, 0.02, 12))


def tilted_plate(angle, squared):
    """Light of a plate of 0.4 m, 0.8 m behind the wall; ``squared``: with the cosine squared."""
    g = torch.linspace(-0.2, 0.2, 9, dtype=F64)
    y, x = torch.meshgrid(g, g, indexing="ij")
    normal = torch.tensor([math.sin(angle), 0.0, -math.cos(angle)], dtype=F64)
    points = torch.stack([x * math.cos(angle), y, 0.8 + x * math.sin(angle)], -1).reshape(-1, 3)
    wall = SCAN.sensor_points.reshape(-1, 3)
    light = torch.zeros(len(wall), AXIS.num_bins, dtype=F64)
    for part in points.split(200):
        way = wall[:, None] - part
        r = way.norm(dim=-1)
        strength = (way @ normal / r).clamp_min(0) ** (2 if squared else 1) * r**-4
        steps = torch.special.ndtr((AXIS.edges_opl - 2 * r[..., None]) / 0.03)
        light += (strength[..., None] * steps.diff(dim=-1)).sum(1)
    return light.T.reshape(AXIS.num_bins, SIDE, SIDE)


@pytest.mark.parametrize(
    "angle, squared, least, most",
    [
        (0.3, False, 9, 17),
        pytest.param(-0.3, True, -17, -9, marks=pytest.mark.slow),
    ],
)
def test_normals_of_plates(angle, squared, least, most):
    light = tilted_plate(angle, squared)
    operator = DirectionalLCT(SCAN, time_axis=AXIS, snr=100.0, dtype=F64)
    vectors = operator.reconstruct(light)
    albedo = vectors.norm(dim=0)
    bright = albedo > 0.5 * albedo.max()
    mean = vectors[:, bright].sum(1)
    found = math.degrees(math.atan2(float(mean[0]), -float(mean[2])))
    # The shortest explanation leans towards the wall: three quarters of the angle, 17 degrees.
    assert least < found < most
    assert abs(float(mean[1])) < 0.02 * float(mean.norm())
    depth = float(operator.depths[albedo.amax((1, 2)).argmax()])
    assert abs(depth - 0.8) < 0.2 * math.sin(abs(angle)) + 0.02


def test_directional_model_of_a_point():
    operator = DirectionalLCT(SCAN, time_axis=AXIS, v_bins=768, dtype=F64)
    normal = torch.tensor([0.4, -0.3, -math.sqrt(0.75)], dtype=F64)
    volume = torch.zeros(operator.volume_shape, dtype=F64)
    volume[:, :, 10, 13] = normal[:, None] * slab_of(operator, 1.0, 0.02).flatten() * SIDE**2
    way = SCAN.sensor_points - torch.tensor([*operator.points[0, 10, 13][:2], 1.0])
    r = way.norm(dim=-1)
    expected = (way @ normal) / r * r**-4
    torch.testing.assert_close(operator(volume).sum(0), expected, rtol=0.015, atol=0.002 * float(expected.max()))


def test_what_it_cannot_take_is_refused():
    with pytest.raises(UnitError, match="from zero on"):
        LCT(SCAN, time_axis=TimeAxis(-0.1, 0.02, 64))
    with pytest.raises(UnitError, match="snr"):
        LCT(SCAN, time_axis=AXIS, snr=0.0)
    with pytest.raises(ArgumentError, match="target"):
        DirectionalLCT(SCAN, time_axis=AXIS, target="mirror")
    with pytest.raises(SceneError, match="v_bins"):
        LCT(SCAN, time_axis=AXIS, v_bins=1)
