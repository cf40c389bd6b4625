"""Shared samples: rays are left out where that pays, tiles have samples of their own, and the light is the same."""

import mitsuba as mi
import numpy as np
import pytest

import torchtransient.plugins.around_corner.shared_light as shared_light
from support.hidden_shapes import ball, mesh
from support.marks import long
from support.nlos_scenes import captures, film, plane, ratio, scan_scene, side

VARIANT = "llvm_ad_mono"
pytestmark = pytest.mark.usefixtures("no_leftovers")


@pytest.mark.parametrize("kind", long(["single", "exhaustive"], ["single"]))
def test_rays_that_are_left_out_change_nothing(monkeypatch, kind):
    """A plate before another one, and a wall beside them: some elements are clear and some are not."""
    hidden = {"a": plane(), "b": side(), "c": plane(0.8, 0.2, 0.3, 0.2, 0.3)}
    shares, runs = [], []
    found = shared_light.spare_rays
    monkeypatch.setattr(shared_light, "spare_rays", lambda *a: shares.append(found(*a)))
    for pays in (True, False):
        monkeypatch.setattr(shared_light, "saves_time", lambda scene, rays, p=pays: p)
        points = 2 if kind == "exhaustive" else 4
        scene = scan_scene(hidden, kind, film(points, kind=kind), max_depth=3, third_bounce="shared")
        runs.append(captures(scene, 2048, 8))
    assert len(shares) == 8 and 0.05 < min(shares) <= max(shares) < 0.95
    value, error = ratio(*runs)
    assert error < 2e-3 and abs(value - 1) < 4 * error


def test_small_jobs_look_for_no_shafts(monkeypatch):
    monkeypatch.setattr(shared_light, "spare_rays", lambda *a: pytest.fail("not worth its time"))
    captures(scan_scene({"a": plane()}, max_depth=3, third_bounce="shared"), 16, 1)


def test_spots_beside_the_scanned_points():
    """As many of them as there are points, near one corner of the wall: light of shared samples is that of paths."""

    def capture(how, spp):
        scene = scan_scene({"a": plane(0.5, 0.4, 0.3)}, "exhaustive", film(2, 0.0, 0.1, 40, "exhaustive"),
                           max_depth=3, third_bounce=how)  # fmt: skip
        spots = [[x, y, 0] for y in (-0.45, -0.4) for x in (-0.45, -0.4)]
        scene["wall"]["sensor"]["laser_points"] = mi.TensorXf(np.float32(spots))
        return captures(scene, spp, 8)

    value, error = ratio(capture("shared", 512), capture("paths", 4096))
    assert error < 0.01 and abs(value - 1) < 4 * error


def test_tiles_of_a_scan_have_less_noise_and_no_bias():
    """An arm 10 cm before a scan of 1 m: of samples for all points alike the variance would be that of paths."""
    arm, grid, spp = {"a": mesh("arm", ball((0.1, 0, 0.25), (0.35, 0.06, 0.12), 3))}, film(8, 0.0, 0.1, 20), 256
    scenes = {how: scan_scene(arm, "confocal", grid, third_bounce=how) for how in ("shared", "paths")}
    shared, paths = (captures(scenes[how], n, 24).reshape(24, 64, -1).sum(2) for how, n in zip(
        scenes, (spp, 4 * spp), strict=True))  # fmt: skip
    value, error = ratio(shared, paths)
    assert error < 5e-3 and abs(value - 1) < 4 * error
    apart = (shared.mean(0) - paths.mean(0)) / np.hypot(*(x.std(0, ddof=1) / 24**0.5 for x in (shared, paths)))
    assert np.abs(apart).max() < 4.5
    noise = [(x.var(0, ddof=1) / x.mean(0) ** 2).mean() for x in (shared, paths)]
    assert noise[0] < 4 * noise[1] / 8
