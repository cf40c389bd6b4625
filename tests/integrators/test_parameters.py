"""Every parameter of `transient_path`, and every kind of light and sensor, against closed forms and Mitsuba's `path`."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins
from torchtransient.errors import GradientError, SceneError, VariantError
from torchtransient.testing.statistics import two_sample_z_test

VARIANTS = ["llvm_ad_mono", "llvm_ad_rgb", "llvm_ad_spectral"]


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")
    plugins.sync()


def T():
    return mi.ScalarTransform4f()


def camera(width=8, height=6, start=0.0, bins=200, bin_width=0.05, fov=30.0, origin=(0, 0, 4), transient=True, **arguments):
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    if transient:
        film |= {"type": "transient_hdr_film", "temporal_bins": bins, "bin_width_opl": bin_width, "start_opl": start}
    return {
        "type": "perspective", "fov": fov, "near_clip": 0.1, "film": film,
        "to_world": T().look_at(origin=list(origin), target=[origin[0], origin[1], 0], up=[0, 1, 0]), **arguments,
    }  # fmt: skip


def load(sensor, objects, integrator="transient_path", **arguments):
    with plugins.plugin_errors():
        node = {"type": integrator, **({"max_depth": 4} | arguments)}
        return mi.load_dict({"type": "scene", "integrator": node, "sensor": sensor, **objects})


def runs(scene, count=6, spp=64, seed=0):
    results = [scene.integrator().render(scene, seed=seed + k, spp=spp) for k in range(count)]
    return [np.array([np.array(r[i]) for r in results], dtype=float) for i in (0, 1)]


def mitsuba_runs(sensor, objects, count=6, spp=64, **arguments):
    scene = load(sensor, objects, "path", **arguments)
    images = np.array([np.array(mi.render(scene, seed=700 + k, spp=spp)) for k in range(count)], dtype=float)
    return images[..., :1] if mi.is_monochromatic else images


def check(a, b):
    result = two_sample_z_test(a, b, rounding=1e-5)
    assert result.passed, str(result)
    assert result.chi2_z < 4.5, str(result)  # equal channels make it small


def room():
    """Walls, floor and a lamp (a mesh), with a mirror, glass, plastic, a picture on the wall and a sky through the open front."""
    picture = np.random.default_rng(1).uniform(0.1, 0.9, (6, 6, 3)).astype(np.float32)
    sky = np.random.default_rng(2).uniform(0.1, 0.6, (4, 8, 3)).astype(np.float32)
    return {
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)},
        "back": {
            "type": "rectangle", "to_world": T().translate([0, 0, -1]).scale(1.4),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "data": mi.TensorXf(picture)}},
        },
        "floor": {
            "type": "rectangle", "to_world": T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(1.4),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.7]}},
        },
        "lamp": {
            "type": "cube", "to_world": T().translate([0.3, 1.0, 0.2]).scale([0.4, 0.05, 0.4]),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [4.0, 3.0, 2.0]}},
        },
        "glass": {"type": "sphere", "center": [0.5, -0.6, 0.3], "radius": 0.35, "bsdf": {"type": "dielectric"}},
        "mirror": {
            "type": "cube", "to_world": T().translate([-0.6, -0.6, -0.1]).rotate([0, 1, 0], 30).scale(0.3),
            "bsdf": {"type": "roughconductor", "material": "Au", "alpha": 0.2},
        },
        "ball": {"type": "sphere", "center": [0.0, -0.75, 0.8], "radius": 0.22, "bsdf": {"type": "roughplastic", "alpha": 0.15}},
        "steel": {"type": "sphere", "center": [-0.5, 0.3, -0.2], "radius": 0.25, "bsdf": {"type": "conductor", "material": "Al"}},
    }  # fmt: skip


@pytest.mark.parametrize("variant", VARIANTS)
def test_steady_image_is_that_of_path(variant):
    mi.set_variant(variant)
    plugins.sync()
    steady, transient = runs(load(camera(bin_width=0.2), room(), max_depth=6), 8, 256)
    check(steady, mitsuba_runs(camera(transient=False), room(), 8, 256, max_depth=6))
    np.testing.assert_allclose(transient.sum(3), steady, atol=1e-5 * steady.max())


def lit_wall(**lamp):
    """A wall at z = 0 and a square lamp at z = 2 (a mesh) in front of its left half, seen from z = 4."""
    return {
        "wall": {"type": "rectangle", "to_world": T().scale(3), "bsdf": {"type": "diffuse", "reflectance": 0.5}},
        "lamp": {
            "type": "cube", "to_world": T().translate([-0.5, 0, 2]).scale([0.4, 0.4, 1e-3]),
            "emitter": {"type": "area", "radiance": 3.0},
        },
        **lamp,
    }  # fmt: skip


@pytest.mark.parametrize("depth", [0, 1, 2, 3, -1])
def test_max_depth(depth):
    steady, transient = runs(load(camera(), lit_wall(), max_depth=depth), 6, 128)
    np.testing.assert_allclose(transient.sum(3), steady, atol=1e-5)
    if depth == 0:
        assert not steady.any()
    else:
        check(steady, mitsuba_runs(camera(transient=False), lit_wall(), 6, 128, max_depth=depth))


@pytest.mark.parametrize("depth", [-2, -7])
def test_max_depth_out_of_range(depth):
    with pytest.raises(SceneError, match="max_depth"):
        load(camera(), {}, max_depth=depth)


def test_roulette_does_not_change_the_mean():
    box = mi.cornell_box()
    objects = {k: v for k, v in box.items() if k not in ("type", "integrator", "sensor")}
    sensor = camera(fov=39, origin=(0, 0, 3.9), bin_width=0.4, bins=60)
    scenes = [load(sensor, objects, max_depth=12, rr_depth=depth) for depth in (1, 1000)]
    early, late = (runs(scene, 12, 256, seed=100 * k)[1].mean((1, 2, 4)) for k, scene in enumerate(scenes))
    # bins of the whole picture, which hold enough events to be normally distributed
    check(early, late)
    # the roulette was at work: the same seed no longer draws the same paths
    a, b = (runs(scene, 1, 16)[0] for scene in scenes)
    assert np.abs(a - b).max() > 1e-3


def test_rr_depth_out_of_range():
    with pytest.raises(SceneError, match="rr_depth"):
        load(camera(), {}, rr_depth=0)


@pytest.mark.parametrize("hide", [False, True])
def test_hidden_area_lights_and_sky(hide):
    sky = {"sky": {"type": "constant", "radiance": 0.7}}
    objects = lit_wall(**sky) | {"wall": lit_wall()["wall"] | {"to_world": T().scale([3, 0.4, 1])}}
    steady, _ = runs(load(camera(), objects, hide_emitters=hide), 6, 128)
    check(steady, mitsuba_runs(camera(transient=False), objects, 6, 128, hide_emitters=hide))


def test_what_lies_behind_a_hidden_light_is_seen_at_its_own_distance():
    # rectangles take their hit point from the distance along the ray, so a wrong distance would be a wrong time
    lamp = {"lamp": {"type": "rectangle", "to_world": T().translate([0, 0, 2]).scale(0.5),
                     "emitter": {"type": "area", "radiance": 3.0}}}  # fmt: skip
    wall = {"wall": {"type": "rectangle", "to_world": T().scale(3), "bsdf": {"type": "diffuse", "reflectance": 0.5}},
            "point": {"type": "point", "position": [0.0, 0.0, 1.0], "intensity": 5.0}}  # fmt: skip
    sensor = camera(fov=5, width=1, height=1, bins=4, bin_width=0.04, start=4.98)
    hidden = load(sensor, wall | lamp, hide_emitters=True, max_depth=2)
    steady, transient = hidden.integrator().render(hidden, spp=256)
    bins = np.array(transient)[0, 0, :, 0]
    # 4 m to the wall and 1 m to the point light; the lamp is off its own axis, hence dark itself at depth 2 from the
    # front
    assert bins[0] > 0.5 * np.array(steady)[0, 0, 0]
    assert hidden.sensors()[0].film().energy_before == 0.0


def test_camera_unwarp_shifts_by_the_last_leg():
    objects = {
        "wall": {"type": "rectangle", "to_world": T().scale(3), "bsdf": {"type": "diffuse", "reflectance": 0.5}},
        "point": {"type": "point", "position": [0.3, 0.0, 4.0], "intensity": 5.0},
    }
    sensor = camera(fov=8, width=1, height=1, bins=6000, bin_width=1e-3, start=3.0, near_clip=1.5)
    spectra = []
    for unwarp in (False, True):
        scene = load(sensor, objects, max_depth=2, camera_unwarp=unwarp)
        bins = np.array(scene.integrator().render(scene, spp=1 << 14)[1], dtype=float)[0, 0, :, 0]
        spectra.append((np.arange(6000) + 0.5) @ bins / bins.sum() * 1e-3 + 3.0)
    # mean distance to the wall over the pixel, from a dense grid
    half = 4 * np.tan(np.radians(4))
    u = (np.arange(400) + 0.5) / 400 * 2 - 1
    x, y = np.meshgrid(u * half, u * half)
    cosine = 4 / np.sqrt((x - 0.3) ** 2 + y**2 + 16)
    weight, near = cosine**3, np.sqrt(x**2 + y**2 + 16)
    expected = (near * weight).sum() / weight.sum()
    noise = 4 * np.std(near) / 128
    assert noise < 2e-4
    assert spectra[0] - spectra[1] == pytest.approx(expected, abs=noise)
    assert spectra[1] == pytest.approx((4 / cosine * weight).sum() / weight.sum(), abs=noise)


def test_discard_direct_light():
    kept, discarded = (
        runs(load(camera(), lit_wall(), discard_direct_light=flag, max_depth=3), 6, 128, 100 * flag)[0] for flag in (False, True)
    )
    only_emission, _ = runs(load(camera(), lit_wall(), max_depth=1), 6, 128, 200)
    assert only_emission.max() == pytest.approx(3.0, rel=1e-5)
    check(discarded + only_emission, kept)


def test_temporal_filter_of_the_integrator_is_handed_to_the_film():
    objects, sensor = lit_wall(), camera(fov=2, width=1, height=1, bins=8, bin_width=0.5, start=5.0, origin=(2.0, 0, 4))
    histograms = {}
    for name in ("box", "tent", "gaussian"):
        scene = load(sensor, objects, temporal_filter=name, gaussian_stddev=1.5, max_depth=2)
        histograms[name] = np.array(scene.integrator().render(scene, spp=64, seed=1)[1])[0, 0, :, 0]
        film = scene.sensors()[0].film()
        assert film.temporal_filter == name and film.gaussian_stddev == 1.5
    occupied = [int((h > 1e-6 * h.max()).sum()) for h in histograms.values()]
    assert occupied[0] < occupied[1] < occupied[2]


def test_gaussian_width_alone_changes_the_film():
    sensor = camera()
    sensor["film"] |= {"temporal_filter": "gaussian"}
    scene = load(sensor, lit_wall(), gaussian_stddev=2.0)
    scene.integrator().render(scene, spp=1)
    assert scene.sensors()[0].film().filter.stddev == 2.0


def test_scene_of_mitransient_loads():
    scene = load(camera(), lit_wall(), temporal_filter="box", gaussian_stddev=2.0, camera_unwarp=False)
    assert scene.integrator().render(scene, spp=1)[1].shape == (6, 8, 200, 3)
    load(camera(), lit_wall(), temporal_filter="", gaussian_stddev=2.0)


@pytest.mark.parametrize(
    "arguments, words",
    [({"temporal_filter": "exponential"}, "box, tent, gaussian"), ({"gaussian_stddev": -1.0}, "gaussian_stddev"),
     ({"gaussian_stddev": 0.0}, "gaussian_stddev")],
)  # fmt: skip
def test_bad_temporal_filter(arguments, words):
    with pytest.raises(SceneError, match=words):
        load(camera(), {}, **arguments)


def test_unknown_parameter_is_reported():
    with pytest.raises(RuntimeError, match="max_dephth"):
        mi.load_dict({"type": "transient_path", "max_dephth": 3})


def test_gradients_need_a_bound_on_the_depth():
    scene = load(camera(), lit_wall(), max_depth=-1)
    params = mi.traverse(scene)
    shape = scene.sensors()[0].film().cube_shape()
    with pytest.raises(GradientError, match="max_depth"):
        scene.integrator().render_backward(scene, params, (None, mi.TensorXf(np.ones(shape))), spp=1)


def test_scalar_variant_is_refused():
    scene = load(camera(), lit_wall())
    integrator = scene.integrator()
    with mi.variant_context("scalar_rgb"), pytest.raises(VariantError, match="llvm_ad_rgb"):
        integrator.render(scene)


# ------------------------------------------------------------------------------------------- arrival times


def one_arrival(scene, spp=16, seed=0):
    """Mean arrival in metres, total, for a scene of one pixel with a narrow view."""
    film = scene.sensors()[0].film()
    bins = np.array(scene.integrator().render(scene, spp=spp, seed=seed)[1], dtype=float)[0, 0, :, 0]
    centers = film.start_opl + (np.arange(bins.size) + 0.5) * film.bin_width_opl
    assert film.energy_before == 0.0 and film.energy_after == 0.0
    return centers @ bins / bins.sum(), bins.sum()


def wall(z=0.0, size=3.0):
    return {"type": "rectangle", "to_world": T().translate([0, 0, z]).scale(size), "bsdf": {"type": "diffuse", "reflectance": 0.5}}


def narrow(**arguments):
    return camera(**({"fov": 0.01, "width": 1, "height": 1, "bins": 12000, "bin_width": 1e-3} | arguments))


@pytest.mark.parametrize("near", [1e-3, 0.5, 1.0, 3.5])
def test_light_beside_the_camera_arrives_at_twice_the_distance(near):
    objects = {"wall": wall(), "point": {"type": "point", "position": [0.0, 0.0, 4.0], "intensity": 5.0}}
    assert one_arrival(load(narrow(near_clip=near), objects))[0] == pytest.approx(8.0, abs=6e-4)


@pytest.mark.parametrize("near", [0.01, 2.0])
@pytest.mark.parametrize("kind", ["thinlens", "orthographic"])
def test_other_projective_sensors(kind, near):
    objects = {"wall": wall(), "point": {"type": "point", "position": [0.0, 0.0, 3.0], "intensity": 5.0}}
    sensor = narrow(near_clip=near)
    sensor["type"] = kind
    if kind == "thinlens":
        sensor |= {"aperture_radius": 1e-3, "focus_distance": 4.0}
    else:
        del sensor["fov"]
        sensor["to_world"] = sensor["to_world"] @ T().scale([1e-3, 1e-3, 1])
    assert one_arrival(load(sensor, objects))[0] == pytest.approx(7.0, abs=6e-4)


def test_sunlight_arrives_as_a_plane_wave():
    direction = np.array([0.5, -0.2, -1.0])
    direction /= np.linalg.norm(direction)
    objects = {"wall": wall(z=0.25), "far": wall(z=-2.0),
               "sun": {"type": "directional", "direction": list(direction), "irradiance": 2.0}}  # fmt: skip
    scene = load(narrow(origin=(1.0, 0.5, 4.0)), objects, max_depth=2)
    center, radius = np.array([0, 0, -0.875]), np.sqrt(9 + 9 + 1.125**2)
    point = np.array([1.0, 0.5, 0.25])
    expected = radius - (point - center) @ -direction + 3.75
    assert one_arrival(scene)[0] == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("z", [0.2, 0.9])
@pytest.mark.parametrize("sky", ["constant", "envmap"])
def test_visible_sky_arrives_from_the_sphere_around_the_scene(sky, z):
    """A camera inside the sphere, and one outside of it, which the wave reaches before t = 0."""
    light = {"type": "constant"} if sky == "constant" else {"type": "envmap", "bitmap": mi.Bitmap(np.ones((2, 4, 3), np.float32))}
    sensor = narrow(near_clip=0.2, start=-1.0)
    sensor["to_world"] = T().look_at(origin=[0, 0, z], target=[0, 0, 10], up=[0, 1, 0])
    arrival, total = one_arrival(load(sensor, {"wall": wall(z=-1.0, size=1.0), "sky": light}, max_depth=2))
    assert total == pytest.approx(1, rel=1e-5)
    assert arrival == pytest.approx(np.sqrt(2.0) - (z + 1.0), abs=6e-4)


def test_clock_of_distant_light_does_not_depend_on_merged_shapes():
    """Mitsuba merges rectangles into a mesh without bounds when it loads a scene; the sphere must hold them all the same."""
    objects = {"wall": wall(z=0.25), "far": wall(z=-2.0), "sky": {"type": "constant"}}
    description = {"type": "scene", "integrator": {"type": "transient_path"}, "sensor": narrow(), **objects}
    spheres = []
    for optimize in (False, True):
        scene = mi.load_dict(description, optimize=optimize)
        spheres.append(scene.integrator().facts(scene).distant)
    np.testing.assert_allclose([*spheres[0].center, spheres[0].radius], [*spheres[1].center, spheres[1].radius], rtol=1e-6)
    assert spheres[0].radius == pytest.approx(np.sqrt(9 + 9 + 1.125**2), rel=1e-6)


def test_clock_of_a_second_scene_is_its_own():
    """One integrator for many scenes: a scene that is gone must not lend its sphere to a later one at the same address."""
    integrator = mi.load_dict({"type": "transient_path"})
    for size in (1.0, 2.0, 3.0, 1.5):
        scene = mi.load_dict({"type": "scene", "wall": wall(size=size), "sky": {"type": "constant"}})
        assert integrator.facts(scene).distant.radius == pytest.approx(size * np.sqrt(2), rel=1e-6)
        del scene


def test_sky_through_both_strategies():
    """Under a uniform sky the first bounce arrives at known times whichever strategy found the light."""
    objects = {"wall": wall(size=1.0), "sky": {"type": "constant", "radiance": 1.0}}
    scene = load(narrow(bins=60, bin_width=0.1, start=3.0), objects, max_depth=2)
    _, transient = runs(scene, 8, 4096)
    edges = 3.0 + 0.1 * np.arange(61)
    # arrival 4 + sqrt(2) - 0 for a wall through the centre: the same for every direction from the centre of the wall
    bins = transient[:, 0, 0, :, 0].mean(0)
    inside = int((4 + np.sqrt(2) - 3.0) / 0.1)
    assert edges[inside] < 4 + np.sqrt(2) < edges[inside + 1]
    np.testing.assert_allclose(bins[inside], 0.5, rtol=2e-2)
    assert np.delete(bins, inside).max() == 0


def test_length_in_glass_counts_its_index():
    """A smooth slab 0.5 m thick before a wall, met at right angles; the lamp stands behind the camera."""
    objects = {
        "wall": wall(),
        # off the axis, so that no ray meets the diagonal of a face, where it may slip between two triangles
        "slab": {"type": "cube", "to_world": T().translate([0.3, 0.1, 2]).scale([2, 2, 0.25]),
                 "bsdf": {"type": "dielectric", "int_ior": 1.6, "ext_ior": 1.0}},
        "lamp": {"type": "rectangle", "to_world": T().translate([0, 0, 5]).rotate([0, 1, 0], 180).scale(0.1),
                 "emitter": {"type": "area", "radiance": 5.0}},
    }  # fmt: skip
    scene = load(narrow(bins=1300, bin_width=1e-2), objects, max_depth=8)
    bins = np.array(scene.integrator().render(scene, spp=1 << 18)[1], dtype=float)[0, 0, :, 0]
    start = np.arange(1300) * 1e-2
    front = 4 - 2.25 + 5 - 2.25
    back = front + 2 * 0.5 * 1.6
    R = (0.6 / 2.6) ** 2
    for order, expected in ((front, 5 * R), (back, 5 * R * (1 - R) ** 2)):
        assert bins[np.abs(start - order) < 0.015].sum() == pytest.approx(expected, rel=0.03)
    # through the slab, off the wall, and back: 2 * 0.5 * 0.6 m more than in air
    through = 9 + 2 * 0.5 * 0.6
    events = np.flatnonzero(bins)
    seen = events[(start[events] > back + 2 * 1.6 + 0.05) & (start[events] < back + 3 * 1.6 - 0.05)]
    assert seen.size and through - 0.02 < start[seen].min() < through + 0.02
