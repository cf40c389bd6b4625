"""Where a wall's coordinates are, and which points are on it: the last that are and the first that are not."""

import math

import numpy as np
import pytest

from torchtransient.capture import Wall
from torchtransient.capture.wall import _EDGE, ON_WALL, checked_mesh, first_hits, grid_size, triangle_normals
from torchtransient.errors import SceneError, ShapeError, UnitError

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
    assert SKEW.is_planar and repr(SKEW) == "Wall(plane, 6 x 4.472 m, center=[ 10., -20.,   5.])"


def test_points_on_the_edges_stand_a_millionth_of_size_and_distance_inside():
    # Of the diagonal and the largest coordinate of the middle, 20 m.
    inside = _EDGE * (math.sqrt(80) + 20.0)
    for (u, v), (side, along) in {
        (0.0, 0.5): (-1, SKEW.half_u), (1.0, 0.5): (1, SKEW.half_u), (0.5, 0.0): (-1, SKEW.half_v),
        (0.5, 1.0): (1, SKEW.half_v),
    }.items():  # fmt: skip
        half = np.linalg.norm(along)
        expected = SKEW.center + side * along * (1 - inside / half)
        np.testing.assert_allclose(SKEW.at(u, v)[0], expected, rtol=0, atol=1e-12)
    margin = inside / (2 * 3.0)
    np.testing.assert_allclose(SKEW.at(2 * margin, 0.5)[0][0], 7.0 + 6.0 * 2 * margin, rtol=0, atol=1e-12)


@pytest.mark.parametrize("u, v", [(-1e-9, 0.5), (1 + 1e-9, 0.5), (0.5, -1e-9), (0.5, 1 + 1e-9), (math.nan, 0.5)])
def test_coordinates_are_between_zero_and_one(u, v):
    SKEW.at([0.0, 1.0], [[0.0], [1.0]])
    with pytest.raises(SceneError, match="between 0 and 1"):
        SKEW.at([0.5, u], [0.5, v])


@pytest.mark.parametrize(("u", "v", "words"), [
    ("a", 0.5, r"as numbers, got 'a' and 0\.5"), (0.5, None, "as numbers"),
    ([0.1, 0.2], [0.1, 0.2, 0.3], r"shapes \(2,\)"),
])  # fmt: skip
def test_coordinates_that_are_none(u, v, words):
    with pytest.raises(ShapeError, match=f"Wall.at: expected coordinates .u, v. .*{words}"):
        SKEW.at(u, v)


def test_points_are_on_a_wall_to_a_share_of_its_diagonal():
    tolerance = ON_WALL * math.sqrt(80)
    across = np.array([0.0, 0.0, 1.0])
    for part, half in ((SKEW.half_u, 3.0), (SKEW.half_v, math.sqrt(5))):
        for side in (-1, 1):
            # Beside it: as far as it may be before it, along its own sides.
            edge = SKEW.center + side * part
            SKEW.normals_at((edge + 0.99 * side * tolerance * part / half)[None], "points")
            with pytest.raises(SceneError, match="beside it"):
                SKEW.normals_at((edge + 1.01 * side * tolerance * part / half)[None], "points")
            inner = SKEW.center + side * 0.9 * part
            normals = SKEW.normals_at(np.stack([inner + 0.99 * side * tolerance * across, inner]), "points")
            np.testing.assert_allclose(normals, [[0, 0, 1]] * 2)
            with pytest.raises(SceneError, match=r"points: .* got 1 of 2 elsewhere, the first at .*, 0\.0009034 m off"):
                SKEW.normals_at(np.stack([inner, inner + 1.01 * side * tolerance * across]), "points")


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
    tolerance = ON_WALL * wall.diagonal
    for off, taken in ((0.99, True), (-0.99, True), (1.01, False), (-1.01, False)):
        moved = points + off * tolerance * np.array([0, 0, 1])
        if taken:
            np.testing.assert_allclose(wall.normals_at(moved, "points"), [steep, flat], atol=1e-12)
            continue
        with pytest.raises(SceneError, match="got 2 of 2 elsewhere"):
            wall.normals_at(moved, "points")
    assert not wall.is_planar and "4 triangles" in repr(wall)


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


