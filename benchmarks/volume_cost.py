"""Media: `transient_prbvolpath` against Mitsuba's steady `prbvolpath` and `volpath`, and mitransient against its own.

Cornell box, 128 x 128, 64 spp, depth 8, 300 bins, with a homogeneous medium in a block of its own (an open boundary),
with the same density found by delta tracking, and in the whole room (the walls bound it, the camera stands in it). Bar:
1.10 x `prbvolpath` with the homogeneous block. `prbvolpath` does not know of media around a sensor, so the fog is
compared with `volpath` alone. With `--peer-python` the peer runs between our runs.
"""

from __future__ import annotations

import numpy as np
from _runner import Worker, arguments, encoded, environment, interleave, ratio, report, steady, summary

from torchtransient.scenes import cornell_box

BAR = 1.10


def with_block(scene: dict, medium: dict) -> dict:
    """The box with its two solids replaced by a block of medium."""
    room = {key: value for key, value in scene.items() if key not in ("small-box", "large-box")}
    pose = np.diag([0.5, 0.5, 0.5, 1.0])
    return {**room, "cloud": {"type": "cube", "to_world": pose, "bsdf": {"type": "null"}, "interior": medium}}


def with_fog(scene: dict, medium: dict) -> dict:
    """The box full of medium, camera included."""
    fog = {"type": "ref", "id": "fog"}
    room = {"fog": medium}
    for key, node in scene.items():
        is_shape = isinstance(node, dict) and node.get("type") in ("cube", "rectangle", "obj", "ply", "sphere")
        room[key] = {**node, "exterior": fog} if is_shape else node
    return {**room, "sensor": {**scene["sensor"], "medium": fog}}


def scenes_of(resolution: int, spp: int) -> dict[str, dict]:
    """The scenes for `transient_prbvolpath`."""
    box = cornell_box(resolution, spp=spp)
    box["integrator"] = {**box["integrator"], "type": "transient_prbvolpath", "max_depth": 8}
    medium = {"type": "homogeneous", "albedo": 0.8, "phase": {"type": "hg", "g": 0.5}}
    whole_box = np.diag([2.0, 2.0, 2.0, 1.0])
    whole_box[:3, 3] = -1.0
    density = {"type": "constvolume", "value": 2.0, "to_world": whole_box}
    cloud = {"type": "heterogeneous", "albedo": 0.8, "sigma_t": density}
    return {
        "block": with_block(box, {**medium, "sigma_t": 2.0}),
        "tracked block": with_block(box, cloud),
        "fog": with_fog(box, {**medium, "sigma_t": 0.2}),
    }


def main() -> None:
    options = arguments(__doc__).parse_args()
    resolution, spp = (16, 4) if options.quick else (128, 64)
    repeats = options.repeats or (2 if options.quick else 9)
    scenes = scenes_of(resolution, spp)
    libraries = {"torchtransient": Worker("torchtransient", options.variant)}
    if options.peer_python:
        libraries["mitransient"] = Worker("mitransient", options.variant, options.peer_python)
    cases, pairs = {}, []
    for library, worker in libraries.items():
        for name, scene in scenes.items():
            jobs = {f"{library}: {name}": scene, f"{library}: {name}, volpath": steady(scene, "volpath")}
            if name != "fog":
                jobs[f"{library}: {name}, prbvolpath"] = steady(scene, "prbvolpath")
            for job, description in jobs.items():
                worker.ask(do="load", name=job, scene=encoded(description))
                cases[job] = lambda seed, w=worker, n=job: w.ask(do="render", name=n, spp=spp, seed=seed)["seconds"]
            pairs += [(f"{library}: {name}", job) for job in jobs if job != f"{library}: {name}"]
    seconds = interleave(cases, repeats)
    bars = {("torchtransient: block", "torchtransient: block, prbvolpath"): BAR}
    ratios = [ratio(seconds, *pair, bars.get(pair)) for pair in pairs]
    for worker in libraries.values():
        worker.close()
    settings = {"resolution": resolution, "spp": spp, "max_depth": 8, "repeats": repeats, "quick": options.quick}
    results = {
        "cases": {name: summary(values) for name, values in seconds.items()},
        "ratios": ratios,
        "environment": environment(options.variant),
        "workers": {library: worker.versions for library, worker in libraries.items()},
    }
    report("volume_cost", settings, results, options.json)


if __name__ == "__main__":
    main()
