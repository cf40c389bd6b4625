"""Files that appear whole, on disks that lack locks or links, and on systems that lack both."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import platform

import pytest

from support.fake_recipe import FakeRecipe
from support.stored_samples import sample, write
from torchtransient.array_files.part_files import whole_file
from torchtransient.data import generate
from torchtransient.data.run_settings import DECIDING, write_description
from torchtransient.errors import StorageError

DESCRIBED = dict.fromkeys((*DECIDING, "about"), 1)


def refuse(number):
    def refused(*_):
        raise OSError(number, os.strerror(number))

    return refused


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
def test_disks_without_locks(tmp_path, monkeypatch, number):
    monkeypatch.setattr(fcntl, "flock", refuse(number))
    assert write_description(tmp_path, DESCRIBED) == DESCRIBED
    write(tmp_path / "shard-000000.h5", [sample(0)])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["recipe.json", "shard-000000.h5"]


@pytest.mark.parametrize("number", [errno.EPERM, errno.EOPNOTSUPP, errno.EMLINK])
def test_disks_without_links(tmp_path, monkeypatch, number):
    monkeypatch.setattr(os, "link", refuse(number))
    assert write_description(tmp_path, DESCRIBED) == DESCRIBED
    assert [path.name for path in tmp_path.iterdir()] == ["recipe.json"]
    assert write_description(tmp_path, {**DESCRIBED, "n": 9}) == DESCRIBED


def test_what_is_there_stays(tmp_path):
    """Of two runs that begin at once the first one says what the data set is."""
    assert write_description(tmp_path, DESCRIBED) == DESCRIBED
    assert write_description(tmp_path, {**DESCRIBED, "n": 9}) == DESCRIBED
    assert json.loads((tmp_path / "recipe.json").read_text()) == DESCRIBED
    assert [path.name for path in tmp_path.iterdir()] == ["recipe.json"]
    with whole_file(tmp_path / "recipe.json", "test") as part:
        part.write_text("other")
    assert (tmp_path / "recipe.json").read_text() == "other"


def test_systems_without_locks(tmp_path, monkeypatch):
    monkeypatch.setattr(platform, "system", lambda: "Windows")
    for call in (
        lambda: generate(FakeRecipe(), tmp_path / "set", 4, progress=False),
        lambda: write(tmp_path / "a.h5", [sample(0)]),
    ):
        with pytest.raises(StorageError, match="on Linux and macOS, this is Windows"):
            call()
    assert list(tmp_path.iterdir()) == []
