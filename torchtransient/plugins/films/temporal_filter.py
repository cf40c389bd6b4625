"""Temporal filters: how one arrival spreads over the bins of the time axis.

A filter gives the weight ``k(x)`` of a bin by the distance ``x`` between arrival and the bin's centre, in bins. All
filters here are the bin's box convolved with a kernel of mass one, so they sum to one over the bins at every arrival
time and the sum of a transient over its bins stays the steady image:

======== ============================================================= =================== ===================
name     kernel                                                        slope               bins written
======== ============================================================= =================== ===================
box      none: the exact histogram, half-open bins ``[k, k + 1)``      none                1
tent     box of one bin: linear splat between the two nearest centres  piecewise constant  2
gaussian Gaussian of ``stddev`` bins s, cut at 4 s and rescaled        continuous but for  2 ceil(4 s) + 1
                                                                       3e-4 of its height
                                                                       at the cut
======== ============================================================= =================== ===================
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError

NAMES = ("box", "tent", "gaussian")
CUT_STDDEVS = 4.0


def check_stddev(stddev: float):
    """Raise ``SceneError`` unless ``stddev`` is a positive number of bins."""
    if not (math.isfinite(stddev) and stddev > 0):
        raise SceneError(f"gaussian_stddev: expected a positive number of bins, got {stddev!r}.")


def check_name(name: str):
    """Raise ``SceneError`` unless ``name`` is a filter."""
    if name not in NAMES:
        raise SceneError(f"temporal_filter: expected one of {', '.join(NAMES)}, got {name!r}.")


class BoxFilter:
    """Exact histogram. It has no usable slope in time, hence no gradient through the time of flight."""

    name = "box"
    has_slope = False
    # Bins before and after an arrival that it can reach.
    reach = (0.0, 0.0)

    def weights(self, x):
        """Weights of one arrival.

        ``x`` is the arrival in bins (0 is the start of bin 0), ``Float64``. Returns a bin (``Float64``, which may lie
        outside of the axis) and a list of ``(offset from that bin, weight, d weight / dx)``.
        """
        return dr.floor(x), [(0, mi.Float(1), mi.Float(0))]


class TentFilter:
    """Linear splat between the two nearest bin centres."""

    name = "tent"
    has_slope = True
    reach = (-0.5, 0.5)

    def weights(self, x):
        first = dr.floor(x - 0.5)
        a = mi.Float(x - 0.5 - first)
        return first, [(0, 1 - a, mi.Float(-1)), (1, a, mi.Float(1))]


class GaussianFilter:
    """The bin's box convolved with a Gaussian of ``stddev`` bins, cut at four standard deviations."""

    name = "gaussian"
    has_slope = True

    def __init__(self, stddev: float):
        check_stddev(stddev)
        self.stddev = float(stddev)
        self.radius = math.ceil(CUT_STDDEVS * stddev)
        self.reach = (-CUT_STDDEVS * self.stddev, CUT_STDDEVS * self.stddev)

    def weights(self, x):
        # The cumulative distribution, rescaled such that it is exactly 0 and 1 at the cut: the weights of an
        # arrival sum to one, whatever stddev is.
        scale = 1 / (self.stddev * math.sqrt(2))
        total = math.erf(CUT_STDDEVS / math.sqrt(2))
        density = 1 / (self.stddev * math.sqrt(2 * math.pi) * total)
        base = dr.floor(x)
        frac = mi.Float(x - base)

        def edge(position):
            u = position - frac
            inside = dr.abs(u) < CUT_STDDEVS * self.stddev
            cdf = dr.select(inside, 0.5 + 0.5 * dr.erf(u * scale) / total, dr.select(u > 0, mi.Float(1), mi.Float(0)))
            pdf = dr.select(inside, density * dr.exp(-dr.square(u * scale)), 0)
            return cdf, pdf

        taps = []
        low = edge(mi.Float(-self.radius))
        for k in range(-self.radius, self.radius + 1):
            high = edge(mi.Float(k + 1))
            taps.append((k, high[0] - low[0], low[1] - high[1]))
            low = high
        return base, taps


def make_temporal_filter(name: str, stddev: float = 0.5):
    """The filter called ``name`` (``box``, ``tent`` or ``gaussian``). Raises ``SceneError`` for another name."""
    check_name(name)
    if name == "box":
        return BoxFilter()
    return TentFilter() if name == "tent" else GaussianFilter(stddev)
