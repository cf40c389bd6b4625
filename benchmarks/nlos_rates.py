"""Connections per second of the third-bounce fast path, beside any-hit rays per second in the same scene.

A connection is one hidden sample seen by one scan point (one pair of points in an exhaustive scan); those that a shaft
spares a ray are counted. Rays are random ones, from the wall to the hidden object's box. Scenes: a letter Z of large
triangles, a body of ellipsoids of 3 072 and of 49 152 triangles that hide each other. With `--memory` the peak memory
of the process is read at 1, 17 and 67 million connections.
"""

from __future__ import annotations

import gc
import resource
import statistics
import time
from collections.abc import Callable
from typing import Any

from _runner import arguments, environment, interleave, ratio, report, summary

import torchtransient  # noqa: F401  before Mitsuba: finds LLVM
from torchtransient import plugins
from torchtransient.scenes.meshes import Mesh, joined, octahedral_ellipsoid, plate

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip

WALL_ALBEDO, ALBEDO = 0.9, 0.7
BINS, BIN_WIDTH, START = 512, 0.005, 1.6


def letter() -> Mesh:
    bar = np.array([[-0.5, -0.3, 1], [-0.25, -0.3, 1], [0.25, 0.3, 1], [0.5, 0.3, 1]])
    return joined(plate(1, 0.2, (0, 0.4, 1)), plate(1, 0.2, (0, -0.4, 1)), (bar, np.array([[0, 2, 1], [1, 2, 3]])))


def body(level: int) -> Mesh:
    parts = [
        ([0, 0.55, 1.2], [0.11, 0.14, 0.12]), ([0, 0.15, 1.2], [0.2, 0.28, 0.13]),
        ([0.12, -0.38, 1.2], [0.08, 0.34, 0.09]), ([-0.12, -0.38, 1.2], [0.08, 0.34, 0.09]),
        ([0.33, 0.2, 1.15], [0.22, 0.06, 0.06]),
        ([-0.2, 0.2, 0.93], [0.06, 0.06, 0.24]),
    ]  # fmt: skip
    return joined(*[octahedral_ellipsoid(center, radii, level) for center, radii in parts])


def mesh(name: str, arrays: Mesh, albedo: float) -> Any:
    v, f = arrays
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": albedo})
    made = mi.Mesh(name, len(v), len(f), props=properties)
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = mi.Float(np.ravel(v).astype(np.float32))
    parameters["faces"] = mi.UInt32(np.ravel(f).astype(np.uint32))
    parameters.update()
    return made


