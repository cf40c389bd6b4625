"""docs/speed.md: its blocks run in the order that they stand in, and do what the page says."""

from __future__ import annotations

import torch

import torchtransient as tt
from support.pages import Page

VARIANT = "llvm_ad_rgb"
NEW = ["traced: the first call", "recorded", "launched"]


def test_the_code_of_the_page():
    before = tt.threads()
    names = Page("docs/speed.md").names()
    assert tt.threads() == before
    assert names["history"] == [(said, said) for said in [*NEW, "launched"]]
    assert names["difference"].item() < 1e-5 * names["out"].transient.max().item()
    assert names["reason"] == "traced: freeze=False"
    assert names["layouts"] == {"squares": ["launched"] * 2, "sum": NEW}
    assert names["several"] == {4: NEW, 16: NEW}
    assert names["shown"] == "traced: progress is reported"
    assert names["batch"].transient.shape == (8, 3, 16, 8, 8)
    assert names["batch"].stats.recorded == ("launched",) * 8
    assert (names["counts"].torch, names["counts"].drjit) == (1, 1)
    assert names["after"] == names["before"]
    expected = names["traced"](seed=0).transient
    torch.testing.assert_close(names["alone"].transient, expected, rtol=1e-5, atol=1e-5 * expected.max().item())
