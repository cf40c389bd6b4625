"""One process of a run: sizes of shards, attempts at samples, their order, and the reasons of failures."""

from __future__ import annotations

import numpy as np
import pytest

import torchtransient as tt
from torchtransient.data import Sample
from torchtransient.data.run_settings import RunSettings, samples_per_shard
from torchtransient.data.shard_making import Messages, ShardMaker, raised, reason_of
from torchtransient.errors import SceneError, StorageError, TorchTransientError, UnitError

MB = 2**20


@pytest.mark.parametrize(
    ("n", "sample_bytes", "expected"),
    [
        (10_000, 4 * MB, 40),  # 250 files of 160 MB
        (1000, 4 * MB, 15),  # 67 files of 60 MB: at least 64
        (100_000, 4 * MB, 64),  # never more than 256 MB
        (2000, 4 * MB, 16),  # 64 MB
        (50, 4 * MB, 1), (10_000, 1000, 156), (10, 1000 * MB, 1), (64, 0, 1),
    ],
)  # fmt: skip
def test_sizes(n, sample_bytes, expected):
    assert samples_per_shard(n, sample_bytes) == expected


class Making:
    """A recipe whose samples fail as often as ``failing`` says; it is its own maker."""

    def __init__(self, failing=(), error=0.25, answers=lambda index: index):
        self.failing, self.error, self.answers = dict(failing), error, answers
        self.asked, self.makers = [], 0

    def maker(self):
        self.makers += 1
        return self

    def sample(self, index):
        self.asked.append(index)
        if self.failing.get(index, 0) > 0:
            self.failing[index] -= 1
            raise UnitError(f"sample {index} is bad")
        return Sample(self.answers(index), 1, arrays={"transient": np.full((1, 2, 3, 5), index, np.float32)})

    def standard_error(self, index):
        if isinstance(self.error, Exception):
            raise self.error
        return self.error

    def order(self, indices):
        return sorted(indices, reverse=True)

    def about(self):
        return {"spp": 4}

    def key(self):
        return "key"

    def to_dict(self):
        return {}

    def close(self):
        pass


@pytest.fixture
def made(tmp_path):
    """Makes a shard of three samples, or measures: (result, messages)."""

    def run(recipe, shard=0, retries=1, skip=(), first=(), about=None):
        settings = RunSettings(recipe, str(tmp_path), 5, "exact", "none", retries)
        sent = []
        messages = Messages(sent.append, dict(skip))
        maker = ShardMaker(settings)
        if shard is None:
            return maker.measure(range(5), messages), sent
        described = {"about": about or {"spp": 4}, "per_shard": 3, "recipe": {}}
        return maker.make(shard, described, messages, first), sent

    with tt.threads(1):
        yield run


BAD = "UnitError: sample {} is bad"


def of(sent, *kinds):
    return [one if one[0] != "traced" else one[:3] for one in sent if one[0] in kinds]


def test_attempts_at_samples(made):
    """In a scene that is built anew; the traceback of the first failure is sent once."""
    recipe = Making({1: 1})
    (samples, failed, _), sent = made(recipe)
    assert (samples, failed) == (3, 0) and recipe.asked == [2, 1, 1, 0] and recipe.makers == 2
    assert of(sent, "traced", "retry") == [("traced", 0, 1), ("retry", 0, 1, BAD.format(1))]
    # Samples under another number are failures.
    assert made(Making(answers=lambda index: index + 1), retries=0)[0][:2] == (3, 3)


def test_suspects_come_first(made, tmp_path):
    """Then the maker's order; samples that are given up or fail have their rows."""
    recipe = Making({3: 9})
    result, sent = made(recipe, 1, retries=0, skip={4: "given up"}, first=[4])
    assert result == (2, 2, (tmp_path / "shard-000001.h5").stat().st_size) and recipe.asked == [3]
    assert of(sent, "begin", "end", "closing") == [
        ("end", 1, 4, "given up"), ("begin", 1, 3), ("end", 1, 3, BAD.format(3)), ("closing", 1),
    ]  # fmt: skip
    recipe = Making()
    made(recipe, first=[1])
    assert recipe.asked == [1, 2, 0]
    with pytest.raises(StorageError, match="spp"):
        made(Making(), about={"spp": 8})


def test_the_first_sample_that_can_be_made_is_measured(made):
    found, sent = made(Making({1: 9}), None, retries=0, skip={0: "given up"})
    assert (found.sample_bytes, found.about, found.standard_error) == (120, {"spp": 4}, 0.25)
    assert [one[2] for one in of(sent, "begin")] == [1, 2, 2]
    for error in (UnitError("no"), float("nan"), float("inf")):
        assert made(Making(error=error), None)[0].standard_error is None
    with pytest.raises(SceneError, match=r"none of the samples 0 to 4 .* The last one: UnitError: sample 4 is bad$"):
        made(Making(dict.fromkeys(range(5), 9)), None)


def test_reasons_are_the_same_everywhere():
    error = ValueError("in /home/one/two/file.ply,\n at <object 0x7fa301385210>: 0x12 and a/b")
    assert reason_of(error) == "ValueError: in file.ply, at <object 0x...>: 0x12 and a/b"
    error = SceneError('At dictionary node: "/srv/of b/c/mesh.ply": I/O error, of 3/4 in a/b.ply')
    assert reason_of(error).endswith('mesh.ply": I/O error, of 3/4 in a/b.ply') and "/srv" not in reason_of(error)
    assert len(reason_of(ValueError("x" * 600))) == 500


def test_errors_travel_as_texts():
    for kind, expected in (
        ("UnitError", UnitError), ("StorageError", StorageError), ("PermissionError", StorageError),
        ("KeyError", TorchTransientError), ("annotations", TorchTransientError),
    ):  # fmt: skip
        assert type(raised(kind, "bad")) is expected
