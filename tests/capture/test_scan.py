"""Scans: where their points are, which lengths they count, and what is refused."""

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.scalars import no_gradient_is_lost
from support.sweeps import together
from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan, Wall
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.files import content_key

WALL = Wall.plane(2.0, 1.6)
ORIGIN = (-0.5, 0.0, 0.25)
F64 = torch.float64
TENSORS = ("sensor_points", "laser_points", "sensor_origin", "laser_origin", "sensor_normals", "laser_normals")
# Elsewhere, turned, wider than high.
TURNED = Wall.plane(2.0, 0.8, center=(1.0, 2.0, 3.0), normal=(0.6, 0.0, 0.8))
LIST = np.array([[0.1, 0.2, 0.0], [0.3, -0.4, 0.0], [-0.6, 0.7, 0.0]])


def scan(kind, **changes):
    return Scan.grid(WALL, (4, 3), kind=kind, **changes)


def test_shapes_and_pairs():
    assert scan("single").shape == (3, 4)
    assert scan("confocal").shape == (3, 4)
    assert scan("exhaustive").shape == (3, 4, 3, 4)
    assert scan("exhaustive", laser_grid=(5, 2)).shape == (2, 5, 3, 4)
    assert scan("exhaustive", laser_grid=(5, 2)).pairs == 120
    assert Scan.grid(WALL, 1, kind="confocal").sensor_points.tolist() == [[[0, 0, 0]]]
    points = Scan.points(LIST, kind="confocal", sensor_origin=ORIGIN, laser_origin=ORIGIN)
    assert points.shape == (3,) and points.pairs == 3
    both = Scan.points(
        LIST, kind="exhaustive", laser_points=LIST[:2], sensor_origin=ORIGIN, laser_origin=ORIGIN, wall=WALL
    )
    assert both.shape == (2, 3)
    assert both.laser_normals.tolist() == [[0, 0, 1]] * 2


def test_grid_takes_a_dictionary_a_wall_or_a_mesh():
    of_wall = scan("single")
    of_dictionary = Scan.grid(WALL.shape, (4, 3), kind="single")
    assert of_wall == of_dictionary
    square = np.array([[-1, -0.8, 0], [1, -0.8, 0], [1, 0.8, 0], [-1, 0.8, 0.0]])
    of_mesh = Scan.grid((square, [[0, 1, 2], [0, 2, 3]]), (4, 3), kind="single")
    torch.testing.assert_close(of_mesh.sensor_points, of_wall.sensor_points)
    torch.testing.assert_close(of_mesh.laser_points, of_wall.laser_points)
    assert of_mesh.wall["type"] == "mesh_arrays"


def test_the_laser_of_a_single_scan():
    assert scan("single").laser_points.tolist() == [0, 0, 0]
    assert scan("single", laser=(0.75, 0.5)).laser_points.tolist() == [0.5, 0, 0]
    assert scan("single", laser=[0.2, 0.1, 0.0]).laser_points.tolist() == [0.2, 0.1, 0]
    moving = torch.tensor([0.2, 0.1, 0.0], dtype=torch.float64, requires_grad=True)
    scan("single", laser=moving).laser_legs.backward()
    assert moving.grad is not None and float(moving.grad.norm()) == pytest.approx(1.0)


def test_legs():
    made = Scan.grid(WALL, (4, 3), kind="exhaustive", laser_grid=2, sensor_origin=(0, 0, 1), laser_origin=(1, 0, 2))
    assert made.legs.shape == made.shape
    expected = (made.laser_points[1, 0] - torch.tensor([1.0, 0, 2])).norm() + (
        made.sensor_points[2, 3] - torch.tensor([0.0, 0, 1])
    ).norm()
    torch.testing.assert_close(made.legs[1, 0, 2, 3], expected)
    single = scan("single", laser_origin=(0, 0, 3))
    torch.testing.assert_close(single.legs, single.sensor_legs + 3.0)


