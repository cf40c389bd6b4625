"""Memory of the backward pass at several depths: the record of a path lives in thread-local memory and must not add up.

Every depth runs in a process of its own; reported is the growth of its peak resident memory during two backward passes
of the Cornell box with gradients through the time of flight.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
from pathlib import Path


def peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def child(depth: int, resolution: int, spp: int) -> None:
    import torch

    import torchtransient as tt

    scene = tt.load(tt.scenes.cornell_box(resolution, num_bins=100, bin_width_opl=0.06, max_depth=depth, spp=spp))
    keys = ["back.to_world", "white.reflectance.value"]
    renderer = tt.TransientRenderer(scene, parameters=keys, spp=spp)
    # The smallest launch first: it compiles the kernels, whose memory is not the pass's.
    renderer(seed=0, spp=1).transient.sum().backward()
    outputs = [renderer(seed=seed).transient for seed in (1, 2)]
    before = peak_bytes()
    for transient in outputs:
        (transient * torch.linspace(0, 1, transient.shape[1])[None, :, None, None]).sum().backward()
    print(json.dumps({"depth": depth, "before": before, "grown": peak_bytes() - before}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--depths", type=int, nargs="+", default=[4, 16, 64])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--quick", action="store_true", help="tiny: shows that it runs, measures nothing")
    parser.add_argument("--child", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    resolution, spp = (8, 4) if options.quick else (128, 64)
    if options.child is not None:
        child(options.child, resolution, spp)
        return
    results = []
    for depth in options.depths:
        command = [sys.executable, __file__, "--child", str(depth), *(["--quick"] if options.quick else [])]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        results.append(json.loads(done.stdout.splitlines()[-1]))
        print(f"depth {depth:3d}: peak grows by {results[-1]['grown'] / 2**20:.1f} MiB", flush=True)
    if options.json:
        options.json.write_text(json.dumps({"resolution": resolution, "spp": spp, "results": results}, indent=2))


if __name__ == "__main__":
    main()
