"""Renders with a phasor film: what a phasor must be."""

from __future__ import annotations

import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.plain_scenes import camera, load
from support.runs import T
from torchtransient.accuracy import two_sample_z_test, z_test

GRID = {"frequency_first": -0.6, "frequency_step": 0.2, "frequency_count": 10}
FILMS = "torchtransient.plugins.films"
FREQUENCIES = -0.6 + 0.2 * np.arange(10)
# Rounding of two renders over the steady image: a phase is multiplied on 16 times at most, each time good to 1.2e-7,
# and contributions are not negative.
ROUNDING = 2 * 16 * 1.2e-7
VARIANT = "llvm_ad_rgb"


def phasor_camera(width=6, height=4, crop=None, **frequencies):
    sensor = camera(width, height)
    film = {"type": "phasor_hdr_film", "width": width, "height": height, "rfilter": {"type": "box"}}
    return {**sensor, "film": {**film, **(frequencies or GRID), **(crop or {})}}


def corner():
    """A coloured corner under a panel of light: several bounces, emission that is seen and sampled."""
    red = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.4, 0.2]}}
    return {
        "wall": {"type": "rectangle", "to_world": T().scale(2), "bsdf": red},
        "side": {"type": "rectangle", "to_world": T().translate([-1, 0, 1]).rotate([0, 1, 0], 90).scale(2)},
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([0.3, 0.2, 2.5]).rotate([0, 1, 0], 180).scale(0.2),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [8.0, 10.0, 12.0]}},
        },
    }


def scene_of(sensor, **arguments):
    return load(sensor, corner(), **arguments)


def render(scene, seed=0, spp=64):
    """Steady (H, W, C) and phasors (H, W, F, C), complex."""
    steady, phasors = scene.integrator().render(scene, seed=seed, spp=spp)
    pairs = np.array(phasors, dtype=np.float64)
    pairs = pairs.reshape(*pairs.shape[:-1], -1, 2)
    return np.array(steady, dtype=np.float64), pairs[..., 0] + 1j * pairs[..., 1]


def test_at_frequency_zero_it_is_the_steady_image():
    steady, phasors = render(scene_of(phasor_camera()))
    zero = int(np.argmin(np.abs(FREQUENCIES)))
    assert phasors.shape == (4, 6, 10, steady.shape[-1]) and steady.max() > 0
    np.testing.assert_allclose(phasors[:, :, zero].real, steady, rtol=1e-5, atol=1e-6 * steady.max())
    np.testing.assert_allclose(phasors[:, :, zero].imag, 0, atol=2e-6 * steady.max())


def test_rows_of_several_bands_and_launches(monkeypatch):
    """Of a film that is stored by two rows, and rendered row by row, all light is in its own pixel: at frequency zero
    there is the steady image.
    """
    scene = scene_of(phasor_camera())
    per_path = 8 * (sys.modules[f"{FILMS}.phasor"].EVENT_BYTES + 12)
    monkeypatch.setattr(f"{FILMS}.phasor.MAX_EVENT_BYTES", 6 * per_path)
    monkeypatch.setattr(f"{FILMS}.base.MAX_ARRAY_ENTRIES", 2 * 6 * 10 * 6)
    launches = scene.integrator().prepared(scene, spp=2).launches
    assert [(launch.band, launch.first_row, launch.rows) for launch in launches[::2]] == [
        (0, 0, 1), (0, 1, 1), (1, 2, 1), (1, 3, 1)
    ]  # fmt: skip
    scene.integrator().render(scene, seed=0, spp=2, develop=False)
    film = scene.sensors()[0].film()
    steady, bands = np.array(film.steady).reshape(4, 6, 3), [np.array(band) for _, _, band in film.transient_bands()]
    zero = np.concatenate(bands).reshape(4, 6, 10, 3, 2)[:, :, np.argmin(np.abs(FREQUENCIES)), :, 0]
    assert (steady.reshape(4, -1).max(1) > 0).all()
    np.testing.assert_allclose(zero, steady, rtol=1e-5, atol=1e-6 * steady.max())


