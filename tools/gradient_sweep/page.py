"""Files of the sweep: ``docs/gradients_sweep.md``, the same as JSON, and the data of the table of parameters."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Container, Iterable, Sequence
from pathlib import Path
from typing import Any

from tools.gradient_sweep.compare import RESOLVED, SCALE, SIGMAS, TOLERANCE, WEAK
from tools.gradient_sweep.settings import all_settings
from torchtransient.plugins.parameter_effect import CORRECT, FILE

PAGE, DATA = "gradients_sweep.md", "gradients_sweep.json"
# Columns of the JSON file, one row for a comparison.
COLUMNS = (
    "setting", "key", "tangent", "verdict", "reverse", "reverse_error", "forward", "differences", "differences_error",
    "scale", "spp", "biased", "table", "note", "place",
)  # fmt: skip
DECIDED = ("agree", "contradict", "modes differ")
UNDECIDED = ("unresolved", "no effect")
TITLES = {
    "bsdf": "Surfaces", "shape": "Shapes", "emitter": "Emitters", "sensor": "Sensors", "texture": "Textures",
    "spectrum": "Spectra", "phase": "Phase functions", "medium": "Media", "velocity": "Velocities",
    "scan": "Captures around a corner",
}  # fmt: skip
# Places that say nothing of a plugin's derivative: that a shape has a surface, a light or a medium at all.
_SLOTS_OF_SHAPES = (".bsdf", ".emitter", ".sensor", ".interior_medium", ".exterior_medium")

HEAD = f"""# The sweep of gradients

Every parameter that `scene.parameters()` offers for every plugin, bare and inside others, against central finite
differences, in scenes in which no silhouette moves but in captures around a corner, where derivatives follow the
outline of what is hidden. Written by `make sweep`
(`tools/gradient_sweep`); the numbers are in [{DATA}]({DATA}) too.

- The loss is the transient of 4 x 4 pixels (exhaustive captures: 2 x 2, with 2 x 2 laser positions) weighed by a sine
  of the optical path length. What is differentiated is the loss along one fixed direction in the entries of a
  parameter: a change by its own size (textures and grids: another one in each entry; normals: by a fifth); poses and
  positions along two directions, a metre and a fifth of a radian, inside others along one of the two. Velocities: a
  film of rates, weighed by a sine of the rate too.
- Derivatives and differences use the same seeds. *Errors* are standard errors over independent seeds.
- *Scale*: {SCALE:g} of the loss with absolute weights. A comparison is decided when the standard errors of derivative
  and differences are both below {RESOLVED:.0%} of the larger of |finite difference| and scale; else it is *unresolved*.
  An effect below {RESOLVED:.0%} of the scale counts beside {WEAK:g} times itself, or {RESOLVED:.0%} of the scale where
  that is more. *No effect*: both are below that and the finite difference is zero within three errors, so that nothing
  is proven.
- *Contradict*: differs, seed by seed, by more than {SIGMAS} standard errors and more than {TOLERANCE:.0%} of the larger
  of |finite difference| and scale, with fresh seeds again and extrapolated to a step of zero.
- Forward mode uses the paths of reverse mode; *modes differ* when they disagree by more than rounding. A dash: asking
  for it is an error.
