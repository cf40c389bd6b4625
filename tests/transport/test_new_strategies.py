"""A new strategy is one class and one entry in a list; its gradients in both modes follow.

Each toy of ``support.toy_strategies`` is compared with finite differences, its forward with its reverse mode, and where
it stands in for something that the library has, with that.
"""

from __future__ import annotations

import ast
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import torchtransient.plugins as plugins
from support import toy_strategies
from support.gradient_cases.problem import Case, Problem
from support.gradient_cases.scenes import room, transform
from support.gradient_cases.unknowns import move, set_color

VARIANT = "llvm_ad_mono"
SIGMAS, ROUNDING = 3.0, 2e-3


def area_light():
    return {
        "type": "rectangle",
        "to_world": transform().translate([0.3, 0.8, 3.0]).rotate([1, 0, 0], 160).scale(0.3),
        "emitter": {"type": "area", "radiance": 20.0},
    }


@pytest.fixture(autouse=True)
def _registered():
    plugins.register_module("support.toy_integrators")


def scene(plugin, media=False, **changes):
    """The room of the gradient cases under another integrator."""
    result = room(depth=4, **changes)
    result["integrator"] = result["integrator"] | {"type": plugin}
    if media:
        fog = {"type": "homogeneous", "sigma_t": 0.4, "albedo": 0.8}
        result["block"] = {
            "type": "cube",
            "to_world": transform().translate([0, 0, 1.5]).scale(0.5),
            "bsdf": {"type": "null"},
            "interior": fog,
        }
    return result


CASES = [
    Case("two_samples_wall", "", lambda: scene("transient_two_emitter_samples", light=area_light()),
         move("wall.to_world", (0, 0, 1)), 0.0, 4e-3, spp=2048, seeds=6),
    Case("two_samples_albedo", "", lambda: scene("transient_two_emitter_samples"),
         set_color("side.bsdf.reflectance.value"), 0.8, 0.02, spp=1024, seeds=6),
    Case("two_samples_light", "", lambda: scene("transient_two_emitter_samples", light=area_light()),
         move("light.to_world", (0, 0, 1)), 0.0, 4e-3, spp=2048, seeds=6),
    Case("two_samples_fog", "", lambda: scene("transient_two_emitter_samples", media=True),
         set_color("block.interior_medium.sigma_t.value.value"), 0.4, 0.02, spp=2048, seeds=6),
    Case("own_light_wall", "", lambda: scene("transient_with_point_light"),
         move("wall.to_world", (0, 0, 1)), 0.0, 4e-3, spp=1024, seeds=6),
    Case("own_light_fog", "", lambda: scene("transient_with_point_light", media=True),
         set_color("block.interior_medium.sigma_t.value.value"), 0.4, 0.02, spp=2048, seeds=6),
    Case("guided_wall", "", lambda: scene("transient_guided"),
         move("wall.to_world", (0, 0, 1)), 0.0, 1e-3, spp=8192, seeds=6),
    Case("guided_albedo", "", lambda: scene("transient_guided"),
         set_color("side.bsdf.reflectance.value"), 0.8, 0.02, spp=1024, seeds=6),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_gradients_follow(case):
    problem = Problem(case)
    reverse = np.array([problem.reverse(100 + s) for s in range(case.seeds)])
    assert problem.forward(100) == pytest.approx(reverse[0], rel=ROUNDING)
    above, below = ([problem.loss(sign * case.step + case.value, s) for s in range(case.seeds)] for sign in (1, -1))
    differences = (np.array(above) - np.array(below)) / (2 * case.step)
    error = np.sqrt((reverse.var(ddof=1) + differences.var(ddof=1)) / case.seeds)
    assert abs(reverse.mean() - differences.mean()) < SIGMAS * error
    assert error < 0.15 * abs(differences.mean())


def images(description, spp, seeds):
    loaded = mi.load_dict(description, optimize=False)
    return np.array([np.array(loaded.integrator().render(loaded, seed=s, spp=spp)[1]) for s in range(seeds)])


SAME = {
    "two samples": lambda kind: scene(kind or "transient_two_emitter_samples", light=area_light()),
    "guided": lambda kind: scene(kind or "transient_guided"),
}


@pytest.mark.parametrize("name", SAME)
def test_same_mean(name):
    """Other strategies, the same light: the difference of the means lies within its error."""
    a, b = (images(SAME[name](kind), 256, 8) for kind in (None, "transient_path"))
    total_a, total_b = a.sum((1, 2, 3, 4)), b.sum((1, 2, 3, 4))
    error = np.sqrt((total_a.var(ddof=1) + total_b.var(ddof=1)) / 8)
    assert abs(total_a.mean() - total_b.mean()) < 4 * error
    assert error < 0.01 * total_b.mean()


def test_own_light_equals_the_scene_s():
    """Same random numbers, same arithmetic: a light of our own is the scene's, event by event."""
    dark = {"type": "point", "position": [0.5, 0.0, 4.0], "intensity": 1e-20}
    ours = images(scene("transient_with_point_light", light=dark), 16, 1)
    theirs = images(scene("transient_path"), 16, 1)
    assert theirs.max() > 0
    np.testing.assert_allclose(ours, theirs, rtol=2e-5, atol=1e-6 * theirs.max())


def test_a_strategy_is_one_class():
    """What the toys know of the library: the interface, the geometry of a connection and the algebra of light. None
    of them is named anywhere in the library.
    """
    tree = ast.parse(Path(toy_strategies.__file__).read_text(encoding="utf-8"))
    used = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
    allowed = ("strategy", "carry", "scattering.geometry_terms", "connection.emitter_sampled")
    expected = {f"torchtransient.plugins.transport.{name}" for name in allowed}
    assert used <= expected | {"__future__", "torchtransient.plugins.polarized"}
    package = Path(plugins.__file__).parent
    names = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    assert len(names) == 3
    for path in package.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert not [name for name in names if name in text]
