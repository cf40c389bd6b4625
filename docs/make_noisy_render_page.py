"""Write the tables and the picture of docs/noisy_renders.md from benchmarks/results/noisy_renders.json.

`python benchmarks/noisy_renders.py` measures them, ten minutes of one core.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

HERE = Path(__file__).parent
NUMBERS = HERE.parent / "benchmarks" / "results" / "noisy_renders.json"
PAGE, PICTURE = HERE / "noisy_renders.md", HERE / "images" / "noisy_renders.png"
UNKNOWNS = ("distance", "yaw", "pitch", "hidden wall", "albedo", "hidden albedo")
# (what is drawn of the losses, label at the line, colour)
DRAWN = (
    ("`poisson_loss`, `poisson_nll`", "Poisson likelihood", "tab:red"),
    ("`log_ratio_loss`, background 1", "log ratio", "tab:pink"),
    ("`root_loss`", "root", "tab:orange"),
    ("`expected_root_loss`", "expected root", "tab:green"),
    ("`cumulative_loss`, `per_root_count`", "running sums", "tab:purple"),
    ('`squared_loss`, weighted, `grad_seed="same"`', "weighted squares, same seed", "tab:cyan"),
    ("`expected_root_loss`, jackknife of two", "expected root, jackknife", "tab:olive"),
    ("`squared_loss`, weighted", "weighted squares", "tab:blue"),
)
DRAWN_UNKNOWNS = ("`poisson_loss`, `poisson_nll`", "`expected_root_loss`", "`squared_loss`, weighted")


def cell(found: dict[str, Any]) -> str:
    """Bias, or what it is below where the noise of the estimate hides it."""
    rms, error = found["rms"], found["error"]
    if not rms < float("inf"):
        return "none"
    if rms < 2 * error:
        return f"< {max(0.01, rms + 2 * error):.2f}"
    return f"{rms:.2f} ± {error:.2f}"


def of_counts(found: dict[str, Any]) -> dict[str, Any]:
    """By samples; losses that are linear in the target have one number for counts and exact targets."""
    rows: dict[str, Any] = found.get("counts", found["exact"])
    return rows


def losses_table(data: dict[str, Any]) -> str:
    samples = list(next(iter(data["least"].values()))["exact"])
    head = f"| loss | spread | own | {' | '.join(samples)} |"
    lines = [head, "|---" * (3 + len(samples)) + "|"]
    for name, found in data["least"].items():
        cells = [f"{found['spread']:.2f}", cell(found["own"]), *(cell(x) for x in of_counts(found).values())]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def exact_table(data: dict[str, Any]) -> str:
    both = {name: found for name, found in data["least"].items() if "counts" in found}
    samples = list(next(iter(both.values()))["exact"])
    lines = [f"| loss | {' | '.join(samples)} |", "|---" * (1 + len(samples)) + "|"]
    lines += [f"| {name} | {' | '.join(cell(x) for x in found['exact'].values())} |" for name, found in both.items()]
    return "\n".join(lines)


def fits_table(data: dict[str, Any]) -> str:
    lines = ["| loss, samples per pixel | bias | of the hidden albedo alone | CPU s a fit |", "|---|---|---|---|"]
    for name, found in data["fits"].items():
        hidden = ", ".join(f"{bias[5]:.1f}" for bias in found["bias"])
        lines.append(f"| {name} | {cell(found)} | {hidden} | {found['CPU s']:.1f} |")
    return "\n".join(lines)


def priors_table(data: dict[str, Any]) -> str:
    lines = ["| misfit, samples per pixel | error, % of the range | by seed | CPU s |", "|---|---|---|---|"]
    for name, found in data["priors"].items():
        each, seconds = found["percent"], found["CPU s"]
        shown = f"{sum(seconds) / len(seconds):.0f}" if seconds else ""
        lines.append(f"| {name} | {sum(each) / len(each):.2f} | {', '.join(f'{x:.2f}' for x in each)} | {shown} |")
    return "\n".join(lines)


def draw(data: dict[str, Any], path: Path) -> None:
    """Bias against samples, of losses; and by unknown, at 64 samples, in the first scene."""
    figure = Figure(figsize=(10.5, 4.3), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.45, 1])
    for name, label, colour in DRAWN:
        found = of_counts(data["least"][name])
        samples = [int(spp) for spp in found]
        # what cannot be told from nothing is drawn as its upper limit, hollow
        seen = [x["rms"] >= 2 * x["error"] for x in found.values()]
        height = [x["rms"] if s else x["rms"] + 2 * x["error"] for x, s in zip(found.values(), seen, strict=True)]
        left.plot(samples, height, color=colour, linewidth=1.4, label=label)
        for spp, y, s in zip(samples, height, seen, strict=True):
            left.plot(spp, y, "o", color=colour, markersize=5, markerfacecolor=colour if s else "white")
    left.axhspan(1e-3, 0.1, color="0.9", linewidth=0)
    left.axhline(1, color="0.4", linewidth=0.8, linestyle="--")
    left.text(samples[0], 1.07, "spread of one capture", fontsize=8, color="0.3", va="bottom")
    left.text(samples[0], 0.085, "does not matter", fontsize=8, color="0.3", va="top")
    left.set(xscale="log", yscale="log", ylim=(0.03, 40))
    left.set(xlabel="samples per pixel", ylabel="bias, in spreads of the best fit")
    left.set_xticks(samples, [str(spp) for spp in samples])
    left.minorticks_off()
    left.set_yticks([0.1, 1, 10], ["0.1", "1", "10"])
    left.set_title("what noise of renders adds, by loss", fontsize=10)
    left.legend(fontsize=7.5, frameon=False, loc="upper right", ncols=2)
    colours = {name: colour for name, _, colour in DRAWN}
    labels = {name: label for name, label, _ in DRAWN}
    for k, name in enumerate(DRAWN_UNKNOWNS):
        found = of_counts(data["least"][name])["64"]
        places = [n + 0.27 * (k - 1) for n in range(6)]
        error = found["standard error"][0]
        right.bar(places, found["bias"][0], 0.25, yerr=error, color=colours[name], label=labels[name])
    right.axhline(0, color="0.4", linewidth=0.8)
    right.set_yscale("symlog", linthresh=1)
    right.set_yticks([-1, 0, 1, 10], ["-1", "0", "1", "10"])
    right.set_ylim(-1.5, 30)
    right.set_xticks(range(6), [name.replace(" ", "\n") for name in UNKNOWNS], fontsize=8)
    right.set_ylabel("bias, in spreads of each")
    right.set_title("by unknown, 64 samples, first scene", fontsize=10)
    right.legend(fontsize=8, frameon=False, loc="upper left")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


TABLES = {"losses": losses_table, "exact": exact_table, "fits": fits_table, "priors": priors_table}


def written(text: str, data: dict[str, Any]) -> str:
    """The page with its tables between their marks."""
    for name, table in TABLES.items():
        begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
        before, after = text.split(begin)[0], text.split(end)[1]
        text = f"{before}{begin}\n{table(data)}\n{end}{after}"
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--numbers", type=Path, default=NUMBERS)
    parser.add_argument("--page", type=Path, default=PAGE, help="the page whose tables are written")
    parser.add_argument("--picture", type=Path, default=PICTURE)
    arguments = parser.parse_args()
    data = json.loads(arguments.numbers.read_text(encoding="utf-8"))
    draw(data, arguments.picture)
    arguments.page.write_text(written(arguments.page.read_text(encoding="utf-8"), data), encoding="utf-8")


if __name__ == "__main__":
    main()