def grid(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of a scan of 1 m and their normals."""
    c = (np.arange(count) + 0.5) / count - 0.5
    x, y = np.meshgrid(c, c)
    points = np.stack([x, y, 0 * x], -1).reshape(-1, 3)
    return points, np.tile([0.0, 0.0, 1.0], (len(points), 1))


class Case:
    """One hidden object: what is timed."""

    def __init__(self, arrays: Mesh, scan: int, pairs: int, samples: int, rays_too: bool = True) -> None:
        # Plugins know their variant: their modules are imported when one is active.
        from torchtransient.plugins.around_corner import geometry as wall_points
        from torchtransient.plugins.around_corner import shafts, third_bounce
        from torchtransient.plugins.sampling import hidden_elements, shared_samples

        v, f = plate(2, 2, (0, 0, 0))
        hidden = mesh("hidden", arrays, ALBEDO)
        self.scene = mi.load_dict(
            {"type": "scene", "wall": mesh("wall", (v, f[:, ::-1]), WALL_ALBEDO), "hidden": hidden}
        )
        points, normals = grid(scan)
        few, few_normals = grid(pairs)
        self.low, self.high = arrays[0].min(0), arrays[0].max(0)
        table = hidden_elements.HiddenElements([hidden], *grid(5))
        every = shared_samples.draw_samples(table, samples, 0) if rays_too else None
        begun = time.perf_counter()
        self.share = shafts.spare_rays(
            self.scene, table, np.concatenate([points, few]), np.concatenate([normals, few_normals])
        )
        self.shaft_seconds = time.perf_counter() - begun
        spared = shared_samples.draw_samples(table, samples, 0)

        def wall(p: np.ndarray, n: np.ndarray) -> Any:
            return wall_points.WallPoints(mi.Point3f(p.T), mi.Normal3f(n.T), WALL_ALBEDO / np.pi)

        sensors, lasers = wall(points, normals), wall(few, few_normals)
        one = film(scan, samples)
        both = film(pairs, samples, exhaustive_scan=True, laser_scan_width=pairs, laser_scan_height=pairs)
        job = third_bounce.ThirdBounce
        free = job(self.scene, one, spared, sensors)
        paired = job(self.scene, both, spared, lasers)
        laser = wall(points[:1], normals[:1])
        flat, square = scan**2 * samples, pairs**4 * samples
        self.jobs: dict[str, tuple[Callable[[], Any], int]] = {
            "any-hit rays": (lambda: self.rays(flat), flat),
            "confocal": (free.add_confocal, flat),
            "single": (lambda: free.add_single(laser), flat),
            "exhaustive": (lambda: third_bounce.add_exhaustive(paired, lasers, False), square),
            "exhaustive, reciprocal": (lambda: third_bounce.add_exhaustive(paired, lasers, True), square),
        }
        if every is not None:
            self.jobs["confocal, a ray each"] = (job(self.scene, one, every, sensors).add_confocal, flat)

    def rays(self, count: int) -> None:
        i = dr.arange(mi.UInt32, count)
        u = [mi.sample_tea_float32(i, k) for k in range(5)]
        ray = dr.zeros(mi.Ray3f, count)
        ray.o = mi.Point3f(u[0] - 0.5, u[1] - 0.5, 1e-4)
        target = mi.Point3f(self.low) + mi.Vector3f(*u[2:]) * mi.Vector3f(self.high - self.low)
        ray.d, ray.maxt = dr.normalize(target - ray.o), mi.Float(5)
        dr.eval(dr.count(self.scene.ray_test(ray)))


def film(size: int, samples: int, **arguments: Any) -> Any:
    node = {"type": "transient_hdr_film", "temporal_bins": BINS, "bin_width_opl": BIN_WIDTH, "start_opl": START}
    made = mi.load_dict({**node, "width": size, "height": size, "rfilter": {"type": "box"}, **arguments})
    made.start_render(samples)
    return made


def timer(job: Callable[[], Any]) -> Callable[[int], float]:
    def run(_: int) -> float:
        dr.sync_thread()
        begun = time.perf_counter()
        job()
        dr.sync_thread()
        return time.perf_counter() - begun

    return run


def memory(level: int) -> dict[str, float]:
    """Peak of the process in MiB, by connections, in ascending order; of a process with torch, as a user's is."""
    import torch

    torch.zeros(1)
    peaks = {}
    for samples in (2**10, 2**14, 2**16):
        case = Case(body(level), 32, 2, samples, rays_too=False)
        case.jobs["confocal"][0]()
        dr.sync_thread()
        peaks[f"{32 * 32 * samples / 1e6:.0f} M"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        del case
        gc.collect()
    return peaks


def main() -> None:
    parser = arguments(__doc__, peer=False)
    parser.add_argument("--memory", action="store_true", help="peak memory instead of times")
    parser.set_defaults(variant="llvm_ad_mono")
    options = parser.parse_args()
    mi.set_variant(options.variant)
    plugins.sync()
    settings = {"quick": options.quick, "albedo": ALBEDO, "bins": BINS}
    if options.memory:
        peaks = memory(2)
        values = list(peaks.values())
        results = {"peak MiB": peaks, "largest over smallest": values[-1] / values[0]}
        report("nlos_rates: memory", settings, results | {"environment": environment(options.variant)}, options.json)
        return
    scan, pairs, samples = (8, 3, 64) if options.quick else (64, 16, 2048)
    repeats = options.repeats or (2 if options.quick else 7)
    settings |= {"scan": scan, "pairs": pairs, "samples": samples, "repeats": repeats}
    results: dict[str, Any] = {"cases": {}, "ratios": [], "environment": environment(options.variant)}
    for name, arrays in (("Z", letter()), ("body", body(3)), ("fine body", body(2 if options.quick else 5))):
        case = Case(arrays, scan, pairs, samples)
        seconds = interleave({k: timer(job) for k, (job, _) in case.jobs.items()}, repeats)
        # Per connection, so that unequal numbers of them compare.
        each = {f"{name}: {k}": [s / case.jobs[k][1] for s in seconds[k]] for k in seconds}
        results["cases"] |= {f"{name}: {k}": summary(s) for k, s in seconds.items()}
        rates = {k: case.jobs[k][1] / statistics.median(s) / 1e6 for k, s in seconds.items()}
        results[f"{name}: million connections per second"] = {k: round(r, 1) for k, r in rates.items()}
        results[f"{name}: share of samples without a ray"] = round(case.share, 3)
        results[f"{name}: seconds for shafts"] = round(case.shaft_seconds, 2)
        results["ratios"].append(ratio(each, f"{name}: confocal", f"{name}: any-hit rays", 1.0))
        del case
    report("nlos_rates", settings, results, options.json)


if __name__ == "__main__":
    main()
