"""Polarized: `transient_path` in a polarized variant against Mitsuba's steady `stokes(path)`.

Cornell box with a metal and a glass block, 128 x 128, 64 spp, depth 8, 300 bins, `llvm_ad_mono_polarized`. Bar: 1.2 x
the steady integrator. With `--peer-python` mitransient runs between our runs, in its own process and environment, and
is compared with its own `stokes(path)`.
"""

from __future__ import annotations

from typing import Any

from _runner import Worker, arguments, encoded, environment, interleave, ratio, report, steady, summary

from torchtransient.scenes import cornell_box

BAR = 1.2
METAL = {"type": "roughconductor", "eta": 0.8, "k": 2.5, "alpha": 0.3}


def box(resolution: int, bins: int, spp: int) -> dict[str, Any]:
    """A Cornell box in which light is polarized."""
    scene = cornell_box(resolution, num_bins=bins, bin_width_opl=6.0 / bins, spp=spp)
    return {
        **scene,
        "large-box": {**scene["large-box"], "bsdf": METAL},
        "small-box": {**scene["small-box"], "bsdf": {"type": "dielectric"}},
    }


def stokes(scene: dict[str, Any]) -> dict[str, Any]:
    """The same scene for Mitsuba's steady integrator."""
    steady_scene = steady(scene, "path")
    return {**steady_scene, "integrator": {"type": "stokes", "nested": steady_scene["integrator"]}}


def main() -> None:
    parser = arguments(__doc__)
    parser.set_defaults(variant="llvm_ad_mono_polarized")
    options = parser.parse_args()
    resolution, spp, bins = (16, 4, 30) if options.quick else (128, 64, 300)
    repeats = options.repeats or (2 if options.quick else 9)
    scene = box(resolution, bins, spp)
    libraries = {"torchtransient": Worker("torchtransient", options.variant)}
    if options.peer_python:
        libraries["mitransient"] = Worker("mitransient", options.variant, options.peer_python)

    cases = {}
    for library, worker in libraries.items():
        for name, job in ((f"{library}: polarized", scene), (f"{library}: stokes(path)", stokes(scene))):
            worker.ask(do="load", name=name, scene=encoded(job))
            cases[name] = lambda seed, w=worker, n=name: w.ask(do="render", name=n, spp=spp, seed=seed)["seconds"]
    seconds = interleave(cases, repeats)
    ratios = [
        ratio(seconds, f"{lib}: polarized", f"{lib}: stokes(path)", BAR if lib == "torchtransient" else None)
        for lib in libraries
    ]
    for worker in libraries.values():
        worker.close()
    settings = {"resolution": resolution, "spp": spp, "max_depth": 8, "bins": bins, "repeats": repeats,
                "quick": options.quick}  # fmt: skip
    results = {
        "cases": {name: summary(values) for name, values in seconds.items()},
        "ratios": ratios,
        "environment": environment(options.variant),
        "workers": {library: worker.versions for library, worker in libraries.items()},
    }
    report("polarized_cost", settings, results, options.json)


if __name__ == "__main__":
    main()
