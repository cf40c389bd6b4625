"""Shafts in the integrator: rays are left out where that pays, and the light is the same."""

import mitsuba as mi
import numpy as np
import pytest

import torchtransient.plugins.around_corner.shared_light as shared_light
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
