"""Media: `transient_prbvolpath` against Mitsuba's steady `prbvolpath` and `volpath`, and mitransient against its own.

Cornell box, 128 x 128, 64 spp, depth 8, 300 bins, with a homogeneous medium in a block of its own (an open boundary),
with the same density found by delta tracking, and in the whole room (the walls bound it, the camera stands in it). Bar:
1.10 x `prbvolpath` with the homogeneous block. `prbvolpath` does not know of media around a sensor, so the fog is
compared with `volpath` alone. `--gradients` times render and backward pass, too. With `--peer-python` the peer runs
between our runs.
"""

from __future__ import annotations

import numpy as np
from _comparison import OURS, PEER, Comparison, Row, comparison_arguments, wants_gradients, with_tent
from _runner import steady

from torchtransient.scenes import cornell_box

BARS = {("block", "prbvolpath"): 1.10}
DENSITY = "cloud.interior_medium.sigma_t.value.value"
WALL = {"red-wall.to_world": [1.0, 0.0, 0.0]}


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


def rows(scenes: dict[str, dict]) -> list[Row]:
    """Every scene, and the same for Mitsuba's own integrators."""
    found = []
    for name, scene in scenes.items():
        integrators = ("volpath",) if name == "fog" else ("volpath", "prbvolpath")
        bars = {f"{name}, {integrator}": BARS.get((name, integrator)) for integrator in integrators}
        found.append(Row(name, scene, against=bars))
        found += [Row(f"{name}, {i}", steady(scene, i), control=True) for i in integrators]
    return found


def backward_rows(scenes: dict[str, dict]) -> list[Row]:
    """Render and backward pass: the density, and with it the position of a wall."""
    return [
        Row("block: density", scenes["block"], (DENSITY,), against={"block": None}),
        Row("block: density and wall", with_tent(scenes["block"]), (DENSITY,), WALL, {"block": None}),
        Row("tracked block: density", scenes["tracked block"], (DENSITY,), against={"tracked block": None}),
    ]


def main() -> None:
    options = comparison_arguments(__doc__, gradients=True).parse_args()
    resolution, spp = (16, 4) if options.quick else (128, 64)
    scenes = scenes_of(resolution, spp)
    comparison = Comparison(options, spp)
    comparison.add(OURS, rows(scenes) + (backward_rows(scenes) if wants_gradients(options) else []))
    comparison.add(PEER, rows(scenes))
    settings = {"resolution": resolution, "spp": spp, "max_depth": 8}
    comparison.run("volume_cost", settings, options.json)


if __name__ == "__main__":
    main()
