"""Derivatives against closed forms, in both modes: black walls, lights that are found, clocks, indices, large spheres.

The film's tent filter keeps the mean arrival of what lies inside of its window: the sum of all bins, each times its
centre, is that of all values, each times its optical length. So ``I`` and ``I τ`` have closed forms, and where a beam
of no width sees a point light they have no noise.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.unknowns import move, set_color
from support.marks import long
from support.runs import T
from torchtransient import plugins

VARIANT = "llvm_ad_mono"
RHO = 0.5


def beam(origin, direction, bins=400, width=0.02, start=0.0):
    """A sensor that looks along one ray."""
    film = {
        "type": "transient_hdr_film", "width": 1, "height": 1, "rfilter": {"type": "box"}, "temporal_bins": bins,
        "bin_width_opl": width, "start_opl": start, "temporal_filter": "tent",
    }  # fmt: skip
    return {"type": "radiancemeter", "origin": list(origin), "direction": list(direction), "film": film}


def scene_of(sensor, depth, integrator="transient_path", properties=None, **objects):
    node = {"type": integrator, "max_depth": depth, "rr_depth": 100, **(properties or {})}
    with plugins.plugin_errors():
        return mi.load_dict({"type": "scene", "integrator": node, "sensor": sensor, **objects}, optimize=False)


def wall(reflectance=RHO, pose=None, **more):
    pose = T().scale(50.0) if pose is None else pose
    return {"type": "rectangle", "to_world": pose, "bsdf": {"type": "diffuse", "reflectance": reflectance}, **more}


def moments(scene, cube):
    """(sum, sum times arrival) of a film's cube."""
    film = scene.sensors()[0].film()
    centers = film.start_opl + (np.arange(film.temporal_bins) + 0.5) * film.bin_width_opl
    values = np.array(cube, dtype=float).reshape(film.temporal_bins, -1).mean(1)
    return np.array([values.sum(), values @ centers])


def weights(scene, moment):
    film = scene.sensors()[0].film()
    centers = film.start_opl + (np.arange(film.temporal_bins) + 0.5) * film.bin_width_opl
    g = np.broadcast_to(np.reshape(centers**moment, (-1, 1)), film.cube_shape()).astype(np.float32)
    return mi.TensorXf(np.ascontiguousarray(g))


def reverse(scene, *unknowns, spp, seed=0, moment=0):
    """Derivatives of a moment by each of the ``unknowns``, pairs of (function that writes it, value)."""
    params = mi.traverse(scene)
    base = {key: dr.copy(params[key]) for key in list(params.keys())}
    xs = [mi.Float(value) for _, value in unknowns]
    dr.enable_grad(*xs)
    for (apply, _), x in zip(unknowns, xs, strict=True):
        apply(params, x)
    changed = [key for key in base if dr.grad_enabled(params[key])]
    params.update()
    scene.integrator().render_backward(scene, params, (None, weights(scene, moment)), seed=seed, spp=spp)
    for key in changed:
        dr.enqueue(dr.ADMode.Backward, params[key])
    dr.traverse(dr.ADMode.Backward)
    found = [float(dr.grad(x)[0]) for x in xs]
    _put_back(params, base, changed)
    return found


def forward(scene, unknown, spp, seed=0):
    """The derivatives of both moments by one unknown."""
    params = mi.traverse(scene)
    base = {key: dr.copy(params[key]) for key in list(params.keys())}
    x = mi.Float(unknown[1])
    dr.enable_grad(x)
    unknown[0](params, x)
    changed = [key for key in base if dr.grad_enabled(params[key])]
    params.update()
    dr.set_grad(x, 1.0)
    _, cube = scene.integrator().render_forward(scene, params, seed=seed, spp=spp)
    found = moments(scene, cube)
    _put_back(params, base, changed)
    return found


def _put_back(params, base, changed):
    for key in changed:
        params[key] = base[key]
    params.update()


