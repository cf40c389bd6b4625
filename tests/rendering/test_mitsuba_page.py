"""The code of docs/mitsuba.md runs, block after block, and does what it says."""

from __future__ import annotations

import drjit as dr
import pytest

from support.pages import Page
from tools.small_room import VARIANT as VARIANT


@pytest.mark.slow
def test_the_code_of_the_page(capsys):
    names = Page("docs/mitsuba.md").names()
    assert "[[" in capsys.readouterr().out
    assert names["transient"].shape == (16, 16, 60, 3) and names["transient"].requires_grad
    assert float(names["colour"].grad.abs().min()) > 0
    key = "wall.bsdf.reflectance.value"
    assert float(names["optimizer"][key].x[0]) > 0.4
    # Neither function has left anything in the scene: it holds what the optimiser has last written there.
    assert dr.grad_enabled(names["params"][key]) and names["params"][key].x[0] > 0.4
