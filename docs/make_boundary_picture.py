"""Draw docs/images/boundary_term.png: one derivative's interior and boundary part, beside finite differences.

    python docs/make_boundary_picture.py

A tilted plate before a wall is shifted sideways. Forward mode with the boundary term and without it, at the same seeds:
their difference is the boundary part. Prints how the sum over the picture agrees with finite differences, bin by bin.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

import torchtransient as tt
from torchtransient.scenes import look_at, rotate, scale, translate
from torchtransient.scenes.parts import diffuse, perspective, transient_film, transient_path
from torchtransient.vis.files import figure_type, save_figure

PICTURE = Path(__file__).parent / "images" / "boundary_term.png"
KEY = "plate.to_world"
PLATE = translate([0.1, -0.05, 0.8]) @ rotate([0, 1, 0], 35) @ scale([0.45, 0.35, 1.0])
SEEDS, SPP, DIFFERENCE_SPP, STEP_M = 16, 512, 4096, 0.002
RENDER, KINDS = "render", ("interior", "boundary", "sum", "finite differences")
SIDEWAYS = torch.zeros(4, 4).index_put((torch.tensor(0), torch.tensor(3)), torch.tensor(1.0))


def renderer(boundary: bool) -> tt.TransientRenderer:
    """32 x 32 pixels, bins of 4 cm, light of one and two reflections."""
    scene = {
        "type": "scene",
        "integrator": transient_path(3),
        "sensor": perspective(look_at([0, 0, 4], [0, 0, 0]), 36.0, transient_film(32, 92, 5.6, 0.04), SPP),
        "light": {"type": "point", "position": [0.7, 0.4, 3.8], "intensity": 10.0},
        "wall": {"type": "rectangle", "to_world": scale(5.0), "bsdf": diffuse(0.7)},
        "plate": {"type": "rectangle", "to_world": PLATE, "bsdf": diffuse(0.4)},
    }
    return tt.TransientRenderer(
        tt.load(scene, variant="llvm_ad_mono"),
        [KEY],
        spp=SPP,
        temporal_filter="tent",
        boundary=boundary,
        physics="ignore",
    )


def derivatives() -> dict[str, Tensor]:
    """(SEEDS, T, H, W) of the render and, per metre of shift, of each kind of derivative."""
    whole, inner = renderer(True), renderer(False)
    base = torch.tensor(PLATE).float()

    def moved(which: tt.TransientRenderer, shift: Tensor, seed: int, spp: int) -> Tensor:
        return which({KEY: base + shift * SIDEWAYS}, seed=seed, spp=spp).transient[0]

    def slope(which: tt.TransientRenderer, seed: int) -> Tensor:
        return torch.func.jvp(lambda x: moved(which, x, seed, SPP), (torch.zeros(()),), (torch.ones(()),))[1]

    found: dict[str, list[Tensor]] = {name: [] for name in (RENDER, *KINDS)}
    for seed in tqdm(range(SEEDS), desc="seeds"):
        with_edges, without = (slope(which, seed) for which in (whole, inner))
        with torch.no_grad():
            ends = [moved(whole, torch.tensor(h), 1000 + seed, DIFFERENCE_SPP) for h in (STEP_M, -STEP_M)]
        found[RENDER].append((ends[0] + ends[1]) / 2)
        found["interior"].append(without)
        found["boundary"].append(with_edges - without)
        found["sum"].append(with_edges)
        found["finite differences"].append((ends[0] - ends[1]) / (2 * STEP_M))
    return {name: torch.stack(each) for name, each in found.items()}


def draw(found: dict[str, Tensor], axis: tt.TimeAxis, path: Path) -> None:
    """Sums over time, one row of pixels over time, and sums over the picture bin by bin."""
    figure = figure_type()(figsize=(13, 8.2), layout="constrained")
    top, bottom = figure.subfigures(2, 1, height_ratios=[2, 1])
    panels = top.subplots(2, len(found))
    row, edges = 16, axis.edges_opl
    images = {name: each.mean(0).sum(0) for name, each in found.items()}
    rows = {name: each.mean(0)[:, row] for name, each in found.items()}
    extent = (-0.5, 31.5, float(edges[-1]), float(edges[0]))
    limits = [float(torch.stack([each[kind].abs() for kind in KINDS]).max()) for each in (images, rows)]
    for upper, lower, name in zip(*panels, found, strict=True):
        colours = [{"cmap": "RdBu_r", "vmin": -limit, "vmax": limit} for limit in limits]
        if name == RENDER:
            colours = [{"cmap": "gray", "vmin": 0}, {"cmap": "gray_r", "vmin": 0}]
        image = upper.imshow(images[name], **colours[0])
        slices = lower.imshow(rows[name], extent=extent, aspect="auto", **colours[1])
        upper.axhline(row, color="0.4", linewidth=0.7, linestyle=":")
        upper.set(title=name, xticks=[], yticks=[])
        lower.set(xlabel="column", ylim=(8.7, 5.7))
    panels[0][0].set_ylabel("summed over time")
    panels[1][0].set_ylabel("dotted row:\noptical path length [m]")
    top.colorbar(image, ax=panels[0], label="per metre of shift")
    top.colorbar(slices, ax=panels[1], label="per metre, in a bin of 4 cm")
    curves = bottom.subplots()
    centers = torch.as_tensor(axis.centers_opl)
    for name, colour, width in zip(KINDS, ("tab:blue", "tab:orange", "black"), (3, 3, 1), strict=False):
        curves.plot(centers, found[name].sum((2, 3)).mean(0), color=colour, linewidth=width, label=name)
    expected = found["finite differences"].sum((2, 3))
    error = expected.std(0) / SEEDS**0.5
    curves.errorbar(
        centers, expected.mean(0), error, fmt=".", color="tab:red", label="finite differences", markersize=4
    )
    curves.axhline(0, color="0.7", linewidth=0.7, zorder=0)
    curves.set(xlim=(5.7, 8.7), xlabel="optical path length [m]", ylabel="summed over the picture,\nper metre")
    curves.legend(fontsize=9)
    save_figure(figure, path, "make_boundary_picture")


def main() -> None:
    tt.threads(1)
    found = derivatives()
    draw(found, renderer(False).axis, PICTURE)
    ours, expected = (found[name].sum((2, 3)).double() for name in ("sum", "finite differences"))
    error = ((ours.var(0) + expected.var(0)) / SEEDS).sqrt()
    seen = error > 1e-3 * error.max()
    z = ((ours - expected).mean(0) / error)[seen]
    print(f"{int(seen.sum())} bins: z mean {z.mean():+.2f}, std {z.std():.2f}, largest {z.abs().max():.1f}; {PICTURE}")


if __name__ == "__main__":
    main()
