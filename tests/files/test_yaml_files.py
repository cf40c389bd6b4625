"""YAML as checked plain data: entries by name and kind, files beside it, and keys of what a simulation depends on."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from torchtransient.errors import MissingPackageError, SceneError, StorageError
from torchtransient.files import plain_data as entries
from torchtransient.files.content_key import content_key, contents_of
from torchtransient.files.yaml_files import Section, as_number, file_beside, read_yaml


def test_texts_files_and_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert read_yaml("a: 1\nb: [2, x]", "recipe") == ({"a": 1, "b": [2, "x"]}, tmp_path)
    folder = tmp_path / "set up"
    folder.mkdir()
    (folder / "set up.yaml").write_text("a: 3")
    for given in (folder, str(folder), folder / "set up.yaml", Path("set up")):
        assert read_yaml(given, "recipe") == ({"a": 3}, folder)
    with pytest.raises(StorageError, match=r"recipe: expected a text, but 'none\.yaml' cannot be read"):
        read_yaml("none.yaml", "recipe")
    for text, kind in (("- 1\n- 2", "list"), ("3\n", "int"), ("\n", "NoneType"), ("words\nand words", "str")):
        with pytest.raises(SceneError, match=f"recipe: expected names and values, .* got {kind}"):
            read_yaml(text, "recipe")


def test_names_stand_once_in_a_mapping():
    with pytest.raises(SceneError, match="recipe: b stands twice in the mapping at line 2; keep one"):
        read_yaml("a:\n  b: 1\n  c: 2\n  b: 3\nd: 4", "recipe")
    # Twice in two mappings, and once beside what is merged into it.
    text = "base: &base {b: 1, c: 2}\nother: {<<: *base, b: 3}\n"
    assert read_yaml(text, "recipe")[0]["other"] == {"b": 3, "c": 2}


def test_yaml_needs_its_package(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(MissingPackageError, match=r"recipe: YAML needs PyYAML.*torchtransient\[yaml\]"):
        read_yaml("a: 1\n", "recipe")


NAMES = ("number", "count", "flag", "name", "list", "nothing", "text_number")
DATA = {"number": 2.5, "count": 3, "flag": False, "name": "wall", "list": [1, 2.5], "nothing": None,
        "text_number": "1e-3"}  # fmt: skip
SECTION = Section(DATA, "recipe: scene", NAMES)


def test_entries_are_taken_out_by_name_and_kind():
    assert SECTION.number("number") == 2.5 and SECTION.number("text_number") == 1e-3 and SECTION.number("count") == 3.0
    assert SECTION.whole("count") == 3 and isinstance(SECTION.whole("count"), int)
    assert SECTION.whole("count", least=3) == 3 == SECTION.whole("count", least=None)
    assert SECTION.flag("flag", True) is False
    assert SECTION.text("name") == "wall" and SECTION.choice("name", ("floor", "wall")) == "wall"
    assert SECTION.numbers("list", (1, 2)) == [1.0, 2.5] and SECTION.get("list") == [1, 2.5]
    assert "number" in SECTION and "nothing" not in SECTION and "missing" not in SECTION


@pytest.mark.parametrize("name", ["nothing", "missing"])
def test_entries_that_are_missing_or_null_have_their_default(name):
    assert SECTION.get(name, 5) == 5 and SECTION.number(name, "auto") == "auto" and SECTION.whole(name, None) is None
    assert SECTION.whole(name, 0) == 0 and SECTION.flag(name, True) is True and SECTION.text(name, 3) == 3
    assert SECTION.choice(name, ("a", "b"), "b") == "b" and SECTION.numbers(name, (2,), "all") == "all"
    for ask in (SECTION.get, SECTION.number, SECTION.whole, SECTION.text):
        with pytest.raises(SceneError, match=f"recipe: scene: expected an entry '{name}', which is missing"):
            ask(name)


@pytest.mark.parametrize(("ask", "words"), [
    (lambda s: s.number("name"), "name: expected a finite number, got 'wall'"),
    (lambda s: s.number("flag"), "flag: expected a finite number"), (lambda s: s.number("list"), "list: expected a f"),
    (lambda s: s.whole("number"), r"number: expected a whole number of at least 1, got 2\.5"),
    (lambda s: s.whole("count", least=4), "count: expected a whole number of at least 4, got 3"),
    (lambda s: s.whole("number", least=None), r"number: expected a whole number, got 2\.5"),
    (lambda s: s.flag("count", True), "count: expected true or false, got 3"),
    (lambda s: s.text("count"), "count: expected a text, got 3"), (lambda s: s.text("flag"), "flag: expected a text"),
    (lambda s: s.choice("name", ("floor", "door")), "name: expected one of floor, door, got 'wall'"),
    (lambda s: s.choice("missing", ("floor",), None), "missing: expected one of floor, got None"),
    (lambda s: s.numbers("list", (1, 3)), r"list: expected a list of 1 or 3 numbers, got \[1, 2\.5\]"),
    (lambda s: s.numbers("number", (1,)), "number: expected a list of 1 numbers"),
    (lambda s: s.numbers("name", (4,)), "name: expected a list of 4 numbers"),
])  # fmt: skip
def test_entries_of_other_kinds(ask, words):
    with pytest.raises(SceneError, match=f"recipe: scene: {words}"):
        ask(SECTION)


def test_sections_are_mappings_of_known_names():
    with pytest.raises(SceneError, match="scene: expected names and values, got 3"):
        Section(3, "scene", NAMES)
    with pytest.raises(SceneError, match=r"scene: unknown entry 'numbr'\. Did you mean 'number'\? Known ones are nu"):
        Section({"numbr": 1}, "scene", NAMES)
    with pytest.raises(SceneError, match=r"scene: unknown entry 'xyz'\. Known ones are number, count"):
        Section({"number": 1, "xyz": 1}, "scene", NAMES)
    assert Section({}, "scene", ()).data == {}


@pytest.mark.parametrize("value", [math.nan, math.inf, "inf", "nan", "", "1 m", True, None, [1], 10**400])
def test_numbers_that_are_none(value):
    with pytest.raises(SceneError, match="here: expected a finite number"):
        as_number(value, "here")
    assert as_number("-2.5", "here") == -2.5 and as_number(7, "here") == 7.0


def test_files_beside_a_file(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    (tmp_path / "b" / "mesh.ply").write_text("ply")
    folders = [tmp_path / "a", tmp_path / "b", tmp_path / "a"]
    assert file_beside("mesh.ply", folders, "scene") == tmp_path / "b" / "mesh.ply"
    (tmp_path / "a" / "mesh.ply").mkdir()  # a folder is no file
    assert file_beside("mesh.ply", folders, "scene") == tmp_path / "b" / "mesh.ply"
    with pytest.raises(SceneError, match=rf"scene: no file 'x' in '{folders[0]}', '{folders[1]}'\. Give a path"):
        file_beside("x", folders, "scene")


# ----------------------------------------------------------------------------------------------------- keys of contents


@dataclass
class Part:
    """Of a scene."""

    width: float
    name: str


@dataclass
class Other:
    """As a part, of another kind."""

    width: float
    name: str


class Transform:
    """As Mitsuba's."""

    def __init__(self, matrix):
        self.matrix = matrix