def both_modes(scene, unknown, spp=64, seeds=1):
    """(seeds, 2) derivatives of both moments in forward mode, which reverse mode has to agree with."""
    rows = []
    for seed in range(seeds):
        ahead = forward(scene, unknown, spp, seed)
        back = [reverse(scene, unknown, spp=spp, seed=seed, moment=moment)[0] for moment in (0, 1)]
        np.testing.assert_allclose(back, ahead, rtol=2e-3, atol=1e-5 * np.abs(ahead).max())
        rows.append(ahead)
    return np.array(rows)


def check_mean(rows, expected, error_below, slack=1e-3):
    """The mean of ``rows`` is ``expected`` up to noise, of which there is little enough to tell."""
    error = rows.std(0, ddof=1) / np.sqrt(len(rows))
    assert np.all(error < error_below * np.abs(expected)), error / expected
    assert np.all(np.abs(rows.mean(0) - expected) < 4.5 * error + slack * np.abs(expected)), (rows.mean(0), expected)


# ------------------------------------------------------------------------------------------------- black walls


def shell(weight, radius=2.0, radiance=3.0):
    """A sphere that shines inwards. With a ``weight`` of zero all connections are made to a light that is dark: rays
    alone find the shell.
    """
    emitter = {"type": "area", "radiance": radiance, "sampling_weight": weight}
    dark = {"type": "point", "position": [0, 0, 1.5], "intensity": 0.0, "sampling_weight": 1.0 - weight}
    return {"shell": {"type": "sphere", "radius": radius, "flip_normals": True, "emitter": emitter}, "dark": dark}


def albedo_of(key, value):
    return set_color(f"{key}.bsdf.reflectance.value"), value


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_light_beyond_a_wall_by_its_reflectance(weight):
    """In a shell of radiance L a wall looks like ρ L: the derivative by the reflectance of a black one is L."""
    lit = scene_of(
        beam((0, 0, 1), (0, 0, -1)), 2, wall=wall(0.0, T().scale(0.5)), **shell(weight),
        properties={"discard_direct_light": True},
    )  # fmt: skip
    rows = np.array([forward(lit, albedo_of("wall", 0.0), 512, seed)[0] for seed in range(8)])
    back = np.array([reverse(lit, albedo_of("wall", 0.0), spp=512, seed=seed)[0] for seed in range(8)])
    np.testing.assert_allclose(back, rows, rtol=2e-3)
    check_mean(rows, 3.0, 0.02)


@pytest.mark.slow
def test_mirrors_and_roulette():
    """A beam between two mirrors comes to the shell after five bounces, with L r^5; few of its samples live so long."""
    mirror = {"type": "conductor", "material": "none", "specular_reflectance": 0.7}
    low, high = ({"type": "rectangle", "to_world": pose, "bsdf": mirror} for pose in (
        T().translate([0, 0, -0.5]), T().translate([0, 0, 0.5]).rotate([1, 0, 0], 180)))  # fmt: skip
    lit = scene_of(
        beam((-0.9, 0, 0), (0.2, 0, -0.5)), 8, low=low, high=high, **shell(0.0), properties={"rr_depth": 1}
    )
    unknown = set_color("low.bsdf.specular_reflectance.value"), 0.7
    rows = np.array([forward(lit, unknown, 4096, seed)[0] for seed in range(8)])
    back = np.array([reverse(lit, unknown, spp=4096, seed=seed)[0] for seed in range(8)])
    np.testing.assert_allclose(back, rows, rtol=2e-3)
    check_mean(rows, 3 * 3.0 * 0.7**4, 0.02)


