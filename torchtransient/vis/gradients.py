"""Gradients as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchtransient.checks import as_number, shown
from torchtransient.errors import ShapeError, UnitError
from torchtransient.vis import colour_maps
from torchtransient.vis.files import picture_figure, save_figure
from torchtransient.vis.sources import Source, as_tensor
from torchtransient.vis.tone_mapping import checked_positive

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def gradient_picture(
    gradient: Source,
    path: str | Path | None = None,
    *,
    percentile: float = 99.0,
    limit: float | None = None,
    per_channel: bool = False,
    label: str = "",
    title: str = "",
) -> Figure:
    """A matplotlib figure of a gradient (C, H, W) or (H, W): blue is negative, white zero, red positive.

    The scale is symmetric around zero and ends at `limit`, or at the given percentile of the absolute values: some
    noisy pixels then do not hide the others. Channels are added up, or shown in a panel each with `per_channel`, on one
    scale. A tensor that requires gradients is taken with its `.grad` by you: this draws the values it is given. A
    texture's gradient (H, W, C) is drawn after `.permute(2, 0, 1)`. Pixels that are not finite are green. Writes the
    figure when `path` is given. Raises ShapeError, UnitError for a percentile outside of (0, 100] or a limit that is
    not positive, StorageError.
    """
    values = as_tensor(gradient, "gradient_picture")
    if values.ndim == 2:
        values = values[None]
    if values.ndim != 3 or values.numel() == 0 or values.is_complex():
        raise ShapeError(f"gradient_picture: expected (C, H, W) or (H, W), got {tuple(values.shape)}.")
    share = as_number(percentile)
    if share is None or not 0 < share <= 100:
        raise UnitError(f"gradient_picture: expected 0 < percentile <= 100, got {shown(percentile)}.")
    images = values.double().numpy() if per_channel else values.double().sum(0, keepdim=True).numpy()
    if limit is None:
        limit = colour_maps.symmetric_limit(images, percentile)
    else:
        limit = checked_positive("limit", limit, "gradient_picture")
    figure, panels = picture_figure(images.shape[1], images.shape[2], panels=len(images), side=4.4)
    import matplotlib

    colours = matplotlib.colormaps["RdBu_r"].with_extremes(bad="limegreen")
    names = ("red", "green", "blue") if len(images) == 3 else tuple(f"channel {n}" for n in range(len(images)))
    drawn: list[Any] = []
    for panel, image, name in zip(panels, images, names, strict=False):
        drawn.append(panel.imshow(image, cmap=colours, vmin=-limit, vmax=limit, interpolation="nearest"))
        panel.set_title(name if per_channel else title, fontsize=10)
    outside = np.abs(images[np.isfinite(images)]) > limit
    extend = "both" if outside.any() else "neither"
    figure.colorbar(drawn[-1], ax=panels[: len(images)], shrink=0.85, label=label, extend=extend)
    if title and per_channel:
        figure.suptitle(title, fontsize=11)
    return save_figure(figure, path, "gradient_picture")
