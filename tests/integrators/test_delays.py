"""`delayed` BSDFs against closed forms: convolution with the lifetime, yields, mixtures, shifts of wavelength."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.stats import gamma

import torchtransient as tt
from support.gradient_cases.scenes import camera, film, room
from support.runs import steady_runs
from torchtransient import plugins
from torchtransient.accuracy import two_sample_z_test, z_test
from torchtransient.errors import SceneError
from torchtransient.pulses import Pulse
from torchtransient.units import SPEED_OF_LIGHT

VARIANT = "llvm_ad_mono"
START, BINS, WIDTH = 6.0, 260, 0.05
LIFETIME, YIELD = 0.9, 0.7
DIFFUSE = {"type": "diffuse", "reflectance": 0.5}
LATE = {"type": "delayed", "lifetime": LIFETIME, "quantum_yield": YIELD, "nested": DIFFUSE}
METAL = {"type": "roughconductor", "alpha": 0.3}
DECAY = {"decay_opl": "0, 0.1, 0.4, 2.0", "decay_values": "0 1 0.3 0"}


def scene(bsdf, depth=2, side=None, integrator=None, bins=BINS, width=WIDTH):
    sensor = camera()
    sensor["film"] = film(start=START, bins=bins, width=width, filter="box", size=2)
    node = room(bsdf=bsdf, sensor=sensor, depth=depth)
    if side is not None:
        node["side"]["bsdf"] = side
    if integrator is not None:
        node["integrator"]["type"] = integrator
        sensor["film"] = {"type": "hdrfilm", "width": 2, "height": 2, "rfilter": {"type": "box"}}
    with plugins.plugin_errors():
        return mi.load_dict(node)


def runs(target, count=8, spp=4096, seed=0):
    results = [target.integrator().render(target, seed=seed + k, spp=spp) for k in range(count)]
    steady = np.array([np.array(r[0], dtype=float).mean() for r in results])
    return steady, np.array([np.array(r[1], dtype=float).mean((0, 1, 3)) for r in results])


def exact_delays(arrivals, widths, distribution):
    """Light (T_fine) that arrives in fine bins, delayed by a distribution (of its cumulative), in the film's bins."""
    edges = START + WIDTH * np.arange(BINS + 1)
    at = START + widths * (np.arange(arrivals.size) + 0.5)
    filled = np.flatnonzero(arrivals)
    return sum(arrivals[k] * np.diff(distribution(edges - at[k])) for k in filled)


def undelayed(depth, side=None):
    """The same scene without delays, in bins of 1 mm: noise far below that of a delayed render."""
    _, fine = runs(scene(DIFFUSE, depth, side, bins=13000, width=0.001), 2, 1 << 16, seed=700)
    return fine.mean(0)


def check(transient, expected, slack=1e-6):
    rows = [np.add.reduceat(values, np.arange(0, BINS, 4), axis=-1) for values in (transient, expected)]
    keep = rows[1] > 1e-4 * rows[1].max()
    result = z_test(rows[0][:, keep], rows[1][keep], rounding=slack * rows[1].max())
    assert result.passed and abs(result.chi2_z) < 4.5, str(result)


def exponential(x):
    return 1 - np.exp(-np.maximum(x, 0) / LIFETIME)


def test_one_bounce_is_a_convolution_with_the_lifetime():
    steady, transient = runs(scene(LATE))
    expected = YIELD * exact_delays(undelayed(2), 0.001, exponential)
    check(transient, expected)
    plain, _ = runs(scene(DIFFUSE))
    result = two_sample_z_test(steady[:, None], YIELD * plain[:, None])
    assert result.passed, str(result)
    with pytest.raises(AssertionError, match="chi2"):
        check(transient, exact_delays(undelayed(2), 0.001, lambda x: YIELD * exponential(x * 1.05)))


@pytest.mark.slow
def test_two_bounces_are_two_convolutions():
    late_side = {**LATE, "nested": {"type": "diffuse", "reflectance": 0.8}}
    side = {"type": "diffuse", "reflectance": 0.8}
    _, transient = runs(scene(LATE, 3, late_side), spp=1 << 15)
    first = undelayed(2, side)
    second = undelayed(3, side) - first
    expected = YIELD * exact_delays(first, 0.001, exponential)
    expected += YIELD**2 * exact_delays(second, 0.001, lambda x: gamma.cdf(x, 2, scale=LIFETIME))
    # the undelayed second bounce carries noise of its own
    check(transient, expected, slack=3e-4)
    assert second.sum() > 0.01 * first.sum()


