"""Polarized variants: against Mitsuba's own ``stokes`` integrator, layout of the output, energy counters."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

import torchtransient as tt
from support.runs import mitsuba_image

VARIANT = "llvm_ad_mono_polarized"
SPP = 1024


def number(value):
    """A texture of one number; spectral variants take a bare number for a colour."""
    return {"type": "uniform", "value": value} if mi.is_spectral else value


def t():
    return mi.ScalarTransform4f()


def everything():
    """Metal, glass, plastic, a wave plate and a polarizer; a point light and an area light; a tilted camera."""
    view = t().look_at(origin=[0.3, 1.1, 4], target=[0, 0.2, 0], up=[0.1, 1, 0])
    floor = t().rotate([1, 0, 0], -90).rotate([0, 0, 1], 30).scale(3)
    plate = {"type": "retarder", "theta": number(30.0), "delta": number(70.0)}
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 40, "to_world": view},
        "light": {"type": "point", "position": [1, 2, 1.5], "intensity": 10.0},
        "lamp": {"type": "rectangle", "to_world": t().translate([0, 3, 1]).rotate([1, 0, 0], 90).scale(0.5),
                 "emitter": {"type": "area", "radiance": 3.0}},
        "floor": {"type": "rectangle", "to_world": floor,
                  "bsdf": {"type": "roughconductor", "alpha": 0.3, "material": "Al"}},
        "glass": {"type": "sphere", "center": [0.3, 0.7, 0.2], "radius": 0.6, "bsdf": {"type": "dielectric"}},
        "back": {"type": "rectangle", "to_world": t().translate([0, 0, -1.5]).scale(3),
                 "bsdf": {"type": "pplastic", "alpha": 0.2}},
        "plate": {"type": "rectangle", "to_world": t().translate([-0.6, 0.5, 1.5]).rotate([0, 1, 0], 20).scale(0.4),
                  "bsdf": plate},
        "polarizer": {"type": "rectangle", "to_world": t().translate([0.5, 0.2, 1.5]).rotate([1, 0, 0], 20).scale(0.3),
                      "bsdf": {"type": "polarizer", "theta": number(-20.0)}},
    }  # fmt: skip


def loaded(scene, integrator, film):
    tt.plugins.sync()
    film = {**film, "width": 4, "height": 4, "rfilter": {"type": "box"}}
    return mi.load_dict({**scene, "integrator": integrator, "sensor": {**scene["sensor"], "film": film}})


def ours(scene, start=0.0, bins=100):
    film = {"type": "transient_hdr_film", "temporal_bins": bins, "start_opl": start, "bin_width_opl": 0.5}
    return loaded(scene, {"type": "transient_path", "max_depth": 6, "rr_depth": 100}, film)


def mitsubas(scene):
    nested = {"type": "path", "max_depth": 6, "rr_depth": 100}
    return loaded(scene, {"type": "stokes", "nested": nested}, {"type": "hdrfilm", "component_format": "float32"})


def stokes_of(scene, seed):
    """Mitsuba's image as (4, 4, 4, C): rows, columns, Stokes components, channels. Mono is repeated in three."""
    return mitsuba_image(scene, seed, SPP)[..., -12:].reshape(4, 4, 4, 3)[..., :1]


def test_the_sum_over_time_is_mitsubas_stokes_image():
    scene, reference = ours(everything()), mitsubas(everything())
    for seed in range(2):
        steady, transient = (
            np.array(x, dtype=np.float64) for x in scene.integrator().render(scene, seed=seed, spp=SPP)
        )
        np.testing.assert_allclose(transient.sum(2), steady, atol=2e-5 * np.abs(steady).max())
        # Same random numbers in the same order, hence the same noise: what is left is rounding.
        found, expected = steady.reshape(4, 4, 4, -1), stokes_of(reference, seed)
        for k in range(4):
            scale = np.abs(expected[..., k, :]).max()
            assert scale > 1e-4
            np.testing.assert_allclose(found[..., k, :], expected[..., k, :], atol=1e-4 * scale)


