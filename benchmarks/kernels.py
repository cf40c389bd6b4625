"""The kernels of a plain scene: hashes, operations and sizes, next to those of an older commit with `--baseline PATH`.

A Cornell box of diffuse surfaces, monochromatic and RGB: render, backward pass to an albedo, backward pass to the pose
of a wall (tent filter). What a scene lacks must cost it nothing: its kernels do not grow when the library learns about
media, polarization or gradients. The hash is of the intermediate code, before the compiler; kernels are equal when
their hashes are. Each job runs in a fresh process.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

from _comparison import BASELINE, OURS, Row, add_baseline, first_call, with_tent
from _runner import ROOT, commit_of

from torchtransient.scenes import cornell_box

VARIANTS = ("llvm_ad_mono", "llvm_ad_rgb")
SPP = 4
Kernel = Mapping[str, Any]


def rows() -> list[Row]:
    """What is compiled for a plain scene."""
    box = cornell_box(16, num_bins=60, bin_width_opl=0.1, spp=SPP)
    albedo, wall = ("red.reflectance.value",), {"red-wall.to_world": [1.0, 0.0, 0.0]}
    return [
        Row("render", box),
        Row("backward, colour", box, gradients=albedo),
        Row("backward, pose", with_tent(box), shifts=wall),
    ]


def sizes(kernels: Sequence[Kernel]) -> dict[str, int]:
    """How many kernels there are and how large they are together."""
    together = {what: sum(kernel[what] for kernel in kernels) for what in ("operations", "ir_bytes")}
    return {"kernels": len(kernels), **together}


def verdict(current: Sequence[Kernel], before: Sequence[Kernel]) -> str:
    """Whether two lists of kernels are the same, or how their sizes differ."""
    if sorted(k["hash"] for k in current) == sorted(k["hash"] for k in before):
        return "equal"
    new, old = sizes(current), sizes(before)
    return ", ".join(f"{what} {new[what] / old[what]:.4f} x" for what in new)


def line(kernel: Kernel | None) -> str:
    """A kernel, to print."""
    if kernel is None:
        return "-"
    return f"{kernel['hash'][:12]:>12} {kernel['operations']:>7} operations {kernel['ir_bytes']:>9} bytes"


def show(name: str, found: Mapping[str, Sequence[Kernel]]) -> None:
    """Print the kernels of a job, side by side."""
    current = found[OURS]
    if BASELINE not in found:
        print(f"{name}: {sizes(current)}")
        for kernel in current:
            print(f"    {line(kernel)}")
        return
    before = found[BASELINE]
    print(f"{name}: {verdict(current, before)}")
    old_hashes = {kernel["hash"] for kernel in before}
    for new, old in zip_longest(current, before):
        mark = "" if new is None else "=" if new["hash"] in old_hashes else "new"
        print(f"    {line(new):<50} {mark:<4} {line(old)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_baseline(parser)
    parser.add_argument("--variants", nargs="+", default=VARIANTS, help="Mitsuba variants")
    parser.add_argument("--json", type=Path, help="write the report to this file")
    options = parser.parse_args()
    checkouts = {OURS: ROOT}
    if options.baseline is not None:
        checkouts[BASELINE] = options.baseline
    jobs: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for variant in options.variants:
        for row in rows():
            name = f"{variant}: {row.name}"
            jobs[name] = {side: first_call(row, variant, SPP, at)["kernels"] for side, at in checkouts.items()}
            show(name, jobs[name])
    if BASELINE in checkouts:
        changed = [name for name, found in jobs.items() if verdict(found[OURS], found[BASELINE]) != "equal"]
        print(f"{len(jobs) - len(changed)} of {len(jobs)} jobs with equal kernels", file=sys.stderr)
    if options.json is not None:
        commits = {side: commit_of(at) for side, at in checkouts.items()}
        report = {"benchmark": "kernels", "commits": commits, "jobs": jobs}
        options.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
