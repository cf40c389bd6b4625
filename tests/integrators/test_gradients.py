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
# So many cases of each row of the support table are in the default set, and so many in the set of slow tests; the soak
# runs the others.
FIRST, SECOND = 1, 1
# Neither are cases of more than a second that need many samples in the default set.
LONG = {
    "pattern_grows", "plastic_alpha", "hair_coloured_absorption", "plastic_index", "medium_albedo",
    "rough_mirror_moves", "thin_glass_tilts", "rough_glass_index", "glass_in_a_group", "phasor_fog_density",
    "phasor_glass_index", "meter_moves", "instance_of_a_grid_turns", "pattern_and_light_move", "gap_lamp_with_a_cone",
    "gap_polarized", "gap_lamp_with_stripes_moves", "gap_lamp_tilts", "instance_and_its_mirror_turn",
    "phase_of_weight_1", "normals_in_an_instance", "polarized_fluorescent_yield",
    "area_light_over_a_delayed_wall_moves",
}  # fmt: skip
# Nor the first cases of rows whose code a quicker case of another row runs, too: surfaces, media, lights, sensors,
# instances, indices and textures are in the default set once or twice each, polarization in test_singular_mueller.py.
ALIKE = {
    "sun_direction", "hair_longitudinal_roughness", "hair_index", "glass_around_camera_index", "gated_side_albedo",
    "quantum_yield", "elastic_fraction", "albedo_inside_a_delay", "black_mirror_of_a_plastic", "principled_glass_index",
    "very_rough_glass", "principled_thin_colour", "no_clearcoat", "medium_albedo_zero", "medium_g",
    "medium_wall_behind", "roughness_of_blended_glass", "polar_metal_of_index_zero", "polar_metal_alpha",
    "polar_wall_distance", "lens_aperture", "camera_moves_in_glass", "blend_weight", "principled_roughness",
    "smooth_plastic_index", "mirror_reflectance", "polar_polarizer_angle", "polar_albedo", "linear_curve_bends",
    "conductor_eta", "side_moves", "medium_sigma_t", "index_of_masked_thin_glass", "banded_albedo_spectrum", "lifetime",
    "gated_wall", "ellipsoid_changes", "instance_turns", "mirror_normals",
    "gap_plates", "sky_texture", "wall_under_long_pulse", "medium_flakes_in_clouds", "mirror_normals_in_an_attribute",
    "mirror_tilts", "bare_light_grows",
}  # fmt: skip


# Of the slow ones, those that take more than six seconds and move edges or bend rays as quicker ones do: soaked.
LONGEST = {
    "instance_of_glass_turns", "spline_bends", "ellipsoid_mirror_moves", "linear_curve_bends", "mirror_tilts",
    "polar_two_sided_tilts", "camera_moves_in_glass", "instance_turns", "sun_direction", "polar_wall_distance",
    "pattern_and_light_move", "medium_wall_behind",
}  # fmt: skip


def marked(cases):
    """Parameters of a test, with the marker that a case's cost asks for."""
    found, seen, later = [], Counter(), Counter()
    for case in cases:
        slow = "slow" in case.tags or case.name in LONG or seen[case.row] >= FIRST
        seen[case.row] += not slow
        later[case.row] += slow
        soak = case.name in LONGEST or later[case.row] > SECOND
        marks = [pytest.mark.soak if soak else pytest.mark.slow] if slow or case.name in ALIKE else []
        found.append(pytest.param(case, id=case.name, marks=marks))
    return found


@pytest.mark.parametrize("case", marked(ALL_CASES))
def test_modes_and_finite_differences_agree(case):
    """In one test, since a scene is loaded and its kernels are traced once."""
    problem = Problem(case)
    reverse = np.array([problem.reverse(100 + s) for s in range(case.seeds)])
    assert np.isfinite(reverse).all() and reverse[0] != 0
    assert problem.forward(100) == pytest.approx(reverse[0], rel=ROUNDING)
    differences = np.array([problem.difference(s) for s in range(case.seeds)])
    error = np.sqrt((reverse.var(ddof=1) + differences.var(ddof=1)) / case.seeds)
    assert abs(reverse.mean() - differences.mean()) < SIGMAS * error + case.off * abs(differences.mean())
    # A test that could not tell the right answer from zero would prove nothing.
    assert error < 0.15 * abs(differences.mean())
