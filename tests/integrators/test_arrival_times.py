"""When light arrives: every kind of sensor and of light against closed forms."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.plain_scenes import camera, load
from support.runs import T, runs

VARIANT = "llvm_ad_rgb"


def one_arrival(scene, spp=16, seed=0):
    """Mean arrival in metres, total, for a scene of one pixel with a narrow view."""
    film = scene.sensors()[0].film()
    bins = np.array(scene.integrator().render(scene, spp=spp, seed=seed)[1], dtype=float)[0, 0, :, 0]
    centers = film.start_opl + (np.arange(bins.size) + 0.5) * film.bin_width_opl
    assert film.energy_before == 0.0 and film.energy_after == 0.0
    return centers @ bins / bins.sum(), bins.sum()


def wall(z=0.0, size=3.0):
    return {
        "type": "rectangle",
        "to_world": T().translate([0, 0, z]).scale(size),
        "bsdf": {"type": "diffuse", "reflectance": 0.5},
    }


def narrow(**arguments):
    return camera(**({"fov": 0.01, "width": 1, "height": 1, "bins": 12000, "bin_width": 1e-3} | arguments))


def test_light_beside_the_camera_arrives_at_twice_the_distance():
    objects = {"wall": wall(), "point": {"type": "point", "position": [0.0, 0.0, 4.0], "intensity": 5.0}}
    assert one_arrival(load(narrow(near_clip=3.5), objects))[0] == pytest.approx(8.0, abs=6e-4)


@pytest.mark.parametrize("kind", ["thinlens", "orthographic"])
def test_other_projective_sensors(kind):
    objects = {"wall": wall(), "point": {"type": "point", "position": [0.0, 0.0, 3.0], "intensity": 5.0}}
    sensor = narrow(near_clip=2.0)
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
    objects = {
        "wall": wall(z=0.25),
        "far": wall(z=-2.0),
        "sun": {"type": "directional", "direction": list(direction), "irradiance": 2.0},
    }
    scene = load(narrow(origin=(1.0, 0.5, 4.0)), objects, max_depth=2)
    center, radius = np.array([0, 0, -0.875]), np.sqrt(9 + 9 + 1.125**2)
    point = np.array([1.0, 0.5, 0.25])
    expected = radius - (point - center) @ -direction + 3.75
    assert one_arrival(scene)[0] == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(("sky", "z"), [("constant", 0.2), ("envmap", 0.9)])
def test_visible_sky_arrives_from_the_sphere_around_the_scene(sky, z):
    """A camera inside the sphere, and one outside of it, which the wave reaches before t = 0."""
    light = (
        {"type": "constant"}
        if sky == "constant"
        else {"type": "envmap", "bitmap": mi.Bitmap(np.ones((2, 4, 3), np.float32))}
    )
    sensor = narrow(near_clip=0.2, start=-1.0)
    sensor["to_world"] = T().look_at(origin=[0, 0, z], target=[0, 0, 10], up=[0, 1, 0])
    arrival, total = one_arrival(load(sensor, {"wall": wall(z=-1.0, size=1.0), "sky": light}, max_depth=2))
    assert total == pytest.approx(1, rel=1e-5)
    assert arrival == pytest.approx(np.sqrt(2.0) - (z + 1.0), abs=6e-4)


def test_clock_of_a_second_scene_is_its_own():
    """One integrator for many scenes: a scene that is gone must not lend its sphere to another at its address."""
    integrator = mi.load_dict({"type": "transient_path"})
    for size in (1.0, 2.0, 3.0, 1.5):
        scene = mi.load_dict({"type": "scene", "wall": wall(size=size), "sky": {"type": "constant"}})
        assert integrator.reference(scene).radius == pytest.approx(size * np.sqrt(2), rel=1e-6)
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


@pytest.mark.slow
def test_length_in_glass_counts_its_index():
    """A smooth slab 0.5 m thick before a wall, met at right angles; the lamp stands behind the camera."""
    objects = {
        "wall": wall(),
        # off the axis, so that no ray meets the diagonal of a face, where it may slip between two triangles
        "slab": {
            "type": "cube",
            "to_world": T().translate([0.3, 0.1, 2]).scale([2, 2, 0.25]),
            "bsdf": {"type": "dielectric", "int_ior": 1.6, "ext_ior": 1.0},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, 5]).rotate([0, 1, 0], 180).scale(0.1),
            "emitter": {"type": "area", "radiance": 5.0},
        },
    }
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
