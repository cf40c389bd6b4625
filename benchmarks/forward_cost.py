"""Forward: `transient_path` against Mitsuba's steady `path` and `prb`, and mitransient against its own `path`.

Cornell box, 256 x 256, 64 spp, depth 8, 300 and 2048 bins. Bars: 1.22 x the steady `path` at 300 bins and 1.38 x at
2048. With `--peer-python` the peer runs between our runs, in its own process and environment, and is compared with its
own `path`.
"""

from __future__ import annotations

from _runner import Worker, arguments, encoded, environment, interleave, ratio, report, steady, summary

from torchtransient.scenes import cornell_box

BARS = {300: 1.22, 2048: 1.38}


def main() -> None:
    options = arguments(__doc__).parse_args()
    resolution, spp, bins = (16, 4, (30, 60)) if options.quick else (256, 64, (300, 2048))
    repeats = options.repeats or (2 if options.quick else 9)
    # The window is the same whatever the number of bins.
    scenes = {n: cornell_box(resolution, num_bins=n, bin_width_opl=6.0 / n, spp=spp) for n in bins}
    libraries = {"torchtransient": Worker("torchtransient", options.variant)}
    if options.peer_python:
        libraries["mitransient"] = Worker("mitransient", options.variant, options.peer_python)

    cases = {}
    for library, worker in libraries.items():
        jobs = {f"{library}: {n} bins": scene for n, scene in scenes.items()}
        jobs[f"{library}: steady path"] = steady(scenes[bins[0]], "path")
        jobs[f"{library}: steady prb"] = steady(scenes[bins[0]], "prb")
        for name, scene in jobs.items():
            worker.ask(do="load", name=name, scene=encoded(scene))
            cases[name] = lambda seed, w=worker, n=name: w.ask(do="render", name=n, spp=spp, seed=seed)["seconds"]
    seconds = interleave(cases, repeats)
    ratios = []
    for library in libraries:
        anchor = f"{library}: steady path"
        for n in bins:
            bar = BARS.get(n) if library == "torchtransient" else None
            ratios.append(ratio(seconds, f"{library}: {n} bins", anchor, bar))
        ratios.append(ratio(seconds, f"{library}: steady prb", anchor))
    for worker in libraries.values():
        worker.close()
    settings = {"resolution": resolution, "spp": spp, "max_depth": 8, "repeats": repeats, "quick": options.quick}
    results = {
        "cases": {name: summary(values) for name, values in seconds.items()},
        "ratios": ratios,
        "environment": environment(options.variant),
        "workers": {library: worker.versions for library, worker in libraries.items()},
    }
    report("forward_cost", settings, results, options.json)


if __name__ == "__main__":
    main()
