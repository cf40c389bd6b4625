"""Distances, sizes, indices, roughnesses, albedos, extinctions, phase functions and bins from one end of their range to
the other, against closed forms; every value and derivative on the way is finite.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from scipy.integrate import quad

import torchtransient as tt
from support.extremes import (
    FACING_DOWN,
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
    square,
    tangent,
)
from torchtransient.scenes.transforms import look_at, scale, translate

VARIANT = "llvm_ad_mono"
# Nothing here warns but of edges that move: all are far outside of the view.
pytestmark = pytest.mark.filterwarnings(
    "error", "ignore::torchtransient.errors.GradientWarning", "ignore::DeprecationWarning:torch"
)
ROUNDING = 2e-6  # of a product of some ten factors in single precision
SAMPLES = 4096
# Five standard errors of the mean of numbers with a variance of one.
NOISE = 5 / math.sqrt(SAMPLES)
SIGMA_T, ALBEDO, G = (f"fog.interior_medium.{name}" for name in ("sigma_t.value.value", "albedo.value.value",
                                                                 "phase_function.g"))  # fmt: skip

# ---------------------------------------------------------------------------------------------------------- lengths


@for_all_runs
def test_wall_at_any_distance(variant, sampler, examples):
    """Light of a lamp beside the meter comes back from a wall at distance d as rho I / (pi d^2), after 2 d, in bins of
    any number; both follow the wall. Each number of bins is another kernel.
    """
    lamp = {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": 1.0}
    scene = tt.load(seen_from(0.0, 2, wall={"type": "rectangle", "to_world": square(-1, 1)}, lamp=lamp), variant=variant)
    pose, albedo = "wall.to_world", "wall.bsdf.reflectance.value"

    def property_(distance, share, bins):
        bins = min(bins, int(distance / 1.01e-7))  # narrower ones are refused
        axis = tt.TimeAxis(1.5 * distance, distance / bins, bins)
        renderer = tt.TransientRenderer(
            scene, [pose, albedo], time_axis=axis, spp=4, sampler=sampler, temporal_filter="tent", boundary=False
        )
        at = leaves(renderer, {pose: torch.tensor(square(-distance, distance)), albedo: share})
        light = light_over_time(renderer(at, seed=0))
        late = axis.centers_opl / distance - 2
        energy = share / (math.pi * distance**2)
        assert float(light.detach().sum()) == pytest.approx(energy, rel=ROUNDING)
        # A length is known to the rounding of the coordinates, in parts of the distance.
        assert float((light * late).detach().sum()) == pytest.approx(0, abs=ROUNDING * energy)
        of_pose, of_albedo = gradients((light * (1 + late)).sum(), at)
        # Up is nearer: the energy grows by 2 / d, and arrives earlier by as much. Adjoints of neighbouring bins differ
        # by 1 / bins, in single precision.
        assert of_pose[2, 3] == pytest.approx(0, abs=(1e-5 + 2e-7 * bins) * energy / distance)
        assert of_albedo.sum() == pytest.approx(1 / (math.pi * distance**2), rel=ROUNDING)

    bins = magnitudes(2, 1e5).map(round)
    holds(property_, examples // 3, distance=magnitudes(1e-3, 1e6), share=numbers(0, 1), bins=bins)


def room(size):
    """A floor, a wall, a block and a lamp, all lengths times ``size``."""

    def placed(kind, *transforms, reflectance=0.6, **more):
        to_world = np.linalg.multi_dot([scale(size), *transforms, np.eye(4)])
        return {"type": kind, "to_world": to_world, "bsdf": {"type": "diffuse", "reflectance": reflectance}, **more}

    film = {"type": "hdrfilm", "width": 3, "height": 3, "rfilter": {"type": "box"}}
    view = look_at([0, -1.5 * size, 0.8 * size], [0, 0, 0.3 * size], [0, 0, 1])
    upright = np.array([[1, 0, 0, 0], [0, 0, -1, 0.8], [0, 1, 0, 0.5], [0, 0, 0, 1.0]])
    clips = {"near_clip": 0.01 * size, "far_clip": 100 * size}
    return {
        "type": "scene",
        "integrator": {"type": "transient_path", "max_depth": 4},
        "sensor": {"type": "perspective", "fov": 40.0, "to_world": view, "film": film, **clips},
        "floor": placed("rectangle", scale(1.0)),
        "wall": placed("rectangle", upright, reflectance=0.5),
        "block": placed("cube", translate([0.2, 0.1, 0.2]), scale(0.2)),
        "lamp": placed(
            "rectangle", translate([-0.3, 0, 1.2]), FACING_DOWN, scale(0.2), emitter={"type": "area", "radiance": 3.0}
        ),
    }


@for_all_runs
def test_room_of_any_size(variant, sampler, examples):
    """With all lengths times s radiance is the same, s times later, and a derivative by a length is 1 / s of it.
    Mitsuba's rays start (1 + size) 9e-5 m off a surface, which a room of a millimetre feels.
    """
    pose, albedo, bins = "wall.to_world", "wall.bsdf.reflectance.value", 100

    def rendered(size):
        axis = tt.TimeAxis(1.0 * size, 0.06 * size, bins)
        renderer = tt.TransientRenderer(
            tt.load(room(size), variant=variant), [pose, albedo], time_axis=axis, spp=64, sampler=sampler,
            temporal_filter="tent", boundary=False, grad_seed="same",
        )  # fmt: skip
        out = renderer(seed=0)
        light = out.transient.double().mean((0, 2, 3))
        moving, painted = gradients((light * torch.linspace(1, 2, bins, dtype=torch.float64)).sum(), renderer.values)
        return light.detach().numpy(), moving[1, 3] * size, painted.sum()

    light, moving, painted = rendered(1.0)

    def property_(size):
        lifted = 9e-5 * (1 + 1 / size)
        found, of_pose, of_albedo = rendered(size)
        assert found.sum() == pytest.approx(light.sum(), rel=lifted)
        np.testing.assert_allclose(found, light, atol=10 * lifted * light.max())
        assert of_albedo == pytest.approx(painted, rel=lifted)
        # Segments in corners are as short as they are lifted.
        assert of_pose == pytest.approx(moving, rel=30 * lifted)

    holds(property_, examples // 4, size=magnitudes(1e-3, 1e6))


# --------------------------------------------------------------------------------------------------------- surfaces


@for_all_runs
def test_index_of_glass(variant, sampler, examples):
    """Straight down on glass: R of a lamp above after 3 m, and (1 - R) / n^2 of one below after 1 m + n 2 m, with the
    sum of both exact. An index of one is not there.
    """
    scene = seen_from(
        1.0, 3,
        glass={"type": "rectangle", "to_world": scale(3), "bsdf": {"type": "diff_dielectric", "int_ior": 1.5}},
        above={"type": "rectangle", "to_world": translate([0, 0, 2]) @ FACING_DOWN @ scale(3),
               "emitter": {"type": "area", "radiance": 1.0}},
        below={"type": "rectangle", "to_world": square(-2, 3), "emitter": {"type": "area", "radiance": 1.0}},
    )  # fmt: skip
    eta, axis = "glass.bsdf.eta", tt.TimeAxis(0.0, 0.25, 48)
    renderer = tt.TransientRenderer(
        tt.load(scene, variant=variant), [eta], time_axis=axis, spp=SAMPLES, sampler=sampler, boundary=False
    )

    def property_(n):
        at = leaves(renderer, {eta: n})
        light = light_over_time(renderer(at, seed=0))
        R, slope = ((n - 1) / (n + 1)) ** 2, 4 * (n - 1) / (n + 1) ** 3
        (found,) = gradients(light.sum(), at)
        energy = R + (1 - R) / n**2
        # One of two lobes is drawn, with the probabilities R and 1 - R.
        noise = NOISE * math.sqrt(R * (1 - R))
        assert float(light.detach().sum()) == pytest.approx(energy, abs=noise + ROUNDING)
        arrival = 3 * R + (1 + 2 * n) * (1 - R) / n**2
        assert float((light * axis.centers_opl).detach().sum()) == pytest.approx(arrival, abs=3 * noise + ROUNDING * 9)
        of_energy = slope * (1 - 1 / n**2) - 2 * (1 - R) / n**3
        assert found == pytest.approx(of_energy, abs=2 * noise + 2e-5)
        assert tangent(renderer, at, eta) == pytest.approx(of_energy, abs=2 * noise + 2e-5)
        if n == 1:
            late = axis.edges_opl[1:] <= 2.75
            assert float(light[late].detach().sum()) == 0  # half a bin before the 3 m of all there is

    holds(property_, examples, n=numbers(1, 4, 1 + 1e-6, 1.5))


@for_all_runs
def test_index_of_metal(variant, sampler, examples):
    """((n - 1)^2 + k^2) / ((n + 1)^2 + k^2), without noise, from metals without losses to glass without absorption."""
    metal = {"type": "rectangle", "bsdf": {"type": "diff_conductor", "eta": 0.2, "k": 3.0}}
    scene = tt.load(seen_from(0.5, 3, plate=metal, sky=SKY), variant=variant)
    keys = ["plate.bsdf.eta.value", "plate.bsdf.k.value"]
    renderer = tt.TransientRenderer(scene, keys, time_axis=tt.TimeAxis(0.0, 0.5, 60), spp=4, sampler=sampler)

    def property_(n, k):
        at = leaves(renderer, dict(zip(keys, (n, k), strict=True)))
        light = light_over_time(renderer(at, seed=0)).sum()
        of_n, of_k = gradients(light, at)
        whole = (n + 1) ** 2 + k**2
        digits = {"rel": 1e-4, "abs": 1e-5 + 1e-6 / max(n, k)}  # near an index of zero it all cancels
        assert float(light.detach()) == pytest.approx(1 - 4 * n / whole, abs=ROUNDING)
        assert of_n.sum() == pytest.approx(4 * (n * n - 1 - k * k) / whole**2, **digits)
        assert of_k.sum() == pytest.approx(8 * n * k / whole**2, **digits)

    holds(property_, examples, n=numbers(0, 4, 1, 1e-3), k=numbers(1e-3, 10, 1))


# Random numbers that draw visible facets along the normal, by the angle of the facet.
U = (np.arange(20000) + 0.5) / 20000


def facets(alpha):
    return np.arctan(np.sqrt(alpha**2 * U / (1 - U)))


def masking(alpha, angle):
    """Smith's for GGX, zero below the surface."""
    return np.where(angle < np.pi / 2, 2 / (1 + np.sqrt(1 + (alpha * np.tan(angle)) ** 2)), 0)


