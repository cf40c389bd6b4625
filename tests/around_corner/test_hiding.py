"""What may hide what, exactly at the bounds: planes that touch, bodies of a few corners, creases that are just flat."""

from __future__ import annotations

import numpy as np
import pytest

from support.hidden_shapes import join, mesh, plate, wall_grid
from torchtransient.plugins.around_corner import outline_table as edges_module
from torchtransient.plugins.around_corner import outline_table as hiding
from torchtransient.plugins.around_corner.outline_table import Edges, parts_of
from torchtransient.plugins.edges.joined import Triangles
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_mono"
ORIGIN = np.zeros((1, 3))
NONE = np.zeros((0, 3))


def test_planes_are_turned_as_often_as_is_said(monkeypatch):
    a, b = np.array([[-1.0, 0, 11], [9, -9, -1], [6, 9, 1]]), np.array([[-4.0, 7, 5], [-4, 6, 1], [-2, 3, 7]])
    for steps, found in ((2, False), (3, True)):
        monkeypatch.setattr(hiding, "STEPS", steps)
        assert hiding._cones_apart(a, b, ORIGIN).tolist() == [found]


def test_points_in_a_plane_are_not_parted_by_it():
    """A plane that holds one of them is turned on; a viewpoint at one of them is in every plane."""
    assert hiding._cones_apart(np.array([[1.0, 0, 0]] * 3 + [[-1, 2, 2]]), NONE, ORIGIN).tolist() == [True]
    a, b = np.array([[0.5, 0, 1.0]]), np.array([[-0.5, 0, 1.0]])
    assert hiding._cones_apart(a, b, np.concatenate([a, b, ORIGIN])).tolist() == [False, False, True]


def test_a_few_viewpoints_are_asked_first(monkeypatch):
    asked = []
    monkeypatch.setattr(hiding, "_is_beyond", lambda *given: False)
    monkeypatch.setattr(hiding, "_cones_apart", lambda a, b, q: asked.append(len(q)) or np.ones(len(q), dtype=bool))
    parts, _ = parts_of([mesh(name, plate(1, 1, (x, 0, 1))) for name, x in (("a", 0), ("b", 3))])
    for count, first in ((7, 7), (16, 16), (100, 16)):
        asked.clear()
        assert hiding.hiding_pairs(parts, np.random.default_rng(1).random((count, 3)), lambda i, j: i == 0) == []
        assert asked == [first, count]


def test_what_touches_a_plane_is_beyond_it(monkeypatch):
    monkeypatch.setattr(hiding, "ROUNDING", 0.0)
    parts, _ = parts_of([mesh(name, plate(1, 1, (x, 0, 1))) for name, x in (("a", 0), ("b", 0.25))])
    for part in parts:
        part.planes = np.array([[0.0, 0, 1]])
    assert hiding._is_beyond(*parts, wall_grid(2)[0])


def octahedron(faces):
    v = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
    f = [[x, y, z] if (x + y + z) % 2 else [y, x, z] for x in (0, 1) for y in (2, 3) for z in (4, 5)]
    return v, np.array(f[:faces])


def test_bodies_as_thin_as_rounding_are_not_flat_yet(monkeypatch):
    body = mesh("open", octahedron(7))
    for rounding, unknown in ((1.0, True), (1.001, False)):
        monkeypatch.setattr(hiding, "ROUNDING", rounding)
        assert parts_of([body])[0][0].hides_itself is unknown


def test_bodies_of_just_as_many_corners_have_no_box(monkeypatch):
    body = mesh("body", octahedron(8))
    for most, corners in ((6, 6), (5, 8)):
        monkeypatch.setattr(hiding, "MOST_CORNERS", most)
        assert len(parts_of([body])[0][0].corners) == corners


@pytest.mark.parametrize("side", [1, -1])
def test_corners_as_far_off_a_face_as_is_allowed(side):
    """On both sides of it: one of them makes a body that is not convex."""
    v = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0.25, 0.5, 0.5 * side], [0.5, 0.5, -1.0 * side]])
    triangles, faces = Local(vertices=v, faces=np.array([[0, 1, 2]])), np.array([0])
    assert not hiding._is_convex(triangles, faces, v, 0.5)
    assert hiding._is_convex(triangles, faces, v, 0.5 + 1e-12)


def test_parts_as_many_as_are_told_apart(monkeypatch):
    """One more, and those of a mesh count as one."""
    pair = mesh("pair", join(plate(1, 1, (-2, 0, 1)), plate(1, 1, (2, 0, 1))))
    for most, parts in ((2, 2), (1, 1)):
        monkeypatch.setattr(hiding, "MOST_PARTS", most)
        assert len(parts_of([pair])[0]) == parts


# --------------------------------------------------------------------------------------------------------------- edges


def page(x, z, far=1.0):
    return np.array([[0, 0, 0], [0, far, 0], [x, 0, z]], dtype=float), np.array([[0, 1, 2]])


def edges_of(*pages):
    triangles = Triangles.from_meshes([mesh("book", join(*pages))])
    return Edges.from_faces(triangles, np.arange(len(triangles.faces)))


def test_creases_exactly_as_flat_as_is_allowed_are_none(monkeypatch):
    """Of two faces, and of three whose widest gap is half a turn."""
    for flat, edges in ((1.0, 4), (1.0 - 1e-12, 5)):
        monkeypatch.setattr(edges_module, "FLAT", flat)
        assert len(edges_of(page(1, 0), page(0, 1)).ends) == edges
    monkeypatch.setattr(edges_module, "FLAT", 0.0)
    assert len(edges_of(page(1, 0), page(0, 1), page(-1, 0)).ends) == 6
    assert len(edges_of(page(1, 0), page(0, 1), page(-1, 0.001)).ends) == 7


@pytest.mark.parametrize(("angle", "edges"), [(1.2e-3, 6), (1.7e-3, 7)])
def test_gaps_that_are_almost_half_a_turn_are_none(angle, edges):
    """Between three faces, wider than it by less than 1.4e-3 radians."""
    assert len(edges_of(page(1, 0), page(0, 1), page(-np.cos(angle), np.sin(angle))).ends) == edges


def test_the_two_zeros_are_one_place():
    """Closed bodies that touch in it alone are one part."""
    v, f = octahedron(8)
    aside = np.array([1, 0, 0])
    one, other = v + aside, v - aside
    other[0] = [-0.0, -0.0, 0.0]
    assert len(parts_of([mesh("both", join((one, f), (other, f)))])[0]) == 1