def test_a_surface_faces_one_side_by_a_thousandth_of_its_area():
    # Two triangles of areas 1 and 1 - s, wound both ways: what is left of them is s / (2 - s).
    for share, taken in ((0.0025, True), (0.0015, False)):
        side = math.sqrt(2 * (1 - share))
        one = [[0, 0, 0], [math.sqrt(2), 0, 0], [0, math.sqrt(2), 0]]
        vertices = np.array([*one, [9, 0, 0], [9, side, 0], [9 + side, 0, 0]])
        faces = [[0, 1, 2], [3, 4, 5]]
        if taken:
            np.testing.assert_allclose(Wall.mesh(vertices, faces).normal, [0, 0, 1], atol=1e-12)
            continue
        with pytest.raises(SceneError, match="normals cancel"):
            Wall.mesh(vertices, faces)


def test_directions_upwards_are_not_those_of_the_normal():
    for angle, taken in ((2e-9, True), (0.5e-9, False)):
        up = (3 * math.sin(angle), 0.0, 3 * math.cos(angle))
        if taken:
            np.testing.assert_allclose(Wall.plane(up=up).half_v, [1, 0, 0], atol=1e-6)
            continue
        with pytest.raises(SceneError, match="parallel to the wall's normal"):
            Wall.plane(up=up)


@pytest.mark.parametrize(("vertices", "faces", "error", "words"), [
    ("a", [[0, 1, 2]], ShapeError, "rows of three numbers"), (np.eye(3), None, ShapeError, "rows of three numbers"),
    (np.zeros(3), [[0, 1, 2]], ShapeError, r"shapes \(3,\) and \(1, 3\)"), (np.eye(3), [0, 1, 2], ShapeError, "shapes"),
    (np.eye(3), np.zeros((0, 3)), ShapeError, "shapes"), (np.eye(3), [[0, 1]], ShapeError, "shapes"),
    (np.eye(3)[:, :2], [[0, 1, 2]], ShapeError, "shapes"), (np.eye(3), [[0, 1, -1]], ShapeError, "from 0 to 2"),
    (np.eye(3), [[0, 1, 3]], ShapeError, "numbers from 0 to 3"), (np.eye(3), [[0, 1, 0.5]], ShapeError, "whole"),
    (1e9 * np.eye(3), [[0, 1, 2]], UnitError, "got 3 other numbers"), (-1e9 * np.eye(3), [[0, 1, 2]], UnitError, "1e"),
])  # fmt: skip
def test_meshes_that_are_none(vertices, faces, error, words):
    with pytest.raises(error, match=f"Method: expected .*{words}"):
        checked_mesh("Method", vertices, faces)


def test_meshes_are_copied():
    vertices = np.eye(3)
    points, faces = checked_mesh("Method", vertices, [[0, 1, 2]])
    vertices += 1
    assert np.array_equal(points, np.eye(3)) and faces.dtype == np.int64
    assert checked_mesh("Method", np.nextafter(1e9, 0) * np.eye(3), [[0, 1, 2]])[0].max() < 1e9


@pytest.mark.parametrize("size", [0, -1, 1.0, True, (2, 0), (2,), (2, 2, 2), (True, 2), (2**16, 2**16), (2**32, 1)])
def test_sizes_of_grids_that_are_none(size):
    with pytest.raises(ShapeError, match="Method: expected"):
        grid_size(size, "Method")


def test_sizes_of_grids():
    assert grid_size(3, "Method") == (3, 3) and grid_size((1, 2), "Method") == (1, 2)
    assert grid_size(np.array([4, 5]), "Method") == (4, 5) and grid_size((2**16, 2**16 - 1), "Method") == (65536, 65535)
    assert grid_size((2**32 - 1, 1), "Method") == (2**32 - 1, 1)


