"""Light that is deeper than a plan's depth: what pilot runs of a few thousand paths know of late light.

Cornell box without a limit of depth. Of each case `tt.plan` is asked with several seeds; for each depth that it found,
the share of the light beyond it is that of long renders with the same samples, with and without the depth: of each
eighth of the time of the light for `error="relative"`, else of each gate.

    python benchmarks/plan_depths.py [--repeats 24] [--json FILE]
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import torch
from _runner import arguments, environment, report

import torchtransient as tt

# So deep that nothing is left.
DEEP = 64
LATE = tt.Gate.rectangular(15.0, 15.06)
CASES: dict[str, dict[str, Any]] = {
    "whole box, squared": {},
    "whole box, relative": {"error": "relative"},
    "late gate": {"outputs": "gates", "gates": LATE, "error": "relative"},
    "early, middle and late gate": {
        "outputs": "gates",
        "gates": [tt.Gate.rectangular(4.4, 4.46), tt.Gate.rectangular(8.5, 8.56), LATE],
        "error": "relative",
    },
}


def light(plan: tt.Plan, depth: int, spp: int, seeds: int) -> torch.Tensor:
    """Light of the bins or gates of a plan, in eighths of the time for bins."""
    renderer = plan.renderer(max_depth=depth, spp=spp, physics="ignore")
    with torch.no_grad():
        outputs = (renderer(seed=seed) for seed in range(seeds))
        found = sum(out.transient if out.gated is None else out.gated for out in outputs).double().sum((0, -2, -1))
    return found if plan.film == "gated" else torch.stack([part.sum() for part in found.tensor_split(8)])


def main() -> None:
    options = arguments(__doc__, peer=False).parse_args()
    seeds, runs, spp = (2, 1, 64) if options.quick else (options.repeats or 24, 16, 1024)
    scene = tt.scenes.cornell_box(resolution=24, num_bins=60, bin_width_opl=0.1, max_depth=-1)
    loaded = tt.load(scene, variant=options.variant)
    results: dict[str, Any] = {"environment": environment(options.variant)}
    for name, settings in CASES.items():
        plans = [tt.plan(loaded, seed=seed, integrator="transient_path", **settings) for seed in range(seeds)]
        depths = Counter(plan.max_depth for plan in plans)
        # The longest window, so that all depths are compared over the same light.
        widest = max(plans, key=lambda plan: 0 if plan.time_axis is None else plan.time_axis.num_bins)
        all_of_it = light(widest, DEEP, spp, runs)
        lost = {depth: 1 - light(widest, depth, spp, runs) / all_of_it for depth in sorted(depths)}
        results[name] = {
            str(depth): {"plans": depths[depth], "shares_lost": [round(float(share), 5) for share in shares]}
            for depth, shares in lost.items()
        }
        for depth, shares in lost.items():
            print(f"{name}: depth {depth} of {depths[depth]} plans loses", " ".join(f"{s:.2%}" for s in shares))
    report("plan_depths", {"seeds": seeds, "runs": runs, "spp": spp, "quick": options.quick}, results, options.json)


if __name__ == "__main__":
    main()
