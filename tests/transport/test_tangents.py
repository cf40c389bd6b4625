"""What forward mode hands on from a vertex: numbers and their tangents, of which nothing is attached."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import pytest

from support.surface_samples import activate
from torchtransient.plugins.transport.derivative import forward


def test_nothing_attached_outlives_a_vertex(monkeypatch):
    """It would leave an edge of the graph behind, which the next traversal runs into."""
    activate("llvm_ad_mono")
    x = mi.Float(3.0)
    dr.enable_grad(x)
    dr.set_grad(x, 5.0)

    def terms(world, v, carry, wanted):
        moving, still = (SimpleNamespace(value=y * y, slope=2 * y, opl=mi.Float64(1)) for y in (x, mi.Float(7.0)))
        return [moving, still], SimpleNamespace(), None

    monkeypatch.setattr(forward, "attached_carry", lambda *_: None)
    monkeypatch.setattr(forward, "vertex_terms", terms)
    (moving, still), _ = forward.vertex_tangents(SimpleNamespace(wanted=None, carried=()), None, None)
    assert not any(dr.grad_enabled(y) for y in (moving.value, moving.d_value, moving.d_opl))
    assert moving.slope is None and still.slope is None
    found = [float(y[0]) for term in (moving, still) for y in (term.value, term.d_value, term.d_opl)]
    assert found == pytest.approx([9, 30, 10, 49, 0, 0])
