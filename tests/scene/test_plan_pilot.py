"""Decisions of a plan by tracing: depth and window hold the promised light and no more."""

import json
import time

import mitsuba as mi
import numpy as np
import pytest
import torch
from click.testing import CliRunner

import torchtransient as tt
from support import plan_scenes
from support.marks import long
from torchtransient.accuracy import two_sample_z_test
from torchtransient.cli.main import main
from torchtransient.errors import ArgumentError, SceneError
from torchtransient.rendering.films import Histogram
from torchtransient.scene.edits import BuildOptions
from torchtransient.scene.pilot import Arrivals, axis_over
from torchtransient.scene.variant import active_variant

VARIANT = "llvm_ad_mono"


def pilot_of(scene, seed=0):
    """The events of a pilot run of a scene."""
    loaded = tt.load(scene, variant=VARIANT)
    with active_variant(VARIANT):
        from torchtransient.plugins.integrators.pilot import pilot_events

        options = BuildOptions(film=Histogram(tt.TimeAxis(0.0, 1.0, 1)), transient=True, merge=True)
        built = loaded.built(options).scene
        return pilot_events(built, built.integrator(), 0, seed=seed, pixels=256, paths=8192)


def means(renderer, count=8, **settings):
    """Image means over all channels of independent renders (K,)."""
    with torch.no_grad(), active_variant(renderer.scene.variant):
        steady = [renderer(seed=100 + k, **settings).steady for k in range(count)]
    # Of Stokes vectors the first component is the intensity.
    return np.array([float((s[0] if s.ndim == 4 else s).mean()) for s in steady])


# ------------------------------------------------------------------------------------------------------- the events


def fog_room():
    fog = {"type": "homogeneous", "sigma_t": 2.0, "albedo": 0.9}
    ball = {"type": "sphere", "center": [0, 0, 1.5], "bsdf": {"type": "null"}, "interior": fog}
    return plan_scenes.grey_room(ball=ball)


@pytest.mark.slow
@pytest.mark.parametrize("scene", long(["plates", "fog"], ["fog"]))
def test_events_have_the_depth_at_which_a_render_gains_them(scene):
    """Renders of depth 1, 2, 3, ... differ by the events of that depth."""
    description = tt.scenes.parallel_plates(resolution=2) if scene == "plates" else fog_room()
    description["integrator"]["type"] = "transient_path" if scene == "plates" else "transient_prbvolpath"
    runs = [pilot_of(description, seed=k) for k in range(6)]
    loaded = tt.load(description, variant=VARIANT)
    for depth in (2, 4):
        pilots = [float(e.energy[e.depth <= depth].sum()) for e in runs]
        axis = tt.TimeAxis(0.0, 1000.0, 1)
        renders = means(tt.TransientRenderer(loaded, max_depth=depth, time_axis=axis), spp=1024)
        assert two_sample_z_test(np.array(pilots), renders).passed


@pytest.mark.slow
def test_events_arrive_when_a_render_says():
    description = tt.scenes.integrating_sphere(max_depth=20)
    axis = tt.TimeAxis(0.0, 2.5, 6)
    runs = []
    for k in range(6):
        e = pilot_of(description, seed=k)
        kept = e.depth <= 20
        runs.append(np.histogram(e.opl[kept], bins=axis.edges_opl.numpy(), weights=e.energy[kept])[0])
    renderer = tt.TransientRenderer(tt.load(description, variant=VARIANT), time_axis=axis)
    with torch.no_grad():
        renders = [renderer(seed=k, spp=1024).transient.mean((0, 2, 3)).numpy() for k in range(6)]
    assert two_sample_z_test(np.array(runs), np.array(renders)).passed


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
@pytest.mark.parametrize("bounces", long([5, 12], [12]))
def test_a_chain_of_mirrors_is_followed_to_its_end(bounces):
    scene = plan_scenes.mirror_chain(bounces)
    axis = tt.TimeAxis(0.0, 100.0, 1)
    default = tt.TransientRenderer(tt.load(scene, variant=VARIANT), time_axis=axis)
    assert (means(default, 1)[0] > 0) == (bounces + 1 <= 6)
    plan = tt.plan(scene)
    assert plan.max_depth == bounces + 1
    assert any(f"at the scene's own 6 it would be {1 if bounces > 5 else 0}" in line for line in plan.reasons) == (
        bounces > 5
    )
    output = plan.renderer()(seed=0, spp=64)
    assert float(output.steady.mean()) > 0
    length = (bounces + 1.0 - 1.0) * np.sqrt(2)  # half a crossing at both ends
    peak = float(plan.time_axis.centers_opl[int(output.transient.sum((0, 2, 3)).argmax())])
    assert abs(peak - length) < max(plan.time_axis.bin_width_opl, 0.02)


