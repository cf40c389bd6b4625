"""Which captures each method for hidden volumes takes, and which one suits a capture."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchtransient.capture import Capture, Scan
from torchtransient.checks import shown, with_article
from torchtransient.errors import ArgumentError, ShapeError
from torchtransient.reconstruction.capture_checks import not_a_capture
from torchtransient.reconstruction.planar_scan import PlanarScan
from torchtransient.volume_methods import METHODS as METHODS
from torchtransient.volume_methods import Method as Method

# Sensor points whose neighbours are looked for where points are no grid.
_LOOKED_AT = 256


@dataclass(frozen=True)
class Choice:
    """The ``name`` of a method, and the ``reason`` for it."""

    name: str
    reason: str


def choose_method(capture: Capture) -> Choice:
    """The method that suits a capture. Raises ShapeError for what is none."""
    if not isinstance(capture, Capture):
        raise ArgumentError(f"choose_method: {not_a_capture(capture)}")
    kind = capture.scan.kind
    this = with_article(kind)
    if kind == "pairs":
        return Choice("fbp", "pairs of spots and points, which only backprojection takes; the filter removes its haze")
    if not is_planar(capture.scan):
        reason = f"{this} scan whose points are not a regular grid of a flat wall, which only backprojection takes"
        return Choice("fbp", f"{reason}; the filter removes its haze")
    if kind == "confocal":
        others = "lct or phasor may show more of clean captures and of few photons (docs/nlos_reconstruction.md)"
        return Choice("fk", f"a confocal scan of a regular grid on a flat wall: it bears background; {others}")
    more = "midpoint-fk is quicker, and approximate"
    return Choice("phasor", f"{this} scan of a regular grid on a flat wall, from plane to plane; {more}")


def check_method(name: str, capture: Capture) -> Method:
    """The method of a name. Raises ArgumentError for unknown ones and for scans that it does not take."""
    if not isinstance(name, str) or name not in METHODS:
        raise ArgumentError(f"reconstruct: expected method to be one of {', '.join(METHODS)}, got {shown(name)}.")
    method, kind = METHODS[name], capture.scan.kind
    if kind not in method.kinds:
        others = ", ".join(other for other, entry in METHODS.items() if kind in entry.kinds)
        raise ArgumentError(
            f"reconstruct: method '{name}' takes {' and '.join(method.kinds)} scans, and this one is {kind}. "
            f"Take one of {others}."
        )
    if method.planar and not is_planar(capture.scan):
        raise ArgumentError(
            f"reconstruct: method '{name}' takes regular grids of points on a flat wall, and this scan is none "
            f"({capture.scan!r}). Take bp or fbp."
        )
    return method


def is_planar(scan: Scan) -> bool:
    """Whether the sensor points are a regular grid of a flat wall."""
    try:
        PlanarScan.of_scan(scan, "choose_method")
    except ShapeError:
        return False
    return True


def pitch_of(scan: Scan) -> float:
    """How far sensor points are from their neighbours, metres: that of a grid, or the mean over a list's points. Zero
    for one point.
    """
    if is_planar(scan):
        return max(PlanarScan.of_scan(scan, "pitch_of").pitch)
    points = scan.sensor_points.detach().cpu().reshape(-1, 3)
    some = points[:: max(1, len(points) // _LOOKED_AT)]
    distances = torch.cdist(some, points)
    # A point is no neighbour of itself, nor of another visit.
    apart = torch.where(distances > 0, distances, torch.inf).amin(1)
    apart = apart[torch.isfinite(apart)]
    return float(apart.mean()) if len(apart) else 0.0


def default_wavelength(capture: Capture) -> float:
    """The shortest wavelength, metres of optical path, that shows no ghosts and that the bins hold: two pitches of
    the sensor points, four of confocal scans and of pairs, where the laser moves with the sensor, and four bins at
    least.

    Raises ShapeError for a capture without a transient.
    """
    if capture.axis is None:
        raise ShapeError("reconstruct: expected a capture with a transient, got phasors alone.")
    turns = 4.0 if capture.scan.kind in ("confocal", "pairs") else 2.0
    return max(turns * pitch_of(capture.scan), 4 * capture.axis.bin_width_opl)
