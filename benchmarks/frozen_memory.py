"""Memory and recordings over 3000 training steps of small films, with three parameters that take turns.

Cornell box of 8^2 pixels and 16 bins, one sample per pixel: a colour, the pose of a wall (tent filter) and the light's
radiance, each with a renderer of its own on one scene, step by step in turns. Bars: from step 300 on the resident set
grows by less than 1 %, no recording is added, every call is launched, and nothing is compiled.
"""

from __future__ import annotations

import gc
from typing import Any

import numpy as np
from _runner import arguments, environment, report
from training_memory import resident_bytes

import torchtransient as tt

KEYS = ("red.reflectance.value", "red-wall.to_world", "light.emitter.radiance.value")
# Allocators and recordings have what they need by then.
SETTLED, EVERY = 300, 100
GROWTH_BAR = 0.01


def recordings_of(scene: Any) -> tuple[int, int]:
    """(structures of calls that a scene remembers, recordings among them)."""
    tables = [each for by_keys in scene.recordings.values() for each in by_keys.values()]
    found = [recording for table in tables for recording in table._by_structure.values()]
    made = [recording._frozen for recording in found if recording._frozen is not None]
    return len(found), sum(frozen.n_cached_recordings for frozen in made)


def main() -> None:
    parser = arguments(__doc__, peer=False)
    parser.add_argument("--steps", type=int, default=None, help="steps, 3000 if not said")
    options = parser.parse_args()
    steps = options.steps or (60 if options.quick else 3000)
    every, settled = (10, 30) if options.quick else (EVERY, SETTLED)
    scene = tt.load(tt.scenes.cornell_box(8, num_bins=16, bin_width_opl=0.4), variant=options.variant)
    renderers = [
        tt.TransientRenderer(scene, parameters=[key], spp=1, temporal_filter="tent", physics="ignore") for key in KEYS
    ]

    # After the layer: it finds LLVM before Dr.Jit is imported.
    import drjit as dr
    import torch

    optimizers = [torch.optim.Adam(renderer.parameters(), lr=1e-4) for renderer in renderers]
    target = renderers[0](seed=12345).transient.detach() * 0.9
    rows: list[dict[str, int]] = []
    traced, compiled = 0, 0
    for step in range(steps):
        renderer, optimizer = renderers[step % len(KEYS)], optimizers[step % len(KEYS)]
        optimizer.zero_grad()
        # The history holds on to kernels: it is asked for a few steps in each hundred alone.
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, step % every < len(KEYS)):
            out = renderer(seed=step)
            (out.transient - target).square().mean().backward()
            optimizer.step()
            history = dr.kernel_history()
        if step >= settled:
            said = [*out.stats.recorded, *out.stats.derivatives_recorded]
            traced += sum(how != "launched" for how in said)
            compiled += sum(not entry["cache_hit"] for entry in history if "cache_hit" in entry)
        if step % every == every - 1:
            structures, recordings = recordings_of(scene)
            rows.append({"step": step + 1, "resident_bytes": resident_bytes(), "structures": structures,
                         "recordings": recordings, "collected_objects": len(gc.get_objects())})  # fmt: skip
            print(f"  {rows[-1]}", flush=True)
    late = [row for row in rows if row["step"] >= settled]
    memory = [row["resident_bytes"] for row in late]
    growth = memory[-1] / memory[0] - 1
    added = late[-1]["recordings"] - late[0]["recordings"]
    results = {
        "growth": growth,
        "bytes_per_step": float(np.polyfit([row["step"] for row in late], memory, 1)[0]),
        "recordings": late[-1]["recordings"],
        "recordings_added": added,
        "calls_traced_when_settled": traced,
        "kernels_compiled_when_settled": compiled,
        "within": growth < GROWTH_BAR and not added and not traced and not compiled,
        "environment": environment(options.variant),
    }
    settings = {"keys": list(KEYS), "steps": steps, "settled": settled, "quick": options.quick}
    report("frozen_memory", settings, results | {"every": rows}, options.json)
    print(
        f"{steps} steps, {len(KEYS)} parameters: resident set {100 * growth:+.2f} % from step {late[0]['step']} on, "
        f"{late[-1]['recordings']} recordings ({added:+d}), {traced} calls traced, {compiled} kernels compiled"
    )


if __name__ == "__main__":
    main()