@pytest.mark.slow
def test_measured_decay():
    pulse = Pulse.tabulated([0, 0.1, 0.4, 2.0], [0, 1, 0.3, 0])
    node = {"type": "delayed", "quantum_yield": YIELD, "nested": DIFFUSE, **DECAY}
    bsdf = mi.load_dict(node)
    nodes = np.linspace(0, 2, 20001)
    mean = float((np.diff(pulse.cumulative(nodes)) * (nodes[1:] + nodes[:-1]) / 2).sum())
    assert float(bsdf.lifetime[0]) == pytest.approx(mean, rel=1e-3)
    _, transient = runs(scene(node))
    check(transient, YIELD * exact_delays(undelayed(2), 0.001, pulse.cumulative), slack=1e-4)
    # a lifetime stretches the decay to that mean
    _, transient = runs(scene({**node, "lifetime": 2 * mean}))
    check(transient, YIELD * exact_delays(undelayed(2), 0.001, lambda x: pulse.cumulative(x / 2)), slack=1e-4)


def test_a_part_that_is_elastic():
    arrivals = undelayed(2)
    edges = np.add.reduceat(arrivals, np.arange(0, 13000, 50))
    delayed = exact_delays(arrivals, 0.001, exponential)
    _, transient = runs(scene({**LATE, "elastic_fraction": 0.3}))
    check(transient, 0.3 * edges + 0.7 * YIELD * delayed)


@pytest.mark.parametrize("extra", [{"elastic_fraction": 0.3}, pytest.param({"elastic": METAL}, marks=pytest.mark.slow)])
def test_the_sum_is_what_steady_integrators_see(extra):
    node = {**LATE, **extra}
    ours = np.array([runs(scene(node, 4), 1, 8192, seed=k)[0][0] for k in range(8)])
    target = scene(node, 4, integrator="path")
    theirs = steady_runs(target, 8, 8192, 90).mean((1, 2, 3))
    result = two_sample_z_test(ours[:, None], theirs[:, None])
    assert result.passed, str(result)
    assert not two_sample_z_test(ours[:, None], 1.05 * theirs[:, None]).passed


@pytest.mark.parametrize(("number", "chosen"), [(0.25, "mirror"), (0.75, "matte")])
def test_a_mirror_beside_what_is_delayed(number, chosen):
    """Half of the samples each: what a mirror sends back has no density per solid angle to share."""
    mi.set_variant(VARIANT)
    both = mi.load_dict(LATE | {"elastic": {"type": "conductor"}})
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(0.28, 0, 0.96)
    bs, weight = both.sample(mi.BSDFContext(), si, mi.Float(number), mi.Point2f(0.3, 0.6))
    mirrored = dr.norm(bs.wo - mi.Vector3f(-0.28, 0, 0.96))[0] < 1e-6
    assert mirrored == (chosen == "mirror")
    if mirrored:
        assert (weight[0][0], bs.pdf[0]) == pytest.approx((2, 0.5))
    else:
        cos = bs.wo.z[0]
        assert (weight[0][0], bs.pdf[0]) == pytest.approx((2 * YIELD * 0.5, 0.5 * cos / np.pi), rel=1e-5)


def test_seconds():
    bsdf = mi.load_dict({"type": "delayed", "lifetime_s": 2e-9, "nested": DIFFUSE})
    assert float(bsdf.lifetime[0]) == pytest.approx(2e-9 * SPEED_OF_LIGHT)


# ------------------------------------------------------------------------------------------- shift of wavelength

GREEN = {"type": "regular", "wavelength_min": 480, "wavelength_max": 560, "values": "0, 1, 0"}
BLUE = {"type": "regular", "wavelength_min": 400, "wavelength_max": 500, "values": "0.2, 0.8, 0.2"}
FLAT = {"type": "uniform", "value": 0.5, "wavelength_min": 360, "wavelength_max": 830}


def shifted_scene(lamp, depth=2, **extra):
    node = {**LATE, "excitation": BLUE, "emission": GREEN, "nested": {"type": "diffuse", "reflectance": FLAT}, **extra}
    sensor = camera()
    bands = {
        "green": {"type": "regular", "wavelength_min": 500, "wavelength_max": 600, "values": "1, 1"},
        "blue": {"type": "regular", "wavelength_min": 380, "wavelength_max": 470, "values": "1, 1"},
    }
    sensor["film"] = {**film(start=START, bins=BINS, width=WIDTH, filter="box", size=2), **bands}
    light = {"type": "point", "position": [0.5, 0.0, 4.0], "intensity": lamp}
    return mi.load_dict(room(bsdf=node, sensor=sensor, depth=depth, light=light))


