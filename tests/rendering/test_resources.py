"""What the bridge costs: no copies of the cube, no kernels compiled and no graphs kept while training."""

from __future__ import annotations

import gc

import drjit as dr
import pytest
import torch

import torchtransient as tt
from tools.small_room import COLOUR, VARIANT, WALL_POSE, make_room


def resident_bytes(field: str = "VmRSS") -> int:
    """Resident memory of this process; `VmHWM` is its peak."""
    with open("/proc/self/status", encoding="ascii") as status:
        for line in status:
            if line.startswith(field):
                return int(line.split()[1]) * 1024
    raise AssertionError(f"/proc/self/status has no {field}")


def reset_peak() -> None:
    """Start a new measurement of the peak."""
    with open("/proc/self/clear_refs", "w", encoding="ascii") as file:
        file.write("5")


def big_room(bins):
    room = make_room()
    room["sensor"]["film"].update(width=64, height=64, temporal_bins=bins, bin_width_opl=6.0 / bins)
    return room


@pytest.mark.slow
def test_peak_of_render_and_backward_is_one_cube_each():
    cube = 64 * 64 * 4096 * 3 * 4
    scene = tt.load(big_room(4096), variant=VARIANT)
    renderer = tt.TransientRenderer(scene, parameters=[COLOUR], spp=4, freeze=False)
    renderer(seed=0).transient.square().sum().backward()
    dr.flush_malloc_cache()
    gc.collect()
    before = resident_bytes()
    reset_peak()
    out = renderer(seed=0).transient
    assert resident_bytes("VmHWM") - before < 1.25 * cube, "the render took more than one cube"
    cotangent = torch.ones_like(out)
    reset_peak()
    start = resident_bytes()
    torch.autograd.grad(out, renderer.values[COLOUR], cotangent)
    assert resident_bytes("VmHWM") - start < 0.25 * cube, "the backward pass copied the cube"


def training_step(renderer, optimizer, target, seed):
    optimizer.zero_grad()
    loss = (renderer(seed=seed).transient - target).square().sum()
    loss.backward()
    optimizer.step()
    with torch.no_grad():
        renderer.values[COLOUR].clamp_(0, 1)
    return float(loss.detach())


@pytest.fixture
def training(room_scene):
    renderer = tt.TransientRenderer(room_scene, parameters=[COLOUR, WALL_POSE], spp=4)
    target = renderer(seed=0).transient.detach() * 0.8
    optimizer = torch.optim.Adam(renderer.parameters(), lr=1e-3)
    return lambda seed: training_step(renderer, optimizer, target, seed)


def test_nothing_is_compiled_after_three_steps(training):
    """They are traced, recorded and launched; small kernels beside a recording differ where it is launched."""
    for seed in range(10, 13):
        training(seed)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for seed in range(2, 8):
            training(seed)
        history = dr.kernel_history()
    kernels = [entry for entry in history if entry["type"] == dr.KernelType.JIT]
    assert len(kernels) >= 12
    missed = [entry for entry in kernels if not entry["cache_hit"]]
    assert not missed, f"{len(missed)} of {len(kernels)} kernels were compiled during training"


def test_no_graph_is_left_behind(room_scene):
    renderer = tt.TransientRenderer(room_scene, parameters=[COLOUR, WALL_POSE], spp=4)
    empty = len(dr.whos_ad(as_string=True).splitlines())
    for seed in range(3):
        renderer(seed=seed).transient.square().sum().backward()
    assert len(dr.whos_ad(as_string=True).splitlines()) == empty
