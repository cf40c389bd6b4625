"""Meshes of scenes: closed, wound outward, in closed form; and letters that are tiled."""

from __future__ import annotations

import numpy as np
import pytest

import torchtransient as tt
from support.sweeps import together
from torchtransient import scenes
from torchtransient.errors import SceneError, ShapeError, UnitError
from torchtransient.scenes import bottle, meshes, nlos

VARIANT = "llvm_ad_rgb"


def area_of(corners):
    x, y = corners.T
    return (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2


def volume(vertices, faces):
    """Of a closed mesh, by the divergence theorem; positive when its normals point out."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return (np.cross(a, b) * c).sum() / 6


def normals(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


LETTERS = list(nlos.OUTLINES)
CLOSED = {
    "ellipsoid": lambda: meshes.ellipsoid([1, 2, 3], [0.3, 0.2, 0.1], 2),
    "octahedron": lambda: meshes.octahedral_ellipsoid([1, 2, 3], [0.3, 0.2, 0.1], 2),
    "mannequin": lambda: nlos.mannequin(1.7, 2),
    **{letter: lambda letter=letter: meshes.solid(nlos.outline(letter), 1.0, 0.2) for letter in LETTERS},
    "subdivided": lambda: meshes.subdivided(meshes.solid(nlos.outline("T"), 1.0, 0.2), 2),
    "bottle": lambda: bottle.lathe(np.array(bottle.PROFILE), 12),
}


@together("name", CLOSED)
def test_bodies_are_closed_and_their_normals_point_out(name):
    vertices, faces = CLOSED[name]()
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = {tuple(edge) for edge in edges.tolist()}
    assert len(forward) == len(edges), "an edge runs one way once"
    assert {(b, a) for a, b in forward} == forward, "and once the other way"
    assert volume(vertices, faces) > 0


@together("letter", LETTERS)
def test_letters_are_tiled_by_their_triangles(letter):
    corners = nlos.outline(letter, 2.0)
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
    assert np.abs(corners).max() <= 1


# Of strokes 0.2 wide in a square of one metre, and the square less the triangles that are cut out of it.
AREAS = {
    "C": 0.2 * (1 + 2 * 0.8), "E": 0.2 * (1 + 2 * 0.8 + 0.6), "H": 0.2 * (2 + 0.6), "L": 0.2 * 1.8,
    "S": 0.2 * (3 + 2 * 0.2), "V": (0.2 + 1) / 2 - 0.6 * 0.75 / 2, "X": 1 - 2 * 0.54 * 0.36 / 2 - 2 * 0.38 / 2,
    "N": 1 - 2 * 0.6 * 0.66 / 2, "Z": 2 * 0.2 + 0.27 * 0.6,
}  # fmt: skip


@together("letter, area", AREAS.items())
def test_areas_of_letters(letter, area):
    assert area_of(nlos.outline(letter)) == pytest.approx(area, rel=1e-12)
    assert area_of(nlos.outline(letter, 3.0)) == pytest.approx(9 * area, rel=1e-12)


def test_the_volume_of_a_solid_letter():
    vertices, faces = meshes.solid(nlos.outline("E"), 1.0, 0.25)
    assert volume(vertices, faces) == pytest.approx(0.25 * area_of(nlos.outline("E")), rel=1e-12)
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


def test_a_plate_of_cells():
    """Three by three pairs of triangles of one size, row by row, that face -z."""
    vertices, faces = meshes.plate(6.0, 1.5, [1.0, -2.0, 3.0], cells=3)
    x, y = np.meshgrid([-2.0, 0, 2, 4], [-2.75, -2.25, -1.75, -1.25])
    np.testing.assert_allclose(vertices, np.stack([x.ravel(), y.ravel(), np.full(16, 3.0)], 1), atol=1e-12)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    np.testing.assert_allclose(np.cross(b - a, c - a) / 2, [[0, 0, -0.5]] * 18, atol=1e-12)
    middles = np.sort(np.round((a + b + c) / 3, 9).view("f8,f8,f8").ravel())
    assert len(np.unique(middles)) == 18
    assert meshes.plate(2.0, 1.0)[0].max(0).tolist() == [1, 0.5, 0] and len(meshes.plate(2.0, 1.0)[1]) == 2


def test_subdivision_keeps_the_surface():
    mesh = meshes.sheet(nlos.outline("K"))
    fine = meshes.subdivided(mesh, 2)
    assert len(fine[1]) == 16 * len(mesh[1])
    np.testing.assert_allclose(normals(*fine).sum(0), normals(*mesh).sum(0), atol=1e-12)
    np.testing.assert_array_equal(fine[0][: len(mesh[0])], mesh[0])


def test_a_body_of_revolution():
    """Of five corners around: a cylinder between two poles, its volume that of the prism with cones on both ends."""
    vertices, faces = bottle.lathe(np.array([[0.0, -1], [2, 0], [2, 3], [0, 5]]), 5)
    angle = 2 * np.pi * np.arange(5) / 5
    ring = np.stack([2 * np.cos(angle), np.zeros(5), 2 * np.sin(angle)], 1)
    np.testing.assert_allclose(vertices[:10], np.concatenate([ring, np.add(ring, [0, 3, 0])]), atol=1e-6)
    assert vertices[10:].tolist() == [[0, -1, 0], [0, 5, 0]] and faces.shape == (20, 3)
    base = 5 / 2 * 4 * np.sin(2 * np.pi / 5)
    assert volume(vertices.astype(float), faces) == pytest.approx(base * (1 / 3 + 3 + 2 / 3), rel=1e-6)
    # Of more rings, each with its neighbours: of the straight side it changes nothing.
    more = bottle.lathe(np.array([[0, -1], [2, 0], [2, 1], [2, 2.5], [2, 3], [0, 5]]), 5)
    assert more[1].shape == (40, 3) and volume(more[0].astype(float), more[1]) == pytest.approx(4 * base, rel=1e-6)


def test_a_bottle_of_diluted_milk(tmp_path):
    """Scattering and absorption of each colour by their sums and quotients, in the unit of the extinction."""
    bottle_of = scenes.milk_bottle(tmp_path / "new" / "bottle.ply", milk=2.0, beam_degrees=10.0, index=1.4)
    inside = bottle_of["bottle"]["interior"]
    scattering, absorption = 2.0 * np.array([4.6, 5.5, 6.7]), np.array([0.30, 0.06, 0.03])
    extinction = np.array(inside["sigma_t"]["value"]) * inside["scale"]
    np.testing.assert_allclose(extinction, scattering + absorption)
    np.testing.assert_allclose(np.array(inside["albedo"]["value"]) * extinction, scattering)
    table = tt.load(bottle_of, variant=VARIANT).parameters()
    points = np.asarray(table["bottle.vertex_positions"].value).reshape(-1, 3)
    np.testing.assert_allclose(points.max(0), [0.035, 0.18, 0.035], atol=1e-3)
    # Blue light first, as far as 40 1/m.
    scenes.milk_bottle(tmp_path / "bottle.ply", milk=(40 - 0.03) / 6.7 * (1 - 1e-9))
    most = (40 - 0.03) / 6.7 * (1 + 1e-9)
    for wrong in ({"beam_degrees": 90.0}, {"beam_degrees": 0.0}, {"anisotropy": 1.0}, {"milk": -1.0}, {"milk": most}):
        with pytest.raises(UnitError):
            scenes.milk_bottle(tmp_path / "bottle.ply", **wrong)


@together("make, error", [
    (lambda: meshes.sheet(nlos.outline("T")[::-1]), SceneError),
    (lambda: meshes.solid([[0, 0], [0, 1], [1, 1]], 0.0, 0.1), SceneError),  # with the clock
    (lambda: meshes.sheet([[0, 0], [1, 0]]), SceneError),
    (lambda: meshes.subdivided(meshes.plate(1, 1), 9), SceneError), (lambda: meshes.plate(0, 1), UnitError),
    (lambda: scenes.triangle_mesh(np.zeros((3, 2)), [[0, 1, 2]]), ShapeError),
    (lambda: scenes.triangle_mesh(np.zeros((3, 3)), [[0, 1, 3]]), ShapeError),
])  # fmt: skip
def test_what_is_no_mesh(make, error):
    with pytest.raises(error):
        make()
