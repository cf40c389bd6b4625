"""Histograms with a line of many bins, which is applied to all arrivals together.

With the line, a bin receives the share ``W(x)`` of an arrival at ``x`` (in bins, from the start of the bin), and an
arrival adds to as many bins as the line is wide. Here it adds to three nodes, by the quadratic B-spline ``B``. A bin
has ``k`` nodes, at ``x_e = (e + 1/2) / k``. When a render ends, it becomes the sum of nodes times ``M_e``, with

    sum over e of B(k x - e - 1/2) M_e = W(x)   at x = x_e.

There ``B`` is 1/8, 3/4, 1/8, so that ``M`` is ``W`` convolved with ``sqrt(2) z^|j|``, ``z = 2 sqrt(2) - 3``. Between
nodes the response is off by ``sqrt(3) / 216 max|W'''| / k^3`` to leading order; ``k`` is the least with an error below
1e-3 of the largest ``W``. The response has a continuous slope, and derivatives are those of what is rendered. In
reverse mode the adjoint of the nodes is that of the bins by the transpose of ``M``.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.films.histogram import TransientHDRFilm
from torchtransient.plugins.films.temporal_filters import PulsedFilter, with_filter
from torchtransient.pulses import cumulative_of_sum

# Largest error of a response, in its largest value.
LARGEST_ERROR = 1e-3
# Where a bin needs more nodes, the line covers few bins.
MOST_PARTS = 8
# Nodes of a bin, which are written out in a kernel: a line with more is added arrival by arrival.
MOST_WEIGHTS = 256
# Values of all nodes (2 GiB), beyond which arrivals are added to the bins.
MOST_VALUES = 2**29
# Values of which all threads together may have copies of their own (1 GiB), so that they need no atomic additions.
MOST_COPIES = 2**28
# Channels that are written or read at once.
PACKET = 4
_Z = 2 * math.sqrt(2) - 3
# Nodes until z^j is rounding, and weights that are.
_REACH = 16
_ROUNDING = 1e-6


class SplinedFilter(PulsedFilter):
    """The temporal filter ``base`` spread by ``pulses``, and the weights of nodes that make bins of it.

    Attributes:
        parts: nodes of a bin, ``k``; 0 where the film has none, for lines of few bins or of too many.
        below: nodes before the start of the first bin.
        weights_count: nodes that a bin is the sum of, a multiple of ``parts``.
        node_weights: their weights ``M``, Float.
    """

    def __init__(self, base, pulses, bin_width_opl: float):
        super().__init__(base, pulses, bin_width_opl)
        self.bin_width_opl, self.parts, self.below, self.weights_count = bin_width_opl, 0, 0, 0
        spread = with_filter(pulses, base, bin_width_opl)
        for parts in range(1, MOST_PARTS + 1):
            below, weights, error = spline_of(spread, bin_width_opl, parts)
            if error <= LARGEST_ERROR:
                break
        if error <= LARGEST_ERROR and weights.size <= MOST_WEIGHTS:
            self.parts, self.below, self.weights_count = parts, below, weights.size
            self.node_weights = mi.Float(weights.astype(np.float32))

    def node(self, opl_from_start):
        """Return the node of an arrival (metres, Float64), counted from the first one, and the distance from it."""
        u = dr.fma(opl_from_start, self.parts / self.bin_width_opl, self.below)
        node = dr.floor(u)
        return node, mi.Float(u - node) - 0.5


def spline_of(pulses, width: float, parts: int):
    """Return (nodes before the start of a bin, weights ``M`` of the nodes, error of the response in its largest value).

    Args:
        pulses: pulses that spread the arrivals, without the bin itself.
        width: width of a bin, metres.
        parts: number of nodes in a bin.
    """
    fine = 8 * parts
    start, values = cumulative_of_sum(pulses, width / fine)

    def share(x):
        edges = np.stack([1 - x, -x]) * fine
        upper, lower = np.interp(edges, start + np.arange(values.size), values)
        return upper - lower

    below = math.ceil((start + values.size) / 8) + _REACH
    above = math.ceil((fine - start) / 8) + _REACH
    nodes = (np.arange(-below, above) + 0.5) / parts
    inverse = math.sqrt(2) * _Z ** np.abs(np.arange(-_REACH, _REACH + 1))
    weights = np.convolve(share(nodes), inverse)[_REACH:-_REACH]
    # Light stays positive, and all of it is counted.
    weights[weights < _ROUNDING * weights.max()] = 0
    used = np.flatnonzero(weights)
    first, last = used[0] - 2, used[-1] + 3
    last += -(last - first) % parts
    weights, nodes, below = weights[first:last], nodes[first:last], below - first
    weights = (weights.reshape(-1, parts) / weights.reshape(-1, parts).sum(0)).ravel()
    error = 0.0
    for d in (np.arange(8) + 0.5) / 8 - 0.5:
        left, middle, right = (w for w, _ in _splines(d))
        found = left * weights[:-2] + middle * weights[1:-1] + right * weights[2:]
        error = max(error, float(np.abs(found - share(nodes[1:-1] + d / parts)).max()))
    return below, weights, error / float(share(nodes).max())


def _splines(d):
    """Return (value, slope) of the quadratic B-splines of the nodes before, at and after ``d``, -1/2 to 1/2."""
    return (
        (0.5 * (0.5 - d) * (0.5 - d), d - 0.5),
        (0.75 - d * d, -2 * d),
        (0.5 * (0.5 + d) * (0.5 + d), d + 0.5),
    )


class SplinedHDRFilm(TransientHDRFilm):
    """Base of histogram films that apply pulses and temporal filter when a render ends.

    Until then the array is ``(..., nodes, lanes)`` in place of ``(..., T, C)``, with a multiple of four lanes for more
    than one channel. Lines that cover few bins, or more than 256 nodes, and films with more than 2 GiB of nodes are
    added arrival by arrival.

    Not supported: exhaustive scans, arrays that are lent.
    """

    pulsed_filter = SplinedFilter
    # What an arrival counts in the sum over all rows.
    share = 1.0

    def can_borrow(self, samples):
        return False

    def node_count(self) -> int:
        """Return the number of nodes of a histogram."""
        return self.filter.parts * (self.temporal_bins - 1) + self.filter.weights_count

    def lanes(self) -> int:
        """Return the number of values of a node."""
        channels = self.channel_count()
        return channels if channels == 1 else -(-channels // PACKET) * PACKET

    @property
    def splined(self) -> bool:
        """Arrivals are added to nodes."""
        return bool(self.filter.parts) and math.prod(self._node_shape()) <= MOST_VALUES

    def _node_shape(self):
        return (*self.cube_shape()[:-2], self.node_count(), self.lanes())

    def storage_shape(self):
        return self._node_shape() if self.splined else super().storage_shape()

    # ----------------------------------------------------------------------------------- splat and read

    def _place(self, base, opl_from_start, active):
        """Return (mask of arrivals before all nodes, behind them, between them; nodes of the latter as indices of their
        first packets; distance from the middle one).
        """
        node, d = self.filter.node(opl_from_start)
        # Weights of the first and of the last node are zero.
        last = self.node_count() - 1
        before, after = node < 1, node >= last
        packet = 1 if self.lanes() == 1 else PACKET
        stride = self.lanes() // packet
        # The first one wraps around below zero and back again.
        first = dr.fma(mi.UInt32(mi.Int32(node)), stride, base // packet - stride)
        # Lengths that are not numbers are nowhere.
        return before, after, active & (node >= 1) & (node < last), [first, first + stride, first + 2 * stride], d

    def _add(self, cube, index, values, inside):
        copies = dr.backend_v(cube) is dr.JitBackend.LLVM and dr.width(cube) * dr.thread_count() <= MOST_COPIES
        mode = dr.ReduceMode.Expand if copies else dr.ReduceMode.Auto
        if not copies or self.lanes() == 1:
            first = index if self.lanes() == 1 else index * PACKET
            for c, value in enumerate(values):
                dr.scatter_reduce(dr.ReduceOp.Add, cube, type(cube)(value), first + c, inside, mode)
            return
        packet = mi.Vector4d if dr.type_v(cube) == dr.VarType.Float64 else mi.Vector4f
        values = [*values, *[mi.Float(0)] * (self.lanes() - len(values))]
        for c in range(0, self.lanes(), PACKET):
            some = packet(*values[c : c + PACKET])
            dr.scatter_reduce(dr.ReduceOp.Add, cube, some, index + c // PACKET, inside, mode)

    def put(self, band, base, opl_from_start, value, active, exclusive=False, crowded=False):
        if not self.splined:
            return super().put(band, base, opl_from_start, value, active, exclusive, crowded)
        before, after, inside, nodes, d = self._place(base, opl_from_start, active)
        for node, (weight, _) in zip(nodes, _splines(d), strict=True):
            self._add(self.band_array(band), node, [v * weight for v in value], inside)
        return dr.select(before, mi.Float(1), 0), dr.select(after, mi.Float(1), 0)

    def put_slope(self, band, base, opl_from_start, d_value, value_d_opl, active):
        if not self.splined:
            super().put_slope(band, base, opl_from_start, d_value, value_d_opl, active)
            return
        _, _, inside, nodes, d = self._place(base, opl_from_start, active)
        scale = self.filter.parts / self.bin_width_opl
        for node, (weight, slope) in zip(nodes, _splines(d), strict=True):
            values = [a * weight + b * (slope * scale) for a, b in zip(d_value, value_d_opl, strict=True)]
            self._add(self.band_array(band), node, values, inside)

    def read(self, adjoint, base, opl_from_start, active, steady=None):
        if not self.splined:
            return super().read(adjoint, base, opl_from_start, active, steady)
        channels = self.channel_count()
        _, _, inside, nodes, d = self._place(base, opl_from_start, active)
        scale = self.filter.parts / self.bin_width_opl
        A, slope = [mi.Float(0)] * channels, [mi.Float(0)] * channels
        for node, (weight, dweight) in zip(nodes, _splines(d), strict=True):
            values = self._gathered(adjoint[0], node, inside)
            for c in range(channels):
                A[c] = dr.fma(values[c], weight, A[c])
                slope[c] = dr.fma(values[c], dweight * scale, slope[c])
        return A, slope

    def _gathered(self, flat, index, inside):
        if self.lanes() == 1:
            return [dr.gather(mi.Float, flat, index, inside)]
        packets = [dr.gather(mi.Vector4f, flat, index + n, inside) for n in range(self.lanes() // PACKET)]
        return [value for packet in packets for value in packet]

    # ----------------------------------------------------------------------------------- nodes and bins

    def finish_render(self):
        super().finish_render()
        if self.splined:
            _, height, nodes = self.bands[0]
            self.bands = [(0, height, self._bins_of(nodes))]
            dr.eval(self.bands[0][2], self.outside)

    def _bins_of(self, nodes):
        """Return the array of bins, and count as outside the light that the line spreads over the window's rims."""
        *rows, bins, channels = self.cube_shape()
        row, channel = _divided(dr.arange(mi.UInt32, math.prod(rows) * channels), channels)
        sweep = Sweep(self, nodes, dr.empty(mi.Float, math.prod(rows) * bins * channels))
        first = row * (self.node_count() * self.lanes()) + channel
        before, sums = swept(sweep, first, row * (bins * channels) + channel)
        after, names = sum(sums[:-1]), len(self.channel_names())
        for side, energy in enumerate((before, after)):
            pixel = row // self.row_count()
            part = energy * (self.share / names)
            dr.scatter_reduce(dr.ReduceOp.Add, self.outside, part, pixel * 2 + side, channel < names)
        return sweep.bins

    def stored_adjoint(self, adjoint):
        if not self.splined:
            return adjoint
        flat, offset, strides = adjoint
        shape, channels = self._node_shape(), self.channel_count()
        row, channel = _divided(dr.arange(mi.UInt32, math.prod(shape[:-2]) * channels), channels)
        rest, at = row, mi.UInt32(offset) + channel * strides[-1]
        for size, stride in zip(shape[-3:0:-1], strides[-3:0:-1], strict=True):
            rest, place = _divided(rest, size)
            at += place * stride
        at += rest * strides[0]
        # Numbers of lanes without a channel are read with the others, and count nowhere.
        sweep = Sweep(self, dr.empty(mi.Float, math.prod(shape)), flat)
        swept_back(sweep, at, strides[-2], row * (shape[-2] * shape[-1]) + channel)
        dr.eval(sweep.nodes)
        return sweep.nodes, 0, tuple(int(stride) for stride in np.cumprod((1, *shape[:0:-1]))[::-1])


