"""Derivatives of light of four and more bounces where hidden things hide each other, against finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from support.moved_captures import MovedCapture, agree, move
from support.nlos_scenes import film, plane, scan_scene, side

VARIANT = "llvm_ad_mono"
SMOOTH = {"start": 1.0, "width": 0.05, "bins": 100, "temporal_filter": "tent"}
BALL = {"type": "sphere", "center": [0.1, 0.1, 0.85], "radius": 0.15, "bsdf": {"type": "diffuse", "reflectance": 0.5}}


# Of differences over 24 seeds of 2^20 samples at each of 2 x 2 points.
REFERENCE, REFERENCE_ERROR = -1.48e-4, 2e-6


def plates(front=None):
    """A plate (or another shape) before a plate, and a third one beside them, which lights what the first one hides."""
    return {"back": plane(1.2), "front": front or plane(0.9, 0.3, 0.1, 0.1), "side": side()}


def capture_of(hidden, key, change, kind="single", points=3, bounces=4, **integrator):
    settings = {"max_depth": bounces, "filter_bounces": bounces} | integrator
    return MovedCapture(scan_scene(hidden, kind, film(points, kind=kind, **SMOOTH), **settings), key, change)


@pytest.mark.slow
def test_late_light_that_a_plate_hides():
    """The derivative is that of long finite differences; paths alone have the other sign, .00021."""
    capture = capture_of(plates(), "front.to_world", move(1, 0, 0), points=2)
    found = np.array([capture.reverse(seed, 2**14) for seed in range(4)])
    assert found.mean() == pytest.approx(REFERENCE, abs=4 * found.std(ddof=1) / 2 + 4 * REFERENCE_ERROR)
    assert found.std(ddof=1) / 2 < 0.25 * abs(REFERENCE)


CASES = {
    "single": lambda: capture_of(plates(), "front.to_world", move(1, 0, 0)),
    "exhaustive": lambda: capture_of(plates(), "front.to_world", move(1, 0, 0), "exhaustive", points=2),
    "five bounces": lambda: capture_of(plates(), "front.to_world", move(1, 0, 0), bounces=5),
    "a ball": lambda: capture_of(plates(BALL), "front.to_world", move(1, 0, 0)),
}


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=pytest.mark.slow if case == "single" else pytest.mark.soak) for case in CASES],
)
def test_late_light(case):
    interior, whole, error = agree(CASES[case](), 2**15, 8, 2**17, 16, step=1e-2, most_error=0.25)
    assert abs(interior - whole) > 5 * error


@pytest.mark.slow
def test_one_body_that_hides_nothing_costs_nothing():
    for hidden, there in (({"front": plane(0.9)}, False), (plates(), True)):
        capture = capture_of(hidden, "front.to_world", move(1, 0, 0), points=1)
        assert (capture.boundary(1) is not None) == there
