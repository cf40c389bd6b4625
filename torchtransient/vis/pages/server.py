"""A server on this machine for results too large for a page: bins and pixels are read when they are asked for.

Its address has a random token, without which nothing is answered. Numbers are sent as the upper halves of float32.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from html import escape
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.array_files.hdf5 import hdf5_package
from torchtransient.axes import TimeAxis
from torchtransient.errors import StorageError
from torchtransient.gates import gates_from_text
from torchtransient.vis.pages.codes import light_table
from torchtransient.vis.pages.content import Content, gate_slider, light_content, slider_of
from torchtransient.vis.pages.layout import colour_maps, layout_of, modes_of
from torchtransient.vis.pages.page import described, html_of, with_script

# Bins that are looked at for the first picture.
_LOOKED_AT = 12
# Rows and columns of the picture.
_MOST_PIXELS = 600
_REQUEST = re.compile(r"/(frame|curve)/0/c([0-2])/(\d+)(?:/(\d+))?")


def cube_bytes(path: Path) -> int:
    """Return the size of the light in an HDF5 result; 0 for files of other kinds."""
    if path.suffix.lower() not in (".h5", ".hdf5") or not path.is_file():
        return 0
    with hdf5_package("view").File(path, "r") as file:
        found = [file[name].size * file[name].dtype.itemsize for name in ("transient", "gated") if name in file]
    return max(found, default=0)


class LargeResult:
    """Light (C, T, H, W) of an HDF5 result, read bin by bin. Raises StorageError for other files."""

    def __init__(self, path: Path) -> None:
        self.file = hdf5_package("view").File(path, "r")
        name = "transient" if "transient" in self.file else "gated"
        if name not in self.file or self.file[name].ndim != 4 or self.file[name].shape[0] not in (1, 3):
            raise StorageError(
                f"view: '{path}' is too large for a page, and a server shows transients (C, T, H, W) of one channel or "
                "three. Cut it, or choose one entry or channel."
            )
        self.cube = self.file[name]
        known = self.file.attrs
        axis = None
        if name == "transient" and "num_bins" in known:
            axis = TimeAxis(float(known["start_opl"]), float(known["bin_width_opl"]), int(known["num_bins"]))
        channels, bins, rows, columns = self.cube.shape
        stride = -(-max(rows, columns) // _MOST_PIXELS)
        light = torch.zeros(channels, 1, 1, 1).expand(channels, bins, -(-rows // stride), -(-columns // stride))
        if name == "gated":
            shown = light_content(light, gate_slider(bins, gates_from_text(str(known.get("gates", "")))), "gates")
        else:
            shown = light_content(light, slider_of(bins, axis, "view"))
        self.content: Content = replace(shown, stride=stride)

    def frame(self, channel: int, t: int) -> NDArray[np.uint16]:
        """Return the upper halves of the pixels that the picture shows of a bin."""
        return _upper_halves(self.cube[channel, t][:: self.content.stride, :: self.content.stride])

    def curve(self, channel: int, row: int, column: int) -> NDArray[np.uint16]:
        """Return the upper halves of a pixel, (T,)."""
        return _upper_halves(self.cube[channel, :, row, column])

    def brightest(self) -> int:
        """Return the bin of a few in which most pixels see light."""
        bins = self.cube.shape[1]
        some = sorted({int((k + 0.5) * bins / _LOOKED_AT) for k in range(_LOOKED_AT)})
        return max(some, key=lambda t: float(np.sqrt(np.abs(self.cube[0, t][::8, ::8])).sum()))


def _upper_halves(values: Any) -> NDArray[np.uint16]:
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    # Rounded to nearest; numbers that are not finite keep their bits.
    rounded = np.where(np.isfinite(bits.view(np.float32)), bits + np.uint32(0x8000), bits)
    return (rounded >> 16).astype(np.uint16)


@contextmanager
def serving(path: Path, title: str, port: int = 0) -> Iterator[tuple[ThreadingHTTPServer, str]]:
    """A server for a result and its address; `serve_forever` of it answers.

    Args:
        path: HDF5 file of a result.
        title: heading of the page.
        port: port on 127.0.0.1, 0 for a free one.
    """
    held, token = LargeResult(path), secrets.token_urlsafe(16)
    content = held.content
    modes, maps = modes_of(content, every_bin=False), colour_maps()
    notes = "Read from the file bin by bin: numbers are within 0.2 % of those of the file."
    if content.stride > 1:
        notes += (
            f" The picture has one row and column of {content.stride}, of {held.cube.shape[2]} x {held.cube.shape[3]}."
        )
    meta = described(content, {f"c{k}": light_table("light", 1.0, 0.1) for k in range(held.cube.shape[0])}, modes, maps)
    meta |= {"server": f"/{token}", "start": held.brightest()}
    page = with_script(html_of(layout_of(content, modes, escape(notes), title, maps), title), meta, []).encode()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            """Answer with the page, a bin or a pixel."""
            if not secrets.compare_digest(self.path[: len(token) + 1].encode(), f"/{token}".encode()):
                self._answer(403, b"the address lacks its token", "text/plain")
                return
            rest = self.path[len(token) + 1 :]
            if rest in ("", "/"):
                self._answer(200, page, "text/html; charset=utf-8")
                return
            asked = _REQUEST.fullmatch(rest)
            try:
                found = _asked_for(held, asked)
            except (IndexError, ValueError):
                found = None
            if found is None:
                self._answer(404, b"no such bin or pixel", "text/plain")
            else:
                self._answer(200, found.tobytes(), "application/octet-stream")

        def _answer(self, status: int, body: bytes, kind: str) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            """Keep silent."""

    with ThreadingHTTPServer(("127.0.0.1", port), Handler) as server:
        server.daemon_threads = True
        try:
            yield server, f"http://127.0.0.1:{server.server_address[1]}/{token}/"
        finally:
            held.file.close()


def _asked_for(held: LargeResult, asked: re.Match[str] | None) -> NDArray[np.uint16] | None:
    if asked is None:
        return None
    what, channel, first, second = asked.groups()
    if what == "frame" and second is None:
        return held.frame(int(channel), int(first))
    return held.curve(int(channel), int(first), int(second)) if what == "curve" and second is not None else None
