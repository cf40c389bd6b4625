"""A thousand kills of a writer of results: the old file or the new one, and nothing beside it after the next write."""

from __future__ import annotations

import pytest

from support.killed_writers import in_child

pytestmark = pytest.mark.soak


def test_a_thousand_kills(tmp_path):
    found = in_child(tmp_path, kills=1000, seed=1)
    print(found)  # -s shows it
    assert found["old"] + found["new"] == 1000
    assert found["old"] > 50 and found["new"] > 50 and found["parts"] > 100
