"""A server on this machine for results too large for a page: bins and pixels are read when they are asked for.

Its address has a random token, without which nothing is answered. Numbers are sent as the upper halves of float32.
Nothing here imports torch, which takes longer than to open the file.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.array_files.hdf5 import hdf5_package
from torchtransient.errors import StorageError
from torchtransient.gates import gates_from_text
from torchtransient.vis.pages.content import (
    Content,
    Planes,
    Slider,
    bin_slider,
    frequency_slider,
    gate_slider,
    time_slider,
)  # fmt: skip
from torchtransient.vis.pages.layout import colour_maps, described, html_of, layout_of, modes_of

# Bins that are looked at for the first picture.
_LOOKED_AT = 12
# Rows and columns of the picture.
_MOST_PIXELS = 600
_SHOWN = ("transient", "phasor", "gated")
_REQUEST = re.compile(r"/(frame|curve)/0/(c[0-2]|s[1-3]|phase)/(\d+)(?:/(\d+))?")


def cube_bytes(path: Path) -> int:
    """Return the bytes of the light in an HDF5 result; 0 for files of other kinds.

    Args:
        path: the file.
    """
    if path.suffix.lower() not in (".h5", ".hdf5") or not path.is_file():
        return 0
    with hdf5_package("view").File(path, "r") as file:
        return max((file[name].nbytes for name in _SHOWN if name in file), default=0)


class LargeResult:
    """Light of an HDF5 result, read bin by bin: a transient or gates (C, T, H, W), the same polarized (4, C, T, H, W),
    or phasors (C, F, H, W).

    Raises:
        StorageError: for other files.
    """

    def __init__(self, path: Path) -> None:
        try:
            self.file = hdf5_package("view").File(path, "r")
        except OSError as error:
            raise StorageError(f"view: '{path}' could not be read as HDF5: {error}") from error
        name = next((name for name in _SHOWN if name in self.file), "")
        shape: tuple[int, ...] = self.file[name].shape if name else ()
        self._polarized = len(shape) == 5 and shape[0] == 4
        self._complex = name == "phasor"
        good = len(shape) == 4 and (self._complex or shape[0] in (1, 3))
        if not (good or (self._polarized and not self._complex)) or 0 in shape:
            raise StorageError(
                f"view: '{path}' has no light that a server reads bin by bin: a transient or gates (C, T, H, W) of one "
                f"channel or three, polarized (4, C, T, H, W), or phasors (C, F, H, W); found {name or 'none'} "
                f"{tuple(shape)}. Show it as a page, torchtransient view -o page.html, or choose one entry or channel."
            )
        self.cube = self.file[name]
        bins, rows, columns = shape[-3:]
        self._stride = -(-max(rows, columns) // _MOST_PIXELS)
        self._peaks: bytes | None = None
        self._lock = Lock()
        channels = 1 if self._polarized or self._complex else shape[0]
        size = (bins, -(-rows // self._stride), -(-columns // self._stride))
        nothing: Any = np.broadcast_to(np.float32(0), (3, *size))
        planes = Planes(
            nothing[:channels], ratios=nothing if self._polarized else None, phase=nothing[0] if self._complex else None
        )
        kind = {"phasor": "phasors", "gated": "gates"}.get(name, "polarized" if self._polarized else name)
        quantity = {"phasor": "amplitude", "gated": "radiance through a gate"}.get(name, "radiance in a bin")
        slider = self._slider(name, bins)
        self.content = Content(kind, slider, ("",), ("",), (planes,), quantity=quantity, stride=self._stride)

    def _slider(self, name: str, bins: int) -> Slider:
        known = self.file.attrs
        if name == "phasor":
            row = self.file.get("frequencies_per_metre")
            return frequency_slider(None if row is None or row.shape != (bins,) else row[()].tolist(), bins)
        if name == "gated":
            return gate_slider(bins, gates_from_text(str(known["gates"])) if "gates" in known else None)
        if "num_bins" not in known:
            return bin_slider(bins)
        if int(known["num_bins"]) != bins:
            raise StorageError(f"view: the file's axis has {known['num_bins']} bins, its light {bins}.")
        start, width = float(known["start_opl"]), float(known["bin_width_opl"])
        return time_slider(start + (np.arange(bins, dtype=np.float64) + 0.5) * width)

    def frame(self, plane: str, t: int) -> NDArray[np.uint16]:
        """Return the upper halves of the pixels that the picture shows of a bin.

        Args:
            plane: name of the plane, see ``Planes.named``.
            t: number of the bin.
        """
        return _upper_halves(self._numbers(plane, (t,))[..., :: self._stride, :: self._stride])

    def curve(self, plane: str, row: int, column: int) -> NDArray[np.uint16]:
        """Return the upper halves of a pixel, (T,).

        Args:
            plane: name of the plane.
            row, column: place of the pixel in the file's light.
        """
        return _upper_halves(self._numbers(plane, (slice(None), row, column)))

    def _numbers(self, plane: str, where: tuple[Any, ...]) -> NDArray[Any]:
        """Numbers of a plane, ``where`` of its (T, H, W)."""
        if self._complex:
            mean = self.cube[(slice(None), *where)].mean(0)
            return np.asarray(np.angle(mean) if plane == "phase" else np.abs(mean))
        if not self._polarized:
            return np.asarray(self.cube[(int(plane[1]), *where)])
        s0 = self.cube[(0, slice(None), *where)].mean(0)
        if plane == "c0":
            return np.asarray(s0)
        part = self.cube[(int(plane[1]), slice(None), *where)].mean(0)
        return np.asarray(np.divide(part, s0, out=np.zeros_like(part), where=s0 > 0))

    def peaks(self) -> bytes:
        """Return centres of the brightest bins and sums over all bins of the picture's pixels, float32. Reads the file
        once from its beginning to its end.
        """
        with self._lock:
            if self._peaks is None:
                size, channels = self.content.shape[1:], len(self.content.planes[0].light)
                peak, most, total = np.full(size, np.nan), np.zeros(size), np.zeros(size)
                for t, center in enumerate(self.content.slider.centers):
                    shown = [self._numbers(f"c{k}", (t,))[:: self._stride, :: self._stride] for k in range(channels)]
                    light: NDArray[np.float64] = np.asarray(np.mean(shown, 0, dtype=np.float64))
                    higher = light > most
                    most[higher], peak[higher] = light[higher], center
                    total += light
                peak[~np.isfinite(total)] = np.nan
                self._peaks = np.stack([peak, total]).astype(np.float32).tobytes()
            return self._peaks

    def brightest(self) -> int:
        """Return the bin of a few in which most pixels see light."""
        bins = self.content.shape[0]
        some = sorted({int((k + 0.5) * bins / _LOOKED_AT) for k in range(_LOOKED_AT)})
        return max(some, key=lambda t: float(np.sqrt(np.abs(self._numbers("c0", (t,))[::8, ::8])).sum()))


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
    modes, maps = modes_of(content), colour_maps()
    notes = "Read from the file bin by bin: numbers are within 0.2 % of those of the file."
    rows, columns = held.cube.shape[-2:]
    if content.stride > 1:
        notes += f" The picture has one row and column of {content.stride}, of {rows} x {columns}."
    if "peak" in modes:
        notes += " Peak time and rainbow read the whole file first."
    names = content.planes[0].named()
    meta = described(content, {name: [] for name in names}, modes, maps)
    meta |= {"server": f"/{token}", "start": held.brightest(), "signed": False}
    page = html_of(layout_of(content, modes, escape(notes), title, maps, sums=False), title, meta).encode()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            """Answer with the page, a bin, a pixel or the peaks."""
            if not secrets.compare_digest(self.path[: len(token) + 1].encode(), f"/{token}".encode()):
                self._answer(403, b"the address lacks its token", "text/plain")
                return
            rest = self.path[len(token) + 1 :]
            if rest in ("", "/"):
                self._answer(200, page, "text/html; charset=utf-8")
                return
            asked = _REQUEST.fullmatch(rest)
            try:
                if rest == "/peaks" and "peak" in modes:
                    found = held.peaks()
                elif asked is not None and asked[2] in names:
                    found = _asked_for(held, asked)
                else:
                    found = b""
            except (IndexError, ValueError):
                found = b""
            if found:
                self._answer(200, found, "application/octet-stream")
            else:
                self._answer(404, b"no such bin or pixel", "text/plain")

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


def _asked_for(held: LargeResult, asked: re.Match[str]) -> bytes:
    what, plane, first, second = asked.groups()
    if what == "frame":
        return held.frame(plane, int(first)).tobytes() if second is None else b""
    return b"" if second is None else held.curve(plane, int(first), int(second)).tobytes()
