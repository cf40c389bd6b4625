"""Records of many bounces: on the stack where they fit, otherwise in memory, with the same gradients."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch

import torchtransient as tt
from support.walks import limit_records
from tools.small_room import COLOUR, VARIANT, WALL_POSE, make_room, pose
from torchtransient.errors import GradientError

TESTS = Path(__file__).parents[1]
ADJOINT = torch.linspace(0, 1, 24)[None, :, None, None]


def gradients(room, keys, depth=3, spp=16, seed=0):
    room["integrator"]["max_depth"] = depth
    renderer = tt.TransientRenderer(room, keys, spp=spp, temporal_filter="tent", boundary=False)
    for _ in range(2):
        renderer.zero_grad()
        out = renderer(seed=seed)
        (out.transient * ADJOINT).sum().backward()
    return torch.cat([renderer.values[key].grad.reshape(-1) for key in keys]), out.stats.derivatives_recorded


def medium_room():
    room = make_room()
    room["integrator"]["type"] = "transient_prbvolpath"
    inside = {"type": "homogeneous", "albedo": 0.5, "sigma_t": 1.0}
    room["box"] = {"type": "cube", "to_world": pose(0.4, 0, 0.5, 0.3), "bsdf": {"type": "null"}, "interior": inside}
    return room


@pytest.mark.parametrize("what", ["surfaces", pytest.param("media", marks=pytest.mark.slow)])
def test_gradients_are_those_of_records_on_the_stack(monkeypatch, what):
    room, keys = (make_room(), [COLOUR, WALL_POSE]) if what == "surfaces" else (medium_room(), [WALL_POSE])
    expected, recorded = gradients(room, keys)
    assert all("memory" not in said for said in recorded)
    limit_records(monkeypatch, stack=0)
    found, recorded = gradients(room, keys)
    assert recorded and all("global memory" in said for said in recorded)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_launches_are_as_small_as_the_memory_wants(monkeypatch):
    expected, _ = gradients(make_room(), [COLOUR, WALL_POSE], spp=4096)
    limit_records(monkeypatch, stack=0, memory=2**22)
    found, _ = gradients(make_room(), [COLOUR, WALL_POSE], spp=4096)
    assert not torch.equal(found, expected)  # other samples
    torch.testing.assert_close(found, expected, rtol=0.1, atol=0.01)


@pytest.mark.slow
def test_a_thread_with_a_small_stack_records_in_memory():
    """Records of 2000 bounces fit the stack of a process's own thread, not one of half a MiB."""
    found, before = [], threading.stack_size(2**19)
    try:
        thread = threading.Thread(target=lambda: found.append(gradients(make_room(), [COLOUR], depth=2000)))
        thread.start()
        thread.join()
    finally:
        threading.stack_size(before)
    ((small, recorded),) = found
    expected, own = gradients(make_room(), [COLOUR], depth=2000)
    assert all("global memory" in said for said in recorded) and not any("memory" in said for said in own)
    torch.testing.assert_close(small, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_what_no_memory_holds_is_an_error_with_the_bound():
    for depth in (2**25, 2**32 - 2):
        with pytest.raises(GradientError, match=rf"88 bytes a bounce.*max_depth up to \d+ .*, got {depth}\. Set"):
            gradients(make_room(), [COLOUR], depth)
    with pytest.raises(GradientError, match=r"memory for those of 2 paths at once: .*, got 4\."):
        gradients(make_room(), [COLOUR], 10**7)


@pytest.mark.slow
def test_paths_of_twenty_thousand_bounces():
    """Of reflectance 0.999 and emission 1 the radiance is 1 / (1 - 0.999), its derivative the square. In a process of
    its own, which died.
    """
    run = subprocess.run(
        [sys.executable, "-m", "support.deep_paths", VARIANT], cwd=TESTS, capture_output=True, text=True, timeout=300,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(TESTS.parent), str(TESTS)])},
    )  # fmt: skip
    assert run.returncode == 0, f"{run.returncode}: {run.stderr[-2000:]}"
    radiance, slope = (float(number) for number in run.stdout.split()[-2:])
    assert radiance == pytest.approx(1e3, rel=1e-2)
    assert slope == pytest.approx(1e6, rel=2e-2)