@together("kind", ["single", "confocal", "exhaustive"])
def test_scans_pickle_compare_and_move(kind):
    made = scan(kind)
    copy = pickle.loads(pickle.dumps(made))
    assert copy == made and hash(copy) == hash(made) and copy is not made
    assert made.to("cpu") == made and made.detach() == made
    assert made != scan(kind, sensor_origin=(0, 0, 1)) and made != scan(kind, first_and_last_leg=True)
    assert made != Scan.grid(Wall.plane(2.0, 1.6, albedo=0.9), (4, 3), kind=kind)
    assert made != 3
    assert "4 x 3 points" in repr(made) and kind in repr(made)


def test_parts_of_an_exhaustive_scan():
    made = scan("exhaustive")
    one = made.single((1, 2))
    assert one.kind == "single" and one.shape == (3, 4)
    assert torch.equal(one.laser_points, made.laser_points[1, 2])
    assert made.confocal() == scan("confocal")
    for wrong in (3, (3, 0), (0, -5), (0, 0, 0), (0.0, 1)):
        with pytest.raises(ShapeError):
            made.single(wrong)
    with pytest.raises(SceneError):
        scan("single").single(0)
    with pytest.raises(SceneError):
        scan("exhaustive", laser_grid=3).confocal()


def points(given=LIST, **changes):
    defaults = {"kind": "confocal", "sensor_origin": ORIGIN, "laser_origin": ORIGIN}
    return Scan.points(given, **{**defaults, **changes})


def carrying(scan):
    """The scan with gradients in all of its tensors."""
    zero = torch.zeros((), dtype=F64, requires_grad=True)
    moved = {name: getattr(scan, name) + zero for name in TENSORS if getattr(scan, name) is not None}
    if scan.kind == "confocal":
        moved |= {"laser_points": moved["sensor_points"], "laser_normals": moved["sensor_normals"]}
    return replace(scan, **moved)


@together("kind", ["single", "confocal", "exhaustive"])
def test_points_with_gradients_have_lengths(kind):
    scan = Scan.grid(TURNED, (4, 3), kind=kind, first_and_last_leg=True)
    box = [[1.5, 1.6, 3.0], [2.0, 2.2, 4.0]]
    with no_gradient_is_lost():
        given = carrying(scan)
        assert given.default_axis(box, 0.01) == scan.default_axis(box, 0.01)
        assert repr(given) == repr(scan)
        if kind == "exhaustive":
            assert given.confocal().kind == "confocal" and given.single((0, 1)).kind == "single"
        with pytest.raises(SceneError, match="sensor_origin"):
            replace(given, sensor_origin=given.sensor_origin - 3 * torch.tensor([0.6, 0.0, 0.8], dtype=F64))
        assert content_key(given.sensor_points) == content_key(scan.sensor_points)
    plain = given.detach()
    assert plain == scan and not any(getattr(plain, name).requires_grad for name in TENSORS)
    capture = Capture(torch.rand(1, 8, *scan.shape, requires_grad=True), TimeAxis(0.0, 0.1, 8), given)
    assert not capture.peak_time().requires_grad
    assert not capture.detach().scan.sensor_points.requires_grad and not capture.detach().transient.requires_grad


def test_points_with_gradients_take_the_normals_of_their_wall():
    flat = Scan.grid(TURNED, (4, 3), kind="confocal")
    points = flat.sensor_points.clone().requires_grad_()
    with no_gradient_is_lost():
        scan = Scan.points(points, kind="confocal", sensor_origin=flat.sensor_origin, laser_origin=flat.laser_origin,
                           wall=TURNED)  # fmt: skip
    torch.testing.assert_close(scan.sensor_normals, flat.sensor_normals)
    assert scan.sensor_points.requires_grad


def test_origins_stand_aside_of_the_middle_of_the_wall_and_before_it():
    scan = Scan.grid(TURNED, (4, 3), kind="single")
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


def span(scan, box):
    """Shortest and longest way, of an axis of narrow bins."""
    axis = scan.default_axis(box, 2.0**-12)
    return pytest.approx(axis.start_opl, abs=2**-12), pytest.approx(axis.end_opl, abs=2**-12)


