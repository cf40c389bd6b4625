"""Runs of thousands of steps: memory stays, numbers stay."""

from __future__ import annotations

import gc
import threading
from pathlib import Path

import pytest
import torch
import tqdm

import torchtransient as tt
from support.call_orders import CASES, Calls

pytestmark = [pytest.mark.soak, pytest.mark.filterwarnings("ignore")]

STEPS = 10_000
ROUNDS = 300
GROWTH = 0.01


def resident() -> int:
    """Bytes of memory that this process has."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def test_ten_thousand_steps_on_a_schedule_of_scenes():
    """Scenes, samples and learning rates change as in a training run; a scene is loaded anew every 500 steps."""
    Calls.prepare()
    names, renderers, seen = ["colours", "phasors", "ready"], {}, []
    for step in tqdm.trange(STEPS, disable=None):
        name = names[step // 500 % len(names)]
        if step % 500 == 0:
            renderers.clear()
            gc.collect()
            renderers[name] = CASES[name].renderer()
            optimizer = torch.optim.Adam(renderers[name].parameters(), lr=1e-3)
        renderer = renderers[name]
        optimizer.zero_grad()
        out = renderer(seed=step, spp=(2, 4, 8)[step // 100 % 3])
        image = out.transient if out.transient is not None else out.phasor.abs()
        image.square().sum().backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in renderer.parameters())
        optimizer.step()
        if step % 500 == 499:
            seen.append(resident())
            if name == "colours":
                del image, out
                fresh = Calls()
                fresh.backward(name, 1, 0)
    # Kernels and pools of the first rounds are there to stay; what the second half has more than the end of the first
    # is growth.
    half = len(seen) // 2
    assert max(seen[half:]) < max(seen[:half]) * (1 + GROWTH), [n >> 20 for n in seen]


def test_four_threads_with_two_variants():
    Calls.prepare()
    calls, errors = Calls(), []
    names = ["colours", "poses", "phasors", "fog"]
    for name in names:
        calls.load(name)

    def work(name: str) -> None:
        try:
            for n in range(ROUNDS):
                calls.backward(name, n % 3, 0)
        except BaseException as error:  # noqa: BLE001 - raised by the thread that has started this one
            errors.append(error)

    workers = [threading.Thread(target=work, args=(name,)) for name in names]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(3600)
    assert not any(worker.is_alive() for worker in workers)
    if errors:
        raise errors[0]
    assert tt.threads().drjit >= 1
