"""What goes from vertex to vertex in derivatives: leaves, adjoints, products."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.plain_scenes import camera, load
from torchtransient import plugins
from torchtransient.plugins.integrators.job import Pass, seed_array
from torchtransient.plugins.transport import carry as module
from torchtransient.plugins.transport.carry import Carry
from torchtransient.plugins.transport.derivative import objective_of, tangent_of
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_rgb"
NAMES = ("β", "slope", "η", "o", "d", "x", "w", "p", "n")


def carry_of(seed):
    """A carry of two lanes of different numbers."""
    rng = np.random.default_rng(seed)

    def some(kind):
        return kind(rng.normal(size=(3, 2)))

    vectors = [some(kind) for kind in (mi.Point3f, mi.Vector3f, mi.Point3f, mi.Vector3f, mi.Point3f, mi.Normal3f)]
    return Carry(some(mi.Spectrum), mi.Float(rng.normal(size=2)), mi.Float(rng.normal(size=2)), *vectors)


def arrays(carry):
    return {name: np.array(getattr(carry, name)) for name in NAMES}


def test_the_product_of_an_adjoint_and_a_carry_is_that_over_all_entries():
    a, b = carry_of(1), carry_of(2)
    for names in (NAMES, ("β",), ("slope", "n"), ()):
        found = np.array(module.inner(a, b, names))
        expected = sum((arrays(a)[n] * arrays(b)[n]).reshape(-1, 2).sum(0) for n in names)
        np.testing.assert_allclose(np.broadcast_to(found, 2), np.broadcast_to(expected, 2), rtol=1e-5, atol=1e-6)


def test_a_carry_is_chosen_lane_by_lane_in_the_fields_that_are_named():
    a, b = carry_of(1), carry_of(2)
    found, mask = arrays(module.choose(mi.Bool([True, False]), a, b, ("β", "o"))), [True, False]
    for name in NAMES:
        other = arrays(b)[name]
        expected = np.where(mask, arrays(a)[name], other) if name in ("β", "o") else other
        np.testing.assert_array_equal(found[name], expected)


def test_leaves_tangents_and_what_a_traversal_leaves_at_them():
    start, tangents = carry_of(3), carry_of(4)
    attached = module.attach(start, ("o", "slope"), tangents)
    assert [name for name in NAMES if dr.grad_enabled(getattr(attached, name))] == ["slope", "o"]
    assert not dr.grad_enabled(start.o)
    np.testing.assert_array_equal(np.array(dr.grad(attached.o)), arrays(tangents)["o"])
    attached = module.attach(start, ("o", "slope"))
    dr.backward(dr.dot(attached.o, mi.Vector3f(2, 3, 5)) + 7 * attached.slope)
    adjoint = arrays(module.adjoint_of(attached, ("o", "slope")))
    np.testing.assert_array_equal(adjoint["o"], [[2, 2], [3, 3], [5, 5]])
    np.testing.assert_array_equal(adjoint["slope"], [7, 7])
    assert not any(adjoint[name].any() for name in NAMES if name not in ("o", "slope"))


def test_the_derivative_alone():
    x = mi.Float(3)
    dr.enable_grad(x)
    y = module.slope_only(5 * x)
    dr.set_grad(x, 2)
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward)
    assert (y[0], dr.grad(y)[0]) == (0, 10)


def test_products_of_stokes_vectors_and_mueller_matrices():
    """Over all entries and channels, each of which differs from all others."""
    before = mi.variant()
    mi.set_variant("llvm_ad_mono_polarized")
    try:
        rng = np.random.default_rng(7)
        a, b = rng.normal(size=(2, 4, 4))
        matrices = [mi.Spectrum(*(mi.UnpolarizedSpectrum(float(x)) for x in m.ravel())) for m in (a, b)]
        assert np.array(module.total_of(*matrices)).item() == pytest.approx((a * b).sum(), rel=1e-5)
        light = [mi.SpectrumEntry(*(mi.UnpolarizedSpectrum(float(x)) for x in m[0])) for m in (a, b)]
        assert np.array(module.total_of(*light)).item() == pytest.approx((a[0] * b[0]).sum(), rel=1e-5)
        assert module.total_of(mi.Float(3), mi.Float(5))[0] == 15
    finally:
        mi.set_variant(before)


def primary_rays(x):
    """The rays of a camera that turns, moves and opens its view with ``x``, by one launch."""
    pose = mi.ScalarTransform4f().look_at([0.3, 0.2, 4], [0, 0.1, 0], [0.1, 1, 0])
    scene = load(camera(3, 2, bins=2, near_clip=0.7, to_world=pose), {"wall": {"type": "rectangle"}})
    params = mi.traverse(scene)
    pose = params["sensor.to_world"]
    turn = mi.Transform4f().rotate(mi.Vector3f(0.3, 0.2, 1), 40 * x).translate(mi.Vector3f(0.5, -0.3, 0.2) * x)
    params["sensor.to_world"] = mi.AffineTransform4f(pose.matrix @ turn.matrix)
    # At a near clip plane rays of a wider view begin farther away.
    params["sensor.x_fov"] = params["sensor.x_fov"] + 60 * (x + 0)
    params.update()
    integrator = scene.integrator()
    with dr.suspend_grad():
        sensor, film = integrator.resolve(scene, 0)
        job = Pass(0, 0, 2, 2, 2, seed_array(3))
        return integrator.start(scene, integrator.contents(scene, sensor), sensor, film, job)


def unknown():
    x = mi.Float(0)
    dr.enable_grad(x)
    return x


@pytest.mark.slow
@pytest.mark.parametrize(("variant", "unwarp"), [("llvm_ad_mono", True), ("llvm_ad_mono_polarized", False)])
def test_the_carry_of_primary_rays_has_the_same_slope_in_both_modes(variant, unwarp):
    """Directions, origins, the length to the sensor (which unwarped renders leave out) and the turn of its frame."""
    before = mi.variant()
    mi.set_variant(variant)
    plugins.sync()
    try:
        world = Local(camera_unwarp=unwarp, wanted=Local(sensor=True))
        x = unknown()
        dr.set_grad(x, 1)
        rays = primary_rays(x)
        with dr.suspend_grad():
            tangent = tangent_of(world, rays)
        names = ("o", "x", "d", "w", "slope", "η", *(("β",) if mi.is_polarized else ()))
        found = {name: np.array(getattr(tangent, name), dtype=float) for name in names}
        assert np.abs(found["slope"]).max() > 0.1 if not unwarp else not found["slope"].any()
        assert all(np.abs(found[name]).max() > 0.1 for name in ("o", "d"))
        if mi.is_polarized:
            assert np.abs(found["β"][1, 2]).min() > 0.1
            np.testing.assert_array_equal(found["β"][1, 2], -found["β"][2, 1])
            assert not np.delete(found["β"].reshape(16, -1), [6, 9], axis=0).any()
        lanes, rng = 12, np.random.default_rng(4)
        adjoint, expected = Carry.zeros(), 0.0
        for name in names:
            kind = type(getattr(adjoint, name))
            if name == "β":
                weights = rng.normal(size=(4, 4, lanes))
                adjoint.β = mi.Spectrum(*(mi.UnpolarizedSpectrum(mi.Float(w)) for w in weights.reshape(16, -1)))
                expected += (weights * found["β"].reshape(4, 4, -1)).sum()
            else:
                shape = (lanes,) if name in ("slope", "η") else (3, lanes)
                weights = rng.normal(size=shape)
                setattr(adjoint, name, kind(weights))
                expected += (weights * found[name]).sum()
        x = unknown()
        objective = objective_of(world, primary_rays(x), adjoint)
        dr.backward(dr.sum(objective))
        assert dr.grad(x)[0] == pytest.approx(expected, rel=1e-3)
    finally:
        mi.set_variant(before)


def test_primary_rays_of_a_sensor_that_stands_still_have_no_tangent():
    tangent = tangent_of(Local(camera_unwarp=False, wanted=Local(sensor=False)), primary_rays(mi.Float(0)))
    assert not any(np.array(getattr(tangent, name)).any() for name in NAMES)
