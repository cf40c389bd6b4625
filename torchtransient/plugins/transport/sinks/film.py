"""Events onto the film."""

from __future__ import annotations

import mitsuba as mi

from torchtransient.plugins.polarized import light_type
from torchtransient.plugins.transport.sinks.sink import Sink


class FilmSink(Sink):
    """Puts events into a film's block; keeps the sum ``L`` over all times, and the energy ``before`` and ``after`` the
    film's window.
    """

    keeps_vertices = False

    def __init__(self, block):
        self.block = block

    def begin(self, world):
        return {"L": light_type()(0), "before": mi.Float(0), "after": mi.Float(0), "block": self.block.begin()}

    def event(self, kept, event):
        kept["L"] = kept["L"] + event.value
        before, after = self.block.put(kept["block"], event.opl, event.value, event.active, event.crowded)
        kept["before"] = kept["before"] + before
        kept["after"] = kept["after"] + after

    def end(self, kept):
        self.block.end(kept["block"])
