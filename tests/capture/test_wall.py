"""Walls: coordinates against Mitsuba's own rectangle, points of curved ones against the surface they were made of."""

import pickle

import mitsuba as mi
import numpy as np
import pytest
import torch

from support.sweeps import together
from torchtransient.capture import Wall
from torchtransient.capture.wall import first_hits
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.scenes.transforms import rotate, scale, translate

TRANSFORMS = {
    "plain": np.eye(4),
    "mirrored": scale([-1.0, 1.0, 1.0]),
    "other side": scale([1.0, 1.0, -1.0]),
    "placed": translate([1.0, 2.0, 3.0]) @ rotate([1, 2, 3], 50) @ scale([0.5, 2.0, 3.0]),
}


def height(x, y):
    """A smooth bump."""
    return 0.2 * np.exp(-(x**2 + 2 * y**2))


def bump(n=40):
    """The graph of `height` over [-1, 1]^2 as a mesh, corners against the clock as seen from +z."""
    x, y = np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n + 1))
    vertices = np.stack([x, y, height(x, y)], axis=-1).reshape(-1, 3)
    i = np.arange(n * (n + 1)).reshape(n, n + 1)[:, :n].ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + n + 2], 1), np.stack([i, i + n + 2, i + n + 1], 1)])
    return vertices, faces


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("name", TRANSFORMS)
def test_coordinates_and_normals_are_those_of_mitsubas_rectangle(name, flip):
    mi.set_variant("llvm_ad_rgb")
    wall = Wall.of({"type": "rectangle", "to_world": TRANSFORMS[name], "flip_normals": flip})
    shape = mi.load_dict(
        {"type": "rectangle", "to_world": mi.ScalarTransform4f(TRANSFORMS[name]), "flip_normals": flip}
    )
    u, v = np.array([0.1, 0.7, 0.5]), np.array([0.2, 0.9, 0.5])
    theirs = shape.sample_position(0.0, mi.Point2f(u, v))
    points, normals = wall.at(u, v)
    np.testing.assert_allclose(points, np.array(theirs.p).T, atol=2e-6)
    np.testing.assert_allclose(normals - np.array(theirs.n).T, 0, atol=2e-6)


def test_a_plane_lies_as_it_is_told():
    wall = Wall.plane(2.0, 1.0, center=(1.0, 0.0, 0.0), normal=(-1.0, 0.0, 0.0), up=(0.0, 0.0, 1.0), albedo=0.7)
    np.testing.assert_allclose(wall.at(0.5, 0.5)[0], [1, 0, 0])
    np.testing.assert_allclose(wall.normal, [-1, 0, 0])
    np.testing.assert_allclose(wall.at(0.5, 1.0)[0], [1, 0, 0.5], atol=4e-6)
    # u runs along up x normal
    np.testing.assert_allclose(wall.at(1.0, 0.5)[0], [1, -1, 0], atol=4e-6)
    assert (wall.width, wall.height) == (2.0, 1.0)
    assert wall.diagonal == pytest.approx(np.sqrt(5))
    assert wall.shape["bsdf"]["reflectance"] == 0.7
    assert "2 x 1 m" in repr(wall)


@pytest.mark.parametrize("size", [1, 2, 3, 7, (5, 1), (1, 4), (64, 33), 128])
@pytest.mark.parametrize("centers", [True, False])
def test_all_points_of_a_grid_are_distinct_and_evenly_spaced(size, centers):
    points, normals = Wall.plane(1.9, 1.3, center=(0.1, 0.2, 0.0)).grid(size, cell_centers=centers)
    nx, ny = size if isinstance(size, tuple) else (size, size)
    assert points.shape == normals.shape == (ny, nx, 3)
    for axis, count, length, middle in ((0, nx, 1.9, 0.1), (1, ny, 1.3, 0.2)):
        places = points[0, :, 0] if axis == 0 else points[:, 0, 1]
        step = length / count if centers or count == 1 else length / (count - 1)
        expected = middle + (np.arange(count) - (count - 1) / 2) * step
        # Points on the edges stand a millionth inside.
        np.testing.assert_allclose(places, expected, atol=1e-14 if centers or count == 1 else 3e-6)
    # also in the single precision that a renderer works in
    assert len(np.unique(points.reshape(-1, 3).astype(np.float32), axis=0)) == nx * ny


