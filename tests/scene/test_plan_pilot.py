"""Decisions of a plan by tracing: depth and window hold the promised light and no more."""

import json

import mitsuba as mi
import numpy as np
import pytest
import torch
from click.testing import CliRunner

import torchtransient as tt
from support import plan_scenes
from torchtransient.__main__ import main
from torchtransient.accuracy import two_sample_z_test

VARIANT = "llvm_ad_mono"


def means(renderer, count=8, **settings):
    """Image means over all channels of independent renders (K,)."""
    with torch.no_grad(), mi.variant_context(renderer.scene.variant):
        steady = [renderer(seed=100 + k, **settings).steady for k in range(count)]
    # Of Stokes vectors the first component is the intensity.
    return np.array([float((s[0] if s.ndim == 4 else s).mean()) for s in steady])


def fog_room():
    fog = {"type": "homogeneous", "sigma_t": 2.0, "albedo": 0.9}
    ball = {"type": "sphere", "center": [0, 0, 1.5], "bsdf": {"type": "null"}, "interior": fog}
    return plan_scenes.grey_room(ball=ball)


# ------------------------------------------------------------------------------------------------------------ depth


def test_depth_of_a_furnace():
    """Inside a furnace exactly albedo^n of the light needs more than n segments."""
    albedo = 0.6
    plan = tt.plan(tt.scenes.furnace(reflectance=albedo), tail=1e-2)
    assert albedo**plan.max_depth <= 1e-2
    # Two standard errors are spent on certainty: not more than two bounces too many.
    assert albedo ** (plan.max_depth - 3) > 1e-2
    assert abs(plan.pilot.tail - albedo**plan.max_depth) < 4 * plan.pilot.tail_error


@pytest.mark.slow
def test_a_chain_of_mirrors_is_followed_to_its_end():
    bounces = 12
    scene = plan_scenes.mirror_chain(bounces)
    axis = tt.TimeAxis(0.0, 100.0, 1)
    default = tt.TransientRenderer(tt.load(scene, variant=VARIANT), time_axis=axis)
    assert means(default, 1)[0] == 0
    plan = tt.plan(scene)
    assert plan.max_depth == bounces + 1
    assert any("at the scene's own 6 it would be 1" in line for line in plan.reasons)
    output = plan.renderer()(seed=0, spp=64)
    assert float(output.steady.mean()) > 0
    length = (bounces + 1.0 - 1.0) * np.sqrt(2)  # half a crossing at both ends
    peak = float(plan.time_axis.centers_opl[int(output.transient.sum((0, 2, 3)).argmax())])
    assert abs(peak - length) < max(plan.time_axis.bin_width_opl, 0.02)


# ----------------------------------------------------------------------------------------------------------- window


@pytest.mark.parametrize("name", ["moving_wall", pytest.param("cornell_box", marks=pytest.mark.slow)])
def test_the_window_holds_what_it_promises(name):
    # A wall that moves has a tent, which spreads light beyond its first bin and its last one.
    moving = ["wall.to_world"] if name == "moving_wall" else []
    plan = tt.plan(getattr(tt.scenes, name)(resolution=8), parameters=moving, missed=1e-2, tail=1e-2)
    output = plan.renderer()(seed=3, spp=512)
    inside = float(output.transient.sum(dtype=torch.float64)) / output.transient.shape[0]
    outside = sum(output.stats.energy_before) + sum(output.stats.energy_after)
    assert outside / (inside + outside) < 1e-2
    # No bins without light at the ends: a twentieth of the window has some.
    profile = output.transient.sum((0, 2, 3))
    some = max(1, len(profile) // 20)
    assert float(profile[:some].sum()) > 0
    assert float(profile[-some:].sum()) > 0


def test_light_at_the_first_edge_is_inside_of_a_tent_too():
    """Light returns to a camera with a lamp in its place from 4.02 m on, just behind an edge of bins."""
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": {"type": "perspective", "fov": 10, "near_clip": 0.01,
                   "film": {"type": "hdrfilm", "width": 4, "height": 4}},
        "lamp": {"type": "point", "position": [0, 0, 0]},
        "wall": {"type": "rectangle", "to_world": tt.scenes.transforms.translate([0, 0, 2.01])
                 @ tt.scenes.transforms.rotate([0, 1, 0], 180)},
    }  # fmt: skip
    plan = tt.plan(tt.load(scene, variant="llvm_ad_mono"), parameters=["wall.to_world"], bin_width_opl=0.5, missed=1e-3)
    assert sum(plan.renderer()(seed=1, spp=16).outside) < 1e-3


