"""Straight segments by themselves: lengths, records, and vertices that are points of their shapes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient.plugins.sampling.lights import DistantReference
from torchtransient.plugins.transport import vacuum as vacuum
from torchtransient.plugins.transport.material_points import MaterialVacuum
from torchtransient.plugins.transport.media import reference
from torchtransient.plugins.transport.strategy import Guide, Local, Step
from torchtransient.plugins.transport.surface_scattering import Surface, is_black, is_on_wrong_side

VARIANT = "llvm_ad_mono"
FAR = DistantReference((0.5, 0.25, 0.0), 4.0)


def unit(*v):
    return np.array(v) / np.linalg.norm(v)


# -------------------------------------------------------------------------------------------------------------- lengths


@pytest.mark.parametrize("unwarp", [False, True])
@pytest.mark.parametrize("distant", [None, FAR])
def test_optical_lengths_of_segments(distant, unwarp):
    """Between hit points, times the index; to distant light where nothing was hit; nothing to the first vertex where
    the camera's way is left out.
    """
    d = unit(1, 2, 2)
    world = Local(contents=Local(distant=distant), camera_unwarp=unwarp)
    path = Local(prev_p=mi.Point3f(1, 2, 3), ray=Local(d=mi.Vector3f(*d.tolist())), η=mi.Float([1.5, 1.25, 2]),
                 depth=mi.UInt32([0, 1, 2]))  # fmt: skip
    valid = mi.Bool([True, True, False])
    found = vacuum.Vacuum().optical_length(world, path, mi.Point3f(3, 5, 9), valid)
    away = 7.0 if distant is None else 4 - np.dot([0.5, 1.75, 3], d)
    expected = np.array([0 if unwarp else 7, 7, away]) * [1.5, 1.25, 2]
    np.testing.assert_allclose(np.array(found), expected, rtol=1e-6)
    assert isinstance(found, mi.Float64)
    length = vacuum.length_to(world.contents, mi.Point3f(1, 2, 3), mi.Point3f(3, 5, 9), valid, mi.Vector3f(*d.tolist()))
    np.testing.assert_allclose(np.array(length), [7, 7, 0 if distant is None else away], rtol=1e-6)


def test_intersections_as_numbers():
    """And back, with the instance where there are some; none where nothing was hit, or the lane is idle."""
    group = {"type": "shapegroup", "ball": {"type": "sphere"}}
    copy = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    scene = mi.load_dict({"type": "scene", "group": group, "copy": copy, "wall": {"type": "rectangle"}}, optimize=False)
    ray = mi.Ray3f(mi.Point3f([0.1, 0.9, 5, 0.2], [0.2, 0.9, 5, 0.1], 3), mi.Vector3f(0, 0, -1))
    pi = scene.ray_intersect_preliminary(ray)
    active = mi.Bool([True, True, True, False])
    assert set(vacuum.intersection_fields(Local(contents=Local(instances=None)))) == {*vacuum.NUMBERS, "shape"}
    fields = vacuum.intersection_fields(Local(contents=Local(instances=["copy"])), "entry_")
    assert fields["entry_instance"] is mi.UInt32 and set(fields) == {
        f"entry_{name}" for name in (*vacuum.NUMBERS, "shape", "instance")
    }
    again = vacuum.intersection(vacuum.intersection_numbers(pi, "entry_"), active, "entry_")
    assert np.array(again.is_valid()).tolist() == [True, True, False, False]
    np.testing.assert_array_equal(np.array(again.t), np.array(pi.t))
    for name in ("prim_uv", "prim_index"):  # where something was hit: elsewhere they mean nothing
        np.testing.assert_array_equal(np.array(getattr(again, name))[..., :2], np.array(getattr(pi, name))[..., :2])
    for name in ("shape", "instance"):
        assert np.array(getattr(again, name) == getattr(pi, name)).all()
    assert np.array(dr.reinterpret_array(mi.UInt32, pi.instance) != 0).tolist()[:2] == [True, False]
    without = vacuum.intersection({name: value for name, value in vacuum.intersection_numbers(pi).items()
                                   if name != "instance"}, active)  # fmt: skip
    assert not np.array(dr.reinterpret_array(mi.UInt32, without.instance)).any()


def test_what_a_vertex_records_of_its_ray():
    """Wavelengths where a surface changes them, otherwise those of the primary ray."""
    ray = mi.Ray3f(mi.Point3f(1, 2, 3), mi.Vector3f(0, 0, 1), 0.5, [])
    segment, pi = vacuum.Vacuum(), dr.zeros(mi.PreliminaryIntersection3f)
    pi.t = mi.Float(2)
    for delays, shifts in ((None, False), (Local(shifts=False), False), (Local(shifts=True), True)):
        fields = segment.fields(Local(contents=Local(delays=delays, instances=None)))
        assert ("wavelengths" in fields) == shifts and fields["o"] is mi.Point3f and fields["d"] is mi.Vector3f
        record = segment.record(Local(ray=ray, leg=pi))
        assert set(fields) <= set(record)
        primary = mi.Ray3f(mi.Point3f(9, 9, 9), mi.Vector3f(1, 0, 0), 0.75, [])
        v = Local(record_of=lambda name, record=record: record, active=mi.Bool(True))
        restored, found = segment.restore(v, primary)
        assert np.array(restored.o).ravel().tolist() == [1, 2, 3] and restored.time[0] == 0.75
        assert np.array(restored.d).ravel().tolist() == [0, 0, 1] and found.t[0] == 2 and found.is_valid()[0]


# ------------------------------------------------------------------------------------------------------ material points


class Given(vacuum.Vacuum):
    """Points that are given, instead of those of shapes."""

    def __init__(self, place):
        self.place, self.triangles = place, True

    def material_hits(self, world, pi, ray, n, active):
        return self.place


class GivenMaterial(MaterialVacuum):
    """The same around corners."""

    __init__, material_hits = Given.__init__, Given.material_hits


def of_two_points(kind, radius):
    """(attached motion of a segment whose ends move, its derivatives, those of two points by differences)."""
    ahead, x = mi.Bool([True, True, False]), mi.Float(0)
    dr.enable_grad(x)
    dr.set_grad(x, 1)
    a, p, n = np.array([0.1, 0.2, 0.3]), np.array([1.2, 2.4, -0.7]), unit(0.2, -0.5, 0.8)
    da, dp, dn = np.array([[0.3, -0.2, 0.5], [-0.4, 0.7, 0.2], [0.6, 0.1, -0.3]])
    dn -= n * (n @ dn)
    area, darea = 1.7, 0.9

    def vector(kind, v, dv):
        return kind(*v.tolist()) + mi.Vector3f(*dv.tolist()) * x

    start, end = vector(mi.Point3f, a, da), vector(mi.Point3f, p, dp)
    segment = kind((mi.Point3f(end), mi.Normal3f(vector(mi.Vector3f, n, dn)), area + darea * x))
    direction, length = unit(*(p - a)), np.linalg.norm(p - a)
    following = Local(d=mi.Vector3f(*direction.tolist()), n=mi.Normal3f(*n.tolist()), t=mi.Float(length))
    after = Local(pi=None, ray=None)
    at = Local(p=mi.Point3f(start))
    vertex = Local(v=Local(after=lambda: after), scattered_si=at, damping_radius=dr.opaque(mi.Float, radius))
    motion = segment.motion(None, vertex, following, ahead)
    values = motion.longer(), motion.d * 1, motion.J * 1, motion.drag * 1  # inner nodes keep no derivative
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward)
    share = 0 if length > radius else (1 - (length / radius) ** 2) ** 2
    δ, across = da - dp, np.eye(3) - np.outer(direction, direction)
    drag = share * across @ δ + (across @ dp if kind is Given else 0)
    slid = share * (across @ δ - direction * (n @ across @ δ) / (n @ direction))

    def at(h):
        to = p + h * (dp + slid) - a - h * da
        r = np.linalg.norm(to)
        return to / r, r, (area + h * darea) * abs((n + h * dn) @ to) / r**3

    h = 1e-6
    expected = [(one - other) / (2 * h) for one, other in zip(at(h), at(-h), strict=True)]
    return motion, [np.array(dr.grad(value)) for value in values], (*expected, drag), at(0), da @ direction


@pytest.mark.parametrize(("kind", "radius"), [(Given, 0.5), (Given, 5.0), (GivenMaterial, 0.5)])
def test_segments_between_points_of_shapes(kind, radius):
    """Direction and length follow both ends, and far ends the measure, area times the cosine over the squared distance;
    near ends slide along with the vertex that sees them.
    """
    motion, found, (d, r, m, dragged), (direction, _, measure), own = of_two_points(kind, radius)
    longer, turned, grown, drag = found
    there = np.array([1, 1, 0])
    np.testing.assert_allclose(turned, np.outer(d, there), rtol=1e-3, atol=1e-4)
    # What the far end adds is counted there, where it is a vertex of a path.
    np.testing.assert_allclose(longer, (r if kind is GivenMaterial else -own) * there, rtol=1e-3)
    if radius < 1:
        np.testing.assert_allclose(grown, m / measure * there, rtol=1e-3, atol=1e-4)
    if kind is Given:
        np.testing.assert_allclose(drag, np.outer(dragged, there), rtol=1e-3, atol=1e-4)
    assert not np.array(motion.drag).any() and (np.array(motion.J) == 1).all()
    np.testing.assert_allclose(np.array(motion.d)[:, 0], direction, rtol=1e-6)


def test_points_of_reference():
    """That of the medium where light scatters there, without a normal; that of the surface elsewhere."""
    si, mei = dr.zeros(mi.SurfaceInteraction3f, 2), dr.zeros(mi.MediumInteraction3f, 2)
    for found, number in ((si, 3.0), (mei, 5.0)):
        found.t = found.time = mi.Float(number)
        found.p, found.n = mi.Point3f(number), mi.Normal3f(0, 0, 1)
    at = reference(si, mei, mi.Bool([True, False]))
    assert np.array(at.t).tolist() == [5, 3] and np.array(at.p).tolist() == [[5, 3]] * 3
    assert np.array(at.n).tolist() == [[0, 0], [0, 0], [0, 1]] and np.unique(np.array(at.time)).tolist() == [3]


# ----------------------------------------------------------------------------------------------------------- scattering


def test_samples_that_stray_from_their_lobe():
    """Reflected ones that crossed the surface, and transmitted ones that did not; lobes of both kinds cannot."""
    R, T = int(mi.BSDFFlags.GlossyReflection), int(mi.BSDFFlags.GlossyTransmission)
    kinds = [R, R, T, T, R | T, R | T]
    bs = dr.zeros(mi.BSDFSample3f, 6)
    bs.sampled_type, bs.wo = mi.UInt32(kinds), mi.Vector3f(0.6, 0, mi.Float([0.8, -0.8] * 3))
    assert np.array(is_on_wrong_side(mi.Vector3f(0, 0, 1), bs)).tolist() == [False, True, True, False, False, False]
    assert np.array(is_on_wrong_side(mi.Vector3f(0, 0, -1), bs)).tolist() == [True, False, False, True, False, False]
    assert np.array(is_black(mi.UnpolarizedSpectrum(mi.Float([0, 0.5])))).tolist() == [True, False]


class Points(Guide):
    """Points that say by which guide they were drawn, and from which numbers."""

    def __init__(self, share, number, density=0.0, normal=None, primitive=None):
        self.share, self.number, self.given, self.normal, self.primitive = share, number, density, normal, primitive

    def draw(self, world, vertex, x, y):
        p, self.x = mi.Point3f(mi.Float(x), mi.Float(y), self.number), np.array(x)
        return Local(p=p, shape=dr.zeros(mi.ShapePtr), primitive=self.primitive, n=self.normal, uv=None)

    def density(self, world, p, q, n, shape, active, primitive=None):
        return mi.Float(self.given)


def followed(guides, depth, u, delta=False):
    """(the surface, its step) of lanes that are samples 0, 1, 2, ... of four each."""
    surface = Surface(guides)
    surface.strata = mi.UInt32(np.arange(len(u)) % 4), mi.UInt32(4)
    p = mi.Point3f(0, 0, 9)
    vertex = Local(at=Local(p=p, spawn_ray_to=lambda q: Local(d=mi.Vector3f(q))))
    count = len(u)
    step = Step(out=mi.Vector3f(5, 6, 7), u_dir=mi.Point2f(0, 0.125), delta=mi.Bool([delta] * count),
                unconnected=mi.Bool([True] * count),
                weight=mi.UnpolarizedSpectrum(mi.Float([0.5] * count)))  # fmt: skip
    surface._follow_guides(None, Local(depth=mi.UInt32(depth)), vertex, step, Local(next_1d=lambda: mi.Float(list(u))))
    return surface, step


def test_who_draws_the_next_vertex():
    """A number chooses among the guides, by their shares, and is used again; at the first vertex the samples of a pixel
    share out the choice. The scattering's own delta lobes stand for those that guides took the place of.
    """
    guides = [Points(0.25, 2, primitive=7), Points(0.5, 3)]
    u = np.array([0.1, 0.25, 0.7, 0.8])
    for depth, number in ((2, u), (0, (np.arange(4) + u) / 4)):
        _, step = followed(guides, depth, u, delta=True)
        kind = np.where(number < 0.25, 2, np.where(number < 0.75, 3, 0))
        x = np.select([kind == 2, kind == 3], [number / 0.25, (number - 0.25) / 0.5], 0)
        guided = kind > 0
        assert np.array(step.guided).tolist() == guided.tolist() and 1 < guided.sum() < 4
        np.testing.assert_allclose(np.array(step.point), [x, 0.125 * guided, np.where(guided, kind, 9)], atol=1e-6)
        np.testing.assert_allclose(np.array(step.out)[:, guided], np.array(step.point)[:, guided], rtol=1e-6)
        assert np.array(step.out)[:, ~guided].tolist() == [[v] * (~guided).sum() for v in (5, 6, 7)]
        assert np.array(step.primitive).tolist() == np.where(kind == 2, 7, 0xFFFFFFFF).tolist()
        assert np.array(step.delta).tolist() == np.array(step.unconnected).tolist() == (~guided).tolist()
        np.testing.assert_allclose(np.array(step.weight).ravel(), np.where(guided, 0.5, 2.0))
        assert step.target is None
        # Those who are not chosen are asked, too, and look things up.
        assert all(np.all((guide.x >= 0) & (guide.x < 1)) for guide in guides)
    known = Points(0.5, 2, normal=mi.Normal3f(0, 0, 1))
    assert followed([known], 1, u)[1].target is not None and followed([Points(0.5, 2)], 1, u)[1].target is None
    np.testing.assert_allclose(np.array(followed([known], 1, u)[1].weight).ravel(), 0.5)


def test_densities_of_guides_and_scattering_together():
    """By their shares; of lights without a shape, and of points that have no extent, that of the scattering alone."""
    surface, pdf, active = Surface([Points(0.25, 0, 3.0), Points(0.5, 0, 5.0)]), mi.Float(8), mi.Bool([True, False])
    emitter = Local(get_shape=lambda: "shape")
    for ds, expected in (
        (Local(emitter=None), [2, 2]), (Local(emitter=emitter, delta=mi.Bool(True), p=None, n=None), [2, 2]),
        (Local(emitter=emitter, delta=mi.Bool(False), p=None, n=None), [2 + 3.25, 2]),
    ):  # fmt: skip
        assert np.broadcast_to(np.array(surface.mixture(None, 0, None, ds, pdf, active)), 2).tolist() == expected
    assert np.array(surface.guided_density(None, 0, None, Local(p=None, n=None), None, True)).tolist() == [3.25]
    assert Surface().mixture(None, 0, None, None, pdf, active) is pdf


class Known(Surface):
    """A value of six at a density of two."""

    def value_towards(self, world, path, vertex, out, active):
        self.out = out
        return mi.UnpolarizedSpectrum(6), mi.Float(2)

    def relative_index(self, bsdf, si, wo):
        return mi.Float(1.5)


def test_weights_of_what_guides_have_drawn():
    """The value over the density of both together, where a ray arrives at the point; nothing where it ends before, on
    another shape or triangle, or beside the point. What the scattering drew, and threw away, does not count.
    """
    scene = mi.load_dict({"type": "scene", "a": {"type": "rectangle"}, "b": {"type": "rectangle"}})
    a, b = (mi.ShapePtr(shape) for shape in scene.shapes())
    surface, count = Known([Points(0.5, 0, 3.0)]), 9
    # Reached; another shape; another triangle; two beside the point; nothing; own; own that was thrown away; a delta.
    guided = mi.Bool([True] * 6 + [False] * 3)
    shape = dr.select(mi.UInt32(np.arange(count)) == 1, b, a)
    p = np.tile([[0.0], [0.0], [2.0]], (1, count))
    p[0, 3:5] = 1.9e-3, 2.1e-3
    step = Step(
        guided=guided, point=mi.Point3f(0, 0, 2), shape=a,
        primitive=mi.UInt32([0xFFFFFFFF, 0xFFFFFFFF, 4] + [3] * 6), delta=mi.Bool([False] * 8 + [True]),
        weight=mi.UnpolarizedSpectrum(mi.Float([0.25] * 7 + [0, 0.75])), pdf=mi.Float(0.7), eta=mi.Float(1.0),
        out=mi.Vector3f(0, 0, 1),
    )  # fmt: skip
    pi = dr.zeros(mi.PreliminaryIntersection3f, count)
    pi.t, pi.valid = mi.Float(2), mi.Bool([True] * 5 + [False] + [True] * 3)
    pi.shape, pi.prim_index = shape, mi.UInt32([3] * count)
    segment = Local(surface_of=lambda leg: (pi, mi.Bool(True)),
                    interaction_of=lambda *a: Local(p=mi.Point3f(p), n=None))  # fmt: skip
    vertex = Local(at=Local(p=mi.Point3f(0, 0, 0)), goes_on=mi.Bool(True), bsdf=None,
                   scattered_si=Local(to_local=lambda v: v))  # fmt: skip
    surface.weigh(Local(segment=segment), Local(depth=mi.UInt32(1)), vertex, step, Local(d=mi.Vector3f(0, 0, 1)), None)
    both = 0.5 * 2 + 0.5 * 3.0
    weight = [6 / both, 0, 0, 6 / both, 0, 0, 6 / both, 0, 0.75]
    np.testing.assert_allclose(np.array(step.weight).ravel(), weight, rtol=1e-6)
    np.testing.assert_allclose(np.array(step.pdf), [both, 0, 0, both, 0, 0, both, both, 0.7], rtol=1e-6)
    np.testing.assert_allclose(np.array(step.eta), [1.5] * 8 + [1])
    np.testing.assert_allclose(np.array(surface.out)[:, 4], unit(2.1e-3, 0, 2), rtol=1e-5)
