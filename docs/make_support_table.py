"""Measure every gradient of the test matrix and write the support table of docs/gradients_table.md.

The cases are those of ``tests/support/gradient_cases``: what the table says is what the tests check.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "gradients_table.md"
BEGIN, END = "<!-- support-table:begin -->", "<!-- support-table:end -->"
TESTED_ELSEWHERE = (
    ("shape to_world behind or of glass", "correct: `glass_moves` of `tests/transport/test_moving_edges.py`"),
)
NOT_SUPPORTED = (
    (
        "`alpha`, `eta` and reflectances of Mitsuba's own `plastic`, `roughplastic`",
        "taken over by `diff_plastic`, `diff_rough_plastic` when the key is asked for",
    ),
    (
        "reflectances of Mitsuba's own `pplastic`, `eta` and `k` of `conductor`, `roughconductor`",
        "taken over by `diff_pplastic`, `diff_conductor`, `diff_rough_conductor` when the key is asked for",
    ),
    (
        "weights of lobes of Mitsuba's own `principled`, `principledthin`",
        "taken over by `diff_principled`, `diff_principled_thin` when the key is asked for",
    ),
    ("parameters of Mitsuba's own `hair`", "taken over by `diff_hair`, always"),
    (
        "eta of Mitsuba's own `dielectric`, `roughdielectric`",
        "taken over by `diff_dielectric`, `diff_rough_dielectric` when the key is asked for",
    ),
    (
        "derivatives of Mitsuba's own `conductor`, `polarizer`, `retarder`, `circular` in polarized variants",
        "`tt.load` builds `diff_conductor`, `diff_polarizer`, ... in their place: [polarization.md](polarization.md)",
    ),
    ("any path length through an explicit box filter", "not supported: `GradientError`"),
    (
        "second derivatives; unlimited depth (`max_depth=-1`) of `mi.render`, where no renderer finds a bound",
        "not supported: `GradientError`",
    ),
)


def measure(case):
    """One case: (reverse mode, its error, finite difference, its error, forward over reverse mode)."""
    from support.gradient_cases.problem import Problem

    problem = Problem(case)
    reverse = np.array([problem.reverse(100 + s) for s in range(case.seeds)])
    forward = problem.forward(100)
    fd = np.array([problem.difference(s) for s in range(case.seeds)])
    root = np.sqrt(case.seeds)
    return reverse.mean(), reverse.std(ddof=1) / root, fd.mean(), fd.std(ddof=1) / root, forward / reverse[0]


def table(rows) -> str:
    lines = [
        "| parameter | status | case: reverse mode, finite differences, difference in standard errors "
        "| forward / reverse |",
        "|---|---|---|---|",
    ]
    for row, entries in rows.items():
        cells, ratios = [], []
        for case, (r, se_r, d, se_d, ratio) in entries:
            z = (r - d) / np.hypot(se_r, se_d)
            cells.append(f"{case.name}: {r:.5g} ± {se_r:.1g}, {d:.5g} ± {se_d:.1g}, {z:+.1f}")
            ratios.append(f"{ratio:.5f}")
        lines.append(f"| {row} | correct | {'<br>'.join(cells)} | {'<br>'.join(ratios)} |")
    lines += [f"| {what} | {status} | | |" for what, status in TESTED_ELSEWHERE + NOT_SUPPORTED]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[], help="names of cases; what they give is printed, not written")
    arguments = parser.parse_args()

    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    from tqdm import tqdm

    import torchtransient  # noqa: F401  finds an LLVM before Dr.Jit does
    from support.gradient_cases.all_cases import ALL_CASES  # isort: skip

    rows = defaultdict(list)
    for case in tqdm(
        [c for c in ALL_CASES if not arguments.only or c.name in arguments.only], desc="gradients", unit="case"
    ):
        rows[case.row].append((case, measure(case)))
    text = table(rows)
    print(text)
    if not arguments.only:
        head, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
        PAGE.write_text(f"{head}{BEGIN}\n{text}\n{END}{rest.split(END)[1]}", encoding="utf-8")


if __name__ == "__main__":
    main()