def _divided(index, size: int):
    """Return quotient and remainder, UInt32."""
    quotient = index // size
    return quotient, index - quotient * size


class Sweep:
    """Arrays and weights of :func:`swept` and :func:`swept_back`. A plain object, which Dr.Jit loops leave alone.

    Args:
        film: film of the nodes.
        nodes: flat array of its nodes.
        bins: flat array of its bins.
    """

    def __init__(self, film, nodes, bins):
        self.nodes, self.bins = nodes, bins
        self.parts, self.lanes, self.channels = film.filter.parts, film.lanes(), film.channel_count()
        self.most = film.filter.weights_count // self.parts
        self.bin_count = film.temporal_bins
        self.count = self.bin_count + self.most - 1
        table = film.filter.node_weights
        self.weights = [dr.gather(mi.Float, table, mi.UInt32(e)) for e in range(film.filter.weights_count)]

    def add(self, sums, at):
        """Return the sums of bins with the nodes of one more bin, whose first is at ``at``."""
        sums = list(sums)
        for p in range(self.parts):
            value = dr.gather(mi.Float, self.nodes, at + p * self.lanes)
            for j in range(self.most):
                sums[j] = dr.fma(value, self.weights[(self.most - 1 - j) * self.parts + p], sums[j])
        return sums

    def spread(self, values, at):
        """Write the adjoint of the nodes of one bin, whose first is at ``at``.

        Args:
            values: adjoint of that bin and of those before it, which these nodes are part of.
            at: index of the first node and channel.
        """
        for p in range(self.parts):
            total = mi.Float(0)
            for j, value in enumerate(values):
                total = dr.fma(value, self.weights[j * self.parts + p], total)
            dr.scatter(self.nodes, total, at + p * self.lanes)


