"""Sums of independent flight lengths: the n-fold convolutions behind every cavity with a closed form.

In a closed Lambertian cavity whose form factors do not depend on the point (a sphere, a pair of infinite plates) the
lengths of successive flights are independent and share one density p. The optical path of n flights then has the
density p^{*n}.

The density is held on pieces of width `unit`, each by its values at Gauss-Legendre nodes. Both densities here
break only at multiples of that width, so every piece of every convolution is smooth and the quadrature converges
geometrically: 24 nodes reach 1e-13, checked against exact polynomials and moments in the tests.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray

from torchtransient.errors import ShapeError, UnitError

Array = NDArray[np.float64]
NODES = 24


@dataclass(frozen=True)
class FlightLaw:
    """The density of one flight, in units of `unit` metres.

    `density(x)` is a probability per unit for `first_piece <= x < last_piece` (None: no upper end), smooth inside every
    [k, k + 1]; it is never evaluated elsewhere.
    """

    unit: float
    density: Callable[[Array], Array]
    first_piece: int
    last_piece: int | None

    def supports(self, piece: int) -> bool:
        """Whether the density is non-zero on [piece, piece + 1]."""
        return piece >= self.first_piece and (self.last_piece is None or piece < self.last_piece)


def sphere_chord(radius: float) -> FlightLaw:
    """Flights between Lambertian points of a sphere: p(l) = l / (2 R^2) on [0, 2R], `radius` in metres.

    Mean 4R/3, variance 2R^2/9. Source: Fry et al., Applied Optics 45 (2006), integrating-cavity theory.
    """
    return FlightLaw(2.0 * _length("radius", radius), lambda x: 2.0 * x, 0, 1)


def plate_gap(separation: float) -> FlightLaw:
    """Flights between infinite parallel Lambertian plates: p(r) = 2 h^2 / r^3 for r >= h, `separation` h in metres.

    Mean 2h, infinite variance.
    """
    return FlightLaw(_length("separation", separation), lambda x: 2.0 / x**3, 1, None)


def checked_edges(edges_opl: ArrayLike) -> Array:
    """Bin edges as a float64 array of shape (T + 1,), metres; ShapeError or UnitError unless finite and increasing."""
    edges = np.asarray(edges_opl, dtype=np.float64)
    if edges.ndim != 1 or edges.size < 2:
        raise ShapeError(f"edges_opl: expected one row of at least two edges, got shape {edges.shape}")
    if not np.all(np.isfinite(edges)) or np.any(np.diff(edges) <= 0):
        raise UnitError("edges_opl: expected finite, strictly increasing lengths in metres")
    return edges


def delta_mass(edges_opl: ArrayLike, opl: float) -> Array:
    """Bins (T,) of one unit of energy that arrives at exactly `opl`; bins are half-open [start, end)."""
    edges = checked_edges(edges_opl)
    mass = np.zeros(edges.size - 1)
    index = int(np.searchsorted(edges, opl, side="right")) - 1
    if 0 <= index < mass.size:
        mass[index] = 1.0
    return mass


def flight_masses(law: FlightLaw, edges_opl: ArrayLike, start_opl: float = 0.0) -> Iterator[Array]:
    """Yield for n = 0, 1, 2, ... the probability (T,) that `start_opl` plus n flights end in each bin.

    Row 0 is a delta at `start_opl`. Rows are integrals over the bins, not densities times widths; what lies beyond the
    last edge is not in any bin. Endless: the caller stops.
    """
    edges = checked_edges(edges_opl)
    yield delta_mass(edges, start_opl)
    x = np.maximum((edges - start_opl) / law.unit, 0.0)
    pieces = max(1, math.ceil(x[-1]))
    grid = _Grid(law, pieces)
    values = grid.one_flight()
    while True:
        yield np.diff(grid.cumulative(values, x))
        values = grid.add_flight(values)


class _Grid:
    """Piecewise densities on [0, pieces], as values (pieces, NODES) at Gauss-Legendre nodes."""

    def __init__(self, law: FlightLaw, pieces: int) -> None:
        self.law = law
        self.pieces = pieces
        points, weights = legendre.leggauss(NODES)
        self.nodes, self.weights = (points + 1.0) / 2.0, weights / 2.0
        self.to_coefficients = np.asarray(np.linalg.inv(legendre.legvander(points, NODES - 1)), dtype=np.float64)
        self.operators = {d: op for d in range(pieces) if (op := self._operator(d)) is not None}

    def one_flight(self) -> Array:
        """Values of the density of a single flight."""
        values = np.zeros((self.pieces, NODES))
        for piece in range(self.pieces):
            if self.law.supports(piece):
                values[piece] = self.law.density(piece + self.nodes)
        return values

    def add_flight(self, values: Array) -> Array:
        """Convolve the density `values` with the one of a flight."""
        result = np.zeros_like(values)
        for shift, operator in self.operators.items():
            result[shift:] += values[: self.pieces - shift] @ operator.T
        return result

    def cumulative(self, values: Array, x: Array) -> Array:
        """Integral of the density from 0 to every x (in units of the law)."""
        coefficients = values @ self.to_coefficients.T
        before = np.concatenate([[0.0], np.cumsum(values @ self.weights)])
        piece = np.minimum(x.astype(np.int64), self.pieces - 1)
        antiderivative = legendre.legint(coefficients, lbnd=-1, axis=1) / 2.0
        basis = legendre.legvander(2.0 * (x - piece) - 1.0, NODES)
        return np.asarray(before[piece] + (basis * antiderivative[piece]).sum(axis=1), dtype=np.float64)

    def _basis(self, v: Array) -> Array:
        """The Lagrange polynomials of the nodes at positions v (...), shape (..., NODES)."""
        return np.asarray(legendre.legvander(2.0 * v - 1.0, NODES - 1) @ self.to_coefficients, dtype=np.float64)

    def _operator(self, shift: int) -> Array | None:
        """What the density on piece i, (NODES,), adds at the nodes of piece i + shift; None if nothing.

        q(t) = int_0^t p(v) k(shift + t - v) dv + int_t^1 p(v) k(shift + t - v) dv: the first integral sees the flight's
        piece `shift`, the second the piece before it, so each integrand is smooth.
        """
        operator = np.zeros((NODES, NODES))
        t = self.nodes[:, None]
        for piece, low, width in ((shift, np.zeros_like(t), t), (shift - 1, t, 1.0 - t)):
            if self.law.supports(piece):
                v = low + width * self.nodes
                density = self.law.density(shift + t - v)
                operator += np.einsum("tq,tqk->tk", width * self.weights * density, self._basis(v))
        supported = self.law.supports(shift) or self.law.supports(shift - 1)
        return operator if supported else None


def _length(name: str, value: float) -> float:
    number = float(value)
    if not math.isfinite(number) or number <= 0:
        raise UnitError(f"{name}: expected a finite length in metres greater than zero, got {value!r}")
    return number
