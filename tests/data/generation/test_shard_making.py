"""One process' part of a data set: which samples are tried how often, and what is said of those that fail."""

from __future__ import annotations

import warnings
from types import SimpleNamespace

import numpy as np
import pytest

import torchtransient as tt
from torchtransient.data.generation import shard_making
from torchtransient.data.generation.shard_making import MOST_CHARACTERS, ShardMaker, fatal, raised, reason_of
from torchtransient.data.recipes.sample import Sample
from torchtransient.data.storage.shard_file import Shard
from torchtransient.errors import PhysicsWarning, SceneError, StorageError, TorchTransientError, UnitError


class Heard:
    """What becomes of samples, in words; ``refused``: samples that are not to be tried."""

    def __init__(self, refused=()):
        self.words, self.refused = [], dict(refused)

    def begin(self, shard, index):
        self.words.append(("begin", shard, index))
        return self.refused.get(index)

    def end(self, shard, index, failed):
        self.words.append(("end", shard, index, failed))

    def retry(self, shard, index, reason):
        self.words.append(("retry", shard, index, reason))

    def traced(self, shard, index, trace):
        self.words.append(("traced", shard, index))

    def closing(self, shard):
        self.words.append(("closing", shard))


class Making:
    """A recipe whose samples fail as often as ``failing`` says; it is its own maker."""

    def __init__(self, failing=(), error=0.25, answers=lambda index: index):
        self.failing, self.error, self.answers = dict(failing), error, answers
        self.asked, self.closed, self.makers = [], 0, 0

    def maker(self):
        self.makers += 1
        return self

    def sample(self, index):
        self.asked.append(index)
        if self.failing.get(index, 0) > 0:
            self.failing[index] -= 1
            raise UnitError(f"sample {index} is bad")
        cube = np.full((1, 2, 3, 5), index, np.float32)
        return Sample(self.answers(index), 1, arrays={"transient": cube})

    def standard_error(self, index):
        if isinstance(self.error, Exception):
            raise self.error
        return self.error

    def order(self, indices):
        return sorted(indices, reverse=True)

    def about(self):
        return {"spp": 4}

    def close(self):
        self.closed += 1


@pytest.fixture
def making(tmp_path, monkeypatch):
    def made(recipe, retries=1, n=5):
        settings = SimpleNamespace(
            recipe=recipe, folder=str(tmp_path), plugins=(), retries=retries, n=n, store="exact", compression="none",
        )  # fmt: skip
        monkeypatch.setattr(shard_making, "shard_header", lambda *_: {"about": {"spp": 4}})
        monkeypatch.setattr(shard_making, "LatestPicture", lambda folder: pictures.append)
        return ShardMaker(settings)

    pictures = []
    made.pictures = pictures
    with tt.threads(1):
        yield made


BAD = "UnitError: sample {} is bad"


def test_samples_that_pass_at_the_second_try(making):
    """In a scene that is built anew; where it has failed first is told once."""
    recipe, heard = Making({3: 1}), Heard()
    found = making(recipe)._sample(7, 3, heard)
    assert found.index == 3 and recipe.asked == [3, 3] and (recipe.closed, recipe.makers) == (1, 2)
    assert heard.words == [("traced", 7, 3), ("retry", 7, 3, BAD.format(3))]


@pytest.mark.parametrize("retries", [0, 1, 2])
def test_samples_that_fail_throughout(making, retries):
    recipe, heard = Making({3: 99}), Heard()
    assert making(recipe, retries)._sample(7, 3, heard) == BAD.format(3)
    assert recipe.asked == [3] * (retries + 1) and recipe.closed == retries + 1
    assert heard.words == [("traced", 7, 3), *[("retry", 7, 3, BAD.format(3))] * retries]


def test_samples_that_are_others(making):
    found = making(Making(answers=lambda index: index + 1), 0)._sample(7, 3, Heard())
    assert found == "TorchTransientError: the maker was asked for sample 3 and made 4."


