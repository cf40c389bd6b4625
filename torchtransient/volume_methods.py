"""Methods for hidden volumes by name: the scans and options that each takes.

Without torch, so that the command line lists them at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

TARGETS = ("diffuse", "retroreflective")
FILTERS = ("phasor", "laplacian")
CAMERAS = ("direct", "confocal", "transient")
# Ratio of the powers of light and noise at frequencies that a slab of foam does not damp.
SLAB_SNR = 1e4


@dataclass(frozen=True)
class Method:
    """Method for hidden volumes.

    Attributes:
        title: name in words.
        kinds: kinds of scan that the method takes.
        options: options of its own with their defaults, None for a default that follows from the capture.
        planar: the method takes only regular grids of flat walls.
        free_grid: voxels may stand anywhere.
    """

    title: str
    kinds: tuple[str, ...]
    options: Mapping[str, Any]
    planar: bool = True
    free_grid: bool = False

    @property
    def takes_legs(self) -> bool:
        """Lengths of a capture may count first and last legs."""
        return self.free_grid


def _options(**options: Any) -> Mapping[str, Any]:
    return MappingProxyType(options)


_GRIDS = ("single", "confocal", "exhaustive")
_ALL = (*_GRIDS, "pairs")
_APART = ("single", "exhaustive")
_MIGRATION = _options(target="diffuse", floor=0.0, taps=4)
_CONE = _options(target="diffuse", snr=10.0, v_bins=None)
_BAND = _options(wavelength=None, cycles=4.0, falloff=0.0)
METHODS = {
    "fk": Method("f-k migration", ("confocal",), _MIGRATION),
    "midpoint-fk": Method("f-k migration by midpoints", _APART, _MIGRATION),
    "lct": Method("light-cone transform", ("confocal",), _CONE),
    "directional-lct": Method("directional light-cone transform", ("confocal",), _options(**_CONE, taper=0.1)),
    "bp": Method("backprojection", _ALL, _options(falloff=0.0), planar=False, free_grid=True),
    "fbp": Method("filtered backprojection", _ALL, _options(**_BAND, filter="phasor"), planar=False, free_grid=True),
    "phasor": Method("phasor field", _GRIDS, _options(**_BAND, camera=None), free_grid=True),
}
# Options with the same names on the command line; a camera has `times` beside it.
SETTINGS = tuple(dict.fromkeys(name for entry in METHODS.values() for name in entry.options if name != "camera"))
