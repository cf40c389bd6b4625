"""Light of four to six bounces of a confocal scan: chains that scan points share against paths, variance x time.

Variance is that between renders of other seeds, which shared numbers cannot flatter: summed over the bins of every scan
point, and over the bins of the sum of all scan points, which is what a reconstruction sees of noise that points have
in common. Scenes: plates in a V with a small one before them, and a body of ellipsoids that touch; scans of one metre.
Time is that of whole renders, tables included.
"""

from __future__ import annotations

import statistics
import time
from typing import Any

from _runner import arguments, environment, interleave, report, summary
from nlos_rates import ALBEDO, WALL_ALBEDO, body, mesh

import torchtransient  # noqa: F401  before Mitsuba: finds LLVM
from torchtransient import plugins
from torchtransient.scenes.meshes import joined, plate

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip

BAR = 5.0
WAYS = ("paths", "chains")


def folded_plates() -> tuple[np.ndarray, np.ndarray]:
    """Two plates in a V that opens towards the wall, and a small one in front of one of them."""
    v, f = plate(1, 1, (0.5, 0, 0))
    left = np.stack([-0.5 + 0.5 * v[:, 0], v[:, 1], 1 + 0.5 * v[:, 0]], 1)
    right = np.stack([0.5 * v[:, 0], v[:, 1], 1.5 - 0.5 * v[:, 0]], 1)
    return joined((left, f), (right, f), plate(0.25, 0.25, (0.3, 0.2, 0.9)))


def scene(arrays: tuple[np.ndarray, np.ndarray], scan: int, way: str) -> Any:
    """A scan of `scan` x `scan` points over a wall of one metre, bins of 2 cm."""
    film = {
        "type": "transient_hdr_film", "width": scan, "height": scan, "temporal_bins": 150, "bin_width_opl": 0.02,
        "start_opl": 1.6, "rfilter": {"type": "box"},
    }  # fmt: skip
    look = mi.ScalarTransform4f().look_at([-0.5, 0, 0.25], [0, 0, 0], [0, 1, 0])
    wall = {
        "type": "rectangle", "to_world": mi.ScalarTransform4f().scale([0.5, 0.5, 1]),
        "bsdf": {"type": "diffuse", "reflectance": WALL_ALBEDO},
        "sensor": {"type": "nlos_capture_meter", "sensor_origin": [-0.5, 0, 0.25], "film": film},
    }  # fmt: skip
    integrator = {
        "type": "transient_nlos_path", "capture_type": "confocal", "nlos_laser_sampling": True,
        "nlos_hidden_geometry_sampling": True, "min_bounces": 4, "max_depth": 6, "late_light": way,
    }  # fmt: skip
    laser = {"type": "laser_beam", "to_world": look}
    parts = {"integrator": integrator, "laser": laser, "wall": wall, "hidden": mesh("hidden", arrays, ALBEDO)}
    return mi.load_dict({"type": "scene", **parts})


class Way:
    """One estimator in one scene: its seconds, and the histograms it has made."""

    def __init__(self, arrays: tuple[np.ndarray, np.ndarray], scan: int, way: str, spp: int) -> None:
        self.scene, self.spp = scene(arrays, scan, way), spp
        self.cubes: list[np.ndarray] = []

    def __call__(self, seed: int) -> float:
        dr.sync_thread()
        begun = time.perf_counter()
        cube = self.scene.integrator().render(self.scene, seed=seed, spp=self.spp)[1]
        dr.eval(cube)
        dr.sync_thread()
        seconds = time.perf_counter() - begun
        if seed >= 100:  # warm-up counts to a few
            self.cubes.append(np.array(cube, dtype=float)[..., 0].reshape(-1, 150))
        return seconds

    def work(self, seconds: float) -> tuple[float, float]:
        """Variance x time of single points, and of their sum."""
        cubes = np.array(self.cubes)
        return float(cubes.var(0, ddof=1).sum()) * seconds, float(cubes.sum(1).var(0, ddof=1).sum()) * seconds


def main() -> None:
    parser = arguments(__doc__, peer=False)
    parser.set_defaults(variant="llvm_ad_mono")
    options = parser.parse_args()
    mi.set_variant(options.variant)
    plugins.sync()
    sizes = ((4, 64),) if options.quick else ((16, 4096), (32, 2048))
    repeats = options.repeats or (2 if options.quick else 12)
    results: dict[str, Any] = {"cases": {}, "environment": environment(options.variant)}
    for name, arrays in (("V and plate", folded_plates()), ("body", body(1 if options.quick else 3))):
        for scan, spp in sizes:
            ways = {f"{name}, {scan} x {scan}: {way}": Way(arrays, scan, way, spp) for way in WAYS}
            seconds = interleave(dict(ways), repeats)
            results["cases"] |= {case: summary(values) for case, values in seconds.items()}
            old, new = (way.work(statistics.median(seconds[case])) for case, way in ways.items())
            totals = [np.array(way.cubes).sum((1, 2)) for way in ways.values()]
            error = np.hypot(*(t.std(ddof=1) / len(t) ** 0.5 for t in totals)) / totals[0].mean()
            gains = {"points": old[0] / new[0], "sum over the scan": old[1] / new[1]}
            results[f"{name}, {scan} x {scan}"] = {
                "paths over chains, variance x time": {k: round(v, 1) for k, v in gains.items()},
                "bar": BAR, "within": min(gains.values()) >= BAR,
                "chains over paths, light": f"{totals[1].mean() / totals[0].mean():.4f} +- {error:.4f}",
            }  # fmt: skip
    settings = {"repeats": repeats, "quick": options.quick, "bounces": "4 to 6", "sizes": sizes}
    report("nlos_late_light", settings, results, options.json)


if __name__ == "__main__":
    main()
