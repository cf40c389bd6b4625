"""Pictures of reconstructed volumes (Z, Y, X): what stands before the wall, seen from three sides, and its surface.

Rows of the volume run upwards, columns to the right, as the sensor points lie on the wall in other pictures; planes
begin at the wall.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchtransient.checks import Numbers, positive
from torchtransient.errors import ShapeError, UnitError
from torchtransient.vis.files import figure_type, save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PANEL = 3.4
# Beside the picture of depth: no colour of the map.
_NOTHING = "0.85"
_NO_NUMBER = "tab:red"
# Steps of even planes differ by less, as a share.
_UNEVEN = 1e-3


def volume_views(
    volume: Any,
    path: str | Path | None = None,
    *,
    depths: Any = None,
    extent: Numbers | None = None,
    depth: Any = None,
    mask: Any = None,
    normals: Any = None,
    gamma: float = 1.0,
    title: str = "",
) -> Figure:
    """Draw a volume: the highest values seen from the front, from the top and from the side.

    Args:
        volume: volume (Z, Y, X), real, or complex of which the squared modulus is shown; values below zero are black,
            infinite ones white, NaN red.
        path: file to write the figure to.
        depths: depths (Z,) in metres, increasing; planes reach to the middle between them. None counts voxels.
        extent: width and height, metres; x and y count from the middle. None counts voxels.
        depth: depth map (Y, X) in metres, drawn in a panel of its own.
        mask: mask (Y, X) of the pixels of ``depth`` and ``normals`` that are drawn.
        normals: normals (3, Y, X), drawn in a panel of their own.
        gamma: exponent of brightness; below 1 lightens dim voxels.
        title: text above the figure.

    Returns:
        The matplotlib figure.

    Raises:
        ShapeError: for shapes that do not fit each other.
        UnitError: for depths that do not increase, extents and gammas that are not positive.
        StorageError: when the figure cannot be written.
    """
    values = _volume(volume)
    gamma = positive("volume_views: gamma", gamma)
    size = tuple(values.shape)
    z, (width, height) = _scales(size, depths, extent)
    kept = None if mask is None else _map("mask", mask, size[1:]).bool()
    extras = [name for name, given in (("depth", depth), ("normals", normals)) if given is not None]
    count = 3 + len(extras)
    figure = figure_type()(figsize=(_PANEL * count + 0.6, _PANEL + 0.6), layout="constrained")
    panels = figure.subplots(1, count, squeeze=False)[0]
    across, up = (torch.linspace(-side / 2, side / 2, n + 1) for side, n in ((width, size[2]), (height, size[1])))
    unit = "m" if extent is not None else "voxels"
    unit_z = "m" if depths is not None else "voxels"
    highest = float(torch.nan_to_num(values, posinf=0.0).max()) or 1.0
    light = (values / highest).clamp_max(1) ** gamma
    views = (
        ("front", light.amax(0), across, up, f"x ({unit})", f"y ({unit})"),
        ("top", light.amax(1), across, z, f"x ({unit})", f"depth ({unit_z})"),
        ("side", light.amax(2).T, z, up, f"depth ({unit_z})", f"y ({unit})"),
    )
    for panel, (name, picture, columns, rows, right, upwards) in zip(panels, views, strict=False):
        _light_panel(panel, picture, columns, rows, aspect="equal" if name == "front" else "auto")
        _label(panel, name, right, upwards)
    box = (-width / 2, width / 2, -height / 2, height / 2)
    for panel, name in zip(panels[3:], extras, strict=True):
        if name == "depth":
            _depth_panel(figure, panel, _map("depth", depth, size[1:]), kept, box)
        else:
            _normals_panel(panel, _map("normals", normals, (3, *size[1:])), kept, box)
        _label(panel, name, f"x ({unit})", f"y ({unit})")
    if title:
        figure.suptitle(title, fontsize=10)
    return save_figure(figure, path, "volume_views")


# ------------------------------------------------------------------------------------------------------------- parts


def _light_panel(panel: Any, picture: Tensor, columns: Tensor, rows: Tensor, aspect: str) -> None:
    """Draw brightness between edges of columns and rows; uneven planes as they are."""
    from matplotlib import colormaps

    shown_ = {"cmap": colormaps["gray"].with_extremes(bad=_NO_NUMBER), "vmin": 0, "vmax": 1}
    if _even(columns) and _even(rows):
        box = (float(columns[0]), float(columns[-1]), float(rows[0]), float(rows[-1]))
        panel.imshow(picture.numpy(), origin="lower", extent=box, aspect=aspect, **shown_)
    else:
        panel.pcolormesh(columns.numpy(), rows.numpy(), picture.numpy(), **shown_)


def _even(edges: Tensor) -> bool:
    steps = edges.diff()
    return bool(((steps - steps.mean()).abs() <= _UNEVEN * steps.mean()).all())


def _depth_panel(figure: Any, panel: Any, depth: Tensor, kept: Tensor | None, box: tuple[float, ...]) -> None:
    shown_ = depth if kept is None else torch.where(kept, depth, torch.nan)
    panel.set_facecolor(_NOTHING)
    image = panel.imshow(shown_.numpy(), origin="lower", extent=box, cmap="viridis", aspect="equal")
    if bool(torch.isfinite(shown_).any()):
        figure.colorbar(image, ax=panel, label="depth (m)")


def _normals_panel(panel: Any, normals: Tensor, kept: Tensor | None, box: tuple[float, ...]) -> None:
    colours = ((normals + 1) / 2).clamp(0, 1).permute(1, 2, 0)
    if kept is not None:
        colours = torch.where(kept[..., None], colours, float(_NOTHING))
    panel.imshow(colours.numpy(), origin="lower", extent=box, aspect="equal")


def _label(panel: Any, title: str, right: str, upwards: str) -> None:
    panel.set_title(title, fontsize=9)
    panel.set_xlabel(right, fontsize=8)
    panel.set_ylabel(upwards, fontsize=8)
    panel.tick_params(labelsize=7)


def _volume(volume: Any) -> Tensor:
    values = torch.as_tensor(volume).detach().cpu()
    if values.ndim != 3:
        raise ShapeError(f"volume: expected (Z, Y, X), got {tuple(values.shape)}; choose an item and a channel.")
    values = values.real.square() + values.imag.square() if values.is_complex() else values
    return values.double().clamp_min(0)


def _map(name: str, values: Any, size: tuple[int, ...]) -> Tensor:
    plain = torch.as_tensor(values).detach().cpu().double()
    if tuple(plain.shape) != size:
        raise ShapeError(f"{name}: expected {size}, got {tuple(plain.shape)}; choose an item and a channel.")
    return plain


def _scales(size: tuple[int, ...], depths: Any, extent: Any) -> tuple[Tensor, tuple[float, float]]:
    """Return edges of the planes (Z + 1,), float64, and (width, height)."""
    if depths is None:
        z = torch.arange(size[0] + 1, dtype=torch.float64) - 0.5
    else:
        planes = torch.as_tensor(depths, dtype=torch.float64).detach().cpu()
        if planes.shape != (size[0],):
            raise ShapeError(f"depths: expected ({size[0]},), one for each plane, got {tuple(planes.shape)}.")
        halves = planes.diff() / 2 if len(planes) > 1 else torch.full((1,), 0.5, dtype=torch.float64)
        if not bool((halves > 0).all()):
            raise UnitError(f"depths: expected metres that increase, got {planes.tolist()}.")
        between = planes[:-1] + halves[: len(planes) - 1]
        z = torch.cat([planes[:1] - halves[:1], between, planes[-1:] + halves[-1:]])
    width, height = (size[2], size[1]) if extent is None else extent
    return z, (positive("extent: width", width), positive("extent: height", height))
