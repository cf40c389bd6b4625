"""Memory and compiled kernels over 200 training steps of the torch layer with `torch.optim.Adam`.

Cornell box, two parameters (an albedo and the red wall's position, tent filter). Bars: the resident set after step 20
grows by less than 2 % until the last step, and no kernel is compiled after the second step.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from _runner import arguments, environment, report

import torchtransient as tt

ALBEDO, WALL = "red.reflectance.value", "red-wall.to_world"


def resident_bytes() -> int:
    """Resident set of this process (Linux)."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024
    raise RuntimeError("/proc/self/status: expected a line VmRSS, found none")


def main() -> None:
    options = arguments(__doc__, peer=False).parse_args()
    resolution, bins, spp, steps = (16, 60, 4, 30) if options.quick else (64, 300, 16, 200)
    box = tt.scenes.cornell_box(resolution, num_bins=bins, bin_width_opl=6.0 / bins)
    scene = tt.load(box, variant=options.variant)
    renderer = tt.TransientRenderer(scene, parameters=[ALBEDO, WALL], spp=spp, temporal_filter="tent")

    # After the layer: it finds LLVM before Dr.Jit is imported.
    import drjit as dr
    import torch

    optimizer = torch.optim.Adam(renderer.parameters(), lr=1e-3)
    target = renderer(seed=12345).transient.detach() * 0.9
    memory, compiled = [], []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for step in range(steps):
            dr.kernel_history_clear()
            optimizer.zero_grad()
            loss = (renderer(seed=step).transient - target).square().mean()
            loss.backward()
            optimizer.step()
            compiled.append(sum(not kernel["cache_hit"] for kernel in dr.kernel_history() if "cache_hit" in kernel))
            memory.append(resident_bytes())
    late = [step for step, count in enumerate(compiled) if count and step >= 2]
    begin = memory[min(20, steps // 2)]
    growth = memory[-1] / begin - 1
    per_step = float(np.polyfit(np.arange(steps // 2), memory[steps - steps // 2 :], 1)[0])
    results = {
        "resident_bytes_begin": begin,
        "resident_bytes_end": memory[-1],
        "growth": growth,
        "bytes_per_step_second_half": per_step,
        "kernels_compiled_by_step": compiled[:5],
        "steps_that_compiled_after_the_second": late,
        "within": growth < 0.02 and not late,
        "environment": environment(options.variant),
    }
    settings = {"resolution": resolution, "bins": bins, "spp": spp, "steps": steps, "quick": options.quick}
    report("training_memory", settings, results, options.json)


if __name__ == "__main__":
    main()
