"""Loops over the bins of a long temporal kernel: what unrolled code does for a short one.

``layout`` is a plain object with the arrays that are scattered to or gathered from: Dr.Jit loops leave it alone, where
they would take local variables for loop state.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


class BinLayout:
    """Where one event meets the film: arrays, index of the histogram's first value, strides, bins and channels."""

    def __init__(self, flat, base, bin_stride, channel_stride, bins, channels, exclusive=False):
        self.flat, self.base = flat, base
        self.bin_stride, self.channel_stride = bin_stride, channel_stride
        self.bins, self.channels = bins, channels
        self.mode = reduce_mode(exclusive)


def reduce_mode(exclusive, direct=False):
    """How lanes add that share their target with others (``Auto``: atomically, lanes with the same address together),
    or that have one of their own. ``direct``: each lane by itself.
    """
    if exclusive:
        return dr.ReduceMode.NoConflicts
    return dr.ReduceMode.Direct if direct else dr.ReduceMode.Auto


@dr.syntax
def put(layout, kernel, x, value, slope_value, active):
    """Add ``value`` times the weight and ``slope_value`` times its slope per bin; returns the shares of the weight
    before and after the window. ``slope_value`` may be None.
    """
    k, node, share = kernel.begin(x)
    end = k + kernel.count
    low, low_pdf = kernel.edge(node, share)
    before, after = mi.Float(0), mi.Float(0)
    going = mi.Bool(active)
    while dr.hint(going, label="long temporal kernel"):
        node += kernel.nodes_per_bin
        high, high_pdf = kernel.edge(node, share)
        weight, dweight = high - low, low_pdf - high_pdf
        before += dr.select(k < 0, weight, 0)
        after += dr.select(k >= layout.bins, weight, 0)
        inside = going & (k >= 0) & (k < layout.bins)
        scatter(layout, inside, k, weight, dweight, value, slope_value)
        low, low_pdf = mi.Float(high), mi.Float(high_pdf)
        k += 1
        going = k < end
    return before, after


def scatter(layout, inside, k, weight, dweight, value, slope_value):
    """Add to one bin."""
    index = dr.fma(mi.UInt32(k), layout.bin_stride, layout.base)
    for c in range(layout.channels):
        v = value[c] * weight
        if slope_value is not None:
            v += slope_value[c] * dweight
        index_c = index + c * layout.channel_stride
        dr.scatter_reduce(dr.ReduceOp.Add, layout.flat, type(layout.flat)(v), index_c, inside, layout.mode)


@dr.syntax
def read(layout, kernel, x, active, steady=None):
    """Weighted sum of a cube's entries and its slope per bin: two lists over channels. ``steady``: list that is added
    to every entry.
    """
    k, node, share = kernel.begin(x)
    end = k + kernel.count
    low, low_pdf = kernel.edge(node, share)
    A, slope = [mi.Float(0) for _ in range(layout.channels)], [mi.Float(0) for _ in range(layout.channels)]
    going = mi.Bool(active)
    while dr.hint(going, label="long temporal kernel, adjoint"):
        node += kernel.nodes_per_bin
        high, high_pdf = kernel.edge(node, share)
        A, slope = gathered(layout, going, k, high - low, low_pdf - high_pdf, steady, A, slope)
        low, low_pdf = mi.Float(high), mi.Float(high_pdf)
        k += 1
        going = k < end
    return A, slope


def gathered(layout, going, k, weight, dweight, steady, A, slope):
    """The sums with one more bin."""
    inside = going & (k >= 0) & (k < layout.bins)
    index = dr.fma(mi.UInt32(k), layout.bin_stride, layout.base)
    values = []
    for c in range(layout.channels):
        a = mi.Float(0) if steady is None else dr.select(inside, steady[c], 0)
        if layout.flat is not None:
            a += dr.gather(mi.Float, layout.flat, index + c * layout.channel_stride, inside)
        values.append(a)
    return (
        [dr.fma(a, weight, s) for a, s in zip(values, A, strict=True)],
        [dr.fma(a, dweight, s) for a, s in zip(values, slope, strict=True)],
    )
