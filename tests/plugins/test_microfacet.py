"""Densities of facets, masking and half vectors against their formulas in double precision, and Mitsuba's values."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient.plugins.bsdfs.microfacet import half_vector, normal_density, smith_g1_over_cos

VARIANT = "llvm_ad_mono"
ALPHAS = [(0.3, 0.3), (0.1, 0.5), (0.9, 0.2)]


def directions(seed, count=200, up=False):
    d = np.random.default_rng(seed).normal(size=(3, count))
    d /= np.linalg.norm(d, axis=0)
    return np.stack([d[0], d[1], np.abs(d[2]) if up else d[2]])


def masking(v, alpha, ggx):
    """Smith's, over the cosine; of Beckmann's facets Walter's fit of it."""
    width, z = np.hypot(alpha[0] * v[0], alpha[1] * v[1]), np.abs(v[2])
    if ggx:
        return 2 / (1 + np.sqrt(1 + (width / z) ** 2)) / z
    a = z / width
    return np.where(a < 1.6, (3.535 * a + 2.181 * a**2) / (1 + 2.276 * a + 2.577 * a**2), 1) / z


@pytest.mark.parametrize("ggx", [True, False])
@pytest.mark.parametrize("alpha", ALPHAS)
def test_densities(alpha, ggx):
    m = directions(1, up=True)
    slope = (m[0] / alpha[0]) ** 2 + (m[1] / alpha[1]) ** 2
    norm = np.pi * alpha[0] * alpha[1]
    expected = 1 / (norm * (slope + m[2] ** 2) ** 2) if ggx else np.exp(-slope / m[2] ** 2) / (norm * m[2] ** 4)
    expected[(expected * m[2] < 1e-20) | (not ggx) & (slope > 45 * m[2] ** 2)] = 0
    found = np.array(normal_density(mi.Vector3f(m), mi.Float(alpha[0]), mi.Float(alpha[1]), ggx), dtype=float)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    kind = mi.MicrofacetType.GGX if ggx else mi.MicrofacetType.Beckmann
    theirs = np.array(mi.MicrofacetDistribution(kind, *alpha, False).eval(mi.Vector3f(m)), dtype=float)
    np.testing.assert_allclose(found[theirs > 1e-6], theirs[theirs > 1e-6], rtol=1e-3)


@pytest.mark.parametrize("ggx", [True, False])
def test_no_facets_along_or_below_the_surface(ggx):
    m = mi.Vector3f([1.0, 0.8, 0.0], [0.0, 0.0, 0.6], [0.0, -0.6, -0.8])
    assert dr.all(normal_density(m, mi.Float(0.3), mi.Float(0.4), ggx) == 0)
    straight = normal_density(mi.Vector3f(0, 0, 1), mi.Float(0.3), mi.Float(0.4), ggx)
    assert straight[0] == pytest.approx(1 / (np.pi * 0.12), rel=1e-6)


def test_densities_too_small_to_count():
    """Below 1e-20 with the cosine, and where the exponential ends."""
    for cosine, alpha in ((0.3, 0.5), (0.3, 0.46), (0.3, 0.47), (0.2, 0.1)):
        exponent = (1 - cosine**2) / (alpha * cosine) ** 2
        expected = np.exp(-exponent) / (np.pi * alpha**2 * cosine**4)
        m = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, cosine)
        found = float(normal_density(m, mi.Float(alpha), mi.Float(alpha), False)[0])
        is_there = expected * cosine > 1e-20 and exponent < 45
        assert found == (pytest.approx(expected, rel=1e-4) if is_there else 0), (cosine, alpha)


@pytest.mark.parametrize("ggx", [True, False])
@pytest.mark.parametrize("alpha", ALPHAS)
def test_masking(alpha, ggx):
    v, m = directions(2), directions(3, up=True)
    found = np.array(smith_g1_over_cos(mi.Vector3f(v), mi.Vector3f(m), mi.Float(alpha[0]), mi.Float(alpha[1]), ggx))
    seen = (v * m).sum(0) * v[2] > 0
    assert 50 < seen.sum() < 190
    np.testing.assert_allclose(found[seen], masking(v, alpha, ggx)[seen], rtol=1e-5)
    assert (found[~seen] == 0).all()
    kind = mi.MicrofacetType.GGX if ggx else mi.MicrofacetType.Beckmann
    theirs = mi.MicrofacetDistribution(kind, *alpha, False).smith_g1(mi.Vector3f(v), mi.Vector3f(m))
    np.testing.assert_allclose(found * np.abs(v[2]), np.array(theirs), atol=2e-5)


@pytest.mark.parametrize("ggx", [True, False])
def test_masking_at_its_ends(ggx):
    """None straight down; along the surface a finite number."""
    normal, a, b = mi.Vector3f(0, 0, 1), mi.Float(0.25), mi.Float(0.5)
    assert smith_g1_over_cos(normal, normal, a, b, ggx)[0] == 1
    tilted = mi.Normal3f(0.6, 0, 0.8)
    grazing = smith_g1_over_cos(mi.Vector3f(1, 0, 1e-12), tilted, a, b, ggx)[0]
    assert grazing == pytest.approx((2 if ggx else 3.535) / 0.25, rel=1e-5)
    assert smith_g1_over_cos(mi.Vector3f(0, 0, -1), normal, a, b, ggx)[0] == 1


@pytest.mark.parametrize("ggx", [True, False])
@pytest.mark.parametrize("v", [(0, 0, 1), (1, 0, 0), (0.6, 0, 0.8), (0, 1, 1e-6), (0, -0.6, -0.8)])
def test_derivatives_are_finite_straight_down_and_along_the_surface(v, ggx):
    """Along it nothing is seen of facets that face up."""
    direction, facet = mi.Vector3f(*map(float, v)), mi.Vector3f(0, 0, 1)
    a, b = mi.Float(0.25), mi.Float(0.5)
    dr.enable_grad(direction, facet, a, b)
    value = smith_g1_over_cos(direction, facet, a, b, ggx)
    density = normal_density(direction, a, b, ggx)
    assert (float(dr.detach(value)[0]) == 0) == (v[2] == 0)
    dr.backward(value + density + normal_density(facet, a, b, ggx))
    for leaf in (direction, facet, a, b):
        assert np.isfinite(np.array(dr.grad(leaf))).all()


def test_half_vectors():
    a, b = directions(4), directions(5)
    for weight in (1.0, 1.5):
        h, defined = half_vector(mi.Vector3f(a), mi.Vector3f(b), weight)
        expected = a + weight * b
        expected *= np.where(expected[2] < 0, -1, 1) / np.linalg.norm(expected, axis=0)
        np.testing.assert_allclose(np.array(h), expected, atol=2e-5)
        assert dr.all(defined)
    h, defined = half_vector(mi.Vector3f(0, 0.6, 0.8), mi.Vector3f(0, -0.6, -0.8), 1.0)
    assert not defined[0] and np.array(h).ravel().tolist() == [0, 0, 1]
