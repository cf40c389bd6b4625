"""Cost of derivatives of captures: time of a backward pass over that of a render, and peak memory by connections.

    python benchmarks/nlos_reverse.py [--scene z|mannequin] [--rounds 5]

Renders and backward passes alternate; what is printed are ratios of medians. Memory is that of a process of its own for
each number of samples.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path

import torchtransient as tt  # isort: skip

import drjit as dr
import mitsuba as mi
import numpy as np

VARIANT = "llvm_ad_mono"


def built(name: str, kind: str, how: str, points: int):
    """(scene, parameters, key of the hidden vertices) under the active variant."""
    hidden = {"z": tt.scenes.nlos_z, "mannequin": tt.scenes.nlos_mannequin}[name]()
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(1.0, 1.0), points, kind=kind)
    description = tt.nlos.capture_scene(hidden, scan)
    description["integrator"]["third_bounce"] = how
    film = description["wall"]["sensor"]["film"]
    film |= {"temporal_bins": 512, "bin_width_opl": 0.0048, "start_opl": 1.6, "temporal_filter": "tent"}
    scene = mi.load_dict(as_mitsuba(description))
    parameters = mi.traverse(scene)
    found = (key for key in parameters.keys() if key.endswith("vertex_positions"))  # noqa: SIM118 (not a dictionary)
    key = next(key for key in found if not key.startswith("wall"))
    return scene, parameters, key


def as_mitsuba(value):
    """A description of ours as ``mi.load_dict`` takes it."""
    if isinstance(value, dict):
        return {key: as_mitsuba(child) for key, child in value.items()}
    if isinstance(value, np.ndarray) and value.shape == (4, 4):
        return mi.ScalarTransform4f(value)
    return mi.TensorXf(value.astype(np.float32)) if isinstance(value, np.ndarray) else value


class Job:
    """A render and its backward pass."""

    def __init__(self, name: str, kind: str, how: str, points: int, spp: int) -> None:
        self.scene, self.parameters, self.key = built(name, kind, how, points)
        self.start, self.spp = type(self.parameters[self.key])(self.parameters[self.key]), spp
        shape = tuple(self.scene.sensors()[0].film().cube_shape())
        self.adjoint = mi.TensorXf(np.random.default_rng(0).normal(size=shape).astype(np.float32))

    def render(self, seed: int) -> None:
        with dr.suspend_grad():
            self.scene.integrator().render(self.scene, seed=seed, spp=self.spp, develop=False)
        dr.sync_thread()

    def backward(self, seed: int) -> None:
        value = type(self.start)(self.start)
        dr.enable_grad(value)
        self.parameters[self.key] = value
        self.parameters.update()
        self.scene.integrator().render_backward(
            self.scene, self.parameters, (None, self.adjoint), seed=seed, spp=self.spp
        )
        dr.eval(dr.grad(value))
        dr.sync_thread()

    def detach(self) -> None:
        self.parameters[self.key] = self.start
        self.parameters.update()


def times(job: Job, rounds: int) -> dict[str, float]:
    """Medians of seconds, in turns."""
    found: dict[str, list[float]] = {"render": [], "backward": []}
    for i in range(rounds + 2):
        job.detach()
        for name, call in (("render", job.render), ("backward", job.backward)):
            began = time.perf_counter()
            call(i)
            if i > 1:
                found[name].append(time.perf_counter() - began)
    return {name: statistics.median(values) for name, values in found.items()}


def memory(name: str, kind: str, spp: int) -> float:
    """Peak memory of a process that takes one backward pass, MiB."""
    done = subprocess.run(
        [sys.executable, __file__, "--memory-of", name, kind, str(spp)], capture_output=True, text=True, check=True
    )
    return float(done.stdout.split()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", choices=("z", "mannequin"), action="append")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--memory-of", nargs=3)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    mi.set_variant(VARIANT)
    tt.plugins.sync()
    if given.memory_of:
        name, kind, spp = given.memory_of
        Job(name, kind, "shared", 32, int(spp)).backward(0)
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
        return
    rows = []
    for name in given.scene or ("z", "mannequin"):
        for kind in ("confocal", "single"):
            for how, spp in (("shared", 2**14), ("paths", 1024)):
                t = times(Job(name, kind, how, 32, spp), given.rounds)
                rows.append({"scene": name, "kind": kind, "how": how, "ratio": t["backward"] / t["render"], **t})
                print(f"{name:10s} {kind:9s} {how:7s} backward over render {rows[-1]['ratio']:.2f}", flush=True)
        sizes = {spp * 1024 / 1e6: memory(name, "confocal", spp) for spp in (1024, 2**14, 2**16)}
        words = ", ".join(f"{count:.0f} M: {size:.0f} MiB" for count, size in sizes.items())
        print(f"{name:10s} confocal, peak memory of a backward pass by connections: {words}", flush=True)
        rows.append({"scene": name, "memory_mib": sizes})
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
