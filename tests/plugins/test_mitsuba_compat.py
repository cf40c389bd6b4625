"""What Mitsuba 3.9.1 does wrong, on Mitsuba alone: a test that fails here says that Mitsuba has mended it.

Then the entry of ``plugins/mitsuba_compat.py`` and what asks for it can go. Below, what those entries answer.
"""

from __future__ import annotations

import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins
from torchtransient.plugins import mitsuba_compat as compat

RGB, POLARIZED, SPECTRAL = "llvm_ad_rgb", "llvm_ad_mono_polarized", "llvm_ad_spectral"


def activate(variant):
    mi.set_variant(variant)
    plugins.sync()


def interaction(wi):
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi, si.sh_frame = mi.Vector3f(wi), mi.Frame3f(mi.Normal3f(0, 0, 1))
    return si


def unit(x, y, z):
    return dr.normalize(mi.Vector3f(x, y, z))


def matrix(value):
    return np.array([[float(value[i, j][0][0]) for j in range(4)] for i in range(4)])


def test_version():
    assert mi.__version__ == compat.WRITTEN_AGAINST, "the entries were checked against another version of Mitsuba"


# ------------------------------------------------------------------------------------------------- lobes and their pdf


def slopes_of_lobe(bsdf, sample1, attach):
    """Relative derivatives of (weight, density) of a sampled lobe."""
    x, wi = attach(mi.traverse(bsdf))
    dr.enable_grad(x)
    bs, weight = bsdf.sample(mi.BSDFContext(), interaction(wi(x)), mi.Float(sample1), mi.Point2f(0.3, 0.4))
    dr.set_grad(x, 1.0)
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward)
    return float(dr.grad(weight)[0][0] / weight[0][0]), float(dr.grad(bs.pdf)[0] / bs.pdf[0])


def by_index(params):
    def wi(x):
        params["eta"] = x
        params.update()
        return unit(0.6, 0.0, 0.8)

    return mi.Float(1.5), wi


def by_direction(params):
    return mi.Float(0.8), lambda c: mi.Vector3f(dr.sqrt(1 - c * c), 0, c)


@pytest.mark.parametrize(("plugin", "attach"), [("thindielectric", by_index), ("plastic", by_direction)])
def test_delta_weights_lack_the_derivative_of_their_probability(plugin, attach):
    activate(RGB)
    bsdf = mi.load_dict({"type": plugin})
    weight, density = slopes_of_lobe(bsdf, 0.01, attach)
    # What is chosen in proportion to Fresnel's term has a weight without it: its derivative is all that is missing.
    assert abs(density) > 0.1 and abs(weight) < 0.3 * abs(density)
    assert compat.hides_lobe_probability(bsdf)
    assert compat.hides_lobe_probability(mi.load_dict({"type": "twosided", "bsdf": {"type": "plastic"}}))


@pytest.mark.parametrize("plugin", ["dielectric", "diff_dielectric"])
def test_delta_weights_of_others_have_it(plugin):
    activate(RGB)
    bsdf = mi.load_dict({"type": plugin})
    weight, density = slopes_of_lobe(bsdf, 0.01, by_direction)
    assert density == 0 and abs(weight) > 0.1
    assert not compat.hides_lobe_probability(bsdf)


# -------------------------------------------------------------------------------------------------------- polarization


def test_two_sided_matrices_from_behind_are_those_of_the_front():
    activate(POLARIZED)
    metal = {"type": "roughconductor", "alpha": 0.3}
    one, both = mi.load_dict(metal), mi.load_dict({"type": "twosided", "bsdf": metal})
    wi, wo = unit(0.5, 0.2, 0.8), unit(-0.3, 0.4, 0.7)
    mirrored = [mi.Vector3f(v.x, v.y, -v.z) for v in (wi, wo)]
    front = matrix(one.eval(mi.BSDFContext(), interaction(wi), wo))
    behind = matrix(both.eval(mi.BSDFContext(), interaction(mirrored[0]), mirrored[1]))
    np.testing.assert_allclose(behind, front, rtol=1e-5)
    assert abs(front[3, 1]) > 0.1 * front[0, 0], "this pair of directions would not tell the hands apart"
    assert compat.is_two_sided(both) and not compat.is_two_sided(one)
    assert compat.is_two_sided(mi.load_dict({"type": "mask", "bsdf": {"type": "twosided", "bsdf": metal}}))


def slope_at_the_normal(bsdf):
    x = mi.Float(0)
    dr.enable_grad(x)
    wi = dr.normalize(mi.Vector3f(x, 0.5 * x, 1))
    _, weight = bsdf.sample(mi.BSDFContext(), interaction(wi), mi.Float(0.3), mi.Point2f(0.3, 0.4))
    total = mi.Float(0)
    for i in range(4):
        for j in range(4):
            total += (i + 4 * j + 1) * weight[i, j][0]
    if not dr.grad_enabled(total):
        return 0.0
    dr.backward_from(total)
    return float(dr.grad(x)[0])


