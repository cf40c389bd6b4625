"""The stretch between two boundaries that a vertex in a medium divides, with derivatives."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins
from torchtransient.plugins.transport.media import Media
from torchtransient.plugins.transport.strategy import Local

FLOOR = -1.0


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_mono")
    plugins.sync()


def floor():
    """A plane under a medium that fills all space above it."""
    pose = mi.ScalarTransform4f().translate([0, 0, FLOOR]).scale(50)
    return mi.load_dict({"type": "scene", "floor": {"type": "rectangle", "to_world": pose}}, optimize=False)


def downwards(origin, slope=0.5):
    return mi.Ray3f(mi.Point3f(*origin), dr.normalize(mi.Vector3f(slope, 0, -1)))


@pytest.mark.parametrize("follows", ["start alone", "ray"])
def test_a_stretch_begins_where_the_vertex_before_moves(follows):
    """A vertex at a quarter of the way keeps that share when the one before comes nearer along the line, whether the
    ray is handed on attached (behind delta lobes) or not. Held at its distance it would leave light out."""
    scene, ray = floor(), downwards((0, 0, 3))
    length = float(scene.ray_intersect_preliminary(ray).t[0])
    x = mi.Float(0)
    dr.enable_grad(x)
    start = ray.o + ray.d * x
    moved = mi.Ray3f(ray)
    if follows == "ray":
        moved.o = start
    media = Media()
    media.settings = Local(open_boundaries=False, surfaces=None)
    v = Local(t=mi.Float(0.25 * length), scatter=mi.Bool(True), pi=scene.ray_intersect_preliminary(ray), entry=None)
    t, stretch = media._attached_distance(v, Local(x=start), moved, Local(geometry=True))
    from_origin = dr.dot(moved(t) - ray.o, ray.d)
    dr.set_grad(x, 1.0)
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward)
    assert stretch[0] == pytest.approx(length)
    assert dr.grad(stretch)[0] == pytest.approx(-1, abs=1e-5)
    assert dr.grad(from_origin)[0] == pytest.approx(0.75, abs=1e-5)


class ZeroSampler:
    """Draws zeros only: a flight of no length."""

    def next_1d(self):
        return mi.Float(0)

    def wavefront_size(self):
        return 1


@pytest.mark.parametrize("origin", [(0, 0, 0.5), (700, -300, 20)])
def test_collisions_are_no_vertices_on_top_of_the_one_before(origin):
    """Derivatives divide by the distance between vertices; the random number zero made them NaN."""
    scene, ray = floor(), downwards(origin, slope=0)
    medium = mi.load_dict({"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.5})
    media = Media()
    media.settings = Local(
        open_boundaries=False, one_stretch=True, hide_emitters=False, homogeneous=True, heterogeneous=False,
        rate_floor=None, recorded=True, geometry=True, keeps_entry=False,
    )  # fmt: skip
    world = Local(scene=scene)
    leg = media._leg(world, ray, mi.MediumPtr(medium), mi.UnpolarizedSpectrum(1), ZeroSampler(), mi.Bool(True))
    assert bool(leg["scatter"][0])
    apart = np.array(ray(leg["t"]) - ray.o).ravel()
    assert 0 < np.linalg.norm(apart) < 1e-5 * (1 + np.abs(origin).max())
