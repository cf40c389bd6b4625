"""Time-gated renders against the full render gated afterwards: time, variance and their product.

Cornell box, one short gate early, in the middle and late, and a sweep of 16 gates. The full render keeps a histogram
fine enough for the gates and its steady image; `cut` is the histogram of the gate's window with `steady=False`. What a
gate saves is `full variance x time / gated variance x time`: above one, the gated film is the better use of time.
"""

from __future__ import annotations

import statistics
import time

import torch
from _runner import arguments, environment, report, summary

import torchtransient as tt
from torchtransient.scenes import cornell_box

GATES = {
    "early": [tt.Gate.rectangular(4.4, 4.6)],
    "middle": [tt.Gate.rectangular(6.0, 6.2)],
    "late": [tt.Gate.rectangular(8.5, 8.7)],
    "sweep of 16": list(tt.Gate.rectangular(4.0, 4.2).sequence(0.2, 16)),
}
KINDS = ("full", "cut", "gated")
FULL = tt.TimeAxis(3.5, 0.02, 300)


def window(gates: list[tt.Gate]) -> tuple[tt.TimeAxis, torch.Tensor]:
    """The bins of a histogram that the gates need, and the weight of each bin in each gate."""
    start = min(gate.start_opl for gate in gates)
    end = max(gate.end_opl for gate in gates)
    axis = tt.TimeAxis(start, FULL.bin_width_opl, round((end - start) / FULL.bin_width_opl))
    return axis, profiles(axis, gates)


def profiles(axis: tt.TimeAxis, gates: list[tt.Gate]) -> torch.Tensor:
    """(G, T) float32: sensitivity of the gates at the bins' centres."""
    return torch.stack([torch.from_numpy(gate.value(axis.centers_opl.numpy())) for gate in gates]).float()


def compared(name: str, images: dict, seconds: dict) -> dict:
    """Mean, time and efficiency (one over variance times time) of the three ways for one set of gates."""
    row: dict = {"gate": name, "mean": {}, "time_over_full": {}, "efficiency_over_full": {}}
    cost = {}
    for kind in KINDS:
        stack, middle = torch.stack(images[name, kind]), statistics.median(seconds[name, kind])
        cost[kind] = float(stack.var(0).mean()) * middle
        row["mean"][kind] = float(stack.mean())
        row["time_over_full"][kind] = middle / statistics.median(seconds[name, "full"])
        row["efficiency_over_full"][kind] = cost["full"] / cost[kind]
    return row


def main() -> None:
    options = arguments(__doc__, peer=False).parse_args()
    resolution, spp = (12, 4) if options.quick else (64, 64)
    repeats = options.repeats or (2 if options.quick else 12)
    scene = tt.load(cornell_box(resolution, num_bins=300, spp=spp), variant=options.variant)
    ways = {}
    for name, gates in GATES.items():
        axis, weights = window(gates)
        ways[name, "full"] = tt.TransientRenderer(scene, time_axis=FULL, spp=spp), profiles(FULL, gates)
        ways[name, "cut"] = tt.TransientRenderer(scene, time_axis=axis, spp=spp, steady=False), weights
        ways[name, "gated"] = tt.TransientRenderer(scene, gates=gates, spp=spp), None
    seconds: dict[tuple[str, str], list[float]] = {way: [] for way in ways}
    images: dict[tuple[str, str], list[torch.Tensor]] = {way: [] for way in ways}
    for seed in range(repeats + 1):
        for way, (renderer, weights) in ways.items():
            out = renderer(seed=seed)
            begun = time.perf_counter()
            image = out.gated if weights is None else torch.einsum("cthw,gt->cghw", out.transient, weights)
            gating = time.perf_counter() - begun
            if seed > 0:  # the first round compiles
                seconds[way].append(out.stats.seconds + gating)
                images[way].append(image.double())
    rows = [compared(name, images, seconds) for name in GATES]
    settings = {"resolution": resolution, "spp": spp, "max_depth": 8, "repeats": repeats, "quick": options.quick}
    cases = {f"{name}: {kind}": summary(values) for (name, kind), values in seconds.items()}
    results = {"cases": cases, "environment": environment(options.variant)}
    results |= {f"gate {row['gate']}": {k: v for k, v in row.items() if k != "gate"} for row in rows}
    report("gate_cost", settings, results, options.json)


if __name__ == "__main__":
    main()
