"""``gated_hdr_film``: the light behind every pixel as one or several time gates see it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError, TorchTransientError
from torchtransient.gates import SLOPE_REMEDY, gates_from_text, jump_in
from torchtransient.plugins._registry import register
from torchtransient.plugins.films.base import TimeResolvedFilm
from torchtransient.plugins.films.block import BinLayout, GappedWindow
from torchtransient.plugins.films.temporal_filters import pulse_of

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
        """Return the first and the last (exclusive) gate that an arrival can meet, UInt32.

        Args:
            opl: arrival, metres, Float64.
            active: mask of lanes.
        """
        inside = active & (opl >= self.first) & (opl < self.last)
        cell = mi.UInt32(dr.select(inside, (opl - self.first) * self._cell_scale, 0))
        cell = dr.minimum(cell, CELLS - 1)
        return dr.gather(mi.UInt32, self._low, cell, inside), dr.gather(mi.UInt32, self._high, cell, inside)

    def value(self, gate, opl, active):
        """Return the sensitivity of a gate to an arrival, and its slope per metre.

        Args:
            gate: number of the gate, UInt32.
            opl: arrival, metres, Float64.
            active: mask of lanes.
        """
        start, end = dr.gather(mi.Float64, self._start, gate, active), dr.gather(mi.Float64, self._end, gate, active)
        inside = active & (opl >= start) & (opl < end)
        scale = dr.gather(mi.Float, self._scale, gate, inside)
        x = mi.Float(opl - start) * scale
        i = dr.minimum(mi.UInt32(x), dr.gather(mi.UInt32, self._last_interval, gate, inside))
        at = dr.gather(mi.UInt32, self._offset, gate, inside) + i
        a, b = dr.gather(mi.Float, self._values, at, inside), dr.gather(mi.Float, self._values, at + 1, inside)
        return dr.select(inside, dr.fma(b - a, x - mi.Float(i), a), 0), (b - a) * scale


@dr.syntax
def _put_gates(layout, table, opl, value, slope_value, active):
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
def _read_gates(layout, table, opl, steady, active):
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


class GatedHDRFilm(TimeResolvedFilm):
    r"""Time-gated film (:monosp:`gated_hdr_film`): ``sum of radiance * gate(opl)`` for every gate.

    Parameters beside those of ``hdrfilm`` (size, crop, ``rfilter``):

    ``gates`` (string)
        Gates separated by semicolons: ``rectangular START END``, ``gaussian CENTER FWHM``, ``tabulated OPL:VALUE
        OPL:VALUE ...`` in metres of optical path, see :class:`torchtransient.gates.Gate`.
    ``pulse``, ``irf`` (as for ``transient_hdr_film``)
        Pulse of the light and impulse response of the sensor: every arrival is spread by them before a gate is asked.
    nested spectra (spectral variants)
        Response curves of the sensor's channels, see :class:`.colour.SensorResponse`.

    ``develop()`` returns ``(steady (H, W, C), gated (H, W, G, C))`` with the gates in the order given. *Steady is the
    sum over the gates*, not the image that an open shutter would see: integrators spend nothing on light that no gate
    lets through. Paths end where they are longer than the last gate, and no shadow ray is traced for light that would
    arrive while all gates are closed; neither changes any expected value. Light outside of the gates is not counted:
    ``energy_before`` and ``energy_after`` are zero.

    Gradients through the path length need gates that rise from zero and fall to zero (``gaussian``, ``tabulated`` with
    zeros at both ends, or a pulse); any other gate has no slope and asking for one raises GradientError. Filter
    settings of an integrator are ignored. A profile is straight between 2049 points, or exact where its own points
    are at equal distances.

    Not supported: alpha channel, half precision.
    """

    plugin = "gated_hdr_film"
    knows_exclusive_lanes = True
    measures = "gated"
    has_window = False
    keeps_steady = False
    slope_remedy = SLOPE_REMEDY

    def __init__(self, props):
        super().__init__(props)
        if "gates" not in props:
            raise SceneError(
                "gated_hdr_film: expected gates, for instance gates='rectangular 6.0 6.4; gaussian 7.0 0.3', got none."
            )
        try:
            self.gates = gates_from_text(props["gates"])
        except TorchTransientError as error:
            raise SceneError(f"gated_hdr_film: {error}") from error
        self.pulses = [p for p in (pulse_of(props, name, self.plugin) for name in ("pulse", "irf")) if p is not None]
        seen = self.gates
        for pulse in self.pulses:
            seen = tuple(gate.spread(pulse) for gate in seen)
        self._has_slope = all(gate.is_continuous for gate in seen)
        self.table = GateTable(seen, self.start_opl)
        self._window = GappedWindow(self.table.first, self.table.last, self.table.open_cells)

    @property
    def has_slope(self) -> bool:
        """All gates are continuous."""
        return self._has_slope

    @property
    def response_name(self) -> str:
        return jump_in(self.gates) or "gate"

    def arrivals(self):
        """Return the window of arrivals while some gate is open."""
        return self._window

    # ---------------------------------------------------------------------------------------- storage

    def gate_count(self) -> int:
        """Return the number of gates, G."""
        return self.table.count

    def cube_shape(self) -> tuple[int, ...]:
        """Return the shape of the gated images: (H, W, G, C) or (H, W, Lh, Lw, G, C)."""
        size = self.crop_size()
        return (int(size[1]), int(size[0]), *self.laser_shape(), self.gate_count(), self.channel_count())

    # ----------------------------------------------------------------------------------- splat and read

    def put(self, band, base, opl_from_start, value, active, exclusive=False):
        _put_gates(self._layout(band, base, exclusive), self.table, opl_from_start, value, None, active)
        return mi.Float(0), mi.Float(0)

    def put_slope(self, band, base, opl_from_start, d_value, value_d_opl, active):
        _put_gates(self._layout(band, base), self.table, opl_from_start, d_value, value_d_opl, active)

    def read(self, adjoint, base, opl_from_start, active, steady=None):
        channels = self.channel_count()
        flat, gate_stride, channel_stride = (None, 1, 1) if adjoint is None else adjoint
        layout = BinLayout(flat, base, gate_stride, channel_stride, self.gate_count(), channels)
        return _read_gates(layout, self.table, mi.Float64(opl_from_start), steady, active)

    def _layout(self, band, base, exclusive=False):
        channels = self.channel_count()
        return BinLayout(self.band_array(band), base, channels, 1, self.gate_count(), channels, exclusive)

    def to_string(self):
        return (
            f"GatedHDRFilm[\n  size = {self.size()},\n  crop = {self.crop_size()} at {self.crop_offset()},\n"
            f"  gates = {self.gate_count()} between {self.table.first + self.start_opl:g} m and "
            f"{self.table.last + self.start_opl:g} m\n]"
        )


register("film", "gated_hdr_film", GatedHDRFilm)