def test_deep_light_in_a_corner_counts():
    """A chain of mirrors that fills one block of the image in 64 and is dim in the whole of it."""
    events = Arrivals(
        _events(
            opl=np.concatenate([np.full(6400, 8.0), np.full(100, 20.0)]),
            energy=np.concatenate([np.full(6400, 1.0), np.full(100, 0.05)]),
            depth=np.concatenate([np.full(6400, 2), np.full(100, 15)]),
            pixel=np.concatenate([np.repeat(np.arange(64), 100), np.zeros(100, dtype=int)]),
        )
    )
    assert events.share(events.depth > 2)[0] < 1e-3
    assert events.enough_depth(1e-3) == 15
    assert events.window(15, 1e-3) == (8.0, 20.0)
    # The same light spread over the image may be left out.
    spread = replace_pixels(events, np.concatenate([np.repeat(np.arange(64), 100), np.arange(100) % 64]))
    assert spread.enough_depth(1e-3) == 2
    assert spread.window(2, 1e-3) == (8.0, 8.0)


class _events:  # noqa: N801 (stands in for the plugin's record)
    def __init__(self, opl, energy, depth, pixel):
        self.opl, self.energy, self.depth, self.pixel = opl, energy, depth, pixel
        self.paths, self.size = len(opl), (8, 8)
        self.path, self.rate = np.arange(len(opl)), np.zeros(len(opl))


def replace_pixels(events, pixel):
    return Arrivals(_events(events.opl, events.energy, events.depth, pixel))


# ----------------------------------------------------------------------------------------------------------- window


WINDOWS = ["furnace", "cornell_box", "glass_slab_before_wall", "moving_wall"]


@pytest.mark.parametrize("name", long(WINDOWS, WINDOWS[3:]))
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


def test_axes_hold_both_ends():
    generator = np.random.default_rng(5)
    for _ in range(300):
        first = generator.uniform(-1, 1) * 10.0 ** generator.integers(-3, 4)
        last = first + generator.uniform(0, 1) * 10.0 ** generator.integers(-6, 4)
        width = float(10.0 ** generator.uniform(-3, 1)) if generator.random() < 0.5 else None
        bins = int(generator.integers(1, 50)) if width is None and generator.random() < 0.5 else None
        axis = axis_over(first, last, width, bins)
        assert axis.start_opl <= first
        assert last < axis.end_opl
        assert bins is None or axis.num_bins == bins
        assert width is None or axis.bin_width_opl == pytest.approx(width, rel=1e-9)
        if width is None and bins is None:
            assert axis.num_bins <= 302


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


def test_the_sensor_that_was_planned_for():
    far = plan_scenes.grey_room()["sensor"]
    far["to_world"] = plan_scenes.look_at([0.0, 0.0, 9.0], [0.0, 0.0, 0.0])
    scene = plan_scenes.grey_room(far=far)
    started = time.perf_counter()
    near, distant = tt.plan(scene), tt.plan(scene, sensor=1)
    assert 0 < near.pilot.seconds < time.perf_counter() - started
    assert near.time_axis.start_opl <= near.pilot.first_opl < near.time_axis.edges_opl[1] < near.pilot.last_opl
    assert distant.time_axis.start_opl == pytest.approx(near.time_axis.start_opl + 5.0, abs=0.1)
    output = distant.renderer()(seed=0)
    assert float(output.transient.sum()) == pytest.approx(float(output.steady.sum()), rel=1e-3)
    with pytest.raises(ArgumentError, match="the scene has 2"):
        tt.plan(scene, sensor=2)


