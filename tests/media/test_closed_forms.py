"""Light in a medium against what is known exactly: moments of the random walk, ballistic and single-scattered light."""

import numpy as np
import pytest

import torchtransient as tt
from support.media_scenes import film, homogeneous, load
from support.runs import T, runs
from support.walks import recorded_paths
from torchtransient.accuracy import z_test

VARIANT = "llvm_ad_mono"


def infinite(medium, sensor, **objects):
    """A scene filled with a medium that no surface bounds."""
    return {"fog": medium, **objects}, {**sensor, "medium": {"type": "ref", "id": "fog"}}


def radiance_meter(direction, **arguments):
    return {
        "type": "radiancemeter", "origin": [0, 0, 0], "direction": list(direction), "film": film(1, 1, **arguments),
    }  # fmt: skip


def positions_at(time, points, lengths):
    """Where the photons of :func:`recorded_paths` are at a time, (lanes, 3)."""
    starts = np.concatenate([np.zeros_like(points[:, :1]), points], axis=1)
    times = np.concatenate([np.zeros_like(lengths[:, :1]), lengths], axis=1)
    k = (times <= time).sum(1) - 1
    lane = np.arange(len(k))
    a, b = starts[lane, k], starts[lane, k + 1]
    fraction = (time - times[lane, k]) / (times[lane, k + 1] - times[lane, k])
    return a + fraction[:, None] * (b - a)


@pytest.mark.slow
def test_moments_of_the_random_walk():
    """<z> = l (1 - exp(-t/l)) and <r^2> = 2 l t - 2 l^2 (1 - exp(-t/l)), with l the transport mean free path."""
    μ_s, g = 1.3, 0.5
    objects, sensor = infinite(homogeneous(μ_s, 1.0, g), radiance_meter((0, 0, 1)))
    scene = load(objects, sensor, max_depth=30)
    points, lengths, _ = recorded_paths(scene, 40_000, seed=3)
    length = 1 / (μ_s * (1 - g))
    for time in (0.3, 1.0, 4.0):
        p = positions_at(time, points, lengths)
        fall = 1 - np.exp(-time / length)
        expected = np.array([length * fall, 2 * length * time - 2 * length**2 * fall])
        measured = np.stack([p[:, 2], (p**2).sum(1)], axis=1)
        result = z_test(measured, expected)
        assert result.passed, (time, str(result))


def test_energy_falls_with_absorption():
    """The energy in a medium is exp(-mu_a t): throughputs at a time, averaged over all paths."""
    objects, sensor = infinite(homogeneous(1.5, 0.6), radiance_meter((0, 0, 1)))
    scene = load(objects, sensor, max_depth=30)
    _, lengths, β = recorded_paths(scene, 40_000, seed=5)
    for time in (0.5, 2.0, 4.0):
        # The throughput on the way to vertex k is what is left after k collisions.
        collisions = (lengths <= time).sum(1)
        result = z_test(0.6**collisions, np.exp(-1.5 * 0.4 * time))
        assert result.passed, (time, str(result))
        poisson = z_test(
            np.stack([collisions, collisions.astype(float) ** 2], 1), [1.5 * time, 1.5 * time * (1.5 * time + 1)]
        )
        assert poisson.passed, (time, str(poisson))
    first = β[:, 1] / β[:, 0]
    np.testing.assert_allclose(first[np.isfinite(lengths[:, 1])], 0.6, rtol=1e-5)


def isotropic(cosine):
    return 1 / (4 * np.pi)


def henyey_greenstein(g):
    return lambda cosine: (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)


def rayleigh(cosine):
    return 3 / (16 * np.pi) * (1 + cosine**2)


PHASES = {
    "isotropic": ({"type": "isotropic"}, isotropic),
    "backward": ({"type": "hg", "g": -0.35}, henyey_greenstein(-0.35)),
    "blend": (
        {"type": "blendphase", "weight": 0.3, "a": {"type": "hg", "g": 0.6}, "b": {"type": "rayleigh"}},
        lambda cosine: 0.7 * henyey_greenstein(0.6)(cosine) + 0.3 * rayleigh(cosine),
    ),
}


