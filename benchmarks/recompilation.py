"""What recompiles and why: one thing changes between two training steps, and the steps after it say what it takes.

A wall and a panel beside it, 8 x 8 pixels, 32 bins, 4 samples: render, sum of squares, derivative. Before each change
the steps are launched. Printed: what becomes of the first render and the first derivative after it, how many kernels
are compiled until steps are launched again, how many steps that takes, and the CPU milliseconds of one thread of the
first of them. `docs/recompilation.md` has the table; a test compares its verdicts with those of a run.

Every case begins without the kernels of others, in memory and on the disk. The last two rows are new processes.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from _runner import HERE, arguments

ROWS = HERE / "_recompilation_cases.py"


def rows_of(cache: Path, which: str, variant: str, bar: Any) -> dict[str, dict[str, Any]]:
    """What a new process with those kernels on its disk says of every case, by name."""
    cache.mkdir(exist_ok=True)
    environment = {**os.environ, "DRJIT_CACHE_DIR": str(cache), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(ROWS), which, variant]
    found = {}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        for line in child.stdout:
            row = json.loads(line)
            found[row.pop("name")] = row
            bar.update()
            bar.set_postfix_str(list(found)[-1])
    if child.returncode:
        raise RuntimeError(f"a process ended with exit code {child.returncode}; its messages are above")
    return found


def measured(passes: int, variant: str, bar: Any) -> dict[str, dict[str, Any]]:
    """Verdicts of all passes, which have to agree, and the medians of their milliseconds."""
    found = []
    for _ in range(passes):
        with tempfile.TemporaryDirectory() as cache:
            rows = rows_of(Path(cache) / "cases", "all", variant, bar)
            for which in ("first", "again"):
                rows |= rows_of(Path(cache) / "two", which, variant, bar)
            found.append(rows)
    table = {}
    for name, first in found[0].items():
        table[name] = first | {"ms": statistics.median(rows[name]["ms"] for rows in found)}
        for key in ("render", "derivative", "compiled", "steps"):
            said = {rows[name][key] for rows in found}
            if len(said) > 1:
                raise RuntimeError(f"{name}: {key} is {said}, not the same in each of {passes} processes")
    return table


def line(name: str, row: dict[str, Any]) -> str:
    """As it stands in the docs."""
    kernels = row["compiled"] or "none"
    return f"| {name} | {row['render']} | {row['derivative']} | {kernels} | {row['steps']} | {row['ms']:.1f} |"


def main() -> None:
    from tqdm import tqdm

    parser: argparse.ArgumentParser = arguments(__doc__, peer=False)
    parser.set_defaults(variant="llvm_ad_mono")
    parser.add_argument("--smoke", dest="quick", action="store_true", help="as --quick: one pass, no medians")
    options = parser.parse_args()
    passes = 1 if options.quick else options.repeats or 5
    with tqdm(unit="case", desc="recompilation") as bar:
        table = measured(passes, options.variant, bar)
    print("| what changes | render | derivative | kernels compiled | steps until launched | CPU ms of the first |")
    print("|---|---|---|---|---|---|")
    for name, row in table.items():
        print(line(name, row))
    if options.json is not None:
        options.json.write_text(json.dumps({"passes": passes, "variant": options.variant, "cases": table}, indent=1))


if __name__ == "__main__":
    main()
