"""Scene dictionaries: no variant needed, picklable, and the geometry they are meant to have."""

import pickle

import mitsuba as mi
import numpy as np
import pytest

from support.sweeps import together
from torchtransient import scenes
from torchtransient.errors import ArgumentError, SceneError, UnitError


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def steady_dict(description):
    """The same scene for Mitsuba's own plugins: film and integrator become steady ones."""
    converted = {}
    for key, value in description.items():
        if isinstance(value, dict) and value.get("type") == "transient_hdr_film":
            value = {k: v for k, v in value.items() if k in ("width", "height", "rfilter")} | {"type": "hdrfilm"}
        elif isinstance(value, dict) and value.get("type") == "transient_path":
            value = {**value, "type": "path"}
        elif isinstance(value, dict):
            value = steady_dict(value)
        converted[key] = value
    return converted


def steady_image(description, spp=16, seed=0):
    return np.array(mi.render(mi.load_dict(steady_dict(description)), spp=spp, seed=seed))


def test_cornell_box_is_the_one_of_mitsuba():
    ours = mi.load_dict(steady_dict(scenes.cornell_box(32, spp=4)))
    reference = mi.cornell_box()
    reference["sensor"]["film"].update({"width": 32, "height": 32, "rfilter": {"type": "box"}})
    theirs = mi.load_dict(reference)
    np.testing.assert_allclose(np.array(ours.bbox().min), np.array(theirs.bbox().min), rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.array(ours.bbox().max), np.array(theirs.bbox().max), rtol=0, atol=1e-6)
    # the same scene, sampler and seed: the same random numbers, equal up to the rounding of the transforms
    image, expected = (np.array(mi.render(scene, spp=4, seed=0)) for scene in (ours, theirs))
    np.testing.assert_allclose(image.mean(axis=(0, 1)), expected.mean(axis=(0, 1)), rtol=1e-4)


def check_mean(description, expected, spp, slack=0.0):
    """The mean over pixels lies within 5 standard errors (12 seeds) of the closed form, plus a stated geometric
    slack."""
    means = [steady_image(description, spp=spp, seed=seed).mean(dtype=np.float64) for seed in range(12)]
    error = np.std(means, ddof=1) / np.sqrt(len(means))
    assert error < 0.01 * expected, "the test is too noisy to mean anything"
    rounding = 1e-5 * expected  # float32 sums; some of these images have no noise at all
    assert abs(np.mean(means) - expected) < 5 * error + slack * expected + rounding


def test_furnace_radiates_the_geometric_series():
    check_mean(scenes.furnace(2.0, 0.8, 1.0, max_depth=64), 5.0, spp=64)  # truncation 0.8**64 / 0.2 = 3e-6


def test_parallel_plates_radiate_the_geometric_series():
    check_mean(scenes.parallel_plates(1.0, 0.5, 1.0, max_depth=32), 2.0, spp=1024)


def test_integrating_sphere_total():
    check_mean(scenes.integrating_sphere(2.0, 0.5, 3.0), 0.5 * 3.0 / (np.pi * 4.0) / 0.5, spp=64)


def test_light_over_plane_total():
    # the light hangs 1e-4 of the height below the meter: (1 - 1e-4)**-2
    check_mean(scenes.light_over_plane(2.0, 0.5, 3.0), 2 * 3.0 * 0.5 / (5 * 4.0), spp=8192, slack=3e-4)


@pytest.mark.parametrize("light, total", [("behind", 0.96 * 0.96 / (1 - 0.04**2)), ("front", 2 * 0.04 / 1.04)])
def test_etalon_totals(light, total):
    check_mean(scenes.etalon_slab(0.5, 1.5, light=light), total, spp=16384)


def test_moving_wall_direct_light():
    d2, z = 0.25 + 3.5**2, 3.5
    # at the pixels' centre x = y = 0; the half width 0.306 of the field of view changes the mean by less than 1 %
    check_mean(scenes.moving_wall(0.5, resolution=4), 0.5 / np.pi * 10.0 * z / d2**1.5, spp=64, slack=0.015)


def _dictionaries():
    """Every dictionary that this room makes without a file."""
    shapes = {"a": scenes.triangle_mesh(np.eye(3), [[0, 1, 2]], reflectance=0.4)}
    others = ("bounds", "triangle_mesh", "milk_bottle", "look_at", "rotate", "scale", "translate")
    made = {name: make() for name, make in vars(scenes).items() if callable(make) and name not in others}
    return {**made, "triangle_mesh": shapes}


def test_mitsuba_loads_every_dictionary():
    """`mi.load_dict` takes the arrays that keep the dictionaries free of a variant."""
    made = _dictionaries()
    assert len(made) > 12
    for name, scene in made.items():
        before = pickle.dumps(scene)
        assert repr(pickle.loads(before)) == repr(scene), name
        loaded = mi.load_dict(scene)
        assert isinstance(loaded, mi.Scene if scene.get("type", "scene") == "scene" else mi.Shape), name
        assert pickle.dumps(scene) == before, name
    assert mi.load_dict(dict=made["cornell_box"], optimize=False).sensors()


MAKE = ("cornell_box", "furnace", "integrating_sphere", "parallel_plates", "moving_wall", "etalon_slab",
        "glass_slab_before_wall")  # fmt: skip


@pytest.mark.parametrize("name", MAKE)
def test_every_scene_hands_its_numbers_on(name):
    scene = getattr(scenes, name)(resolution=(5, 3), num_bins=7, start_opl=-1.5, bin_width_opl=0.25, spp=9, max_depth=4)
    assert scene["sensor"]["film"] == {
        "type": "transient_hdr_film", "width": 5, "height": 3, "rfilter": {"type": "box"}, "temporal_bins": 7,
        "start_opl": -1.5, "bin_width_opl": 0.25,
    }  # fmt: skip
    assert scene["sensor"]["sampler"] == {"type": "independent", "sample_count": 9}
    assert scene["integrator"]["max_depth"] == 4
    has_roulette = name in ("furnace", "integrating_sphere", "parallel_plates", "etalon_slab")
    assert scene["integrator"].get("rr_depth") == (1000 if has_roulette else None)


@together("call, error", [
    (lambda: scenes.cornell_box(mirror=True, glass=True), ArgumentError), (lambda: scenes.cornell_box(0), SceneError),
    *((lambda side=side: scenes.cornell_box(side), SceneError) for side in ((1, 2, 3), (3, 0))),
    (lambda: scenes.cornell_box(num_bins=2.5), SceneError), (lambda: scenes.cornell_box(bin_width_opl=0.0), UnitError),
    (lambda: scenes.cornell_box(start_opl=float("nan")), UnitError), (lambda: scenes.furnace(radius=-1.0), UnitError),
    (lambda: scenes.cornell_box(max_depth=-2), ArgumentError), (lambda: scenes.furnace(reflectance=1.2), UnitError),
    (lambda: scenes.etalon_slab(light="left"), ArgumentError),
])  # fmt: skip
def test_what_is_refused(call, error):
    with pytest.raises(error):
        call()
