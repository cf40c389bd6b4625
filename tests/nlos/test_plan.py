"""``tt.plan`` of captures: the scene's integrator is kept, and said how it finds which light."""

from __future__ import annotations

import pytest

import torchtransient as tt
from support.marks import long

VARIANT = "llvm_ad_mono"
WALL = tt.nlos.Wall.plane(2.0, 1.6, albedo=0.7)
SHARED = "light: light of three bounces from hidden samples that all scanned points share; "


def scene(kind="confocal", hidden=None, film=None, **integrator):
    settings = {"exhaustive": {"laser_grid": (2, 2)}}.get(kind, {})
    scan = tt.nlos.Scan.grid(WALL, (6, 4), kind=kind, **settings)
    described = tt.nlos.capture_scene(tt.scenes.nlos_z() if hidden is None else hidden, scan)
    axis = {"start_opl": 1.9, "bin_width_opl": 0.02, "temporal_bins": 100}
    described["wall"]["sensor"]["film"] |= axis if film is None else film
    described["integrator"] |= integrator
    return described


def light(plan):
    return next(line for line in plan.reasons if line.startswith("light: "))


@pytest.mark.parametrize("kind", long(["confocal", "exhaustive"], ["confocal"]))
def test_a_capture_is_planned_and_rendered(kind):
    plan = tt.plan(scene(kind, filter_bounces=3, min_bounces=0))
    assert (plan.variant, plan.integrator, plan.max_depth) == ("llvm_ad_mono", "transient_nlos_path", 3)
    assert light(plan) == SHARED + "no later light"
    # From the nearest point of the letter, 1 m before the wall, and the farthest.
    assert 1.98 <= plan.time_axis.start_opl <= 2.1 and 2.1 < plan.time_axis.end_opl < 4.2
    out = plan.renderer(spp=64)(seed=0)
    assert out.stats.integrator == "transient_nlos_path" and float(out.transient.sum()) > 0
    assert sum(out.stats.energy_before) + sum(out.stats.energy_after) < 0.01 * float(out.transient.sum())


def test_bounces_of_a_plan():
    """A pilot run goes deeper than the scene; what its integrator filters is not asked for, later light is told."""
    plan = tt.plan(scene(filter_bounces=3, min_bounces=0, max_depth=8))
    assert plan.max_depth == 3 and plan.time_axis.end_opl < 4.2 and light(plan) == SHARED + "no later light"
    plan = tt.plan(scene(hidden=tt.scenes.nlos_corner(), min_bounces=0, max_depth=-1))
    assert plan.max_depth >= 4 and light(plan).startswith(f"{SHARED}light of 4 ") and "chains" in light(plan)


def test_why_paths():
    plan = tt.plan(scene(), ("transient", "stokes"))
    assert plan.variant == "llvm_ad_mono_polarized" and "from paths, since the variant" in light(plan)
    metal = tt.scenes.nlos_z()
    metal["letter"]["bsdf"] = {"type": "roughconductor", "alpha": 0.3, "id": "metal"}
    plan = tt.plan(scene(hidden=metal), pilot=False)
    assert "light of three bounces from paths, since not all surfaces are diffuse" in light(plan)
    assert "as third_bounce asks for" in light(tt.plan(scene(third_bounce="paths"), pilot=False))


def test_without_a_pilot_run_the_depth_is_kept():
    """The plate's albedo leaves little of the emitted power behind two bounces, and all that is seen."""
    plan = tt.plan(scene(hidden=tt.scenes.nlos_z(albedo=1e-4)), pilot=False)
    assert plan.max_depth is None and "max_depth: 3, kept" in str(plan) and light(plan).startswith(SHARED)
