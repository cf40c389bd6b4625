"""Error, noise and cost of `tt.over_time` by number of poses.

Errors are of the image that an exposure of 1.5 ms with one beat makes of 30 MHz, over that of 64 instants re-rendered
with four times the samples and another seed: a wall towards the camera at 10 m/s, a corner whose second wall moves and
turns with its edges far and near, a plate whose outline crosses pixels. "one seed" takes the samples of the estimate
for the instants, which leaves the polynomial in time. Rolling shutters are compared with a render for each row. Noise
is the deviation between runs over the phasor without a beat, at equal samples in all. Cost is CPU time over one render,
or over one render with its backward pass, of the Cornell box; all take turns.

    python benchmarks/moving_scenes.py [--quick] [--json FILE]
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from _runner import arguments, environment, report

import torchtransient as tt
from torchtransient.scenes import look_at, scale

FREQUENCIES, EXPOSURE_S = tt.FrequencyAxis.from_hertz([30e6]), 1.5e-3
POSES = (2, 3, 8)
LAMP = {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": 1.0}
INSIDE = {"type": "point", "position": [-0.5, 0.3, 0.2], "intensity": 1.0}


def wall(center: Any, towards: Any, half: float) -> dict[str, Any]:
    """A square of albedo 0.5 that faces a point."""
    color = {"type": "rgb", "value": [0.5, 0.5, 0.5]}
    matrix = look_at(center, towards) @ scale(half)
    return {"type": "rectangle", "to_world": matrix, "bsdf": {"type": "diffuse", "reflectance": color}}


def scene(nodes: dict[str, Any], depth: int, size: int = 1, fov: float = 0.05) -> dict[str, Any]:
    """A camera at the origin that looks along z."""
    film = {"type": "transient_hdr_film", "width": size, "height": size, "rfilter": {"type": "box"}}
    camera = {"type": "perspective", "fov": fov, "near_clip": 1e-3, "film": film,
              "to_world": look_at((0, 0, 0), (0, 0, 1)), "sampler": {"type": "independent"}}  # fmt: skip
    integrator = {"type": "transient_path", "max_depth": depth, "rr_depth": 99}
    return {"type": "scene", "integrator": integrator, "sensor": camera, **nodes}


def corner(half: float) -> dict[str, Any]:
    """Two walls, of which the second moves; the camera sees the first."""
    return {"wall": wall((0, 0, 2), (0.3, 0.2, 0), 0.9), "body": wall((1.3, 0, 1.0), (0, 0, 1.2), half), "lamp": INSIDE}


TURNING = tt.Motion(linear=(-8.0, 4.0, 3.0), angular=(0.0, 30.0, 0.0), center=(1.3, 0.0, 1.0))
PLATE = {"wall": wall((0, 0, 2.5), (0, 0, 0), 2.0), "body": wall((0.05, 0, 1.5), (0.05, 0, 0), 0.11), "lamp": LAMP}
# (scene, motion, samples)
CASES = {
    "wall, head on": (
        scene({"body": wall((0, 0, 2), (0, 0, 0), 1.0), "lamp": LAMP}, 2), tt.Motion(linear=(0, 0, -10.0)), 1 << 12
    ),
    "corner, edges far": (scene(corner(40.0), 3), TURNING, 1 << 16),
    "corner, edges seen from the wall": (scene(corner(0.7), 3), TURNING, 1 << 16),
    "plate whose outline crosses pixels": (scene(PLATE, 2, 8, 12.0), tt.Motion(linear=(6.0, 0, -6.0)), 1 << 12),
}  # fmt: skip


def renderer_of(description: Any, variant: str, keys: list[str], **settings: Any) -> tt.TransientRenderer:
    settings.setdefault("frequencies", FREQUENCIES)
    return tt.TransientRenderer(tt.load(description, variant=variant), keys, grad_seed="same", **settings)


def instants(renderer: tt.TransientRenderer, motion: tt.Motion, seed: int, spp: int) -> torch.Tensor:
    """The average of 64 instants with the beat, by Gauss-Legendre quadrature."""
    x, g = np.polynomial.legendre.leggauss(64)
    total: Any = 0
    for t, weight in zip(EXPOSURE_S / 2 * x, g / 2, strict=True):
        picture = tt.over_time(renderer, {"body": motion}, tt.Frames([t]), seed=seed, spp=spp).phasor[0]
        total = total + weight * np.exp(2j * np.pi * t / EXPOSURE_S) * picture.detach().to(torch.complex128)
    return total


def relative(found: torch.Tensor, truth: torch.Tensor) -> float:
    return float((found.detach() - truth).abs().norm() / truth.abs().norm())


def errors(variant: str, quick: bool) -> dict[str, dict[str, float]]:
    rows = {}
    for name, (description, motion, spp) in CASES.items():
        spp = 16 if quick else spp
        renderer = renderer_of(description, variant, ["body.to_world"])
        truth, same = instants(renderer, motion, 1234, 4 * spp), instants(renderer, motion, 7, spp)
        row = {"signal": float(truth.abs().mean() / renderer(seed=0, spp=spp).phasor.detach().abs().mean())}
        for poses in POSES:
            exposure = tt.Exposure(EXPOSURE_S, beat_hz=1 / EXPOSURE_S, poses=poses)
            found = tt.over_time(renderer, {"body": motion}, exposure, seed=7, spp=spp).phasor
            row |= {f"{poses} poses": relative(found, truth), f"{poses} poses, one seed": relative(found, same)}
        rows[name] = row
        print(f"{name}: " + ", ".join(f"{key} {value:.1e}" for key, value in row.items()), flush=True)
    return rows


def rolling(variant: str, quick: bool) -> dict[str, dict[str, float]]:
    """20 ms from the first row to the last; error over a render for each row, and that of a global shutter."""
    rows, size, spp = {}, 16, 4 if quick else 512
    shutter, motion = tt.RollingShutter(20e-3 / size), tt.Motion(linear=(2.0, 0.5, -3.0))
    bodies = {
        "rolling shutter, wall": {"body": wall((0, 0, 2), (0.5, 0.2, 0), 2.0)},
        "rolling shutter, plate with its outline": {
            "wall": wall((0, 0, 3), (0, 0, 0), 3.0), "body": wall((0.1, 0, 2), (0, 0, 0), 0.2)
        },
    }  # fmt: skip
    number = torch.arange(size)
    for name, nodes in bodies.items():
        renderer = renderer_of(scene({**nodes, "lamp": LAMP}, 3, size, 20.0), variant, ["body.to_world"])
        each = tt.over_time(renderer, {"body": motion}, tt.Frames(shutter.rows_s(size)), seed=5, spp=spp).phasor
        truth = each[number, ..., number, :].movedim(0, -2).detach()
        found = tt.over_time(renderer, {"body": motion}, shutter, seed=5, spp=spp).phasor
        rows[name] = {"3 poses": relative(found, truth), "global": relative(renderer(seed=5, spp=spp).phasor, truth)}
        print(f"{name}: " + ", ".join(f"{key} {value:.1e}" for key, value in rows[name].items()), flush=True)
    return rows


def noise(variant: str, quick: bool) -> dict[str, float]:
    """Deviation of the image between runs over the phasor, 1024 samples a pixel in all, in a room of two walls."""
    total, runs = (32, 3) if quick else (1024, 24)
    renderer = renderer_of(scene(corner(0.7), 4, 4, 20.0), variant, ["body.to_world"])
    level = float(renderer(seed=0, spp=4 * total).phasor.detach().abs().mean())

    def spread(image: Callable[[int], torch.Tensor]) -> float:
        images = torch.stack([image(100 + 17 * run).detach() for run in range(runs)])
        return float((images - images.mean(0)).abs().square().sum(0).div(runs - 1).mean().sqrt()) / level

    still = spread(lambda seed: renderer(seed=seed, spp=total).phasor)
    # A time for each path turns its weight by a random phase of the beat, so that its square remains.
    rows = {"a time for each path (computed)": (still**2 + 1 / total) ** 0.5}
    for poses in POSES:
        exposure = tt.Exposure(EXPOSURE_S, beat_hz=1 / EXPOSURE_S, poses=poses)
        rows[f"{poses} poses"] = spread(
            lambda seed, e=exposure: tt.over_time(
                renderer, {"body": TURNING}, e, seed=seed, spp=total // e.poses
            ).phasor
        )
    print("noise over the phasor: " + ", ".join(f"{key} {value:.1e}" for key, value in rows.items()), flush=True)
    return rows


def costs(variant: str, quick: bool, repeats: int) -> dict[str, float]:
    """CPU time over one render, and over one render with its backward pass."""
    box = tt.scenes.cornell_box(resolution=8 if quick else 64)
    keys = ["small-box.to_world", "red.reflectance.value"]
    renderer = renderer_of(box, variant, keys, spp=4 if quick else 64)
    velocity = torch.tensor([1.0, 0.0, 0.0], requires_grad=True)
    ways: dict[str, Callable[[int], tt.RenderOutput]] = {"one": lambda seed: renderer(seed=seed)}
    for poses in POSES:
        exposure = tt.Exposure(EXPOSURE_S, beat_hz=1 / EXPOSURE_S, poses=poses)
        ways[f"{poses} poses"] = lambda seed, e=exposure: tt.over_time(
            renderer, {"small-box": tt.Motion(linear=velocity)}, e, seed=seed
        )
    seconds: dict[str, list[float]] = {f"{name}{what}": [] for what in ("", ", backward") for name in ways}
    for seed in range(repeats + 1):
        for what in ("", ", backward"):
            for name, way in ways.items():
                begun = time.process_time()
                out = way(seed)
                if what:
                    out.phasor.abs().square().sum().backward()
                if seed > 0:  # the first round compiles
                    seconds[name + what].append(time.process_time() - begun)
    rows = {}
    for name, values in seconds.items():
        base = seconds["one, backward" if "backward" in name else "one"]
        rows[name] = statistics.median(a / b for a, b in zip(values, base, strict=True))
    print("CPU time: " + ", ".join(f"{key} {value:.2f}" for key, value in rows.items()), flush=True)
    return rows


def main() -> None:
    options = arguments(__doc__, peer=False).parse_args()
    torch.set_num_threads(1)
    variant, quick = options.variant, options.quick
    repeats = options.repeats or (2 if quick else 9)
    results: dict[str, Any] = {"errors": errors(variant, quick), "rolling": rolling(variant, quick)}
    results |= {"noise": noise(variant, quick), "cost": costs(variant, quick, repeats)}
    report("moving_scenes", {"repeats": repeats, "quick": quick}, results | {"environment": environment(variant)},
           options.json)  # fmt: skip


if __name__ == "__main__":
    main()
