"""The plugin of docs/plugins.md renders, has a gradient in both modes, and its calls are recorded."""

from __future__ import annotations

import pytest
import torch

import torchtransient as tt
from support.pages import Page
from torchtransient import plugins
from torchtransient.plugins import _registry

PAGE = Page("docs/plugins.md")


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "grey_paint.py").write_text(PAGE.blocks("python")[0], encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    _registry._state.third_party = []
    _registry._state.variant = None
    plugins.sync()


def test_the_example(module, capsys):
    found = PAGE.names()
    assert "launched" in capsys.readouterr().out
    key = "red.albedo"
    options = {"time_axis": found["axis"], "spp": 64, "grad_seed": "same"}
    renderer = tt.TransientRenderer(found["scene"], parameters=[key], **options)

    def light(albedo):
        return renderer({key: albedo}, seed=5).transient.sum()

    x, h = renderer.values[key].detach(), 1e-2
    _, tangent = torch.func.jvp(light, (x,), (torch.ones_like(x),))
    (gradient,) = torch.autograd.functional.vjp(light, x)[1:]
    difference = (light(x + h) - light(x - h)) / (2 * h)
    assert float(difference) > 0
    assert float(gradient) == pytest.approx(float(difference), rel=5e-3)
    assert float(tangent) == pytest.approx(float(gradient), rel=1e-3)
