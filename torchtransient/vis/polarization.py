"""Polarization as pictures, with the colour maps of the field."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient import stokes as st
from torchtransient.errors import ArgumentError
from torchtransient.vis import colour_maps
from torchtransient.vis.files import picture_figure, save_figure
from torchtransient.vis.sources import Source, stokes_of
from torchtransient.vis.tone_mapping import tone_map

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TITLES = {
    "intensity": "intensity $S_0$",
    "dop": "degree of polarization",
    "dolp": "degree of linear polarization",
    "aolp": "angle of linear polarization",
    "docp": "degree of circular polarization",
    "s1": "$S_1$",
    "s2": "$S_2$",
    "s3": "$S_3$",
}
_NO_LIGHT = 0.35  # grey: neither an angle nor a degree of anything


def polarization_picture(
    source: Source,
    path: str | Path | None = None,
    *,
    quantities: Sequence[str] = ("intensity", "dolp", "aolp", "docp"),
    frame: int | None = None,
    floor: float | None = None,
    angle_map: str = "even",
) -> Figure:
    """Draw polarization, a panel for each quantity.

    Args:
        source: Stokes vectors (4, C, T, H, W) or (4, C, H, W), a result with such, or its file; channels are added up.
        path: file to write the figure to.
        quantities: "intensity" (tone mapped), "dop", "dolp" (0 to 1, black to yellow; noise above one is shown as one),
            "aolp" (-90 to 90 degrees, cyclic, the more colourful the more linearly polarized), "docp" (-1 to 1, blue is
            left and red right circular), "s1", "s2", "s3" (blue to red around zero).
        frame: index of the bin; None for the light of all times.
        floor: intensity below which pixels are grey; None for a hundredth of the median of lit pixels.
        angle_map: "even" for hues of equal lightness, "hsv" for the hue circle of many papers.

    Returns:
        The matplotlib figure.

    Raises:
        ShapeError: for unpolarized sources.
        IndexError: for bins outside.
        ArgumentError: for unknown names.
        StorageError: when the figure cannot be written.
    """
    if any(name not in _TITLES for name in quantities) or angle_map not in ("even", "hsv"):
        raise ArgumentError(
            f"polarization_picture: expected quantities out of {', '.join(_TITLES)} and angle_map 'even' or 'hsv', got "
            f"{tuple(quantities)} and {angle_map!r}."
        )
    vectors = stokes_of(source, frame, "polarization_picture").to(torch.float64)
    broken = ~torch.isfinite(vectors).all(0).all(0)
    vectors = torch.nan_to_num(vectors, posinf=0.0, neginf=0.0)
    total = vectors.sum(1)
    if floor is None:
        # Of the median, which lamps in the picture do not decide.
        lit = total[0][total[0] > 0]
        floor = 0.01 * lit.median().item() if lit.numel() else 0.0
    dark = ((total[0] <= floor) | broken).numpy()
    figure, panels = picture_figure(total.shape[1], total.shape[2], panels=len(quantities), side=3.4)
    for panel, name in zip(panels, quantities, strict=False):
        panel.set_title(_TITLES[name], fontsize=10)
        if name == "intensity":
            panel.imshow(tone_map(torch.where(broken, torch.nan, vectors[0])).numpy(), interpolation="nearest")
        elif name == "aolp":
            _draw_angle(figure, panel, total, dark, angle_map)
        else:
            _draw_scalar(figure, panel, name, total, dark)
    return save_figure(figure, path, "polarization_picture")


def _angle_image(stokes: Tensor, dark: NDArray[np.bool_], angle_map: str) -> NDArray[np.float64]:
    """Return RGB (H, W, 3) in [0, 1] of Stokes vectors (4, H, W): hue by the angle, colourful by the degree."""
    turns = st.angle_of_linear_polarization(stokes, 0).numpy() / math.pi
    degree = np.clip(st.degree_of_linear_polarization(stokes, 0).numpy(), 0, 1)
    # Half polarized light is already half as colourful; the root lets weak polarization be seen.
    strength = np.sqrt(degree)[..., None]
    if angle_map == "hsv":
        colours = colour_maps.cyclic_map("hsv")(np.mod(turns + 0.5, 1.0))[..., :3]
        grey = np.full_like(colours, 0.6)
    else:
        colours = colour_maps.cyclic(turns)
        grey = np.broadcast_to(colour_maps.oklch(0.75, 0.0, 0.0), colours.shape)
    image = strength * colours + (1 - strength) * grey
    image[dark] = _NO_LIGHT
    return np.asarray(image)


def _draw_angle(figure: Any, panel: Any, total: Tensor, dark: NDArray[np.bool_], angle_map: str) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    panel.imshow(_angle_image(total, dark, angle_map), interpolation="nearest")
    colours = ScalarMappable(Normalize(-90, 90), colour_maps.cyclic_map(angle_map))
    bar = figure.colorbar(colours, ax=panel, shrink=0.8, label="degrees")
    bar.set_ticks([-90, -45, 0, 45, 90])


def _draw_scalar(figure: Any, panel: Any, name: str, total: Tensor, dark: NDArray[np.bool_]) -> None:
    import matplotlib

    if name in ("dop", "dolp"):
        measure = st.degree_of_polarization if name == "dop" else st.degree_of_linear_polarization
        values, colours, low, high = measure(total, 0).numpy(), "inferno", 0.0, 1.0
    elif name == "docp":
        values, colours, low, high = st.degree_of_circular_polarization(total, 0).numpy(), "RdBu_r", -1.0, 1.0
    else:
        values, colours = total[int(name[1])].numpy(), "RdBu_r"
        high = colour_maps.symmetric_limit(values)
        low = -high
    colour_map = matplotlib.colormaps[colours].with_extremes(bad=(_NO_LIGHT,) * 3)
    seen = np.where(dark, np.nan, values) if name in ("dop", "dolp", "docp") else values
    image = panel.imshow(seen, cmap=colour_map, vmin=low, vmax=high, interpolation="nearest")
    figure.colorbar(image, ax=panel, shrink=0.8)
