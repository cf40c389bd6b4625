"""A page in one file: its numbers in eight bits, compressed, beside the models of bokeh and `view.js`."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.array_files.part_files import replacing
from torchtransient.axes import FrequencyAxis, RateAxis, TimeAxis
from torchtransient.checks import Numbers, check_folder
from torchtransient.errors import StorageError, UnitError
from torchtransient.vis.pages.codes import PHASE, RATIO, Table, table_of
from torchtransient.vis.pages.content import Content, Planes
from torchtransient.vis.pages.kinds import binned, content_of
from torchtransient.vis.pages.layout import colour_maps, described, html_of, import_bokeh, layout_of, modes_of

# A notebook keeps what it shows in its own file.
NOTEBOOK_BYTES = 8_000_000
# Beyond it the numbers of a page fill a browser's memory.
_MOST_CODES = 250_000_000
# Parts of a content that tell how small it becomes.
_SAMPLED = 24


@dataclass(frozen=True)
class Page:
    """One HTML page that shows a result in a browser.

    Attributes:
        html: the page, which needs no other file and no network.
        notes: sentences about the error of its numbers and about what was left out.
        path: file that it was written to, None for none.
    """

    html: str
    notes: tuple[str, ...]
    path: Path | None = None

    def __repr__(self) -> str:
        where = "" if self.path is None else f", {self.path}"
        return f"Page({len(self.html) / 1e6:.1f} MB{where})"

    def _repr_html_(self) -> str:
        if len(self.html) > NOTEBOOK_BYTES:
            return f"<p>{escape(repr(self))}: too large for a notebook, open the file in a browser.</p>"
        return f'<iframe srcdoc="{escape(self.html)}" width="100%" height="760" style="border:0"></iframe>'


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
            `transient`, `phasor`, `slow_phasor`, `gated`, `rates` or `beats`; a Capture; a HiddenVolume; the path of a
            file of one of them; a tuple of two of a kind, shown as A, B and their difference; or a sequence of samples,
            of which one is shown at a time.
        path: file to write the page to, which ends in .html.
        axis, rate_axis, frequencies: axes of tensors that do not know their own. Rates (C, R, T, H, W) need
            ``rate_axis``.
        title: heading of the page.
        max_megabytes: size of the page in 10^6 bytes, at least 2. What is larger is binned over time and pixels, and
            the page says so.
        samples: number of samples of a sequence that the page holds.

    Returns:
        The page, with its notes about errors of numbers. Light is kept in 256 logarithmic steps, whole numbers up to
        65534 as they are.

    Raises:
        ShapeError: for other shapes, and results that do not fit each other.
        ArgumentError: for what is no result.
        UnitError: for ``max_megabytes`` below 2, of which the page's own scripts take most.
        StorageError: when a file cannot be read or the page not be written.
        MissingPackageError: without bokeh, the extra ``view``.
    """
    if not max_megabytes >= 2:
        raise UnitError(f"view: expected max_megabytes of at least 2, as an empty page takes, got {max_megabytes!r}.")
    target = None if path is None else check_folder(path, "view")
    if target is not None and target.suffix.lower() not in (".html", ".htm"):
        raise StorageError(f"view: expected a name that ends in .html, got '{target}'. Pictures: docs/pictures.md.")
    heading = title or (Path(x).name if isinstance(x, str | Path) else "torchtransient")
    content = content_of(x, axis=axis, rate_axis=rate_axis, frequencies=frequencies, samples=samples)
    page = _page_of(content, heading, int(max_megabytes * 1e6))
    if target is None:
        return page
    with replacing(target, "view") as unfinished:
        unfinished.write_text(page.html, encoding="utf-8")
    return replace(page, path=target)


@dataclass(frozen=True)
class Encoded:
    """Codes of a content: tables by the name of the plane, and compressed codes by entry and plane."""

    tables: dict[str, Table]
    packed: list[dict[str, bytes]]

    @property
    def size(self) -> int:
        """Bytes on the page."""
        return sum(len(packed) for planes in self.packed for packed in planes.values()) * 4 // 3


def _page_of(content: Content, title: str, max_bytes: int) -> Page:
    """Return the page of a content, binned until it fits."""
    import_bokeh()
    not_finite = _not_finite_said(content)
    room = max_bytes - 1_800_000
    content, encoded = _fitted(content, room)
    notes = (*_errors_said(content, encoded.tables), *not_finite, *content.notes)
    if encoded.size > room:
        notes += (f"The page is larger than max_megabytes={max_bytes / 1e6:g}: it cannot be binned further.",)
    maps, modes = colour_maps(), modes_of(content)
    root = layout_of(content, modes, " ".join(map(escape, notes)), title, maps)
    chunks = [
        f'<script type="text/plain" id="codes-{entry}-{name}">{base64.b64encode(packed).decode("ascii")}</script>'
        for entry, planes in enumerate(encoded.packed)
        for name, packed in planes.items()
    ]
    meta = described(content, {name: table.plain() for name, table in encoded.tables.items()}, modes, maps)
    return Page(html_of(root, title, meta | {"signed": encoded.tables["c0"].kind == "signed"}, chunks), notes)