def test_a_shard(making, tmp_path):
    """Suspects first, then as the maker orders; what is given up or fails has its row, too."""
    recipe, heard = Making({3: 9}), Heard({4: "given up"})
    maker = making(recipe, retries=0)
    described = {"about": {"spp": 4}, "per_shard": 3}
    assert maker.make(1, described, heard, first=[4]) == (2, 2, (tmp_path / "shard-000001.h5").stat().st_size)
    assert recipe.asked == [3] and making.pictures == []
    assert heard.words == [
        ("begin", 1, 4), ("end", 1, 4, "given up"),
        ("begin", 1, 3), ("traced", 1, 3), ("end", 1, 3, BAD.format(3)), ("closing", 1),
    ]  # fmt: skip
    assert maker.make(0, described, Heard(), first=[1])[:2] == (3, 0)
    assert recipe.asked[1:] == [1, 2, 0] and [one.index for one in making.pictures] == [1, 2, 0]
    with Shard(tmp_path / "shard-000000.h5") as shard:
        assert [float(shard.read("transient", row).max()) for row in range(3)] == [0, 1, 2]
    with pytest.raises(StorageError):
        making(Making()).make(0, {"about": {"spp": 8}, "per_shard": 3}, Heard())


def test_the_first_sample_that_can_be_made_is_measured(making):
    recipe, heard = Making({1: 9}), Heard({0: "given up"})
    found = making(recipe, retries=0).measure(range(5), heard)
    assert (found.sample_bytes, found.about, found.standard_error) == (120, {"spp": 4}, 0.25)
    assert [word[:3] for word in heard.words if word[0] in ("begin", "end")] == [
        ("begin", -1, 0), ("begin", -1, 1), ("end", -1, 1), ("begin", -1, 2), ("end", -1, 2), ("begin", -1, 2),
        ("end", -1, 2),
    ]  # fmt: skip
    for error in (UnitError("no"), float("nan"), float("inf")):
        assert making(Making(error=error)).measure(range(5), Heard()).standard_error is None
    with pytest.raises(SceneError, match=r"none of the samples 0 to 1 .* The last one: UnitError: sample 1 is bad$"):
        making(Making({0: 9, 1: 9})).measure(range(2), Heard())


def test_recipes_that_check_themselves(making):
    recipe = Making()

    def check(maker):
        recipe.asked.append(maker)
        for message, category in (("dark", PhysicsWarning), ("old", DeprecationWarning), ("own", UserWarning)):
            warnings.warn(message, category, stacklevel=1)

    recipe.check = check
    with pytest.warns(UserWarning, match="own"):
        found = making(recipe).measure(range(1), Heard())
    assert recipe.asked == [recipe, 0]
    # Those of other packages stay where they are.
    assert found.warned == (("dark", PhysicsWarning),)


def test_reasons_are_the_same_everywhere():
    error = ValueError("in /home/one/two/file.ply,\n at <object 0x7fa301385210>: 0x12 and a/b")
    assert reason_of(error) == "ValueError: in file.ply, at <object 0x...>: 0x12 and a/b"
    room = MOST_CHARACTERS - len("ValueError: ")
    assert reason_of(ValueError("x" * room)) == "ValueError: " + "x" * room
    cut = reason_of(ValueError("x" * (room + 1)))
    assert len(cut) == MOST_CHARACTERS and cut.endswith("xxx...")


def test_errors_travel_as_texts():
    assert fatal(UnitError("bad"))[:2] == ("UnitError", "bad")
    assert type(raised("UnitError", "bad")) is UnitError and str(raised("UnitError", "bad")) == "bad"
    for kind in ("StorageError", "OSError", "PermissionError", "FileNotFoundError"):
        assert type(raised(kind, "Full.")) is StorageError
        assert str(raised(kind, "Full.")) == "Full. Finished shards are kept: the same call goes on."
    for kind in ("KeyError", "annotations"):
        found = raised(kind, "bad")
        assert type(found) is TorchTransientError and str(found) == f"generate: a worker ended: {kind}: bad"
