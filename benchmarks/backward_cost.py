"""Render and backward: ours with gradients through the time of flight against mitransient without them.

Cornell box, 128 x 128, 64 spp, depth 8, 300 bins. Ours differentiates the red albedo and the position of the red wall
along its normal (tent filter); the peer, whose time of flight has no derivative, the red albedo alone. Our albedo alone
is shown too. Bar: 1.0 x the peer. Without `--peer-python` only our own cases are compared with each other.
"""

from __future__ import annotations

from _runner import Worker, arguments, encoded, environment, interleave, ratio, report, summary

from torchtransient.scenes import cornell_box

ALBEDO, WALL = "red.reflectance.value", {"red-wall.to_world": [1.0, 0.0, 0.0]}


def main() -> None:
    options = arguments(__doc__).parse_args()
    resolution, spp, bins = (16, 4, 60) if options.quick else (128, 64, 300)
    repeats = options.repeats or (2 if options.quick else 9)
    box = cornell_box(resolution, num_bins=bins, bin_width_opl=6.0 / bins, spp=spp)
    film = {**box["sensor"]["film"], "temporal_filter": "tent"}
    tent = {**box, "sensor": {**box["sensor"], "film": film}}
    ours = Worker("torchtransient", options.variant)
    workers = [ours]
    jobs = {
        "torchtransient: render": (ours, "render", box, [], {}),
        "torchtransient: albedo": (ours, "backward", box, [ALBEDO], {}),
        "torchtransient: albedo and wall": (ours, "backward", tent, [ALBEDO], WALL),
    }
    if options.peer_python:
        peer = Worker("mitransient", options.variant, options.peer_python)
        workers.append(peer)
        jobs["mitransient: render"] = (peer, "render", box, [], {})
        jobs["mitransient: albedo"] = (peer, "backward", box, [ALBEDO], {})
    cases = {}
    for name, (worker, what, scene, radiometric, shifts) in jobs.items():
        worker.ask(do="load", name=name, scene=encoded(scene), gradients=radiometric, shifts=shifts)
        cases[name] = lambda seed, w=worker, n=name, do=what: w.ask(do=do, name=n, spp=spp, seed=seed)["seconds"]
    seconds = interleave(cases, repeats)
    ratios = [
        ratio(seconds, "torchtransient: albedo", "torchtransient: render"),
        ratio(seconds, "torchtransient: albedo and wall", "torchtransient: render"),
    ]
    if options.peer_python:
        ratios.append(ratio(seconds, "mitransient: albedo", "mitransient: render"))
        ratios.append(ratio(seconds, "torchtransient: albedo", "mitransient: albedo"))
        ratios.append(ratio(seconds, "torchtransient: albedo and wall", "mitransient: albedo", 1.0))
    for worker in workers:
        worker.close()
    settings = {"resolution": resolution, "spp": spp, "bins": bins, "max_depth": 8, "repeats": repeats}
    results = {
        "cases": {name: summary(values) for name, values in seconds.items()},
        "ratios": ratios,
        "environment": environment(options.variant),
    }
    report("backward_cost", {**settings, "quick": options.quick}, results, options.json)


if __name__ == "__main__":
    main()
