"""Which samples stand in which file."""

from __future__ import annotations

import pytest

from torchtransient.data.run_settings import Plan, samples_per_shard, shard_file_name

MB = 2**20


@pytest.mark.parametrize(
    ("n", "sample_bytes", "expected"),
    [
        (10_000, 4 * MB, 40),  # 250 files of 160 MB
        (1000, 4 * MB, 15),  # 67 files of 60 MB: at least 64
        (100_000, 4 * MB, 64),  # never more than 256 MB
        (2000, 4 * MB, 16),  # 64 MB
        (50, 4 * MB, 1), (1, 4 * MB, 1), (10_000, 1000, 156), (10_000_000, 1000, 67108), (10, 1000 * MB, 1), (64, 0, 1),
    ],
)  # fmt: skip
def test_sizes(n, sample_bytes, expected):
    found = samples_per_shard(n, sample_bytes)
    assert found == expected
    plan = Plan(n, found)
    assert found * sample_bytes <= 256 * MB or found == 1
    assert plan.shards >= min(n, 64)


@pytest.mark.parametrize(("n", "per_shard"), [(1, 1), (10, 3), (12, 3), (5, 100)])
def test_every_sample_once(n, per_shard):
    plan = Plan(n, per_shard)
    assert [index for k in range(plan.shards) for index in plan.indices(k)] == list(range(n))
    for parts in (1, 2, 5):
        assert sorted(k for part in range(parts) for k in plan.share(part, parts)) == list(range(plan.shards))
    assert shard_file_name(3) == "shard-000003.h5"
