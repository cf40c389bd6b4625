"""Temporal filters that parameters call for, and the error for a filter without a slope."""

from __future__ import annotations

import pytest

from torchtransient.errors import GradientError
from torchtransient.scene.slope import check_filter, filter_for, has_slope


@pytest.mark.parametrize(
    ("own", "pulsed", "slope"),
    [("box", False, False), ("box", True, True), ("tent", False, True), ("gaussian", False, True), ("", False, True)],
)
def test_filters(own, pulsed, slope):
    assert has_slope(own, pulsed) == slope
    assert filter_for([], own, pulsed) == own
    assert filter_for(["key"], own, pulsed) == (own if slope else "tent")
    check_filter([], own, pulsed)
    if slope:
        check_filter(["key"], own, pulsed)
    else:
        with pytest.raises(GradientError, match=r"'key'.*'box' has no slope.*'tent'"):
            check_filter(["key"], own, pulsed)
