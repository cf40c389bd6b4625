"""Scans: where their points are, which lengths they count, and what is refused."""

import pickle

import numpy as np
import pytest
import torch

from support.sweeps import together
from torchtransient.capture import Scan, Wall
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError

WALL = Wall.plane(2.0, 1.6)
ORIGIN = (-0.5, 0.0, 0.25)
LIST = np.array([[0.1, 0.2, 0.0], [0.3, -0.4, 0.0], [-0.6, 0.7, 0.0]])


def scan(kind, **changes):
    return Scan.grid(WALL, (4, 3), kind=kind, **changes)


def test_shapes_and_pairs():
    assert scan("single").shape == (3, 4)
    assert scan("confocal").shape == (3, 4)
    assert scan("exhaustive").shape == (3, 4, 3, 4)
    assert scan("exhaustive", laser_grid=(5, 2)).shape == (2, 5, 3, 4)
    assert scan("exhaustive", laser_grid=(5, 2)).pairs == 120
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


def test_default_origins_see_the_wall():
    made = scan("single")
    torch.testing.assert_close(made.sensor_origin, torch.tensor(ORIGIN, dtype=torch.float64))
    assert made.sensor_origin.dtype == torch.float64


def test_spacing():
    assert scan("confocal").spacing == pytest.approx((0.5, 1.6 / 3))
    assert scan("confocal", cell_centers=False).spacing == pytest.approx((2 / 3, 0.8), rel=1e-5)
    with pytest.raises(ShapeError, match="2 x 2"):
        _ = Scan.grid(WALL, (1, 3), kind="confocal").spacing
    bent = scan("confocal").sensor_points.clone()
    bent[1, 1, 0] += 0.01
    with pytest.raises(ShapeError, match="regular"):
        _ = Scan.points(bent, kind="confocal", sensor_origin=ORIGIN, laser_origin=ORIGIN).spacing


def test_planar():
    assert scan("exhaustive").is_planar
    assert Scan.grid(WALL, 1, kind="confocal").is_planar
    bent = scan("confocal").sensor_points.clone()
    bent[1, 1, 2] += 0.01
    assert not Scan.points(bent, kind="confocal", sensor_origin=ORIGIN, laser_origin=ORIGIN).is_planar


def test_legs():
    made = Scan.grid(WALL, (4, 3), kind="exhaustive", laser_grid=2, sensor_origin=(0, 0, 1), laser_origin=(1, 0, 2))
    assert made.legs.shape == made.shape
    expected = (made.laser_points[1, 0] - torch.tensor([1.0, 0, 2])).norm() + (
        made.sensor_points[2, 3] - torch.tensor([0.0, 0, 1])
    ).norm()
    torch.testing.assert_close(made.legs[1, 0, 2, 3], expected)
    single = scan("single", laser_origin=(0, 0, 3))
    torch.testing.assert_close(single.legs, single.sensor_legs + 3.0)


@pytest.mark.parametrize("kind, legs", [("single", True), ("confocal", False), ("exhaustive", True)])
def test_default_axis_holds_every_path_and_little_else(kind, legs):
    made = scan(kind, first_and_last_leg=legs)
    box = np.array([[-0.3, -0.2, 0.8], [0.5, 0.4, 1.1]])
    axis = made.default_axis(box, 0.01)
    generator = torch.Generator().manual_seed(3)
    inside = torch.rand(20000, 3, generator=generator, dtype=torch.float64)
    inside = torch.cat([inside, inside.round()])  # corners too
    places = torch.from_numpy(box[0]) + inside * torch.from_numpy(box[1] - box[0])
    to_laser = torch.cdist(made.laser_points.reshape(-1, 3), places)
    to_sensor = torch.cdist(made.sensor_points.reshape(-1, 3), places)
    if kind == "confocal":
        lengths = to_laser + to_sensor + (made.legs.reshape(-1, 1) if legs else 0)
    else:
        lengths = to_laser[:, None] + to_sensor
        lengths = lengths + (made.legs.reshape(len(to_laser), -1, 1) if legs else 0)
    assert axis.start_opl <= float(lengths.min()) and float(lengths.max()) <= axis.end_opl
    assert axis.end_opl < float(lengths.max()) + 0.3
    if kind == "confocal" and not legs:
        assert axis.start_opl > float(lengths.min()) - 0.05
        assert axis.end_opl < float(lengths.max()) + 0.011
    assert axis.start_opl / 0.01 == pytest.approx(round(axis.start_opl / 0.01))


@pytest.mark.parametrize(
    ("bounds", "width", "error"),
    [
        (np.zeros((3, 2)), 0.01, ShapeError),
        ([[0, 0, 1], [1, 1, 0.5]], 0.01, UnitError),
        ([[0, 0, 1], [1, 1, np.nan]], 0.01, UnitError),
        ([[0, 0, 1], [1, 1, 2]], 0.0, UnitError),
    ],
)
def test_bounds_that_are_none(bounds, width, error):
    with pytest.raises(error, match="default_axis"):
        scan("single").default_axis(bounds, width)


