"""Extinctions, albedos and phase functions of fog from one end of their range to the other, against closed forms; every
value and derivative on the way is finite.
"""

import math

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.integrate import quad

import torchtransient as tt
from support.extremes import (
    NOISE,
    ROUNDING,
    SAMPLES,
    SKY,
    fog_between,
    for_all_runs,
    gradients,
    holds,
    leaves,
    light_over_time,
    magnitudes,
    numbers,
    seen_from,
    tangent,
)
from torchtransient.scenes import scale, translate

VARIANT = "llvm_ad_mono"
pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning", "error::torchtransient.errors.PhysicsWarning")
SIGMA_T = "fog.interior_medium.sigma_t.value.value"
ALBEDO = "fog.interior_medium.albedo.value.value"
G = "fog.interior_medium.phase_function.g"


@for_all_runs
def test_extinction_of_a_shadow(variant, sampler, examples):
    """exp(-sigma l) of a lamp above a metre of black fog, and its slope in both modes, until it underflows."""
    scene = seen_from(
        1.0, 2, floor={"type": "rectangle", "to_world": scale(3)}, fog=fog_between(1.5, 2.5),
        lamp={"type": "point", "position": [0.01, 0.02, 4.0], "intensity": 1.0},
    )  # fmt: skip
    renderer = tt.TransientRenderer(
        tt.load(scene, variant=variant), [SIGMA_T], time_axis=tt.TimeAxis(0.0, 0.5, 20), spp=4, sampler=sampler
    )
    distance = math.sqrt(16 + 5e-4)
    path, clear = distance / 4, 0.5 / math.pi * 4 / distance**3

    def property_(extinction):
        at = leaves(renderer, {SIGMA_T: extinction})
        light = light_over_time(renderer(at, seed=0)).sum()
        (slope,) = gradients(light, at)
        energy = clear * math.exp(-extinction * path)
        near = {"rel": ROUNDING * (1 + extinction), "abs": 1e-37}
        assert float(light.detach()) == pytest.approx(energy, **near)
        assert slope.sum() == pytest.approx(-path * energy, **near)
        assert tangent(renderer, at, SIGMA_T) == pytest.approx(-path * energy, **near)

    holds(property_, examples, extinction=magnitudes(1e-6, 1e5, 0))


def scattered_once(extinction, g, height, offset=0.3):
    """Light of a lamp at ``height`` that fog from z = -1 to 0 scatters straight up once, per albedo: (light, its
    derivative by the extinction and by g, largest weight of a sample)."""

    def at(z):
        away = math.hypot(offset, height + z)
        passed = (z if height > 0 else 1 - z) * away / abs(height + z)
        c = (height + z) / away
        root = 1 + g * g + 2 * g * c
        phase = (1 - g * g) / (4 * math.pi * root**1.5)
        by_g = -2 * g / (1 - g * g) - 3 * (g + c) / root
        weight = phase * math.exp(-extinction * passed) / away**2
        return weight, z + passed, by_g

    deep = min(1.0, 50 / extinction)

    def mean(factor):
        def integrand(z):
            weight, length, by_g = at(z)
            return extinction * math.exp(-extinction * z) * weight * factor(length, by_g)

        return quad(integrand, 0, deep, limit=200, epsabs=0, epsrel=1e-8)[0]

    largest = max(at(z)[0] for z in np.linspace(0, deep, 100))
    light = mean(lambda length, by_g: 1)
    of_extinction = light / extinction - mean(lambda length, by_g: length)
    steepest = max(abs(at(z)[2]) for z in np.linspace(0, deep, 100))
    return light, of_extinction, mean(lambda length, by_g: by_g), largest, steepest


@pytest.mark.parametrize("height", [1.0, -2.0], ids=["lit from above", "lit from below"])
@for_all_runs
def test_light_scattered_once(variant, sampler, examples, height):
    """A metre of fog of any extinction, phase function and albedo. The meter looks at the edge between two triangles of
    its boundary, and in dense fog all light is scattered beside that boundary.
    """
    lamp = {"type": "point", "position": [0.3, 0.0, height], "intensity": 1.0}
    scene = tt.load(seen_from(1.0, 2, fog=fog_between(-1, 0), lamp=lamp), variant=variant)
    keys = [SIGMA_T, ALBEDO, G]
    renderer = tt.TransientRenderer(
        scene, keys, time_axis=tt.TimeAxis(0.0, 0.1, 100), spp=SAMPLES, sampler=sampler
    )

    def property_(extinction, albedo, g):
        at = leaves(renderer, dict(zip(keys, (extinction, albedo, g), strict=True)))
        light = light_over_time(renderer(at, seed=0)).sum()
        of_extinction, of_albedo, of_g = (found.sum() for found in gradients(light, at))
        energy, by_extinction, by_g, largest, steepest = scattered_once(extinction, g, height)
        # Samples lie between 0 and the largest weight; depths are known to a few roundings of a metre.
        noise = NOISE * math.sqrt(largest * energy)
        digits = energy * (ROUNDING + 4e-7 * extinction) + 1e-37
        assert float(light.detach()) == pytest.approx(albedo * energy, abs=albedo * (noise + digits) + 1e-37)
        assert of_albedo == pytest.approx(energy, abs=noise + digits)
        # Depths have a deviation of 1 / extinction.
        near = albedo * (noise + digits)
        assert of_extinction == pytest.approx(albedo * by_extinction, abs=2 * near / extinction + 1e-37)
        assert of_g == pytest.approx(albedo * by_g, abs=near * steepest + 1e-37)

    # From behind, light of dense fog is that of a few samples in a million.
    densest = 1e5 if height > 0 else 3
    holds(
        property_, examples, extinction=magnitudes(0.1, densest, 1), albedo=numbers(0, 1), g=numbers(-0.999, 0.999, 0)
    )


