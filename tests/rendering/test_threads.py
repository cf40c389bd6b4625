"""``tt.threads``: torch's and Dr.Jit's threads set together, and numbers that do not depend on them."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap

import drjit as dr
import pytest
import torch

import torchtransient as tt

VARIANT = "llvm_ad_rgb"


@pytest.fixture(autouse=True)
def counts_come_back():
    before = torch.get_num_threads(), dr.thread_count()
    yield
    dr.set_thread_count(before[1])
    torch.set_num_threads(before[0])


def run(script, *, code=0):
    """What a fresh interpreter prints. Numbers of threads are the script's alone."""
    own = {name: value for name, value in os.environ.items() if name not in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")}
    command = [sys.executable, "-c", textwrap.dedent(script)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False, env=own)
    assert done.returncode == code, f"exit code {done.returncode}: {done.stderr[-3000:]}"
    return done.stdout.split()


def counts():
    now = tt.threads()
    assert (now.torch, now.drjit) == (torch.get_num_threads(), dr.thread_count())
    return now.torch, now.drjit


def test_counts_are_set_together_and_told():
    found = tt.threads(3)
    assert (found.torch, found.drjit) == counts() == (3, 3)
    tt.threads(1)
    # Asking changes nothing, whatever each of them is set to.
    torch.set_num_threads(2)
    assert counts() == (2, 1) and repr(tt.threads()) == "Threads(torch=2, drjit=1)"


def test_a_context_puts_back_what_was():
    torch.set_num_threads(2)
    dr.set_thread_count(3)
    with tt.threads(1):
        assert counts() == (1, 1)
        with tt.threads(4):
            assert counts() == (4, 4)
        assert counts() == (1, 1)
    assert counts() == (2, 3)
    with pytest.raises(KeyError), tt.threads(1):
        raise KeyError
    assert counts() == (2, 3)
    with tt.threads():
        tt.threads(1)
    assert counts() == (2, 3)


NUMBERS = """
    import torch
    import torchtransient as tt

    KEY = "red.reflectance.value"
    scene = tt.load(tt.scenes.cornell_box(8, num_bins=16, bin_width_opl=0.4, max_depth=3), variant="llvm_ad_mono")
    renderer = tt.TransientRenderer(scene, parameters=[KEY], spp=16, physics="ignore")
    first, said = None, []
    for n in {counts}:
        tt.threads(n)
        renderer.zero_grad()
        out = renderer(seed=3)
        out.transient.square().sum().backward()
        found = out.transient.detach().clone(), renderer.values[KEY].grad.clone()
        first = first or found
        for a, b in zip(found, first):
            # Sums are added in another order.
            torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5 * float(b.abs().max()))
        said.append(out.stats.recorded[0])
    print("done", said.count("launched"))

    class Work:
        def __init__(self):
            self.steps = self.blocks()
            next(self.steps)
        def blocks(self):
            with tt.threads(5):
                yield self
    Work()  # a cycle: the pool shrinks when the interpreter, at its end, collects it
"""
# More threads than cores, fewer again, and as many as before.
COUNTS = (1, 1, 1, 4, 4, 4, 2, 16, 1)


@pytest.mark.slow
def test_numbers_are_the_same_whatever_the_count():
    """In a process of its own: memory that is sized for fewer threads than write to it ends the process."""
    done, launched = run(NUMBERS.format(counts=COUNTS))
    # A render that came back to a count that has been recorded is launched.
    assert done == "done" and int(launched) >= 3


@pytest.mark.slow
def test_pictures_of_scenes_are_read_by_one_thread(tmp_path):
    """Mitsuba alone waits for ever: it leaves an OpenEXR file to other threads of the pool, and there is none."""
    script = f"""
        import numpy as np
        import torchtransient as tt
        import mitsuba as mi
        mi.set_variant("llvm_ad_rgb")
        grey = np.full((40, 60, 3), 0.25, np.float32)
        with tt.threads(2):
            mi.Bitmap(grey).write({str(tmp_path / "grey.exr")!r})
        tt.threads(1)
        picture = {{"type": "bitmap", "filename": {str(tmp_path / "grey.exr")!r}}}
        light = {{"type": "envmap", "filename": {str(tmp_path / "grey.exr")!r}}}
        ball = {{"type": "sphere", "center": [0, 0, -9], "bsdf": {{"type": "diffuse", "reflectance": picture}}}}
        scene = tt.load({{"type": "scene", "sensor": {{"type": "perspective"}}, "light": light, "ball": ball}})
        renderer = tt.TransientRenderer(scene, time_axis=tt.TimeAxis(0.0, 1.0, 4))
        print(round(float(renderer(spp=1, seed=0).steady.mean()), 2), tt.threads().drjit)
        print(tt.plan(scene, time_axis=tt.TimeAxis(0.0, 1.0, 4)).variant, tt.threads().drjit)
    """
    assert run(script) == ["0.25", "1", "llvm_ad_mono", "1"]
