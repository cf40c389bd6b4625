"""A laser's spot on any surface, and what it sends to a vertex that moves: values, frames and their derivatives."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.moving_points import attached_zero, slopes, unit, vector
from torchtransient.plugins import polarized
from torchtransient.plugins.transport.laser_spot import GeneralSpot, LaserSpot
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_mono_polarized"
PLACE, MOVE = np.array([1.3, 1.2, 0.9]), np.array([0.4, -0.3, 0.5])
BEAM, TOWARDS = unit(np.array([0.8, 1.1, -0.7])), unit(np.array([0.5, -0.7, 0.4]))
STEP = 1 / 128


@pytest.fixture(scope="module")
def turned():
    """(the interaction of a vertex, the ray that found it)"""
    pose = mi.ScalarTransform4f().translate(PLACE.tolist()).rotate([1, 0.2, 0], 170)
    scene = mi.load_dict({"type": "scene", "wall": {"type": "rectangle", "to_world": pose}})
    ray = mi.Ray3f(mi.Point3f(*(PLACE - TOWARDS).tolist()), mi.Vector3f(*TOWARDS.tolist()))
    si = scene.ray_intersect(ray)
    assert bool(si.is_valid()[0]) and si.wi.z[0] > 0.1
    si.shape = dr.zeros(mi.ShapePtr)
    return si, ray


def matrix(seed):
    return [mi.UnpolarizedSpectrum(float(x)) for x in np.random.default_rng(seed).uniform(0.2, 1, 16)]


class Lamp:
    """A spot whose polarized light changes with the direction, and has a frame of its own."""

    def __init__(self):
        self.p, self.n, self.valid, self.leg = mi.Point3f(0.1, 0.2, 0), mi.Normal3f(0, 0, 1), mi.Bool(True), 0.75

    def light(self, d, active):
        stokes = mi.SpectrumEntry(*[x * (2 + dr.dot(d, mi.Vector3f(0.7, 0.2, -0.5))) for x in matrix(5)[:4]])
        across = dr.cross(d, mi.Vector3f(0.2, 0.3, 1))
        return polarized.rotate_stokes(stokes, polarized.rotation_between(-d, across, polarized.stokes_frame_of(d)))


class Spotted(LaserSpot):
    def spot(self, wavelengths, active, attached=False):
        return Lamp()


def connection_to_lamp():
    connection = Spotted(Local(wall=None, spots=None, looks_at_points=True), False, True)
    connection.index = mi.UInt32(0)
    return connection


def scattering(si, d):
    """(Mueller matrix between the frames of the local directions, ``wo``)"""
    wo = si.to_local(d)
    share = 2 + dr.dot(wo, mi.Vector3f(-0.4, 0.6, 0.3))
    return mi.Spectrum(*[x * share for x in matrix(4)]), wo


def throughput():
    return mi.Spectrum(*matrix(3))


def stokes(value):
    dr.eval(value)
    return np.array([np.array(value[k]).ravel()[0] for k in range(4)], dtype=np.float64)


def sent(turned, h):
    """What arrives from the spot where the vertex is ``h`` further on, as renders have it, and when."""
    si, ray = turned
    connection, place = connection_to_lamp(), PLACE + h * MOVE
    at = Local(p=mi.Point3f(*(dr.opaque(mi.Float, x) for x in place.tolist())), n=si.n, wavelengths=[])
    vertex = Local(at=at, goes_on=mi.Bool(True), connectable=mi.Bool(True), β=throughput(), η=mi.Float(1.25),
                   scattered_τ=mi.Float64(3))  # fmt: skip
    segment = Local(transmittance=lambda world, vertex, ds, u, sampler, active: (active, 1))
    world = Local(deep_enough=lambda active, depth: active, counted=lambda active, opl: active, segment=segment,
                  contents=Local(media=None))  # fmt: skip
    path = Local(depth=mi.UInt32(0))
    proposal = connection.propose(world, path, vertex, None)
    value, wo = scattering(si, proposal.d)
    rotations = polarized.rotation_to_sensor(si, ray.d), polarized.rotation_from_light(si, wo, proposal.d)
    answer = Local(matrix=polarized.rotate_mueller(value, *rotations), eta=mi.Float(1.5))
    event = connection.connect(world, path, vertex, proposal, answer, False)
    dr.eval(event.value, event.opl, event.active)
    assert bool(event.active[0])
    return stokes(event.value), event.opl[0]


def test_the_light_of_a_spot_on_any_surface():
    """Its scattering of the beam, in the frame of the ray that finds it, times the cosine towards that ray."""
    metal = {"type": "roughconductor", "alpha": 0.5, "material": "Cu"}
    scene = mi.load_dict({"type": "scene", "wall": {"type": "rectangle", "bsdf": metal}})
    spot = scene.ray_intersect(mi.Ray3f(mi.Point3f(0.1, 0.2, 3), mi.Vector3f(0, 0, -1)))
    index, d = mi.UInt32(0), mi.Vector3f(*unit(np.array([-0.7, -0.4, -0.5])).tolist())
    spots = Local(si=spot, ray=mi.Ray3f(mi.Point3f(0), mi.Vector3f(*BEAM.tolist())), length=mi.Float(0.75),
                  energy=lambda wavelengths, index, cos, active: 3 * cos)  # fmt: skip
    for legs in (False, True):
        found = GeneralSpot(spots, index, [], legs, mi.Bool(True))
        assert np.array(found.leg).tolist() == [0.75 * legs] and bool(found.valid[0])
    seen = dr.copy(spot)
    seen.wi = -d
    value = seen.bsdf().eval(mi.BSDFContext(), seen, mi.Vector3f(*(-BEAM).tolist()), True)
    light = polarized.rotate_stokes(polarized.first_column(value), polarized.rotation_to_sensor(seen, d))
    expected = stokes(light) * 3 * abs(BEAM[2] * d.z[0])
    np.testing.assert_allclose(stokes(found.light(d, mi.Bool(True))), expected, rtol=1e-5)
    assert abs(stokes(light)[1:]).max() > 0.02 * stokes(light)[0]


@pytest.mark.parametrize("geometry", [False, True])
def test_polarized_light_of_a_spot_with_derivatives(turned, geometry):
    """All of the Stokes vector follows the vertex as its light does in renders, which know no frame between both."""
    si, ray = turned
    connection, x = connection_to_lamp(), attached_zero()
    moving = dr.copy(si)
    moving.p = mi.Point3f(vector(mi.Point3f, PLACE, MOVE, x))

    def evaluate(world, vertex, d, active):
        value, wo = scattering(vertex.scattered_si, d)
        return Local(value=value, wo=wo, eta=mi.Float(1.5))

    world = Local(scattering=Local(evaluate=evaluate), segment=Local(attached_transmittance=lambda *a: 1))
    v = Local(record_of=lambda name: {"lit": mi.Bool(True)}, η=mi.Float(1.25), arrival=lambda name: None)
    vertex = Local(scattered_si=moving, v=v, rotation=polarized.rotation_to_sensor(si, ray.d),
                   carry=Local(β=throughput(), η=mi.Float(1.25)), scattered_opl=mi.Float64(3),
                   scattered_slope=7 * (x - dr.detach(x)))  # fmt: skip
    (term,) = connection.attached(world, vertex, None, Local(geometry=geometry))
    value, opl = sent(turned, 0)
    dr.eval(term.value, term.opl)
    np.testing.assert_allclose(stokes(term.value), value, rtol=1e-4)
    assert term.opl[0] == pytest.approx(opl, rel=1e-6)
    *found, slope = slopes(x, *(term.value[k] for k in range(4)), term.slope)
    (one, later), (other, sooner) = sent(turned, STEP), sent(turned, -STEP)
    expected = (one - other) / (2 * STEP)
    assert abs(expected).min() > 0.01 * abs(expected).max()
    np.testing.assert_allclose(np.concatenate(found), expected, rtol=1e-2, atol=2e-3 * abs(expected).max())
    assert slope[0] == pytest.approx(7 + geometry * (later - sooner) / (2 * STEP), rel=1e-3)
