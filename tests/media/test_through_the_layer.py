"""Scenes with media in the torch layer: loaded from steady ones and the peer's files, with their parameters."""

import gc
import threading
import weakref
from contextlib import nullcontext

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.media_scenes import block, camera, clouds, homogeneous
from support.walks import before_each_turn
from torchtransient.errors import SceneError
from torchtransient.scene.variant import active_variant

VARIANT = "llvm_ad_rgb"
AXIS = tt.TimeAxis(start_opl=0.0, bin_width_opl=0.2, num_bins=100)

# A room with two blocks of medium, as the peer's examples describe it.
XML = """<scene version="3.0.0">
  <default name="res" value="8"/> <default name="max_depth" value="12"/>
  <integrator type="transient_prbvolpath">
    <integer name="max_depth" value="$max_depth"/> <string name="temporal_filter" value="box"/>
    <float name="gaussian_stddev" value="2.0"/> <boolean name="camera_unwarp" value="false"/>
  </integrator>
  <sensor type="perspective">
    <float name="fov" value="45"/>
    <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="transient_hdr_film">
      <integer name="width" value="$res"/> <integer name="height" value="$res"/>
      <integer name="temporal_bins" value="100"/> <float name="start_opl" value="0"/>
      <float name="bin_width_opl" value="0.2"/> <rfilter type="box"/>
    </film>
  </sensor>
  <shape type="rectangle">
    <transform name="to_world"><scale value="3"/><translate z="-2"/></transform>
    <bsdf type="diffuse"/>
  </shape>
  <shape type="rectangle">
    <transform name="to_world"><rotate x="1" angle="140"/><translate y="1.6" z="2.5"/></transform>
    <emitter type="area"><rgb name="radiance" value="5, 4, 3"/></emitter>
  </shape>
  <shape type="cube" id="block">
    <bsdf type="null"/>
    <medium type="homogeneous" name="interior">
      <rgb name="albedo" value="0.99, 0.4, 0.46"/> <float name="sigma_t" value="0.8"/>
      <phase type="hg"><float name="g" value="0.1"/></phase>
    </medium>
  </shape>
</scene>"""


def steady_scene(integrator, **objects):
    node = {"integrator": {"type": integrator, "max_depth": 8}} if integrator else {}
    return tt.load({"type": "scene", **node, "sensor": camera(transient=False), **objects}, variant=VARIANT)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["prbvolpath", None])
def test_steady_scenes_with_media(integrator):
    """Whatever integrator a steady scene with media names, its light walks through them."""
    scene = steady_scene(integrator, **block(homogeneous(1.0, 0.8)))
    out = tt.TransientRenderer(scene, parameters=[], time_axis=AXIS, spp=64)(seed=0)
    assert out.stats.integrator == "transient_prbvolpath"
    torch.testing.assert_close(out.transient.sum(1), out.steady, rtol=2e-3, atol=1e-4)


@pytest.mark.slow
def test_peer_scene_file(tmp_path):
    path = tmp_path / "volumetric.xml"
    path.write_text(XML)
    out = tt.TransientRenderer(tt.load(path, variant=VARIANT, res=4), parameters=[], spp=64)(seed=0)
    assert out.stats.integrator == "transient_prbvolpath" and out.transient.shape == (3, 100, 4, 4)
    assert out.steady.min() > 0


def test_parameters_of_media():
    scene = steady_scene("volpath", **block(clouds()), fog=homogeneous())
    table = scene.parameters()
    prefix = "block.interior_medium."
    for key, shape in (("sigma_t.data", (4, 4, 4, 1)), ("albedo.value.value", ())):
        assert table[prefix + key].differentiable and table[prefix + key].shape == shape
        assert not table[prefix + key].moves_path_length
    assert not table[prefix + "scale"].differentiable


@pytest.mark.slow
def test_gradients_arrive_in_torch():
    """A step against the gradient lowers a loss: grids, albedo, phase function and index together."""
    objects = block(clouds())
    glass = {"type": "roughdielectric", "int_ior": 1.2, "alpha": 0.3}
    objects["ball"] = {
        "type": "sphere", "center": [1.6, 0, 0], "radius": 0.5, "bsdf": glass, "interior": homogeneous(1.0, 0.8, 0.3),
    }  # fmt: skip
    keys = [
        "block.interior_medium.sigma_t.data",
        "ball.interior_medium.albedo.value.value",
        "ball.interior_medium.phase_function.g",
        "ball.bsdf.eta",
    ]
    scene = steady_scene("prbvolpath", **objects)
    renderer = tt.TransientRenderer(scene, parameters=keys, time_axis=AXIS, spp=256)
    out = renderer(seed=0)
    weights = torch.sin(torch.as_tensor(AXIS.centers_opl, dtype=torch.float32))[:, None, None]
    loss = (out.transient * weights).sum()
    loss.backward()
    values = {key: renderer.values[key].detach() for key in keys}
    gradients = {key: renderer.values[key].grad for key in keys}
    for key in keys:
        assert torch.isfinite(gradients[key]).all() and gradients[key].abs().sum() > 0, key
    norm = sum((g**2).sum() for g in gradients.values())
    step = {key: values[key] - 5e-2 * loss.detach().abs() / norm * gradients[key] for key in keys}
    lower = (renderer(step, seed=0).transient * weights).sum()
    assert lower < loss
    assert np.isfinite(lower.item())


