"""Who is to blame where workers die."""

from __future__ import annotations

import pytest

from torchtransient.data.generation.ledger import DIED, MEASURING, MOST_IN_A_ROW, MOST_OF_A_SHARD, Ledger
from torchtransient.data.generation.run_log import RunLog, SampleBar
from torchtransient.errors import TorchTransientError


@pytest.fixture
def ledger(tmp_path):
    found = Ledger(2, RunLog(tmp_path), SampleBar(0, 0, shown=False))
    found.add([0, 1])
    return found


@pytest.mark.parametrize(("own_fault", "deaths"), [(True, 3), (False, 6)])
def test_a_sample_over_which_workers_die(ledger, own_fault, deaths):
    """Crashes count twice as much as kills, which may come from outside."""
    for death in range(deaths):
        assert ledger.skip(0) == {}
        assert ledger.suspects(0) == ([5] if death else [])
        assert ledger.take() == 0
        ledger.lost(0, 5, "by test", own_fault)
    assert ledger.skip(0) == {5: DIED} and ledger.suspects(0) == [] and list(ledger.waiting) == [0, 1]
    assert ledger.restarts == deaths


def test_a_sample_that_is_made_is_not_to_blame(ledger):
    for _ in range(10):
        assert ledger.take() == 0
        ledger.ended(0, 5, None)
        ledger.lost(0, 6, "by test", own_fault=False)
        ledger.take()
        ledger.ended(0, 6, None)
        ledger.lost(0, 5, "by test", own_fault=False)
    assert ledger.skip(0) == {} and ledger.suspects(0) == [5]


def test_deaths_without_end(ledger):
    """While files are written no sample is to blame; nor are samples that could be made at other times."""
    for _ in range(MOST_OF_A_SHARD):
        ledger.take()
        ledger.ended(0, 5, None)
        ledger.lost(0, None, "by test", own_fault=True)
    with pytest.raises(TorchTransientError, match=rf"{MOST_OF_A_SHARD + 1} workers died over shard 0.*the same call"):
        ledger.lost(0, None, "by test", own_fault=True)


def test_few_deaths_before_the_first_samples_are_enough(ledger):
    """Nothing says that the recipe can be rendered at all; where a sample is to blame, it is given up first."""
    ledger.add([MEASURING])
    for _ in range(2):
        ledger.take()
        ledger.lost(MEASURING, None, "by test", own_fault=True)
    with pytest.raises(TorchTransientError, match="3 workers died before the first samples were made, the last one by"):
        ledger.lost(MEASURING, None, "by test", own_fault=True)


def test_workers_that_die_with_nothing_to_do(ledger):
    for _ in range(MOST_IN_A_ROW):
        ledger.lost(None, None, "by test", own_fault=False)
    with pytest.raises(TorchTransientError, match="one after another"):
        ledger.lost(None, None, "by test", own_fault=False)


def test_totals(ledger):
    ledger.take()
    ledger.ended(0, 0, None)
    ledger.ended(0, 1, "why")
    ledger.wrote(0, 2, 1, 1000)
    assert (ledger.samples, ledger.failed, ledger.shards, ledger.bytes) == (1, 1, 1, 1000)
    assert ledger.take() == 1 and ledger.take() is None
