"""A page in one file: its numbers in eight bits, compressed, beside the models of bokeh and `view.js`."""

from __future__ import annotations

import base64
import json
import zlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.vis.pages.codes import PHASE, RATIO, Table, light_table, table_of
from torchtransient.vis.pages.content import Content, Planes, binned
from torchtransient.vis.pages.layout import colour_maps, import_bokeh, layout_of, modes_of

_SCRIPT = Path(__file__).with_name("view.js")
# A notebook keeps what it shows in its own file.
NOTEBOOK_BYTES = 8_000_000
# Beyond it the numbers of a page fill a browser's memory.
_MOST_CODES = 250_000_000
_RATIOS = ("s1", "s2", "s3")


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


@dataclass(frozen=True)
class Encoded:
    """Codes of a content: tables by the name of the plane, and compressed codes by entry and plane."""

    tables: dict[str, Table]
    packed: list[dict[str, bytes]]

    @property
    def size(self) -> int:
        """Bytes on the page."""
        return sum(len(packed) for planes in self.packed for packed in planes.values()) * 4 // 3


def page_of(content: Content, title: str, max_bytes: int) -> Page:
    """Return the page of a content, binned until it has at most ``max_bytes``."""
    import_bokeh()
    from bokeh.embed import file_html
    from bokeh.resources import INLINE

    content, encoded = _fitted(content, max_bytes - 2_000_000)
    notes = (*_errors_said(content, encoded.tables), *content.notes)
    maps, modes = colour_maps(), modes_of(content)
    root = layout_of(content, modes, " ".join(map(escape, notes)), title, maps)
    html = file_html(root, INLINE, title=title)
    chunks = [
        f'<script type="text/plain" id="codes-{entry}-{name}">{base64.b64encode(packed).decode("ascii")}</script>'
        for entry, planes in enumerate(encoded.packed)
        for name, packed in planes.items()
    ]
    meta = described(content, encoded.tables, modes, maps)
    return Page(with_script(html, meta, chunks), notes)


def with_script(html: str, meta: dict[str, Any], chunks: list[str]) -> str:
    """Return a page of bokeh with the page's own script and numbers before its end."""
    head, end, rest = html.rpartition("</body>")
    said = json.dumps(meta).replace("</", "<\\/")
    script = _SCRIPT.read_text(encoding="utf-8")
    data = f'<script type="application/json" id="meta">{said}</script>'
    return "\n".join([head, data, *chunks, f"<script>\n{script}\n</script>", end + rest])


def described(content: Content, tables: dict[str, Table], modes: dict[str, str], maps: dict[str, Any]) -> dict[str, Any]:
    """Return what `view.js` has to know, as plain data."""
    slider = content.slider
    return {
        "kind": content.kind, "shape": content.shape, "items": len(content.items), "layers": len(content.layers),
        "layerNumbers": content.layer_numbers, "layerGrid": content.layer_grid, "marks": content.marks,
        "channels": content.planes[0].light.shape[0], "extent": content.extent, "quantity": content.quantity,
        "slider": {
            "name": slider.name, "unit": slider.unit, "centers": slider.centers.tolist(), "second": slider.second,
            "secondUnit": slider.second_unit, "factor": slider.factor,
        },
        "tables": {name: [None if not np.isfinite(v) else float(v) for v in table.values] for name, table in tables.items()},
        "pair": content.items == ("A", "B"), "signed": tables["c0"].kind == "signed", "modes": list(modes), "maps": maps,
    }  # fmt: skip


def _fitted(content: Content, max_bytes: int) -> tuple[Content, Encoded]:
    """Codes of a content with as many bins and pixels as there is room for."""
    times = pixels = 1
    entries = len(content.planes) * len(_codes_of(content.planes[0], _tables(content, first=True), 1))
    while True:
        shown = content if times == pixels == 1 else binned(content, times, pixels)
        t, h, w = shown.shape
        if t * h * w * entries <= _MOST_CODES:
            tables = _tables(shown)
            encoded = Encoded(tables, [])
            with ThreadPoolExecutor(2) as pool:
                for planes in shown.planes:
                    codes = _codes_of(planes, tables)
                    packed = pool.map(_packed, codes.values())
                    encoded.packed.append(dict(zip(codes, packed, strict=True)))
                    if encoded.size > max_bytes:
                        break
            if encoded.size <= max_bytes or t * h * w <= 64:
                return shown, encoded
        if t > 64 and shown.planes[0].phase is None and times <= 4 * pixels:
            times *= 2
        else:
            pixels *= 2


def _packed(codes: NDArray[np.uint8]) -> bytes:
    packer = zlib.compressobj(1, zlib.DEFLATED, 31)
    return packer.compress(np.ascontiguousarray(codes)) + packer.flush()


def _tables(content: Content, first: bool = False) -> dict[str, Table]:
    planes = content.planes[:1] if first else content.planes
    light = light_table("light", 1.0, 1e-3) if first else table_of(content.quantity, [part.light for part in planes])
    tables = {f"c{k}": light for k in range(planes[0].light.shape[0])}
    if planes[0].ratios is not None:
        tables |= dict.fromkeys(_RATIOS, RATIO)
    if planes[0].phase is not None:
        tables["phase"] = PHASE
    if planes[0].error is not None:
        tables["error"] = light if first else table_of("error", [part.error for part in planes if part.error is not None])
    return tables


def _codes_of(planes: Planes, tables: dict[str, Table], bins: int | None = None) -> dict[str, NDArray[np.uint8]]:
    """Codes by plane. Channels behind the first are stored as differences of codes, which are small."""
    codes = {f"c{k}": tables[f"c{k}"].encode(light[:bins]) for k, light in enumerate(planes.light)}
    for name in list(codes)[1:]:
        codes[name] -= codes["c0"]
    if planes.ratios is not None:
        codes |= {name: RATIO.encode(part[:bins]) for name, part in zip(_RATIOS, planes.ratios, strict=True)}
    if planes.phase is not None:
        codes["phase"] = PHASE.encode(planes.phase[:bins])
    if planes.error is not None:
        codes["error"] = tables["error"].encode(planes.error[:bins])
    return codes


def _errors_said(content: Content, tables: dict[str, Table]) -> list[str]:
    light = tables["c0"]
    if light.kind == "whole":
        said = ["Counts are exact."]
    else:
        said = [
            f"Stored in 8 bits: numbers are within {100 * light.error:.2g} % of those of the file; sizes below "
            f"{light.floor:.3g} are zero."
        ]
    if "s1" in tables:
        said.append(f"Stokes components over S0 are within {RATIO.error:.2g}.")
    if "phase" in tables:
        said.append(f"Phases are within {np.degrees(PHASE.error):.2g} degrees.")
    if "error" in tables:
        said.append("Bands: two standard errors.")
    return said
