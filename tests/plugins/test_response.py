"""Response curves of a film: values of the channels, sampled wavelengths, errors, and the way through torch."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
import torch
from scipy.integrate import trapezoid

import torchtransient as tt
from torchtransient import plugins
from torchtransient.accuracy import two_sample_z_test, z_test
from torchtransient.errors import SceneError
from torchtransient.files import read_result, write_result

VARIANT = "llvm_ad_spectral"
BANDS = {
    "red": {"type": "spectrum", "value": [(600, 0.0), (700, 2.0), (800, 0.0)]},
    "blue": {"type": "regular", "wavelength_min": 400, "wavelength_max": 500, "values": "0, 1, 0"},
    "ragged": {"type": "irregular", "wavelengths": "500, 510, 600", "values": "0, 3, 1"},
}
LAMP = {"type": "regular", "wavelength_min": 360, "wavelength_max": 830, "values": "1, 5, 2, 8"}
WALL = {"type": "regular", "wavelength_min": 360, "wavelength_max": 830, "values": "0.1, 0.9, 0.3"}


def film(kind="transient_hdr_film", bands=BANDS):
    time = {"temporal_bins": 50, "bin_width_opl": 0.5} if kind == "transient_hdr_film" else {}
    return {"type": kind, "width": 2, "height": 2, "rfilter": {"type": "box"}, **time, **bands}


def description(film_node, integrator="transient_path", lamp=LAMP, wall=WALL):
    """A lit wall with a panel beside it; matrices only, so that it serves every variant."""
    pose = np.array([[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 4], [0, 0, 0, 1.0]])
    turned = np.array([[0.3, 0, -0.52, 1.6], [0, 0.6, 0, 0], [0.52, 0, 0.3, 1.2], [0, 0, 0, 1]])
    return {
        "type": "scene",
        "integrator": {"type": integrator, "max_depth": 4},
        "sensor": {
            "type": "perspective",
            "fov": 40,
            "film": film_node,
            "to_world": mi.ScalarTransform4f(pose),
            "sampler": {"type": "independent", "sample_count": 1024},
        },
        "light": {"type": "point", "position": [0.5, 0, 2], "intensity": lamp},
        "wall": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(np.diag([2.0, 2, 2, 1])),
            "bsdf": {"type": "diffuse", "reflectance": wall},
        },
        "side": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(turned),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.2, 0.2]}},
        },
    }


def integral(values, nodes, curve_nodes, curve_values):
    """Integral over wavelength of a spectrum times a response curve."""
    at = np.linspace(360, 830, 47001)
    curve = np.interp(at, curve_nodes, curve_values, left=0, right=0)
    return trapezoid(np.interp(at, nodes, values) * curve, at)


def runs(scene, count=8):
    results = [scene.integrator().render(scene, seed=k) for k in range(count)]
    return [np.array([np.array(r[i], dtype=float) for r in results]) for i in (0, 1)]


@pytest.mark.slow
def test_steady_image_is_that_of_specfilm():
    scene, reference = mi.load_dict(description(film())), mi.load_dict(description(film("specfilm"), "path"))
    steady, transient = runs(scene)
    expected = np.array([np.array(mi.render(reference, seed=90 + k), dtype=float) for k in range(8)])
    result = two_sample_z_test(steady, expected)
    assert result.passed and abs(result.chi2_z) < 4.5, str(result)
    np.testing.assert_allclose(transient.sum(3), steady, rtol=1e-5)
    # the comparison would notice two channels that are exchanged, and 2 percent of one
    assert not two_sample_z_test(steady[..., [1, 0, 2]], expected).passed
    assert two_sample_z_test(steady * 1.02, expected).chi2_z > 4.5


def test_channels_are_integrals_over_wavelength():
    # direct light alone: the share of the wall's reflectance and the lamp's spectrum in each channel
    node = description(film())
    node["integrator"]["max_depth"] = 2
    del node["side"]
    steady, _ = runs(mi.load_dict(node))
    lamp, wall = [1, 5, 2, 8], [0.1, 0.9, 0.3]
    at = np.linspace(360, 830, 47001)
    product = np.interp(at, np.linspace(360, 830, 4), lamp) * np.interp(at, [360, 595, 830], wall)
    expected = [
        integral(product, at, [600, 700, 800], [0, 2, 0]),
        integral(product, at, [400, 450, 500], [0, 1, 0]),
        integral(product, at, [500, 510, 600], [0, 3, 1]),
    ]
    shares = steady.mean((1, 2)) / expected
    # one geometry factor for all channels
    result = z_test(shares[:, 1:] / shares[:, :1], np.ones(2))
    assert result.passed, str(result)


def test_lines_narrower_than_a_nanometre_are_found():
    line = {"type": "irregular", "wavelengths": "532.2, 532.4, 532.6", "values": "0, 5, 0"}
    broad = {"type": "spectrum", "value": [(500, 1.0), (560, 1.0)]}
    node = description(film(bands={"line": line, "broad": broad}), lamp=1.0, wall=0.5)
    node["integrator"]["max_depth"] = 2
    del node["side"]
    steady, _ = runs(mi.load_dict(node))
    means = steady.mean((1, 2))
    # a triangle of 0.4 nm and height 5 beside 60 nm
    result = z_test((means[:, 0] * 60 - means[:, 1])[:, None], np.zeros(1))
    assert result.passed, str(result)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_mono"])
def test_a_variant_without_wavelengths_is_refused(variant):
    mi.set_variant(variant)
    with (
        pytest.raises(SceneError, match=r"red, blue, ragged need a variant .* llvm_ad_spectral"),
        plugins.plugin_errors(),
    ):
        mi.load_dict(film())


@pytest.mark.parametrize("value", [-1.0, 0.0])
def test_impossible_curves_are_refused(value):
    bands = {"bad": {"type": "uniform", "value": value}}
    with pytest.raises(SceneError, match=r"'bad' must be finite, nowhere negative"), plugins.plugin_errors():
        mi.load_dict(film(bands=bands))


def test_through_torch(tmp_path):
    scene = tt.load(description(film()), variant=VARIANT)
    out = tt.TransientRenderer(scene, spp=64)(seed=0)
    assert out.transient.shape == (3, 50, 2, 2) and out.channels == ("red", "blue", "ragged")
    torch.testing.assert_close(out.transient.sum(1), out.steady)
    for name in ("a.h5", "a.npz"):
        back = read_result(write_result(tmp_path / name, out))
        assert back.channels == out.channels and torch.equal(back.transient, out.transient)


def test_a_specfilm_becomes_a_film_with_its_bands():
    axis = tt.TimeAxis(0.0, 0.5, 50)
    steady = tt.load(description(film("specfilm"), "path"), variant=VARIANT)
    ours = tt.load(description(film()), variant=VARIANT)
    out = tt.TransientRenderer(steady, time_axis=axis, spp=64)(seed=0)
    assert out.channels == ("red", "blue", "ragged")
    torch.testing.assert_close(out.transient, tt.TransientRenderer(ours, spp=64)(seed=0).transient)


# ------------------------------------------------------------------------------------------- samples and channels