def _fitted(content: Content, max_bytes: int) -> tuple[Content, Encoded]:
    """Codes of a content with as many bins and pixels as there is room for."""
    times = pixels = 1
    while True:
        t, h, w = (n // k for n, k in zip(content.shape, (times, pixels, pixels), strict=True))
        # Slices, frequencies and slow times are no bins of light.
        adds_up = t > 1 and content.planes[0].phase is None and content.kind not in ("gates", "volume")
        least = t * h * w <= 64 or (min(h, w) == 1 and not adds_up)
        if least or _expected(content, times, pixels) <= 1.1 * max_bytes:
            shown = content if times == pixels == 1 else binned(content, times, pixels)
            encoded = _encoded(shown)
            if encoded.size <= max_bytes or least:
                return shown, encoded
        if adds_up and (min(h, w) == 1 or (t > 64 and times <= 4 * pixels)):
            times *= 2
        else:
            pixels *= 2


def _expected(content: Content, times: int, pixels: int) -> float:
    """Bytes of a content on the page, from some of its bins."""
    bins, rows, columns = content.shape
    some = max(times, bins // _SAMPLED // times * times)
    parts = []
    number = min(8, bins // some)
    for start in ((2 * k + 1) * (bins - some) // (2 * number) for k in range(number)):
        planes = content.planes[:: max(1, len(content.planes) // _SAMPLED)]
        parts.append([part.map(lambda x, a=start: x[..., a : a + some, :, :]) for part in planes])  # type: ignore[misc]
    joined = [_joined(same) for same in zip(*parts, strict=True)]
    share = len(parts) * some * len(joined) / (bins * len(content.planes))
    slider = replace(content.slider, centers=np.arange(float(len(parts) * some)))
    sample = replace(content, planes=tuple(joined), slider=slider)
    encoded = _encoded(sample if times == pixels == 1 else binned(sample, times, pixels))
    codes = len(encoded.packed[0]) * len(content.planes) * bins * rows * columns / (times * pixels**2)
    return encoded.size / share if codes <= _MOST_CODES else float("inf")


def _joined(parts: Sequence[Planes]) -> Planes:
    """Return bins of several parts in one."""
    names = ("light", "ratios", "phase", "error")
    held = [name for name in names if all(getattr(part, name) is not None for part in parts)]
    return Planes(**{name: torch.cat([getattr(part, name) for part in parts], -3) for name in held})


def _encoded(content: Content) -> Encoded:
    tables = _tables(content)
    packed = []
    with ThreadPoolExecutor(2) as pool:
        for planes in content.planes:
            codes = _codes_of(planes, tables)
            packed.append(dict(zip(codes, pool.map(_packed, codes.values()), strict=True)))
    return Encoded(tables, packed)


def _packed(codes: NDArray[np.uint8]) -> bytes:
    # Noise has no strings that repeat: runs of zeros and short codes for frequent numbers are what there is to gain.
    packer = zlib.compressobj(1, zlib.DEFLATED, 31, 9, zlib.Z_RLE)
    return packer.compress(codes.data) + packer.flush()


def _tables(content: Content) -> dict[str, Table]:
    planes = content.planes
    light = table_of(content.quantity, [part.light for part in planes])
    tables = dict.fromkeys((f"c{k}" for k in range(len(planes[0].light))), light)
    if planes[0].ratios is not None:
        tables |= dict.fromkeys(("s1", "s2", "s3"), RATIO)
    if planes[0].phase is not None:
        tables["phase"] = PHASE
    errors = [part.error for part in planes if part.error is not None]
    if len(errors) == len(planes):
        tables["error"] = table_of("error", errors)
    return tables


def _codes_of(planes: Planes, tables: dict[str, Table]) -> dict[str, NDArray[np.uint8]]:
    return {name: tables[name].encode(plane) for name, plane in planes.named().items() if name in tables}


def _not_finite_said(content: Content) -> list[str]:
    found = torch.zeros(content.shape[1:], dtype=torch.bool)
    for planes in content.planes:
        for plane in (*planes.light, *(() if planes.ratios is None else planes.ratios)):
            found |= ~torch.isfinite(plane).all(0)
    number = int(found.sum())
    return [f"NaN or infinity in {number} of {found.numel()} pixels."] if number else []


def _errors_said(content: Content, tables: dict[str, Table]) -> list[str]:
    light = tables["c0"]
    if light.kind in ("whole", "wide"):
        said = ["Counts are exact."]
    else:
        said = [
            f"Stored in 8 bits: numbers are within {100 * light.error:.2g} % of those of the file; sizes below "
            f"{light.floor:.3g} are zero."
        ]
        if content.items == ("A", "B"):
            said.append(f"A − B is within {100 * light.error:.2g} % of |A| + |B|.")
    if "s1" in tables:
        said.append(f"Stokes components over S0 are within {RATIO.error:.2g}.")
    if "phase" in tables:
        said.append(f"Phases are within {np.degrees(PHASE.error):.2g} degrees.")
    if "error" in tables:
        said.append("Bands: two standard errors.")
    elif any(part.error is not None for part in content.planes):
        said.append("No bands of errors, which only a part of the results has.")
    return said
