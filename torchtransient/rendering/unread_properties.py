"""Properties that no plugin has read: Mitsuba's report of them, and what to do."""

from __future__ import annotations

import re

from torchtransient.plain_texts import some_of

_REPORT = re.compile(
    r'While loading (?P<where>.*): Found \d+ unreferenced propert(?:y|ies) in \w+ plugin of type "(?P<plugin>[^"]*)":'
    r"(?P<list>(?:\n  - .*)+)"
)
_ONE = re.compile(r'\n  - \w+ "(?P<name>[^"]*)": (?P<value>.*)')
# Of mitransient, which reads them.
_INSTEAD = {
    "nlos_hidden_geometry_sampling_max_depth": "hidden geometry is sampled at all depths up to max_depth",
    "original_film_width": "the film itself says its width",
    "original_film_height": "the film itself says its height",
}


def unread_properties(text: str, description: str) -> str | None:
    """What to say in place of Mitsuba's ``text``, None where that reports something else. ``description``: the name of
    the scene that was being loaded.
    """
    report = _REPORT.search(text)
    if report is None:
        return None
    plugin, found = report["plugin"], dict(_ONE.findall(report["list"]))
    # In files the place begins with the name of the file.
    where = report["where"] if report["where"].startswith(description) else f"{description}: {report['where']}"
    named = some_of([f"{name!r} = {value}" for name, value in found.items()])
    hints = [f"Leave {name!r} out: {_INSTEAD[name]}." for name in found if name in _INSTEAD]
    if plugin != "transient_nlos_path":
        nlos = [name for name in found if name.startswith("nlos_") and name not in _INSTEAD]
        hints += [f"{', '.join(map(repr, nlos))}: transient_nlos_path reads such."] if nlos else []
    if len(hints) < len(found):
        hints.append("Misspelt, of another plugin, or without effect beside the others: mend it, or leave it out.")
    return f"{where}: {plugin!r} does not read {named}. {' '.join(hints)}"
