"""Records of many bounces: on the stack where they fit, otherwise in memory, with the same gradients."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import COLOUR, VARIANT, WALL_POSE, make_room, pose
from torchtransient.errors import GradientError
from torchtransient.plugins.transport import record as record_room

TESTS = Path(__file__).parents[1]
ADJOINT = torch.linspace(0, 1, 24)[None, :, None, None]


def gradients(room, keys, depth=3, spp=16, seed=0):
    room["integrator"]["max_depth"] = depth
    renderer = tt.TransientRenderer(room, keys, spp=spp, temporal_filter="tent")
    for _ in range(2):
        renderer.zero_grad()
        out = renderer(seed=seed)
        (out.transient * ADJOINT).sum().backward()
    return torch.cat([renderer.values[key].grad.reshape(-1) for key in keys]), out.stats.derivatives_recorded


def tangent(room):
    renderer = tt.TransientRenderer(room, [COLOUR, WALL_POSE], spp=16, temporal_filter="tent")
    start = renderer.values[WALL_POSE].detach().clone()
    return torch.func.jvp(lambda x: renderer({WALL_POSE: x}, seed=0).transient, (start,), (torch.ones(4, 4),))[1]


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
    monkeypatch.setattr(record_room, "SHARE", 1e-9)
    found, recorded = gradients(room, keys)
    assert recorded and all("global memory" in said for said in recorded)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_tangents_are_those_of_records_on_the_stack(monkeypatch):
    expected = tangent(make_room())
    monkeypatch.setattr(record_room, "SHARE", 1e-9)
    torch.testing.assert_close(tangent(make_room()), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_launches_are_as_small_as_the_memory_wants(monkeypatch):
    expected, _ = gradients(make_room(), [COLOUR, WALL_POSE], spp=4096)
    monkeypatch.setattr(record_room, "SHARE", 1e-9)
    monkeypatch.setattr(record_room, "MEMORY", 2**22)
    found, _ = gradients(make_room(), [COLOUR, WALL_POSE], spp=4096)
    assert not torch.equal(found, expected)  # other samples
    torch.testing.assert_close(found, expected, rtol=0.1, atol=0.01)


@pytest.mark.slow
def test_phasors_do_without_a_list_of_arrivals(monkeypatch):
    def found():
        renderer = tt.TransientRenderer(make_room(), [COLOUR], spp=4, frequencies=[0.5, 1.0])
        renderer(seed=0).phasor.abs().square().sum().backward()
        return renderer.values[COLOUR].grad

    expected = found()
    # The record of four vertices fits, the list of all arrivals beside it does not.
    monkeypatch.setattr(record_room, "room_of_path", lambda: 4 * 100)
    torch.testing.assert_close(found(), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_what_no_memory_holds_is_an_error_with_the_bound():
    for depth in (2**25, 2**32 - 2):
        with pytest.raises(GradientError, match=rf"88 bytes a bounce.*max_depth up to \d+ .*, got {depth}\. Set"):
            gradients(make_room(), [COLOUR], depth)
    with pytest.raises(GradientError, match=r"memory for those of 2 paths at once: .*, got 4\."):
        gradients(make_room(), [COLOUR], 10**7)


def test_stacks_of_python_threads_are_asked_for():
    found, before = [], threading.stack_size(2**19)
    try:
        thread = threading.Thread(target=lambda: found.append(record_room.room_of_path()))
        thread.start()
        thread.join()
    finally:
        threading.stack_size(before)
    assert 2**10 < found[0] <= 2**19 < 16 * record_room.room_of_path()


@pytest.mark.slow
@pytest.mark.parametrize("variant", [VARIANT, "llvm_ad_mono"])
def test_paths_of_twenty_thousand_bounces(variant):
    """Of reflectance 0.999 and emission 1 the radiance is 1 / (1 - 0.999), its derivative the square. In a process of
    its own, which died.
    """
    run = subprocess.run(
        [sys.executable, "-m", "support.deep_paths", variant], cwd=TESTS, capture_output=True, text=True, timeout=300,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(TESTS.parent), str(TESTS)])},
    )  # fmt: skip
    assert run.returncode == 0, f"{run.returncode}: {run.stderr[-2000:]}"
    radiance, slope = (float(number) for number in run.stdout.split()[-2:])
    assert radiance == pytest.approx(1e3, rel=1e-2)
    assert slope == pytest.approx(1e6, rel=2e-2)


# ------------------------------------------------------------------------------------------------- arrays in memory


def test_bytes_of_what_is_recorded():
    mi.set_variant("llvm_ad_rgb")
    assert [record_room.bytes_of(kind) for kind in (mi.Float, mi.Float64, mi.UInt32)] == [4, 8, 4]
    assert [record_room.bytes_of(kind) for kind in (mi.Point2f, mi.Vector3f, mi.Spectrum)] == [8, 12, 12]
    mi.set_variant("llvm_ad_mono_polarized")
    assert record_room.bytes_of(mi.Spectrum) == 4 * 4 * 4


@pytest.mark.parametrize("kind", ["Float64", "Vector3f", "UInt32"])
def test_arrays_of_all_lanes_in_memory(kind):
    """Every lane has its own entries; those of idle lanes stay as they are, and are read as zero."""
    mi.set_variant("llvm_ad_rgb")
    kind = getattr(mi, kind)
    array = record_room.GlobalArray(kind, 4, 3)
    assert dr.width(array.numbers) == 4 * 3 * (3 if kind is mi.Vector3f else 1)
    everywhere = mi.Bool([True] * 3)
    for index in range(4):
        array.write(kind(0), index, everywhere)
    array.write(kind(mi.Float([5, 6, 7])), mi.UInt32([0, 2, 3]), everywhere)
    array.write(kind(mi.Float([50, 60, 70])), mi.UInt32([1, 2, 0]), mi.Bool([True, False, True]))
    rows = np.array([np.atleast_2d(np.array(array.read(index, everywhere)))[0] for index in range(4)])
    assert rows.tolist() == [[5, 0, 70], [50, 0, 0], [0, 6, 0], [0, 0, 7]]
    found = np.atleast_2d(np.array(array.read(mi.UInt32([0, 2, 3]), mi.Bool([True, False, True]))))[0]
    assert found.tolist() == [5, 0, 7]


def test_room_of_other_devices_and_systems(monkeypatch):
    monkeypatch.setattr(record_room.mi, "variant", lambda: "cuda_ad_rgb")
    assert record_room.room_of_path() == record_room.CUDA_ROOM
    monkeypatch.setattr(record_room.mi, "variant", lambda: "llvm_ad_rgb")
    monkeypatch.setattr(record_room, "_lanes_of_vector", lambda: 8)
    for platform, stack in (("darwin", record_room._STACKS["darwin"]), ("plan9", record_room._STACK_UNKNOWN)):
        monkeypatch.setattr(record_room.sys, "platform", platform)
        assert record_room.room_of_path() == int(record_room.SHARE * stack) // 8


def test_where_a_record_lies(monkeypatch):
    """On the stack up to its room, in memory up to as much as all paths may take, at most so many at once."""
    monkeypatch.setattr(record_room, "room_of_path", lambda: 1000)
    monkeypatch.setattr(record_room, "MEMORY", 2300)
    monkeypatch.setattr(record_room.RecordLayout, "__init__", lambda layout, context: None)
    monkeypatch.setattr(record_room.RecordLayout, "bytes_of_vertex", lambda layout: 100)

    def of(vertices):
        return record_room.record_room(SimpleNamespace(max_depth=vertices - 1))

    assert of(10) == record_room.RecordRoom(in_memory=False, lanes=None, room=1000)
    assert of(11) == record_room.RecordRoom(in_memory=True, lanes=2, room=1000)
    assert of(23) == record_room.RecordRoom(in_memory=True, lanes=1, room=1000)
    with pytest.raises(GradientError, match=r"100 bytes a bounce.*max_depth up to 22 .*, got 23\."):
        of(24)
