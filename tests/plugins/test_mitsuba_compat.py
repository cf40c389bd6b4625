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

from support.hair_model import scattered
from torchtransient import plugins
from torchtransient.plugins import mitsuba_compat as compat
from torchtransient.plugins import mitsuba_shapes
from torchtransient.plugins.bsdfs.mixtures import hides_lobe_probability, mirrors_matrices
from torchtransient.plugins.node_walk import objects_below, objects_of
from torchtransient.plugins.spectral_colours import keeps_coefficients

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
    assert hides_lobe_probability(bsdf)
    assert hides_lobe_probability(mi.load_dict({"type": "twosided", "bsdf": {"type": "plastic"}}))
    bumpy = {"type": "bumpmap", "texture": {"type": "bitmap", "data": mi.TensorXf(np.ones((2, 2, 1)))}}
    assert hides_lobe_probability(mi.load_dict({**bumpy, "bsdf": {"type": plugin}}))
    # Mixtures are asked part by part.
    assert not hides_lobe_probability(mi.load_dict({"type": "mask", "bsdf": {"type": plugin}}))


def test_blends_of_delta_lobes_have_wrong_values():
    activate(RGB)
    mirror = {"type": "conductor", "material": "none", "specular_reflectance": 0.9}
    paint = {"type": "diffuse", "reflectance": 0.5}
    bsdf = mi.load_dict({"type": "blendbsdf", "weight": 0.5, "a": paint, "b": mirror})
    n = 100_000
    u = mi.Float((np.arange(n) + 0.5) / n)
    si = interaction(unit(0.3, 0.0, 0.8))
    bs, weight = bsdf.sample(mi.BSDFContext(), si, u, mi.Point2f(0.3, 0.4))
    reflected = dr.mean(dr.select(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), weight.x, 0))
    # Half of the mirror: 0.45. What comes is divided by 1 / 2 and half of the density of the paint.
    assert abs(float(reflected[0]) - 0.45) > 0.02
    assert adds_up_wrongly(bsdf) and compat.weight_slot(bsdf) == "weight"
    assert not adds_up_wrongly(mi.load_dict({"type": "blendbsdf", "weight": 0.5, "a": paint, "b": paint}))


def adds_up_wrongly(bsdf):
    held = [part for _, part in objects_of(bsdf) if isinstance(part, mi.BSDF)]
    return compat.adds_up_wrongly(bsdf, held, objects_below(bsdf, mi.BSDF))


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
    assert mirrors_matrices(both) and not mirrors_matrices(one)
    assert mirrors_matrices(mi.load_dict({"type": "mask", "bsdf": {"type": "twosided", "bsdf": metal}}))


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


# ------------------------------------------------------------------------------------------- samples, lobes and tables


def many_samples(bsdf, count=20000):
    """(samples, their weights, interaction) for directions from behind the surface."""
    rng = mi.PCG32(count)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = -mi.warp.square_to_cosine_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    u, v = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
    return *bsdf.sample(mi.BSDFContext(), si, u, v), si


@pytest.mark.parametrize("plugin", ["principled", "principledthin", "roughdielectric"])
def test_samples_that_are_thrown_away_have_a_density(plugin):
    """What asks for it: ``discarded`` in the attached form of scattering by surfaces."""
    activate(RGB)
    rough = {"alpha": 0.7} if plugin == "roughdielectric" else {"roughness": 0.8, "spec_trans": 0.5}
    thin = {"diff_trans": 0.5} if plugin == "principledthin" else {}
    bsdf = mi.load_dict({"type": plugin, **rough, **thin})
    sample, weight, si = many_samples(bsdf)
    value = dr.max(bsdf.eval(mi.BSDFContext(), si, sample.wo))
    lost = (dr.max(weight) == 0) & (sample.pdf > 0) & (value > 0)
    assert dr.count(lost)[0] > 20


def clearcoat_slope(weight):
    """(derivative of a principled surface by its clearcoat, forward difference)."""
    bsdf = mi.load_dict({"type": "principled", "clearcoat": {"type": "uniform", "value": weight}})
    params = mi.traverse(bsdf)

    def value(x):
        params["clearcoat.value"] = x
        params.update()
        wi, wo = unit(0.3, 0.1, 0.9), unit(-0.3, -0.1, 0.9)
        return dr.sum(bsdf.eval(mi.BSDFContext(), interaction(wi), wo))

    x = mi.Float(weight)
    dr.enable_grad(x)
    dr.backward(value(x))
    return float(dr.grad(x)[0]), float(((value(mi.Float(weight + 0.1)) - value(mi.Float(weight))) / 0.1)[0])


