"""Every emitter and every sensor: when its light arrives and how much of it, in closed form and against Mitsuba."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.lights_and_sensors import (
    HALF,
    LIGHTS,
    SENSORS,
    SPHERE,
    arrivals,
    facing_down,
    film,
    from_above,
    load,
    looking_down,
    one_arrival,
    plane,
    scene,
)
from support.marks import long, long_rows
from support.runs import T, steady_runs
from torchtransient import plugins
from torchtransient.accuracy import two_sample_z_test

VARIANT = "llvm_ad_rgb"  # the sky of Mitsuba knows no monochromatic variant
# Half a bin, and what float32 makes of lengths of ten metres.
HALF_BIN = 5.1e-4


# -------------------------------------------------------------------------------------------------- closed forms


@pytest.mark.parametrize("name", long(LIGHTS, list(LIGHTS)[::3]))
def test_light_on_a_plane(name):
    light = LIGHTS[name]
    loaded = load(scene(SENSORS["perspective"].make(film()), light.make()))
    spp = 1 << 14 if name in ("constant", "envmap", "sunsky") else 64
    opl, radiance, width = one_arrival(loaded, spp)
    assert opl == pytest.approx(light.opl + 4.0, abs=HALF_BIN)
    # One moment: O is the centre of the sphere, which the waves of all directions reach at once.
    assert width < 2.5e-3
    if not math.isnan(light.radiance):
        assert radiance == pytest.approx(light.radiance, rel=light.tolerance)


@pytest.mark.parametrize("name", long(SENSORS, list(SENSORS)[::3]))
def test_sensor_over_a_plane(name):
    sensor = SENSORS[name]
    light = LIGHTS["directional" if name == "distant" else "point"]
    opl, radiance, width = one_arrival(load(scene(sensor.make(film()), light.make())), 256)
    assert opl == pytest.approx(light.opl + sensor.opl, abs=HALF_BIN)
    assert radiance == pytest.approx(light.radiance * sensor.weight, rel=1e-3)
    assert width < 2.5e-3


# ---------------------------------------------------------------------------------------------- where paths begin


def test_orthographic_rays_start_on_the_plane_of_the_camera():
    """All pixels see the plane at the same distance, also those far from the axis."""
    sensor = {
        "type": "orthographic", "near_clip": 0.5, "far_clip": 100.0, "film": film(size=(5, 1)),
        "to_world": T().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0]) @ T().scale([2, 2, 2]),
    }  # fmt: skip
    bins, centers = arrivals(load(scene(sensor, LIGHTS["directional"].make())), 512)
    means = (bins @ centers / bins.sum(-1))[0]
    # five columns of 0.8 m; +x of the camera is to the left; each pixel averages over its columns
    x = -np.array([-1.6, -0.8, 0.0, 0.8, 1.6])
    np.testing.assert_allclose(np.sort(means), np.sort(4.0 + SPHERE - 0.6 * x), atol=0.03)


def test_thin_lens_light_arrives_at_the_sampled_point_of_the_aperture():
    """Focus on the light's image: paths over the rim of the lens are longer than those through its middle."""
    radius, near = 0.5, 1.0
    sensor = {
        "type": "thinlens", "fov": 0.01, "near_clip": near, "aperture_radius": radius, "focus_distance": 4.0,
        "film": film(bins=8000), **looking_down(4.0),
    }  # fmt: skip
    bins, centers = arrivals(load(scene(sensor, LIGHTS["point"].make())), 4096)
    lit = centers[np.flatnonzero(bins[0, 0])]
    assert lit[0] == pytest.approx(1.0 + 4.0, abs=2e-3)
    assert lit[-1] == pytest.approx(1.0 + math.hypot(4.0, radius), abs=2e-3)
    mean = centers @ bins[0, 0] / bins.sum()
    # uniform over the disk: the mean of sqrt(16 + r^2)
    expected = 2 / (3 * radius**2) * ((16 + radius**2) ** 1.5 - 64)
    assert mean == pytest.approx(1.0 + expected, abs=1e-3)