@pytest.mark.slow
@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_a_light_that_moves_leaves_the_other_derivatives_as_they_are(weight):
    """Which derivatives are asked for together does not change them. Where the shape of a light moves, its light is
    counted one vertex before the one that finds it: what all vertices before owe to it has to come through there.
    """
    emitter = {"type": "area", "radiance": 9.0, "sampling_weight": weight}
    lamp = {"type": "rectangle", "to_world": T().translate([-1, 0, 1]).rotate([0, 1, 0], 90).scale(0.8)}
    lit = scene_of(
        beam((0, 0, 1), (0, 0, -1)), 3, wall=wall(0.5, T().scale(0.6)),
        side=wall(0.8, T().translate([0.6, 0, 0.3]).rotate([0, 1, 0], -90).scale(0.3)),
        lamp=lamp | {"emitter": emitter},
        still={"type": "rectangle", "to_world": T().translate([0, 1, 1]).rotate([1, 0, 0], 90), "emitter": emitter},
        dark={"type": "point", "position": [0, 0, 1.5], "intensity": 0.0, "sampling_weight": 1.0 - weight},
    )  # fmt: skip
    first, second = albedo_of("wall", 0.5), albedo_of("side", 0.8)
    moving = move("lamp.to_world", (0, 0, 1)), 0.0
    for moment in (0, 1):
        options = {"spp": 4096, "seed": 3, "moment": moment}
        alone = [*reverse(lit, first, **options), *reverse(lit, second, **options)]
        together = reverse(lit, first, second, moving, **options)
        assert min(map(abs, together)) > 1e-3
        np.testing.assert_allclose(together[:2], alone, rtol=1e-4)


# ------------------------------------------------------------------------------------------------------- clocks


def over_a_wall(unwarp, sensor=None, depth=2):
    """A wall lit by a point, seen along a slanting beam."""
    sensor = sensor or beam((0.4, 0, 3), (0, 0, -1))
    lamp = {"type": "point", "position": [0.0, 0.3, 2.0], "intensity": 10.0}
    return scene_of(sensor, depth, wall=wall(), lamp=lamp, properties={"camera_unwarp": unwarp})


@pytest.mark.parametrize("unwarp", long([False, True], [True]))
def test_a_wall_that_moves_under_either_clock(unwarp):
    """With ``camera_unwarp`` the leg to the sensor counts neither in the arrival nor in its derivative."""

    def exact(z):
        r = np.sqrt(0.4**2 + 0.3**2 + (2 - z) ** 2)
        value = RHO / np.pi * 10.0 * (2 - z) / r**3
        return np.array([value, value * (r + (0 if unwarp else 3 - z))])

    lit = over_a_wall(unwarp)
    np.testing.assert_allclose(moments(lit, lit.integrator().render(lit, seed=0, spp=16)[1]), exact(0), rtol=1e-4)
    rows = both_modes(lit, (move("wall.to_world", (0, 0, 1)), 0.0), 16)
    np.testing.assert_allclose(rows[0], (exact(1e-4) - exact(-1e-4)) / 2e-4, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("unwarp", "unknown"), [(True, "field of view"), (False, "place")])