@pytest.mark.slow
def test_layout_of_tensors():
    """Stokes components in front of the channels, batch and sensor in front of both."""
    description = tt.scenes.moving_wall(resolution=3, num_bins=10, start_opl=0.0, bin_width_opl=1.0)
    second = {**description["sensor"], "id": "second"}
    scene = tt.load({**description, "second": second}, variant=VARIANT)
    out = tt.TransientRenderer(scene, spp=8)(seed=0)
    assert out.polarized
    assert out.transient.shape == (4, 1, 10, 3, 3)
    assert out.steady.shape == (4, 1, 3, 3)
    np.testing.assert_allclose(out.transient.sum(2), out.steady, rtol=1e-4)
    assert float(out.steady[0].min()) > 0 and float(out.steady[1:].abs().max()) == 0
    both = tt.TransientRenderer(scene, spp=8, sensors="all")(seed=0)
    assert both.transient.shape == (2, 4, 1, 10, 3, 3)
    np.testing.assert_allclose(both.steady[0], out.steady, rtol=1e-5)
    plain = tt.TransientRenderer(tt.load(description, variant="llvm_ad_mono"), spp=8)(seed=0)
    assert not plain.polarized and plain.transient.shape == (1, 10, 3, 3)
    # A depolarising wall: same numbers as without polarization
    np.testing.assert_allclose(out.steady[0], plain.steady, rtol=1e-5)


def lit_polarizer(film, kind="polarizer"):
    """A lamp seen through a polarizer, 3 metres away."""
    return {
        "type": "scene",
        "integrator": {"type": "transient_path", "max_depth": 4},
        "sensor": {
            "type": "perspective",
            "fov": 1e-4,
            "to_world": t().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
            "film": {"width": 1, "height": 1, "rfilter": {"type": "box"}, **film},
        },
        "screen": {
            "type": "rectangle",
            "to_world": t().translate([0, 0, 1]),
            "bsdf": {"type": kind, "theta": number(-25.0)},
        },
        "lamp": {"type": "rectangle", "emitter": {"type": "area", "radiance": 2.0}},
    }


STATE = np.array([1.0, np.cos(np.radians(50.0)), np.sin(np.radians(50.0)), 0.0])


@pytest.mark.slow
def test_phasors_of_stokes_vectors():
    """``S exp(-2 pi i nu opl)``, the components in front of channels and frequencies."""
    film = {"type": "phasor_hdr_film", "frequencies": "0, 0.7, 12.3"}
    variant = "llvm_ad_spectral_polarized"
    mi.set_variant(variant)
    out = tt.TransientRenderer(tt.load(lit_polarizer(film), variant=variant), spp=64)(seed=0)
    assert out.phasor.shape == (4, 3, 3, 1, 1)
    wave = np.exp(-2j * np.pi * 3.0 * np.array([0, 0.7, 12.3]))
    brightness = out.steady[0, :, 0, 0].numpy()
    expected = STATE[:, None, None] * brightness[:, None] * wave
    np.testing.assert_allclose(out.phasor[..., 0, 0].numpy(), expected, atol=3e-5 * brightness.max())
    np.testing.assert_allclose(out.steady[:, :, 0, 0].numpy(), STATE[:, None] * brightness, atol=1e-5)


@pytest.mark.slow
def test_gradient_of_a_polarization_loss():
    """Through the layer: the angle of a polarizer from the angle of polarization, S1 and S2 alone."""
    film = {"type": "transient_hdr_film", "temporal_bins": 10, "start_opl": 2.5, "bin_width_opl": 0.1}
    key = "screen.bsdf.theta.value"
    renderer = tt.TransientRenderer(tt.load(lit_polarizer(film), variant=VARIANT), parameters=[key], spp=16)
    out = renderer({key: renderer.values[key]}, seed=0)
    angle = tt.stokes.angle_of_linear_polarization(out.transient.sum(-3), tt.stokes.STEADY_DIM)
    assert float(angle.detach()) == pytest.approx(np.radians(25.0), abs=1e-5)
    angle.sum().backward()
    # Mitsuba's angle turns clockwise as the camera sees it.
    assert float(renderer.values[key].grad) == pytest.approx(-np.pi / 180, rel=1e-3)
    dop = tt.stokes.degree_of_polarization(renderer(seed=0).steady, tt.stokes.STEADY_DIM)
    assert float(dop.detach()) == pytest.approx(1.0, abs=1e-5)


