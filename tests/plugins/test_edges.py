"""Edges and limbs of all kinds of shapes: which side hides, how they are drawn, how they move; against rays."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import ball, disc, join, mesh
from torchtransient.plugins.cache import Cache
from torchtransient.plugins.edges.table import EdgeTable
from torchtransient.plugins.edges.topology import Topology, topology_of

VARIANT = "llvm_ad_mono"
STRETCH = (0.8, 0.5, 1.2)
# From how far points are looked at.
FAR = 3.0
COUNT = 40_000


def placed(*where, scale=0.8):
    return mi.ScalarAffineTransform4f().translate(where).rotate([0.6, 0.8, 0], 40).scale(scale)


def all_shapes():
    """One of each kind, far from each other."""
    kinds = {name: {"type": name} for name in ("rectangle", "cube", "disk", "cylinder", "sphere")}
    shapes = {
        **{name: kind | {"to_world": placed(6 * i, 0, 0)} for i, (name, kind) in enumerate(kinds.items())},
        "tube": {"type": "cylinder", "to_world": placed(0, 6, 0), "flip_normals": True},
        "ellipsoids": {
            "type": "ellipsoids", "centers": mi.TensorXf(np.array([[6, 6, 0], [9, 6, 0.0]])), "extent": 2.0,
            "scales": mi.TensorXf(np.array([[0.4, 0.3, 0.1], [0.2, 0.2, 0.3]])),
            "quaternions": mi.TensorXf(np.array([[0, 0, 0.6, 0.8], [0, 0, 0, 1.0]])),
        },
        "star": mesh("star", join(ball([12, 6, 0], [0.7, 0.2, 0.4], 1), ball([12, 6, 0], [0.2, 0.7, 0.3], 1))),
        "group": {"type": "shapegroup", **{
            f"part{i}": kind | {"to_world": mi.ScalarAffineTransform4f().translate([3.5 * i, 0, 0])}
            for i, kind in enumerate(kinds.values())
        }},
        "copy": {
            "type": "instance", "to_world": placed(0, 14, 0, scale=STRETCH), "ref": {"type": "ref", "id": "group"},
        },
    }  # fmt: skip
    return mi.load_dict({"type": "scene", **shapes}, optimize=False)


@pytest.fixture(scope="module")
def scene():
    return all_shapes()


def looked_at(scene, moving=frozenset(), alone=False):
    """(table, points of it seen from around): strata of the density in order."""
    table = EdgeTable(Topology(scene), moving)
    rng = np.random.default_rng(3)
    x = mi.Float(((np.arange(COUNT) + rng.random(COUNT)) / COUNT).astype(np.float32))
    density = table.of_moving if alone else table.by_length
    k = table.pick(density, x, mi.Float(rng.random(COUNT).astype(np.float32)))
    away = rng.normal(size=(3, COUNT))
    V = k.near + mi.Vector3f((FAR * away / np.linalg.norm(away, axis=0)).astype(np.float32))
    return table, table.seen_from(k, mi.Point3f(V), True)


def seen(scene, b):
    """Where nothing hides the points."""
    to = b.beside - b.V
    return b.valid & ~scene.ray_test(mi.Ray3f(b.V, dr.normalize(to), dr.norm(to) * (1 - 1e-4), 0, []))


def beside(scene, b, off):
    """What rays from the viewpoint meet at distance ``off`` outwards of the points."""
    return scene.ray_intersect_preliminary(mi.Ray3f(b.V, dr.normalize(b.p + b.n * off - b.V)))


def same(pi, told):
    numbers = lambda p: dr.reinterpret_array(mi.UInt32, p)  # noqa: E731
    inside = numbers(told.instance) != 0
    found = (numbers(pi.instance) == numbers(told.instance)) & (pi.prim_index == told.prim_index)
    return found & dr.select(inside, pi.shape_index == told.shape_index, numbers(pi.shape) == numbers(told.shape))


def bodies_of(table, b):
    return np.array(dr.gather(mi.UInt32, table.topology.owners[0], b.k.e))


def share(hit, among):
    return np.array(hit)[among].mean()


def test_the_inner_side_hides_and_the_outer_one_does_not(scene):
    """Of every shape. Rays so near a corner meet another face, and none where a face is seen edge-on."""
    table, b = looked_at(scene)
    found, off = seen(scene, b), 3e-4
    inside, outside = (beside(scene, b, sign * off) for sign in (-1, 1))
    near = dr.abs(inside.t - b.dist) < 0.15
    outline = np.array(found & ~b.crease)
    crease = np.array(found & b.crease)
    body = bodies_of(table, b)
    hit, met = same(inside, b.inner), same(outside, b.inner) & (dr.abs(outside.t - b.dist) < 0.02)
    for number, one in enumerate(table.topology.bodies):
        here = outline & (body == number) & np.array(near)
        assert here.sum() > 200, one.shape.id()
        assert here.sum() > 0.96 * (outline & (body == number)).sum(), one.shape.id()
        assert share(hit, here) > 0.97 and share(met, here) < 0.01, one.shape.id()
    assert crease.sum() > 1000 and share(hit & same(outside, b.facing), crease) > 0.95
    # The legs lead to the points, to a thousandth of a face and 2 mrad of a limb.
    for leg, d, where in ((b.inner, b.d_in, b.valid), (b.facing, b.d, b.valid & b.crease)):
        si = leg.compute_surface_interaction(mi.Ray3f(b.V, d), mi.RayFlags.All, where)
        assert np.array(dr.select(where, dr.norm(si.p - b.p), 0)).max() < 5e-3
    lines = np.array(dr.select(b.valid, dr.abs(dr.dot(b.n, b.d)), 0))
    assert lines.max() < 1e-4


def rim(a, b):
    angle = np.linspace(0, 2 * np.pi, 2000)
    p = np.outer(np.cos(angle), a) + np.outer(np.sin(angle), b)
    return np.linalg.norm(np.diff(p, axis=0), axis=1).sum()


def test_lengths_are_those_of_all_edges_and_limbs(scene):
    """One over the density, on average."""
    table, b = looked_at(scene)
    inverse, body = np.array(b.inv_pdf, np.float64), bodies_of(table, b)
    found = {one.shape.id() + ("" if one.instance is None else "'"): (inverse * (body == k)).mean()
             for k, one in enumerate(table.topology.bodies)}  # fmt: skip
    x, y, z = (np.array(placed(0, 0, 0, scale=STRETCH).matrix)[:3, i] for i in range(3))
    sides = [np.linalg.norm(v) for v in (x, y, z)]
    limb = lambda R: 2 * np.pi * R * np.sqrt(1 - (R / FAR) ** 2)  # noqa: E731
    for name, length in {
        "rectangle": 6.4, "cube": 19.2, "disk": rim(0.8 * np.eye(3)[0], 0.8 * np.eye(3)[1]), "sphere": limb(0.8),
        "cylinder": 4 * np.pi * 0.8 + 1.6, "tube": 4 * np.pi * 0.8 + 1.6, "part0'": 4 * (sides[0] + sides[1]),
        "part1'": 8 * sum(sides), "part2'": rim(x, y), "part3'": 2 * rim(x, y) + 2 * sides[2],
    }.items():  # fmt: skip
        assert found[name] == pytest.approx(length, rel=5e-3), name


def test_rims_of_two_meshes_are_one_until_they_part():
    """A roof of two plates: the ridge once, with a face of each; pulled apart, two rims."""
    turned = [mi.ScalarAffineTransform4f().rotate([0, 1, 0], 40 * s).translate([s, 0, 0]) for s in (-1, 1)]
    halves = {f"r{i}": {"type": "rectangle", "to_world": T} for i, T in enumerate(turned)}
    scene = mi.load_dict({"type": "scene", **halves}, optimize=False)
    topology, params = Topology(scene), mi.traverse(scene)

    def length_and_two():
        table = EdgeTable(topology, frozenset())
        u = mi.Float((np.arange(2000, dtype=np.float32) + 0.5) / 2000)
        b = table.seen_from(table.pick(table.by_length, u, u), mi.Point3f(0, 0.1, 9), True)
        return np.array(b.inv_pdf).mean(), np.array(b.crease).mean()

    length, crease = length_and_two()
    assert length == pytest.approx(14, rel=1e-3) and crease == pytest.approx(1 / 7, abs=0.01)
    params["r0.to_world"] = mi.AffineTransform4f().translate([-0.1, 0, 0]) @ params["r0.to_world"]
    params.update()
    length, crease = length_and_two()
    assert length == pytest.approx(16, rel=1e-3) and not crease


def total_length(scene, V=(0, 0.1, 9)):
    """Of all outlines and creases, seen from ``V``."""
    table = EdgeTable(topology_of(scene, Cache()), frozenset())
    u = mi.Float((np.arange(4000, dtype=np.float32) + 0.5) / 4000)
    b = table.seen_from(table.pick(table.by_length, u, u), mi.Point3f(*V), True)
    return np.array(dr.select(b.valid, b.inv_pdf, 0), np.float64).mean()


@pytest.mark.parametrize("corners", [1500, 4000])
def test_short_rims_far_from_the_origin(corners):
    """Ten micrometres are what a coordinate of a hundred metres is rounded to."""
    v, f = disc(0.3, 1.2, corners)
    scene = mi.load_dict({"type": "scene", "fan": mesh("fan", (v + np.array([100, 0, 0]), f))})
    assert total_length(scene, (100, 0.1, 9)) == pytest.approx(0.6 * np.pi, rel=0.02)


def test_faces_that_get_an_area():
    """A mesh of none, which has no edges; then it has three, and none again."""
    flat = mesh("flat", (np.zeros((3, 3)), np.array([[0, 1, 2]])))
    scene = mi.load_dict({"type": "scene", "r": {"type": "rectangle"}, "flat": flat}, optimize=False)
    params, memory = mi.traverse(scene), Cache()
    for area in (0, 1, 2, 0):
        params["flat.vertex_positions"] = mi.Float(3, 0, 0, 3, area, 0, 3, 0, area)
        params.update()
        topology = topology_of(scene, memory)
        assert (len(topology.bodies), topology.count - 5) == ((2, 3) if area else (1, 0))
        EdgeTable(topology, frozenset())