def test_a_lobe_of_weight_zero_is_skipped():
    activate(RGB)
    at_zero, difference = clearcoat_slope(0.0)
    assert at_zero == 0 and difference > 0.1
    beside, difference = clearcoat_slope(1e-6)
    assert beside == pytest.approx(difference, rel=1e-3)
    assert 0 in compat.LOST_AT["Principled"]["clearcoat"]


@pytest.mark.parametrize("plugin", compat.METALS.values())
@pytest.mark.parametrize(("slot", "index"), [("eta", (0.0, 2.0)), ("k", (0.4, 0.0))])
def test_metals_lose_their_slopes_without_index_or_absorption(plugin, slot, index):
    activate("llvm_ad_mono")

    def reflected(x):
        numbers = {"eta": index[0], "k": index[1]}
        textures = {name: {"type": "uniform", "value": value} for name, value in numbers.items()}
        params = mi.traverse(bsdf := mi.load_dict({"type": plugin, **textures}))
        params[f"{slot}.value"] = x
        params.update()
        # Every facet that light reaches here is beyond the angle of total reflection.
        ctx, si = mi.BSDFContext(), interaction(unit(0.6, 0.0, 0.8))
        smooth = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)
        return bsdf.sample(ctx, si, 0.5, mi.Point2f(0.5))[1] if smooth else bsdf.eval(ctx, si, unit(-0.6, 0.0, 0.8))

    x = mi.Float(0)
    dr.enable_grad(x)
    dr.backward(reflected(x)[0], flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    change = float((reflected(mi.Float(0.01))[0] - reflected(mi.Float(0))[0])[0]) / 0.01
    assert dr.grad(x)[0] == 0 and abs(change) > 0.3
    assert compat.loses_slope_of_metal(slot, (index[0],) * 2, (index[1],) * 2)


@pytest.mark.slow
@pytest.mark.parametrize("cls", compat.PLASTICS)
@pytest.mark.parametrize("black", [0, 1])
def test_black_lobes_of_plastics_are_never_sampled(cls, black):
    activate(RGB)
    lobes = ("specular_reflectance", "diffuse_reflectance")
    samples = {}
    for plugin in (compat.PLASTICS[cls], compat.DIFFERENTIABLE_PLUGINS[compat.PLASTICS[cls]]):
        colours = {name: {"type": "uniform", "value": float(i != black)} for i, name in enumerate(lobes)}
        bsdf = mi.load_dict({"type": plugin, **colours})
        si = dr.zeros(mi.SurfaceInteraction3f, 1000)
        si.wi = unit(0.3, 0.1, 0.9)
        u = dr.linspace(mi.Float, 0, 1, 1000, endpoint=False)
        samples[plugin], _ = bsdf.sample(mi.BSDFContext(), si, u, mi.Point2f(0.3, 0.6))
    theirs, ours = (np.mean(np.array(bs.sampled_component) == black) for bs in samples.values())
    assert theirs == 0 and ours > 0.01
    assert compat.lost_at(mi.load_dict({"type": compat.PLASTICS[cls]}), lobes[black]) == (0,)


@pytest.mark.slow
def test_rough_plastic_has_no_derivative_through_its_tables():
    activate(RGB)
    context = mi.BSDFContext()
    context.component = 1  # of the diffuse base, where roughness acts through the tables alone

    def derivative(plugin):
        bsdf = mi.load_dict({"type": plugin, "alpha": 0.3})
        params = mi.traverse(bsdf)
        x = mi.Float(0.3)
        dr.enable_grad(x)
        params["alpha"] = x
        params.update()
        value = dr.sum(bsdf.eval(context, interaction(unit(0.3, 0.1, 0.9)), unit(-0.3, -0.1, 0.9)))
        if not dr.grad_enabled(value):
            return 0.0
        dr.backward(value)
        return float(dr.grad(x)[0])

    assert derivative("roughplastic") == 0
    assert derivative(compat.DIFFERENTIABLE_PLUGINS["roughplastic"]) < -0.01


def test_lobes_of_hair_are_not_those_of_its_samples():
    """Too dark where the series of the Bessel function ends, of another slope, and flat past three crossings."""
    activate(RGB)
    absorbing = {"sigma_a": {"type": "uniform", "value": 0.5}, "int_ior": 1.55, "ext_ior": 1.0}
    wi, wo = unit(0.1, 0.0, 1.0), unit(0.1, 0.02, 1.0)

    def value(plugin, roughness):
        bsdf = mi.load_dict({"type": plugin, "longitudinal_roughness": roughness, **absorbing})
        return float(bsdf.eval(mi.BSDFContext(), interaction(wi), wo)[0][0])

    def truth(roughness):
        return scattered(np.array(wi), np.array(wo), 0.5, (roughness, 0.3))[0]

    ours = compat.DIFFERENTIABLE_PLUGINS["hair"]
    for plugin, largest in (("hair", 0.005), (ours, 1e-4)):
        # The reflected lobe has a concentration of 12 there.
        error = value(plugin, 0.296) / truth(0.296) - 1
        assert (abs(error) > 0.003) == (plugin == "hair") and abs(error) < 2 * largest

    samples = {}
    for plugin in ("hair", ours):
        bsdf = mi.load_dict({"type": plugin, "sigma_a": 0.0, "int_ior": 3.0})
        rng = mi.PCG32(20000)
        points = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        si = dr.zeros(mi.SurfaceInteraction3f, 20000)
        si.wi = unit(0.3, 0.5, 0.8)
        samples[plugin] = np.array(bsdf.sample(mi.BSDFContext(), si, *points)[0].wo.y)
    assert np.mean(np.abs(samples["hair"]) < 1e-6) > 0.03
    assert np.mean(np.abs(samples[ours]) < 1e-6) < 1e-3


def test_the_sun_shows_its_angle_in_its_description_alone():
    activate(RGB)
    sky = mi.load_dict({"type": "sunsky", "sun_direction": [0.0, 0.6, 0.8], "sun_aperture": 2.5, "sky_scale": 0.0})
    assert not any("aperture" in key for key in mi.traverse(sky).properties)
    half = compat.sun_half_angle(sky)
    assert half == pytest.approx(np.radians(1.25), rel=1e-5)

    def light_at(angle):
        si = dr.zeros(mi.SurfaceInteraction3f)
        towards = np.arctan2(0.6, 0.8) + angle
        si.wi = -mi.Vector3f(0, float(np.sin(towards)), float(np.cos(towards)))
        return float(dr.max(sky.eval(si))[0])

    assert light_at(0.99 * half) > 0 and light_at(1.01 * half) == 0


# --------------------------------------------------------------------------------------------- indices, sides, spectra


def test_colours_are_kept_as_coefficients_in_spectral_variants():
    colour = [0.2, 0.5, 0.7]
    for variant, kept in ((RGB, False), (SPECTRAL, True)):
        activate(variant)
        texture = mi.load_dict({"type": "rgb", "value": colour})
        value = np.array(mi.traverse(texture)["value"]).ravel()
        assert np.allclose(value, colour) != kept
        assert keeps_coefficients(texture, "value") == kept
        pixels = mi.Bitmap(np.full((2, 2, 3), 0.3, dtype=np.float32))
        assert keeps_coefficients(mi.load_dict({"type": "bitmap", "bitmap": pixels, "raw": False}), "data") == kept


def test_attributes_of_meshes_do_not_say_that_they_vary():
    activate(RGB)
    texture = mi.load_dict({"type": "mesh_attribute", "name": "vertex_color", "scale": 2.0})
    mesh = mi.load_dict({"type": "cube"})
    mesh.add_attribute("vertex_color", 1, np.linspace(0, 1, mesh.vertex_count()).tolist())
    rays = mi.Ray3f(mi.Point3f([-0.5, 0.5], 0.0, 3.0), mi.Vector3f(0, 0, -1))
    values = np.array(texture.eval_1(mi.load_dict({"type": "scene", "mesh": mesh}).ray_intersect(rays)))
    assert values[0] != values[1]
    assert not texture.is_spatially_varying() and compat.varies(texture)
    assert not compat.varies(mi.load_dict({"type": "uniform", "value": 0.5}))
    assert compat.attribute_name(texture) == "vertex_color"
    assert compat.attribute_name(mi.load_dict({"type": "checkerboard"})) is None


@pytest.mark.parametrize("size", [1, 3, 4])
def test_attributes_of_another_size_read_as_zero(size):
    mesh = mi.load_dict({"type": "cube"})
    mesh.add_attribute("vertex_color", size, [0.5] * (size * mesh.vertex_count()))
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.shape = mi.ShapePtr(mesh)
    texture = mi.load_dict({"type": "mesh_attribute", "name": "vertex_color"})
    read = {
        "base_color": dr.max(texture.eval(si))[0],
        "roughness": texture.eval_1(si)[0],
        "normalmap": dr.max(texture.eval_3(si))[0],
    }
    holders = dict.fromkeys(read, mi.load_dict({"type": "principled"}))
    holders["normalmap"] = mi.load_dict({"type": "normalmap", "normalmap": texture, "nested": {"type": "diffuse"}})
    for slot, value in read.items():
        assert (value > 0) == (size in compat.attribute_sizes(holders[slot], slot)), slot


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
    np.testing.assert_allclose(np.array(mitsuba_shapes.bounds_of(shape).max), [1, 1, 1])


def round_shape(plugin):
    shapes = {
        "sphere": {"type": "sphere", "radius": 0.8},
        "cylinder": {"type": "cylinder", "p0": [-2, 0, 0], "p1": [2, 0.1, 0], "radius": 0.7},
    }
    if plugin in shapes:
        return {"shape": shapes[plugin]}
    group = {"type": "shapegroup", "ball": shapes["sphere"]}
    pose = mi.ScalarTransform4f().translate([0.1, 0, 0])
    return {"group": group, "copy": {"type": "instance", "to_world": pose, "group": {"type": "ref", "id": "group"}}}


def slopes_of_the_way_out(plugin):
    """Where a ray that shifts and turns leaves a shape: derivative of the distance by finite differences and by
    Mitsuba.
    """
    activate("llvm_ad_mono")
    scene = mi.load_dict({"type": "scene", **round_shape(plugin)}, optimize=False)

    def ray(x):
        return mi.Ray3f(mi.Point3f(0.3 + x, 0.2, -4 - 0.5 * x), dr.normalize(mi.Vector3f(0.01 - 0.2 * x, 0.02, 1)))

    def way_out(x):
        line = ray(mi.Float(x))
        start = scene.ray_intersect_preliminary(line).t + 1e-3
        onward = mi.Ray3f(line)
        onward.o = line(start)
        pi = scene.ray_intersect_preliminary(onward)
        pi.t += start
        return pi

    def slope(distance):
        x = mi.Float(0)
        dr.enable_grad(x)
        t = distance(way_out(0.0), ray(x))
        dr.forward(x)
        return float(dr.grad(t)[0])

    h = 1e-2
    expected = float((way_out(h).t - way_out(-h).t)[0]) / (2 * h)
    return expected, slope(lambda pi, line: pi.compute_surface_interaction(line, mi.RayFlags.Minimal).t)


@pytest.mark.parametrize("plugin", ["sphere", "cylinder", "instance"])
def test_distances_behind_round_shapes_have_the_derivative_of_those_before(plugin):
    expected, theirs = slopes_of_the_way_out(plugin)
    assert abs(theirs - expected) > 5e-3


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


@pytest.mark.slow
def test_forward_mode_through_a_batch_of_sensors_ends_the_process():
    for batch, ends in ((False, False), (True, True)):
        run = subprocess.run([sys.executable, "-c", BATCH % batch], capture_output=True, text=True, timeout=300)
        assert (run.returncode != 0) == ends, run.stderr
        assert not ends or "unrecoverable" in run.stderr


# -------------------------------------------------------------------------------------------------------- sphere lights


def towards_sphere(radius, height, p=(0, 0, 0), u=(0.3, 0.4), radiance=1.0, **more):
    """(direction sample, emission over density, density that is asked for) of Mitsuba's area light on a sphere."""
    activate("llvm_ad_mono")
    light = {"type": "sphere", "center": [0, 0, height], "radius": radius, **more}
    shape = mi.load_dict(light | {"emitter": {"type": "area", "radiance": radiance}})
    it = dr.zeros(mi.Interaction3f, max(dr.width(p), dr.width(u)))
    it.p = mi.Point3f(p)
    ds, weight = shape.emitter().sample_direction(it, mi.Point2f(u))
    return ds, weight.x, shape.emitter().pdf_direction(it, ds)


def test_cone_of_a_small_sphere_has_no_digits_left():
    """pi L (r / d)^2 of a sphere of 1 mm, and of one of 0.3 mm, at 3 m."""
    weights = [float(towards_sphere(radius, 3.0)[1][0]) / (np.pi * (radius / 3.0) ** 2) for radius in (1e-3, 3e-4)]
    assert weights[0] == pytest.approx(1.07, abs=0.06) and abs(weights[0] - 1) > 0.01
    assert weights[1] == 0
