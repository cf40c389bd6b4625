"""``gated_hdr_film``: the light behind every pixel as one or several time gates see it."""

from __future__ import annotations

import mitsuba as mi

from torchtransient.errors import SceneError, TorchTransientError
from torchtransient.gates import SLOPE_REMEDY, gates_from_text, jump_in
from torchtransient.plugins._registry import register
from torchtransient.plugins.films.base import TimeResolvedFilm
from torchtransient.plugins.films.gate_table import GateTable, put_gates, read_gates
from torchtransient.plugins.films.long_kernel import BinLayout
from torchtransient.plugins.films.pulsed_filter import pulse_of
from torchtransient.plugins.films.window import GappedWindow


class GatedHDRFilm(TimeResolvedFilm):
    r"""Time-gated film (:monosp:`gated_hdr_film`): ``sum of radiance * gate(opl)`` for every gate.

    Parameters beside those of ``hdrfilm`` (size, crop, ``rfilter``):

    ``gates`` (string)
        Gates separated by semicolons: ``rectangular START END``, ``gaussian CENTER FWHM``, ``tabulated OPL:VALUE
        OPL:VALUE ...`` in metres of optical path, see :class:`torchtransient.gates.Gate`.
    ``pulse``, ``irf`` (as for ``transient_hdr_film``)
        Pulse of the light and impulse response of the sensor: every arrival is spread by them before a gate is asked.
    nested spectra (spectral variants)
        Response curves of the sensor's channels, see :mod:`.response`.

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
        """Whether all gates are continuous."""
        return self._has_slope

    @property
    def response_name(self) -> str:
        return jump_in(self.gates) or "gate"

    @property
    def slope_remedy(self) -> str:
        return SLOPE_REMEDY

    def arrivals(self):
        """What can count: arrivals while some gate is open."""
        return self._window

    # ---------------------------------------------------------------------------------------- storage

    def gate_count(self) -> int:
        """G, the number of gates."""
        return self.table.count

    def cube_shape(self) -> tuple[int, ...]:
        """Shape of the gated images: (H, W, G, C) or (H, W, Lh, Lw, G, C)."""
        size = self.crop_size()
        return (int(size[1]), int(size[0]), *self.laser_shape(), self.gate_count(), self.channel_count())

    def entries_per_array(self) -> int:
        """Floats of the gates of one pixel and laser position."""
        return self.gate_count() * self.channel_count()

    # ----------------------------------------------------------------------------------- splat and read

    def put(self, band, base, opl_from_start, value, active, exclusive=False):
        put_gates(self._layout(band, base, exclusive), self.table, opl_from_start, value, None, active)
        return mi.Float(0), mi.Float(0)

    def put_slope(self, band, base, opl_from_start, d_value, value_d_opl, active):
        put_gates(self._layout(band, base), self.table, opl_from_start, d_value, value_d_opl, active)

    def read(self, adjoint, base, opl_from_start, active, steady=None):
        channels = self.channel_count()
        flat, gate_stride, channel_stride = (None, 1, 1) if adjoint is None else adjoint
        layout = BinLayout(flat, base, gate_stride, channel_stride, self.gate_count(), channels)
        return read_gates(layout, self.table, mi.Float64(opl_from_start), steady, active)

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
