"""Hidden scenes: plain data that Mitsuba builds, meshes that are closed where they say so and face the wall."""

import pickle

import mitsuba as mi
import numpy as np
import pytest

import torchtransient as tt
from torchtransient import scenes
from torchtransient.capture import Wall
from torchtransient.capture.wall import first_hits
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.scenes import meshes
from torchtransient.scenes.nlos import OUTLINES, outline
from torchtransient.scenes.transforms import rotate, scale, translate

ALL = {
    "nlos_z": scenes.nlos_z,
    "nlos_letter": scenes.nlos_letter,
    "solid letter": lambda: scenes.nlos_letter("S", thickness=0.1, subdivide=1),
    "nlos_plates": scenes.nlos_plates,
    "nlos_corner": scenes.nlos_corner,
    "nlos_mannequin": scenes.nlos_mannequin,
    "nlos_room": scenes.nlos_room,
}
CLOSED = {
    "ellipsoid": lambda: meshes.ellipsoid([1, 2, 3], [0.3, 0.2, 0.1], 2),
    "mannequin": lambda: scenes.nlos.mannequin(1.7, 2),
    **{letter: lambda letter=letter: meshes.solid(outline(letter), 1.0, 0.2) for letter in OUTLINES},
    "subdivided": lambda: meshes.subdivided(meshes.solid(outline("T"), 1.0, 0.2), 2),
}