def test_lengths_over_a_box():
    # Distances of 3 and 4, 5 and 12, ... between whole numbers.
    box = torch.tensor([[3.0, 0.0, 4.0], [8.0, 9.0, 12.0]], dtype=F64)
    wall = [[0, 0, 0], [-1.0, 0, 0]]
    scan = lined(wall)
    far = math.sqrt(306)
    # The nearest point of the box is (3, 0, 4), the farthest (8, 9, 12); a second point is farther from all.
    assert (10.0, 2 * far) == span(scan, box)
    # Legs of 4 and 5 m, and of sqrt(17) and sqrt(26) m.
    assert (19.0, 2 * far + math.sqrt(17) + math.sqrt(26)) == span(replace(scan, first_and_last_leg=True), box)
    # The shortest of each side for itself, where pairs are free.
    one = lined(wall, kind="single", laser_points=[3.0, -12.0, 4.0])
    assert (12.0 + 5.0, far + math.sqrt(25 + 441 + 64)) == span(one, box)
    pairs = lined(wall, kind="exhaustive", laser_points=[[0, 0, 0.0], [3.0, -12.0, 4.0]], first_and_last_leg=True)
    last = max(math.sqrt(289) + 5.0, math.sqrt(25 + 441 + 64) + math.hypot(3, 15))
    assert (5.0 + 5.0 + 5.0 + 4.0, last + far + math.sqrt(17)) == span(pairs, box)
    # On the other side of it, and inside.
    assert span(lined([[11.0, 13.0, 12.0]]), box)[0] == 10.0 and span(lined([[5.0, 1, 5]]), box)[0] == 0.0
    axis = scan.default_axis(box, 0.75)
    assert axis == TimeAxis(9.75, 0.75, math.ceil(2 * math.sqrt(306) / 0.75) - 13)
    tiny = lined([[0, 0, 0]]).default_axis([[0, 0, 3.0], [0, 0, 3.0]], 2.0)
    assert tiny == TimeAxis(6.0, 2.0, 1)


@together("make, error", [
    (lambda: scan("biaxial"), ArgumentError), (lambda: scan("single", laser=(0.0, 0.0, 0.3)), SceneError),
    (lambda: scan("single", laser=(1.5, 0)), SceneError), (lambda: scan("single", laser=(np.nan, 0.0, 0.0)), UnitError),
    (lambda: scan("single", laser=(0.1, 0.2, 0.3, 0.4)), ShapeError), (lambda: scan("single", laser="a"), ShapeError),
    (lambda: scan("single", laser_grid=3), ArgumentError), (lambda: scan("confocal", laser=(0, 0, 0)), ArgumentError),
    (lambda: scan("confocal", laser_grid=4), ArgumentError),
    (lambda: scan("confocal", sensor_origin=(0, 0, -1)), SceneError),
    (lambda: scan("single", laser_origin=(0, 0, 0)), SceneError),
    (lambda: scan("single", sensor_origin=(0, 0)), ShapeError),
    (lambda: Scan.grid(WALL, 0, kind="single"), ShapeError),
    (lambda: Scan.grid(WALL, 1, kind="exhaustive"), SceneError),
    (lambda: points(LIST + np.array([0, 0, 0.1]), wall=WALL), SceneError),
    (lambda: points(laser_points=LIST), ArgumentError), (lambda: points(kind="single"), SceneError),
    (lambda: points(kind="single", laser_points=LIST), ShapeError),
    (lambda: points(kind="exhaustive", laser_points=LIST[0]), ShapeError), (lambda: points(LIST[0]), ShapeError),
    (lambda: points(LIST[:, :2]), ShapeError), (lambda: points(LIST * np.nan), UnitError),
    (lambda: points(torch.zeros(2, 3, dtype=torch.complex64)), ShapeError),
    (lambda: points(normals=LIST[:2]), ShapeError), (lambda: points(normals=0 * LIST), UnitError),
    (lambda: Scan("confocal", LIST, LIST + 1, sensor_origin=ORIGIN, laser_origin=ORIGIN), SceneError),
    (lambda: scan("single").default_axis(np.zeros((3, 2)), 0.01), ShapeError),
    (lambda: scan("single").default_axis([[0, 0, 1], [1, 1, 0.5]], 0.01), UnitError),
])  # fmt: skip
def test_what_is_no_scan(make, error):
    with pytest.raises(error):
        make()
