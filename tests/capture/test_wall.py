"""Walls: coordinates against Mitsuba's own rectangle, points of curved ones against the surface they were made of,
and rays against all triangles.
"""

import math
import pickle

import mitsuba as mi
import numpy as np
import pytest
import torch

from support.sweeps import together
from torchtransient.capture import Wall
from torchtransient.capture.wall import first_hits
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.scenes import rotate, scale, translate

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


@together("flip", [False, True])
@together("name", TRANSFORMS)
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


@together("size", [1, 2, 7, (5, 1), (64, 33)])
@together("centers", [True, False])
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


def test_points_of_a_curved_wall_lie_on_it():
    vertices, faces = bump()
    wall = pickle.loads(pickle.dumps(Wall.mesh(vertices, faces)))
    np.testing.assert_allclose(wall.normal, [0, 0, 1], atol=1e-12)
    assert wall.faces is not None
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


@together("seed", [1, 2])
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


BALL = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, -1, -1]])
TETRAHEDRON = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]


def test_triangles_that_turn_their_back():
    vertices, faces = bump(4)
    faces[::9] = faces[::9, ::-1]
    with pytest.raises(SceneError, match="turn their back"):
        Wall.mesh(vertices, faces).grid(16)


# A parallelogram: half sides (3, 0, 0) and (1, 2, 0), diagonals of (8, 4) and (4, -4).
SKEW = Wall.of({"type": "rectangle", "to_world": np.array(
    [[3.0, 1.0, 0.0, 10.0], [0.0, 2.0, 0.0, -20.0], [0.0, 0.0, 1.0, 5.0], [0.0, 0.0, 0.0, 1.0]]
)})  # fmt: skip
# A roof over 4 x 2 m, of which the ridge runs along y at a third of its width, 0.5 m high; against the clock from +z.
ROOF = (
    np.array([[0.0, 0, 0], [1.0, 0, 0.5], [4.0, 0, 0], [0.0, 2, 0], [1.0, 2, 0.5], [4.0, 2, 0]]),
    np.array([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]]),
)


def test_sides_and_diagonals_of_a_parallelogram():
    assert SKEW.width == 6.0 and SKEW.height == pytest.approx(2 * math.sqrt(5))
    assert SKEW.diagonal == pytest.approx(math.sqrt(80))
    other = Wall(SKEW.center, SKEW.half_u, -SKEW.half_v, normal=SKEW.normal, shape=SKEW.shape)
    assert other.diagonal == pytest.approx(math.sqrt(80))
    points, normals = SKEW.at([0.5, 0.75, 0.25], [0.5, 0.5, 0.75])
    np.testing.assert_allclose(points, [[10, -20, 5], [11.5, -20, 5], [9, -19, 5]])
    np.testing.assert_allclose(normals, [[0, 0, 1]] * 3)
    assert repr(SKEW) == "Wall(plane, 6 x 4.472 m, center=[ 10., -20.,   5.])"


def test_points_are_on_a_wall_to_a_share_of_its_diagonal():
    tolerance = 1e-4 * math.sqrt(80)
    for part in (SKEW.half_u, SKEW.half_v, -SKEW.half_u, -SKEW.half_v):
        # Beside it, along its own sides, and before it.
        for start, aside in ((part, part / np.linalg.norm(part)), (0.9 * part, np.array([0.0, 0.0, 1.0]))):
            point = SKEW.center + start
            normals = SKEW.normals_at(np.stack([point + 0.99 * tolerance * aside, SKEW.center]), "points")
            np.testing.assert_allclose(normals, [[0, 0, 1]] * 2)
            with pytest.raises(SceneError):
                SKEW.normals_at(np.stack([point + 1.01 * tolerance * aside, SKEW.center]), "points")


def test_points_of_a_roof_have_the_normals_of_its_sides():
    wall = Wall.mesh(*ROOF)
    np.testing.assert_allclose(wall.normal, [0, 0, 1], atol=1e-12)
    assert (wall.width, wall.height) == pytest.approx((4.0, 2.0))
    np.testing.assert_allclose(wall.center, [2, 1, 0.25], atol=1e-12)
    steep, flat = np.array([-0.5, 0, 1]) / math.sqrt(1.25), np.array([0.5 / 3, 0, 1]) / math.sqrt(1 + 0.25 / 9)
    points, normals = wall.at([0.125, 0.625], [0.25, 0.9])
    np.testing.assert_allclose(points, [[0.5, 0.5, 0.25], [2.5, 1.8, 0.25]], atol=1e-9)
    np.testing.assert_allclose(normals, [steep, flat], atol=1e-12)
    np.testing.assert_allclose(wall.normals_at(points, "points"), [steep, flat], atol=1e-12)
    tolerance = 1e-4 * wall.diagonal
    for side in (1, -1):
        moved = points + side * 0.99 * tolerance * np.array([0, 0, 1])
        np.testing.assert_allclose(wall.normals_at(moved, "points"), [steep, flat], atol=1e-12)
        with pytest.raises(SceneError):
            wall.normals_at(points + side * 1.01 * tolerance * np.array([0, 0, 1]), "points")
    assert "4 triangles" in repr(wall)


