"""Gradient cases of metals: without index or absorption, where Mitsuba's own have no slope, and brushed ones."""

from __future__ import annotations

from functools import partial

from support.gradient_cases.problem import Case
from support.gradient_cases.scenes import area_light, camera, mirror_room, room, transform
from support.gradient_cases.unknowns import rotate, set_color

INDEX = "complex index of a conductor"
SEEN_AT = (3.0, 0.0, 2.0)
"""Beyond the angle of total reflection from an index of 0.4, which is 24 degrees."""


def metal(plugin="diff_rough_conductor", **index):
    """A metal of ``eta`` and ``k``."""
    rough = {"alpha": 0.3} if "rough" in plugin else {}
    return {"type": plugin, **rough, **{name: {"type": "uniform", "value": value} for name, value in index.items()}}


def slanted(bsdf):
    """A wall seen under an angle, and light from the other side."""
    light = area_light("sphere") | {"center": [-2.5, 0.2, 1.6]}
    scene = room(bsdf, light=light, sensor=camera(origin=SEEN_AT, start=5.0))
    del scene["side"]
    return scene


def brushed():
    """A wall of brushed metal that overfills the picture, turned about its normal."""
    bsdf = {"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.4, "eta": 0.5, "k": 2.0, "distribution": "ggx"}
    scene = room(bsdf, light={"type": "point", "position": [1.5, 0.7, 3.0], "intensity": 10.0}, depth=2)
    del scene["side"]
    scene["wall"]["to_world"] = transform().rotate([0, 0, 1], 20).scale(4)
    return scene


def case(name, scene, slot, step=0.01, **more):
    return Case(name, INDEX, scene, set_color(f"wall.bsdf.{slot}.value"), 0.0, step, side=1, **more)


CASES = [
    case("metal_without_index", lambda: mirror_room(metal("diff_conductor", eta=0.0, k=2.0)), "eta", spp=2048),
    case("slanted_metal_without_absorption", lambda: slanted(metal(eta=0.4, k=0.0)), "k", 2e-3),
    case(
        "rough_metal_of_index_zero_polarized",
        partial(slanted, metal(eta=0.0, k=2.0)),
        "eta",
        variant="llvm_ad_mono_polarized",
    ),
    # In degrees. Differences of 2 degrees are 0.3 % off, of one 0.07 %, of a half 0.02 %: the step, not the derivative.
    Case("brushed_metal_turns", "shape to_world", brushed, rotate("wall.to_world", (0, 0, 1)), 0.0, 0.25),
    Case(
        "brushed_metal_alpha", "roughness (rough conductor)", brushed, set_color("wall.bsdf.alpha_u.value"), 0.1, 1e-3
    ),
]