- *Refused*: the table of parameters says that there is no derivative, and asking for it is an error.
"""


def _number(value: float) -> str:
    return f"{value:.4g}" if value == value else "-"


def _cells(row: dict[str, Any]) -> list[str]:
    decided = row["differences"] == row["differences"]
    return [
        f"`{row['key']}`" if row["key"] else "-",
        row["tangent"] or "-",
        f"{_number(row['reverse'])} ± {row['reverse_error']:.1g}" if decided else "-",
        _number(row["forward"]),
        f"{_number(row['differences'])} ± {row['differences_error']:.1g}" if decided else "-",
        f"{row['scale']:.2g}" if decided else "-",
        f"**{row['verdict']}**" if row["verdict"] in ("contradict", "modes differ", "error") else row["verdict"],
        _state(row).replace("|", "/"),
    ]


def _state(row: dict[str, Any]) -> str:
    """Entry of the table of parameters, in a few words."""
    if row["biased"] or row["verdict"] == "refused":
        return str(row["table"])
    # Not all edges are followed in every scene.
    partly = row["table"].startswith(f"{CORRECT} except")
    return row["table"].replace(CORRECT, "right", 1) if partly else "right" if row["table"] else ""


def _table(rows: Iterable[dict[str, Any]]) -> list[str]:
    lines = [
        "| scene | key | direction | reverse | forward | finite differences | scale | verdict | table of parameters |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    before = ""
    for row in rows:
        # The name of the scene once, without its kind.
        name = row["setting"].partition(" ")[2]
        lines.append("| " + " | ".join([name if name != before else "", *_cells(row)]) + " |")
        before = name
    return lines


def page(rows: Sequence[dict[str, Any]]) -> str:
    """The page."""
    lines = [HEAD, summary(rows), ""]
    measured, settings = {row["setting"] for row in rows}, all_settings()
    if missing := [setting.name for setting in settings if setting.name not in measured]:
        # What they alone hold counts as unchecked.
        words = f"Without a comparison (no parameters, or not measured yet), {len(missing)} of {len(settings)} scenes"
        lines += [f"{words}: {'; '.join(missing)}.", ""]
    for kind, title in TITLES.items():
        chosen = [row for row in rows if row["setting"].split(" ")[0] == kind]
        if chosen:
            lines += [f"## {title}", "", *_table(chosen), ""]
    return "\n".join(lines)


def summary(rows: Sequence[dict[str, Any]]) -> str:
    """Number of comparisons of each outcome."""
    counts = Counter(row["verdict"] for row in rows)
    compared = sum(counts[v] for v in (*DECIDED, *UNDECIDED, "not finite"))
    said = ", ".join(f"{counts[verdict]} {verdict}" for verdict in sorted(counts, key=lambda v: -counts[v]))
    biased = sum(row["biased"] for row in rows if row["verdict"] == "contradict")
    share = counts["unresolved"] / max(compared, 1)
    return (
        f"{compared} comparisons in {len({row['setting'] for row in rows})} scenes: {said}. Unresolved: {share:.1%}. "
        f"Of what contradicts, {biased} are called biased by the table of parameters."
    )


def place_without_shapes(place: Sequence[str]) -> list[str]:
    """A place by what counts in it."""
    return [name for name in place if not name.endswith(_SLOTS_OF_SHAPES)]


def swept(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Data of the table of parameters: names that took part in a decided comparison, places of undecided ones.

    A parameter is decided in a place when it is along one direction in one scene.
    """
    decided = {tuple(row["place"]) for row in rows if row["verdict"] in DECIDED}
    names = sorted({name for place in decided for name in place})
    reduced = {tuple(place_without_shapes(place)) for place in decided}
    undecided = {
        tuple(place_without_shapes(row["place"]))
        for row in rows
        if row["verdict"] not in (*DECIDED, "refused") and row["place"]
    }
    return {"checked": names, "undecided": sorted(list(place) for place in undecided - reduced)}


def write_files(results: Iterable[dict[str, Any]], folder: Path) -> None:
    """Page, data, and the file of the table of parameters."""
    rows = list(results)
    (folder / PAGE).write_text(page(rows), encoding="utf-8")
    compact = ",\n".join(json.dumps([row.get(column) for column in COLUMNS]) for row in rows)
    (folder / DATA).write_text(f'{{"columns": {json.dumps(COLUMNS)},\n"rows": [\n{compact}\n]}}\n', encoding="utf-8")
    FILE.write_text(json.dumps(swept(rows), indent=1) + "\n", encoding="utf-8")


def with_rows_of_the_page(
    results: Iterable[dict[str, Any]], done: Container[str], folder: Path
) -> list[dict[str, Any]]:
    """``results`` of the settings that are ``done``, and what the page has of the others, in the order of the sweep."""
    order = {setting.name: number for number, setting in enumerate(all_settings())}
    page_has = read_rows(folder) if (folder / DATA).exists() else []
    kept = [row for row in page_has if row["setting"] in order and row["setting"] not in done]
    return sorted([*results, *kept], key=lambda row: order[row["setting"]])


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """The rows of the data beside the page."""
    data = json.loads((folder / DATA).read_text(encoding="utf-8"))
    return [dict(zip(data["columns"], row, strict=True)) for row in data["rows"]]