def rough_glass(alpha, n):
    """Light of a white sky, straight down on a rough surface: (reflected, transmitted). Walter et al. 2007."""
    angle = facets(alpha)
    c, s = np.cos(angle), np.sin(angle)
    g = np.sqrt(n * n - s * s)
    F = (((c - g) / (c + g)) ** 2 + ((n * n * c - g) / (n * n * c + g)) ** 2) / 2
    refracted = angle - np.arcsin(s / n)
    return (F * masking(alpha, 2 * angle)).mean(), ((1 - F) * masking(alpha, refracted)).mean() / n**2


@for_all_runs
def test_roughness_of_metal(variant, sampler, examples):
    """What facets of a metal without losses send on to a white sky, once."""
    bsdf = {"type": "diff_rough_conductor", "eta": 0.0, "k": 1.0, "alpha": 0.3, "distribution": "ggx"}
    scene = tt.load(seen_from(0.5, 3, plate={"type": "rectangle", "bsdf": bsdf}, sky=SKY), variant=variant)
    key = "plate.bsdf.alpha.value"
    renderer = tt.TransientRenderer(
        scene, [key], time_axis=tt.TimeAxis(0.0, 0.5, 60), spp=SAMPLES, sampler=sampler
    )

    def property_(alpha):
        at = leaves(renderer, {key: alpha})
        light = light_over_time(renderer(at, seed=0)).sum()
        (slope,) = gradients(light, at)
        clamped = max(alpha, 1e-4)  # Mitsuba's
        energy = masking(clamped, 2 * facets(clamped)).mean()
        # Samples lie between 0 and 1. Narrow lobes lose digits of the facet's height.
        assert float(light.detach()) == pytest.approx(energy, abs=NOISE * math.sqrt(energy * (1 - energy)) + 5e-4)
        near = [masking(a, 2 * facets(a)).mean() for a in (0.9 * clamped, 1.1 * clamped)]
        # By the logarithm of the roughness that of the density has a variance of 4 / 3, and its masking less.
        by_log = (near[1] - near[0]) / 0.2 if alpha > 1.001e-4 else 0
        assert slope * clamped == pytest.approx(by_log, abs=1.5 * NOISE + 0.01)

    holds(property_, examples, alpha=magnitudes(1e-5, 1, 0))


