"""What is left to do, what is under way, and which sample is to blame where workers die. It knows no process."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from torchtransient.data.generation.run_log import RunLog, SampleBar
from torchtransient.errors import TorchTransientError

# The same words in every run: how it died stands in the log.
DIED = "its process died or did not answer at every attempt"
MEASURING = -1
# A worker that was killed may have been in somebody's way; one that crashes or hangs did so on its own.
_OWN_FAULT, _KILLED = 2, 1
# Deaths without an end of it: of one shard, and of all workers without a sample in between.
MOST_OF_A_SHARD, MOST_IN_A_ROW = 20, 30
# And before the first samples: nothing says that the recipe can be rendered at all.
MOST_BEFORE_ANY = 3


@dataclass
class UnderWay:
    """A shard in work: samples that have ended, and those of them that failed."""

    ended: int = 0
    failed: int = 0


@dataclass
class Ledger:
    """The state of a run. ``retries``: a sample at which processes died once more than that is given up."""

    retries: int
    log: RunLog
    bar: SampleBar
    waiting: deque[int] = field(default_factory=deque)
    skipped: dict[int, dict[int, str]] = field(default_factory=dict)
    samples: int = 0
    failed: int = 0
    bytes: int = 0
    restarts: int = 0
    shards: int = 0
    _under_way: dict[int, UnderWay] = field(default_factory=dict)
    _blame: Counter[tuple[int, int]] = field(default_factory=Counter)
    _deaths: Counter[int] = field(default_factory=Counter)
    _in_a_row: int = 0

    def add(self, shards: Iterable[int]) -> None:
        """More to do."""
        self.waiting.extend(shards)

    def take(self) -> int | None:
        """The next shard, or None."""
        if not self.waiting:
            return None
        shard = self.waiting.popleft()
        self._under_way[shard] = UnderWay()
        return shard

    def skip(self, shard: int) -> dict[int, str]:
        """Samples of a shard that are given up, with the reason."""
        return self.skipped.get(shard, {})

    def suspects(self, shard: int) -> list[int]:
        """Samples that come first, so that nothing that went before them can be to blame."""
        skip = self.skip(shard)
        return sorted(index for of, index in self._blame if of == shard and index not in skip)

    def ended(self, shard: int, index: int, failed: str | None) -> None:
        """A sample was made, or failed."""
        self._in_a_row = 0
        self._blame.pop((shard, index), None)
        if shard == MEASURING:
            return
        now = self._under_way.setdefault(shard, UnderWay())
        now.ended += 1
        now.failed += failed is not None
        self.bar(1, failed=int(failed is not None))
        if failed is not None:
            self.log("failed", shard=shard, sample=index, reason=failed)

    def wrote(self, shard: int, samples: int, failed: int, size: int) -> None:
        """A shard is whole."""
        self._under_way.pop(shard, None)
        self._deaths.pop(shard, None)
        self.samples += samples - failed
        self.failed += failed
        self.bytes += size
        self.shards += 1
        self.log("shard", shard=shard, samples=samples - failed, failed=failed, bytes=size)

    def lost(self, shard: int | None, index: int | None, how: str, own_fault: bool) -> None:
        """A worker is gone, in the middle of a sample or elsewhere. Raises TorchTransientError where there is no end to
        it.
        """
        self.restarts += 1
        self.log("death", shard=shard, sample=index, how=how)
        now = self._under_way.pop(shard, UnderWay()) if shard is not None else UnderWay()
        self.bar(-now.ended, failed=-now.failed, restarts=1)
        self._in_a_row += 1
        if shard is not None:
            self.waiting.appendleft(shard)
            self._deaths[shard] += 1
            if index is not None:
                self._charge(shard, index, own_fault)
            deaths = self._deaths[shard]
            if shard == MEASURING and index is None and deaths >= MOST_BEFORE_ANY:
                self._give_up(f"{deaths} workers died before the first samples were made, the last one {how}")
            if deaths > MOST_OF_A_SHARD:
                where = "the first samples" if shard == MEASURING else f"shard {shard}"
                self._give_up(f"{deaths} workers died over {where}, the last one {how}")
        if self._in_a_row > MOST_IN_A_ROW:
            self._give_up(f"{self._in_a_row} workers died one after another without a sample, the last one {how}")

    def _charge(self, shard: int, index: int, own_fault: bool) -> None:
        self._blame[shard, index] += _OWN_FAULT if own_fault else _KILLED
        if self._blame[shard, index] >= _OWN_FAULT * (self.retries + 1):
            self.skipped.setdefault(shard, {})[index] = DIED
            self._deaths[shard] = 0
            self.log("given up", shard=shard, sample=index, reason=DIED)

    def _give_up(self, what: str) -> None:
        raise TorchTransientError(
            f"generate: {what}. log.jsonl has all of them; where the system ends processes for want of memory, take "
            "fewer workers. Finished shards are kept: the same call goes on."
        )


def facts(ledger: Ledger) -> dict[str, Any]:
    """Totals for the log."""
    names = ("shards", "samples", "failed", "bytes", "restarts")
    return {name: getattr(ledger, name) for name in names}
