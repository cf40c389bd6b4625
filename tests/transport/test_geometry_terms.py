"""Directions and slides between points that move, by geometry in double precision."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.walks import damped_motion

VARIANT = "llvm_ad_mono"
RADIUS = 0.4
# Distances within and beyond the radius, a touch, and lanes that do not count.
R = np.array([0.07, 0.3, 0.55, 2.0, 0.0, 0.3, 0.9])
ACTIVE = np.array([1, 1, 1, 1, 1, 0, 0], dtype=bool)


def unit(v):
    return v / np.linalg.norm(v, axis=0)


def draw(seed, count=R.size):
    return np.random.default_rng(seed).normal(size=(3, count))


D, N, MOVED = unit(draw(1)), unit(draw(2)), draw(3)


def motion_of(**unbound):
    vectors = (mi.Vector3f(MOVED), mi.Vector3f(D), mi.Float(R), mi.Normal3f(N))
    return damped_motion(*vectors, mi.Bool(ACTIVE), mi.Float(RADIUS), **unbound)


def share(r, nailed):
    """How much of the vertex's motion a point at distance ``r`` makes, too."""
    return np.zeros_like(r) if nailed else (1 - np.minimum(r / RADIUS, 1) ** 2) ** 2


@pytest.mark.parametrize("unbound", [None, "nailed", "volume"])
def test_the_direction_to_a_point_that_moves_with_its_vertex(unbound):
    """Of surfaces, points of lights and points in volumes: ``-W`` times what the vertex moves across, and its
    divergence.
    """
    motion = motion_of(**({unbound: mi.Bool(True)} if unbound else {}))
    nailed = unbound == "nailed"
    r = np.where(R > 0, R, 1.0)
    weight = np.where((R > 0) & ACTIVE, (1 - share(r, nailed)) / r, 0)
    step = 1e-6
    slope = ((1 - share(r + step, nailed)) / (r + step) - (1 - share(r - step, nailed)) / (r - step)) / (2 * step)
    slope = np.where((R > 0) & ACTIVE, r * slope, 0)
    along, cos = (D * MOVED).sum(0), (D * N).sum(0)
    across = MOVED - D * along
    divergence = 2 * weight * along
    if unbound is None:
        divergence += slope * ((N * MOVED).sum(0) / cos - along)
    np.testing.assert_allclose(np.array(motion.d), D - weight * across, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(np.array(motion.J), 1 + divergence, rtol=1e-4, atol=1e-4)
    drag = np.where(ACTIVE, (1 - weight * R) * across, 0)
    np.testing.assert_allclose(np.array(motion.drag), drag, rtol=1e-4, atol=1e-5)


def test_points_slide_on_their_surfaces():
    """Across the normal, and seen along the ray where it was dragged to; the length changes by what both ends move."""
    motion, n = motion_of(), mi.Normal3f(N)
    slid = np.array(motion.slide(n), dtype=np.float64)[:, ACTIVE]
    drag, d, normal = (v[:, ACTIVE] for v in (np.array(motion.drag, dtype=np.float64), D, N))
    np.testing.assert_allclose((slid * normal).sum(0), 0, atol=1e-5)
    np.testing.assert_allclose(np.cross(slid - drag, d, axis=0), 0, atol=1e-5)
    np.testing.assert_allclose(np.array(motion.longer()), -(MOVED * D).sum(0), rtol=1e-5, atol=1e-6)
    longer = ((slid - MOVED[:, ACTIVE]) * d).sum(0)
    np.testing.assert_allclose(np.array(motion.longer(n))[ACTIVE], longer, rtol=1e-4, atol=1e-4)


def test_material_points_count_as_far_as_they_do_not_slide():
    """The solid angle grows as the element of area and as the cosine of the normal that turns."""
    motion, x = motion_of(), mi.Float(0)
    dr.enable_grad(x)
    dr.set_grad(x, 1)
    turned, grown = draw(5), np.arange(1.0, 8.0)
    J = motion.of_material(mi.Normal3f(N) + mi.Vector3f(turned) * x, 1 + mi.Float(grown) * x)
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward)
    np.testing.assert_array_equal(np.array(J), 1)
    stays = np.where(R > 0, 1 - share(R, False), 0)
    expected = stays * (grown + (turned * D).sum(0) / (N * D).sum(0))
    np.testing.assert_allclose(np.array(dr.grad(J))[ACTIVE], expected[ACTIVE], rtol=1e-4, atol=1e-4)


def test_grazing_points_do_not_move():
    """Nothing is divided by a cosine of zero."""
    d, n, δ = mi.Vector3f(0, 0, 1), mi.Normal3f(1, 0, 0), mi.Vector3f(0.3, 0.2, 0.5)
    motion = damped_motion(δ, d, mi.Float(0.2), n, mi.Bool(True), mi.Float(RADIUS))
    np.testing.assert_array_equal(np.array(motion.slide(n)), np.array(motion.drag))
    a = (1 - 0.5**2) ** 2
    slope = (4 * 0.5**2 * (1 - 0.5**2) - (1 - a)) / 0.2
    assert motion.J[0] == pytest.approx(1 + (2 * (1 - a) / 0.2 - slope) * 0.5, rel=1e-5)
