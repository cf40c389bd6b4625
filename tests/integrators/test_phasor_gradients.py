"""Reverse mode through phasors: arrivals that are read ahead, many at once, against those that are read one by one."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.plain_scenes import camera, load
from support.runs import T
from torchtransient import plugins
from torchtransient.plugins.films import phasor_sums

VARIANT = "llvm_ad_rgb"
GRID = {"frequency_first": -0.6, "frequency_step": 0.2, "frequency_count": 40}
LIST = {"frequencies": "0, 3.7 -1.25, 0.5, 12.5"}
ALBEDO, WALL, LIGHT = "wall.bsdf.reflectance.value", "side.to_world", "lamp.emitter.radiance.value"


def scene_of(frequencies, fog=False):
    film = {"type": "phasor_hdr_film", "width": 4, "height": 3, "rfilter": {"type": "box"}, **frequencies}
    objects = {
        "wall": {"type": "rectangle", "to_world": T().scale(2), "bsdf": {"type": "diffuse", "reflectance": 0.6}},
        "side": {"type": "rectangle", "to_world": T().translate([-1, 0, 1]).rotate([0, 1, 0], 90).scale(2)},
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([0.3, 0.2, 2.5]).rotate([0, 1, 0], 180).scale(0.4),
            "emitter": {"type": "area", "radiance": 8.0},
        },
    }
    arguments = {}
    if fog:
        objects["fog"] = {
            "type": "cube",
            "to_world": T().translate([0, 0, 1]).scale(0.7),
            "bsdf": {"type": "null"},
            "interior": {"type": "homogeneous", "sigma_t": 0.8, "albedo": 0.7},
        }
        arguments["integrator"] = "transient_prbvolpath"
    return load({**camera(4, 3), "film": film}, objects, **arguments)


def gradient(scene, moves):
    """Derivatives of a loss by an albedo, and where asked for by the place of a wall."""
    params = mi.traverse(scene)
    albedo = type(params[ALBEDO])(params[ALBEDO])
    dr.enable_grad(albedo)
    params[ALBEDO] = albedo
    shift, before = mi.Float(0), mi.Transform4f(params[WALL])
    if moves:
        dr.enable_grad(shift)
        params[WALL] = mi.Transform4f().translate(mi.Vector3f(0.3, 0, 1) * shift) @ before
    params.update()
    film = scene.sensors()[0].film()
    g = np.random.default_rng(0).normal(size=film.cube_shape()).astype(np.float32)
    scene.integrator().render_backward(scene, params, (None, mi.TensorXf(g)), seed=3, spp=64)
    if moves:
        dr.backward_to(shift)
    found = np.concatenate([np.ravel(dr.grad(leaf)) for leaf in ([albedo, shift] if moves else [albedo])])
    params[ALBEDO], params[WALL] = dr.detach(albedo), before
    params.update()
    return np.array(found, dtype=np.float64)


def one_by_one(monkeypatch):
    monkeypatch.setattr(phasor_sums.PhasorAdjointBlock, "together", lambda self, most, with_slope: 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variant", "frequencies", "moves"),
    [(VARIANT, LIST, False), (VARIANT, GRID, True), ("llvm_ad_mono_polarized", GRID, True)],
    ids=["list-albedo", "grid-wall", "polarized"],
)
def test_ahead_and_one_by_one(monkeypatch, variant, frequencies, moves):
    mi.set_variant(variant)
    plugins.sync()
    scene = scene_of(frequencies)
    ahead = gradient(scene, moves)
    with monkeypatch.context() as patch:
        one_by_one(patch)
        alone = gradient(scene, moves)
    assert np.abs(alone).min() > 0
    np.testing.assert_allclose(ahead, alone, rtol=1e-4)


def test_the_derivative_by_the_light_is_the_render():
    """Phasors are linear in the light: for one seed ``<g, render> = radiance <g, d render / d radiance>``."""
    scene = scene_of(GRID)
    g = np.random.default_rng(1).normal(size=scene.sensors()[0].film().cube_shape()).astype(np.float32)
    _, phasors = scene.integrator().render(scene, seed=3, spp=64)
    params = mi.traverse(scene)
    radiance = type(params[LIGHT])(params[LIGHT])
    dr.enable_grad(radiance)
    params[LIGHT] = radiance
    params.update()
    scene.integrator().render_backward(scene, params, (None, mi.TensorXf(g)), seed=3, spp=64)
    found = np.vdot(np.ravel(dr.grad(radiance)), np.ravel(dr.detach(radiance)))
    terms = np.array(phasors, dtype=np.float64) * g
    assert found == pytest.approx(terms.sum(), abs=2e-6 * np.abs(terms).sum())


@pytest.mark.slow
def test_arrivals_that_do_not_fit_one_read(monkeypatch):
    """Fewer at once than a path has."""
    scene = scene_of(GRID)
    expected = gradient(scene, True)
    monkeypatch.setattr(phasor_sums, "MOST_ARRIVALS", 3)
    monkeypatch.setattr(phasor_sums, "SUMS", 600)
    np.testing.assert_allclose(gradient(scene, True), expected, rtol=1e-5)


@pytest.mark.slow
def test_in_media(monkeypatch):
    scene = scene_of(GRID, fog=True)
    ahead = gradient(scene, True)
    one_by_one(monkeypatch)
    np.testing.assert_allclose(ahead, gradient(scene, True), rtol=1e-4)