def test_a_dark_scene_says_so():
    scene = plan_scenes.grey_room(light={"type": "point", "position": [0.0, 0.0, -4.0], "intensity": 1.0})
    plan = tt.plan(scene)
    assert plan.time_axis == tt.TimeAxis(7.0, 0.05, 64)
    assert any("no light" in line for line in plan.reasons)
    assert json.loads(json.dumps(plan.to_dict(), allow_nan=False))["pilot"]["relative_error"] is None
    scene["sensor"]["film"] = {"type": "hdrfilm", "width": 4, "height": 4}
    with pytest.raises(SceneError, match="no light"):
        tt.plan(scene)


# ------------------------------------------------------------------------- the same numbers with the cheapest means

SCENES = {
    "furnace": {"resolution": 4},
    "integrating_sphere": {"resolution": 4},
    "parallel_plates": {"resolution": 4},
    "cornell_box": {"resolution": 4},
    "etalon_slab": {"resolution": 4},
    "glass_slab_before_wall": {"resolution": 4},
    "light_over_plane": {},
    "moving_wall": {"resolution": 4},
}


def test_every_scene_of_the_library_is_listed():
    functions = {
        n
        for n, f in vars(tt.scenes).items()
        if callable(f) and f.__module__.startswith("torchtransient.scenes") and not f.__module__.endswith("transforms")
    }
    # The bottle needs a place for its mesh and holds a medium: it has a test of its own. What is hidden behind a corner
    # is no scene yet.
    parts = {"relay_wall", "bounds", "triangle_mesh"}
    assert {name for name in functions if not name.startswith("nlos_")} - parts == {*SCENES, "milk_bottle"}


@pytest.mark.slow
def test_the_plan_of_the_bottle_sees_its_milk(tmp_path):
    description = tt.scenes.milk_bottle(tmp_path / "bottle.ply", resolution=(5, 8), spp=64)
    plan = tt.plan(description, max_depth="scene", time_axis="scene", pilot=False)
    assert (plan.integrator, plan.variant) == ("transient_prbvolpath", "llvm_ad_rgb")
    plain = tt.TransientRenderer(tt.load(description, variant="llvm_ad_rgb"))
    torch.testing.assert_close(plan.renderer()(seed=3).transient, plain(seed=3).transient, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if n > 0 else []) for n, name in enumerate(SCENES)]
)
def test_a_plan_renders_what_the_plain_integrator_renders(name):
    """Same depth and window, other variant and integrator: the same image mean."""
    description = getattr(tt.scenes, name)(**SCENES[name])
    plan = tt.plan(description, max_depth="scene", time_axis="scene", pilot=False)
    assert plan.integrator == "transient_path"
    assert not plan.variant.endswith("polarized")
    plain = tt.TransientRenderer(tt.load(description, variant="llvm_ad_rgb"))
    cheap, full = means(plan.renderer(), spp=256), means(plain, spp=256)
    assert two_sample_z_test(cheap, full, rounding=1e-5 * full.mean()).passed


EXTRAS = {
    "transient_prbvolpath": {"integrator": "transient_prbvolpath"},
    "llvm_ad_mono_polarized": {"variant": "llvm_ad_mono_polarized"},
    "llvm_ad_spectral": {"variant": "llvm_ad_spectral"},
}


@pytest.mark.slow
@pytest.mark.parametrize("extra", EXTRAS)
def test_an_effect_that_is_not_there_changes_nothing(extra):
    """The plan leaves out what the scene does not call for; forcing it gives the same image mean."""
    scene = tt.scenes.parallel_plates(resolution=2)
    settings = {"max_depth": 6, "time_axis": "scene", "pilot": False}
    cheap, forced = tt.plan(scene, **settings), tt.plan(scene, **settings, **EXTRAS[extra])
    assert extra not in (cheap.variant, cheap.integrator)
    assert extra in (forced.variant, forced.integrator)
    heavy = means(forced.renderer(), spp=256)
    light = means(cheap.renderer(), spp=256)
    assert two_sample_z_test(light, heavy, rounding=1e-3 * light.mean() if "spectral" in extra else 1e-6).passed


# ------------------------------------------------------------------------------------------------------- other films


