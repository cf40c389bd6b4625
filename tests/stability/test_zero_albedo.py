"""Gradients with respect to albedos that are zero or nearly so."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from support.gradient_cases.cases_materials import CASES
from support.gradient_cases.problem import Problem
from support.gradient_cases.scenes import room
from support.gradient_cases.unknowns import set_color

BASE = next(case for case in CASES if case.name == "diffuse_albedo")
SIDE, WALL = "side.bsdf.reflectance.value", "wall.bsdf.reflectance.value"


def problem(key, value, scene):
    case = dataclasses.replace(
        BASE, name="albedo", scene=scene, apply=set_color(key), value=value, step=0.05, spp=512, fd_spp=512
    )
    return Problem(case)


@pytest.mark.parametrize(("key", "albedo"), [(SIDE, 0.0), (SIDE, 1e-8), (WALL, 0.0)])
def test_gradient_against_finite_differences(key, albedo):
    """Guards against dividing the light beyond a vertex by its BSDF value: at zero that gives 0 (or 0 / 0) although the
    derivative is not zero, and just above it an amplification by up to 1e8.

    Same seed, same paths, and a polynomial in the albedo: central differences with Richardson's correction are exact to
    rounding.
    """
    scene = (
        (lambda: room(side_reflectance=albedo))
        if key == SIDE
        else (lambda: room(bsdf={"type": "diffuse", "reflectance": albedo}, side_reflectance=0.8))
    )
    p = problem(key, albedo, scene)
    h = p.case.step
    for seed in (1, 2):
        near, far = ((p.loss(albedo + s, seed) - p.loss(albedo - s, seed)) / (2 * s) for s in (h / 2, h))
        expected = (4 * near - far) / 3
        assert abs(expected) > 1e-3
        assert p.reverse(seed) == pytest.approx(expected, rel=2e-3)
        assert p.forward(seed) == pytest.approx(expected, rel=2e-3)


def test_two_black_surfaces():
    """With the wall black too, no light comes by way of the side: its derivative is zero, and finite."""
    p = problem(SIDE, 0.0, lambda: room(bsdf={"type": "diffuse", "reflectance": 0.0}, side_reflectance=0.0))
    gradient = p.reverse(1)
    assert np.isfinite(gradient) and gradient == 0.0
