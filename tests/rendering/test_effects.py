"""What a renderer takes over from a plan, and what its own arguments say otherwise."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from torchtransient.errors import SceneError
from torchtransient.rendering.effects import Effects


class Decided(Effects):
    def __str__(self):
        return "decided"


FILTERED, GATED = SimpleNamespace(has_bins=True), SimpleNamespace(has_bins=False)
PLAN = Decided(
    scene=None, variant="llvm_ad_mono", integrator="transient_path", film_choice=None, max_depth=3, pulse=None,
    irf=None, temporal_filter="tent", sensor=1,
)  # fmt: skip


def test_the_film_of_the_plan_where_the_renderer_has_none():
    planned = replace(PLAN, film_choice=FILTERED)
    assert planned.film_settings(None, "gaussian") == (FILTERED, "gaussian")
    assert planned.film_settings(GATED, "gaussian") == (GATED, "gaussian")
    assert PLAN.film_settings(None, "gaussian") == (None, "gaussian")


@pytest.mark.parametrize(
    ("decided", "asked_for", "taken"),
    [("tent", False, "tent"), ("tent", True, "tent"), ("box", True, "box"), ("box", False, "auto"),
     ("", False, "auto"), ("", True, "auto")],
)  # fmt: skip
def test_the_filter_of_the_plan_where_the_renderer_leaves_it_open(decided, asked_for, taken):
    plan = replace(PLAN, temporal_filter=decided, filter_is_given=asked_for)
    for film in (None, FILTERED):
        assert plan.film_settings(film, "auto") == (film, taken)
        assert plan.film_settings(film, "gaussian") == (film, "gaussian")
    # Films without a temporal filter take none.
    assert plan.film_settings(GATED, "auto") == (GATED, "auto")
    assert replace(plan, film_choice=GATED).film_settings(None, "auto") == (GATED, "auto")


def test_sensors_that_were_not_planned_for():
    PLAN.check_sensors([1])
    PLAN.check_sensors([])
    with pytest.raises(SceneError, match=r"for sensor 1, got sensors=\[1, 4, 2\]: .*tt\.plan\(scene, sensor=2\)"):
        PLAN.check_sensors([1, 4, 2])
    with pytest.raises(SceneError, match=r"sensor=0\)"):
        PLAN.check_sensors([0])
