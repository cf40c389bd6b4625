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
from support.gradient_cases.problem import Case, Problem
from support.gradient_cases.scenes import room, transform
from support.gradient_cases.unknowns import move, set_color
from support.marks import long_rows

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
    Case("two_samples_light", "", lambda: scene("transient_two_emitter_samples", light=area_light()),
         move("light.to_world", (0, 0, 1)), 0.0, 4e-3, spp=2048, seeds=6),
    Case("own_light_fog", "", lambda: scene("transient_with_point_light", media=True),
         set_color("block.interior_medium.sigma_t.value.value"), 0.4, 0.02, spp=2048, seeds=6),
    Case("guided_fog", "", lambda: scene("transient_guided", media=True, light=area_light()),
         set_color("block.interior_medium.sigma_t.value.value"), 0.4, 0.03, spp=2048, seeds=6),
]  # fmt: skip


@pytest.mark.slow
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
    """(steady, film's array), each for several seeds."""
    loaded = mi.load_dict(description, optimize=False)
    runs = [loaded.integrator().render(loaded, seed=s, spp=spp) for s in range(seeds)]
    return [np.array([np.array(run[k], dtype=np.float64) for run in runs]) for k in (0, 1)]


FILMS = {
    "histogram": {},
    "short histogram": {"steady": False, "temporal_bins": 100},
    "phasors": {"type": "phasor_hdr_film", "frequencies": "0, 0.3"},
    "gates": {"type": "gated_hdr_film", "gates": "gaussian 8.0 2.0; rectangular 7.5 9.0"},
}
HARD = {
    "area light": lambda: {"light": area_light()},
    "point light": dict,
    "something before the panel": lambda: {"light": area_light(), "before": {
        "type": "rectangle", "to_world": transform().translate([0.9, 0, 0.8]).rotate([0, 1, 0], -60).scale(0.2)}},
    "glossy and mirror": lambda: {"light": area_light(), "bsdf": {
        "type": "blendbsdf", "weight": 0.5, "a": {"type": "diffuse"}, "b": {"type": "conductor"}}},
}  # fmt: skip
# Films do not care about surfaces.
PAIRS = [("histogram", "something before the panel"), ("histogram", "glossy and mirror")]
PAIRS += [(film, "area light") for film in FILMS if film != "histogram"]


def hard_scene(plugin, film, hard):
    result = scene(plugin, **HARD[hard]())
    own = result["sensor"]["film"]
    size = {"width": own["width"], "height": own["height"], "rfilter": own["rfilter"]}
    result["sensor"]["film"] = (size if "type" in FILMS[film] else own) | FILMS[film]
    return result


TOYS = ("transient_guided", "transient_three_emitter_samples")
ROWS = [(TOYS[(n + 1) % 2], pair) for n, pair in enumerate(PAIRS)]


@pytest.mark.parametrize(("toy", "pair"), long_rows(ROWS, ROWS[2:3]))
def test_same_mean(toy, pair):
    """Other strategies, the same light: sums over the steady image and over the film's array agree within 4 sigma."""
    count, (film, hard) = 8, pair
    spp = 2048 if hard == "glossy and mirror" else 512
    found = [images(hard_scene(plugin, film, hard), spp, count) for plugin in (toy, "transient_path")]
    for ours, theirs in zip(*found, strict=True):
        a, b = (x.reshape(count, -1).sum(1) for x in (ours, theirs))
        error = np.sqrt((a.var(ddof=1) + b.var(ddof=1)) / count)
        assert abs(a.mean() - b.mean()) < 4 * error
        assert error < 0.03 * abs(b.mean())


def test_light_inside_a_short_window():
    """A light that is none of the scene's is not cut off by the box around those that are."""
    description = hard_scene("transient_with_point_light", "gates", "point light")
    far = {"type": "point", "position": [0.5, 0.0, 9.0], "intensity": 1e-6}
    gated = images(description | {"light": far}, 64, 2)[1].sum()
    expected = images(hard_scene("transient_path", "gates", "point light"), 64, 2)[1].sum()
    assert gated == pytest.approx(expected, rel=0.01) and gated > 0


@pytest.mark.parametrize("plugin", ["transient_guided_with_point_light"])
def test_own_light_equals_the_scene_s(plugin):
    """A light of our own is the scene's: as bright, and at the same time."""
    dark = {"type": "point", "position": [0.5, 0.0, 4.0], "intensity": 1e-20}
    ours, theirs = (images(scene(p, **c), 1024, 8)[1] for p, c in (
        (plugin, {"light": dark}), ("transient_path", {})))  # fmt: skip
    assert theirs.sum() > 0
    assert ours.sum() == pytest.approx(theirs.sum(), rel=2e-3)
    centers = np.arange(theirs.shape[-2])
    mean_a, mean_b = ((x.sum((0, 1, 2, 4)) * centers).sum() / x.sum() for x in (ours, theirs))
    assert mean_a == pytest.approx(mean_b, abs=0.1)


def test_every_connection_is_asked_by_an_integrator():
    """A strategy that no integrator makes, and no pass of the boundary term, is one that was forgotten."""
    package = Path(plugins.__file__).parent
    files = [ast.parse(path.read_text(encoding="utf-8")) for path in (package / "transport").glob("*.py")]
    bases = {
        node.name: {base.id for base in node.bases if isinstance(base, ast.Name)}
        for tree in files for node in tree.body if isinstance(node, ast.ClassDef)
    }  # fmt: skip
    connections, before = {"Connection"}, set()
    while connections != before:
        before = set(connections)
        connections |= {name for name, parents in bases.items() if parents & connections}
    makers = [path for room in ("integrators", "transport/boundary") for path in (package / room).glob("*.py")]
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in makers]
    calls = [node.func for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Call)]
    made = {call.id for call in calls if isinstance(call, ast.Name)}
    # Bases of others are no connections themselves.
    shared = set().union(*bases.values())
    assert len(connections) > 3 and connections - shared - made == set()
