"""Which samples of a data set stand in which shard file."""

from __future__ import annotations

from dataclasses import dataclass

LEAST_BYTES, MOST_BYTES = 64 * 2**20, 256 * 2**20
# Shards that a data set has at least, where it has as many samples: all workers are busy, and a kill loses little.
LEAST_SHARDS = 64
# Beyond that many of the smallest size, shards grow instead.
MANY_SHARDS = 256


@dataclass(frozen=True)
class Plan:
    """``n`` samples, ``per_shard`` in each file, fewer in the last one."""

    n: int
    per_shard: int

    @property
    def shards(self) -> int:
        """How many files."""
        return -(-self.n // self.per_shard)

    def indices(self, shard: int) -> range:
        """Samples of a shard; row 0 of the file is the first one."""
        return range(shard * self.per_shard, min(self.n, (shard + 1) * self.per_shard))

    def share(self, part: int, parts: int) -> range:
        """Shards of one of several runs that divide the work: every ``parts``-th one, beginning with ``part``."""
        return range(part, self.shards, parts)


def samples_per_shard(n: int, sample_bytes: int) -> int:
    """Samples in a shard of ``n`` samples that have ``sample_bytes`` bytes each before compression.

    Shards have 64 MB; where there would be more than 256 of them, up to 256 MB. They are smaller where there would be
    fewer than 64 otherwise. It depends on nothing else, above all not on how many workers there are: files have to be
    the same ones everywhere.
    """
    sample_bytes = max(1, sample_bytes)
    least, most = LEAST_BYTES // sample_bytes, MOST_BYTES // sample_bytes
    by_size = min(most, max(least, -(-n // MANY_SHARDS)))
    return max(1, min(by_size, n // LEAST_SHARDS))