@pytest.mark.slow
def test_no_kernels_are_compiled_while_training():
    """Nor when a shape moves, which changes the size of the scene, and nothing of Dr.Jit's graph stays behind."""
    objects = block(clouds())
    keys = ["block.interior_medium.sigma_t.data", "floor.to_world", "block.interior_medium.albedo.value.value"]
    renderer = tt.TransientRenderer(steady_scene("volpath", **objects), parameters=keys, time_axis=AXIS, spp=4)
    optimizer = torch.optim.Adam(renderer.parameters(), lr=1e-3)

    def step(seed):
        optimizer.zero_grad()
        renderer(seed=seed).transient.square().sum().backward()
        optimizer.step()

    with active_variant(VARIANT):
        import drjit as dr

        empty = len(dr.whos_ad(as_string=True).splitlines())
        step(0)
        step(1)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            for seed in range(2, 5):
                step(seed)
            history = dr.kernel_history()
        assert len(dr.whos_ad(as_string=True).splitlines()) == empty
    kernels = [entry for entry in history if entry["type"] == dr.KernelType.JIT]
    assert len(kernels) >= 6
    assert all(entry["cache_hit"] for entry in kernels)


@pytest.mark.slow
@pytest.mark.parametrize("explode", [False, True])
def test_dropped_scenes_stay_until_a_kernel_is_traced(monkeypatch, explode):
    """A scene freed between two method calls of one trace makes Dr.Jit write a function twice, and LLVM abort.

    Scenes that hang in reference cycles are left to the collector, which runs whenever enough objects were made.
    """
    class Cycle:
        pass

    def dropped():
        cycle = Cycle()
        cycle.scene, cycle.me = tt.load({"type": "scene"}, variant=VARIANT), cycle
        return weakref.ref(cycle)

    key = "block.interior_medium.albedo.value.value"
    scene = steady_scene("volpath", **block(homogeneous(1.0, 0.8)))
    renderer = tt.TransientRenderer(scene, parameters=[key], time_axis=AXIS, spp=2)
    alive = []

    def drop():
        gone = dropped()
        _ = [[] for _ in range(1000)]  # with the threshold below the collector would run many times
        alive.append(gone() is not None)
        if explode:
            raise ZeroDivisionError

    before_each_turn(monkeypatch, drop)
    thresholds = gc.get_threshold()
    gc.set_threshold(10, 1, 1)
    try:
        with pytest.raises(SceneError, match="ZeroDivisionError") if explode else nullcontext():
            renderer(seed=0).transient.sum().backward()
        assert gc.isenabled()
    finally:
        gc.set_threshold(*thresholds)
    assert alive and all(alive)


def integrator_of(renderer):
    """A weak reference to an object that Mitsuba's scene owns."""
    (built,) = renderer.scene._builds.values()
    return weakref.ref(built.scene.integrator())


@pytest.mark.slow
def test_scenes_are_freed_at_once():
    """Not only when the collector runs: data sets are rendered scene by scene."""
    key = "block.interior_medium.albedo.value.value"
    renderer = tt.TransientRenderer(
        steady_scene("volpath", **block(homogeneous(1.0, 0.8))), parameters=[key], time_axis=AXIS, spp=2
    )
    out = renderer(seed=0)
    out.transient.sum().backward()
    gone = integrator_of(renderer)
    gc.disable()
    try:
        del renderer, out
        assert gone() is None
    finally:
        gc.enable()


@pytest.mark.slow
def test_a_scene_dropped_by_another_thread_waits_for_the_trace(monkeypatch):
    def renderer():
        scene = steady_scene("volpath", **block(homogeneous(1.0, 0.8)))
        return tt.TransientRenderer(scene, parameters=[], time_axis=AXIS, spp=3)

    others = [renderer()]
    others[0](seed=0)
    gone, mine = integrator_of(others[0]), renderer()
    alive = []

    def drop():
        if others:
            thread = threading.Thread(target=others.clear)
            thread.start()
            thread.join()
        alive.append(gone() is not None)

    before_each_turn(monkeypatch, drop)
    mine(seed=0)
    assert alive and all(alive)
    assert gone() is None
