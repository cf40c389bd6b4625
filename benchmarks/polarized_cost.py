"""Polarized: `transient_path` in a polarized variant against Mitsuba's steady `stokes(path)`.

Cornell box with a metal and a glass block, 128 x 128, 64 spp, depth 8, 300 bins, `llvm_ad_mono_polarized`. Bar: 1.2 x
the steady integrator. `--gradients` times render and backward pass, too. With `--peer-python` mitransient runs between
our runs, in its own process and environment, and is compared with its own `stokes(path)`.
"""

from __future__ import annotations

from typing import Any

from _comparison import OURS, PEER, Comparison, Row, comparison_arguments, wants_gradients, with_tent
from _runner import steady

from torchtransient.scenes import cornell_box

BAR = 1.2
ALBEDO, WALL = "red.reflectance.value", {"red-wall.to_world": [1.0, 0.0, 0.0]}
METAL = {"type": "roughconductor", "eta": 0.8, "k": 2.5, "alpha": 0.3}


def box(resolution: int, bins: int, spp: int) -> dict[str, Any]:
    """A Cornell box in which light is polarized."""
    scene = cornell_box(resolution, num_bins=bins, bin_width_opl=6.0 / bins, spp=spp)
    return {
        **scene,
        "large-box": {**scene["large-box"], "bsdf": METAL},
        "small-box": {**scene["small-box"], "bsdf": {"type": "dielectric"}},
    }


def stokes(scene: dict[str, Any]) -> dict[str, Any]:
    """The same scene for Mitsuba's steady integrator."""
    steady_scene = steady(scene, "path")
    return {**steady_scene, "integrator": {"type": "stokes", "nested": steady_scene["integrator"]}}


def rows(scene: dict[str, Any]) -> list[Row]:
    """Transient, and Mitsuba's steady integrator."""
    return [
        Row("polarized", scene, against={"stokes(path)": BAR}),
        Row("stokes(path)", stokes(scene), control=True),
    ]


def backward_rows(scene: dict[str, Any]) -> list[Row]:
    """Render and backward pass: an albedo, and with it the position of a wall."""
    return [
        Row("albedo", scene, (ALBEDO,), against={"polarized": None}),
        Row("albedo and wall", with_tent(scene), (ALBEDO,), WALL, {"polarized": None}),
    ]


def main() -> None:
    parser = comparison_arguments(__doc__, gradients=True)
    parser.set_defaults(variant="llvm_ad_mono_polarized")
    options = parser.parse_args()
    resolution, spp, bins = (16, 4, 30) if options.quick else (128, 64, 300)
    scene = box(resolution, bins, spp)
    comparison = Comparison(options, spp)
    comparison.add(OURS, rows(scene) + (backward_rows(scene) if wants_gradients(options) else []))
    comparison.add(PEER, rows(scene))
    settings = {"resolution": resolution, "spp": spp, "max_depth": 8, "bins": bins}
    comparison.run("polarized_cost", settings, options.json)


if __name__ == "__main__":
    main()
