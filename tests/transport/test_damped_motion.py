"""How the direction to a near point follows its vertex: against finite differences of the field that it stands for."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.walks import damped_motion

RADIUS = 0.4
δ = np.array([0.3, -0.7, 0.5])
# A plane seen from the origin, as the points q with N.q = 1.
N = np.array([0.5, 1.0, -4.0])


def normalized(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def reach(d):
    """Distance of the plane along ``d``."""
    return 1 / (d @ N)


def field(d):
    """Velocity of the direction ``d`` when the origin moves by ``δ``."""
    r = reach(d)
    s2 = np.minimum(r / RADIUS, 1)[..., None] ** 2
    share = (1 - s2) ** 2
    return -(1 - share) / r[..., None] * (δ - d * (d @ δ)[..., None])


def directions():
    """Some at every distance: before, around and beyond the radius."""
    d = normalized(N + np.random.default_rng(1).normal(size=(64, 3)) * 3)
    return d[(d @ N > 0.5)]


def tangents(d):
    """The derivatives of direction, solid angle, drag and slide."""
    mi.set_variant("llvm_ad_mono")
    def vector(v):
        return mi.Vector3f(np.ascontiguousarray(v.T, dtype=np.float32))

    x = mi.Float(0)
    dr.enable_grad(x)
    r = mi.Float(reach(d).astype(np.float32))
    n = mi.Normal3f(*normalized(N).tolist())
    motion = damped_motion(mi.Vector3f(*δ.tolist()) * x, vector(d), r, n, mi.Bool(True), mi.Float(RADIUS))
    found = [motion.d, motion.J, motion.drag, motion.slide(n)]
    dr.set_grad(x, 1.0)
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
    return [np.array(dr.grad(v)) for v in found]


def test_direction():
    d = directions()
    r = reach(d)
    assert (r < RADIUS).sum() > 10
    assert (r > RADIUS).sum() > 10
    found = tangents(d)[0]
    assert pytest.approx(field(d), rel=1e-4, abs=1e-4) == found.T


def test_solid_angle_is_the_divergence():
    d, h = directions(), 1e-5
    away = [np.broadcast_to(axis, d.shape) for axis in np.eye(3)]
    # The trace over the tangent plane: the field is extended to all of space along the rays.
    divergence = sum(
        ((field(normalized(d + h * e)) - field(normalized(d - h * e))) / (2 * h) * e).sum(-1) for e in away
    )
    assert tangents(d)[1] == pytest.approx(divergence, rel=2e-3, abs=2e-3)


def test_slide_follows_the_direction():
    """The point where the moved ray meets the plane, and the one that slides, are the same."""
    d, h = directions(), 1e-6
    out = d + h * field(d)
    at = h * δ
    moved = at + out * ((1 - at @ N) / (out @ N))[:, None]
    slide = (moved - d * reach(d)[:, None]) / h
    _, _, drag, found = tangents(d)
    np.testing.assert_allclose(found.T, slide, rtol=2e-3, atol=2e-3)
    assert (drag.T * d).sum(-1) == pytest.approx(0, abs=1e-5)
    assert drag.T[reach(d) > RADIUS] == pytest.approx(0, abs=1e-6)
