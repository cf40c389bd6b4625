"""A new effect is one file and the entry below: the contract's tests come with it."""

from __future__ import annotations

from support.sensing.contract import Entry
from support.sensing.toy_effect import StrayLight
from torchtransient.errors import UnitError

ENTRIES: list[Entry] = [
    Entry(
        "StrayLight",
        lambda: StrayLight(0.1),
        conserves=lambda y: y.sum(),
        errors=((lambda: StrayLight(1.5), UnitError),),
    ),
]
