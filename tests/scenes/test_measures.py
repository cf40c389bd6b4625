"""Sizes and places of what the scenes are made of: letters, bodies, furniture, the bottle. Metres."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from torchtransient import scenes
from torchtransient.errors import SceneError, UnitError
from torchtransient.scenes import meshes
from torchtransient.scenes.bottle import _smooth, lathe, write_ply
from torchtransient.scenes.nlos import _BODY, OUTLINES, mannequin, outline
from torchtransient.scenes.transforms import rotate, scale, translate


def area_of(corners):
    x, y = corners.T
    return (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return (np.cross(a, b) * c).sum() / 6


def box(vertices):
    return [vertices.min(0), vertices.max(0)]


def boxes(center, size):
    return [np.array(center) - np.array(size) / 2, np.array(center) + np.array(size) / 2]


# ----------------------------------------------------------------------------------------------------------- letters

# Of strokes 0.2 wide in a square of one metre.
AREAS = {
    "C": 0.2 * (1 + 2 * 0.8), "E": 0.2 * (1 + 2 * 0.8 + 0.6), "F": 0.2 * (1 + 0.8 + 0.6), "H": 0.2 * (2 + 0.6),
    "I": 0.2, "L": 0.2 * 1.8, "S": 0.2 * (3 + 2 * 0.2), "T": 0.2 * 1.8, "U": 0.2 * (2 + 0.6),
}  # fmt: skip


SLANTED = {
    "V": (0.2 + 1) / 2 - 0.6 * 0.75 / 2,
    "X": 1 - 2 * 0.54 * 0.36 / 2 - 2 * 0.38 / 2,
    "Y": 1 - 2 * 0.4 * (0.45 + 1) / 2 - 0.54 * 0.35 / 2,
    "N": 1 - 2 * 0.6 * 0.66 / 2,
    "Z": 2 * 0.2 + 0.27 * 0.6,
    "K": 0.2 + 0.2854,
}


@pytest.mark.parametrize("letter", AREAS)
def test_areas_of_straight_letters(letter):
    assert area_of(outline(letter)) == pytest.approx(AREAS[letter], rel=1e-12)
    assert area_of(outline(letter, 3.0)) == pytest.approx(9 * AREAS[letter], rel=1e-12)


def corners_of(letter):
    return {tuple(corner) for corner in np.round(OUTLINES[letter], 9).tolist()}


def turned(letter, x, y):
    return {tuple(corner) for corner in np.round([(x(a, b), y(a, b)) for a, b in OUTLINES[letter]], 9).tolist()}


@pytest.mark.parametrize("letter", OUTLINES)
def test_letters_fill_their_square_and_have_their_symmetries(letter):
    """About the upright, the level, or the middle."""
    low, high = box(np.array(OUTLINES[letter], float))
    assert (low[1], high[1]) == (0, 1) and (letter == "I" or (low[0], high[0]) == (0, 1))
    if letter in "HITUVXY":
        assert turned(letter, lambda a, b: 1 - a, lambda a, b: b) == corners_of(letter)
    if letter in "CEHIX":
        assert turned(letter, lambda a, b: a, lambda a, b: 1 - b) == corners_of(letter)
    if letter in "HINSXZ":
        assert turned(letter, lambda a, b: 1 - a, lambda a, b: 1 - b) == corners_of(letter)
    np.testing.assert_allclose(outline(letter, 3.0), (np.array(OUTLINES[letter]) - 0.5) * 3.0)


@pytest.mark.parametrize(("letter", "area"), SLANTED.items())
def test_areas_of_slanted_letters(letter, area):
    """The square less the triangles and corners that are cut out of it."""
    assert area_of(outline(letter)) == pytest.approx(area, rel=1e-12)


# ------------------------------------------------------------------------------------------------------------ meshes


def test_a_plate_of_cells():
    """Three by three pairs of triangles of one size, row by row, that face -z."""
    vertices, faces = meshes.plate(6.0, 1.5, [1.0, -2.0, 3.0], cells=3)
    x, y = np.meshgrid([-2.0, 0, 2, 4], [-2.75, -2.25, -1.75, -1.25])
    np.testing.assert_allclose(vertices, np.stack([x.ravel(), y.ravel(), np.full(16, 3.0)], 1), atol=1e-12)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    np.testing.assert_allclose(np.cross(b - a, c - a) / 2, [[0, 0, -0.5]] * 18, atol=1e-12)
    middles = np.sort(np.round((a + b + c) / 3, 9).view("f8,f8,f8").ravel())
    assert len(np.unique(middles)) == 18
    assert box(meshes.plate(2.0, 1.0)[0])[1].tolist() == [1, 0.5, 0] and len(meshes.plate(2.0, 1.0)[1]) == 2


@pytest.mark.parametrize("level", [0, 1, 3])
def test_bodies_made_of_an_octahedron(level):
    radii, center = np.array([0.3, 0.2, 0.1]), np.array([1.0, 2.0, 3.0])
    vertices, faces = meshes.octahedral_ellipsoid(center, radii, level)
    assert len(faces) == 8 * 4**level and len(vertices) == len(faces) // 2 + 2
    np.testing.assert_allclose((((vertices - center) / radii) ** 2).sum(1), 1, atol=1e-12)
    np.testing.assert_allclose(box(vertices), [center - radii, center + radii], atol=1e-12)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = {tuple(edge) for edge in edges.tolist()}
    assert len(forward) == len(edges) and {(b, a) for a, b in forward} == forward
    assert volume(vertices - center, faces) > 0
    if level == 0:
        assert volume(vertices - center, faces) == pytest.approx(4 / 3 * radii.prod())


def test_an_icosahedron():
    """Twelve corners on a unit sphere, each with five neighbours at one distance; its volume in closed form."""
    vertices, faces = meshes.ellipsoid([0, 0, 0], 1.0, 0)
    edge = 4 / np.sqrt(10 + 2 * np.sqrt(5))
    far = np.linalg.norm(vertices[:, None] - vertices, axis=-1)
    assert vertices.shape == (12, 3) and ((np.abs(far - edge) < 1e-12).sum(1) == 5).all()
    assert volume(vertices, faces) == pytest.approx(5 / 12 * (3 + np.sqrt(5)) * edge**3)


def test_arcs_are_halved():
    """Of an edge that is cut in four, all parts fill the same angle."""
    corners, faces = meshes.ellipsoid([0, 0, 0], 1.0, 0)
    a, b = corners[faces[0, :2]]
    fine = meshes.ellipsoid([0, 0, 0], 1.0, 2)[0]
    n, middle = np.cross(a, b), (a + b) / np.linalg.norm(a + b)
    on_the_arc = fine[(np.abs(fine @ n) < 1e-9) & (fine @ middle > a @ middle - 1e-9)]
    angles = np.sort(np.arccos(np.clip(on_the_arc @ a, -1, 1)))
    np.testing.assert_allclose(angles, np.linspace(0, np.arccos(a @ b), 5), atol=1e-7)


def test_several_meshes_as_one():
    one, two = meshes.plate(1.0, 2.0), meshes.plate(3.0, 1.0, [0, 0, 1.0], cells=2)
    vertices, faces = meshes.joined(one, two, one)
    np.testing.assert_array_equal(vertices, np.concatenate([one[0], two[0], one[0]]))
    np.testing.assert_array_equal(vertices[faces[2:10]], two[0][two[1]])
    np.testing.assert_array_equal(vertices[faces[10:]], one[0][one[1]])


def test_a_triangle_cut_in_four():
    """New corners in the middle of its edges; every piece is wound as the whole."""
    mesh = np.array([[0.0, 0, 0], [4, 0, 0], [0, 2, 0]]), np.array([[0, 1, 2]])
    vertices, faces = meshes.subdivided(mesh)
    assert {tuple(corner) for corner in vertices[3:].tolist()} == {(2, 0, 0), (2, 1, 0), (0, 1, 0)}
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    np.testing.assert_allclose(np.cross(b - a, c - a)[:, 2], [2, 2, 2, 2])
    assert len(meshes.subdivided(mesh, 8)[1]) == 4**8 and len(meshes.subdivided(mesh, 0)[1]) == 1
    with pytest.raises(SceneError, match="subdivide: expected at most 8, got 9"):
        meshes.subdivided(mesh, 9)


# Of whole numbers, so that what lies on a line stays there.
SHEARS = (np.eye(2), np.array([[2.0, 1], [1, 3]]), np.array([[1.0, -2], [3, 1]]))


def test_corners_against_the_clock_wherever_they_lie():
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    for middle in ([0, 0], [100, 50], [-100, 50], [100, -50], [-100, -50]):
        assert len(meshes.sheet(square + np.array(middle))[1]) == 2
        with pytest.raises(SceneError, match="against the clock"):
            meshes.sheet(square[::-1] + np.array(middle))


@pytest.mark.parametrize(
    "corners",
    [
        # An edge that ends on another one, runs along it, crosses it, comes back on itself.
        [[0, 0], [4, 0], [4, 3], [2, 0], [0, 3]], [[0, 0], [4, 0], [4, 2], [3, 0], [1, 0], [0, 2]],
        [[0, 0], [4, 0], [4, 3], [2, -1], [0, 3]], [[0, 0], [4, 0], [4, 3], [4, 1], [6, 1], [6, 4], [0, 4]],
    ],
)  # fmt: skip
def test_polygons_that_touch_themselves(corners):
    for shift in range(len(corners)):
        for shear in SHEARS:
            with pytest.raises(SceneError, match="cross or touch"):
                meshes.sheet(np.roll(corners, shift, axis=0) @ shear)


@pytest.mark.parametrize(
    "corners",
    [
        # Beside each other on one line, in a row, with a corner that is straight, with deep bays.
        [[0, 0], [1, 0], [1, 1], [2, 1], [2, 0], [3, 0], [3, 2], [0, 2]], [[0, 0], [1, 0], [2, 0], [2, 2], [0, 2]],
        [[0, 0], [5, 0], [5, 4], [4, 4], [4, 1], [1, 1], [1, 4], [0, 4]], [[0, 0], [2, 1], [4, 0], [2, 4]],
    ],
)  # fmt: skip
def test_polygons_that_do_not(corners):
    for shift, shear in itertools.product(range(len(corners)), SHEARS):
        points = np.roll(np.array(corners, float), shift, axis=0) @ shear
        vertices, faces = meshes.sheet(points, 2.0)
        assert len(faces) == len(corners) - 2 and (vertices[:, 2] == 2).all()
        a, b, c = (vertices[faces[:, k], :2] for k in (2, 1, 0))
        signed = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        assert (signed > 0).all() and signed.sum() / 2 == pytest.approx(area_of(points))


# ------------------------------------------------------------------------------------------------------ hidden things


def test_parts_of_a_body():
    """Six ellipsoids one after the other, larger than they are written by what 1.41 m are to the height."""
    vertices, faces = mannequin(2.82, 1)
    assert len(faces) == 6 * 80
    for part, (center, radii) in enumerate(_BODY):
        found = box(vertices[faces[part * 80 : (part + 1) * 80]].reshape(-1, 3))
        np.testing.assert_allclose(found, [2 * np.subtract(center, radii), 2 * np.add(center, radii)], atol=1e-12)
    assert np.ptp(vertices[:, 1]) == pytest.approx(2.82, rel=1e-12)
    moved = scenes.nlos_mannequin(depth=2.0, height=2.82, level=1, x=0.5)["body"]["vertices"]
    np.testing.assert_allclose(moved, vertices + np.array([0.5, 0, 2.0]))


def test_the_arm_reaches_up_to_the_wall():
    """0.51 m of a body of 1.41 m."""
    for height in (1.41, 2.82):
        reach = 0.51 * height / 1.41
        scenes.nlos_mannequin(depth=reach * (1 + 1e-9), height=height, level=1)
        with pytest.raises(SceneError, match=rf"depth: expected more than {reach:.3g} m, the reach of the arm"):
            scenes.nlos_mannequin(depth=reach * (1 - 1e-9), height=height, level=1)


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
    np.testing.assert_allclose(box(corner["small"]["vertices"]), boxes([0.6, 0.4, 2.8], [0.5, 0.5, 0]), atol=1e-12)
    letter = scenes.nlos_letter("L", size=2.0, depth=1.5, thickness=0.25)["letter"]["vertices"]
    np.testing.assert_allclose(box(letter), [[-1, -1, 1.5], [1, 1, 1.75]])
    wall = scenes.relay_wall(3.0, 2.0)
    np.testing.assert_allclose(wall["to_world"], np.diag([1.5, 1, 1, 1]))


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


# --------------------------------------------------------------------------------------------------------- the office

# Of a room 4 m wide, 3 m high and 3.4 m deep: middle and size of each block, from its right wall, floor and back wall.
RIGHT, FLOOR, BACK, LEFT = 2.0, -1.5, 3.4, -2.0
BLOCKS = {
    "desk_top": ([RIGHT - 0.45, FLOOR + 0.73, BACK - 1], [0.8, 0.04, 1.4]),
    "screen": ([RIGHT - 0.35, FLOOR + 0.98, BACK - 1], [0.03, 0.36, 0.6]),
    "chair_seat": ([RIGHT - 1.15, FLOOR + 0.45, BACK - 1], [0.44, 0.06, 0.44]),
    "chair_back": ([RIGHT - 1.35, FLOOR + 0.76, BACK - 1], [0.05, 0.5, 0.42]),
    "chair_post": ([RIGHT - 1.15, FLOOR + 0.21, BACK - 1], [0.08, 0.42, 0.08]),
    "shelf_side_0": ([LEFT + 0.25, FLOOR + 0.9, BACK - 0.17], [0.03, 1.8, 0.3]),
    "shelf_side_1": ([LEFT + 1.25, FLOOR + 0.9, BACK - 0.17], [0.03, 1.8, 0.3]),
    **{f"shelf_board_{n}": ([LEFT + 0.75, FLOOR + 0.05 + 0.42 * n, BACK - 0.17], [0.97, 0.03, 0.3]) for n in range(5)},
}


def room():
    return scenes.nlos_room(4.0, 3.0, 3.4, level=1)


@pytest.mark.parametrize("name", BLOCKS)
def test_furniture_stands_where_it_is_told(name):
    np.testing.assert_allclose(scenes.bounds({"a": room()[name]}), boxes(*BLOCKS[name]), atol=1e-12)


def test_the_faces_of_the_room_are_whole():
    found = {name: scenes.bounds({"a": shape}) for name, shape in room().items()}
    for name, low, high in (
        ("floor", [LEFT, FLOOR, 0], [RIGHT, FLOOR, BACK]), ("ceiling", [LEFT, -FLOOR, 0], [RIGHT, -FLOOR, BACK]),
        ("left_wall", [LEFT, FLOOR, 0], [LEFT, -FLOOR, BACK]), ("right_wall", [RIGHT, FLOOR, 0], [RIGHT, -FLOOR, BACK]),
        ("back_wall", [LEFT, FLOOR, BACK], [RIGHT, -FLOOR, BACK]),
    ):  # fmt: skip
        np.testing.assert_allclose(found[name], [low, high], atol=1e-12)


def test_things_stand_on_each_other():
    """Legs and the post on the floor, the desk on its legs, the seat on its post, books on the upper boards."""
    found = {name: scenes.bounds({"a": shape}) for name, shape in room().items()}
    legs = np.array([found[f"desk_leg_{n}"] for n in range(4)])
    np.testing.assert_allclose(legs[:, :, 1], [[FLOOR, FLOOR + 0.71]] * 4)
    np.testing.assert_allclose(legs[:, 1] - legs[:, 0], [[0.05, 0.71, 0.05]] * 4)
    around = [legs[:, 0].min(0), legs[:, 1].max(0)]
    np.testing.assert_allclose(np.subtract(around, found["desk_top"])[:, [0, 2]], [[0.015, 0.025], [-0.015, -0.025]])
    assert len({tuple(leg) for leg in np.round(legs[:, 0], 9).tolist()}) == 4
    assert np.argsort(legs[:, 0] @ [2, 0, 1]).tolist() == [0, 1, 2, 3]
    assert found["desk_top"][0, 1] == pytest.approx(FLOOR + 0.71)
    assert found["chair_seat"][0, 1] == pytest.approx(found["chair_post"][1, 1]) == pytest.approx(FLOOR + 0.42)
    middle = LEFT + 0.75
    for n, (at, length) in enumerate(((-0.25, 0.4), (0.2, 0.5), (-0.1, 0.7))):
        books = found[f"books_{n}"]
        assert books[0, 1] == pytest.approx(found[f"shelf_board_{n + 1}"][1, 1])
        expected = [[middle + at - length / 2, BACK - 0.24], [middle + at + length / 2, BACK - 0.04]]
        np.testing.assert_allclose(books[:, [0, 2]], expected)
        assert books[1, 1] - books[0, 1] == pytest.approx(0.26)


@pytest.mark.parametrize(("depth", "z"), [(2.4, 0.55 * 2.4), (3.4, 0.55 * 3.4), (8.0, 2.0)])
def test_the_person_stands_on_the_floor(depth, z):
    """1.7 m high, an eighth of the width beside the middle, at most two metres before the wall."""
    body = scenes.nlos_room(4.0, 3.0, depth, level=1)["person"]["vertices"]
    alone = mannequin(1.7, 1)[0]
    np.testing.assert_allclose(
        body - alone, np.broadcast_to([-0.5, FLOOR - alone[:, 1].min(), z], body.shape), atol=1e-12
    )
    assert np.ptp(body[:, 1]) == pytest.approx(1.7)


def test_rooms_that_are_too_small_for_their_furniture():
    scenes.nlos_room(2.4, 2.2, 2.4, level=0)
    for name, least in (("width", 2.4), ("height", 2.2), ("depth", 2.4)):
        with pytest.raises(UnitError, match=f"{name} beyond the {least} m of the furniture"):
            scenes.nlos_room(**{name: least - 1e-6}, level=0)
    colours = {shape["bsdf"]["reflectance"] for shape in scenes.nlos_room(albedo=0.25, level=0).values()}
    assert colours == {0.25}


# --------------------------------------------------------------------------------------------------------- the bottle


def test_corners_are_cut():
    """At a quarter and three quarters of each edge; the poles stay."""
    found = _smooth(((0.0, 0.0), (4.0, 0.0), (4.0, 8.0), (0.0, 12.0)), 1)
    np.testing.assert_allclose(found, [[0, 0], [3, 0], [4, 2], [4, 6], [3, 9], [0, 12]])
    assert _smooth(((0.0, 0.0), (4.0, 0.0), (0.0, 8.0)), 0).tolist() == [[0, 0], [4, 0], [0, 8]]


def test_a_body_of_revolution():
    """Of five corners around: a cylinder between two poles, its volume that of the prism with cones on both ends."""
    vertices, faces = lathe([[0, -1], [2, 0], [2, 3], [0, 5]], 5)
    angle = 2 * np.pi * np.arange(5) / 5
    ring = np.stack([2 * np.cos(angle), np.zeros(5), 2 * np.sin(angle)], 1)
    np.testing.assert_allclose(vertices[:10], np.concatenate([ring, np.add(ring, [0, 3, 0])]), atol=1e-6)
    assert vertices[10:].tolist() == [[0, -1, 0], [0, 5, 0]] and faces.shape == (20, 3)
    base = 5 / 2 * 4 * np.sin(2 * np.pi / 5)
    assert volume(vertices.astype(float), faces) == pytest.approx(base * (1 / 3 + 3 + 2 / 3), rel=1e-6)
    # Of more rings, each with its neighbours: of the straight side it changes nothing.
    more = lathe([[0, -1], [2, 0], [2, 1], [2, 2.5], [2, 3], [0, 5]], 5)
    assert more[1].shape == (40, 3) and volume(more[0].astype(float), more[1]) == pytest.approx(4 * base, rel=1e-6)
    for wrong in ([[0, -1], [2, 0], [0, 3], [0, 5]], [[0, -1], [-2, 0], [2, 3], [0, 5]]):
        with pytest.raises(SceneError, match="positive radii between the two ends"):
            lathe(wrong, 5)


def test_meshes_as_files(tmp_path):
    vertices, faces = np.arange(9, dtype=np.float32).reshape(3, 3), np.array([[0, 1, 2], [2, 1, 0]], np.int32)
    write_ply(tmp_path / "new" / "a.ply", vertices, faces)
    head, body = (tmp_path / "new" / "a.ply").read_bytes().split(b"end_header\n")
    assert b"element vertex 3\n" in head and b"element face 2\n" in head
    assert np.frombuffer(body[:36], "<f4").tolist() == list(range(9)) and len(body) == 36 + 2 * 13
    assert [body[36], *np.frombuffer(body[50:], "<i4")] == [3, 2, 1, 0]


def test_a_bottle_of_diluted_milk(tmp_path):
    """Scattering and absorption of each colour by their sums and quotients, in the unit of the extinction."""
    bottle = scenes.milk_bottle(tmp_path / "bottle.ply", milk=2.0, beam_degrees=10.0, index=1.4, roughness=0.1)
    inside, laser = bottle["bottle"]["interior"], bottle["laser"]["emitter"]
    scattering, absorption = 2.0 * np.array([4.6, 5.5, 6.7]), np.array([0.30, 0.06, 0.03])
    extinction = np.array(inside["sigma_t"]["value"]) * inside["scale"]
    np.testing.assert_allclose(extinction, scattering + absorption)
    np.testing.assert_allclose(np.array(inside["albedo"]["value"]) * extinction, scattering)
    assert (laser["cutoff_angle"], laser["beam_width"], inside["phase"]["g"]) == (10.0, 8.0, 0.7)
    assert (bottle["bottle"]["bsdf"]["int_ior"], bottle["bottle"]["bsdf"]["alpha"]) == (1.4, 0.1)
    up = np.array([0.0, 0, 1, 0])
    for name, height, half in (("laser", 0.002, 0.004), ("table", -0.0005, 0.5)):
        pose = bottle[name]["to_world"]
        np.testing.assert_allclose(pose @ up / half, [0, 1, 0, 0], atol=1e-12)
        np.testing.assert_allclose(pose[:3, 3], [0, height, 0])
        assert np.linalg.norm(pose[:3, 0]) == pytest.approx(half)
    # Blue light first, as far as 40 1/m.
    scenes.milk_bottle(tmp_path / "bottle.ply", milk=(40 - 0.03) / 6.7 * (1 - 1e-9))
    with pytest.raises(UnitError, match=r"milk: expected an extinction of at most 40\.0 1/m, got 40"):
        scenes.milk_bottle(tmp_path / "bottle.ply", milk=(40 - 0.03) / 6.7 * (1 + 1e-9))
    for wrong in ({"beam_degrees": 90.0}, {"beam_degrees": 0.0}, {"anisotropy": 1.0}, {"anisotropy": -1.0}):
        with pytest.raises(UnitError):
            scenes.milk_bottle(tmp_path / "bottle.ply", **wrong)