@pytest.mark.parametrize("extent", [
    (0.5, 0, 0.5, 1), (0, 0.5, 1, 0.5), (0.6, 0, 0.5, 1), (0, 0.6, 1, 0.5), (-1e-9, 0, 1, 1), (0, -1e-9, 1, 1),
    (0, 0, 1 + 1e-9, 1), (0, 0, 1, 1 + 1e-9), (math.nan, 0, 1, 1),
])  # fmt: skip
def test_extents_are_parts_of_the_wall(extent):
    with pytest.raises(SceneError, match="extent: expected 0 <= u0 < u1 <= 1"):
        SKEW.grid(2, extent)
    SKEW.grid(2, (0, 0, 1, 1))


def test_grids_run_along_their_own_sides():
    points, _ = Wall.plane(4.0, 2.0).grid((2, 3), (0.25, 0.5, 0.75, 1.0), cell_centers=False)
    # Rows along v from the middle to the upper edge, columns along u.
    np.testing.assert_allclose(points[..., 0], [[-1, 1]] * 3, atol=1e-5)
    np.testing.assert_allclose(points[..., 1], [[0, 0], [0.5, 0.5], [1, 1]], atol=1e-5)
    alone, _ = Wall.plane(4.0, 2.0).grid((1, 2), (0.25, 0.5, 0.75, 1.0), cell_centers=False)
    np.testing.assert_allclose(alone[..., 0], [[0], [0]], atol=1e-12)


# ------------------------------------------------------------------------------------------------- rays and triangles


def test_normals_of_triangles_are_of_length_one_or_zero():
    corners = np.array([[[0.0, 0, 0], [2, 0, 0], [0, 3, 0]], [[0, 0, 0], [0, 3, 0], [2, 0, 0]], [[0, 0, 0]] * 3,
                        [[0, 0, 0], [0, 0, 2], [0, 5, 0]]])  # fmt: skip
    np.testing.assert_array_equal(triangle_normals(corners), [[0, 0, 1], [0, 0, -1], [0, 0, 0], [-1, 0, 0]])


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


def test_of_equally_near_triangles_the_first_counts():
    plate = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0]])
    corners = np.stack([plate - np.array([0, 0, 1.0]), plate, plate[::-1], plate])
    assert first_hits(np.array([[0.5, -0.5, 2.0]]), np.array([0.0, 0, -1]), corners)[1].tolist() == [1]


def test_pieces_of_rays_do_not_show(monkeypatch):
    from torchtransient.capture import wall as triangles

    rng = np.random.default_rng(0)
    corners = rng.normal(size=(40, 3, 3))
    origins, direction = rng.normal(size=(60, 3)) - [0, 0, 6], np.array([0.0, 0.0, 1.0])
    whole = first_hits(origins, direction, corners)
    assert 10 < np.isfinite(whole[0]).sum() < 60
    for pairs in (1, 7, 100):
        monkeypatch.setattr(triangles, "_PAIRS_AT_ONCE", pairs)
        found = first_hits(origins, direction, corners)
        np.testing.assert_array_equal(found[0], whole[0])
        np.testing.assert_array_equal(found[1], whole[1])


def test_lists_of_triangles_stay_short():
    from torchtransient.capture.wall import _Cells

    rng = np.random.default_rng(1)
    large = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]]) + np.arange(100.0)[:, None, None] * [0, 0, 1]
    cells = _Cells(large, np.array([0.0, 0.0, 1.0]))
    # Each reaches into all of ten by ten cells, and of five by five: nine are made.
    assert cells._count == 3 and len(cells.triangles) == 900
    small = 3 * rng.normal(size=(100, 1, 3)) + 1e-3 * rng.normal(size=(100, 3, 3))
    cells = _Cells(small, np.array([0.0, 0.0, 1.0]))
    assert cells._count == 10 and len(cells.triangles) < 110
    # A ray beside all of them has no list; a list holds every triangle whose box it goes through.
    place = small.mean(1) + np.array([[0, 0, 5.0]])
    starts, counts = cells.candidates(np.concatenate([place, [[99.0, 0, 0], [0, -99.0, 0]]]))
    assert counts[-2:].tolist() == [0, 0]
    for k in range(100):
        assert k in cells.triangles[starts[k] : starts[k] + counts[k]]
