"""Phasor film against Mitsuba's steady `path`: 1, 16, 64 and 301 frequencies, and a list that is no grid.

Cornell box, 128 x 128, 64 spp, depth 8. Bars: 1.5 x the steady `path` for 16 frequencies and 5 x for 301, both on a
uniform grid. `--gradients` times render and backward through the phasors too, with the albedo of a wall. With
`--peer-python` mitransient runs 16 and 301 frequencies between our runs, in its own process and environment, and is
compared with its own `path`; it renders phasors in monochromatic variants only, so give `--variant llvm_ad_mono` then.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from _runner import Worker, arguments, encoded, environment, interleave, ratio, report, steady, summary

from torchtransient.scenes import cornell_box

BARS = {"grid of 16": 1.5, "grid of 301": 5.0}
STEP = 0.05


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


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--gradients", action="store_true", help="time render and backward, too")
    options = parser.parse_args()
    resolution, spp, counts = (16, 4, (1, 3, 5)) if options.quick else (128, 64, (1, 16, 64, 301))
    repeats = options.repeats or (2 if options.quick else 9)
    scene = cornell_box(resolution, num_bins=300, bin_width_opl=0.02, spp=spp)
    ours = {f"grid of {n}": grid(scene, n) for n in counts}
    ours |= {f"list of {n}": scattered(scene, n) for n in (counts[1], counts[-1])}
    theirs = {f"transform of {n}": transform_bins(scene, n) for n in (counts[1], counts[-1])}

    workers = {"torchtransient": (Worker("torchtransient", options.variant), ours)}
    if options.peer_python:
        workers["mitransient"] = (Worker("mitransient", options.variant, options.peer_python), theirs)
    cases = {}
    for library, (worker, scenes) in workers.items():
        for name, described in {"path": steady(scene, "path"), **scenes}.items():
            job = f"{library}: {name}"
            worker.ask(do="load", name=job, scene=encoded(described), gradients=[])
            cases[job] = lambda seed, w=worker, n=job: w.ask(do="render", name=n, spp=spp, seed=seed)["seconds"]
    if options.gradients:
        worker = workers["torchtransient"][0]
        for name in (f"grid of {counts[1]}", f"grid of {counts[-1]}"):
            job = f"torchtransient: {name}, render and backward"
            worker.ask(do="load", name=job, scene=encoded(ours[name]), gradients=["red.reflectance.value"])
            cases[job] = lambda seed, w=worker, n=job: w.ask(do="backward", name=n, spp=spp, seed=seed)["seconds"]
    seconds = interleave(cases, repeats)
    ratios = []
    for case in cases:
        library, _, name = case.partition(": ")
        if name != "path":
            bar = BARS.get(name) if library == "torchtransient" else None
            ratios.append(ratio(seconds, case, f"{library}: path", bar))
    for worker, _ in workers.values():
        worker.close()
    settings = {"resolution": resolution, "spp": spp, "max_depth": 8, "repeats": repeats, "quick": options.quick}
    results = {
        "cases": {name: summary(values) for name, values in seconds.items()},
        "ratios": ratios,
        "environment": environment(options.variant),
        "workers": {library: worker.versions for library, (worker, _) in workers.items()},
    }
    report("phasor_cost", settings, results, options.json)


if __name__ == "__main__":
    main()
