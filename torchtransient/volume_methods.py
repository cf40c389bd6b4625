"""Methods for hidden volumes by name: which scans and options each takes. The one list, without torch, so that the
command line reads it too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

TARGETS = ("diffuse", "retroreflective")
FILTERS = ("phasor", "laplacian")
CAMERAS = ("direct", "confocal", "transient")
# Power of the light over that of the noise where a slab of foam lost none.
SLAB_SNR = 1e4


@dataclass(frozen=True)
class Method:
    """``kinds`` of scan that it takes, ``planar``: only regular grids of flat walls; ``options`` of its own with their
    defaults, None for what follows from the capture; whether voxels stand where whoever calls wants them
    (``free_grid``), and whether lengths may count first and last legs.
    """

    title: str
    kinds: tuple[str, ...]
    options: Mapping[str, Any]
    planar: bool = True
    free_grid: bool = False

    @property
    def takes_legs(self) -> bool:
        return self.free_grid


def _of(**options: Any) -> Mapping[str, Any]:
    return MappingProxyType(options)


_GRIDS = ("single", "confocal", "exhaustive")
_ALL = (*_GRIDS, "pairs")
_APART = ("single", "exhaustive")
_MIGRATION = _of(target="diffuse", floor=0.0, taps=4)
_CONE = _of(target="diffuse", snr=10.0, v_bins=None)
_BAND = _of(wavelength=None, cycles=4.0, falloff=0.0)
METHODS = {
    "fk": Method("f-k migration", ("confocal",), _MIGRATION),
    "midpoint-fk": Method("f-k migration by midpoints", _APART, _MIGRATION),
    "lct": Method("light-cone transform", ("confocal",), _CONE),
    "directional-lct": Method("directional light-cone transform", ("confocal",), _of(**_CONE, taper=0.1)),
    "bp": Method("backprojection", _ALL, _of(falloff=0.0), planar=False, free_grid=True),
    "fbp": Method("filtered backprojection", _ALL, _of(**_BAND, filter="phasor"), planar=False, free_grid=True),
    "phasor": Method("phasor field", _GRIDS, _of(**_BAND, camera=None), free_grid=True),
}
# Options that are said by the same names on the command line; a camera has `times` beside it.
SETTINGS = tuple(dict.fromkeys(name for entry in METHODS.values() for name in entry.options if name != "camera"))
