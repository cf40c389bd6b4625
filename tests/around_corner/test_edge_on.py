"""What is met, seen or lit edge-on, and what lies exactly at a bound."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import mesh, plate, scene_of
from torchtransient.plugins.around_corner import late_light as chains
from torchtransient.plugins.around_corner import occlusion
from torchtransient.plugins.around_corner.occlusion import MutualOcclusion
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_mono"


@pytest.mark.parametrize("two_sided", [True, False])
def test_surfaces_that_are_met_edge_on_are_not_lit(two_sided):
    """By their shading normals, which rays do not know of."""
    sheet = mesh("a", plate(1, 1, (0, 0, 1)), two_sided=two_sided)
    ray = mi.Ray3f(mi.Point3f(0.1, 0.2, 0), mi.Vector3f(0, 0, 1))
    scene = scene_of(sheet)
    pi = scene.ray_intersect_preliminary(ray)
    for x, z in ((1, 0), (0.6, 0.8)):
        si = pi.compute_surface_interaction(ray)
        si.wi = mi.Vector3f(x, 0, z)
        met = Local(compute_surface_interaction=lambda ray, flags, active, si=si: si, shape=pi.shape,
                    prim_index=pi.prim_index, prim_uv=pi.prim_uv)  # fmt: skip
        found = chains._step(Local(ray_intersect_preliminary=lambda *given, met=met, **named: met),
                             Local(elements=Local(smooth=False)), ray.o, ray.d, mi.Bool(True))  # fmt: skip
        assert np.array(found.alive).tolist() == [z > 0]


def test_steps_that_end_at_a_bound(monkeypatch):
    """Along the surface that they start from, or that they arrive at, they bring nothing; exactly a thousandth of the
    way from the point that was chosen they have not arrived.
    """
    shape, primitive = dr.gather(mi.ShapePtr, mi.ShapePtr(mesh("a", plate(1, 1, (0, 0, 4)))), mi.UInt32([0] * 6)), 3
    tie = np.float32(1e-3) * np.float32(5)
    beside = mi.Float(np.array([0, 0, 0, 0, tie, np.nextafter(tie, np.float32(0))], dtype=np.float32))
    n = mi.Vector3f([0, 0, 1, 0, 0, 0], 0, [1, -1, 0, 1, 1, 1])
    met_n = mi.Vector3f([0, 0, 0, 1, 0, 0], 0, [-1, -1, -1, 0, -1, -1])
    elements = Local(
        per_area=lambda *given: mi.Float(0), select_element=lambda x, active: (mi.UInt32(1), mi.Float(0.5)),
        point=lambda element, a, y, active: (mi.Point3f(0, 3, 4), None),
        surface=lambda element, active: (shape, mi.UInt32(primitive)),
    )  # fmt: skip
    start = chains.Vertices(p=mi.Point3f(0, 0, 0), n=n, geometric_n=mi.Vector3f(0, 0, 0), shape=shape,
                            primitive=mi.UInt32(primitive), alive=mi.Bool([True] * 6))  # fmt: skip
    asked = []

    def step(scene, plan, origin, d, active):
        asked.append(np.array(active))
        p = mi.Point3f(beside, 3, 4)
        return chains.Vertices(p=p, geometric_n=met_n, shape=shape, primitive=mi.UInt32(primitive), alive=active)

    monkeypatch.setattr(chains, "_step", step)
    plan = Local(elements=elements, center=mi.Point3f(0, 0, 0))
    vertex, weight = chains._guided_step(None, plan, start, [mi.UInt32(2**31), mi.UInt32(2**31)], (0, 1))
    assert asked[0].tolist() == [True, False, False, True, True, True]
    assert np.array(vertex.alive).tolist() == [True, False, False, True, False, True]
    weight = np.array(weight)
    assert (weight > 0).tolist() == [True, False, False, False, False, True] and not weight[1:5].any()


def test_links_along_a_surface_carry_nothing():
    """Though the shading normals of neighbours say otherwise: by those of the tail, and by those of the head."""
    scene = scene_of(mesh("far", plate(1, 1, (50, 0, 0))))

    def vertex(p, n):
        return Local(p=mi.Point3f(*p), n=mi.Vector3f(*np.transpose(n).tolist()), geometric_n=mi.Vector3f(0, 0, 1),
                     value=mi.UnpolarizedSpectrum(2), alive=mi.Bool([True] * len(n)), length=mi.Float(0))  # fmt: skip

    for head, tail, count in (([0, 0, 1], [0, 0.6, -0.8], 1), ([0, 0, 1], [1, 0, 0], 0), ([0, 1, 0], [0, 0, -1], 0)):
        heads, tails = vertex((0, 0, 0), [head]), vertex((0, 0, 2), [tail])
        heads.p, tails.p = mi.Point3f([0], [0], [0]), mi.Point3f([0], [0], [2])
        tables = [chains.VertexTable(each, True) for each in (heads, tails)]
        links = chains.Links(scene, Local(size=1), *tables, mi.Float(0.1))
        assert np.array(links.count).tolist() == [count]


@pytest.mark.parametrize(("bound", "seen"), [(0.5, False), (0.499, True)])
def test_hidden_points_at_the_bound_of_edge_on(monkeypatch, bound, seen):
    monkeypatch.setattr(occlusion, "EDGE_ON", bound)
    scene = mi.load_dict({"type": "scene", "wall": {"type": "rectangle"}})

    def at(x):
        return scene.ray_intersect(mi.Ray3f(mi.Point3f(x, 0, 1), mi.Vector3f(0, 0, -1)))

    world = Local(scene=scene, counted=lambda active, opl: active,
                  scattering=Local(correct_two_sided=lambda world, bsdf, si, wo, value: value))  # fmt: skip
    job = MutualOcclusion(None, world, None, None, None, Local(confocal=False), [])
    for near, far in (("seen", "lit"), ("lit", "seen")):
        hidden = at(0.0)
        # Straight above the one, at a cosine of a half, and nearer to the normal from the other.
        hidden.p, hidden.n = mi.Point3f(0, 0, 0.5), mi.Normal3f(-0.9, 0, 0.5)
        place = Local(**{near: at(0.0), far: at(0.5)}, ray=mi.Ray3f(mi.Point3f(0, 0, 1), mi.Vector3f(0, 0, -1)), η=1.0,
                      before=mi.Float64(0), spot=Local(light=lambda d, active: mi.UnpolarizedSpectrum(1)))  # fmt: skip
        hidden.p = mi.Point3f(place.seen.p.x if near == "seen" else place.lit.p.x, 0, 0.5)
        assert np.array(job._light(place, hidden, False, mi.Bool(True))[2]).tolist() == [seen]
