"""`transient_hdr_film` under renders: crop, spatial filters, storage bands, passes, samplers, energy outside the
window.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.marks import long
from torchtransient import plugins
from torchtransient.accuracy import two_sample_z_test
from torchtransient.errors import StorageError

LANES = "torchtransient.plugins.integrators.job.MAX_LANES"
ENTRIES = "torchtransient.plugins.films.base.MAX_ARRAY_ENTRIES"


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")
    plugins.sync()


def film(kind="transient_hdr_film", rfilter="box", **arguments):
    time = {"temporal_bins": 40, "bin_width_opl": 0.03, "start_opl": 3.95} if kind == "transient_hdr_film" else {}
    return {"type": kind, "width": 9, "height": 6, "rfilter": {"type": rfilter}, **time, **arguments}


def glowing_wall(
    film_node, integrator="transient_path", radiance=None, sampler="independent", spp=16, **integrator_arguments
):
    """A camera at 4 m looks at a wall that glows in the colours of a picture (or in one)."""
    if radiance is None:
        picture = np.random.default_rng(7).uniform(0.0, 1.0, (24, 24, 3)).astype(np.float32)
        radiance = {"type": "bitmap", "data": mi.TensorXf(picture), "raw": True, "filter_type": "nearest"}
    t = mi.ScalarTransform4f()
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, "max_depth": 1, **integrator_arguments},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "film": film_node,
                "sampler": {"type": sampler, "sample_count": spp},
                "to_world": t.look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0]),
            },
            "wall": {
                "type": "rectangle",
                "to_world": t.scale([2.5, 2.5, 1]),
                "emitter": {"type": "area", "radiance": radiance},
            },
        }
    )


def runs(scene, count=6, spp=64):
    """Independent renders: steady (K, H, W, C), transient (K, H, W, T, C)."""
    results = [scene.integrator().render(scene, seed=50 + k, spp=spp) for k in range(count)]
    return [np.array([np.array(r[i]) for r in results], dtype=float) for i in (0, 1)]


def steady_runs(scene, count=6, spp=64):
    return np.array([np.array(mi.render(scene, seed=900 + k, spp=spp)) for k in range(count)], dtype=float)


def check(a, b, rounding=1e-5):
    result = two_sample_z_test(a, b, rounding=rounding)
    assert result.passed, str(result)
    assert abs(result.chi2_z) < 4.5, str(result)


CROP = {"crop_offset_x": 5, "crop_offset_y": 1, "crop_width": 3, "crop_height": 4}


@pytest.mark.slow
def test_crop_is_the_crop_of_the_full_render():
    whole, part = glowing_wall(film()), glowing_wall(film(**CROP))
    steady, transient = runs(part)
    assert steady.shape[1:] == (4, 3, 3) and transient.shape[1:] == (4, 3, 40, 3)
    full_steady, full_transient = runs(whole, 7)
    check(steady, full_steady[:, 1:5, 5:8])
    check(transient.mean(-1), full_transient[:, 1:5, 5:8].mean(-1))
    # a window displaced by one pixel would not pass
    assert not two_sample_z_test(steady, full_steady[:, 1:5, 4:7]).passed
    assert not two_sample_z_test(steady, full_steady[:, 2:6, 5:8]).passed


@pytest.mark.slow
@pytest.mark.parametrize("rfilter", ["gaussian", "lanczos"])
def test_spatial_filters_converge_to_splatting(rfilter):
    steady, transient = runs(glowing_wall(film(rfilter=rfilter)), 8, 1024)
    # splatting divides by the sum of the weights: a bias of order 1 / spp, a tenth of the noise here
    splatted = steady_runs(glowing_wall(film("hdrfilm", rfilter, sample_border=True), "path"), 8, 1024)
    check(steady, splatted)
    np.testing.assert_allclose(transient.sum(3), steady, atol=2e-6)


@pytest.mark.slow
def test_storage_bands(monkeypatch):
    rows = 4
    whole = glowing_wall(film())
    _, transient = runs(whole)
    monkeypatch.setattr(ENTRIES, rows * 9 * 40 * 3 + 5)
    scene = glowing_wall(film())
    target = scene.sensors()[0].film()
    banded, steady = [], []
    for k in range(6):
        assert scene.integrator().render(scene, seed=k, spp=64, develop=False) is None
        bands = target.transient_bands()
        assert [b[0] for b in bands] == list(range(0, 6, rows))
        banded.append(np.concatenate([np.array(flat).reshape(count, 9, 40, 3) for _, count, flat in bands]))
        steady.append(np.array(target.steady).reshape(6, 9, 3))
    np.testing.assert_allclose(np.sum(banded, axis=3), steady, atol=2e-6)
    check(np.array(banded).mean(-1), transient.mean(-1))
    with pytest.raises(StorageError, match="develop=False"):
        scene.integrator().render(scene, spp=1)


def gradient_of_radiance(scene, seed, spp=16):
    """(dLoss / dradiance, loss) for a loss with weights on every bin and on the steady image, same seed."""
    params = mi.traverse(scene)
    key = "wall.emitter.radiance.value"
    target = scene.sensors()[0].film()
    rng = np.random.default_rng(4)
    g, g_steady = rng.normal(size=target.cube_shape()), rng.normal(size=(6, 9, 3))
    scene.integrator().render(scene, seed=seed, spp=spp, develop=False)
    cube = np.concatenate([np.array(b[2], dtype=float) for b in target.transient_bands()])
    loss = cube @ g.ravel() + np.array(target.steady, dtype=float) @ g_steady.ravel()
    dr.enable_grad(params[key])
    params.update()
    adjoint = (mi.TensorXf(g_steady), mi.TensorXf(g))
    scene.integrator().render_backward(scene, params, adjoint, seed=seed, spp=spp)
    slope = np.array(dr.grad(params[key]), dtype=float).sum()
    assert np.concatenate(
        [np.array(b[2]) for b in target.transient_bands()]
    ).any()  # backward left the render in the film
    return slope, loss


@pytest.mark.parametrize("what", long(["bands", "rows"], ["bands"]))
def test_adjoint_of_every_layout(monkeypatch, what):
    if what == "bands":
        monkeypatch.setattr(ENTRIES, 4 * 9 * 40 * 3)
    else:
        monkeypatch.setattr(LANES, 20)
    scene = glowing_wall(film(), radiance={"type": "rgb", "value": [1.0, 1.0, 1.0]})
    slope, loss = gradient_of_radiance(scene, seed=11)
    # the render is linear in the radiance, which is 1
    assert slope == pytest.approx(loss, rel=1e-4)
    assert abs(loss) > 0.1


def test_many_passes(monkeypatch):
    lanes, spp = 54 * 7, 64
    full, transient = runs(glowing_wall(film()))
    monkeypatch.setattr(LANES, lanes)
    scene = glowing_wall(film())
    fractions = []
    scene.integrator().render(scene, spp=spp, progress_callback=fractions.append)
    assert len(fractions) > 1 and fractions == sorted(fractions) and fractions[-1] == 1.0
    assert len(fractions) >= 54 * spp / lanes
    steady, split = runs(scene, spp=spp)
    np.testing.assert_allclose(split.sum(3), steady, atol=2e-6)
    check(steady, full)
    # a bin of a pixel holds too few samples here to be normally distributed; one of a column does not
    check(split.mean((1, -1)), transient.mean((1, -1)))


def test_seeds():
    scene = glowing_wall(film())
    a, b, c = (np.array(scene.integrator().render(scene, seed=s, spp=8)[1]) for s in (3, 3, 4))
    # atomic sums may come in any order
    np.testing.assert_allclose(a, b, atol=1e-6)
    assert np.abs(a - c).max() > 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("sampler", ["independent", "stratified", "multijitter", "orthogonal", "ldsampler"])
def test_total_weight_with_any_sampler_and_count(monkeypatch, sampler):
    monkeypatch.setattr(LANES, 54 * 11)
    scene = glowing_wall(film(), radiance=1.0, sampler=sampler)
    for spp in (1, 7, 23, 30):
        steady, transient = (np.array(t) for t in scene.integrator().render(scene, spp=spp, seed=spp))
        np.testing.assert_allclose(steady, 1, rtol=1e-5)
        np.testing.assert_allclose(transient.sum(2), 1, rtol=1e-5)


def test_total_weight_in_bands_of_different_height(monkeypatch):
    monkeypatch.setattr(ENTRIES, 4 * 9 * 40 * 3)
    monkeypatch.setattr(LANES, 9 * 4 * 10)
    scene = glowing_wall(film(), radiance=1.0)
    scene.integrator().render(scene, spp=23, develop=False)
    np.testing.assert_allclose(np.array(scene.sensors()[0].film().steady), 1, rtol=1e-5)


def cornell(start, bins, filter):
    description = mi.cornell_box()
    description["integrator"] = {"type": "transient_path", "max_depth": 5}
    description["sensor"]["film"] = film(
        width=8,
        height=8,
        temporal_bins=bins,
        bin_width_opl=0.25,
        start_opl=start,
        temporal_filter=filter,
        gaussian_stddev=0.8,
    )
    return mi.load_dict(description)


@pytest.mark.slow
@pytest.mark.parametrize("filter", ["tent", "gaussian"])
def test_energy_outside_is_that_of_a_wider_window(filter):
    wide, narrow = cornell(0.0, 120, filter), cornell(5.0, 16, filter)
    cube = np.array(wide.integrator().render(wide, seed=2, spp=64)[1], dtype=float)
    steady, part = (np.array(t, dtype=float) for t in narrow.integrator().render(narrow, seed=2, spp=64))
    np.testing.assert_allclose(part, cube[:, :, 20:36], atol=1e-5 * cube.max())
    target = narrow.sensors()[0].film()
    before, after = cube[:, :, :20].mean(-1).sum(), cube[:, :, 36:].mean(-1).sum()
    assert before > 0.1 and after > 0.1
    assert target.energy_before == pytest.approx(before, rel=1e-5)
    assert target.energy_after == pytest.approx(after, rel=1e-5)
    assert part.mean(-1).sum() + before + after == pytest.approx(steady.mean(-1).sum(), rel=1e-5)


