"""Which temporal filter parameters call for, and the error where it has no slope."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from torchtransient.errors import GradientError
from torchtransient.rendering.renderer import TransientRenderer
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


@pytest.mark.parametrize(
    ("temporal_filter", "pulsed", "response", "there"),
    [
        ("tent", False, True, True),
        ("box", False, True, False),
        ("box", True, True, True),
        # Films without a temporal filter have the slope of their own response, or none.
        ("", False, True, True),
        ("", False, False, False),
        ("box", True, False, False),
    ],
)
def test_a_renderer_has_the_slope_of_its_filter_and_of_its_response(temporal_filter, pulsed, response, there):
    moving, still = (SimpleNamespace(moves_path_length=moves) for moves in (True, False))
    renderer = SimpleNamespace(
        effective_filter=temporal_filter, _pulsed=pulsed, _response=(response, "", ""),
        _infos={"moving": moving, "still": still},
    )  # fmt: skip
    assert TransientRenderer.has_slope_for(renderer, ["still", "moving"]) is there
    assert TransientRenderer.has_slope_for(renderer, ["still"]) is True
    assert TransientRenderer.has_slope_for(renderer, []) is True