@for_all_runs
def test_fog_in_a_furnace(variant, sampler, examples):
    """A sky of radiance one is seen through fog as at most one, and as one where nothing is absorbed and no light has
    more than the bounces that are followed.
    """
    scene = tt.load(seen_from(2.0, 48, fog={**fog_between(-1, 1), "type": "sphere", "to_world": scale(1)}, sky=SKY),
                    variant=variant)  # fmt: skip
    keys = [SIGMA_T, ALBEDO, G]
    renderer = tt.TransientRenderer(
        scene, keys, time_axis=tt.TimeAxis(0.0, 1.0, 200), spp=1024, sampler=sampler, physics="ignore"
    )

    def property_(extinction, albedo, g):
        at = leaves(renderer, dict(zip(keys, (extinction, albedo, g), strict=True)))
        light = light_over_time(renderer(at, seed=0)).sum()
        gradients(light, at)
        # By a connection and by scattering the sky is found with weights that add up to at most one each.
        noise = 5 / math.sqrt(1024)
        found = float(light.detach())
        assert 0 <= found <= 1 + noise
        # What passes the middle without a collision is no less, and nothing is lost in thin fog of albedo one.
        assert found >= math.exp(-2 * extinction) - noise
        if albedo == 1 and extinction <= 1:
            assert found == pytest.approx(1, abs=noise)

    extinctions, shares = magnitudes(1e-6, 1e5, 0, 1), st.one_of(st.just(1.0), numbers(0, 1))
    holds(property_, examples, extinction=extinctions, albedo=shares, g=numbers(-0.999, 0.999, 0))


def test_lamp_just_inside_of_fog():
    """The shadow ray ends in the fog, a millimetre behind its boundary, as far as such rays stop before an occluder."""
    depth = 1e-3
    scene = seen_from(
        1.0, 2, floor={"type": "rectangle", "to_world": scale(3)}, fog=fog_between(1.5, 2.5),
        lamp={"type": "point", "position": [0.0, 0.0, 1.5 + depth], "intensity": 1.0},
    )  # fmt: skip
    renderer = tt.TransientRenderer(tt.load(scene, variant=VARIANT), [SIGMA_T], time_axis=tt.TimeAxis(0.0, 0.5, 10))
    for extinction in (1.0, 1e3):
        at = leaves(renderer, {SIGMA_T: extinction})
        light = light_over_time(renderer(at, seed=0, spp=4)).sum()
        expected = 0.5 / math.pi / (1.5 + depth) ** 2 * math.exp(-extinction * depth)
        # Of the depth four digits are left in single precision.
        assert float(light.detach()) == pytest.approx(expected, rel=1e-3)
        assert gradients(light, at)[0].sum() == pytest.approx(-depth * expected, rel=2e-3)


def test_boundary_met_between_two_triangles():
    """A ray along the diagonal of a face may slip through it: derivatives have to follow the ray of the render."""

    def slope(*aside):
        fog = fog_between(-1, 0)
        fog["to_world"] = translate([*aside, 0]) @ fog["to_world"]
        lamp = {"type": "point", "position": [0.3, 0.0, -2.0], "intensity": 1.0}
        scene = tt.load(seen_from(1.0, 2, fog=fog, lamp=lamp), variant=VARIANT)
        renderer = tt.TransientRenderer(scene, [SIGMA_T], time_axis=tt.TimeAxis(0.0, 0.1, 100), spp=SAMPLES)
        light = renderer(seed=0).steady.sum()
        return float(gradients(light, renderer.values)[0].sum()), float(light.detach())

    (met_at_edge, light), (met_in_face, _) = slope(0, 0), slope(0.13, 0.07)
    assert met_at_edge == pytest.approx(met_in_face, abs=1e-5 * light)
