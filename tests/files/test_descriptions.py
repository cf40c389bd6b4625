"""Files of descriptions: YAML as checked plain data, and keys of what a simulation depends on."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from torchtransient.errors import MissingPackageError, SceneError, StorageError, TorchTransientError
from torchtransient.files import content_key

SETUP = """
hidden:
  plate: {shape: rectangle, scale: 0.3, rotate: [[0, 1, 0], 180], translate: [0.1, 0, 0.9], albedo: 0.7}
wall: {width: 2.0, height: 1.6}
scan: {kind: confocal, size: [4, 3]}
time_axis: {start_opl: 1.7, bin_width_opl: 2e-2, num_bins: 60}
spp: 16
"""


def read(folder, text):
    (folder / "a.yaml").write_text(text)
    return tt.nlos.read_setup(folder / "a.yaml")


def test_files_and_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    expected = read(tmp_path, SETUP)
    assert expected["spp"] == 16 and expected["time_axis"].bin_width_opl == 0.02  # YAML 1.1 has a text there
    folder = tmp_path / "set up"
    folder.mkdir()
    (folder / "set up.yaml").write_text(SETUP)
    for given in (folder, str(folder), folder / "set up.yaml", Path("set up")):
        assert tt.nlos.read_setup(given)["scan"] == expected["scan"]
    with pytest.raises(StorageError):
        tt.nlos.read_setup("none.yaml")
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(MissingPackageError, match=r"torchtransient\[yaml\]"):
        read(tmp_path, SETUP)


@together("old, new", [
    ("spp: 16", "spp: many"), ("spp: 16", "spp: 1.5"), ("spp: 16", "spp: 0"), ("spp: 16", "spp: true"),
    ("spp: 16", "spp: .inf"), ("width: 2.0", "width: [1]"), ("width: 2.0", "width: 1 m"),
    ("kind: confocal", "kind: biaxial"), ("size: [4, 3]", "size: [4, 3, 2]"), ("size: [4, 3]", "size: [4, x]"),
    ("num_bins: 60", "num_bins: null"), ("wall: {width: 2.0, height: 1.6}", "wall: 3"), (SETUP, "- 1\n- 2"),
    (SETUP, "\n"),
])  # fmt: skip
def test_entries_of_other_kinds(tmp_path, old, new):
    with pytest.raises(TorchTransientError) as found:
        read(tmp_path, SETUP.replace(old, new))
    assert "cannot be read" not in str(found.value)


def test_wrong_entries_are_named_with_their_place(tmp_path):
    for old, new, words in (
        ("spp: 16", "spp: 16\nspp: 17", "spp stands twice"),
        ("width: 2.0", "widht: 2.0", "Did you mean 'width'"), ("translate: [0.1, 0, 0.9]", "translate: 5", "translate"),
    ):  # fmt: skip
        with pytest.raises(SceneError, match=words):
            read(tmp_path, SETUP.replace(old, new))


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
    # Folders, missing files and texts that are no path count as texts.
    assert len({content_key(one) for one in (tmp_path, tmp_path / "none", Path("a\0b"))}) == 3
