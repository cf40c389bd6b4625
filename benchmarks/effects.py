"""What each effect costs: the Cornell box with every effect alone, and in useful pairs, next to the plain run.

Time: ratio to the plain run, formed round by round from runs that take turns in two processes; median and quartiles.
Memory: growth of the process's peak during the runs. Variance: of the steady image's pixels at the same number of
samples, over the squared mean of the image, relative to the plain run (scenes with other materials or media look
different; the factor then compares two scenes). `--docs` writes `docs/effects.md` and `docs/images/effects.png`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from _effects_cases import CASES, Case
from _runner import HERE, ChildProcess, arguments, environment, summary

DOCS = HERE.parent / "docs"
# Rounds whose times are not kept: the first compiles.
WARM_UP = 2


class CaseProcess(ChildProcess):
    """A case in a process of its own."""

    def __init__(self, case: Case, resolution: int, spp: int) -> None:
        super().__init__([sys.executable, str(HERE / "_effects_cases.py"), case.name, str(resolution), str(spp)])
        self.unavailable: str | None = self.greeting["unavailable"]


def measure(case: Case, plain: CaseProcess, options: Any, resolution: int, spp: int, repeats: int) -> dict[str, Any]:
    """One row: the case against the plain run."""
    row: dict[str, Any] = {"name": case.name, "group": case.group, "what": case.what, "variant": case.variant}
    worker = CaseProcess(case, resolution, spp)
    try:
        if worker.unavailable:
            return {**row, "unavailable": worker.unavailable}
        ratios, seconds = [], []
        for seed in range(WARM_UP + repeats):
            anchor = plain.ask(do="run", seed=seed)["seconds"]
            answer = worker.ask(do="run", seed=seed)
            if "unavailable" in answer:
                return {**row, "unavailable": answer["unavailable"]}
            if seed >= WARM_UP:
                ratios.append(answer["seconds"] / anchor)
                seconds.append(answer["seconds"])
        row["seconds"], row["time"] = summary(seconds), summary(ratios)
        row["added_bytes"] = worker.ask(do="memory")["added_bytes"]
        if not case.gradients:
            row["noise"] = worker.ask(do="noise", spp=max(1, spp // 4), runs=4 if options.quick else 16)["noise"]
    finally:
        worker.close()
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown."""
    lines = [
        "| effect | time, plain run = 1 | variance, plain run = 1 | variance x time | memory added | variant |",
        "|---|---|---|---|---|---|",
    ]
    noise = next((row["noise"] for row in rows if row["name"] == "plain" and "noise" in row), None)
    group = None
    for row in rows:
        if row["group"] != group:
            group = row["group"]
            lines.append(f"| **{group}** | | | | | |")
        text = f"{row['name']}: {row['what']}" if row["what"] else row["name"]
        if "unavailable" in row:
            lines.append(f"| {text} | not available: {row['unavailable'].splitlines()[0]} | | | | {row['variant']} |")
            continue
        time = row["time"]
        variance = row["noise"] / noise if noise and "noise" in row else None
        product = "" if variance is None else f"{variance * time['median']:.2f}"
        lines.append(
            f"| {text} | {time['median']:.2f} [{time['q25']:.2f}, {time['q75']:.2f}] | "
            f"{'' if variance is None else f'{variance:.2f}'} | {product} | {row['added_bytes'] / 2**20:.0f} MB | "
            f"{row['variant']} |"
        )
    return "\n".join(lines)


def write_docs(rows: list[dict[str, Any]], settings: dict[str, Any]) -> None:
    """docs/effects.md and its picture."""
    size, cpus = f"{settings['resolution']} x {settings['resolution']}", settings["environment"]["cpus"]
    text = f"""# What each effect costs

The Cornell box ({size} pixels, {settings["spp"]} samples per pixel, depth 8, 300 bins) rendered with each effect alone
and in pairs, next to the plain run, on {cpus} CPU cores. `python benchmarks/effects.py --docs` measures this page.

Time is the ratio of runs that take turns, median and quartiles of {settings["repeats"]} rounds. Variance is that of the
steady image's pixels at the same number of samples, relative to the square of the image's mean; where an effect changes
the scene (fog, glass and metal), it compares two scenes. Memory is the growth of the process's peak during the runs.
Kernels are compiled before the first timed run.

{table(rows)}

![Time of every effect over the plain run](images/effects.png)
"""
    (DOCS / "effects.md").write_text(text, encoding="utf-8")
    draw([row for row in rows if "time" in row], DOCS / "images" / "effects.png")


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Horizontal bars of the time ratios with quartiles."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 0.3 * len(rows) + 1.2), layout="constrained")
    groups = list(dict.fromkeys(row["group"] for row in rows))
    for k, row in enumerate(rows):
        time = row["time"]
        whiskers = [[time["median"] - time["q25"]], [time["q75"] - time["median"]]]
        axes.barh(k, time["median"], xerr=whiskers, color=f"C{groups.index(row['group'])}", height=0.7)
        axes.annotate(f"{time['median']:.2f}", (time["q75"], k), xytext=(4, 0), textcoords="offset points", va="center")
    axes.set_yticks(range(len(rows)), [row["name"] for row in rows])
    axes.invert_yaxis()
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set_xlabel("time, plain run = 1")
    axes.spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    parser = arguments(__doc__, peer=False)
    parser.add_argument("--docs", action="store_true", help="write docs/effects.md and docs/images/effects.png")
    parser.add_argument("--only", nargs="+", default=None, help="names of the cases to run")
    options = parser.parse_args()
    if options.quick and options.docs:
        parser.error("--docs keeps what is measured, and --quick measures nothing: give one of the two")
    resolution, spp = (8, 4) if options.quick else (128, 64)
    repeats = options.repeats or (2 if options.quick else 9)
    chosen = [case for case in CASES if options.only is None or case.name in options.only]
    settings: dict[str, Any] = {"resolution": resolution, "spp": spp, "repeats": repeats, "quick": options.quick}
    settings["environment"] = environment()
    plain = CaseProcess(CASES[0], resolution, spp)
    rows = []
    try:
        for case in chosen:
            rows.append(measure(case, plain, options, resolution, spp, repeats))
            print(
                f"  {case.name}: {rows[-1].get('time', {}).get('median', rows[-1].get('unavailable'))}", file=sys.stderr
            )
    finally:
        plain.close()
    print(table(rows))
    if options.json:
        options.json.write_text(
            json.dumps({"benchmark": "effects", "settings": settings, "rows": rows}, indent=2) + "\n"
        )
    if options.docs:
        write_docs(rows, settings)


if __name__ == "__main__":
    main()
