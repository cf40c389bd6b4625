"""Events summed against the film's adjoint."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.transport.carry import total_of
from torchtransient.plugins.transport.sinks.sink import Sink


class AdjointSumSink(Sink):
    """Keeps ``sum``: that of ``A(opl) value`` over the events of a path, with the adjoint ``A`` of the film.

    What the light behind a point contributes to a loss: paths are traced from there, as a boundary term asks on both
    sides of an edge.
    """

    def __init__(self, block):
        self.block = block

    def begin(self, world):
        return {"sum": mi.Float(0)}

    def event(self, kept, event):
        A, _ = self.block.read(event.opl, event.active)
        kept["sum"] = kept["sum"] + dr.select(event.active, total_of(A, event.value), 0)
