"""The boundary term of edges that move: reverse mode against finite differences, forward mode, time bin by bin.

Reverse mode and finite differences are independent estimates over different seeds. The interior term alone has to be
off by more than the bound, or a case would prove nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tools.boundary_cases.closed_rooms import ROOMS
from tools.boundary_cases.edge_derivatives import EdgeProblem
from tools.boundary_cases.moving_edges import CASES, SPECTRAL

SIGMAS = 4.0
# Both modes add the same float32 terms in another order.
ROUNDING = 1e-4
SEEDS = 6


def compare(case, spp, fd_spp, seeds=SEEDS):
    """The mean over the seeds of a derivative agrees with central differences, and is not the interior term."""
    problem = EdgeProblem(case)
    found = np.array([problem.reverse(100 + seed, spp) for seed in range(seeds)])
    expected = np.array([problem.difference(300 + seed, fd_spp) for seed in range(seeds)])
    bound = SIGMAS * np.sqrt((found.var(ddof=1) + expected.var(ddof=1)) / seeds)
    assert abs(found.mean() - expected.mean()) < bound
    assert abs(problem.reverse(100, spp, ()) - expected.mean()) > bound


@pytest.mark.parametrize("name", ["plate", "shadow_area", "flash"])
def test_outlines_and_shadows(name):
    compare(CASES[name], 64, 1024, seeds=4)


# With samples per pixel of reverse mode and of differences.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "spp", "fd_spp"),
    [
        ("cube", 256, 4096), ("ball_shadow", 256, 4096), ("indirect4_area", 256, 16384), ("wall_moves", 512, 4096),
        ("camera_zooms", 256, 4096), ("instance4", 256, 8192), ("fog_shadow", 256, 8192), ("gated_plate4", 256, 4096),
        ("polar_plate", 256, 8192), ("mirror_shadow", 512, 8192), ("mirror_camera", 4096, 32768),
        ("sun_turns4", 256, 4096), ("glass_moves", 1024, 8192),
    ],
)  # fmt: skip
def test_edges_seen_by_sensors_lights_and_surfaces(name, spp, fd_spp):
    compare(CASES[name], spp, fd_spp)


@pytest.mark.slow
def test_colours():
    compare(replace(CASES["indirect4_area"], variant=SPECTRAL), 256, 16384)


def test_rays_edge_on_to_a_meter():
    """Of 2e6 paths none counts by one over a cosine that is rounding: no run is far from the others."""
    problem = EdgeProblem(ROOMS["meter"](2))
    found = np.array([problem.reverse(seed, 1 << 18, ()) for seed in range(300, 308)])
    off = np.abs(found - np.median(found))
    assert off.max() < 10 * np.median(off)


def check_modes(name, *passes):
    """Forward mode is reverse mode, of the given passes at one seed."""
    problem = EdgeProblem(CASES[name])
    reverse, forward = (mode(5, 64, passes, interior=False) for mode in (problem.reverse, problem.forward))
    assert abs(reverse) > 1e-3
    assert forward == pytest.approx(reverse, rel=ROUNDING)


@pytest.mark.slow
def test_forward_mode():
    check_modes("contact4", "primary", "vertex", "light")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "passes"), [("mirror", ["specular"]), ("glass_moves", ["primary", "light", "specular"])]
)
def test_forward_mode_of_every_pass(name, passes):
    for one in passes:
        check_modes(name, one)


@pytest.mark.slow
def test_a_shadow_bin_by_bin():
    """z-scores of all bins that the shadow reaches have mean zero and deviation one."""
    problem, h = EdgeProblem(CASES["shadow_area"]), CASES["shadow_area"].step
    found = np.array([problem.tangent(seed, 512).sum((0, 1, 3)) for seed in range(8)])
    expected = np.array(
        [(problem.cube(h, 50 + s, 8192) - problem.cube(-h, 50 + s, 8192)).sum((0, 1, 3)) / (2 * h) for s in range(8)]
    )
    error = np.sqrt((found.var(0, ddof=1) + expected.var(0, ddof=1)) / 8)
    # Bins at the rims, which few paths reach, have errors that few runs cannot tell.
    lit = abs(expected.mean(0)) > 0.02 * abs(expected.mean(0)).max()
    z = (found.mean(0) - expected.mean(0))[lit] / error[lit]
    assert lit.sum() > 20
    assert abs(z.mean()) < SIGMAS / np.sqrt(lit.sum())
    assert np.sqrt((z**2).mean()) < 1.5 and abs(z).max() < SIGMAS
