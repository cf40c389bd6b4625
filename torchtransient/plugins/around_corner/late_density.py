"""Where heads of chains are drawn: by what light of four bounces weighs there, as a few thousand of them tell."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.remembered import Remembered, digest
from torchtransient.plugins.sampling.hidden_elements import HiddenElements
from torchtransient.plugins.sampling.shared_samples import draw_samples
from torchtransient.plugins.transport.strategy import Local

# Points of the pilot, and how many of them a weight is the mean of.
_POINTS, _BUCKET = 2**15, 64
_SEED = 0x70696C6F
# Share of the density before: light of more bounces comes from elsewhere, too, and must not weigh much.
_BEFORE = 0.4


def late_density(
    scene: Any, elements: HiddenElements, points: np.ndarray, normals: np.ndarray, memory: Remembered | None = None
) -> HiddenElements:
    """The elements drawn by the root mean square, over wall points ``(P, 3)`` and directions of scattering, of what a
    point sends by way of one further hidden point.

    A body's creases weigh more than what stands free, where no light is scattered twice. Neighbours have one weight
    per area, the mean of some samples. What the weights leave out is drawn by its share of plain area. ``memory``: of
    densities that were made for the same ``elements`` (with a ``key``), seen from the same points.
    """
    s = draw_samples(elements, _POINTS, _SEED)
    # The side that faces the scan: of two-sided surfaces it counts most.
    center = mi.Point3f(*np.mean(points, axis=0).tolist())
    dr.make_opaque(center)
    n = mi.Vector3f(s.geometric_n)
    n = dr.mulsign(n, dr.dot(n, center - s.p))
    lit = dr.dot(n, mi.Vector3f(s.geometric_n)) > 0
    lit = dr.select(lit, dr.max(s.front), dr.max(s.back)) > 0

    def made() -> HiddenElements:
        return _density(scene, elements, (points, normals), s, (center, n, lit))

    if memory is None or not elements.key:
        return made()
    # Of what surfaces scatter it matters whether they do.
    return memory.of("late density", elements.key + digest(np.array(lit)), made)


def _density(scene: Any, elements: HiddenElements, wall: tuple[np.ndarray, np.ndarray], s: Any, side: Any) -> Any:
    """``side``: the middle of the scan, normals towards it, and whether something is scattered there."""
    points, normals = wall
    center, n, lit = side
    numbers = np.random.default_rng(_SEED).random((2, _POINTS)).astype(np.float32)
    d = mi.Frame3f(mi.Normal3f(n)).to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(numbers)))
    reach = dr.max(dr.abs(s.p)) + dr.norm(center - s.p)
    ray = mi.Ray3f(mi.Point3f(s.p + n * (mi.math.RayEpsilon * reach)), d)
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=lit)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, lit)
    lit &= si.is_valid()
    there = mi.Vector3f(dr.select(dr.dot(si.n, d) < 0, si.n, -si.n))
    wall = Local(p=mi.Point3f(points.T), n=mi.Vector3f(normals.T))
    dr.make_opaque(wall.p, wall.n)
    square = mi.Float(0)
    for i in range(len(points)):
        q, m = dr.gather(mi.Point3f, wall.p, i), dr.gather(mi.Vector3f, wall.n, i)
        square += dr.square(_factor(s.p, n, q, m) * _factor(si.p, there, q, m))
    square, stands_for, element = (np.array(a) for a in (dr.select(lit, square, 0), s.weight, s.element))
    return elements.reweighted(_smoothed(elements, square.astype(np.float64), stands_for.astype(np.float64), element))


def _factor(p: Any, n: Any, q: Any, m: Any) -> Any:
    """Cosines over the squared distance."""
    d = mi.Vector3f(q - p)
    inverse = dr.rcp(dr.squared_norm(d))
    return dr.maximum(dr.dot(n, d), 0) * dr.maximum(-dr.dot(m, d), 0) * dr.square(inverse)


def _smoothed(elements: HiddenElements, square: np.ndarray, area: np.ndarray, element: np.ndarray) -> np.ndarray:
    """Weights ``(1, E)`` of elements from squares at samples, which stand for ``area`` each; elements next to each
    other in the table are neighbours in space.
    """
    size = len(elements.elements)
    drawn = np.bincount(element, minlength=size)
    bucket = (np.cumsum(drawn) - drawn) // _BUCKET
    total, covered = (np.bincount(bucket, np.bincount(element, w, size)) for w in (square * area, area))
    rms = np.sqrt(total / np.where(covered > 0, covered, 1))
    learned = rms[bucket] * elements.elements.area
    before = elements.probabilities[0]
    return (learned * ((1 - _BEFORE) / max(learned.sum(), 1e-300)) + _BEFORE * before / before.sum())[None]
