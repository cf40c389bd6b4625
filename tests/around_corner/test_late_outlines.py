"""Derivatives of light of four and more bounces where hidden things hide each other."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.moved_captures import MovedCapture, move
from support.nlos_scenes import film, plane, scan_scene, side
from torchtransient.plugins.around_corner.late_outlines import LateOutlines

VARIANT = "llvm_ad_mono"
SIGMAS = 4.0
SMOOTH = {"start": 1.0, "width": 0.05, "bins": 100, "temporal_filter": "tent"}
# The parameter of differences: of the third derivative a share of (h / 0.3 m)^2 is left.
STEP = 1.5e-2


def plates(**front):
    """A plate before another one, and a third beside them, which lights what the first hides."""
    return {"back": plane(1.2), "front": plane(0.9, 0.3, 0.22, 0.1) | front, "side": side()}


def capture_of(hidden, key, change, kind="single", bounces=4, points=3, **integrator):
    settings = {"max_depth": bounces, "filter_bounces": bounces} | integrator
    scene = scan_scene(hidden, kind, film(points, kind=kind, **SMOOTH), **settings)
    return MovedCapture(scene, key, change)


@pytest.mark.parametrize("kind", ["exhaustive"])
def test_both_modes_agree(kind):
    """At one seed, to rounding; and the term is there."""
    capture = capture_of(plates(), "front.to_world", move(1, 0, 0), kind, points=2)
    whole = capture.reverse(0, 2**8)
    assert capture.forward(0, 2**8) == pytest.approx(whole, rel=2e-4)
    interior = capture_of(plates(), "front.to_world", move(1, 0, 0), kind, points=2, boundary=False)
    assert abs(interior.reverse(0, 2**8) - whole) > 1e-3 * abs(whole)
