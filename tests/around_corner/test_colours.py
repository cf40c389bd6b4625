"""Light that some of the colours alone carry counts as light."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import folded_plates, mesh, plate, scene_of, wall_grid
from torchtransient.plugins.around_corner import late_light as chains
from torchtransient.plugins.around_corner import shared_light as late_density
from torchtransient.plugins.around_corner import third_bounce
from torchtransient.plugins.around_corner.geometry import WallPoints
from torchtransient.plugins.around_corner.third_bounce import lit_by
from torchtransient.plugins.sampling.hidden_elements import HiddenElements
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_rgb"
SCATTERED = (0.0, 0.5, 0.25)
PAINT = {"type": "rgb", "value": list(SCATTERED)}


@pytest.mark.parametrize("lit", [True, False])
def test_samples_of_some_colours(monkeypatch, lit):
    monkeypatch.setattr(third_bounce, "occluded", lambda *given: mi.Bool(False))
    up, down = mi.Vector3f(0, 0, 1), mi.Vector3f(0, 0, -1)
    sample = Local(p=mi.Point3f(0, 0, 2), n=down, geometric_n=down, front=mi.UnpolarizedSpectrum(*SCATTERED),
                   back=mi.UnpolarizedSpectrum(0), delay=mi.Float(0))  # fmt: skip
    kept = {"L": mi.UnpolarizedSpectrum(0), "before": mi.Float(0), "after": mi.Float(0), "block": {}}
    block = Local(put=lambda state, opl, value, active: (mi.Float(0), mi.Float(0)))
    lane = Local(p=mi.Point3f(0, 0, 0), n=up, factor=mi.UnpolarizedSpectrum(3, 5, 7), apart=False)
    table = Local(load=lambda k: sample, lit=lit)
    third_bounce.deposit(Local(scene=None, window=None), table, lane, block, kept, mi.UInt32(0), True)
    g = 1 / 4 if lit else 1 / 16
    np.testing.assert_allclose(np.array(kept["L"]).ravel(), [0, 2.5 * g, 1.75 * g], rtol=1e-5)


def test_samples_of_some_colours_that_a_spot_lights(monkeypatch):
    monkeypatch.setattr(third_bounce, "occluded", lambda *given: mi.Bool(False))
    samples = Local(count=1, tiles=1, smooth=False, p=mi.Point3f(0, 0, 2), n=mi.Normal3f(0, 0, -1), clear=mi.UInt32(0),
                    front=mi.UnpolarizedSpectrum(*SCATTERED), back=mi.UnpolarizedSpectrum(0),
                    weight=mi.Float(2))  # fmt: skip
    spot = WallPoints(mi.Point3f(0, 0, 0), mi.Normal3f(0, 0, 1), 0.3)
    found = np.array(lit_by(None, samples, spot).load(mi.UInt32(0)).front)
    np.testing.assert_allclose(found.ravel(), [0, 0.25, 0.125], rtol=1e-5)


def test_vertices_of_some_colours(monkeypatch):
    """Of heads and of all vertices of tails."""
    sheet = mesh("a", plate(1, 1, (0, 0, 1)), PAINT)
    plan = chains.ChainPlan(HiddenElements([sheet], *wall_grid(2)), mi.Point3f(0, 0, 0), 4, 16, 2, mi.UInt32(1))
    numbers = [mi.UInt32([2**31, 2**30]) for _ in range(3)]
    drawn = chains._drawn(plan, numbers, (0, 1), 2)
    met = chains._step(scene_of(sheet), plan, mi.Point3f(0.1, 0.2, 0), mi.Vector3f(0, 0, 1), mi.Bool(True))
    for vertex in (drawn, met):
        assert np.array(vertex.alive).all()
        np.testing.assert_allclose(np.array(vertex.albedo)[:, 0], np.float32(SCATTERED), rtol=1e-4)
    monkeypatch.setattr(chains, "_guided_step", lambda *given: (met, mi.Float(0.5)))
    monkeypatch.setattr(chains, "_step", lambda *given: met)
    _, tail = chains.trace_chains(None, plan, dr.arange(mi.UInt32, 3))
    assert np.array(tail[1].alive).all() and np.array(tail[1].value)[1].min() > 0


def test_pilots_of_some_colours(monkeypatch):
    """On the side that faces the scan, front or back."""
    squares = []
    monkeypatch.setattr(late_density, "_smoothed", lambda elements, square, *others: squares.append(square) or (
        elements.probabilities))  # fmt: skip
    points, normals = wall_grid(2)
    v, f = folded_plates()
    shapes = [mesh("front", (v, f), PAINT), mesh("back", (v, f[:, ::-1]), 0.0, two_sided=True, back=PAINT)]
    for shape in shapes:
        late_density.late_density(scene_of(shape), HiddenElements([shape], points, normals), points, normals)
    assert min((square > 0).mean() for square in squares) > 0.1
