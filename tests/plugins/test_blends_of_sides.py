"""Blends of what works on one side of a surface with what works on both, or lets light through."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

import torchtransient as tt
from tools.gradient_sweep.bsdfs import ROUGH_GLASS, blend
from tools.gradient_sweep.measure import Subject
from tools.gradient_sweep.stages import between_lights, matte
from torchtransient import plugins

GLASS = {"type": "roughdielectric", **ROUGH_GLASS}


@pytest.fixture(autouse=True)
def rgb():
    mi.set_variant("llvm_ad_rgb")
    plugins.sync()


def total(bsdf, spp):
    """Light in all bins, with the sum over a few seeds."""
    scene = tt.load(between_lights(bsdf), variant="llvm_ad_rgb")
    sums = [float(tt.render(scene, spp=spp, seed=seed).transient.sum()) for seed in range(4)]
    return np.mean(sums), np.std(sums, ddof=1) / 2


@pytest.mark.slow
def test_values():
    """A weight by which nothing is blended is the same as none: black paint takes away its share."""
    blended, error = total({"type": "blendbsdf", "weight": 0.5, "a": GLASS, "b": matte(0.0)}, 16384)
    # Glass that is half as bright, once: paths of depth 2 meet the plate once.
    half = {name: GLASS[name] / 2 for name in ("specular_reflectance", "specular_transmittance")}
    once, other = total(GLASS | half, 16384)
    assert blended == pytest.approx(once, abs=4 * np.hypot(error, other) + 0.01 * once)


@pytest.mark.slow
def test_derivative_by_the_roughness():
    """It was 35 % too large."""
    scene = tt.load(between_lights(blend(GLASS)), variant="llvm_ad_rgb")
    subject = Subject(scene, "plate.bsdf.bsdf_0.alpha.value")
    (tangent,) = subject.tangents()
    gaps, differences = [], []
    for seed in range(6):
        difference, _ = subject.difference(tangent, seed, 8192, 0.05)
        gaps.append(float(subject.reverse(seed, 8192) @ tangent.direction.double().reshape(-1).numpy()) - difference)
        differences.append(difference)
    assert abs(np.mean(gaps)) < 4 * np.std(gaps) / np.sqrt(6) + 0.03 * abs(np.mean(differences))
    assert np.std(gaps) / np.sqrt(6) < 0.05 * abs(np.mean(differences))