@pytest.mark.parametrize("plugin", ["conductor", "dielectric", "polarizer", "retarder"])
def test_derivatives_at_normal_incidence_are_not_numbers(plugin):
    activate(POLARIZED)
    assert np.isnan(slope_at_the_normal(mi.load_dict({"type": plugin})))
    assert np.isfinite(slope_at_the_normal(mi.load_dict({"type": compat.POLARIZED_PLUGINS[plugin]})))


def test_rough_dielectric_depolarises():
    activate(POLARIZED)
    wi, wo = unit(0.5, 0.2, 0.8), unit(-0.3, 0.4, 0.7)
    theirs, ours = (
        matrix(mi.load_dict({"type": name, "alpha": 0.3}).eval(mi.BSDFContext(), interaction(wi), wo))
        for name in ("roughdielectric", compat.POLARIZED_PLUGINS["roughdielectric"])
    )
    assert theirs[0, 0] == pytest.approx(ours[0, 0], rel=1e-4)
    assert not theirs[1:, 1:].any() and abs(ours[1, 1]) > 0.5 * ours[0, 0]


def test_wave_plate_jumps_at_oblique_incidence():
    activate(POLARIZED)

    def jump(plugin):
        plate = mi.load_dict({"type": plugin})
        beside = [
            plate.sample(mi.BSDFContext(), interaction(unit(0.5, y, 1.0)), mi.Float(0.3), mi.Point2f(0.3))[1]
            for y in (1e-4, -1e-4)
        ]
        return np.abs(matrix(beside[0]) - matrix(beside[1])).max()

    assert jump("retarder") > 0.5 and jump(compat.POLARIZED_PLUGINS["retarder"]) < 1e-2


# --------------------------------------------------------------------------------------------- indices, sides, spectra


def test_index_of_the_dielectric_is_a_plain_number():
    activate(RGB)
    params = mi.traverse(mi.load_dict({"type": "dielectric"}))
    assert isinstance(params["eta"], float) and params.flags("eta") & int(mi.ParamFlags.NonDifferentiable)
    ours = mi.traverse(mi.load_dict({"type": compat.DIFFERENTIABLE_PLUGINS["dielectric"]}))
    assert dr.is_jit_v(ours["eta"])


def test_hair_has_a_lobe_like_an_interface():
    activate(RGB)
    hair = mi.load_dict({"type": "hair"})
    flags = [hair.flags(i) for i in range(hair.component_count())]
    lobe = (mi.BSDFFlags.GlossyTransmission, mi.BSDFFlags.NonSymmetric)
    assert any(all(mi.has_flag(f, flag) for flag in lobe) for f in flags)
    assert compat.has_equal_sides(hair) and not compat.has_equal_sides(mi.load_dict({"type": "roughdielectric"}))


def test_colours_are_kept_as_coefficients_in_spectral_variants():
    colour = [0.2, 0.5, 0.7]
    for variant, kept in ((RGB, False), (SPECTRAL, True)):
        activate(variant)
        texture = mi.load_dict({"type": "rgb", "value": colour})
        value = np.array(mi.traverse(texture)["value"]).ravel()
        assert np.allclose(value, colour) != kept
        assert compat.keeps_coefficients(texture) == kept
        pixels = mi.Bitmap(np.full((2, 2, 3), 0.3, dtype=np.float32))
        assert compat.keeps_coefficients(mi.load_dict({"type": "bitmap", "bitmap": pixels, "raw": False})) == kept


@pytest.mark.parametrize(("plugin", "name"), [("normalmap", "normalmap"), ("bumpmap", "nested_texture")])
def test_slots_of_normals(plugin, name):
    activate(RGB)
    map_of = {"normalmap": {"type": "bitmap", "bitmap": mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32)), "raw": True}}
    bsdf = mi.load_dict({"type": plugin, **map_of, "bsdf": {"type": "conductor"}})
    assert compat.normal_texture(bsdf) == name
    assert any(key.startswith(f"{name}.") for key in mi.traverse(bsdf).keys())  # noqa: SIM118 (not a dictionary)
    assert compat.normal_texture(mi.load_dict({"type": "diffuse"})) is None


# ------------------------------------------------------------------------------------------------------ shapes, sensors


def test_merged_rectangles_have_no_bounds():
    activate(RGB)
    paint = {"type": "diffuse", "id": "paint"}
    parts = {
        f"part_{n}": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, n]),
            "bsdf": {"type": "ref", "id": "paint"},
        }
        for n in range(2)
    }
    scene = mi.load_dict({"type": "scene", "paint": paint, "all": {"type": "merge", **parts}})
    (shape,) = scene.shapes()
    assert not shape.bbox().valid() and not scene.bbox().valid()
    np.testing.assert_allclose(np.array(compat.bounds_of(shape).max), [1, 1, 1])


