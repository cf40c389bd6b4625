"""`angulararea` against `area` and against the radiance that its profile promises."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins
from torchtransient.errors import SceneError

VARIANT = "llvm_ad_mono"


def lamp_over_floor(emitter, height=2.0, integrator="transient_path"):
    """A lamp of 0.2 m facing a floor; the camera sees a small patch straight below it."""
    plugins.sync()
    t = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    if integrator == "transient_path":
        film = {**film, "type": "transient_hdr_film", "temporal_bins": 1, "bin_width_opl": 20.0}
        del film["pixel_format"]
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": integrator, "max_depth": 2},
        "sensor": {
            "type": "perspective", "fov": 1.0, "film": film,
            "to_world": t.look_at(origin=[1.0, 0, 1.0], target=[0, 0, 0], up=[0, 0, 1]),
        },
        "lamp": {"type": "rectangle", "to_world": t.translate([0, 0, height]).rotate([1, 0, 0], 180).scale(0.1),
                 "emitter": emitter},
        "floor": {"type": "rectangle", "to_world": t.scale(3.0), "bsdf": {"type": "diffuse", "reflectance": 0.5}},
    })  # fmt: skip


def mean(scene, seeds=8, spp=4096):
    values = [np.array(scene.integrator().render(scene, seed=s, spp=spp)[0]).mean() for s in range(seeds)]
    return np.mean(values), np.std(values, ddof=1) / np.sqrt(seeds)


def test_inside_the_beam_it_is_an_area_light():
    """The peer's has an additional 1/d^2: 0.82, 0.23 and 0.11 of the area light at 1, 2 and 3 m."""
    wide, wide_error = mean(lamp_over_floor({"type": "area", "radiance": 5.0}, 3.0))
    beam = {"type": "angulararea", "radiance": 5.0, "cutoff_angle": 40.0, "beam_width": 20.0}
    narrow, narrow_error = mean(lamp_over_floor(beam, 3.0))
    assert abs(wide - narrow) < 4 * np.hypot(wide_error, narrow_error)
    assert np.hypot(wide_error, narrow_error) < 0.01 * wide


@pytest.mark.parametrize(("degrees", "share"), [(0.0, 1.0), (9.9, 1.0), (25.0, 0.25), (30.1, 0.0)])
def test_profile(degrees, share):
    lamp = lamp_over_floor({"type": "angulararea", "radiance": 5.0, "cutoff_angle": 30.0, "beam_width": 10.0})
    angle = np.radians(degrees)
    x, z = float(np.sin(angle)), float(np.cos(angle))
    si = lamp.ray_intersect(mi.Ray3f([x, 0.0, 2.0 - z], [-x, 0.0, z]))
    np.testing.assert_allclose(si.emitter(lamp).eval(si).numpy(), 5.0 * share, rtol=1e-5, atol=1e-6)


def test_both_strategies_agree():
    """A light that is both found and sampled: equal to Mitsuba's own path tracer, which mixes both by their weights."""
    emitter = {"type": "angulararea", "radiance": 5.0, "cutoff_angle": 60.0, "beam_width": 5.0}
    ours, ours_error = mean(lamp_over_floor(emitter, height=0.15))
    steady = lamp_over_floor(emitter, height=0.15, integrator="path")
    values = [np.array(mi.render(steady, spp=4096, seed=s)).mean() for s in range(8)]
    assert abs(ours - np.mean(values)) < 4 * np.hypot(ours_error, np.std(values, ddof=1) / np.sqrt(8))


def test_angles_out_of_range():
    plugins.sync()
    for angles in ({"cutoff_angle": 0.1, "beam_width": 0.0}, {"cutoff_angle": 90.0}, {"cutoff_angle": 5.0}):
        lamp = mi.load_dict({"type": "angulararea", **angles})
        assert lamp.beam_width == angles.get("beam_width", angles["cutoff_angle"])
    for angles in ({"cutoff_angle": 90.1}, {"cutoff_angle": 10.0, "beam_width": 10.1}, {"cutoff_angle": 0.0},
                   {"cutoff_angle": 10.0, "beam_width": -0.1}):  # fmt: skip
        with pytest.raises(SceneError, match="cutoff_angle"), plugins.plugin_errors():
            mi.load_dict({"type": "angulararea", **angles})


def test_the_slope_of_a_profile():
    """By the cosine: that of the arc cosine over the width between both angles, and none beside it."""
    scene = lamp_over_floor({"type": "angulararea", "radiance": 5.0, "cutoff_angle": 40.0, "beam_width": 10.0})
    degrees = np.radians([0.0, 9.0, 25.0, 45.0])
    cosine = mi.Float(np.cos(degrees))
    dr.enable_grad(cosine)
    dr.backward(scene.emitters()[0].falloff(cosine))
    expected = [0, 0, 1 / (np.sin(np.radians(25.0)) * np.radians(30.0)), 0]
    np.testing.assert_allclose(np.array(dr.grad(cosine)), expected, rtol=1e-4)


def test_lights_that_stay_dark_to_paths():
    """All but the rays that leave them."""
    scene = lamp_over_floor({"type": "diff_directionalarea", "radiance": 5.0})
    (light,) = scene.emitters()
    it = dr.zeros(mi.SurfaceInteraction3f)
    it.p = mi.Point3f(0, 0, 1)
    ds, weight = light.sample_direction(it, mi.Point2f(0.5, 0.5))
    for nothing in (weight, light.eval(it), light.pdf_direction(it, ds), light.eval_direction(it, ds), ds.pdf):
        assert not np.array(nothing).any()
    ps, position_weight = light.sample_position(0.0, mi.Point2f(0.25, 0.5))
    assert float(position_weight[0]) == pytest.approx(0.04) and float(ps.p.z[0]) == pytest.approx(2.0)
    assert float(light.sample_position(0.0, mi.Point2f(0.5, 0.5), False)[1][0]) == 0


def test_wavelengths_are_those_of_area_lights():
    mi.set_variant("llvm_ad_spectral")
    plugins.sync()
    ours, theirs = (
        mi.load_dict({"type": "rectangle", "emitter": {"type": kind, "radiance": {"type": "d65"}}}).emitter()
        for kind in ("angulararea", "area")
    )
    si, u = dr.zeros(mi.SurfaceInteraction3f, 5), mi.Float([0.1, 0.3, 0.5, 0.7, 0.9])
    for one, other in zip(ours.sample_wavelengths(si, u), theirs.sample_wavelengths(si, u), strict=True):
        np.testing.assert_allclose(np.array(one), np.array(other), rtol=1e-6)