def volume(vertices, faces):
    """Of a closed mesh, by the divergence theorem; positive when its normals point out."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return (np.cross(a, b) * c).sum() / 6


def normals(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


def area_of(corners):
    x, y = corners.T
    return (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2


@pytest.mark.parametrize("name", ALL)
def test_descriptions_are_plain_data(name):
    shapes = ALL[name]()
    assert repr(pickle.loads(pickle.dumps(shapes))) == repr(shapes)
    low, high = scenes.bounds(shapes)
    assert low[2] >= 0 and (high > low).sum() >= 2
    for shape in shapes.values():
        assert shape["type"] in ("mesh_arrays", "rectangle", "cube") and shape["bsdf"]["type"] == "diffuse"


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_mitsuba_builds_them_where_they_are_told(name):
    shapes = ALL[name]()
    sensor = {"type": "perspective", "film": {"type": "hdrfilm"}}
    scene = tt.load(
        {"type": "scene", "integrator": {"type": "path"}, "sensor": sensor, **shapes}, variant="llvm_ad_mono"
    )
    table = scene.parameters()
    for key, shape in shapes.items():
        assert f"{key}.bsdf.reflectance.value" in table
        if shape["type"] == "mesh_arrays":
            np.testing.assert_allclose(table[f"{key}.vertex_positions"].value, shape["vertices"], atol=1e-6)


@pytest.mark.parametrize("name", CLOSED)
def test_bodies_are_closed_and_their_normals_point_out(name):
    vertices, faces = CLOSED[name]()
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = {tuple(edge) for edge in edges.tolist()}
    assert len(forward) == len(edges), "an edge runs one way once"
    assert {(b, a) for a, b in forward} == forward, "and once the other way"
    assert volume(vertices, faces) > 0


@pytest.mark.parametrize("letter", OUTLINES)
def test_letters_are_tiled_by_their_triangles(letter):
    corners = outline(letter, 2.0)
    vertices, faces = meshes.sheet(corners, 1.5)
    assert (vertices[:, 2] == 1.5).all() and len(faces) == len(corners) - 2
    towards = normals(vertices, faces)
    assert (towards[:, 2] < 0).all(), "all triangles face the wall"
    assert -towards[:, 2].sum() == pytest.approx(area_of(corners), rel=1e-12)
    # triangles of the right total area that overlap nowhere cover the polygon
    points = np.random.default_rng(1).uniform(-1, 1, (4000, 2))
    a, b, c = (vertices[faces[:, k], :2] for k in (2, 1, 0))

    def left_of(p, q):
        e, d = q - p, points[:, None] - p
        return e[:, 0] * d[..., 1] - e[:, 1] * d[..., 0] > 0

    covered = (left_of(a, b) & left_of(b, c) & left_of(c, a)).sum(1)
    assert covered.max() == 1
    # a share of n points has the standard error sqrt(p (1 - p) / n) <= 0.0079
    assert covered.mean() == pytest.approx(area_of(corners) / 4, abs=4 * 0.0079)
    assert np.abs(corners).max() <= 1


def test_the_volume_of_a_solid_letter():
    vertices, faces = meshes.solid(outline("E"), 1.0, 0.25)
    assert volume(vertices, faces) == pytest.approx(0.25 * area_of(outline("E")), rel=1e-12)
    assert vertices[:, 2].min() == 1.0 and vertices[:, 2].max() == 1.25


def test_ellipsoids():
    radii = np.array([0.3, 0.2, 0.1])
    for level in (0, 1, 3):
        vertices, faces = meshes.ellipsoid([1, 2, 3], radii, level)
        assert len(faces) == 20 * 4**level
        np.testing.assert_allclose((((vertices - [1, 2, 3]) / radii) ** 2).sum(1), 1, atol=1e-12)
    # what is lost to flat triangles falls by 4 with every level
    full = 4 / 3 * np.pi * radii.prod()
    lost = [1 - volume(*meshes.ellipsoid([0, 0, 0], radii, level)) / full for level in (2, 3, 4)]
    assert lost[0] / lost[1] == pytest.approx(4, rel=0.05) and lost[1] / lost[2] == pytest.approx(4, rel=0.02)


def test_subdivision_keeps_the_surface():
    mesh = meshes.sheet(outline("K"))
    fine = meshes.subdivided(mesh, 2)
    assert len(fine[1]) == 16 * len(mesh[1])
    np.testing.assert_allclose(normals(*fine).sum(0), normals(*mesh).sum(0), atol=1e-12)
    np.testing.assert_array_equal(fine[0][: len(mesh[0])], mesh[0])


@pytest.mark.parametrize("name", ["nlos_z", "nlos_plates", "nlos_corner"])
def test_flat_parts_face_the_wall(name):
    for shape in ALL[name]().values():
        assert (normals(shape["vertices"], shape["faces"])[:, 2] < 0).all()


def test_the_corner_is_a_right_angle_and_partly_hidden():
    shapes = scenes.nlos_corner(1.0, 1.0)
    left, right = (normals(shapes[k]["vertices"], shapes[k]["faces"]).sum(0) for k in ("left", "right"))
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
    with pytest.raises(SceneError, match="reach of the arm"):
        scenes.nlos_mannequin(depth=0.4)


@pytest.mark.parametrize("size", [{}, {"width": 2.4, "height": 2.2, "depth": 2.4}, {"width": 6.0, "depth": 8.0}])
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


def test_bounds_are_those_of_mitsuba():
    mi.set_variant("llvm_ad_mono")
    pose = translate([1, 2, 3]) @ rotate([1, 1, 0], 30) @ scale([0.5, 2.0, 1.5])
    shapes = {
        "rectangle": {"type": "rectangle", "to_world": pose},
        "cube": {"type": "cube", "to_world": pose},
        "disk": {"type": "disk", "to_world": translate([1, 2, 3]) @ rotate([1, 1, 0], 30) @ scale(2.0)},
        "sphere": {"type": "sphere", "center": [1.0, 0, 0], "radius": 0.5, "to_world": translate([0, 1, 0])},
    }
    for name, shape in shapes.items():
        theirs = mi.load_dict({**shape, "to_world": mi.ScalarTransform4f(shape["to_world"])}).bbox()
        low, high = scenes.bounds({name: shape})
        # Mitsuba's box of a disk is that of the square around it
        slack = 1.0 if name == "disk" else 1e-5
        assert (low >= np.array(theirs.min) - 1e-5).all() and (low <= np.array(theirs.min) + slack).all()
        assert (high <= np.array(theirs.max) + 1e-5).all() and (high >= np.array(theirs.max) - slack).all()
    angle = np.linspace(0, 2 * np.pi, 1000)
    rim = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1) @ shapes["disk"]["to_world"][:3, :3].T + [1, 2, 3]
    np.testing.assert_allclose(scenes.bounds({"d": shapes["disk"]}), [rim.min(0), rim.max(0)], atol=1e-4)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: scenes.nlos_letter("A"), ArgumentError, "expected one of C, E"),
        (lambda: scenes.nlos_letter(size=0.0), UnitError, "size"),
        (lambda: scenes.nlos_letter(thickness=-1.0), UnitError, "thickness"),
        (lambda: scenes.nlos_plates(gap=0.0), UnitError, "gap"),
        (lambda: scenes.nlos_z(albedo=1.2), UnitError, "albedo"),
        (lambda: scenes.nlos_room(depth=1.0), UnitError, "depth beyond the 2.4 m"),
        (lambda: scenes.relay_wall(-1.0), UnitError, "width"),
        (lambda: scenes.triangle_mesh(np.zeros((3, 2)), [[0, 1, 2]]), ShapeError, r"\(V, 3\)"),
        (lambda: scenes.triangle_mesh(np.zeros((3, 3)), [[0, 1, 3]]), ShapeError, "whole numbers from 0 to 2"),
        (lambda: scenes.bounds({}), SceneError, "without any"),
        (lambda: scenes.bounds({"a": {"type": "obj"}}), SceneError, "'obj' at a"),
        (lambda: meshes.sheet(outline("T")[::-1]), SceneError, "against the clock"),
        (lambda: meshes.sheet([[0, 0], [1, 0]]), ShapeError, "three corners"),
        (lambda: meshes.sheet([[0, 0], [2, 0], [2, 2], [1, -1], [0, 2]]), SceneError, "cross or touch"),
        (lambda: meshes.sheet([[0, 0], [2, 0], [2, 2], [1, 0], [0, 2]]), SceneError, "cross or touch"),
    ],
)
def test_what_is_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()
