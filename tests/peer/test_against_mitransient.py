"""Forward renders against mitransient 1.3.1: equal where it is right, the closed form where it is not."""

import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins, scenes
from torchtransient.accuracy import two_sample_z_test, z_test
from torchtransient.scenes import look_at, scale

pytestmark = pytest.mark.peer

VARIANT = "llvm_ad_rgb"
RUNS = 12


def with_film(description, **changes):
    """The scene with other film parameters."""
    sensor = description["sensor"]
    return {**description, "sensor": {**sensor, "film": {**sensor["film"], **changes}}}


def enough_events(a, b, relative):
    """Entries where both sides hold at least `relative` of the brightest: few events in a bin are not normally
    distributed."""
    mean = (a.mean(axis=0) + b.mean(axis=0)) / 2
    return mean > relative * mean.max()


@pytest.mark.parametrize("mirror", [False, True], ids=["diffuse", "mirror"])
def test_cornell_box_agrees_in_every_bin(ours, peer, mirror):
    box = scenes.cornell_box(4, num_bins=60, bin_width_opl=0.1, max_depth=8, mirror=mirror)
    near = box["sensor"]["near_clip"]
    _, a = ours(box, range(RUNS), 8192)
    # The peer's clock starts at the near clip plane: its window opens that much earlier. What is left of its error,
    # near / cos - near, is below 0.1 mm in a bin of 100 mm.
    steady_b, b = peer(with_film(box, start_opl=3.5 - near), range(1000, 1000 + RUNS), 8192)
    steady_a, _ = ours(box, range(50, 50 + RUNS), 8192)
    steady = two_sample_z_test(steady_a, steady_b)
    assert steady.passed, f"steady: {steady}"
    tested = enough_events(a, b, 1e-3)
    assert tested.sum() > 1000
    result = two_sample_z_test(a[:, tested], b[:, tested])
    assert result.passed, str(result)
    assert abs(result.chi2_z) < 4.5, str(result)
    # Over all pixels the noise of a bin is about a percent; an error of five percent would be noticed.
    totals_a, totals_b = a.mean(axis=(1, 2)), b.mean(axis=(1, 2))
    pooled = two_sample_z_test(totals_a, totals_b)
    assert pooled.passed, str(pooled)
    assert not two_sample_z_test(totals_a, 1.05 * totals_b).passed


def test_equal_seeds_draw_equal_samples(ours, peer):
    """Both follow the order of random numbers of Mitsuba's own path tracer, so that even the noise agrees."""
    box = scenes.cornell_box(8, num_bins=1, bin_width_opl=100.0, start_opl=0.0, max_depth=5)
    (_, a), (_, b) = ours(box, [3], 16), peer(box, [3], 16)
    np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-5)


def under_the_sky():
    """The centre of a white square of side 2 under a uniform sky of radiance 1, seen from 2 m above."""
    scene = scenes.moving_wall(resolution=2, num_bins=100, start_opl=0.0, bin_width_opl=0.1, max_depth=2)
    scene["light"] = {"type": "constant", "radiance": 1.0}
    scene["sensor"].update(to_world=look_at([0, 0, 2.03], [0, 0, 0]), fov=0.5)
    scene["wall"]["to_world"] = scale(1.0)
    return scene


def test_environment_light_arrives(ours, peer):
    steady_a, a = ours(under_the_sky(), range(RUNS), 256)
    steady_b, b = peer(under_the_sky(), range(RUNS), 256)
    for steady in (steady_a, steady_b):
        result = z_test(steady.mean(axis=(1, 2, 3)), 0.5, rounding=1e-5)
        assert result.passed, str(result)
    # Light starts at the sphere around the square, of radius sqrt(2), and every direction reaches its centre after
    # that; 2.03 m more to the camera make 3.444 m. The pixels are 9 mm wide, which spreads the arrival by as much.
    total = a.sum(axis=3)
    np.testing.assert_allclose(total, steady_a, rtol=1e-5)
    np.testing.assert_allclose(a[:, :, :, 34], total, rtol=1e-5)
    # The peer keeps a part of it, elsewhere
    assert b.sum() / (steady_b.sum()) < 0.5


def test_crop_keeps_its_own_shape(ours, peer):
    box = scenes.cornell_box((6, 8), num_bins=30, bin_width_opl=0.2, max_depth=4)
    crop = {"crop_offset_x": 1, "crop_offset_y": 3, "crop_width": 4, "crop_height": 2}
    steady, a = ours(with_film(box, **crop), range(RUNS), 2048)
    assert steady.shape == (RUNS, 2, 4, 3) and a.shape == (RUNS, 2, 4, 30, 3)
    _, full = ours(box, range(100, 100 + RUNS), 2048)
    window = full[:, 3:5, 1:5]
    tested = enough_events(a, window, 3e-3)
    result = two_sample_z_test(a[:, tested], window[:, tested])
    assert result.passed, str(result)
    _, b = peer(with_film(box, **crop), range(2), 16)
    assert b.shape[1:3] == (8, 6), "the peer returns the full size, with the crop in a corner"


def test_stokes_vectors_in_time(ours, peer):
    """A metal floor and a metal block, in every bin and component. The peer's window opens earlier by the near clip
    plane.
    """
    box = scenes.cornell_box(4, num_bins=30, bin_width_opl=0.2, max_depth=5)
    metal = {"type": "roughconductor", "eta": 0.8, "k": 2.5, "alpha": 0.3}
    for name in ("floor", "large-box"):
        box[name] = {**box[name], "bsdf": metal}
    near, variant = box["sensor"]["near_clip"], "llvm_ad_mono_polarized"
    mi.set_variant(variant)
    plugins.sync()
    _, a = ours(box, range(RUNS), 8192)
    _, b = peer(with_film(box, start_opl=3.5 - near), range(1000, 1000 + RUNS), 8192, variant)
    assert a.shape == b.shape == (RUNS, 4, 4, 30, 4)
    for k in range(4):
        assert np.abs(b[..., k]).max() > 1e-4
    totals = two_sample_z_test(a.sum(axis=3), b.sum(axis=3))
    assert totals.passed, str(totals)
    tested = enough_events(a[..., 0], b[..., 0], 1e-2)
    result = two_sample_z_test(a[:, tested], b[:, tested])
    assert result.passed, str(result)
    assert abs(result.chi2_z) < 4.5, str(result)
