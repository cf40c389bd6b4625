"""Hidden scenes: plain data that Mitsuba builds, which faces the wall and hides parts of itself."""

import pickle

import numpy as np
import pytest

from support.sweeps import together
from torchtransient import scenes
from torchtransient.capture import Wall
from torchtransient.capture.wall import first_hits
from torchtransient.errors import ArgumentError, SceneError, UnitError
from torchtransient.scenes import rotate, scale, translate

ALL = {
    "nlos_z": scenes.nlos_z,
    "nlos_letter": scenes.nlos_letter,
    "solid letter": lambda: scenes.nlos_letter("S", thickness=0.1, subdivide=1),
    "nlos_plates": scenes.nlos_plates,
    "nlos_corner": scenes.nlos_corner,
    "nlos_mannequin": scenes.nlos_mannequin,
    "nlos_room": scenes.nlos_room,
}


def faces_of(shape):
    """Areas of triangles along their normals."""
    a, b, c = (shape["vertices"][shape["faces"][:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


def box(vertices):
    return [vertices.min(0), vertices.max(0)]


@pytest.mark.parametrize("name", ALL)
def test_descriptions_are_plain_data(name):
    shapes = ALL[name]()
    assert repr(pickle.loads(pickle.dumps(shapes))) == repr(shapes)
    low, high = scenes.bounds(shapes)
    assert low[2] >= 0 and (high > low).sum() >= 2
    for shape in shapes.values():
        assert shape["type"] in ("mesh_arrays", "rectangle", "cube") and shape["bsdf"]["type"] == "diffuse"


@pytest.mark.parametrize("name", ["nlos_z", "nlos_plates", "nlos_corner"])
def test_flat_parts_face_the_wall(name):
    for shape in ALL[name]().values():
        assert (faces_of(shape)[:, 2] < 0).all()


def test_the_corner_is_a_right_angle_and_partly_hidden():
    shapes = scenes.nlos_corner(1.0, 1.0)
    left, right = (faces_of(shapes[k]).sum(0) for k in ("left", "right"))
    assert left @ right == pytest.approx(0, abs=1e-12)
    corners = np.concatenate([s["vertices"][s["faces"]] for s in shapes.values()])
    _, index = first_hits(np.array([[0.3, 0.2, 0.0], [0.3, -0.2, 0.0]]), np.array([0.0, 0, 1.0]), corners)
    assert index.tolist()[0] >= 4 and 2 <= index.tolist()[1] < 4


def test_the_mannequin_hides_parts_of_itself():
    body = scenes.nlos_mannequin(depth=1.2, level=2)["body"]
    corners = body["vertices"][body["faces"]]
    count = 20 * 4**2
    shoulder = np.array([[-0.16 * 1.45 / 1.41, 0.2 * 1.45 / 1.41, 0.0]])
    ahead = np.array([0.0, 0.0, 1.0])
    _, first = first_hits(shoulder, ahead, corners)
    assert first[0] // count == 5, "the arm comes first"
    without = corners[: 5 * count]
    _, behind = first_hits(shoulder, ahead, without)
    assert behind[0] // count == 1, "and hides the trunk"
    assert np.ptp(body["vertices"][:, 1]) == pytest.approx(1.45, rel=2e-3)


@pytest.mark.parametrize("size", [{"width": 2.4, "height": 2.2, "depth": 2.4}, {"width": 6.0, "depth": 8.0}])
def test_everything_in_the_room_stays_in_it(size):
    sides = {"width": 3.6, "height": 2.6, "depth": 3.2, **size}
    shapes = scenes.nlos_room(**size)
    low, high = scenes.bounds(shapes)
    np.testing.assert_allclose(low, [-sides["width"] / 2, -sides["height"] / 2, 0], atol=1e-12)
    np.testing.assert_allclose(high, [sides["width"] / 2, sides["height"] / 2, sides["depth"]], atol=1e-12)
    middle = np.array([0, 0, sides["depth"] / 2])
    for name in ("floor", "ceiling", "left_wall", "right_wall", "back_wall"):
        wall = Wall.of(shapes[name])
        assert (middle - wall.center) @ wall.normal > 0, f"{name} looks into the room"
    wall = Wall.of(scenes.relay_wall(sides["width"], sides["height"]))
    np.testing.assert_allclose([wall.width, wall.height], [sides["width"], sides["height"]])
    for name, shape in shapes.items():
        inner_low, inner_high = scenes.bounds({name: shape})
        if shape["type"] != "rectangle":
            assert (inner_low > low - 1e-9).all() and (inner_high < high + 1e-9).all() and inner_low[2] > 0.3
    assert scenes.bounds({"p": shapes["person"]})[0][1] == pytest.approx(low[1])
    assert set(shapes) - set(scenes.nlos_room(**size, person=False)) == {"person"}


def test_boxes_of_shapes():
    moved = translate([1, 2, 3]) @ rotate([0, 0, 1], 90) @ scale([2.0, 3.0, 4.0])
    for shape, expected in (
        ({"type": "rectangle"}, [[-3, -2, 0], [3, 2, 0]]), ({"type": "cube"}, [[-3, -2, -4], [3, 2, 4]]),
        ({"type": "disk"}, [[-3, -2, 0], [3, 2, 0]]),
        ({"type": "sphere", "radius": 0.5}, [[-1.5, -1, -2], [1.5, 1, 2]]),
        ({"type": "sphere", "center": [1, 0, 2]}, [[-3, 0, 4], [3, 4, 12]]),
        ({"type": "mesh_arrays", "vertices": [[1, 0, 0], [0, 1, 1], [1, 1, 0]]}, [[-3, 0, 0], [0, 2, 4]]),
    ):  # fmt: skip
        found = scenes.bounds({"a": {**shape, "to_world": moved}})
        np.testing.assert_allclose(found, np.add(expected, [1, 2, 3]), atol=1e-12)
    both = scenes.bounds({"a": {"type": "cube"}, "b": {"type": "sphere", "center": [5, -3, 0]}, "name": "text"})
    np.testing.assert_allclose(both, [[-1, -4, -1], [6, 1, 1]])


def test_plates_and_corners():
    plates = scenes.nlos_plates(size=0.5, depth=0.75, gap=0.25, second_size=2.0)
    np.testing.assert_allclose(box(plates["front"]["vertices"]), [[-0.25, -0.25, 0.75], [0.25, 0.25, 0.75]])
    np.testing.assert_allclose(box(plates["back"]["vertices"]), [[-1, -1, 1], [1, 1, 1]])
    same = scenes.nlos_plates(size=0.5)
    assert np.ptp(same["back"]["vertices"][:, 0]) == pytest.approx(0.5)
    corner = scenes.nlos_corner(2.0, 3.0)
    np.testing.assert_allclose(box(corner["left"]["vertices"]), [[-1, -1, 3], [0, 1, 4]])
    np.testing.assert_allclose(box(corner["right"]["vertices"]), [[0, -1, 3], [1, 1, 4]])
    for name in ("left", "right"):
        vertices = corner[name]["vertices"]
        assert set(vertices[vertices[:, 0] == 0][:, 2]) == {4}
    np.testing.assert_allclose(box(corner["small"]["vertices"]), [[0.35, 0.15, 2.8], [0.85, 0.65, 2.8]], atol=1e-12)
    letter = scenes.nlos_letter("L", size=2.0, depth=1.5, thickness=0.25)["letter"]["vertices"]
    np.testing.assert_allclose(box(letter), [[-1, -1, 1.5], [1, 1, 1.75]])
    wall = scenes.relay_wall(3.0, 2.0)
    np.testing.assert_allclose(wall["to_world"], np.diag([1.5, 1, 1, 1]))


@together("make, error", [
    (lambda: scenes.nlos_mannequin(depth=0.51 * (1 - 1e-9), height=1.41, level=1), SceneError),  # reached by an arm
    (lambda: scenes.nlos_letter("A"), ArgumentError), (lambda: scenes.nlos_letter(size=0.0), UnitError),
    (lambda: scenes.nlos_letter(thickness=-1.0), UnitError), (lambda: scenes.nlos_plates(gap=0.0), UnitError),
    (lambda: scenes.nlos_z(albedo=1.2), UnitError), (lambda: scenes.relay_wall(-1.0), UnitError),
    (lambda: scenes.nlos_room(width=2.4 - 1e-6, level=0), UnitError),
    (lambda: scenes.bounds({}), SceneError), (lambda: scenes.bounds({"a": {"type": "obj"}}), SceneError),
])  # fmt: skip
def test_what_is_refused(make, error):
    with pytest.raises(error):
        make()
