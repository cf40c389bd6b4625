"""Phasor images: one complex number a pixel and frequency."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.axes import FrequencyAxis
from torchtransient.checks import Numbers
from torchtransient.errors import ShapeError, UnitError
from torchtransient.units import SPEED_OF_LIGHT
from torchtransient.vis import colour_maps
from torchtransient.vis.files import enlarge, grey_where_broken, picture_figure, save_figure, to_bytes
from torchtransient.vis.sources import Source, frequencies_of, phasor_of
from torchtransient.vis.videos import Frames, check_video, with_strip, write_video

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWS = ("real", "imaginary", "amplitude", "phase", "domain")


def phasor_picture(
    source: Source,
    path: str | Path | None = None,
    *,
    show: Sequence[str] = ("real", "domain"),
    which: Sequence[int] = (0,),
    frequencies: FrequencyAxis | Numbers | None = None,
) -> Figure:
    """Draw phasor images, a row for each frequency and a panel for each quantity; scales hold 99 % of the pixels.

    Args:
        source: phasors, complex (C, F, H, W), a result with such a ``phasor``, or its file; channels are added up.
        path: file to write the figure to.
        show: panels. "real" and "imaginary", blue to red around zero on one symmetric scale; "amplitude"; "phase",
            cyclic hue, grey where dark; "domain", hue by phase and brightness by amplitude.
        which: indices of the frequencies.
        frequencies: cycles per metre of optical path, for titles; None takes those of the source.

    Returns:
        The matplotlib figure. Pixels that are not finite are grey.

    Raises:
        ShapeError: for another shape, other numbers of frequencies.
        IndexError: for an index outside.
        UnitError: for an unknown panel.
        StorageError: when the figure cannot be written.
    """
    if any(name not in SHOWS for name in show):
        raise UnitError(f"phasor_picture: expected panels out of {', '.join(SHOWS)}, got {tuple(show)}.")
    images, known = _images(source, frequencies, "phasor_picture")
    height, width = images.shape[1:]
    figure, panels = picture_figure(height, width, panels=len(show) * len(which), side=3.6, columns=len(show))
    for row, index in enumerate(which):
        values = images[index].numpy()
        for panel, name in zip(panels[row * len(show) :], show, strict=False):
            panel.set_title(_label(index, known, name), fontsize=9)
            _draw(figure, panel, name, values)
    return save_figure(figure, path, "phasor_picture")


def phasor_video(
    source: Source,
    path: str | Path,
    *,
    which: int = 0,
    steps: int = 48,
    fps: float = 24.0,
    frequencies: FrequencyAxis | Numbers | None = None,
    scale: int | None = None,
    progress: bool = False,
) -> Path:
    """Write one period of ``Re(P exp(i phi))``, the wave that modulated light makes, as a video that can be looped.

    With growing ``phi`` and phasors ``exp(-2 pi i nu opl)`` crests run from early to late pixels, as light does. Blue
    to red around zero on one symmetric scale.

    Args:
        source: phasors, complex (C, F, H, W), a result with such a ``phasor``, or its file, see :func:`phasor_picture`.
        path: file, ``.mp4`` or ``.gif``.
        which: index of the frequency.
        steps: number of frames.
        fps: frames per second.
        frequencies: cycles per metre, for the text; None takes those of the source.
        scale: screen pixels of a pixel; None for some 320 in all.
        progress: show a bar.

    Returns:
        The path.

    Raises:
        ShapeError: for another shape, other numbers of frequencies.
        IndexError: for an index outside.
        StorageError: as for ``video``.
    """
    check_video(path)
    images, known = _images(source, frequencies, "phasor_video")
    values = np.nan_to_num(images[which].numpy(), posinf=0.0, neginf=0.0)
    limit = colour_maps.symmetric_limit(np.abs(values))
    colours = grey_where_broken("RdBu_r")
    factor = max(1, round(320 / max(values.shape))) if scale is None else scale
    label = _label(which, known, "real")

    def make(index: int) -> Any:
        turned = np.real(values * np.exp(2j * math.pi * index / steps))
        shown = to_bytes(colours(0.5 + 0.5 * turned / limit)[..., :3])
        return with_strip(enlarge(shown, factor), label, (index + 1) / steps)

    return write_video(path, Frames(steps, make), steps, fps=fps, progress=progress)


def _domain_colours(values: NDArray[Any]) -> NDArray[np.float64]:
    """Return RGB (..., 3) in [0, 1]: hue by phase, red at 0, brightness by the root of the amplitude."""
    finite = np.isfinite(values)
    safe = np.where(finite, values, 0)
    amplitude = np.abs(safe)
    level = np.sqrt(amplitude / colour_maps.symmetric_limit(amplitude))
    image = colour_maps.cyclic(np.angle(safe) / (2 * math.pi), level)
    image[~finite] = 0.5
    return image


def _draw(figure: Any, panel: Any, name: str, values: NDArray[Any]) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    if name in ("real", "imaginary"):
        part = np.real(values) if name == "real" else np.imag(values)
        limit = colour_maps.symmetric_limit(part)
        image = panel.imshow(part, cmap=grey_where_broken("RdBu_r"), vmin=-limit, vmax=limit, interpolation="nearest")
        figure.colorbar(image, ax=panel, shrink=0.8)
    elif name == "amplitude":
        top = colour_maps.symmetric_limit(np.abs(values))
        colours = grey_where_broken("inferno")
        image = panel.imshow(np.abs(values), cmap=colours, vmin=0, vmax=top, interpolation="nearest")
        figure.colorbar(image, ax=panel, shrink=0.8)
    else:
        level: Any = colour_maps.cyclic(np.angle(values) / (2 * math.pi))
        if name == "phase":
            # What is as good as dark has no phase.
            amplitude = np.where(np.isfinite(values), np.abs(values), 0)
            level[amplitude <= 1e-4 * colour_maps.symmetric_limit(amplitude)] = 0.5
        panel.imshow(level if name == "phase" else _domain_colours(values), interpolation="nearest")
        bar = figure.colorbar(
            ScalarMappable(Normalize(-1, 1), colour_maps.cyclic_map()), ax=panel, shrink=0.8, label="phase"
        )
        bar.set_ticks([-1, -0.5, 0, 0.5, 1], labels=["$-\\pi$", "$-\\pi/2$", "0", "$\\pi/2$", "$\\pi$"])


def _images(source: Source, given: FrequencyAxis | Numbers | None, who: str) -> tuple[Tensor, tuple[float, ...] | None]:
    """Return images (F, H, W), summed over channels, and their frequencies, given or those of the source."""
    phasor, known = phasor_of(source, who)
    known = known if given is None else frequencies_of(given)
    if known is not None and len(known) != phasor.shape[1]:
        raise ShapeError(f"{who}: expected {phasor.shape[1]} frequencies, as the phasors have, got {len(known)}.")
    return phasor.to(torch.complex128).sum(0), known


def _label(index: int, frequencies: Sequence[float] | None, name: str) -> str:
    if frequencies is None:
        return f"{name}, frequency {index}"
    nu = frequencies[index]
    if nu == 0:
        return f"{name}, steady light"
    from matplotlib.ticker import EngFormatter

    hertz = float(f"{abs(nu) * SPEED_OF_LIGHT:.3g}")
    return f"{name}, wavelength {1 / nu:.3g} m ({EngFormatter('Hz')(hertz)})"
