"""Contract entries of cameras: iToF, streak, gated, polarization, devices."""

from __future__ import annotations

from contract import Entry

ENTRIES: list[Entry] = []
