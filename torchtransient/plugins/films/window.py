"""Which arrivals a film without a steady image counts, so that a path is not traced for nothing."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


class ArrivalWindow:
    """Arrivals between ``first`` and ``last`` (metres after the film's ``start_opl``) count, others do not.

    No later event of a path can count once the path itself is longer than ``last``. A plain object, which Dr.Jit loops
    leave alone.
    """

    def __init__(self, first: float, last: float):
        self.first, self.last = float(first), float(last)

    def counts(self, opl):
        """Whether an arrival at ``opl`` (``Float64``) can count."""
        return (opl >= self.first) & (opl < self.last)

    def over(self, opl):
        """Whether nothing that arrives at ``opl`` or later can count."""
        return opl >= self.last


class GappedWindow(ArrivalWindow):
    """A window in which equal cells of time count or not, for gates with gaps in between."""

    def __init__(self, first: float, last: float, cells):
        super().__init__(first, last)
        self._cells = mi.UInt32(cells)
        self._scale = len(cells) / (self.last - self.first)

    def counts(self, opl):
        inside = super().counts(opl)
        cell = mi.UInt32(dr.select(inside, (opl - self.first) * self._scale, 0))
        cell = dr.minimum(cell, dr.width(self._cells) - 1)
        return dr.gather(mi.UInt32, self._cells, cell, inside) == 1
