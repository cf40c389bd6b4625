"""Distances, sizes, bins, indices, roughnesses and albedos from one end of their range to the other, against closed
forms; every value and derivative on the way is finite.
"""

import math

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.extremes import (
    FACING_DOWN,
    NOISE,
    ROUNDING,
    SAMPLES,
    SKY,
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
from support.marks import long_rows
from torchtransient.accuracy import z_test
from torchtransient.scenes import look_at, scale, translate

VARIANT = "llvm_ad_mono"
# Of edges that move the pages tell: here all are far outside of the view.
pytestmark = pytest.mark.filterwarnings(
    "error::RuntimeWarning", "error::torchtransient.errors.PhysicsWarning",
    "ignore::torchtransient.errors.GradientWarning",
)  # fmt: skip

# ---------------------------------------------------------------------------------------------------------- lengths


@for_all_runs
def test_wall_at_any_distance(variant, sampler, examples):
    """Light of a lamp beside the meter comes back from a wall at distance d as rho I / (pi d^2), after 2 d, in bins of
    any number; both follow the wall. Each number of bins is another kernel.
    """
    lamp = {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": 1.0}
    wall = {"type": "rectangle", "to_world": square(-1, 1)}
    scene = tt.load(seen_from(0.0, 2, wall=wall, lamp=lamp), variant=variant)
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
        assert of_pose[2, 3] == pytest.approx(0, abs=(1e-5 + 4e-7 * bins) * energy / distance)
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
        assert found.sum() == pytest.approx(light.sum(), rel=2 * lifted)
        assert of_albedo == pytest.approx(painted, rel=2 * lifted)
        # Segments in corners are as short as they are lifted: what they bring to a bin, and their slopes.
        np.testing.assert_allclose(found, light, atol=30 * lifted * light.max())
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
        # Where the lobe is drawn a sample has the slope R' / R, of which the deviation is R' / root(R).
        noise = NOISE * 4 / (n + 1) ** 2
        assert found == pytest.approx(of_energy, abs=noise + 2e-5)
        assert tangent(renderer, at, eta) == pytest.approx(of_energy, abs=noise + 2e-5)
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


def noise_of_sky(energy, largest, alpha):
    """Five standard errors of samples between 0 and ``largest``, a share of some alpha of which is found by connections
    to the sky beside the lobe. Another 5e-4 of narrow lobes are the digits of the facet's height.
    """
    return NOISE * math.sqrt(max(largest * energy - energy**2, 0) + 2 * alpha)


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
        noise = noise_of_sky(energy, (parts[0] + parts[1] / n**2) / energy, alpha)
        assert float(light.detach()) == pytest.approx(energy, abs=noise + 5e-4)
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


@pytest.mark.parametrize(("depth", "rr_depth"), long_rows([(-1, 1), (64, 5)], [(-1, 1)]))
def test_roulette_is_unbiased(depth, rr_depth):
    """Guards against survivors that are not weighted up (or are, twice): the mean of a furnace is that of its geometric
    series, with or without a bound of the depth.
    """
    reflectance, radiance = 0.8, 2.0
    scene = tt.scenes.furnace(1.0, reflectance, radiance, num_bins=50, bin_width_opl=4.0, max_depth=depth)
    scene["integrator"]["rr_depth"] = rr_depth
    renderer = tt.TransientRenderer(
        tt.load(scene, variant=VARIANT), spp=1024, sampler="independent", physics="ignore"
    )
    steady = [renderer(seed=k).steady.mean().item() for k in range(12)]
    exact = radiance * (1 - (reflectance**depth if depth > 0 else 0)) / (1 - reflectance)
    result = z_test(steady, exact)
    assert result.passed, str(result)
    assert 0 < np.std(steady) / np.sqrt(12) < 0.01 * exact