def test_batch_counts_the_near_clip_plane_of_each_child():
    children = {
        "first": SENSORS["perspective"].make(film(steady=True)),
        "second": {
            "type": "perspective", "fov": 0.01, "near_clip": 0.2, "film": film(steady=True), **looking_down(3.0),
        },
        "third": SENSORS["radiancemeter"].make(film(steady=True)),
    }  # fmt: skip
    sensor = {"type": "batch", "film": film(size=(3, 1)), **children}
    bins, centers = arrivals(load(scene(sensor, LIGHTS["point"].make())))
    means = (bins @ centers / bins.sum(-1))[0]
    np.testing.assert_allclose(means, [1.0 + 4.0, 1.0 + 3.0, 1.0 + 4.0], atol=HALF_BIN)
    np.testing.assert_allclose(bins.sum(-1)[0], LIGHTS["point"].radiance, rtol=1e-3)


@pytest.mark.slow
def test_batch_reports_polarization_in_the_frame_of_each_child():
    """A mirror under a uniform sky has no noise: a camera in a batch sees what it sees alone, upright or turned."""
    mi.set_variant("llvm_ad_mono_polarized")
    plugins.sync()
    ups = ([0, 0, 1], [0, 1, 1], [1, 1, 0])
    cameras = [
        {"type": "perspective", "fov": 0.01, "to_world": T().look_at(origin=[0, 3, 2], target=[0, 0, 0], up=up)}
        for up in ups
    ]
    objects = {
        "mirror": {**plane(), "bsdf": {"type": "conductor", "material": "Cr"}},
        "sky": {"type": "constant"},
        "integrator": {"type": "transient_path", "max_depth": 3},
    }

    def seen(sensor):
        loaded = load({"type": "scene", "sensor": sensor, **objects})
        return np.array(loaded.integrator().render(loaded, spp=16)[0], float)[0]

    alone = np.concatenate([seen({**camera, "film": film()}) for camera in cameras])
    children = {f"c{n}": {**camera, "film": film(steady=True)} for n, camera in enumerate(cameras)}
    together = seen({"type": "batch", "film": film(size=(3, 1)), **children})
    np.testing.assert_allclose(together, alone, atol=1e-5)
    assert np.ptp(alone[:, 1]) > 0.05  # the frames do differ


@pytest.mark.parametrize("target", long(["shape", "scene"], ["shape"]))
def test_a_distant_sensor_sees_a_plane_wave(target):
    """Parts of a slanted surface that lie further along the view arrive later by that much, wherever rays start."""
    direction = np.array([-0.6, 0.0, -0.8])  # the sensor looks along it
    sensor = {
        "type": "distant", "film": film(),
        "to_world": T().look_at(origin=[0, 0, 0], target=list(direction), up=[0, 1, 0]),
    }  # fmt: skip
    if target == "shape":
        sensor["target"] = {"type": "rectangle", "to_world": T().translate([1.0, 0.5, 0.0]).scale(0.2)}
    bins, centers = arrivals(load(scene(sensor, LIGHTS["directional"].make())), 1 << 14)
    bins = bins[0, 0]
    lit = centers[np.flatnonzero(bins)]
    # sun and sensor in the same direction u: x is reached after SPHERE - dot(x, u), and again that long on its way back
    half = {"shape": 0.2, "scene": HALF}[target]
    middle = 0.0 if target == "scene" else 1.0
    expected = 2 * (SPHERE - 0.6 * (middle + np.array([half, -half])))
    np.testing.assert_allclose([lit[0], lit[-1]], expected, atol=0.03 if target == "scene" else 3e-3)


# ----------------------------------------------------------------------------------------------- spots and beams


@pytest.mark.slow
def test_sun_slants_over_the_plane():
    """The sun's light reaches one side of the plane before the other."""
    sun = LIGHTS["sunsky"].make()
    u = from_above()
    for x in (-2.0, 2.0):
        sensor = {**SENSORS["radiancemeter"].make(film()),
                  "to_world": T().look_at(origin=[x, 0, 3], target=[x, 0, 0], up=[0, 1, 0])}  # fmt: skip
        opl, _, width = one_arrival(load(scene(sensor, sun)), 4096)
        assert opl == pytest.approx(SPHERE - x * u[0] + 3.0, abs=2e-3)
        assert width < 4 * 2.0 * math.radians(0.5338)


# ------------------------------------------------------------------------------------ sum over time, every pair


