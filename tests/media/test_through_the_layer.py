"""Scenes with media in the torch layer: loaded from steady ones and the peer's files; parameters, memory, kernels."""

import gc
import threading
import weakref

import pytest
import torch

import torchtransient as tt
from support.media_scenes import block, camera, clouds, homogeneous
from support.walks import before_each_turn
from torchtransient.errors import SceneError
from torchtransient.scene.variant import active_variant

VARIANT = "llvm_ad_rgb"
AXIS = tt.TimeAxis(start_opl=0.0, bin_width_opl=0.2, num_bins=100)

def steady_scene(integrator, **objects):
    node = {"integrator": {"type": integrator, "max_depth": 8}} if integrator else {}
    return tt.load({"type": "scene", **node, "sensor": camera(transient=False), **objects}, variant=VARIANT)


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
        for seed in range(3):
            step(seed)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            for seed in range(3, 6):
                step(seed)
            history = dr.kernel_history()
        assert len(dr.whos_ad(as_string=True).splitlines()) == empty
    kernels = [entry for entry in history if entry["type"] == dr.KernelType.JIT]
    assert len(kernels) >= 6
    assert all(entry["cache_hit"] for entry in kernels)


@pytest.mark.slow
def test_dropped_scenes_stay_until_a_kernel_is_traced(monkeypatch):
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
        raise ZeroDivisionError

    before_each_turn(monkeypatch, drop)
    thresholds = gc.get_threshold()
    gc.set_threshold(10, 1, 1)
    try:
        with pytest.raises(SceneError, match="ZeroDivisionError"):
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