def test_the_frame_of_a_mesh_is_the_smallest_rectangle_around_it():
    vertices, faces = ROOF
    # A vertex that no triangle has does not count.
    loose = Wall.mesh(np.concatenate([vertices, [[99.0, 99, 99]]]), faces)
    np.testing.assert_allclose(loose.center, [2, 1, 0.25], atol=1e-12)
    sideways = Wall.mesh(vertices, faces, up=(1.0, 0.0, 0.0))
    # u runs along up x normal: -y.
    np.testing.assert_allclose(sideways.half_u, [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(sideways.half_v, [2, 0, 0], atol=1e-12)
    placed = Wall.of({"type": "mesh_arrays", "vertices": vertices, "faces": faces,
                      "to_world": [[0, 0, 1, 10], [1, 0, 0, 20], [0, 1, 0, 30], [0, 0, 0, 1]]})  # fmt: skip
    np.testing.assert_allclose(placed.center, [10.25, 22, 31], atol=1e-12)
    np.testing.assert_allclose(placed.normal, [1, 0, 0], atol=1e-12)


def test_rays_meet_what_is_before_them_up_to_the_edges():
    corners = np.array([[[0.0, 0, 0], [2, 0, 0], [0, 4, 0]]])
    down = np.array([0.0, 0, -1])
    hits = {
        (0.5, 1.0, 3.0): 3.0, (0.0, 0.0, 1.0): 1.0, (2.0, 0.0, 1.0): 1.0, (0.0, 4.0, 1.0): 1.0, (1.0, 2.0, 1.0): 1.0,
        # Beside it, behind it, in it.
        (-0.01, 1.0, 1.0): np.inf, (1.0, -0.01, 1.0): np.inf, (1.01, 2.01, 1.0): np.inf, (0.5, 1.0, -1.0): np.inf,
        (0.5, 1.0, 0.0): np.inf,
    }  # fmt: skip
    found, index = first_hits(np.array(list(hits)), down, corners)
    np.testing.assert_allclose(found, list(hits.values()))
    assert index.tolist() == [0 if np.isfinite(t) else -1 for t in hits.values()]
    # From behind as well; a triangle along the rays is none.
    found, _ = first_hits(np.array([[0.5, 1.0, -2.0]]), -down, corners)
    assert found.tolist() == [2.0]
    assert np.isinf(first_hits(np.array([[0.5, 1.0, -2.0]]), np.array([1.0, 0, 0]), corners)[0]).all()


def split(share):
    """Two triangles of areas 1 and 1 - share, wound both ways: share / (2 - share) is left of them."""
    side = math.sqrt(2 * (1 - share))
    one = [[0, 0, 0], [math.sqrt(2), 0, 0], [0, math.sqrt(2), 0]]
    return Wall.mesh([*one, [9, 0, 0], [9, side, 0], [9 + side, 0, 0]], [[0, 1, 2], [3, 4, 5]])


@together("make, error", [
    (lambda: Wall.plane(0.0, 1.0), UnitError), (lambda: Wall.plane(normal=(0, 0, 0)), SceneError),
    (lambda: Wall.plane(normal=(0, 1, 0)), SceneError), (lambda: Wall.plane(center=(0, 1)), ShapeError),
    (lambda: Wall.plane(center=(0, 1, math.inf)), UnitError), (lambda: Wall.plane(albedo=1.5), UnitError),
    (lambda: Wall.of({"type": "sphere"}), SceneError), (lambda: Wall.of(3), ArgumentError),
    (lambda: Wall.of({"type": "rectangle", "to_world": np.zeros((4, 4))}), SceneError),
    (lambda: split(0.0015), SceneError), (lambda: Wall.mesh(BALL, TETRAHEDRON), SceneError),
    (lambda: Wall.mesh(BALL, [[0, 1, 7]]), ShapeError), (lambda: Wall.mesh(BALL, [[0, 1, 1.5]]), ShapeError),
    (lambda: Wall.mesh(BALL[:, :2], [[0, 1, 2]]), ShapeError),
    (lambda: Wall.mesh(BALL * np.nan, [[0, 1, 2]]), UnitError),
    (lambda: Wall.plane().grid(0), ShapeError), (lambda: Wall.plane().grid((2**16, 2**16)), ShapeError),
    (lambda: Wall.plane().grid(2, (0, 0, 1)), ShapeError), (lambda: Wall.plane().grid(2, (0, 0, 1, 1.1)), SceneError),
    (lambda: Wall.plane().grid(2, (0.6, 0, 0.5, 1)), SceneError), (lambda: Wall.plane().at(0.5, 1.1), SceneError),
    (lambda: Wall.plane().at(0.5, math.nan), SceneError),
    (lambda: Wall.mesh(BALL[:3], [[0, 1, 2]]).grid(3), SceneError),
])  # fmt: skip
def test_what_is_no_wall(make, error):
    with pytest.raises(error):
        make()
    split(0.0025)
