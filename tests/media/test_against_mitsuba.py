"""The sum over time is what Mitsuba's steady volumetric path tracer renders."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.marks import long
from support.media_scenes import block, camera, clouds, homogeneous, load, rgb, volume
from support.runs import T, runs, steady_runs
from torchtransient.accuracy import two_sample_z_test
from torchtransient.errors import GradientError, SceneError

VARIANT = "llvm_ad_rgb"


def coloured():
    return homogeneous(rgb(0.5, 0.8, 0.2), rgb(0.9, 0.5, 0.7), 0.5, scale=2.0)


def blend():
    parts = {"a": {"type": "hg", "g": 0.7}, "b": {"type": "tabphase", "values": "0.2, 0.5, 1.0, 0.7"}}
    return homogeneous(1.5, 0.9) | {"phase": {"type": "blendphase", "weight": 0.3, **parts}}


CASES = {
    "coloured grid": lambda: block(clouds((3, 3, 3, 3))),
    "grid of albedo": lambda: block(clouds(albedo=volume(np.linspace(0, 1, 27).reshape(3, 3, 3)))),
    "blended phase": lambda: block(blend()),
    "no emitter sampling": lambda: block(homogeneous(1.0, 0.8, sample_emitters=False)),
    "smooth glass": lambda: block(coloured(), {"type": "dielectric", "int_ior": 1.33}),
    "grid in rough glass": lambda: block(clouds(), {"type": "diff_rough_dielectric", "alpha": 0.4}),
}  # fmt: skip


@pytest.mark.parametrize("name", long(CASES, ["coloured grid"]))
def test_steady_sum(name):
    objects = CASES[name]()
    if "diff_" in str(objects):
        plain = CASES[name]()
        plain["block"]["bsdf"]["type"] = "roughdielectric"
    else:
        plain = objects
    steady, _ = runs(load(objects))
    # `volpath`, since `prbvolpath` refuses no media but ignores that of the sensor.
    expected = steady_runs(load(plain, integrator="volpath"))
    result = two_sample_z_test(steady, expected, rounding=1e-5)
    assert result.passed, str(result)
    # The whole picture is a sharper test than its pixels.
    total = two_sample_z_test(steady.mean((1, 2)), expected.mean((1, 2)))
    assert total.passed, str(total)


@pytest.mark.slow
def test_sensor_inside_a_medium():
    """A fog around everything, camera included: the sensor and the walls name the medium."""
    fog = homogeneous(0.5, 0.3, 0.3)
    room = {
        "fog": fog,
        "box": {
            "type": "cube",
            "to_world": T().scale(5),
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}},
            "interior": {"type": "ref", "id": "fog"},
        },
        "lamp": {"type": "sphere", "center": [0, 2, 0], "radius": 0.5, "emitter": {"type": "area", "radiance": 5.0}},
    }

    def scene(integrator):
        sensor = camera(transient=integrator.startswith("transient"))
        sensor["medium"] = {"type": "ref", "id": "fog"}
        return load(room, sensor, integrator)

    steady, _ = runs(scene("transient_prbvolpath"))
    expected = steady_runs(scene("volpath"))
    total = two_sample_z_test(steady.mean((1, 2)), expected.mean((1, 2)))
    assert total.passed, str(total)
    clear = steady_runs(load(room, integrator="path")).mean()
    assert expected.mean() < 0.8 * clear, "the fog must matter"


@pytest.mark.slow
def test_hidden_emitters():
    objects = block(clouds())
    objects["lamp"]["to_world"] = T().translate([0, 0.3, 1.5]).rotate([1, 0, 0], 180).scale(0.5)
    objects["sky"] = {"type": "constant", "radiance": 0.3}
    objects["lamp_behind"] = {
        "type": "rectangle", "to_world": T().translate([0, 0, -1.5]).scale(0.5),
        "emitter": {"type": "area", "radiance": 2.0},
    }  # fmt: skip
    steady, _ = runs(load(objects, hide_emitters=True))
    expected = steady_runs(load(objects, integrator="volpath", hide_emitters=True))
    result = two_sample_z_test(steady, expected, rounding=1e-5)
    assert result.passed, str(result)


@pytest.mark.slow
def test_depth_counts_real_events():
    objects = block(homogeneous(1.0, 0.8))
    steady, _ = runs(load(objects, max_depth=2))
    expected = steady_runs(load(objects, integrator="volpath", max_depth=2))
    result = two_sample_z_test(steady, expected, rounding=1e-5)
    assert result.passed, str(result)


@pytest.mark.slow
def test_wavelengths():
    """Extinction by wavelength: the free flights of four wavelengths share one sample."""
    with mi.variant_context("llvm_ad_spectral"):
        objects = block(coloured())
        steady, _ = runs(load(objects))
        expected = steady_runs(load(objects, integrator="volpath"))
        total = two_sample_z_test(steady.mean((1, 2)), expected.mean((1, 2)))
    assert total.passed, str(total)


@pytest.mark.slow
def test_scattering_in_a_medium_leaves_no_polarization():
    """A phase function of one number says nothing of polarization, and light that is scattered once has none."""
    with mi.variant_context("llvm_ad_mono_polarized"):
        objects = block(homogeneous(1.0, 0.8))
        objects["floor"]["bsdf"] = {"type": "conductor", "material": "Au"}
        deep, transient = runs(load(objects, max_depth=3), count=2)
        fog = {name: objects[name] for name in ("block", "lamp")}
        scattered, _ = runs(load(fog), count=2)
    assert np.isfinite(transient).all() and np.isfinite(deep).all()
    assert scattered[..., 0].min() > 0 and abs(scattered[..., 1:]).max() == 0
    # The metal floor turns what it reflects towards the camera.
    assert abs(deep[..., 1:]).max() > 1e-4 * deep[..., 0].max()


def test_spherical_lights_need_connections():
    objects = block(homogeneous(1.0, 0.8, sample_emitters=False))
    objects["lamp"] = {"type": "sphere", "center": [0, 1.6, 2], "emitter": {"type": "area", "radiance": 5.0}}
    scene = load(objects, camera(filter="tent"))
    params = mi.traverse(scene)
    x = mi.Float(0)
    dr.enable_grad(x)
    shift = mi.AffineTransform4f().translate(mi.Vector3f(0, 0, 1) * x)
    params["floor.to_world"] = shift @ mi.AffineTransform4f(params["floor.to_world"])
    params.update()
    adjoint = mi.TensorXf(np.ones(scene.sensors()[0].film().cube_shape(), dtype=np.float32))
    with pytest.raises(GradientError, match="sample_emitters"):
        scene.integrator().render_backward(scene, params, (None, adjoint), spp=1)


@pytest.mark.slow
def test_media_inside_instances():
    objects = block(homogeneous(1.0, 0.8))
    group = {"type": "shapegroup", "block": objects.pop("block")}
    pose = T().rotate([0, 0, 1], 30)
    objects |= {"group": group, "copy": {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": pose}}
    steady, _ = runs(load(objects), spp=512, seed=40)
    expected = steady_runs(load(objects, integrator="volpath"), spp=512, seed=900)
    result = two_sample_z_test(steady, expected, rounding=1e-5)
    assert result.passed, str(result)
    refused = load(objects, integrator="transient_path")
    with pytest.raises(SceneError, match="transient_prbvolpath"):
        refused.integrator().render(refused, spp=1)
