"""Draw the picture and print the table of docs/parametrize.md: its fit with parametrizations and without.

    python docs/make_parametrize_picture.py

The fit is the page's own first block; the free one is the same loop with Adam on the values themselves.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import torch

import torchtransient as tt
from torchtransient.vis.files import figure_type, save_figure

HERE = Path(__file__).parent
SEEDS = (0, 1, 2)
COLOURS = {"parametrized": "tab:blue", "free": "tab:orange"}


def page() -> dict[str, Any]:
    """What the first block of the page leaves behind: its functions, its truth, and its fit."""
    block = re.search(r"```python\n(.*?)```", (HERE / "parametrize.md").read_text(), re.DOTALL)
    assert block is not None
    names: dict[str, Any] = {}
    exec(compile(block.group(1), "docs/parametrize.md", "exec"), names)
    return names


def fits(names: dict[str, Any]) -> dict[str, list[list[dict[str, torch.Tensor]]]]:
    """Values of every step, by kind and seed."""
    albedo, pose, index = names["ALBEDO"], names["POSE"], names["INDEX"]
    # The page's own fit is that of seed 0.
    found: dict[str, list[list[dict[str, torch.Tensor]]]] = {"parametrized": [names["history"]], "free": []}
    for seed in SEEDS:
        if seed:
            renderer = names["renderer_of"](**names["START"])
            groups = names["parametrized"](renderer)
            found["parametrized"].append(list(names["fit"](renderer, groups, names["target"], seed)))
        free = names["renderer_of"](**names["START"])
        own = dict(zip(free.values, free.parameters(), strict=True))
        groups = [{"params": [own[albedo], own[index]], "lr": 0.04}, {"params": [own[pose]], "lr": 0.01}]
        found["free"].append(list(names["fit"](free, groups, names["target"], seed)))
    return found


def row(names: dict[str, Any], run: list[dict[str, torch.Tensor]]) -> list[str]:
    """Return the cells of a fit: its albedo and index, the lowest index on the way, and how far the wall is off."""
    last, truth = run[-1], torch.as_tensor(names["TRUTH"]["pose"])
    pose = last[names["POSE"]]
    # Of its sides: the columns of a free matrix need not stay at right angles.
    found, normal = (
        torch.nn.functional.normalize(torch.linalg.cross(one[:3, 0].double(), one[:3, 1].double()), dim=0)
        for one in (pose, truth)
    )
    distance = 1e3 * float((pose[:3, 3] - truth[:3, 3]).double() @ normal)
    tilt = math.degrees(math.acos(min(1.0, float(found @ normal))))
    rotation = pose[:3, :3].double() / 3  # the wall's scale
    stretch = float((rotation.T @ rotation - torch.eye(3)).abs().max())
    index = [float(one[names["INDEX"]]) for one in run]
    numbers = (float(last[names["ALBEDO"]]), index[-1], min(index), abs(distance), tilt, stretch)
    return [f"{value:.{digits}f}" for value, digits in zip(numbers, (3, 4, 2, 1, 2, 2), strict=True)]


def main() -> None:
    tt.threads(1)
    names = page()
    found = fits(names)
    # Along the wall's normal: how far it slides in its own plane is nothing that a wall larger than the picture tells.
    pose = torch.as_tensor(names["TRUTH"]["pose"])
    place, normal = pose[:3, 3], torch.nn.functional.normalize(pose[:3, 2], dim=0)
    panels = [
        ("albedo", lambda one: float(one[names["ALBEDO"]]), names["TRUTH"]["albedo"]),
        ("index of refraction", lambda one: float(one[names["INDEX"]]), names["TRUTH"]["index"]),
        ("wall off by, m", lambda one: float(((one[names["POSE"]][:3, 3] - place) @ normal).abs()), None),
    ]
    figure = figure_type()(figsize=(10.5, 3.2), layout="constrained")
    for axes, (title, number, right) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        for kind, runs in found.items():
            for seed, run in enumerate(runs):
                axes.plot([number(one) for one in run], color=COLOURS[kind], lw=1, label=kind if seed == 0 else None)
        if right is None:
            axes.set_yscale("log")
        else:
            axes.axhline(right, color="k", ls=":", lw=1, label="truth")
        axes.set(xlabel="step", title=title)
    figure.axes[1].axhspan(0.85, 1.0, color="0.9", zorder=0, label="no glass")
    figure.axes[1].set_ylim(0.85, 1.75)
    figure.axes[1].legend(fontsize=8)
    path = HERE / "images" / "parametrize.png"
    save_figure(figure, path, "make_parametrize_picture")
    for kind, runs in found.items():
        columns = zip(*(row(names, run) for run in runs), strict=True)
        print(f"| {kind} | {' | '.join(', '.join(column) for column in columns)} |")
    print(path)


if __name__ == "__main__":
    main()
