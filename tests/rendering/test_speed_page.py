"""docs/speed.md: its blocks run in the order that they stand in, and do what the page says."""

from __future__ import annotations

import pytest
import torch

import torchtransient as tt
from support.pages import Page
from torchtransient.rendering import recording

VARIANT = "llvm_ad_rgb"

PAGE = Page("docs/speed.md")


NEW = [recording.FIRST, recording.RECORDED, recording.LAUNCHED]


@pytest.fixture(scope="module")
def names():
    """What stands there after every block has run, in one session from top to bottom."""
    before = tt.threads()
    found = PAGE.names()
    assert tt.threads() == before
    return found


@pytest.mark.slow
def test_calls_are_traced_recorded_and_launched(names):
    assert names["history"] == [(said, said) for said in [*NEW, recording.LAUNCHED]]
    assert names["difference"].item() < 1e-5 * names["out"].transient.max().item()
    assert names["reason"] == recording.SWITCHED_OFF


def test_another_layout_is_another_kind_of_call(names):
    assert names["layouts"] == {"squares": [recording.LAUNCHED] * 2, "sum": NEW}


def test_so_is_another_number_of_samples(names):
    assert names["several"] == {4: NEW, 16: NEW}


def test_progress_is_traced(names):
    assert names["shown"] == recording.PROGRESS


def test_a_batch_is_a_launch_an_entry(names):
    assert names["batch"].transient.shape == (8, 3, 16, 8, 8)
    assert names["batch"].stats.recorded == (recording.LAUNCHED,) * 8


def test_threads(names):
    assert (names["counts"].torch, names["counts"].drjit) == (1, 1)
    assert names["after"] == names["before"]
    expected = names["traced"](seed=0).transient
    torch.testing.assert_close(names["alone"].transient, expected, rtol=1e-5, atol=1e-5 * expected.max().item())
