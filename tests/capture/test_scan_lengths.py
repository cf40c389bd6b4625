"""Lengths and tolerances of scans in closed form, and what becomes of the gradients of their points."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.scalars import no_gradient_is_lost
from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan, Wall
from torchtransient.capture.scan import bounds_of, laser_index, longest, shortest
from torchtransient.errors import SceneError, ShapeError, UnitError
from torchtransient.files.captures.gaps import hidden_side
from torchtransient.files.content_key import content_key

F64 = torch.float64
TENSORS = ("sensor_points", "laser_points", "sensor_origin", "laser_origin", "sensor_normals", "laser_normals")
# Elsewhere, turned, wider than high.
WALL = Wall.plane(2.0, 0.8, center=(1.0, 2.0, 3.0), normal=(0.6, 0.0, 0.8))


def carrying(scan):
    """The scan with gradients in all of its tensors."""
    zero = torch.zeros((), dtype=F64, requires_grad=True)
    moved = {name: getattr(scan, name) + zero for name in TENSORS if getattr(scan, name) is not None}
    if scan.kind == "confocal":
        moved |= {"laser_points": moved["sensor_points"], "laser_normals": moved["sensor_normals"]}
    return replace(scan, **moved)


@pytest.mark.parametrize("kind", ["single", "confocal", "exhaustive"])
def test_points_with_gradients_have_lengths(kind):
    scan = Scan.grid(WALL, (4, 3), kind=kind, first_and_last_leg=True)
    box = [[1.5, 1.6, 3.0], [2.0, 2.2, 4.0]]
    with no_gradient_is_lost():
        given = carrying(scan)
        assert given.default_axis(box, 0.01) == scan.default_axis(box, 0.01)
        assert given.spacing == scan.spacing and given.is_planar and repr(given) == repr(scan)
        if kind == "exhaustive":
            assert given.confocal().kind == "confocal" and given.single((0, 1)).kind == "single"
        with pytest.raises(SceneError, match="behind them by up to"):
            replace(given, sensor_origin=given.sensor_origin - 3 * torch.tensor([0.6, 0.0, 0.8], dtype=F64))
        side = hidden_side(given)
        assert content_key(given.sensor_points) == content_key(scan.sensor_points)
    assert side == pytest.approx([0.6, 0.0, 0.8])
    plain = given.detach()
    assert plain == scan and not any(getattr(plain, name).requires_grad for name in TENSORS)
    capture = Capture(torch.rand(1, 8, *scan.shape, requires_grad=True), TimeAxis(0.0, 0.1, 8), given)
    assert not capture.peak_time().requires_grad
    assert not capture.detach().scan.sensor_points.requires_grad and not capture.detach().transient.requires_grad


def test_points_with_gradients_take_the_normals_of_their_wall():
    flat = Scan.grid(WALL, (4, 3), kind="confocal")
    points = flat.sensor_points.clone().requires_grad_()
    with no_gradient_is_lost():
        scan = Scan.points(points, kind="confocal", sensor_origin=flat.sensor_origin, laser_origin=flat.laser_origin,
                           wall=WALL)  # fmt: skip
    torch.testing.assert_close(scan.sensor_normals, flat.sensor_normals)
    assert scan.sensor_points.requires_grad


def test_origins_stand_aside_of_the_middle_of_the_wall_and_before_it():
    scan = Scan.grid(WALL, (4, 3), kind="single")
    # u runs along up x normal, (0.8, 0, -0.6): a quarter of 2 m aside, an eighth of it before the wall.
    expected = torch.tensor([1.0, 2.0, 3.0], dtype=F64) + torch.tensor(
        [-0.5 * 0.8 + 0.25 * 0.6, 0.0, 0.5 * 0.6 + 0.25 * 0.8], dtype=F64
    )
    torch.testing.assert_close(scan.sensor_origin, expected, rtol=0, atol=1e-14)
    torch.testing.assert_close(scan.laser_origin, expected, rtol=0, atol=1e-14)
    torch.testing.assert_close(scan.laser_points, torch.tensor([1.0, 2.0, 3.0], dtype=F64), rtol=0, atol=1e-14)


def lined(points, **changes):
    origin = {"sensor_origin": (0.0, 0.0, 4.0), "laser_origin": (0.0, 3.0, 4.0)}
    return Scan.points(points, **{"kind": "confocal", **origin, **changes})


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_grids_are_regular_to_a_millionth_of_their_extent(axis):
    y, x = torch.meshgrid(1.5 * torch.arange(3, dtype=F64), 2.0 * torch.arange(5, dtype=F64), indexing="ij")
    points = torch.stack([x, y, torch.zeros_like(x)], -1) + torch.tensor([7.0, 8.0, 0.0], dtype=F64)
    assert lined(points).spacing == (2.0, 1.5)
    # Eight metres and three.
    for off, taken in ((0.9e-6, True), (-0.9e-6, True), (1.1e-6, False), (-1.1e-6, False)):
        moved = points.clone()
        moved[1, 2, axis] += off * math.hypot(8.0, 3.0)
        if taken:
            assert lined(moved).spacing == (2.0, 1.5)
            continue
        with pytest.raises(ShapeError, match=r"regular grid, got points up to 9\.4e-06 m off it"):
            _ = lined(moved).spacing
    # Off by a length in space, whichever other points are.
    some, far = points.clone(), points.clone()
    some[1, 1:4, axis] += 0.8e-6 * math.hypot(8.0, 3.0)
    far[1, 2] += 0.8e-6 * math.hypot(8.0, 3.0)
    assert lined(some).spacing == (2.0, 1.5)
    with pytest.raises(ShapeError, match="regular grid"):
        _ = lined(far).spacing
    for shape in ((1, 5), (3, 1)):
        with pytest.raises(ShapeError, match="at least 2 x 2"):
            _ = lined(points[: shape[0], : shape[1]]).spacing
    with pytest.raises(ShapeError, match="at least 2 x 2"):
        _ = lined(points.reshape(-1, 3)).spacing
    assert lined(points[:2, :2]).spacing == (2.0, 1.5)


def test_points_lie_in_a_plane_to_a_millionth_of_their_extent():
    # A square with corners that go up and down: spreads of 2 along both sides, and of twice the height.
    for height, flat in ((0.9e-6, True), (1.1e-6, False)):
        corners = [[-1, -1, height], [1, -1, -height], [1, 1, height], [-1, 1, -height]]
        assert lined(corners).is_planar is flat
    # The spot counts with them; three points are always in one plane.
    plane = [[-1, -1, 0.0], [1, -1, 0.0], [1, 1, 0.0], [-1, 1, 0.0]]
    assert lined(plane, kind="single", laser_points=[0, 0, 0.0]).is_planar
    assert not lined(plane, kind="single", laser_points=[0, 0, 0.1]).is_planar
    assert lined(plane[:2], kind="single", laser_points=[0.3, 0.2, 0.1]).is_planar


def test_lengths_over_a_box():
    # Distances of 3 and 4, 5 and 12, ... between whole numbers.
    low, high = torch.tensor([3.0, 0.0, 4.0], dtype=F64), torch.tensor([8.0, 9.0, 12.0], dtype=F64)
    wall = [[0, 0, 0], [-1.0, 0, 0]]
    scan = lined(wall)
    # The nearest point of the box is (3, 0, 4), the farthest (8, 9, 12); a second point is farther from all.
    assert shortest(scan, low, high) == 10.0 and longest(scan, low, high) == 2 * math.sqrt(306)
    counted = replace(scan, first_and_last_leg=True)
    # Legs of 4 and 5 m, and of sqrt(17) and sqrt(26) m.
    assert shortest(counted, low, high) == 19.0
    assert longest(counted, low, high) == pytest.approx(2 * math.sqrt(306) + math.sqrt(17) + math.sqrt(26))
    # The shortest of each side for itself, where pairs are free.
    one = lined(wall, kind="single", laser_points=[3.0, -12.0, 4.0])
    assert shortest(one, low, high) == 12.0 + 5.0
    assert longest(one, low, high) == pytest.approx(math.sqrt(306) + math.sqrt(25 + 441 + 64))
    pairs = lined(wall, kind="exhaustive", laser_points=[[0, 0, 0.0], [3.0, -12.0, 4.0]], first_and_last_leg=True)
    assert shortest(pairs, low, high) == 5.0 + 5.0 + 5.0 + 4.0
    far = max(math.sqrt(289) + 5.0, math.sqrt(25 + 441 + 64) + math.hypot(3, 15))
    assert longest(pairs, low, high) == pytest.approx(far + math.sqrt(306) + math.sqrt(17))
    # On the other side of it, and inside.
    assert shortest(lined([[11.0, 13.0, 12.0]]), low, high) == 10.0 and shortest(lined([[5.0, 1, 5]]), low, high) == 0.0
    axis = scan.default_axis(torch.stack([low, high]), 0.75)
    assert axis == TimeAxis(9.75, 0.75, math.ceil(2 * math.sqrt(306) / 0.75) - 13)
    tiny = lined([[0, 0, 0]]).default_axis([[0, 0, 3.0], [0, 0, 3.0]], 2.0)
    assert tiny == TimeAxis(6.0, 2.0, 1)


def test_bounds_of_a_box():
    low, high = bounds_of([[0, 1, 2], [0, 1, 2]], "Method")
    assert low.tolist() == high.tolist() == [0.0, 1.0, 2.0]
    for bounds in ([[0, 0, 1], [-1e-9, 1, 1]], [[0, 2, 0], [1, 1, 1]], [[0, 0, 0], [1, 1, math.inf]]):
        with pytest.raises(UnitError, match="Method: expected finite bounds"):
            bounds_of(bounds, "Method")
    for bounds in ([0, 0, 0, 1, 1, 1], [[0, 0, 0]], None, "box"):
        with pytest.raises(ShapeError, match=r"Method: expected bounds \(2, 3\)"):
            bounds_of(bounds, "Method")


def test_spots_of_a_scan_by_their_index():
    scan = Scan.grid(WALL, 2, kind="exhaustive", laser_grid=(4, 3))
    for index, found in (((2, 3), (2, 3)), ((-3, -4), (-3, -4)), ((np.int64(1), 0), (1, 0))):
        assert laser_index(scan, index) == found
        assert torch.equal(scan.single(index).laser_points, scan.laser_points[index])
    for index in (0, (3, 0), (0, 4), (-4, 0), (0, -5), (0,), (0, 0, 0), (True, 0), (0.0, 1), ("0", 0), None):
        with pytest.raises(ShapeError, match=r"expected an index into spots \(3, 4\)"):
            laser_index(scan, index)


@pytest.mark.parametrize("off, same", [(0.9e-9, True), (1.1e-9, False), (-1.1e-9, False)])
def test_spots_are_sensor_points_to_a_nanometre(off, same):
    scan = Scan.grid(WALL, (4, 3), kind="exhaustive")
    moved = replace(scan, laser_points=scan.laser_points + torch.tensor([0.0, off, 0.0], dtype=F64))
    if same:
        assert torch.equal(moved.confocal().laser_points, scan.sensor_points)
        return
    with pytest.raises(SceneError, match=r"spots \(3, 4\) and sensor points \(3, 4\)"):
        moved.confocal()


def test_normals_of_length_one_keep_their_digits():
    points = [[0, 0, 0], [1.0, 0, 0]]
    kept = torch.tensor([[0, 0, 1 + 0.9e-12], [0, 0, 1 - 0.9e-12]], dtype=F64)
    assert torch.equal(lined(points, normals=kept).sensor_normals, kept)
    given = torch.tensor([[0, 0, 1 + 1e-11], [0.0, 0.6, 0.4]], dtype=F64)
    expected = given / given.norm(dim=1, keepdim=True)
    found = lined(points, normals=given).sensor_normals
    assert torch.equal(found, expected) and not torch.equal(found, given)


@pytest.mark.parametrize(("make", "error", "words"), [
    (lambda: Scan.grid(WALL, 2, kind="single", laser="middle"), ShapeError, r"expected \(u, v\) on the wall or"),
    (lambda: Scan.grid(WALL, 2, kind="single", laser=(0.1, 0.2, 0.3, 0.4)), ShapeError, "expected .u, v. on the wall"),
    (lambda: lined([[0, 0, 0]], sensor_origin=[[0, 0, 4.0]]), ShapeError, r"sensor_origin \(3,\), got \(1, 3\)"),
    (lambda: lined([[0, 0, 0]], laser_origin=[[0, 0, 4.0]]), ShapeError, r"laser_origin \(3,\), got \(1, 3\)"),
    (lambda: lined(torch.zeros(2, 2, 2, 3)), ShapeError, r"\(Sy, Sx, 3\) or \(N, 3\), got \(2, 2, 2, 3\)"),
    (lambda: lined(torch.zeros(2, 3, dtype=torch.complex64)), ShapeError, "complex64"),
    (lambda: lined(torch.zeros(2, 3, dtype=torch.bool)), ShapeError, "torch.bool"),
    (lambda: lined(torch.tensor(3.0)), ShapeError, r"points \(\.\.\., 3\), got torch.float32 of \(\)"),
    (lambda: Scan("confocal", torch.zeros(2, 3), torch.zeros(1, 3), sensor_origin=(0, 0, 1), laser_origin=(0, 0, 1)),
     ShapeError, r"\(2, 3\), the sensor points"),
    (lambda: Scan("single", torch.zeros(2, 3), torch.zeros(3), sensor_origin=(0, 0, 1), laser_origin=(0, 0, 1),
                  laser_normals=torch.ones(1, 3)), ShapeError, r"laser_normals \(3,\) as the points, got \(1, 3\)"),
    (lambda: Scan("single", torch.zeros(2, 3), torch.zeros(3), sensor_origin=(0, 0, 1), laser_origin=(0, 0, 0),
                  laser_normals=torch.tensor([0, 0, 1.0])), SceneError, "laser_origin in front .* in the wall itself"),
])  # fmt: skip
def test_parts_that_do_not_belong_together(make, error, words):
    with pytest.raises(error, match=words):
        make()
