"""The profiles of all gates of a film in one table, and which gates an arrival can meet."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

CELLS = 4096


class GateTable:
    """Profiles of ``gates`` (see :class:`torchtransient.gates.Gate`) over lengths counted from ``start_opl``.

    A plain object, which Dr.Jit loops leave alone. Time is divided into cells, each with the range of gates that reach
    into it: of many gates only those are asked that an arrival can meet.
    """

    def __init__(self, gates, start_opl: float):
        self.count = len(gates)
        nodes = [gate.nodes() for gate in gates]
        starts = np.array([gate.start_opl - start_opl for gate in gates])
        ends = np.array([gate.end_opl - start_opl for gate in gates])
        sizes = np.array([len(values) for values in nodes])
        self.first, self.last = float(starts.min()), float(ends.max())
        self._values = mi.Float(np.concatenate([*nodes, [0.0]]).astype(np.float32))
        self._offset = mi.UInt32(np.cumsum([0, *sizes[:-1]]))
        self._start = mi.Float64(starts)
        self._end = mi.Float64(ends)
        # Intervals per metre.
        self._scale = mi.Float((sizes - 1) / (ends - starts))
        self._last_interval = mi.UInt32(sizes - 2)
        self._cell_scale = CELLS / (self.last - self.first)
        low, high = np.full(CELLS, self.count), np.zeros(CELLS, dtype=int)
        for g in range(self.count):
            # From the cell of the start to that of the end, as those of arrivals are rounded.
            a, b = (int((opl[g] - self.first) * self._cell_scale) for opl in (starts, ends))
            low[a : b + 1] = np.minimum(low[a : b + 1], g)
            high[a : b + 1] = np.maximum(high[a : b + 1], g + 1)
        self.open_cells = (high > low).astype(np.uint32)
        self._low, self._high = mi.UInt32(np.minimum(low, high)), mi.UInt32(high)
        dr.make_opaque(
            self._values, self._offset, self._start, self._end, self._scale, self._last_interval, self._low, self._high
        )

    def candidates(self, opl, active):
        """First and last (exclusive) gate that light arriving at ``opl`` (``Float64``) can meet."""
        inside = active & (opl >= self.first) & (opl < self.last)
        cell = mi.UInt32(dr.select(inside, (opl - self.first) * self._cell_scale, 0))
        cell = dr.minimum(cell, CELLS - 1)
        return dr.gather(mi.UInt32, self._low, cell, inside), dr.gather(mi.UInt32, self._high, cell, inside)

    def value(self, gate, opl, active):
        """Sensitivity of a gate to light arriving at ``opl`` and its slope per metre."""
        start, end = dr.gather(mi.Float64, self._start, gate, active), dr.gather(mi.Float64, self._end, gate, active)
        inside = active & (opl >= start) & (opl < end)
        scale = dr.gather(mi.Float, self._scale, gate, inside)
        x = mi.Float(opl - start) * scale
        i = dr.minimum(mi.UInt32(x), dr.gather(mi.UInt32, self._last_interval, gate, inside))
        at = dr.gather(mi.UInt32, self._offset, gate, inside) + i
        a, b = dr.gather(mi.Float, self._values, at, inside), dr.gather(mi.Float, self._values, at + 1, inside)
        return dr.select(inside, dr.fma(b - a, x - mi.Float(i), a), 0), (b - a) * scale


@dr.syntax
def put_gates(layout, table, opl, value, slope_value, active):
    """Add to every gate that light arriving at ``opl`` meets."""
    g, end = table.candidates(opl, active)
    going = mi.Bool(active) & (g < end)
    while dr.hint(going, label="gates put"):
        weight, slope = table.value(g, opl, going)
        _scatter(layout, g, weight, slope, value, slope_value, going & ((weight != 0) | (slope != 0)))
        g += 1
        going = g < end


def _scatter(layout, gate, weight, slope, value, slope_value, active):
    for c in range(layout.channels):
        v = value[c] * weight
        if slope_value is not None:
            v += slope_value[c] * slope
        index = dr.fma(gate, layout.bin_stride, layout.base) + c * layout.channel_stride
        dr.scatter_reduce(dr.ReduceOp.Add, layout.flat, type(layout.flat)(v), index, active, layout.mode)


@dr.syntax
def read_gates(layout, table, opl, steady, active):
    """Adjoint and its slope summed over the gates that light arriving at ``opl`` meets."""
    A, slope = [mi.Float(0) for _ in range(layout.channels)], [mi.Float(0) for _ in range(layout.channels)]
    g, end = table.candidates(opl, active)
    going = mi.Bool(active) & (g < end)
    while dr.hint(going, label="gates read"):
        weight, dweight = table.value(g, opl, going)
        A, slope = _gathered(layout, g, weight, dweight, steady, A, slope, going)
        g += 1
        going = g < end
    return A, slope


def _gathered(layout, gate, weight, dweight, steady, A, slope, active):
    index = dr.fma(gate, layout.bin_stride, layout.base)
    total_A, total_slope = [], []
    for c in range(layout.channels):
        a = mi.Float(0) if steady is None else steady[c]
        if layout.flat is not None:
            a = a + dr.gather(mi.Float, layout.flat, index + c * layout.channel_stride, active)
        total_A.append(dr.fma(a, weight, A[c]))
        total_slope.append(dr.fma(a, dweight, slope[c]))
    return total_A, total_slope
