"""A result in a browser: light over a slider, histograms of pixels, two results side by side."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from torchtransient.array_files.part_files import replacing
from torchtransient.axes import FrequencyAxis, RateAxis, TimeAxis
from torchtransient.checks import Numbers, check_folder, count, positive
from torchtransient.errors import UnitError
from torchtransient.vis.pages.content import content_of
from torchtransient.vis.pages.page import Page, page_of


def view(
    x: Any,
    path: str | Path | None = None,
    *,
    axis: TimeAxis | None = None,
    rate_axis: RateAxis | None = None,
    frequencies: FrequencyAxis | Numbers | None = None,
    title: str = "",
    max_megabytes: float = 20.0,
    samples: int = 8,
) -> Page:
    """Show a result as one HTML page that opens without server and network, in a notebook too.

    Args:
        x: a tensor or array (C, T, H, W), polarized (4, C, T, H, W) or complex (C, F, H, W); a result of a render with
            `transient`, `phasor`, `gated`, `rates` or `beats`; a Capture; a HiddenVolume; the path of a file of one of
            them; a tuple of two of a kind, shown as A, B and their difference; or a sequence of samples, of which one
            is shown at a time.
        path: file to write the page to.
        axis, rate_axis, frequencies: axes of tensors that do not know their own. Rates (C, R, T, H, W) need
            ``rate_axis``.
        title: heading of the page.
        max_megabytes: size of the page in 10^6 bytes, at least 2. What is larger is binned over time and pixels, and
            the page says so.
        samples: number of samples of a sequence that the page holds.

    Returns:
        The page, with its notes about errors of numbers. Light is kept in 256 logarithmic steps.

    Raises:
        ShapeError: for other shapes, and results that do not fit each other.
        ArgumentError: for what is no result.
        UnitError: for ``max_megabytes`` below 2, of which the page's own scripts take most.
        StorageError: when a file cannot be read or the page not be written.
        MissingPackageError: without bokeh, the extra ``view``.
    """
    megabytes, samples = positive("view: max_megabytes", max_megabytes), count("view: samples", samples)
    if megabytes < 2:
        raise UnitError(f"view: expected max_megabytes of at least 2, as an empty page takes, got {max_megabytes!r}.")
    target = None if path is None else check_folder(path, "view")
    heading = title or (Path(x).name if isinstance(x, str | Path) else "torchtransient")
    content = content_of(x, "view", axis=axis, rate_axis=rate_axis, frequencies=frequencies, samples=samples)
    page = page_of(content, heading, int(megabytes * 1e6))
    if target is None:
        return page
    with replacing(target, "view") as unfinished:
        unfinished.write_text(page.html, encoding="utf-8")
    return replace(page, path=target)
