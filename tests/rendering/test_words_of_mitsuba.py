"""What Mitsuba says, in one line and in words of this library."""

from __future__ import annotations

import pytest

from torchtransient.rendering.mitsuba_words import one_line
from torchtransient.rendering.unread_properties import unread_properties


@pytest.mark.parametrize(("length", "kept"), [(599, 599), (600, 600), (601, 597), (2000, 597)])
def test_six_hundred_letters_at_most(length, kept):
    text = one_line(RuntimeError("a" * length))
    assert text == "a" * kept + ("" if kept == length else "...") and len(text) <= 600


def test_tracebacks_and_places_in_sources_are_left_out():
    said = 'no\n  such  lobe [bsdf.cpp:12] in "a"\nTraceback (most recent call last):\n  File "a", line 3\n\tmore\nend'
    assert one_line(RuntimeError(said)) == 'no such lobe in "a" end'


def report(plugin, *unread, where="room.xml (line 3, col 5)"):
    lines = "".join(f'\n  - {kind} "{name}": {value}' for kind, name, value in unread)
    word = "property" if len(unread) == 1 else "properties"
    kind = "integrator" if "path" in plugin else "film"
    return f'While loading {where}: Found {len(unread)} unreferenced {word} in {kind} plugin of type "{plugin}":{lines}'


DEPTH = ("integer", "nlos_hidden_geometry_sampling_max_depth", "3")
LASER = ("boolean", "nlos_laser_sampling", "true")
OTHER = ("integer", "max_dept", "4")
MISSPELT = "Misspelt, of another plugin, or without effect beside the others"


@pytest.mark.parametrize(
    ("plugin", "unread", "hints"),
    [
        ("transient_path", [OTHER], [MISSPELT]),
        ("transient_path", [DEPTH], ["Leave 'nlos_hidden_geometry_sampling_max_depth' out: hidden geometry is"]),
        ("transient_path", [LASER], ["'nlos_laser_sampling': transient_nlos_path reads such."]),
        ("transient_path", [DEPTH, LASER], ["Leave 'nlos_h", "'nlos_laser_sampling': transient_nlos_path reads such"]),
        ("transient_path", [DEPTH, OTHER], ["Leave 'nlos_hidden", MISSPELT]),
        ("transient_nlos_path", [LASER], [MISSPELT]),
        ("transient_nlos_path", [DEPTH], ["Leave 'nlos_hidden"]),
        ("transient_hdr_film", [("integer", "original_film_width", "9")], ["Leave 'original_film_width' out: "]),
    ],
)
def test_properties_that_nobody_has_read(plugin, unread, hints):
    text = unread_properties(f"Error: {report(plugin, *unread)}\nand more", "room.xml")
    named = [f"'{name}' = {value}" for _, name, value in unread]
    head, rest = text.split(" does not read ")
    assert head == f"room.xml (line 3, col 5): '{plugin}'"
    assert all(one in rest for one in (*named, *hints))
    for hint in (MISSPELT, "reads such", "Leave "):
        assert rest.count(hint) == sum(hint in one for one in hints)


def test_places_without_a_file_are_those_of_the_scene():
    place = 'dictionary node "film"'
    text = unread_properties(report("transient_hdr_film", OTHER, where=place), "scene dictionary")
    assert text.startswith(f"scene dictionary: {place}: 'transient_hdr_film' does not read 'max_dept' = 4.")
    assert unread_properties("no such plugin", "room.xml") is None
