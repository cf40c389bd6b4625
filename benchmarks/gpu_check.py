"""The CUDA checks behind `gpu_check.sh`: values, gradients and tensors against LLVM, then the speed of both.

`--variant llvm_ad_rgb` compares LLVM with itself: whether this script works, on a machine without a GPU.

Each variant runs in a process of its own. Prints one line per check and exits with 1 if any failed.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from _runner import arguments, environment, report, summary

CHILD = Path(__file__).resolve().parent / "_gpu_child.py"


def run(variant: str, quick: bool) -> dict[str, Any]:
    """Results of one variant."""
    command = [sys.executable, str(CHILD), variant, *(["--quick"] if quick else [])]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    if done.returncode or not lines:
        sys.exit(
            f"gpu_check: the process of {variant} failed with exit code {done.returncode}; its messages are above."
        )
    result: dict[str, Any] = json.loads(lines[-1].removeprefix("RESULT "))
    return result


def agree(name: str, cuda: dict[str, Any], llvm: dict[str, Any]) -> bool:
    """Means over seeds within 4.5 standard errors of their difference, entry by entry."""
    a, b = (np.asarray(side[name], dtype=np.float64) for side in (cuda, llvm))
    error = np.sqrt(a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b))
    # Equal seeds draw equal samples: what differs is rounding, which may be all there is.
    rounding = 1e-4 * np.abs(b.mean(axis=0)).max()
    worst = float(np.max(np.abs(a.mean(axis=0) - b.mean(axis=0)) / (4.5 * error + rounding)))
    print(f"{'ok  ' if worst <= 1 else 'FAIL'} {name}: worst difference {worst:.3f} of the tolerance")
    return worst <= 1


def main() -> None:
    parser = arguments(__doc__, peer=False)
    parser.set_defaults(variant="cuda_ad_rgb")
    options = parser.parse_args()
    cuda, llvm = run(options.variant, options.quick), run("llvm_ad_rgb", options.quick)
    passed = [agree(name, cuda, llvm) for name in ("steady", "transient", "gradient albedo", "gradient wall")]
    for name in ("tensor on the GPU", "tensor is the film's memory", "parameter on the GPU", "gradient on the GPU"):
        passed.append(bool(cuda[name]))
        print(f"{'ok  ' if cuda[name] else 'FAIL'} {name}")
    results: dict[str, Any] = {
        "cases": {
            f"{side} {what}": summary(data[what])
            for side, data in (("cuda", cuda), ("llvm", llvm))
            for what in ("forward", "backward")
        },
        "checks_passed": sum(passed),
        "checks": len(passed),
        "environment": {**environment(options.variant), "gpu": cuda["gpu"]},
    }
    settings = {"resolution": 256, "bins": 300, "spp": 64} if not options.quick else {"quick": True}
    report("gpu_check", settings, results, options.json)
    sys.exit(0 if all(passed) else 1)


if __name__ == "__main__":
    main()