@dr.syntax
def swept(sweep, at, to):
    """Write the bins of all rows, each node read once.

    Args:
        sweep: :class:`Sweep`.
        at: index of each row's first node and channel.
        to: index of each row's first bin and channel.

    Returns:
        (sum of bins before the first one, list of those behind the last one and a zero).
    """
    sums, before = [mi.Float(0) for _ in range(sweep.most)], mi.Float(0)
    number = mi.UInt32(0)
    while dr.hint(number < sweep.count, label="bins of nodes"):
        sums = sweep.add(sums, at)
        inside = number >= sweep.most - 1
        before += dr.select(inside, 0, sums[0])
        dr.scatter(sweep.bins, sums[0], to + (number - (sweep.most - 1)) * sweep.channels, inside)
        sums = [*sums[1:], mi.Float(0)]
        at += sweep.parts * sweep.lanes
        number += 1
    return before, sums


@dr.syntax
def swept_back(sweep, at, stride, to):
    """Write the adjoint of the nodes of all rows, by the transpose of :func:`swept`: each bin is read once.

    Args:
        sweep: :class:`Sweep` with the adjoint of the bins.
        at: index of each row's first bin and channel.
        stride: step of the index from one bin to the next.
        to: index of the first node and channel.
    """
    values, number = [mi.Float(0) for _ in range(sweep.most)], mi.UInt32(0)
    while dr.hint(number < sweep.count, label="nodes of bins"):
        values = [dr.gather(mi.Float, sweep.bins, at, number < sweep.bin_count), *values[:-1]]
        sweep.spread(values, to)
        at += stride
        to += sweep.parts * sweep.lanes
        number += 1
