"""docs/training.md: its blocks run, and what it says of their results is so."""

from __future__ import annotations

import pytest
import torch

import torchtransient as tt
from support.pages import Page

VARIANT = "llvm_ad_mono"
TRAINING = Page("docs/training.md")
PAGE = TRAINING.text


@pytest.fixture(scope="module")
def names():
    return TRAINING.names()


@pytest.mark.slow
def test_a_run_in_parts_ends_as_one_in_one_piece(names):
    whole, resumed = (names[name].state_dict() for name in ("whole", "resumed"))
    assert all(torch.equal(whole[name], resumed[name]) for name in whole)
    first = torch.load(names["folder"] / "parts.pt")["step"]
    assert first == 6
    # It has learnt something: two steps are not six.
    names["train"](2, names["folder"] / "short.pt")
    short = torch.load(names["folder"] / "short.pt")["parts"]["model"]
    assert not torch.equal(short["network.1.weight"], whole["network.1.weight"])


@pytest.mark.slow
def test_seeds_know_the_sample_alone(names):
    assert names["apart"] == [names["together"][2], names["together"][0]]
    assert not set(names["other"]) & set(names["together"])
    assert names["noise"].shape == (2,)


@pytest.mark.slow
def test_iterators_draw_from_the_global_generator(names):
    assert names["after_a_loader"] != names["untouched"]
    assert names["after_batches"] == names["untouched"]


@pytest.mark.slow
def test_parts_have_the_gradient_of_the_whole(names):
    torch.testing.assert_close(names["in_parts"], names["in_one"], rtol=1e-6, atol=0)
    assert names["loss"] > 0


def test_renders_are_float32(names):
    assert names["light"].dtype == torch.float32
    assert names["values"].grad.dtype == torch.bfloat16
    assert bool((names["values"].grad != 0).all())


def test_threads_and_workers(names):
    assert (names["counts"].torch, names["counts"].drjit) == (1, 1)
    loader = names["loader"]
    assert loader.multiprocessing_context.get_start_method() == "spawn"
    assert loader.worker_init_fn is tt.training.worker_init


def test_it_names_everything_of_the_room():
    missing = [name for name in vars(tt.training) if name[0].isupper() and f"{name}" not in PAGE and name != "Ranks"]
    missing += [name for name in ("accumulate", "ranks(", "worker_init", "load_checkpoint") if name not in PAGE]
    assert not [name for name in missing if name != "Checkpoint"]