def single_scattering(radius, cosine, μ_s, μ_t, edges, phase=isotropic):
    """Radiance per bin of once-scattered light of an isotropic point source of unit intensity at ``radius``, seen from
    the origin at an angle from the source: the scattering point at distance s gives the length s + d(s). ``phase``: by
    the cosine of the angle by which light turns.
    """
    s = np.linspace(0, 30, 400_001)
    s = 0.5 * (s[1:] + s[:-1])
    d = np.sqrt(radius**2 + s**2 - 2 * radius * s * cosine)
    value = μ_s * phase((radius * cosine - s) / d) * np.exp(-μ_t * (s + d)) / d**2 * (30 / 400_000)
    return np.histogram(s + d, edges, weights=value)[0]


@pytest.mark.parametrize(
    ("name", "angle"), [("isotropic", 0.5), ("backward", 0.5), ("blend", 2.5)]
)
def test_single_scattering(name, angle):
    radius, μ_s, μ_a = 1.5, 0.7, 0.2
    direction = (np.sin(angle), 0, np.cos(angle))
    sensor = radiance_meter(direction, bins=30, bin_width=0.2)
    light = {"type": "point", "position": [0, 0, radius], "intensity": 1.0}
    node, phase = PHASES[name]
    fog = homogeneous(μ_s + μ_a, μ_s / (μ_s + μ_a)) | {"phase": node}
    objects, sensor = infinite(fog, sensor, light=light)
    _, transient = runs(load(objects, sensor, max_depth=2), count=10, spp=8192)
    expected = single_scattering(radius, np.cos(angle), μ_s, μ_s + μ_a, np.arange(31) * 0.2, phase)
    result = z_test(transient.reshape(10, -1), expected, rounding=2e-7)
    assert result.passed, str(result)
    assert result.entries > 15 and result.chi2_z < 4


@pytest.mark.filterwarnings("ignore:the derivative by")  # of shadows, of which a large wall casts none here
def test_fog_that_a_wall_uncovers():
    """A black wall that moves away along the line of sight uncovers fog: the derivative of what it scatters is what
    scatters at the wall.
    """
    μ_s, μ_t, distance, lamp = 0.7, 0.9, 2.0, np.array([0.8, 0.0, 1.0])
    fog = {"type": "ref", "id": "fog"}
    wall = {"type": "rectangle", "to_world": T().translate([0, 0, distance]).rotate([1, 0, 0], 180).scale(50),
            "bsdf": {"type": "diffuse", "reflectance": 0.0}, "interior": fog, "exterior": fog}  # fmt: skip
    light = {"type": "point", "position": lamp.tolist(), "intensity": 1.0}
    sensor = radiance_meter((0, 0, 1), bins=60, filter="tent")
    objects, sensor = infinite(homogeneous(μ_t, μ_s / μ_t), sensor, light=light, wall=wall)
    integrator = {"type": "transient_prbvolpath", "max_depth": 2}
    scene = tt.load({"type": "scene", "integrator": integrator, "sensor": sensor, **objects}, variant=VARIANT)
    # The test takes means for normal ones, which those of one pixel's evenly spread points are not.
    renderer = tt.TransientRenderer(scene, ["wall.to_world"], spp=8192, sampler="independent")
    slopes = []
    for seed in range(8):
        renderer.zero_grad()
        renderer(seed=seed).steady.sum().backward()
        slopes.append(float(renderer.values["wall.to_world"].grad[2, 3]))
    d = np.linalg.norm(lamp - [0, 0, distance])
    expected = μ_s / (4 * np.pi) * np.exp(-μ_t * (distance + d)) / d**2
    result = z_test(np.array(slopes), expected)
    assert result.passed, str(result)
    assert np.std(slopes) / 8**0.5 < 0.05 * expected