class Mesh:
    """Of a library of meshes."""

    def __init__(self, vertices, faces):
        self.vertices, self.faces = vertices, faces


def different():
    """Things that are all unlike each other."""
    big = np.arange(5000.0)
    later = big.copy()
    later[2500] += 1e-9
    return [
        {"a": 1}, {"a": 2}, {"b": 1}, {"a": 1, "b": 2}, [1, 2], [2, 1], [1, [2]], "a", "b", 1, 1.5, True, None,
        Part(1.0, "x"), Part(2.0, "x"), Part(1.0, "y"), Other(1.0, "x"), big, later, big.astype(np.float32),
        big.reshape(50, 100), torch.tensor([1.0, 2.0]), torch.tensor([1, 2]), Transform(np.eye(4)),
        Transform(2 * np.eye(4)), Mesh(np.eye(3), [[0, 1, 2]]), Mesh(np.eye(3), [[0, 2, 1]]),
        Mesh(2 * np.eye(3), [[0, 1, 2]]),
    ]  # fmt: skip


def test_keys_are_equal_where_everything_is():
    keys = [content_key(one) for one in different()]
    assert keys == [content_key(one) for one in different()] and len(set(keys)) == len(keys)
    # What is the same in another coat.
    for one, other in (
        ((1, 2), [1, 2]), (torch.ones(3), np.ones(3, np.float32)), (torch.ones(3, requires_grad=True), torch.ones(3)),
        (Transform(np.eye(4)), np.eye(4)), (np.ones((4, 2)).T, np.ones((2, 4))),
    ):  # fmt: skip
        assert content_key(one) == content_key(other)
    assert content_key(1, 2) == content_key(1, 2) != content_key(2, 1) != content_key([1, 2])
    assert content_key(Part) == content_key(Part) and len(content_key()) == 64


def test_files_count_with_what_is_in_them(tmp_path):
    path = tmp_path / "mesh.ply"
    before = content_key({"mesh": str(path)})
    path.write_text("one")
    one = content_key({"mesh": str(path)})
    assert one == content_key({"mesh": path}) != before
    path.write_text("two")
    assert content_key({"mesh": path}) not in (one, before)
    assert contents_of(tmp_path) == contents_of(tmp_path / "none") == contents_of(Path("a\0b")) == ""
    assert len(contents_of(path)) == 64


# ----------------------------------------------------------------------------------------------------- entries of files

ENTRIES = {
    "text": np.array("wall"), "number": np.array([2.5]), "whole": 3.0, "flag": np.array(1), "off": False,
    "names": '["a", "b"]', "notes": '{"a": 1}', "nan": np.nan, "two": np.array([1.0, 0.0]), "complex": 1j, "three": 3,
    "texts": np.array(["a", "b"]), "mixed": '["a", 1]',
}  # fmt: skip


def test_entries_are_what_they_are_said_to_be():
    assert entries.text_of(ENTRIES, "text") == "wall" and entries.number_of(ENTRIES, "number") == 2.5
    assert entries.whole_of(ENTRIES, "whole") == 3 and isinstance(entries.whole_of(ENTRIES, "whole"), int)
    assert entries.flag_of(ENTRIES, "flag") is True and entries.flag_of(ENTRIES, "off") is False
    assert entries.names_of(ENTRIES, "names") == ("a", "b") and entries.notes_of(ENTRIES, "notes") == {"a": 1}


@pytest.mark.parametrize(("kind", "wrong", "words"), [
    ("text", ("number", "texts", "flag"), "as a text"),
    ("number", ("text", "nan", "two", "complex", "off"), "one finite"), ("whole", ("number", "text"), "number"),
    ("flag", ("text", "two", "three", "nan", "complex"), "as 0 or 1"),
    ("names", ("notes", "mixed"), "as a list of names"), ("notes", ("names",), "as names and values"),
])  # fmt: skip
def test_entries_that_are_something_else(kind, wrong, words):
    for name in wrong:
        with pytest.raises(ValueError, match=f"expected {name} .*{words}"):
            getattr(entries, f"{kind}_of")(ENTRIES, name)
