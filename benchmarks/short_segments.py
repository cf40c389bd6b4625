"""Variance of gradients by a wall that others nearly touch: a plate, the floor of a corner, a lamp; by the gap.

Nailed down, the point ahead makes the derivative grow as one over the length of the segment, and its variance has no
bound. Nearer than a small radius it slides along instead. `plates`: a wall behind translucent paper; `corner`: the
strip of a wall that begins at the gap above the floor, and `deep corner` with one bounce more; `lamp`: one behind the
wall, which is translucent. In each the wall moves along its normal. `cornell box`: the red wall. Variances are per
sample, of the gradient of a loss that weighs all bins. With `--baseline PATH` those of another commit stand beside
them; bar at 1e-3 m: 10 times less. At 1e-4 m Mitsuba's rays, which start 2e-4 m and more off a surface, begin beyond
the plate: there the variance counts, not the value.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from typing import Any

import numpy as np
from _comparison import BASELINE, OURS, Row, add_baseline, load, with_tent
from _runner import Worker, arguments, environment, report

from torchtransient.scenes import cornell_box, look_at, rotate, scale, translate
from torchtransient.scenes.parts import perspective, transient_film, transient_path

GAPS = (1e-1, 1e-2, 1e-3, 1e-4)
DIFFUSE = {"type": "diffuse", "reflectance": 0.6}
PAPER = {"type": "principledthin", "base_color": 0.8, "diff_trans": 1.2, "roughness": 1.0, "spec_trans": 0.0}
SIZE = 16
Scene = dict[str, Any]


def scene_of(depth: int, sensor: Scene, **parts: Scene) -> Scene:
    """A scene of few shapes, under a point light unless they bring one."""
    light = {"type": "point", "position": [0.5, 0.2, 4.0], "intensity": 10.0}
    integrator = transient_path(depth) | {"rr_depth": 100}
    return with_tent({"type": "scene", "integrator": integrator, "sensor": sensor, "light": light, **parts})


def rectangle(pose: np.ndarray, bsdf: Scene) -> Scene:
    return {"type": "rectangle", "to_world": pose, "bsdf": dict(bsdf)}


def view(fov: float, pose: np.ndarray, start: float, bins: int = 200, width: float = 0.02) -> Scene:
    return perspective(pose, fov, transient_film(SIZE, bins, start, width), 16, "independent")


ABOVE = look_at([0.0, 0.0, 4.0], [0.0, 0.0, 0.0])


def plates(gap: float) -> Scene:
    plate = rectangle(translate([0.0, 0.0, gap]) @ scale(2.0), PAPER)
    return scene_of(5, view(8.0, ABOVE, 6.0), wall=rectangle(scale(2.0), DIFFUSE), plate=plate)


def corner(gap: float, depth: int = 3) -> Scene:
    pose = look_at([3.0, 0.0, 1.5 * gap], [0.0, 0.0, 1.5 * gap], [0.0, 0.0, 1.0])
    light = {"type": "point", "position": [1.0, 0.2, 1.0], "intensity": 10.0}
    # Of another colour: Mitsuba merges what is alike into one mesh.
    floor = rectangle(scale(2.0), {**DIFFUSE, "reflectance": 0.7})
    wall = rectangle(rotate([0, 1, 0], 90) @ scale(2.0), DIFFUSE)
    sensor = view(2 * math.degrees(math.atan(gap / 6)), pose, 3.5)
    return scene_of(depth, sensor, wall=wall, floor=floor, light=light)


def deep_corner(gap: float) -> Scene:
    """With paths that come back to the wall: seen at a grazing angle, it slides far along their rays."""
    return corner(gap, depth=4)


def lamp(gap: float) -> Scene:
    light = rectangle(translate([0.05, 0.03, -gap]) @ scale(0.3), DIFFUSE)
    light["emitter"] = {"type": "area", "radiance": 5.0}
    return scene_of(3, view(4.0, ABOVE, 3.5, 100, 0.01), wall=rectangle(scale(2.0), PAPER), light=light)


def cornell(_: float) -> Scene:
    return with_tent(cornell_box(SIZE, num_bins=300, bin_width_opl=0.02))


SCENES: dict[str, tuple[Callable[[float], Scene], list[float]]] = {
    "plates": (plates, [0.0, 0.0, 1.0]),
    "corner": (corner, [1.0, 0.0, 0.0]),
    "deep corner": (deep_corner, [1.0, 0.0, 0.0]),
    "lamp": (lamp, [0.0, 0.0, 1.0]),
}


def measure(worker: Worker, row: Row, spp: int, seeds: int) -> dict[str, float]:
    """Mean of the gradient, its standard error, and the variance per sample."""
    load(worker, row)
    key = next(iter(row.shifts))
    request = {"do": "backward", "name": row.name, "spp": spp}
    found = [worker.ask(**request, seed=2 * seed)["gradients"][key][0] for seed in range(seeds)]
    error = statistics.stdev(found) / math.sqrt(seeds)
    return {"mean": statistics.fmean(found), "error": error, "variance": statistics.variance(found) * SIZE * SIZE * spp}


def main() -> None:
    parser = arguments(__doc__, peer=False)
    add_baseline(parser)
    options = parser.parse_args()
    spp, seeds = (4, 3) if options.quick else (64, options.repeats or 64)
    rows = [
        (name, gap, Row(f"{name} {gap:g}", make(gap), shifts={"wall.to_world": direction}))
        for name, (make, direction) in SCENES.items()
        for gap in GAPS
    ]
    rows.append(("cornell box", 0.0, Row("cornell box", cornell(0), shifts={"red-wall.to_world": [1.0, 0.0, 0.0]})))
    workers = {OURS: Worker(OURS, options.variant)}
    if options.baseline is not None:
        workers[BASELINE] = Worker(OURS, options.variant, checkout=options.baseline)
    results: dict[str, Any] = {}
    for name, gap, row in rows:
        found = {side: measure(worker, row, spp, seeds) for side, worker in workers.items()}
        if BASELINE in found:
            gain = found[BASELINE]["variance"] / found[OURS]["variance"]
            found["gain"] = {"variance": gain} | ({"bar": 10.0, "within": gain >= 10} if gap == 1e-3 else {})
        results[row.name] = {"scene": name, "gap": gap, **found}
        print(line(row.name, found))
    for worker in workers.values():
        worker.close()
    settings = {"size": SIZE, "spp": spp, "seeds": seeds, "quick": options.quick}
    report("short_segments", settings, results | {"environment": environment(options.variant)}, options.json)


def line(name: str, found: dict[str, Any]) -> str:
    """One row of the table."""
    sides = [
        f"{side} {found[side]['mean']:+.4g} +- {found[side]['error']:.2g}, variance {found[side]['variance']:.3g}"
        for side in (OURS, BASELINE)
        if side in found
    ]
    gain = f"   {found['gain']['variance']:.1f} x less" if "gain" in found else ""
    return f"  {name:<18} " + " | ".join(sides) + gain


if __name__ == "__main__":
    main()