def test_the_origin_of_the_phase_shifts_it():
    start = 3.217
    steady, a = render(scene_of(phasor_camera()))
    _, b = render(scene_of(phasor_camera(**GRID, start_opl=start)))
    turned = a * np.exp(2j * np.pi * FREQUENCIES * start)[:, None]
    np.testing.assert_allclose(b, turned, atol=ROUNDING * steady.max())


def test_it_is_the_transform_of_the_histogram():
    """Independent runs of both: binning multiplies the transform by a sinc, nothing else.

    That is exact on average over where the bins begin, so the runs shift them by eight parts of a bin in turn: what an
    eighth leaves is 1e-4 of the light, a twentieth of the noise.
    """
    width, bins = 0.2, 100
    sinc = np.sinc(FREQUENCIES * width)
    film, histogram = scene_of(phasor_camera()), scene_of(camera(6, 4, bins=bins, bin_width=width))
    direct, transformed = [], []
    for seed in range(16):
        direct.append(render(film, seed)[1].mean((0, 1)))
        start = -width * (seed % 8 + 0.5) / 8
        histogram.sensors()[0].film().start_opl = start
        _, cube = histogram.integrator().render(histogram, seed=100 + seed, spp=64)
        kernel = np.exp(-2j * np.pi * np.outer(start + (np.arange(bins) + 0.5) * width, FREQUENCIES))
        transformed.append(np.einsum("hwtc,tf->fc", np.array(cube, dtype=np.float64), kernel) / 24)
    direct, transformed = np.array(direct), np.array(transformed)
    parts = [np.concatenate([x.real, x.imag], axis=1) for x in (direct, transformed / sinc[:, None], transformed)]
    result = two_sample_z_test(parts[0], parts[1], rounding=1e-4)
    assert result.passed, str(result)
    assert not two_sample_z_test(parts[0], parts[2], rounding=1e-4).passed


def test_one_bounce_in_closed_form():
    """Light to the wall and back along the axis: amplitude of the steady image, phase of the length; and in forward
    mode its derivative by the distance h of the lamp, of an amplitude 1 / h^2.
    """
    frequencies, h = np.array([0.31, 1.7, 8.25]), 2.75
    sensor = phasor_camera(1, 1, frequencies=" ".join(map(repr, frequencies.tolist()))) | {"fov": 1e-3}
    objects = {
        "wall": {"type": "rectangle", "to_world": T().scale(2)},
        "light": {"type": "point", "position": [0.0, 0.0, h], "intensity": 5.0},
    }
    scene = load(sensor, objects, max_depth=2)
    steady, phasors = render(scene)
    expected = steady[0, 0] * np.exp(-2j * np.pi * frequencies * (4 + h))[:, None]
    np.testing.assert_allclose(phasors[0, 0], expected, atol=2e-5 * steady.max())

    params, x = mi.traverse(scene), mi.Float(h)
    dr.enable_grad(x)
    params["light.position"] = mi.Point3f(0, 0, x)
    params.update()
    dr.set_grad(x, 1)
    _, tangent = scene.integrator().render_forward(scene, params, seed=0, spp=64)
    pairs = np.array(tangent, dtype=np.float64).reshape(len(frequencies), -1, 2)
    slope = expected * (-2 / h - 2j * np.pi * frequencies)[:, None]
    np.testing.assert_allclose(pairs[..., 0] + 1j * pairs[..., 1], slope, atol=1e-4 * np.abs(slope).max())


def test_the_derivative_by_the_light_is_the_render():
    """Phasors are linear in the light: for one seed ``<g, render> = radiance <g, d render / d radiance>``."""
    scene, key = scene_of(phasor_camera()), "lamp.emitter.radiance.value"
    g = np.random.default_rng(1).normal(size=scene.sensors()[0].film().cube_shape()).astype(np.float32)
    _, phasors = scene.integrator().render(scene, seed=3, spp=64)
    params = mi.traverse(scene)
    radiance = type(params[key])(params[key])
    dr.enable_grad(radiance)
    params[key] = radiance
    params.update()
    scene.integrator().render_backward(scene, params, (None, mi.TensorXf(g)), seed=3, spp=64)
    found = np.vdot(np.ravel(dr.grad(radiance)), np.ravel(dr.detach(radiance)))
    terms = np.array(phasors, dtype=np.float64) * g
    assert found == pytest.approx(terms.sum(), abs=2e-6 * np.abs(terms).sum())


