"""docs/speed.md: its blocks run in the order that they stand in, and do what the page says."""

from __future__ import annotations

import pytest
import torch

import torchtransient as tt
from support.pages import Page
from torchtransient.rendering import recording
from torchtransient.rendering.engine import LARGE_FILM
from torchtransient.rendering.recording import MOST_AT_ONCE

VARIANT = "llvm_ad_rgb"
PAGE = Page("docs/speed.md")
TEXT = PAGE.text
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


def test_numbers_and_reasons_are_those_of_the_code():
    assert f"recordings of {recording.MAX_STRUCTURES} kinds of calls" in TEXT
    assert f"and {recording.MAX_RECORDINGS} for sizes" in TEXT
    assert f"that {max(recording.MOST_UNLAUNCHED, recording.MAX_STRUCTURES)} calls in a row" in TEXT
    assert f"up to {MOST_AT_ONCE} at once" in TEXT
    assert LARGE_FILM == 2**18 and "films below 2^18 values" in TEXT
    for name in ("FIRST", "SWITCHED_OFF", "SEVERAL", "LARGE", "PROGRESS", "OWN_ENTRY", "NO_FREEZING"):
        assert f"`{getattr(recording, name)}`" in TEXT


def test_it_is_linked_where_it_is_looked_for():
    for page in ("README.md", "docs/torch_layer.md"):
        assert "speed.md" in Page(page).text, page
