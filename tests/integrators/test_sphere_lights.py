"""Spherical lights of any size, against closed forms: what they emit, its derivatives, and their densities."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.marks import long_rows
from support.runs import T, runs
from support.surface_samples import start
from torchtransient.accuracy import two_sample_z_test

RHO, DISTANCE, RADIANCE = 0.5, 3.0, 2.0
@pytest.fixture(autouse=True)
def _variant(request):
    start(request, "llvm_ad_mono_polarized" if request.node.name == "test_polarized" else "llvm_ad_mono")


def film(bins=400, width=0.02, start=2.0):
    return {
        "type": "transient_hdr_film", "width": 1, "height": 1, "temporal_bins": bins, "bin_width_opl": width,
        "start_opl": start, "temporal_filter": "tent", "rfilter": {"type": "box"},
    }  # fmt: skip


def lamp(ratio, distance=DISTANCE, emitter=None, **more):
    emitter = emitter or {"type": "area", "radiance": RADIANCE}
    return {"type": "sphere", "center": [0, 0, distance], "radius": ratio * distance, "emitter": emitter, **more}


def over_a_plane(*lights, bsdf=None, depth=2, integrator="transient_path", **more):
    """A point of a plane seen from close by and from the side, with lights above it."""
    bsdf = bsdf or {"type": "diffuse", "reflectance": RHO}
    lights = {f"light_{n}": light for n, light in enumerate(lights)}
    return mi.load_dict({
        "type": "scene", "integrator": {"type": integrator, "max_depth": depth},
        "sensor": {
            "type": "perspective", "fov": 0.02, "near_clip": 1e-4, "film": film(),
            "to_world": T().look_at(origin=[0.01, 0, 0.003], target=[0, 0, 0], up=[0, 1, 0]),
        },
        "plane": {"type": "rectangle", "to_world": T().scale(0.02), "bsdf": bsdf},
        **lights, **more,
    }, optimize=False)  # fmt: skip


def close_to(values, expected, slack=2e-5):
    """Mean of ``values`` is ``expected``, up to noise that could show a percent."""
    error = np.std(values, ddof=1) / np.sqrt(len(values))
    assert error < 2e-3 * abs(expected)
    assert abs(np.mean(values) - expected) < 4.5 * error + slack * abs(expected)


def steady(scene, count=6, spp=1 << 14):
    return runs(scene, count, spp)[0].mean((1, 2, 3))


@pytest.mark.parametrize(("ratio", "distance"), [(1e-6, 3.0), (1e-3, 300.0), (0.5, 3.0), (0.99, 300.0)])
def test_irradiance_below_a_sphere(ratio, distance):
    """E = pi L (r / d)^2, for any sphere that is above the horizon."""
    close_to(steady(over_a_plane(lamp(ratio, distance))), RHO * RADIANCE * ratio**2)


@pytest.mark.parametrize("kind", ["inside", "on the surface"])
def test_irradiance_inside_a_sphere(kind):
    """E = pi L everywhere in a sphere that shines inwards."""
    center = {"inside": 0.0, "on the surface": 2.0 - 1e-5}[kind]
    shell = {"type": "sphere", "center": [0, 0, center], "radius": 2.0, "flip_normals": True}
    shell["emitter"] = {"type": "area", "radiance": RADIANCE}
    close_to(steady(over_a_plane(shell), 8), RHO * RADIANCE, slack=2e-4)


@pytest.mark.slow
def test_polarized():
    images = runs(over_a_plane(lamp(0.1)), 8, 1 << 14)[0][:, 0, 0]
    close_to(images[:, 0], RHO * RADIANCE * 0.01, slack=5e-5)


def stripes():
    """A texture whose mean over the sphere is one, since it changes along the equator alone."""
    data = np.tile(np.array([0.5, 1.5, 0.2, 1.8], dtype=np.float32)[None, :, None], (2, 1, 3))
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True, "filter_type": "nearest"}


def on_its_side(weight):
    turned = T().translate([0, 0, 1]).rotate([0.6, 0.8, 0.0], 70).scale(0.4)
    emitter = {"type": "area", "radiance": stripes(), "sampling_weight": weight}
    return {"type": "sphere", "to_world": turned, "emitter": emitter}


DARK = {"type": "point", "position": [0, 0, 1], "intensity": 1e-30}


@pytest.mark.slow
def test_texture_of_a_turned_sphere():
    """The meridians differ: which texel is where, as rays find it that run into the sphere."""
    sampled, found = (steady(over_a_plane(on_its_side(weight), DARK), 8, 1 << 15) for weight in (1.0, 0.0))
    assert two_sample_z_test(sampled[:, None], found[:, None]).passed
    assert abs(sampled.mean() / (RHO * 0.16) - 1) > 0.02  # the texture shows


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1e-5, 1e-2])
def test_angular_light(ratio):
    """Emission into a cone of half angle c: as if the sphere had the radius r sin(c), up to r / d."""
    emitter = {"type": "angulararea", "radiance": RADIANCE, "cutoff_angle": 30.0}
    close_to(steady(over_a_plane(lamp(ratio, emitter=emitter)), 8, 1 << 18), RHO * RADIANCE * ratio**2 / 4, 2 * ratio)


@pytest.mark.slow
@pytest.mark.parametrize(("ratio", "alpha"), [(0.1, 0.02), (0.7, 0.5), (0.95, 0.02)])
def test_found_and_sampled_light_share_the_weight(ratio, alpha):
    """A rough mirror finds the light by itself, too: the sum over both does not depend on who does."""
    bsdf = {"type": "roughconductor", "alpha": alpha, "distribution": "ggx", "material": "none"}
    alone = over_a_plane(lamp(ratio), bsdf=bsdf)
    unsampled = {"type": "area", "radiance": RADIANCE, "sampling_weight": 0.0}
    found = over_a_plane(lamp(ratio, emitter=unsampled), DARK, bsdf=bsdf)
    both = steady(alone, 8, 1 << 18)
    assert both.mean() > 0
    assert two_sample_z_test(both[:, None], steady(found, 8, 1 << 18)[:, None]).passed


def test_lights_that_move():
    """What is kept of the lights is looked up again."""
    number = 2
    scene = over_a_plane(*[lamp(0.01, center=[0.3 * n, 0, DISTANCE]) for n in range(number)])
    before = steady(scene, 8, 1 << 14).mean()
    params = mi.traverse(scene)
    for key in [f"light_{n}.to_world" for n in range(number)]:
        params[key] = params[key] @ mi.Transform4f().scale(2.0)
    params.update()
    assert steady(scene, 8, 1 << 14).mean() == pytest.approx(4 * before, rel=1e-2)


@pytest.mark.parametrize(
    ("ratio", "key"), long_rows([(1e-3, "height"), (0.1, "radiance"), (0.9, "radius")], [(1e-3, "height")])
)
def test_derivatives(ratio, key):
    """Of rho L (r / d)^2, in both modes."""
    scene = over_a_plane(lamp(ratio))
    params = mi.traverse(scene)
    expected = RHO * RADIANCE * ratio**2 * {"radius": 2.0, "height": -2.0, "radiance": 1.0}[key]

    def install():
        x = mi.Float(1.0)
        dr.enable_grad(x)
        r, d, L = (mi.Float(v) for v in (ratio * DISTANCE, DISTANCE, RADIANCE))
        r, d, L = (v * x if key == k else v for v, k in ((r, "radius"), (d, "height"), (L, "radiance")))
        params["light_0.to_world"] = mi.Transform4f().translate(mi.Point3f(0, 0, d)).scale(mi.Point3f(r))
        params["light_0.emitter.radiance.value"] = L
        params.update()
        return x

    reverse, forward = [], []
    for seed in range(4):
        x = install()
        scene.integrator().render_backward(scene, params, (mi.TensorXf([[[1.0]]]), None), seed=seed, spp=1 << 14)
        for name in ("light_0.to_world", "light_0.emitter.radiance.value"):
            value = params[name]
            value = value.matrix if hasattr(value, "matrix") else value
            if dr.grad_enabled(value):
                dr.enqueue(dr.ADMode.Backward, value)
        dr.traverse(dr.ADMode.Backward)
        reverse.append(float(dr.grad(x)[0]))
        x = install()
        dr.set_grad(x, 1.0)
        derivative, _ = scene.integrator().render_forward(scene, params, seed=seed, spp=1 << 14)
        forward.append(float(np.array(derivative).sum()))
    close_to(reverse, expected, slack=2e-4)
    np.testing.assert_allclose(forward, reverse, rtol=1e-3)


@pytest.mark.slow
def test_small_light_in_fog():
    """Attenuated along the way: the connection ends at the sphere."""
    fog = {"type": "homogeneous", "sigma_t": 0.5, "albedo": 0.0}
    middle = T().translate([0, 0, 2.0]).scale([1, 1, 0.5])
    box = {"type": "cube", "to_world": middle, "bsdf": {"type": "null"}, "interior": fog}
    scene = over_a_plane(lamp(1e-4), integrator="transient_prbvolpath", box=box)
    close_to(steady(scene), RHO * RADIANCE * 1e-8 * np.exp(-0.5), slack=1e-4)