def test_extent_is_a_part_of_the_wall():
    points, _ = Wall.plane(2.0, 2.0).grid((2, 2), (0.5, 0.0, 1.0, 0.5))
    np.testing.assert_allclose(points[..., 0], [[0.25, 0.75]] * 2)
    np.testing.assert_allclose(points[..., 1], [[-0.75] * 2, [-0.25] * 2])


def test_points_of_a_curved_wall_lie_on_it():
    vertices, faces = bump()
    wall = Wall.mesh(vertices, faces)
    np.testing.assert_allclose(wall.normal, [0, 0, 1], atol=1e-12)
    assert not wall.is_planar
    points, normals = wall.grid((9, 6), (0.05, 0.05, 0.95, 0.95))
    x, y = points[..., 0], points[..., 1]
    # the chord of an arc of 2/40 m at a curvature of at most 0.8 per metre stays 0.8 / 8 (2/40)^2 = 2.5e-4 m near it
    np.testing.assert_allclose(points[..., 2], height(x, y), atol=2.5e-4)
    slope = np.stack([2 * x * height(x, y), 4 * y * height(x, y), np.ones_like(x)], -1)
    slope /= np.linalg.norm(slope, axis=-1, keepdims=True)
    assert np.arccos((normals * slope).sum(-1)).max() < 0.8 * 2 / 40
    again = wall.normals_at(points.reshape(-1, 3), "points")
    np.testing.assert_allclose(again, normals.reshape(-1, 3))


def test_no_ray_slips_between_triangles():
    """Rays through vertices and edges of a mesh, in a direction that rounding does not treat kindly."""
    vertices, faces = bump(8)
    turn = rotate([0.3, 0.5, 0.7], 77)[:3, :3]
    corners = (vertices @ turn.T)[faces]
    inner = vertices[(np.abs(vertices[:, :2]) < 0.99).all(1)]
    edges = (corners[:, 0] + corners[:, 1]) / 2 @ turn
    edges = edges[(np.abs(edges[:, :2]) < 0.99).all(1)]
    targets = np.concatenate([inner, edges]) @ turn.T
    distance, index = first_hits(targets + 3 * turn[:, 2], -turn[:, 2], corners)
    assert (index >= 0).all()
    np.testing.assert_allclose(distance, 3.0, atol=1e-8)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_hits_are_those_of_a_search_over_all_triangles(seed):
    """Triangles of very different sizes in any place, in any direction."""
    rng = np.random.default_rng(seed)
    size = 10 ** rng.uniform(-3, 0.5, (400, 1, 1))
    corners = rng.normal(size=(400, 1, 3)) + size * rng.normal(size=(400, 3, 3))
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    origins = 1.5 * rng.normal(size=(500, 3)) - 4 * direction
    found, index = first_hits(origins, direction, corners)
    expected = np.full(500, np.inf)
    for a, b, c in corners:
        # o + t d = a + u (b - a) + v (c - a)
        t, u, v = np.linalg.solve(np.stack([-direction, b - a, c - a], 1), (origins - a).T)
        expected = np.where((t > 0) & (u >= 0) & (v >= 0) & (u + v <= 1), np.minimum(expected, t), expected)
    assert 100 < np.isfinite(expected).sum() < 500
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert ((index >= 0) == np.isfinite(expected)).all()


def test_the_first_triangle_counts():
    plate = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0]])
    corners = np.stack([plate, plate + np.array([0, 0, 0.5]), plate - np.array([0, 0, 1.0])])
    distance, index = first_hits(np.array([[0.5, -0.5, 2.0], [-0.5, 0.5, 2.0]]), np.array([0.0, 0, -1]), corners)
    assert index.tolist() == [1, -1]
    assert distance.tolist() == [1.5, np.inf]