def test_a_camera_that_changes_under_either_clock(unwarp, unknown):
    """Rays begin at the near clip plane, and the clock at the pinhole: how long that part is changes with the field of
    view. The film has one pixel, and renders of one seed look at the same points of it: their difference is exact.
    """
    film = beam((0, 0, 0), (0, 0, 1))["film"]
    pose = T().look_at(origin=[0.4, 0.1, 3], target=[0, 0, 0], up=[0, 1, 0])
    sensor = {"type": "perspective", "fov": 30.0, "near_clip": 1.0, "to_world": pose, "film": film}
    lit = over_a_wall(unwarp, sensor)
    apply, value, step = {
        "field of view": (set_color("sensor.x_fov"), 30.0, 0.1),
        "place": (move("sensor.to_world", (0.3, 0, 1)), 0.0, 2e-3),
    }[unknown]
    sides = []
    params = mi.traverse(lit)
    base = {key: dr.copy(params[key]) for key in list(params.keys())}
    for sign in (1, -1):
        apply(params, mi.Float(value + sign * step))
        params.update()
        sides.append(moments(lit, lit.integrator().render(lit, seed=0, spp=256)[1]))
        _put_back(params, base, list(base))
    rows = both_modes(lit, (apply, value), 256)
    np.testing.assert_allclose(rows[0], (sides[0] - sides[1]) / (2 * step), rtol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("lamp_inside", [True, False])
def test_the_index_of_a_block_counts_along_the_shadow_ray(lamp_inside):
    """A beam enters a block of index n upright and meets a wall in it, which a point lights from inside of the block:
    I = T(n) / n^2 ..., τ = 2 + n (1 + r), all of which change with n. Or the beam leaves the block by its back side,
    and wall and lamp stand in the air behind it.
    """
    r = np.hypot(0.5, 0.8)
    block = {
        "type": "cube", "to_world": T().translate([0, 0, 1.0 if lamp_inside else 3.0]).scale([20, 20, 2]),
        "bsdf": {"type": "diff_dielectric", "int_ior": 1.5, "ext_ior": 1.0},
    }  # fmt: skip
    # From z = -1 to 3 or from 1 to 5; the beam begins 2 m above its upper face.
    where, start = (2.0, 5.0) if lamp_inside else (0.0, 7.0)
    lit = scene_of(
        beam((0, 0, start), (0, 0, -1), bins=60, width=0.25), 3 if lamp_inside else 4, block=block,
        wall=wall(pose=T().translate([0, 0, where]).scale(0.4)),
        lamp={"type": "point", "position": [0.5, 0, where + 0.8], "intensity": 10.0},
    )  # fmt: skip

    def exact(n):
        through = 1 - ((n - 1) / (n + 1)) ** 2
        value = RHO / np.pi * 10.0 * 0.8 / r**3 * through
        if lamp_inside:
            return value / n**2 * np.array([1, 2 + n * (1 + r)])
        return value * through * np.array([1, 2 + 4 * n + 1 + r])

    # Whether the beam is reflected is drawn by chance.
    rows = both_modes(lit, (set_color("block.bsdf.eta"), 1.5), 16384, seeds=6)
    check_mean(rows, (exact(1.5 + 1e-4) - exact(1.5 - 1e-4)) / 2e-4, 5e-3)


@pytest.mark.slow
def test_the_index_that_the_sensor_stands_in():
    """Where all stands in one block, its index does not change what is seen, but every length: I n (d + r)."""
    lit = scene_of(
        beam((0, 0, 1.5), (0, 0, -1)), 2, wall=wall(pose=T().scale(0.4)),
        lamp={"type": "point", "position": [0.5, 0, 0.8], "intensity": 10.0},
        block={"type": "cube", "to_world": T().scale([20, 20, 2]),
               "bsdf": {"type": "diff_dielectric", "int_ior": 1.5, "ext_ior": 1.0}},
    )  # fmt: skip
    r = np.hypot(0.5, 0.8)
    value = RHO / np.pi * 10.0 * 0.8 / r**3
    np.testing.assert_allclose(
        moments(lit, lit.integrator().render(lit, seed=0, spp=16)[1]), [value, value * 1.5 * (1.5 + r)], rtol=1e-4
    )
    rows = both_modes(lit, (set_color("block.bsdf.eta"), 1.5), 16)
    np.testing.assert_allclose(rows[0], [0, value * (1.5 + r)], rtol=1e-3, atol=1e-5)


# ---------------------------------------------------------------------------------------------- spherical lights


@pytest.mark.slow
def test_a_large_sphere_over_a_wall_that_moves():
    """I = ρ L (r / d)^2: rays find a large sphere as often as connections do. Where lengths change, derivatives come by
    connections alone; those of the reflectance, too, and nothing is counted twice.
    """
    d, radiance, ratio = 3.0, 2.0, 0.9
    lamp = {"type": "sphere", "center": [0, 0, d], "radius": ratio * d}
    lamp["emitter"] = {"type": "area", "radiance": radiance}
    lit = scene_of(beam((0.05, 0, 0.05), (-1, 0, -1), bins=200, width=0.05), 2, wall=wall(), lamp=lamp)
    albedo, moving = albedo_of("wall", RHO), (move("wall.to_world", (0, 0, 1)), 0.0)
    found = np.array([reverse(lit, albedo, moving, spp=1 << 13, seed=seed) for seed in range(8)])
    exact = np.array([radiance * ratio**2, 2 * RHO * radiance * ratio**2 / d])
    check_mean(found, exact, 0.03)
    rows = both_modes(lit, moving, 1 << 13, seeds=1)
    assert rows[0, 0] == pytest.approx(found[0, 1], rel=2e-3)
    lone = np.array([forward(lit, albedo, 1 << 13, seed) for seed in range(8)])
    check_mean(lone[:, :1], exact[:1], 0.03)
