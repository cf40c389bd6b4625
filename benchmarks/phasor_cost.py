"""Phasor film against Mitsuba's steady `path`: 1, 16, 64 and 301 frequencies, and a list that is no grid.

Cornell box, 128 x 128, 64 spp, depth 8. Bars: 1.5 x the steady `path` for 16 frequencies and 5 x for 301, both on a
uniform grid. `--gradients` times a render and the backward pass through its phasors together: derivatives by an albedo
(bars 2.5 x and 8 x one render of the steady `path`), and by the position of a wall, too. With `--peer-python`
mitransient runs 16 and 301 frequencies between our runs, in its own process and environment, and is compared with its
own `path`; it renders phasors in monochromatic variants only, so give `--variant llvm_ad_mono` then.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from _comparison import OURS, PEER, Comparison, Row, comparison_arguments, wants_gradients
from _runner import steady

from torchtransient.scenes import cornell_box

BARS = {"grid of 16": 1.5, "grid of 301": 5.0}
BACKWARD_BARS = {"grid of 16": 2.5, "grid of 301": 8.0}
STEP = 0.05
ALBEDO, WALL = "red.reflectance.value", {"red-wall.to_world": [1.0, 0.0, 0.0]}


def with_film(scene: dict[str, Any], **film: Any) -> dict[str, Any]:
    """The scene with a phasor film."""
    size = {key: scene["sensor"]["film"][key] for key in ("width", "height", "rfilter")}
    film = {"type": "phasor_hdr_film", **size, **film}
    return {**scene, "sensor": {**scene["sensor"], "film": film}}


def grid(scene: dict[str, Any], count: int) -> dict[str, Any]:
    """`count` frequencies from zero on."""
    return with_film(scene, frequency_first=0.0, frequency_step=STEP, frequency_count=count)


def scattered(scene: dict[str, Any], count: int) -> dict[str, Any]:
    """As many frequencies of the same range, at random."""
    values = np.sort(np.random.default_rng(0).uniform(0, STEP * count, count))
    return with_film(scene, frequencies=" ".join(map(str, values)))


def transform_bins(scene: dict[str, Any], count: int) -> dict[str, Any]:
    """`count` bins of a transform: what mitransient can express, `STEP` apart."""
    middle = (count - 1) / 2 * STEP
    return with_film(
        scene, wl_mean=1 / middle, wl_sigma=1 / (count - 2) / STEP, temporal_bins=2000, bin_width_opl=1 / 2000 / STEP
    )


def rows(scene: dict[str, Any], films: dict[str, dict[str, Any]]) -> list[Row]:
    """The steady `path`, and every film."""
    measured = [Row(name, with_film, against={"path": BARS.get(name)}) for name, with_film in films.items()]
    return [Row("path", steady(scene, "path"), control=True), *measured]


def backward_rows(films: dict[str, dict[str, Any]], counts: tuple[int, ...]) -> list[Row]:
    """Render and backward pass: an albedo, and with it the position of a wall."""
    few, many = (f"grid of {n}" for n in (counts[1], counts[-1]))
    names = few, many, f"list of {counts[-1]}"
    albedo = [
        Row(f"{name}, render and backward", films[name], (ALBEDO,), against={"path": BACKWARD_BARS.get(name)})
        for name in names
    ]
    path: dict[str, float | None] = {"path": None}
    walls = [
        Row(f"{name}, render and backward, with a wall", films[name], (ALBEDO,), WALL, path) for name in (few, many)
    ]
    return albedo + walls


def main() -> None:
    options = comparison_arguments(__doc__, gradients=True).parse_args()
    resolution, spp, counts = (16, 4, (1, 3, 5)) if options.quick else (128, 64, (1, 16, 64, 301))
    scene = cornell_box(resolution, num_bins=300, bin_width_opl=0.02, spp=spp)
    ours = {f"grid of {n}": grid(scene, n) for n in counts}
    ours |= {f"list of {n}": scattered(scene, n) for n in (counts[1], counts[-1])}
    theirs = {f"transform of {n}": transform_bins(scene, n) for n in (counts[1], counts[-1])}
    comparison = Comparison(options, spp)
    comparison.add(OURS, rows(scene, ours) + (backward_rows(ours, counts) if wants_gradients(options) else []))
    comparison.add(PEER, rows(scene, theirs))
    settings = {"resolution": resolution, "spp": spp, "max_depth": 8}
    comparison.run("phasor_cost", settings, options.json)


if __name__ == "__main__":
    main()