def test_a_mesh_of_a_scene_dictionary_is_placed():
    vertices, faces = bump(4)
    given = {"type": "mesh_arrays", "vertices": vertices, "faces": faces, "to_world": translate([0, 0, 2.0])}
    wall = Wall.of(given)
    assert wall.shape is given
    assert wall.at(0.5, 0.5)[0][2] == pytest.approx(2.2, abs=1e-9)
    turned = Wall.of({**given, "flip_normals": True})
    np.testing.assert_allclose(turned.normal, [0, 0, -1], atol=1e-12)
    pair = Wall.of((torch.from_numpy(vertices), torch.from_numpy(faces)))
    np.testing.assert_allclose(pair.at(0.5, 0.5)[0], [0, 0, 0.2], atol=1e-9)


def test_walls_pickle():
    wall = Wall.mesh(*bump(4))
    copy = pickle.loads(pickle.dumps(wall))
    np.testing.assert_array_equal(copy.at(0.3, 0.4)[0], wall.at(0.3, 0.4)[0])


BALL = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, -1, -1]])
TETRAHEDRON = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]


@together(
    "make, error, message",
    [
        (lambda: Wall.plane(0.0, 1.0), UnitError, "width: expected a finite number greater than zero"),
        (lambda: Wall.plane(1.0, float("nan")), UnitError, "height: expected a finite number greater than zero"),
        (lambda: Wall.plane(normal=(0, 0, 0)), SceneError, "normal with a direction"),
        (lambda: Wall.plane(normal=(0, 1, 0)), SceneError, "parallel"),
        (lambda: Wall.plane(center=(0, 1)), ShapeError, "three numbers"),
        (lambda: Wall.plane(center=(0, 1, float("inf"))), UnitError, "finite"),
        (lambda: Wall.plane(albedo=1.5), UnitError, "between 0 and 1"),
        (lambda: Wall.of({"type": "sphere"}), SceneError, "'sphere'"),
        (lambda: Wall.of(3), ArgumentError, "got int"),
        (lambda: Wall.of({"type": "rectangle", "to_world": np.zeros((4, 4))}), SceneError, "inverse"),
        (lambda: Wall.of({"type": "rectangle", "to_world": np.eye(3)}), ShapeError, r"\(4, 4\)"),
        (lambda: Wall.mesh(BALL, TETRAHEDRON), SceneError, "faces one side"),
        (lambda: Wall.mesh(BALL, [[0, 1, 7]]), ShapeError, "from 0 to 3"),
        (lambda: Wall.mesh(BALL, [[0, 1, 1.5]]), ShapeError, "whole numbers"),
        (lambda: Wall.mesh(BALL[:, :2], [[0, 1, 2]]), ShapeError, r"\(V, 3\)"),
        (lambda: Wall.mesh(BALL * np.nan, [[0, 1, 2]]), UnitError, "finite"),
        (lambda: Wall.plane().grid(0), ShapeError, "at least 1"),
        (lambda: Wall.plane().grid((2, 2.5)), ShapeError, "whole number"),
        (lambda: Wall.plane().grid(2, (0, 0, 1)), ShapeError, "four"),
        (lambda: Wall.plane().grid(2, (0, 0, 1, 1.1)), SceneError, "u0 < u1"),
        (lambda: Wall.plane().at(0.5, 1.1), SceneError, "between 0 and 1"),
        (lambda: Wall.mesh(BALL[:3], [[0, 1, 2]]).grid(3), SceneError, "do not meet the mesh"),
        (lambda: Wall.plane().normals_at(np.array([[0, 0, 0], [0, 0, 0.01]]), "x"), SceneError, "0.01 m off"),
        (lambda: Wall.plane().normals_at(np.array([[1.1, 0, 0.0]]), "x"), SceneError, "beside"),
    ],
)
def test_what_is_no_wall(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_triangles_that_turn_their_back():
    vertices, faces = bump(4)
    faces[::9] = faces[::9, ::-1]
    with pytest.raises(SceneError, match="turn their back"):
        Wall.mesh(vertices, faces).grid(16)
