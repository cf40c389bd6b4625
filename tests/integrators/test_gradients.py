"""Every parameter of the support table: reverse mode against finite differences, forward mode against reverse mode.

The bounds are derived: reverse mode and finite differences are independent estimates over different seeds, their
difference may be three standard errors of both; forward and reverse mode use the same paths, so they differ by float32
sums alone.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from support.gradient_cases.all_cases import ALL_CASES
from support.gradient_cases.problem import Problem

SIGMAS = 3.0
# Forward and reverse mode add the same float32 terms in another order; a sum of n terms of mixed signs is good to about
# sqrt(n) ulp.
ROUNDING = 2e-3
# So many cases of each row of the support table are in the default set; the set of slow tests runs the others.
FIRST = 1
# So does it run cases of more than a second that need many samples.
LONG = {
    "rough_mirror_moves", "thin_glass_tilts", "rough_glass_index", "glass_in_a_group", "phasor_fog_density",
    "phasor_glass_index", "meter_moves", "camera_before_an_instance", "instance_of_a_grid_turns",
    "camera_before_a_curve", "pattern_and_light_move", "gap_lamp_with_a_cone_tilts", "gap_lamp_with_a_cone",
    "gap_tube_with_a_cone", "gap_plates_tilt", "gap_polarized", "gap_block", "gap_fog", "gap_lamp_with_stripes",
    "gap_lamp_with_stripes_moves", "gap_corner_floor", "gap_lamp_tilts", "bare_light_with_a_cone_grows",
    "no_transmission_of_a_sheet", "instance_and_its_mirror_turn", "phase_of_weight_1", "normals_in_an_instance",
    "polarized_fluorescent_yield", "area_light_over_a_delayed_wall_moves",
}  # fmt: skip


def marked(cases):
    """Parameters of a test, with the marker that a case's cost asks for."""
    found, seen = [], Counter()
    for case in cases:
        slow = "slow" in case.tags or case.name in LONG or seen[case.row] >= FIRST
        seen[case.row] += not slow
        found.append(pytest.param(case, id=case.name, marks=[pytest.mark.slow] if slow else []))
    return found


@pytest.fixture(scope="module")
def problems():
    """Loaded problems by name, so that kernels and scenes are shared between the tests of a case."""
    return {}


def _problem(problems, case):
    # One at a time: a loaded scene stays a target of every virtual call of its variant.
    if case.name not in problems:
        problems.clear()
        problems[case.name] = Problem(case)
    return problems[case.name]


@pytest.mark.parametrize("case", marked(ALL_CASES))
def test_forward_equals_reverse(problems, case):
    problem = _problem(problems, case)
    reverse, forward = problem.reverse(100), problem.forward(100)
    assert np.isfinite(reverse) and reverse != 0
    assert forward == pytest.approx(reverse, rel=ROUNDING)


@pytest.mark.parametrize("case", marked(c for c in ALL_CASES if c.support == "correct"))
def test_reverse_against_finite_differences(problems, case):
    problem = _problem(problems, case)
    reverse = np.array([problem.reverse(100 + s) for s in range(case.seeds)])
    differences = np.array([problem.difference(s) for s in range(case.seeds)])
    error = np.sqrt((reverse.var(ddof=1) + differences.var(ddof=1)) / case.seeds)
    assert abs(reverse.mean() - differences.mean()) < SIGMAS * error
    # A test that could not tell the right answer from zero would prove nothing.
    assert error < 0.15 * abs(differences.mean())