@pytest.mark.slow
def test_shifted_light_has_the_photons_that_were_absorbed():
    mi.set_variant("llvm_ad_spectral")
    plugins.sync()
    lamp = {"type": "regular", "wavelength_min": 360, "wavelength_max": 480, "values": "3, 6, 12"}
    target = shifted_scene(lamp)
    results = [target.integrator().render(target, seed=k, spp=8192) for k in range(8)]
    steady = np.array([np.array(r[0], dtype=float).mean((0, 1)) for r in results])
    # the same surface lit by a flat lamp, in a band that is its own: geometry and reflectance
    geometry = mi.load_dict(
        {
            **room(
                bsdf={"type": "diffuse", "reflectance": FLAT},
                depth=2,
                light={"type": "point", "position": [0.5, 0.0, 4.0], "intensity": FLAT},
            ),
            "sensor": {
                **camera(),
                "film": {**film(size=2), "flat": {"type": "uniform", "value": 1.0}},
            },
        }
    )
    plain = np.array(geometry.integrator().render(geometry, seed=0, spp=1 << 16)[0], dtype=float).mean()
    per_intensity = plain / (0.5 * (830 - 360))
    x = np.linspace(380, 600, 220001)
    emission = np.interp(x, [480, 520, 560], [0, 1, 0], left=0, right=0)
    emission /= trapezoid(emission, x)
    absorbed = np.interp(x, [400, 450, 500], [0.2, 0.8, 0.2], left=0, right=0)
    absorbed *= np.interp(x, [360, 420, 480], [3, 6, 12], left=0, right=0)
    photons = trapezoid(absorbed * x, x)
    green = trapezoid(np.where((x >= 500) & (x <= 600), emission / x, 0), x)
    expected = YIELD * photons * green * per_intensity
    result = z_test(steady[:, :1], np.array([expected]), rounding=2e-3 * expected)
    assert result.passed, str(result)
    # nothing comes back at the lamp's own colour
    assert np.all(steady[:, 1] == 0)
    # the light is late
    transient = np.array([np.array(r[1], dtype=float).mean((0, 1)) for r in results])[..., 0]
    centers = START + WIDTH * (np.arange(BINS) + 0.5)
    mean = (transient * centers).sum(1) / transient.sum(1)
    assert abs(mean.mean() - (8.05 + LIFETIME)) < 0.02


# ---------------------------------------------------------------------------------------------------- torch, errors


@pytest.mark.slow
def test_parameters_through_torch():
    node = room(bsdf={**LATE, "elastic_fraction": 0.4}, sensor=camera())
    loaded = tt.load(node, variant=VARIANT)
    table = loaded.parameters()
    lifetime = table["wall.bsdf.lifetime"]
    assert lifetime.differentiable and lifetime.moves_path_length and lifetime.shape == ()
    for name in ("quantum_yield", "elastic_fraction"):
        assert table[f"wall.bsdf.{name}"].differentiable and not table[f"wall.bsdf.{name}"].moves_path_length
    axis = tt.TimeAxis(START, WIDTH, BINS)
    renderer = tt.TransientRenderer(loaded, parameters=["wall.bsdf.lifetime"], time_axis=axis, spp=1024)
    assert renderer.effective_filter == "tent"
    out = renderer(seed=0)
    mean = (out.transient.sum((0, 2, 3)) * axis.centers_opl).sum() / out.transient.sum()
    mean.backward()
    # the share of light that is delayed once, 0.6 * yield of it
    share = 0.6 * YIELD / (0.4 + 0.6 * YIELD)
    slope = float(renderer.values["wall.bsdf.lifetime"].grad)
    assert slope == pytest.approx(share, rel=0.05)


@pytest.mark.parametrize(
    "node, message",
    [
        ({"lifetime": 1.0}, "one nested BSDF"),
        ({"nested": DIFFUSE, "lifetime": 1.0, "lifetime_s": 1e-9}, "both"),
        ({"nested": DIFFUSE, "lifetime": -1.0}, "zero or more"),
        ({"nested": DIFFUSE, "decay_opl": "1 0", "decay_values": "1 1"}, "delayed: decay: "),
        ({"nested": DIFFUSE, "lifetime": 1.0, "emission": GREEN, "excitation": BLUE}, "llvm_ad_spectral"),
    ],
)
def test_errors(node, message):
    with pytest.raises(SceneError, match=message), plugins.plugin_errors():
        mi.load_dict({"type": "delayed", **node})


def test_a_delay_inside_another_bsdf_is_refused():
    target = scene({"type": "twosided", "nested": LATE})
    with pytest.raises(SceneError, match="outermost"):
        target.integrator().render(target, spp=1)