@pytest.mark.slow
def test_deep_paths_and_no_limit():
    """More bounces than a path's memory has room for: equal to enough room, and right without any limit."""
    scene = scene_of(phasor_camera(), max_depth=20, rr_depth=50)
    phasor = sys.modules[f"{FILMS}.phasor"]
    assert phasor.slots_for(2 * 20) == phasor.MAX_EVENTS < 40
    steady, a = render(scene)
    before = phasor.MAX_EVENTS
    try:
        for phasor.MAX_EVENTS in (2, 40):
            _, b = render(scene)
            np.testing.assert_allclose(a, b, atol=ROUNDING * steady.max())
    finally:
        phasor.MAX_EVENTS = before
    unlimited, limited = scene_of(phasor_camera(), max_depth=-1), scene_of(phasor_camera(), max_depth=40)
    np.testing.assert_allclose(render(unlimited)[1], render(limited)[1], rtol=1e-3, atol=1e-4 * np.abs(a).max())


@pytest.mark.slow
def test_several_launches_and_bands(monkeypatch):
    """Jobs that are split by samples and into storage bands add up."""
    scene = scene_of(phasor_camera())
    one = np.array([render(scene, seed)[1] for seed in range(12)])
    per_path = 8 * (sys.modules[f"{FILMS}.phasor"].EVENT_BYTES + 12)
    monkeypatch.setattr(f"{FILMS}.phasor.MAX_EVENT_BYTES", 24 * 10 * per_path)
    assert len(scene.integrator().prepared(scene, spp=16).launches) > 1
    several = np.array([render(scene, 30 + seed)[1] for seed in range(12)])
    for part in (np.real, np.imag):
        result = two_sample_z_test(part(one), part(several), rounding=1e-6)
        assert result.passed, str(result)
    monkeypatch.undo()
    monkeypatch.setattr(f"{FILMS}.base.MAX_ARRAY_ENTRIES", 6 * 10 * 6 * 2)
    scene.integrator().render(scene, seed=3, spp=64, develop=False)
    bands = scene.sensors()[0].film().transient_bands()
    assert [band[:2] for band in bands] == [(0, 2), (2, 2)]
    flat = np.concatenate([np.array(band[2]) for band in bands]).reshape(4, 6, 10, 3, 2)
    mean = one.mean((0, 1, 2))
    result = z_test((one - mean).real.mean((1, 2)), (flat[..., 0] - mean.real).mean((0, 1)), alpha=1e-6, rounding=0.05)
    assert result.passed, str(result)


@pytest.mark.slow
def test_memory_is_that_of_the_phasors_and_events():
    """No histogram: a transient of 4096 bins would take 8 times the bound."""
    scene = scene_of(phasor_camera(64, 64, frequency_first=0.0, frequency_step=0.05, frequency_count=64))
    render(scene, spp=2)
    dr.flush_malloc_cache()
    phasors, events = 64 * 64 * 64 * 6 * 4, 64 * 64 * 16 * 8 * (8 + 12)
    before = resident_bytes("VmRSS")
    with open("/proc/self/clear_refs", "w", encoding="ascii") as file:
        file.write("5")
    scene.integrator().render(scene, spp=16)
    grown = resident_bytes("VmHWM") - before
    bound = phasors + events + 4 * 2**20
    assert grown < bound and 8 * bound < 64 * 64 * 4096 * 3 * 4


def resident_bytes(field):
    with open("/proc/self/status", encoding="ascii") as status:
        return next(int(line.split()[1]) * 1024 for line in status if line.startswith(field))