@pytest.mark.parametrize("kind", ["single", "confocal", "exhaustive"])
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
    for wrong in (3, (3, 0), (0, 0, 0)):
        with pytest.raises(ShapeError, match="index"):
            made.single(wrong)
    with pytest.raises(SceneError, match="exhaustive"):
        scan("single").single(0)
    with pytest.raises(SceneError, match="spots are its sensor points"):
        scan("exhaustive", laser_grid=3).confocal()


def test_points_keep_their_gradients():
    points = torch.tensor(LIST, requires_grad=True)
    made = Scan.points(points, kind="confocal", sensor_origin=ORIGIN, laser_origin=ORIGIN, wall=WALL)
    made.sensor_legs.sum().backward()
    assert points.grad is not None and bool(points.grad.abs().sum() > 0)


def points(given=LIST, **changes):
    defaults = {"kind": "confocal", "sensor_origin": ORIGIN, "laser_origin": ORIGIN}
    return Scan.points(given, **{**defaults, **changes})


@together(
    "make, error, message",
    [
        (lambda: scan("biaxial"), ArgumentError, "single, confocal, exhaustive"),
        (lambda: scan("single", laser=(0.0, 0.0, 0.3)), SceneError, "0.3 m off"),
        (lambda: scan("single", laser=(1.5, 0.0, 0.0)), SceneError, "beside"),
        (lambda: scan("single", laser=(1.5, 0.0)), SceneError, "between 0 and 1"),
        (lambda: scan("single", laser=(np.nan, 0.0, 0.0)), UnitError, "finite"),
        (lambda: scan("single", laser_grid=3), ArgumentError, "laser_grid has no meaning"),
        (lambda: scan("confocal", laser=(0, 0, 0)), ArgumentError, "laser has no meaning"),
        (lambda: scan("confocal", laser_grid=4), ArgumentError, "laser_grid has no meaning"),
        (lambda: scan("confocal", sensor_origin=(0, 0, -1)), SceneError, "12 of 12 points"),
        (lambda: scan("single", laser_origin=(0, 0, 0)), SceneError, "laser_origin in front of the wall"),
        (lambda: scan("single", sensor_origin=(0, 0)), ShapeError, "sensor_origin"),
        (lambda: scan("single", sensor_origin=(0, 0, np.inf)), UnitError, "finite"),
        (lambda: scan("single", sensor_origin="left"), ShapeError, "three numbers"),
        (lambda: Scan.grid(WALL, 0, kind="single"), ShapeError, "at least 1"),
        (lambda: Scan.grid(WALL, 1, kind="exhaustive"), SceneError, "grid of one point"),
        (lambda: points(LIST + np.array([0, 0, 0.1]), wall=WALL), SceneError, "3 of 3"),
        (lambda: points(laser_points=LIST), ArgumentError, "laser_points has no meaning"),
        (lambda: points(kind="single"), SceneError, "expected laser_points"),
        (lambda: points(kind="single", laser_points=LIST), ShapeError, r"\(3,\), the one spot"),
        (lambda: points(kind="exhaustive", laser_points=LIST[0]), ShapeError, r"\(Ly, Lx, 3\)"),
        (lambda: points(LIST[0]), ShapeError, "sensor_points"),
        (lambda: points(LIST[:, :2]), ShapeError, r"\(\.\.\., 3\)"),
        (lambda: points(LIST * np.nan), UnitError, "finite"),
        (lambda: points(np.zeros((0, 3))), ShapeError, r"\(0, 3\)"),
        (lambda: points(normals=LIST[:2]), ShapeError, "sensor_normals"),
        (lambda: points(normals=0 * LIST), UnitError, "direction"),
        (lambda: scan("single").to(torch.float32), ShapeError, "device"),
        (lambda: Scan("confocal", LIST, LIST + 1, sensor_origin=ORIGIN, laser_origin=ORIGIN), SceneError,
         "sensor points, got others"),
        (lambda: Scan("confocal", LIST, LIST, sensor_origin=ORIGIN, laser_origin=ORIGIN, wall="wall"), ArgumentError,
         "dictionary"),
    ],
)
def test_what_is_no_scan(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_a_grid_of_one_point_is_a_scan():
    assert Scan.grid(WALL, 1, kind="confocal").sensor_points.tolist() == [[[0, 0, 0]]]
    assert Scan.grid(WALL, 1, kind="single", laser=(0.2, 0.2)).pairs == 1
    assert Scan.grid(WALL, 1, kind="exhaustive", laser_grid=2).shape == (2, 2, 1, 1)


@pytest.mark.parametrize(
    ("height", "words"), [(0.0, "it is in the wall itself"), (-0.25, "behind them by up to 0.25 m")]
)
def test_origins_that_see_nothing(height, words):
    with pytest.raises(SceneError, match=words):
        Scan.grid(Wall.plane(2.0, 2.0), 2, kind="confocal", sensor_origin=(0.0, 0.0, height))