@for_all_runs
def test_roughness_and_index_of_glass(variant, sampler, examples):
    """Reflected and transmitted light of a white sky, from almost smooth to rough and from an index of exactly one."""
    bsdf = {"type": "diff_rough_dielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.3, "distribution": "ggx"}
    scene = tt.load(seen_from(0.5, 3, plate={"type": "rectangle", "bsdf": bsdf}, sky=SKY), variant=variant)
    eta, rough = "plate.bsdf.eta", "plate.bsdf.alpha.value"
    renderer = tt.TransientRenderer(
        scene, [rough, eta], time_axis=tt.TimeAxis(0.0, 0.5, 200), spp=SAMPLES, sampler=sampler
    )

    def property_(alpha, n):
        at = leaves(renderer, {rough: alpha, eta: n})
        light = light_over_time(renderer(at, seed=0)).sum()
        of_alpha, of_eta = gradients(light, at)
        clamped = max(alpha, 1e-3)
        parts = rough_glass(clamped, n)
        energy = sum(parts)
        # Samples lie between 0 and 1, or those of the one lobe between 0 and 1 / n^2.
        noise = NOISE * math.sqrt(max(parts[0] + parts[1] / n**2 - energy**2, 0))
        assert float(light.detach()) == pytest.approx(energy, abs=noise + 2e-3 * alpha + 1e-4)
        if n < 1.02:
            return  # the half vector has too few digits for a slope
        h = 1e-3 * (n - 1)
        expected = (sum(rough_glass(clamped, n + h)) - sum(rough_glass(clamped, n - h))) / (2 * h)
        # The refracted lobe is as wide as (n - 1) alpha: by the logarithm of that the variance is again about 4 / 3.
        assert of_eta == pytest.approx(expected, abs=1.5 * NOISE * energy / (n - 1) + 0.01)
        # Where reflected light and refracted light take turns, both lobes change by the roughness.
        near = [sum(rough_glass(a, n)) for a in (0.9 * clamped, 1.1 * clamped)]
        by_log = (near[1] - near[0]) / 0.2 if alpha > 1.001e-3 else 0
        assert of_alpha * clamped == pytest.approx(by_log, abs=1.5 * NOISE + 0.01)

    holds(property_, examples, alpha=magnitudes(1e-5, 1, 0), n=numbers(1, 4, 1 + 1e-6, 1.5))


@for_all_runs
def test_albedo_of_a_furnace(variant, sampler, examples):
    """The geometric series of a closed room, without noise: of albedo zero the first term alone, of one the number of
    terms; the derivative, too, in both modes.
    """
    terms = 12
    scene = tt.scenes.furnace(1.0, 0.5, 1.0, resolution=1, num_bins=12, bin_width_opl=2.0, max_depth=terms)
    key = "wall.bsdf.reflectance.value"
    renderer = tt.TransientRenderer(tt.load(scene, variant=variant), [key], spp=16, sampler=sampler, physics="ignore")
    powers = np.arange(terms)

    def property_(albedo):
        at = leaves(renderer, {key: albedo})
        out = renderer(at, seed=0)
        light = light_over_time(out)
        (slope,) = gradients(out.steady.double().mean(), at)
        assert float(out.steady.detach().double().mean()) == pytest.approx((albedo**powers).sum(), rel=ROUNDING)
        expected = (powers[1:] * albedo ** (powers[1:] - 1)).sum()
        assert slope.sum() == pytest.approx(expected, rel=1e-5)
        assert tangent(renderer, at, key) == pytest.approx(expected, rel=1e-5)
        if albedo == 0:
            assert not light.detach()[1:].any()

    holds(property_, examples, albedo=numbers(0, 1, 1e-30, 0.999))


@for_all_runs
def test_light_is_linear_in_an_albedo(variant, sampler, examples):
    """Light that meets a wall once is a line in its albedo, from exactly none."""
    scene = room(1.0)
    scene["integrator"]["max_depth"] = 2
    for name in ("floor", "block"):
        scene[name]["bsdf"]["reflectance"] = 0.0
    key = "wall.bsdf.reflectance.value"
    renderer = tt.TransientRenderer(
        tt.load(scene, variant=variant), [key], time_axis=tt.TimeAxis(0.0, 0.1, 60), spp=64, sampler=sampler,
        grad_seed="same",
    )  # fmt: skip

    def at_albedo(albedo):
        at = leaves(renderer, {key: albedo})
        out = renderer(at, seed=0)
        (slope,) = gradients(out.steady.double().sum(), at)
        return out.transient.detach().double(), slope.sum() / out.steady.shape[0]

    white, _ = at_albedo(1.0)
    of_lamp, _ = at_albedo(0.0)
    assert (white - of_lamp).sum() > 0.01

    def property_(albedo):
        light, slope = at_albedo(albedo)
        expected = of_lamp + albedo * (white - of_lamp)
        torch.testing.assert_close(light, expected, rtol=1e-5, atol=1e-7 * float(white.max()))
        assert slope == pytest.approx(float((white - of_lamp).sum() / white.shape[0]), rel=1e-5)

    holds(property_, examples, albedo=numbers(0, 1, 1e-30))


# ------------------------------------------------------------------------------------------------------------ media


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
        digits = energy * (ROUNDING + 4e-7 * extinction)
        assert float(light.detach()) == pytest.approx(albedo * energy, abs=albedo * (noise + digits))
        assert of_albedo == pytest.approx(energy, abs=noise + digits)
        # Depths have a deviation of 1 / extinction.
        assert of_extinction == pytest.approx(albedo * by_extinction, abs=2 * albedo * (noise + digits) / extinction)
        assert of_g == pytest.approx(albedo * by_g, abs=albedo * (noise + digits) * steepest)

    # From behind, light of dense fog is that of a few samples in a million.
    densest = 1e5 if height > 0 else 3
    holds(
        property_, examples, extinction=magnitudes(0.1, densest, 1), albedo=numbers(0, 1), g=numbers(-0.999, 0.999, 0)
    )


@for_all_runs
def test_light_from_the_side(variant, sampler, examples):
    """Across the line of sight g and -g scatter alike, sample by sample, with opposite slopes."""
    sun = {"type": "directional", "direction": [1.0, 0.0, 0.0], "irradiance": 1.0}
    scene = tt.load(seen_from(1.0, 2, fog=fog_between(-1, 0), sun=sun), variant=variant)
    renderer = tt.TransientRenderer(
        scene, [G, SIGMA_T], time_axis=tt.TimeAxis(-100.0, 1.0, 200), spp=64, sampler=sampler, grad_seed="same"
    )

    def at_asymmetry(g, extinction):
        at = leaves(renderer, {G: g, SIGMA_T: extinction})
        light = light_over_time(renderer(at, seed=0)).sum()
        return float(light.detach()), float(gradients(light, at)[0].sum())

    def property_(g, extinction):
        (light, slope), (other, opposite) = at_asymmetry(g, extinction), at_asymmetry(-g, extinction)
        assert light == pytest.approx(other, rel=1e-5)
        assert slope == pytest.approx(-opposite, rel=1e-4, abs=1e-6 * light)

    holds(property_, examples // 2, g=numbers(0, 0.999, 0.5), extinction=magnitudes(1e-3, 5))


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
