"""Differentiable state of a path between two vertices.

A vertex is a function ``Carry -> (EventTerms, Carry)``. Reverse mode carries the adjoint of a Carry backwards, forward
mode its tangent forwards; neither depends on its fields.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi


@dataclass
class Carry:
    """Differentiable state of a path. A dataclass: its adjoint and tangent are loop state. Copied, never changed."""

    β: Any      # Spectrum    throughput; its adjoint is the light beyond, weighed by the film's adjoint
    slope: Any  # Float       value 0, derivative that of the optical path length so far
    η: Any      # Float       index of refraction along the ray
    o: Any      # Point3f     ray origin behind delta lobes and sensors, else zero with the sideways shift of the ray
    d: Any      # Vector3f    ray direction behind delta lobes and sensors
    x: Any      # Point3f     start of the segment, where its transmittance matters
    w: Any      # Vector3f    direction at the far end of the segment, for ``si.wi`` there
    p: Any      # Point3f     far end of the segment, where a segment strategy places it (``material_points``)
    n: Any      # Normal3f    normal there, likewise
    rate: Any   # Float       value 0, derivative that of the rate so far, of films that measure rates

    @staticmethod
    def zeros() -> Carry:
        """Return a Carry of zeros."""
        vectors = (mi.Vector3f(0) for _ in range(6))
        return Carry(mi.Spectrum(0), mi.Float(0), mi.Float(0), *vectors, mi.Float(0))


def attach(carry: Carry, names: Sequence[str], tangents: Carry | None = None) -> Carry:
    """Return a Carry with new leaves of the AD graph.

    Args:
        carry: values of all fields.
        names: fields that become leaves.
        tangents: Carry with their tangents in forward mode, None in reverse mode.
    """
    leaves = {}
    for name in names:
        leaf = type(getattr(carry, name))(getattr(carry, name))
        dr.enable_grad(leaf)
        if tangents is not None:
            dr.set_grad(leaf, getattr(tangents, name))
        leaves[name] = leaf
    return replace(carry, **leaves)


def adjoint_of(carry: Carry, names: Sequence[str]) -> Carry:
    """Return the gradients of leaves of the graph as a Carry, zeros for other fields.

    Args:
        carry: Carry whose fields ``names`` are the leaves.
        names: fields of :class:`Carry`.
    """
    return with_fields(Carry.zeros(), names, [dr.grad(getattr(carry, name)) for name in names])


def with_fields(carry: Carry, names: Sequence[str], values: Sequence[Any]) -> Carry:
    """Return a Carry with some fields replaced.

    Args:
        carry: the other fields.
        names: fields of :class:`Carry`.
        values: their values, in the order of ``names``.
    """
    return replace(carry, **{n: type(getattr(carry, n))(v) for n, v in zip(names, values, strict=True)})


def inner(adjoint: Carry, carry: Carry, names: Sequence[str]) -> Any:
    """Return the inner product ``<adjoint, carry>``, Float.

    Args:
        adjoint, carry: the factors.
        names: fields of :class:`Carry` that count.
    """
    total = mi.Float(0)
    for name in names:
        total += total_of(getattr(adjoint, name), getattr(carry, name))
    return total


def total_of(a: Any, b: Any) -> Any:
    """Return the sum of ``a b`` over entries, Float.

    Args:
        a, b: numbers, vectors, spectra, Stokes vectors or Mueller matrices, both of one kind.
    """
    if mi.is_polarized and isinstance(b, mi.Spectrum):
        return dr.sum(sum(a[i, j] * b[i, j] for i in range(4) for j in range(4)))
    if mi.is_polarized and isinstance(b, mi.SpectrumEntry):
        return dr.sum(sum(a[i] * b[i] for i in range(4)))
    return a * b if dr.depth_v(b) == 1 else dr.sum(a * b)


def choose(mask: Any, a: Carry, b: Carry, names: Sequence[str]) -> Carry:
    """Return a Carry with fields of one or of another, lane by lane.

    Args:
        mask: lanes of ``a``.
        a, b: the two.
        names: fields that are chosen; other fields are those of ``b``.
    """
    return replace(b, **{name: dr.select(mask, getattr(a, name), getattr(b, name)) for name in names})


def slope_only(x: Any) -> Any:
    """Return a number whose value is 0 and whose derivative is that of ``x``.

    Args:
        x: Float.
    """
    return dr.replace_grad(mi.Float(0), x)