def test_delays_are_part_of_the_window():
    """A wall that answers with a lifetime of 0.5 m: all but a hundredth of the light within ln(100) lifetimes."""
    slow = {"type": "delayed", "lifetime": 0.5, "bsdf": plan_scenes.GREY}
    plain = tt.plan(plan_scenes.grey_room(), missed=1e-2)
    late = tt.plan(plan_scenes.grey_room(wall={"type": "rectangle", "bsdf": slow}), missed=1e-2)
    assert late.variant == "llvm_ad_mono"
    tail = late.time_axis.end_opl - plain.time_axis.end_opl
    assert 0.5 * np.log(100) - 0.15 < tail < 0.5 * np.log(100) + 0.5


def test_pulses_widen_the_window():
    scene = tt.scenes.moving_wall()
    plain = tt.plan(scene)
    pulsed = tt.plan(scene, irf=tt.Pulse.rectangular(0.4, center_opl=0.1))
    assert pulsed.time_axis.start_opl == pytest.approx(plain.time_axis.start_opl - 0.1, abs=0.011)
    assert pulsed.time_axis.end_opl == pytest.approx(plain.time_axis.end_opl + 0.3, abs=0.021)
    output = pulsed.renderer()(seed=0, spp=64)
    assert float(output.transient.sum()) == pytest.approx(float(output.steady.sum()), rel=1e-3)


# ------------------------------------------------------------------------- the same numbers with the cheapest means


@pytest.mark.parametrize("name", ["furnace", pytest.param("glass_slab_before_wall", marks=pytest.mark.slow)])
def test_a_plan_renders_what_the_plain_integrator_renders(name):
    """Same depth and window, other variant and integrator: the same image mean."""
    description = getattr(tt.scenes, name)(resolution=4)
    plan = tt.plan(description, max_depth="scene", time_axis="scene", pilot=False)
    assert plan.integrator == "transient_path"
    assert not plan.variant.endswith("polarized")
    plain = tt.TransientRenderer(tt.load(description, variant="llvm_ad_rgb"))
    cheap, full = means(plan.renderer(), spp=256), means(plain, spp=256)
    assert two_sample_z_test(cheap, full, rounding=1e-5 * full.mean()).passed


# ------------------------------------------------------------------------------------------------------- other films


def test_a_medium_is_rendered_without_a_plan_too():
    """effects="auto": a steady integrator becomes the one that the scene's contents call for."""
    scene = fog_room()
    scene["integrator"] = {"type": "path", "max_depth": 4}
    renderer = tt.TransientRenderer(scene)
    assert renderer(seed=0, spp=1).stats.integrator == "transient_prbvolpath"
    scene["ball"].pop("interior")
    assert tt.TransientRenderer(scene)(seed=0, spp=1).stats.integrator == "transient_path"
    assert tt.plan(fog_room(), pilot=False, time_axis="scene", max_depth="scene").integrator == "transient_prbvolpath"


# ---------------------------------------------------------------------------------------------------------- command


def test_command(tmp_path):
    file = tmp_path / "scene.xml"
    file.write_text(plan_scenes.xml_room('<shape type="sphere"><bsdf type="pplastic"/></shape>'), encoding="utf-8")
    result = CliRunner().invoke(main, ["plan", str(file), "--missed", "0.01"])
    assert result.exit_code == 0, result.output
    for start in ("variant: llvm_ad_mono_polarized", "integrator: ", "film: ", "max_depth: ", "time axis: ", "pilot: "):
        assert any(line.startswith(start) for line in result.output.splitlines()), start
    result = CliRunner().invoke(main, ["plan", str(file), "--json", "--outputs", "steady,stokes", "--no-pilot"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.output)
    assert (found["variant"], found["film"], found["pilot"]) == ("llvm_ad_mono_polarized", "steady", None)
    assert found["sensor"] == 0
    result = CliRunner().invoke(main, ["plan", str(file), "--sensor", "1", "--missed", "0.01"])
    assert result.exit_code == 2 and "the scene has 1" in result.output
    result = CliRunner().invoke(main, ["plan", str(file), "--outputs", "video"])
    assert result.exit_code == 2
