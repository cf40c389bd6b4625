"""A fit on one page: images before and after, the loss, and the parameters on their way."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.checks import Numbers, finite, mapping, numbers, shown
from torchtransient.errors import ShapeError
from torchtransient.vis.files import figure_type, save_figure
from torchtransient.vis.sources import real_tensor
from torchtransient.vis.tone_mapping import exposure_of, tone_map

# A curve called by the name of a channel is drawn in its colour.
CHANNEL_COLORS = {"red": "tab:red", "green": "tab:green", "blue": "tab:blue"}


def plot_fit(
    images: Mapping[str, Tensor],
    loss: Numbers,
    values: Mapping[str, Numbers],
    *,
    truth: Mapping[str, float],
    path: str | Path,
) -> None:
    """Write a picture: `images` (title -> steady (C, H, W)) under one exposure, the loss, the values over the steps.

    The exposure is that of the last image. `values`: name -> one number per step; `truth`: name -> the number aimed at,
    a dashed line. Raises ShapeError without images or steps, or when the lists differ in length; StorageError when the
    file cannot be written. Needs matplotlib (extra `vis`).
    """
    given = mapping("plot_fit: images", images, "{title: image}")
    images = {title: real_tensor(image, f"plot_fit: {title!r}") for title, image in given.items()}
    curves = mapping("plot_fit: values", values, "{name: numbers}")
    row, values = _row("loss", loss), {name: _row(f"values of {name!r}", curve) for name, curve in curves.items()}
    aims = mapping("plot_fit: truth", truth, "{name: number}")
    truth = {name: finite(f"plot_fit: truth of {name!r}", one) for name, one in aims.items()}
    steps = len(row)
    if not images or steps == 0:
        raise ShapeError(f"plot_fit: expected at least one image and one step, got {len(images)} and {steps}.")
    for name, curve in values.items():
        if len(curve) != steps:
            raise ShapeError(f"plot_fit: expected {steps} values of '{name}', as many as losses, got {len(curve)}.")
    figure = figure_type()(figsize=(11.0, 6.6), layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False).flat
    exposure = exposure_of(list(images.values())[-1].cpu())
    panels = upper.subplots(1, len(images), squeeze=False)[0]
    for panel, (title, image) in zip(panels, images.items(), strict=True):
        panel.imshow(tone_map(image.cpu(), exposure).numpy(), interpolation="nearest")
        panel.set_title(title, fontsize=10)
        panel.set_axis_off()
    left, right = lower.subplots(1, 2)
    left.plot(row, color="black", linewidth=1.2)
    if bool((row > 0).all()):
        left.set_yscale("log")
    left.set_ylabel("loss")
    for n, (name, curve) in enumerate(values.items()):
        color = CHANNEL_COLORS.get(name, f"C{n}")
        right.plot(curve, color=color, linewidth=1.2, label=name)
        if name in truth:
            right.axhline(truth[name], color=color, linewidth=0.8, linestyle="--")
    right.set_ylabel("value (dashed: truth)")
    if values:
        right.legend(fontsize=8, frameon=False)
    for panel in (left, right):
        panel.set_xlabel("step")
        panel.grid(True, color="0.9", linewidth=0.6)
    save_figure(figure, path, "plot_fit")


def _row(what: str, given: Any) -> NDArray[np.float64]:
    row = numbers(f"plot_fit: {what}", given)
    if row.ndim != 1:
        raise ShapeError(f"plot_fit: expected {what} as one number for each step, got {shown(given)}.")
    return row
