"""Walls read from counts: by processes of torchrun, killed and resumed, and by Lightning, all to the same weights."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

import torchtransient as tt
from support.examples import FOLDER, example

STEPS, EVERY = 20, 2


def weights_of(folder):
    return torch.load(folder / f"train_ddp-{STEPS}-0.pt")["parts"]["model"]


def assert_same_up_to_sums(found, expected):
    """Of 20 steps of Adam, whose length is 3e-3 whatever the size of a gradient, a part in 600 (measured: 1.2e-5)."""
    assert found.keys() == expected.keys()
    for name, weight in expected.items():
        if weight.is_floating_point():
            assert float((found[name] - weight).abs().max()) <= 1e-4, name


def test_the_plane_fit_finds_planes():
    """Without noise, from the light itself."""
    walls = example("tilted_walls")
    distance, tilt = torch.tensor([3.75, 4.0, 4.2]), torch.tensor([-15.0, 0.0, 18.0])
    pose = walls.wall_to_world(distance, tilt)
    for found, expected in zip(walls.truth_of(pose), (distance, tilt), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-4)
    reader = walls.Reader(256)
    with torch.no_grad(), tt.threads(1):
        light = reader.renderer({walls.KEY: pose}, seed=1).transient
        millimetres, degrees = walls.errors_of(walls.plane_fit(1e3 * walls.expected_counts(light)), (distance, tilt))
    # Bins of 15 mm of depth; the parabola through three of them is not exact for a response cut in bins.
    assert millimetres < 5
    assert degrees < 1


def children(pid):
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def torchrun(output, *, kill):
    """The small run by two ranks; ``kill``: one of them, as soon as there is a checkpoint."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2",
               str(FOLDER / "train_ddp.py"), "--smoke", "--every", str(EVERY), "--output", str(output)]  # fmt: skip
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as run:
        end, path = time.monotonic() + 400, output / f"train_ddp-{STEPS}-0.pt"
        while kill and not path.exists() and run.poll() is None and time.monotonic() < end:
            time.sleep(0.01)
        if kill:
            os.kill(children(run.pid)[-1], signal.SIGKILL)
        said, _ = run.communicate(timeout=400)
    return run.returncode, said


@pytest.mark.soak
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds the ranks of torchrun in /proc")
def test_two_ranks_one_of_which_is_killed_learn_what_one_learns(tmp_path):
    ended, said = torchrun(tmp_path / "two", kill=True)
    assert ended, said
    first = torch.load(tmp_path / "two" / f"train_ddp-{STEPS}-0.pt")["step"]
    assert 0 < first < STEPS
    ended, said = torchrun(tmp_path / "two", kill=False)
    assert not ended, said
    # The bar of the second run begins where the first one was.
    assert f"/{STEPS - first}" in said
    assert "trained by the renderer" in said
    run = example("train_ddp").main(["--smoke", "--output", str(tmp_path / "one")])
    assert len(run.losses) == STEPS
    assert_same_up_to_sums(weights_of(tmp_path / "two"), weights_of(tmp_path / "one"))
    assert (tmp_path / "two" / "train_ddp.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.soak
def test_lightning_goes_on_to_the_bit_and_learns_the_same(tmp_path):
    pytest.importorskip("lightning")
    script = example("lightning_fit")
    whole = script.main(["--smoke", "--output", str(tmp_path / "whole")])
    small = ["--smoke", "--output", str(tmp_path / "parts")]
    script.main([*small, "--every", "4", "--stop", "10"])  # the last checkpoint is that of step 8
    parts = script.main([*small, "--every", "4"])
    assert parts.global_step == whole.global_step == STEPS
    assert parts.losses == whole.losses
    for name, weight in whole.state_dict().items():
        assert torch.equal(parts.state_dict()[name], weight), name
    example("train_ddp").main(["--smoke", "--output", str(tmp_path / "one")])
    assert_same_up_to_sums(whole.reader.state_dict(), weights_of(tmp_path / "one"))
    assert (tmp_path / "parts" / "lightning_fit.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.soak
def test_the_renderer_teaches_the_network(tmp_path):
    """One seed of three; the docs have all."""
    walls = example("tilted_walls")
    run = example("train_ddp").main(["--seeds", "0", "--output", str(tmp_path)])
    network, plane = (walls.errors_of(run.found[name], run.truth) for name in (walls.NETWORK, walls.PLANE))
    assert network[0] < plane[0] / 3
    assert network[1] < plane[1] / 3