def wide(kind, transient):
    """Sensors with a wide view of the plane and the light."""
    f = film(size=(4, 2), bins=8, width=10.0, start=-5.0, steady=not transient)
    point = film(bins=8, width=10.0, start=-5.0, steady=not transient)
    slanted = {"to_world": T().look_at(origin=[2, -3, 4], target=[0, 0, 0], up=[0, 0, 1])}
    inner = {"type": "perspective", "fov": 40.0, "film": film(steady=True), **slanted}
    return {
        "perspective": {"type": "perspective", "fov": 50.0, "film": f, **slanted},
        "thinlens": {
            "type": "thinlens", "fov": 50.0, "aperture_radius": 0.3, "focus_distance": 3.0, "film": f, **slanted,
        },
        "orthographic": {"type": "orthographic", "film": f, "to_world": slanted["to_world"] @ T().scale([2, 2, 1])},
        "radiancemeter": {"type": "radiancemeter", "film": point, **slanted},
        "irradiancemeter": facing_down(0.7, 0.2, {"meter": {"type": "irradiancemeter", "film": point}}),
        "distant": {"type": "distant", "film": point, **slanted},
        "batch": {"type": "batch", "film": f, "a": inner, "b": {**inner, "fov": 20.0}},
    }[kind]  # fmt: skip


def pair(sensor, light, integrator):
    white = {"type": "diffuse", "reflectance": 0.7}
    ball = {"type": "sphere", "center": [-1.0, 0.5, 0.4], "radius": 0.3, "bsdf": white}
    made = LIGHTS[light].make()
    if light == "sunsky":
        made["sky_scale"] = 1.0
    transient = integrator != "path"
    return load(scene(wide(sensor, transient), made, integrator, depth=4, ball=ball))


PAIRS = [
    ("thinlens", "area"), ("orthographic", "area"), ("radiancemeter", "area"), ("irradiancemeter", "area"),
    ("distant", "area"), ("batch", "area"), ("perspective", "sunsky"), ("perspective", "projector"),
    ("distant", "constant"),
]  # fmt: skip


@pytest.mark.parametrize(("sensor", "light"), long_rows(PAIRS, [("batch", "area")]))
def test_sum_over_time_is_what_mitsuba_renders(sensor, light):
    count, spp = 6, 512
    ours, theirs = pair(sensor, light, "transient_path"), pair(sensor, light, "path")
    sums = []
    for k in range(count):
        steady, transient = ours.integrator().render(ours, seed=k, spp=spp)
        steady, transient = np.array(steady, float), np.array(transient, float)
        np.testing.assert_allclose(transient.sum(2), steady, rtol=1e-4, atol=1e-6 * max(steady.max(), 1e-3))
        sums.append(transient.sum(2))
    images = steady_runs(theirs, count, spp, 900)
    assert images.max() > 0
    result = two_sample_z_test(np.array(sums), images, rounding=1e-5 * images.max())
    assert result.passed, str(result)


# ---------------------------------------------------------------------------------------------------- gradients


@pytest.mark.slow
@pytest.mark.parametrize("name", ["point", "area", "projector", "constant", "envmap"])
def test_gradient_of_the_intensity(name):
    """Light is proportional to its intensity: with the same samples, intensity times derivative is the light itself."""
    light = LIGHTS[name]
    loaded = load(scene(wide("perspective", True), light.make(), depth=3))
    params = mi.traverse(loaded)
    keys = [k for k in params.keys() if k.endswith(light.key.split(".", 1)[1])]  # noqa: SIM118 (not a mapping)
    assert len(keys) == 1, list(params.keys())
    key = keys[0]
    integrator = loaded.integrator()
    weights = np.linspace(0.5, 1.5, 2 * 4 * 8 * 3).reshape(2, 4, 8, 3).astype(np.float32)
    value = type(params[key])(params[key])
    _, transient = integrator.render(loaded, seed=5, spp=256)
    expected = float((np.array(transient, float) * weights).sum())
    dr.enable_grad(value)
    params[key] = value
    params.update()
    integrator.render_backward(loaded, params, (None, mi.TensorXf(weights)), seed=5, spp=256)
    assert expected > 0
    product = (np.array(dr.grad(value)).ravel() * np.array(dr.detach(value)).ravel()).sum()
    assert product == pytest.approx(expected, rel=1e-3)
