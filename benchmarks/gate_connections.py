"""Squared error times CPU time of ellipsoidal connections over the plain path, in narrow gates.

Gates of 1 % of the Cornell box's extent in time (6 cm of 6 m), early, in the middle and late, one after the other; with
a box of glass; in thin and thick fog, and in fog that does not reach the lamp; and gates that are wider. All render the
same scene in one process and take turns: plain paths with the samplers `independent` and `owen`, `transient_path_reuse`
where it renders the scene, and `connections="ellipsoidal"`. Per gate and way: the variance between runs, summed over
pixels and channels, over the square of the mean; CPU seconds of a render; the product over that of plain paths with
`independent` and with `owen` (larger than 1: better); the energy with its standard error.

    python benchmarks/gate_connections.py [--scenes cornell,glass] [--runs 16] [--json FILE]
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from _runner import arguments, environment

import torchtransient as tt
from torchtransient.scenes import scale, translate

SceneDict = dict[str, Any]
NARROW = {"early": (4.4, 4.46), "middle": (6.0, 6.06), "late": (8.5, 8.56)}
WIDE = {"60 cm, middle": (6.0, 6.6), "60 cm, late": (8.5, 9.1), "6 m": (3.5, 9.5)}
# Integrator, connections, sampler.
WAYS = {
    "independent": ("plain", "ordinary", "independent"),
    "owen": ("plain", "ordinary", "owen"),
    "path reuse": ("reuse", "ordinary", "owen"),
    "ellipsoidal": ("plain", "ellipsoidal", "owen"),
    "ellipsoidal, independent": ("plain", "ellipsoidal", "independent"),
}


def cornell(resolution: int) -> SceneDict:
    """The Cornell box."""
    return tt.scenes.cornell_box(resolution=resolution)


def glass(resolution: int) -> SceneDict:
    """The Cornell box with a box of glass."""
    return tt.scenes.cornell_box(resolution=resolution, glass=True)


def fog(resolution: int, extinction: float, place: Any = None) -> SceneDict:
    """The Cornell box full of fog, or with a cube of it in another place."""
    scene = cornell(resolution)
    medium = {"type": "homogeneous", "sigma_t": extinction, "albedo": 0.9, "phase": {"type": "hg", "g": 0.3}}
    place = scale(0.999) if place is None else place
    scene["fog"] = {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": medium}
    scene["integrator"] = {**scene["integrator"], "type": "transient_prbvolpath"}
    return scene


# Below the lamp by 0.7 m, over the boxes.
LOW = translate([0.0, -0.35, 0.0]) @ scale([0.98, 0.64, 0.98])
# Scene, gates, samples per pixel.
SCENES: dict[str, tuple[Callable[[int], SceneDict], dict[str, tuple[float, float]], int]] = {
    "cornell": (cornell, NARROW, 256),
    "cornell 16 spp": (cornell, NARROW, 16),
    "wide gates": (cornell, WIDE, 256),
    "glass": (glass, NARROW, 256),
    "fog 0.3 / m": (lambda resolution: fog(resolution, 0.3), NARROW, 64),
    "low fog 1.5 / m": (lambda resolution: fog(resolution, 1.5, LOW), NARROW, 64),
    "fog 1.5 / m": (lambda resolution: fog(resolution, 1.5), NARROW, 64),
}


def renderer(scene: SceneDict, way: str, gate: tuple[float, float], spp: int, variant: str) -> tt.TransientRenderer:
    """A renderer of one gate."""
    kind, connections, sampler = WAYS[way]
    integrator = scene["integrator"] | ({} if kind == "reuse" else {"connections": connections})
    if kind == "reuse":
        integrator["type"] = "transient_path_reuse"
    loaded = tt.load(scene | {"integrator": integrator}, variant=variant)
    gates = [tt.Gate.rectangular(*gate)]
    return tt.TransientRenderer(loaded, spp=spp, sampler=sampler, gates=gates, physics="ignore")


def measure(scene: SceneDict, gate: tuple[float, float], spp: int, runs: int, variant: str) -> dict[str, Any]:
    """Error, time and energy of all ways."""
    ways = [way for way in WAYS if way != "path reuse" or scene["integrator"]["type"] == "transient_path"]
    renderers = {way: renderer(scene, way, gate, spp, variant) for way in ways}
    images: dict[str, list[np.ndarray]] = {way: [] for way in ways}
    seconds: dict[str, list[float]] = {way: [] for way in ways}
    with torch.no_grad():
        for run in range(-2, runs):
            for way, one in renderers.items():
                begin = time.process_time()
                out = one(seed=1000 + run)
                if run >= 0:
                    seconds[way].append(time.process_time() - begin)
                    images[way].append(out.gated.double().numpy())
    rows: dict[str, Any] = {}
    for way in ways:
        stack, cpu = np.array(images[way]), float(np.median(seconds[way]))
        energy = stack.sum((1, 2, 3, 4))
        rows[way] = {
            "relative_variance": float(stack.var(0, ddof=1).sum() / np.square(stack.mean(0)).sum()),
            "cpu_seconds": cpu,
            "variance_times_cpu": float(stack.var(0, ddof=1).sum() * cpu),
            "energy": float(energy.mean()),
            "energy_standard_error": float(energy.std(ddof=1) / np.sqrt(runs)),
        }
    for row in rows.values():
        for base in ("independent", "owen"):
            row[f"gain_over_{base}"] = rows[base]["variance_times_cpu"] / row["variance_times_cpu"]
    return rows


def main() -> None:
    parser = arguments(__doc__, peer=False)
    parser.add_argument("--scenes", help="comma-separated; all")
    parser.add_argument("--runs", type=int, default=16)
    options = parser.parse_args()
    torch.set_num_threads(1)
    resolution, runs = (8, 3) if options.quick else (32, options.runs)
    known = json.loads(options.json.read_text()) if options.json and options.json.exists() else {}
    print(f"{'scene':16}{'gate':16}{'way':26}{'variance':>10}{'CPU':>8}{'/indep.':>9}{'/owen':>9}{'energy':>9}{'+-':>9}")
    for name in options.scenes.split(",") if options.scenes else SCENES:
        make, gates, spp = SCENES[name]
        spp = 4 if options.quick else spp
        # More runs of few samples, and of fog, where rare bright paths make most of the noise.
        count = runs if options.quick or spp >= 256 else 3 * runs
        for gate, ends in gates.items():
            rows = measure(make(resolution), ends, spp, count, options.variant)
            for way, row in rows.items():
                print(
                    f"{name:16}{gate:16}{way:26}{row['relative_variance']:10.4f}{row['cpu_seconds']:8.3f}"
                    f"{row['gain_over_independent']:9.2f}{row['gain_over_owen']:9.2f}{row['energy']:9.4f}"
                    f"{row['energy_standard_error']:9.4f}",
                    flush=True,
                )
            known.setdefault("scenes", {}).setdefault(name, {})[gate] = {"spp": spp, "runs": count, "ways": rows}
        if options.json:
            known["environment"] = environment(options.variant)
            options.json.write_text(json.dumps(known, indent=1) + "\n")


if __name__ == "__main__":
    main()