@pytest.mark.slow
def test_steady_outputs():
    plan = tt.plan(tt.scenes.cornell_box(8), ("steady",), max_depth="scene", parameters=["red-wall.to_world"])
    assert (plan.film, plan.temporal_filter) == ("steady", "tent")
    assert plan.time_axis.num_bins == 1
    renderer = plan.renderer(spp=16)
    steady = renderer(seed=0).steady
    box = tt.load(tt.scenes.cornell_box(8), variant="llvm_ad_rgb")
    usual = tt.TransientRenderer(box, parameters=["red-wall.to_world"], spp=16)
    expected = usual(seed=0).steady
    assert torch.allclose(steady, expected, rtol=1e-4, atol=1e-6)
    steady.sum().backward()
    assert float(renderer.values["red-wall.to_world"].grad.abs().sum()) > 0


def test_phasor_outputs():
    frequencies = tt.FrequencyAxis((0.0, 1.0))
    plan = tt.plan(tt.scenes.moving_wall(), ("phasor", "steady"), frequencies=frequencies)
    assert (plan.film, plan.time_axis, plan.max_depth) == ("phasor", None, 2)
    output = plan.renderer()(seed=0, spp=64)
    assert output.frequencies == frequencies
    assert torch.allclose(output.phasor[:, 0].real, output.steady, rtol=1e-4)


@pytest.mark.slow
def test_gated_outputs():
    """Light outside of the gates asks for no depth."""
    scene = tt.scenes.integrating_sphere(reflectance=0.8)
    gates = [tt.Gate.rectangular(3.0, 5.0), tt.Gate.gaussian(7.0, 0.5)]
    early = tt.plan(scene, ("gates",), gates=gates, tail=1e-2)
    late = tt.plan(scene, ("gates",), gates=[gate.shifted(20.0) for gate in gates], tail=1e-2)
    assert (early.film, early.time_axis, early.temporal_filter) == ("gated", None, "")
    assert early.max_depth < late.max_depth
    output = early.renderer()(seed=0, spp=4)
    assert output.gates == tuple(gates)
    assert output.gated.shape[1] == 2 and output.transient is None
    deep = tt.plan(scene, ("gates",), gates=gates, max_depth=60)
    found, full = means(early.renderer(), spp=512), means(deep.renderer(), spp=512)
    # The steady image of a gated film is the sum over its gates; a hundredth of it was given up.
    assert two_sample_z_test(found, full, rounding=1e-2 * full.mean()).passed
    own = tt.load(scene, variant=VARIANT)
    assert tt.TransientRenderer(own, effects=early, time_axis=tt.TimeAxis(0.0, 1.0, 9)).gates is None
    assert tt.TransientRenderer(own, effects=early, gates=gates[:1]).gates == (gates[0],)


def test_stokes_outputs():
    plan = tt.plan(tt.scenes.glass_slab_before_wall(resolution=2), ("transient", "stokes"))
    assert plan.variant == "llvm_ad_mono_polarized"
    assert plan.pilot.variant == "llvm_ad_mono"


@pytest.mark.slow
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


# -------------------------------------------------------------------------------------------------------- not slower


def operations(renderer) -> list[int]:
    """Number of operations of every kernel that a render launches."""
    import drjit as dr

    with torch.no_grad(), active_variant(renderer.scene.variant), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        renderer(seed=0, spp=4)
        return [entry["operation_count"] for entry in dr.kernel_history([dr.KernelType.JIT])]


@pytest.mark.slow
def test_a_planned_render_runs_the_plain_integrator_s_kernels():
    """Nothing is added to a scene without effects, not even by the integrator for media."""
    mi.set_variant("llvm_ad_rgb")
    scene = tt.load(tt.scenes.cornell_box(8), variant="llvm_ad_rgb")
    settings = {"max_depth": 7, "time_axis": "scene", "pilot": False}
    plain = operations(tt.TransientRenderer(scene, max_depth=7))
    assert len(plain) >= 1
    assert operations(tt.plan(scene, **settings).renderer()) == plain
    assert operations(tt.plan(scene, integrator="transient_prbvolpath", **settings).renderer()) == plain
