"""The example trains through f-k: in a few steps it is better than no network, in all of them five times."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest
import torch

SCRIPT = Path(__file__).parents[2] / "training_examples" / "denoise_before_fk.py"


@pytest.fixture(scope="module")
def example():
    return runpy.run_path(str(SCRIPT))


@pytest.fixture(autouse=True)
def one_thread():
    """Convolutions of this size wait for their threads more than they compute."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.slow
def test_a_few_steps(example, tmp_path, capsys):
    options = {"--steps": 20, "--points": 10, "--bins": 48, "--scenes": 6, "--test-scenes": 3, "--output": tmp_path}
    errors = example["main"]([str(x) for pair in options.items() for x in pair])
    assert errors["trained through f-k"] < 0.5 * errors["as measured"]
    assert errors["trained through f-k"] < errors["trained on transients"]
    assert json.loads((tmp_path / "denoise_before_fk.json").read_text()) == errors
    assert (tmp_path / "denoise_before_fk.png").read_bytes().startswith(b"\x89PNG")
    assert f"{errors['blurred']:.4f}" in capsys.readouterr().out


def test_captures_are_what_they_are_said_to_be(example):
    fk = example["make_operator"](12, 64)
    signal = example["bar"](fk, torch.Generator().manual_seed(3))
    assert float(signal.sum()) == pytest.approx(example["SIGNAL"] * 12 * 12, rel=1e-5)
    captures = example["make_captures"](fk, 2, torch.Generator().manual_seed(3))
    assert captures.noisy.shape == captures.volumes.shape == (2, 64, 12, 12)
    torch.testing.assert_close(captures.volumes.sum((1, 2, 3)), torch.ones(2))
    # the brightest voxel is one of the bar: 0.6 to 0.9 m before the wall
    depth = fk.depths[captures.volumes.amax((2, 3)).argmax(1)]
    assert bool(((depth > 0.55) & (depth < 0.95)).all())


@pytest.mark.slow
def test_five_times_better_where_transients_alone_are_not(example, tmp_path):
    errors = example["main"](["--output", str(tmp_path)])
    assert errors["trained through f-k"] < errors["as measured"] / 5
    assert errors["trained through f-k"] < errors["blurred"] / 2
