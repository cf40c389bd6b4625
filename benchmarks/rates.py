"""Error and cost of films of rates and of beats: closed forms, and CPU time over the static histogram film.

Closed forms, monochromatic, at 4096 samples: mean rates and lengths of a wall head on and one that slides in its
plane, a mirror, a slab of glass that grows, fog that blows; distance and speed from two beats. Cost is CPU time of the
Cornell box, 64 x 64 pixels at 64 samples, in which everything moves, over the same with a static film of as many bins:
a render, with the backward pass by three albedos, by a pose, and by all velocities, the last over a static render. A
film of beats has the chirp's line shape, ten bins wide: "a line shape" is a static film that adds every arrival to so
many. All take turns in one process.

    python benchmarks/rates.py [--quick] [--json FILE]
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from _runner import arguments, environment, report

import torchtransient as tt  # isort: skip
import mitsuba as mi

from torchtransient.scenes import look_at, scale, translate

RATES, AXIS = tt.RateAxis(-10.0, 0.25, 80), tt.TimeAxis(0.0, 0.1, 100)
LAMP = {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": 1.0}


# ------------------------------------------------------------------------------------------------------- closed forms


def plate(center: Any, towards: Any, half: float = 1.0, bsdf: Any = None) -> dict[str, Any]:
    """A square of albedo 0.5 that faces a point."""
    matrix = look_at(center, towards) @ scale(half)
    return {"type": "rectangle", "to_world": matrix, "bsdf": bsdf or {"type": "diffuse", "reflectance": 0.5}}


def scene(nodes: dict[str, Any], depth: int = 2, kind: str = "transient_path") -> tt.Scene:
    """A camera of one pixel at the origin that looks along z."""
    film = {"type": "transient_hdr_film", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    camera = {"type": "perspective", "fov": 0.02, "near_clip": 1e-3, "film": film,
              "to_world": look_at((0, 0, 0), (0, 0, 1))}  # fmt: skip
    integrator = {"type": kind, "max_depth": depth, "rr_depth": 99}
    description = {"type": "scene", "integrator": integrator, "sensor": camera, "lamp": LAMP, **nodes}
    return tt.load(description, variant="llvm_ad_mono")


def mean_rate(moving: tt.Scene, spp: int, until: int | None = None) -> float:
    renderer = tt.TransientRenderer(moving, rates=RATES, time_axis=AXIS, temporal_filter="tent", spp=spp)
    by_rate = renderer(seed=0).rates[0, :, :until].double().sum((1, 2, 3))
    return float((by_rate * RATES.centers).sum() / by_rate.sum())


def glass(far: float) -> dict[str, Any]:
    """A slab of 0.4 m of index 1.5, whose far face moves."""
    corners = np.array([[x, y, z] for z in (1.0, 1.4) for y in (-1, 1) for x in (-1, 1)], float)
    faces = np.array([[0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4], [2, 6, 7], [2, 7, 3],
                      [0, 4, 6], [0, 6, 2], [1, 3, 7], [1, 7, 5]])  # fmt: skip
    speeds = np.where(corners[:, 2:] < 1.2, 0.0, far) * np.array([[0, 0, 1.0]])
    return {"type": "mesh_arrays", "vertices": corners, "faces": faces, "vertex_velocity": speeds,
            "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}}  # fmt: skip


def closed_forms(quick: bool) -> dict[str, dict[str, float]]:
    """Found and expected, of each case."""
    spp, v, rows = 16 if quick else 4096, 1.37, {}

    def row(name: str, found: float, expected: float) -> None:
        rows[name] = {"found": found, "expected": expected, "error": abs(found - expected)}
        print(f"{name}: {found:.6f}, closed form {expected:.6f}, error {abs(found - expected):.1e}", flush=True)

    head_on = scene({"wall": plate((0, 0, 2), (0, 0, 0))}).moving({"wall": tt.Motion(linear=(0, 0, -v))})
    row("wall head on, rate in m/s", mean_rate(head_on, spp), -2 * v)
    tilt = math.radians(60)
    sliding = scene({"wall": plate((0, 0, 2), (math.sin(tilt), 0, 2 - math.cos(tilt)))})
    sliding = sliding.moving({"wall": tt.Motion(linear=(v * math.cos(tilt), 0, v * math.sin(tilt)))})
    row("wall that slides in its plane, tilted by 60 degrees", mean_rate(sliding, spp), 2 * v * math.sin(tilt))

    at, normal, lamp = np.array([0, 0, 2.0]), np.array([1, 0, -1]) / math.sqrt(2), np.array([1.5, 0, 2.0])
    mirror = plate(tuple(at), tuple(at + normal), 0.5, {"type": "conductor"})
    light = {"type": "rectangle", "to_world": look_at(tuple(lamp), tuple(at)) @ scale(0.3), "emitter": {"type": "area"}}
    reflected = scene({"mirror": mirror, "lamp": light})
    for name, velocity in (("along its normal", 1.1 * normal), ("in its plane", np.array([0.9, 0.4, 0.9]))):
        found = mean_rate(reflected.moving({"mirror": tt.Motion(linear=velocity)}), spp)
        row(f"mirror that moves {name}", found, math.sqrt(2) * float(velocity @ normal) * -1.0)

    behind = {"type": "rectangle", "to_world": look_at((0, 0, 3), (0, 0, 0)), "emitter": {"type": "area"}}
    grows = scene({"glass": glass(2.0), "lamp": behind}, depth=3)
    row("slab of glass that grows by 2 m/s", mean_rate(grows, spp, until=36), 1.0)

    fog = {"type": "homogeneous", "sigma_t": 0.4, "albedo": 0.9, "id": "mist"}
    box = {"type": "cube", "to_world": translate([0, 0, 2.5]) @ scale([5, 5, 1.5]), "bsdf": {"type": "null"},
           "interior": fog}  # fmt: skip
    blows = scene({"box": box}, kind="transient_prbvolpath").moving({"mist": tt.Motion(linear=(0.3, 0.2, 1.4))})
    row("fog that blows, scattered once", mean_rate(blows, spp), 2.8)

    chirps, distance, speed = tt.Chirps(1e9, 10e-6, 1550e-9), 3.217, 1.83
    axis = chirps.time_axis((0.5, 6.0), (-3.0, 3.0))
    wall = scene({"wall": plate((0, 0, distance), (0, 0, 0))}).moving({"wall": tt.Motion(linear=(0, 0, -speed))})
    renderer = tt.TransientRenderer(wall, chirps=chirps, time_axis=axis, temporal_filter="box", spp=spp)
    found = tt.sensing.range_and_speed(renderer(seed=0).beats[0], chirps, axis)
    row("distance from two beats, m", float(found[0]), distance)
    row("speed of approach from two beats, m/s", float(found[1]), speed)
    return rows


# --------------------------------------------------------------------------------------------------------------- cost

BINS = tt.TimeAxis(2.0, 0.15, 64)
# A line of 0.15 m; 1 m/s looks like 0.1 m.
CHIRPS = tt.Chirps(2e9, 1e-6, 1550e-9)
FILMS: dict[str, dict[str, Any]] = {
    "static": {},
    "one bin of rate": {"rates": tt.RateAxis(-100.0, 200.0, 1)},
    "32 bins of rate": {"rates": tt.RateAxis(-8.0, 0.5, 32)},
    "a line shape": {"irf": CHIRPS.line_shape},
    "two chirps": {"chirps": CHIRPS},
}
STATIC = ("static", "a line shape")


def costs(variant: str, quick: bool, repeats: int) -> dict[str, dict[str, float]]:
    """CPU time over the same with the static film."""
    mi.set_variant(variant)
    box = tt.load(tt.scenes.cornell_box(resolution=8 if quick else 64), variant=variant)
    bodies = [key.removesuffix(".to_world") for key in box.parameters() if key.endswith(".to_world")]
    turning = tt.Motion(linear=(0.5, -1.0, 2.0), angular=(0.1, 0.2, 0.3))
    moving = box.moving({name: turning for name in bodies if name != "sensor"})
    albedos = [key for key in box.parameters() if key.endswith("reflectance.value")][:3]
    velocities = [key for key in moving.parameters() if key.endswith("velocity.linear")]
    keys = {"render": [], "albedos": albedos, "a pose": ["small-box.to_world"], "velocities": velocities}
    jobs: dict[tuple[str, str], Callable[[int], None]] = {}
    for film, settings in FILMS.items():
        for what, chosen in keys.items():
            if what == "velocities" and film in STATIC:
                continue
            renderer = tt.TransientRenderer(
                box if film in STATIC else moving, chosen, time_axis=BINS, spp=4 if quick else 64, **settings
            )

            def job(seed: int, renderer: tt.TransientRenderer = renderer, backward: bool = bool(chosen)) -> None:
                out = renderer(seed=seed)
                light = next(x for x in (out.transient, out.rates, out.beats) if x is not None)
                loss = light.square().sum()
                if backward:
                    loss.backward()

            jobs[film, what] = job
    seconds: dict[tuple[str, str], list[float]] = {name: [] for name in jobs}
    for seed in range(repeats + 2):
        for name, job in jobs.items():
            begun = time.process_time()
            job(seed)
            if seed > 1:  # the first rounds compile and record
                seconds[name].append(time.process_time() - begun)
    rows: dict[str, dict[str, float]] = {}
    for (film, what), values in seconds.items():
        base = seconds["static", "render" if what == "velocities" else what]
        rows.setdefault(film, {})[what] = statistics.median(a / b for a, b in zip(values, base, strict=True))
    for what in ("render", "albedos", "a pose"):
        pairs = zip(seconds["two chirps", what], seconds["a line shape", what], strict=True)
        rows.setdefault("two chirps over a line shape", {})[what] = statistics.median(a / b for a, b in pairs)
    rows["static"]["seconds"] = statistics.median(seconds["static", "render"])
    for film, row in rows.items():
        print(f"{film}: " + ", ".join(f"{what} {value:.2f}" for what, value in row.items()), flush=True)
    return rows


def main() -> None:
    options = arguments(__doc__, peer=False).parse_args()
    torch.set_num_threads(1)
    variant, quick = options.variant, options.quick
    repeats = options.repeats or (2 if quick else 9)
    results: dict[str, Any] = {"closed forms": closed_forms(quick), "cost": costs(variant, quick, repeats)}
    report("rates", {"repeats": repeats, "quick": quick}, results | {"environment": environment(variant)},
           options.json)  # fmt: skip


if __name__ == "__main__":
    main()
