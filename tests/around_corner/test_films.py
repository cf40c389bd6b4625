"""Every film around a corner: gates, phasors, bins and what is outside of them show the same light, which is drawn
alike for the same seed.
"""

import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import folded_plates, mesh
from support.marks import long_pairs
from support.nlos_scenes import scan_scene

VARIANT = "llvm_ad_mono"
GRID, SAMPLES = 2, 256
LIGHT = {
    "third": {"filter_bounces": 3, "max_depth": 3, "third_bounce": "shared"},
    "late": {"min_bounces": 4, "max_depth": 5, "late_light": "chains"},
}
KINDS = ("confocal", "single", "exhaustive")
QUICK = [("third", "confocal"), ("late", "single"), ("third", "exhaustive")]
HISTOGRAM = {"type": "transient_hdr_film", "start_opl": 1.2, "temporal_bins": 40, "bin_width_opl": 0.05}
every_light = pytest.mark.parametrize(("which", "kind"), long_pairs(LIGHT, KINDS, QUICK))


def render(which, kind, response, albedo=0.7, **settings):
    """(steady image, what the film keeps, film) of a fold and a plate before the wall."""
    film = {"width": GRID, "height": GRID, "rfilter": {"type": "box"}, **response}
    if kind == "exhaustive":
        film |= {"exhaustive_scan": True, "laser_scan_width": GRID, "laser_scan_height": GRID}
    shape = mesh("a", folded_plates(), albedo, two_sided=True)
    scene = mi.load_dict(scan_scene({"a": shape}, kind, film, **LIGHT[which], **settings), optimize=False)
    steady, kept = scene.integrator().render(scene, seed=2, spp=SAMPLES)
    return np.array(steady, dtype=float), np.array(kept, dtype=float), scene.sensors()[0].film()


@every_light
@pytest.mark.parametrize("filter_name", ["box", "tent"])
def test_bins_and_what_is_outside_are_the_steady_image(which, kind, filter_name):
    window = {"start_opl": 2.6 if which == "third" else 3.4, "temporal_bins": 3, "temporal_filter": filter_name}
    steady, cube, film = render(which, kind, HISTOGRAM | window)
    assert cube.sum() + film.energy_before + film.energy_after == pytest.approx(steady.sum(), rel=1e-5)
    assert min(film.energy_before, film.energy_after) > 0.05 * steady.sum()


@every_light
def test_a_film_without_a_steady_image_leaves_out_what_it_cannot_see(which, kind):
    _, cube, _ = render(which, kind, HISTOGRAM)
    steady, same, _ = render(which, kind, HISTOGRAM | {"steady": False})
    assert cube.sum() > 0 and same == pytest.approx(cube, rel=1e-5, abs=1e-7 * cube.max())
    assert steady.sum() == pytest.approx(cube.sum(), rel=1e-5)


@every_light
def test_gates_are_sums_of_bins(which, kind):
    _, cube, _ = render(which, kind, HISTOGRAM)
    gates = {"type": "gated_hdr_film", "gates": "rectangular 1.2 2.2; rectangular 2.2 3.2"}
    _, gated, _ = render(which, kind, gates)
    expected = cube.reshape(*cube.shape[:-2], 2, 20, 1).sum(-2)
    assert gated == pytest.approx(expected, rel=1e-4, abs=1e-6 * expected.max())


@pytest.mark.parametrize(("which", "kind"), [(which, kind) for which in LIGHT for kind in ("confocal", "single")])
def test_phasors_are_the_transform_of_fine_bins(which, kind):
    frequencies, width, bins = [0.0, 0.7, 1.5], 0.001, 8000
    fine = {"start_opl": 0.0, "temporal_bins": bins, "bin_width_opl": width}
    _, cube, _ = render(which, kind, HISTOGRAM | fine)
    phasors = {"type": "phasor_hdr_film", "frequencies": "0, 0.7, 1.5", "start_opl": 0.3}
    steady, found, _ = render(which, kind, phasors)
    centers = width * (np.arange(bins) + 0.5) - 0.3
    expected = cube[..., 0] @ np.exp(-2j * np.pi * np.outer(centers, frequencies))
    # Within a bin the phase changes by 2 pi nu 0.5 mm at most.
    np.testing.assert_allclose(found[..., 0] + 1j * found[..., 1], expected, atol=6e-3 * np.abs(expected).max())
    assert steady[..., 0] == pytest.approx(found[:, :, 0, 0], rel=1e-5)


@pytest.mark.slow
def test_colours():
    """Every channel is a capture of its own albedo and energy."""
    kind, albedos, energies = "exhaustive", [0.2, 0.5, 0.8], [1.0, 2.0, 3.0]
    with mi.variant_context("llvm_ad_rgb"):
        laser = {"type": "laser_beam", "energy": {"type": "rgb", "value": energies}}
        _, cube, _ = render("third", kind, HISTOGRAM, {"type": "rgb", "value": albedos}, laser=laser)
    for channel, (albedo, energy) in enumerate(zip(albedos, energies, strict=True)):
        _, expected, _ = render("third", kind, HISTOGRAM, albedo, laser={"type": "laser_beam", "energy": energy})
        assert expected.max() > 0
        assert cube[..., channel] == pytest.approx(expected[..., 0], rel=1e-4, abs=1e-6 * expected.max())


@pytest.mark.parametrize("which", LIGHT)
def test_the_diagonal_is_the_confocal_capture_and_a_column_a_single_one(which):
    """The same samples; an arrival at the rim of a bin may be rounded into the other one."""
    fine = {"start_opl": 0.0, "temporal_bins": 40, "bin_width_opl": 0.2}
    _, every, _ = render(which, "exhaustive", HISTOGRAM | fine)
    _, confocal, _ = render(which, "confocal", HISTOGRAM | fine)
    _, single, _ = render(which, "single", HISTOGRAM | fine, spot=(-0.25, 0.25, 0.0))
    every = every.reshape(GRID**2, GRID**2, -1)
    for found, expected in ((every[range(4), range(4)], confocal), (every[:, 2], single)):
        found, expected = found.cumsum(-1), expected.reshape(GRID**2, -1).cumsum(-1)
        assert expected.max() > 0
        assert np.median(np.abs(found - expected)) < 1e-6 * expected.max()
        assert found[:, -1] == pytest.approx(expected[:, -1], rel=1e-4)
