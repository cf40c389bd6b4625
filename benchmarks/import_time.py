"""What `import torchtransient` adds to `import torch, mitsuba`, in fresh processes that take turns.

Bar: 0.1 s. Also lists the heavy modules that the import of the library brought along and the other two had not.
"""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

from _runner import arguments, environment, interleave, report, summary

PROGRAM = """
import json, sys, time
begin = time.perf_counter()
import torch, mitsuba
middle, known = time.perf_counter(), set(sys.modules)
if {library}: import torchtransient
end = time.perf_counter()
new = sorted({{name.split(".")[0] for name in set(sys.modules) - known}})
print("RESULT " + json.dumps([end - begin, end - middle, new]))
"""


def run(library: bool) -> list[Any]:
    """Seconds in all, seconds of the library alone, and the top-level modules that it added."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(library=library)], check=True, capture_output=True, text=True
    )
    line = next(line for line in done.stdout.splitlines() if line.startswith("RESULT "))
    result: list[Any] = json.loads(line.removeprefix("RESULT "))
    return result


def main() -> None:
    options = arguments(__doc__, peer=False).parse_args()
    repeats = options.repeats or (2 if options.quick else 15)
    added: list[float] = []
    modules: set[str] = set()

    def with_library(_: int) -> float:
        total, own, new = run(True)
        added.append(own)
        modules.update(new)
        return float(total)

    cases = {
        "import torch, mitsuba": lambda _: float(run(False)[0]),
        "import torch, mitsuba, torchtransient": with_library,
    }
    seconds = interleave(cases, repeats, warm_up=1)
    own = summary(added[1:])
    results = {
        "cases": {name: summary(values) for name, values in seconds.items()} | {"added by torchtransient": own},
        "bar_seconds": 0.1,
        "within": own["median"] <= 0.1,
        "modules_added": sorted(modules),
        "environment": environment(),
    }
    report("import_time", {"repeats": repeats, "quick": options.quick}, results, options.json)


if __name__ == "__main__":
    main()