def test_shapes_do_not_speak_of_all_that_moves_them():
    """Why attached parameters are asked one by one, and not ``Shape.parameters_grad_enabled()``."""
    activate(RGB)
    scene = mi.load_dict(
        {
            "type": "scene",
            "group": {"type": "shapegroup", "part": {"type": "cube"}},
            "copy": {"type": "instance", "group": {"type": "ref", "id": "group"}},
            "mirror": {"type": "cube", "bsdf": {"type": "conductor"}},
        }
    )
    params = mi.traverse(scene)
    for key in ("copy.to_world", "mirror.vertex_normals"):
        value = type(params[key])(params[key])
        dr.enable_grad(value)
        params[key] = value
    params.update()
    assert not any(shape.parameters_grad_enabled() for shape in scene.shapes())


FILM = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}


def test_where_rays_of_sensors_start():
    activate(RGB)
    meter = mi.load_dict({"type": "radiancemeter", "film": FILM})
    camera = mi.load_dict({"type": "perspective", "near_clip": 0.5, "film": FILM})
    starts = [float(s.sample_ray(0.0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))[0].o.z[0]) for s in (meter, camera)]
    assert starts[0] == pytest.approx(mi.math.RayEpsilon) and starts[1] == pytest.approx(0.5)
    assert compat.starts_off_itself(meter) and not compat.starts_off_itself(camera)
    assert compat.near_clip(camera) == 0.5 and compat.near_clip(meter) is None


def test_classes_of_shapes_and_sensors():
    activate(RGB)
    assert compat.is_sphere(mi.load_dict({"type": "sphere"})) and not compat.is_sphere(mi.load_dict({"type": "disk"}))
    distant = mi.load_dict({"type": "distant", "film": FILM})
    aimed = mi.load_dict({"type": "distant", "film": FILM, "target": mi.ScalarPoint3f(0, 0, 0)})
    batch = mi.load_dict({"type": "batch", "a": {"type": "perspective"}, "b": {"type": "perspective"}})
    assert compat.is_distant(distant) and compat.is_distant(aimed) and not compat.is_distant(batch)
    assert compat.is_batch(batch) and not compat.is_batch(distant)
    scene = mi.load_dict(
        {
            "type": "scene",
            "group": {"type": "shapegroup", "part": {"type": "cube"}},
            "copy": {"type": "instance", "group": {"type": "ref", "id": "group"}},
        }
    )
    assert [compat.is_instance(shape) for shape in scene.shapes()] == [True]


def test_flat_shapes():
    activate(RGB)
    names = ("rectangle", "disk", "cube", "sphere", "cylinder")
    flat = [compat.is_flat(mi.load_dict({"type": name})) for name in names]
    assert flat == [True, True, True, False, False]
    bent = mi.load_dict({"type": "cube"})
    params = mi.traverse(bent)
    params["vertex_normals"] = dr.ravel(dr.normalize(dr.unravel(mi.Point3f, params["vertex_positions"])))
    params.update()
    assert not compat.is_flat(bent)


def test_patterned_lights():
    activate(RGB)
    board = {"type": "checkerboard"}

    def light(shape, **emitter):
        return compat.is_patterned(mi.load_dict({"type": shape, "emitter": emitter}).emitter())

    assert not light("rectangle", type="area", radiance=1.0)
    assert not light("cylinder", type="area", radiance=1.0)
    assert light("rectangle", type="area", radiance=board)
    assert not light("rectangle", type="angulararea", radiance=1.0)
    assert light("rectangle", type="angulararea", radiance=board)
    assert light("cylinder", type="angulararea", radiance=1.0)
    assert not compat.is_patterned(mi.load_dict({"type": "point"}))


BATCH = """
import torchtransient  # finds an LLVM
import drjit as dr, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
film = {"type": "hdrfilm", "width": 2, "height": 1, "rfilter": {"type": "box"}}
cameras = {"a": {"type": "perspective"}, "b": {"type": "perspective"}}
sensor = mi.load_dict({"type": "batch", "film": film, **cameras} if %r else {"type": "perspective", "film": film})
params = mi.traverse(sensor)
key = "a.x_fov" if "a.x_fov" in params else "x_fov"
x = mi.Float(params[key])
dr.enable_grad(x)
params[key] = x
params.update()
dr.set_grad(x, 1.0)
place = mi.Point2f([0.2, 0.7], [0.3, 0.3])
ray, _ = sensor.sample_ray_differential(time=0.0, sample1=0.5, sample2=place, sample3=mi.Point2f(0.5))
dr.enqueue(dr.ADMode.Forward, x)
dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)
assert dr.all(dr.isfinite(dr.grad(ray.d)), axis=None)
"""


def test_forward_mode_through_a_batch_of_sensors_ends_the_process():
    for batch, ends in ((False, False), (True, True)):
        run = subprocess.run([sys.executable, "-c", BATCH % batch], capture_output=True, text=True, timeout=300)
        assert (run.returncode != 0) == ends, run.stderr
        assert not ends or "unrecoverable" in run.stderr
