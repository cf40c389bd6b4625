"""Plans for small errors: no Russian roulette, shared light, and ellipsoidal connections where they pay."""

import re

import pytest
import torch

import torchtransient as tt


def box(resolution=24, **integrator):
    scene = tt.scenes.cornell_box(resolution=resolution, num_bins=60, bin_width_opl=0.1)
    scene["integrator"] |= integrator
    return scene


def test_diffuse_rooms_share_their_light():
    plan = tt.plan(box(), error="relative")
    assert plan.integrator == "transient_path_reuse"
    assert plan.rr_depth > plan.max_depth
    assert any("path reuse: used" in line for line in plan.reasons)
    assert plan.renderer(spp=16)(seed=0).stats.integrator == "transient_path_reuse"


@pytest.mark.parametrize("reason", ["one bounce", "polarized", "asked for", "no pilot"])
def test_paths_stay_plain(reason):
    scene, settings = box(8), {}
    if reason == "one bounce":  # nothing to share
        settings = {"max_depth": 2}
    if reason == "polarized":
        settings = {"variant": "llvm_ad_spectral_polarized"}
    if reason == "asked for":
        settings = {"integrator": "transient_path"}
    if reason == "no pilot":
        settings = {"pilot": False, "max_depth": 8}
    plan = tt.plan(scene, error="relative", **settings)
    assert plan.integrator == "transient_path"
    assert plan.rr_depth > plan.max_depth


@pytest.mark.slow
def test_depths_of_late_light_are_said_with_what_they_rest_on():
    """A gate that some twenty arrivals meet: none lies deeper, and of the gate's light a part does all the same."""
    scene, gate = box(max_depth=-1), tt.Gate.rectangular(15.0, 15.06)
    plan = tt.plan(scene, "gates", gates=gate, integrator="transient_path")
    line = next(line for line in plan.reasons if line.startswith("max_depth"))
    assert plan.pilot.tail == 0 and 5 < plan.pilot.events < 100 and f"its {plan.pilot.events} arrivals" in line
    untold = float(re.search(r"cannot tell that from ([\d.e-]+)\)", line)[1])
    with torch.no_grad():
        all_of_it, kept = (
            float(plan.renderer(max_depth=depth, spp=2048)(seed=0).gated.sum()) for depth in (64, plan.max_depth)
        )
    assert 1e-3 < 1 - kept / all_of_it < untold
    assert "cannot tell" not in str(tt.plan(scene, integrator="transient_path"))


def test_roulette_stays_where_nothing_else_ends_paths():
    plan = tt.plan(box(8, max_depth=-1), error="relative", max_depth="scene", pilot=False, time_axis="scene")
    assert plan.rr_depth is None


@pytest.mark.slow
def test_light_is_shared_up_to_the_depth_of_the_plan():
    """Of a scene without a limit, too; one that is asked for leaves paths plain, and the plan says so."""
    scene = box(max_depth=-1)
    plan = tt.plan(scene, error="relative")
    assert plan.integrator == "transient_path_reuse" and 0 < plan.max_depth < plan.rr_depth
    assert plan.renderer(spp=4)(seed=0).stats.max_depth == plan.max_depth
    unlimited = tt.plan(scene, error="relative", max_depth=-1)
    assert (unlimited.integrator, unlimited.max_depth) == ("transient_path", -1)
    assert any("path reuse: not used" in line and "no limit" in line for line in unlimited.reasons)


@pytest.mark.parametrize(("width", "error"), [(0.06, "squared"), pytest.param(6.0, "relative", marks=pytest.mark.slow)])
def test_narrow_gates_are_connected_by_path_length(width, error):
    plan = tt.plan(box(), "gates", gates=tt.Gate.rectangular(7.5 - width / 2, 7.5 + width / 2), error=error)
    assert plan.connections == ("ellipsoidal" if width < 1 else None)
    out = plan.renderer(spp=16)(seed=0)
    assert out.gated.isfinite().all() and out.gated.sum() > 0


@pytest.mark.slow
def test_late_bins_are_less_noisy_for_the_plan_and_the_mean_is_the_same():
    """Late light of a room with depth 20, 24 runs of each: variances over the local mean squared, means by z."""
    scene, axis = box(16, max_depth=20), tt.TimeAxis(4.0, 0.5, 60)
    plan = tt.plan(scene, error="relative", time_axis=axis, max_depth="scene", integrator="transient_path")
    planned, plain = plan.renderer(spp=64), tt.TransientRenderer(scene, time_axis=axis, spp=64)
    runs = {}
    for name, renderer in (("planned", planned), ("plain", plain)):
        with torch.no_grad():
            runs[name] = torch.stack([renderer(seed=100 + k).transient.mean(0).double() for k in range(24)])
    energies = [r.sum((1, 2, 3)) for r in runs.values()]
    z = (energies[0].mean() - energies[1].mean()) / (energies[0].var() / 24 + energies[1].var() / 24).sqrt()
    assert abs(float(z)) < 4
    mean = torch.cat(list(runs.values())).mean(0)
    near = torch.nn.functional.avg_pool3d(mean[None], 3, 1, 1, count_include_pad=False)[0]
    late = [float((r.var(0) / (near**2 + (0.01 * near.mean()) ** 2))[30:].mean()) for r in runs.values()]
    assert late[0] < late[1] / 3
