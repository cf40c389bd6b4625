"""Which points are a regular grid on a flat wall, where its sides are, and which side is hidden."""

import pytest
import torch

from torchtransient.capture import Scan
from torchtransient.errors import ShapeError
from torchtransient.reconstruction import PlanarScan

F64 = torch.float64
# Three rows, four columns, 0.5 m and 0.25 m apart, turned and moved.
TURN = torch.linalg.qr(torch.tensor([[1.0, 2.0, 0.5], [0.3, 1.0, 2.0], [2.0, 0.1, 1.0]], dtype=F64))[0]
TURN = TURN * torch.linalg.det(TURN)
FIRST = torch.tensor([3.0, -1.0, 2.0], dtype=F64)


def points_of(rows=3, columns=4, dy=0.5, dx=0.25, lean=0.0):
    """``lean``: metres along x for each metre along y."""
    y, x = torch.meshgrid(dy * torch.arange(rows, dtype=F64), dx * torch.arange(columns, dtype=F64), indexing="ij")
    return torch.stack([x + lean * y, y, torch.zeros_like(x)], -1) @ TURN.T + FIRST


def of(points):
    return PlanarScan.of(points, who="Method")


def test_grids_have_their_sides_and_points():
    wall = of(points_of())
    assert wall.size == (3, 4) and wall.pitch == pytest.approx((0.5, 0.25), rel=1e-14)
    for found, expected in zip((wall.along_x, wall.along_y, wall.normal), TURN.T, strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-14)
    torch.testing.assert_close(wall.points, points_of(), rtol=0, atol=1e-14)
    assert torch.equal(wall.first, points_of()[0, 0])
    place = torch.tensor([[0.25, -1.0, 0.75], [3.0, 0.125, -2.0]], dtype=F64)
    torch.testing.assert_close(wall.local(place @ TURN.T + wall.first), place, rtol=0, atol=1e-14)
    assert of(points_of(2, 2)).size == (2, 2)
    assert repr(of(points_of(2, 2))) == "PlanarScan(2 x 2 points, 0.25 x 0.5 m apart)"


@pytest.mark.parametrize("shape", [(4, 3), (1, 3, 3), (2, 2, 2, 3), (2, 2, 4)])
def test_what_is_no_grid_of_points(shape):
    points = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    with pytest.raises(ShapeError, match=r"Method: expected sensor points as a grid \(Y, X, 3\) of 2 x 2"):
        of(points)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_rows_and_columns_may_lean_by_a_thousandth(sign):
    wall = of(points_of(lean=0.9e-3 * sign))
    assert abs(float(wall.along_x @ wall.along_y)) < 1e-15
    assert float(wall.along_y.norm()) == pytest.approx(1.0, abs=1e-15)
    with pytest.raises(ShapeError, match="rectangular grid"):
        of(points_of(lean=1.1e-3 * sign))


def test_the_normal_is_that_of_the_wall():
    up, origin = TURN[:, 2].expand(3, 4, 3), points_of().mean((0, 1))
    mixed = up.clone()
    mixed[0, 0] *= -1
    # One of twelve that points to the other side is outvoted.
    for normals, sign in ((up, 1.0), (-up, -1.0), (None, 1.0), (mixed, 1.0)):
        at = origin + 0.1 * sign * TURN[:, 2]
        scan = Scan.points(points_of(), kind="confocal", sensor_origin=at, laser_origin=at)
        # Origins do not matter beside normals.
        object.__setattr__(scan, "sensor_normals", normals)
        found = PlanarScan.of_scan(scan, "Method").normal
        torch.testing.assert_close(found, sign * TURN[:, 2], rtol=0, atol=1e-14)
