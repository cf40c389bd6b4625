"""Virtual cameras: at what moments the phasor field of a hidden scene is looked at, and how it is lit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchtransient.checks import real_array, shown
from torchtransient.errors import ShapeError, UnitError


@dataclass(frozen=True)
class DirectLight:
    """The image of light that met one voxel and nothing else: laser and sensor are focused on the voxel itself, and the
    picture is taken at the moment of focus. Volumes are (..., Z, Y, X).
    """

    @property
    def times(self) -> None:
        """No video."""
        return None

    @property
    def focuses_laser(self) -> bool:
        return True


@dataclass(frozen=True, eq=False)
class ConfocalCamera:
    """A video of voxels that laser and sensor are both focused on, ``times`` (N,) metres of optical path after the
    focus: at zero it is :class:`DirectLight`, later what else of the light came back. Volumes are (..., N, Z, Y, X).
    """

    times: Tensor

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", _times(self.times, "ConfocalCamera"))

    @property
    def focuses_laser(self) -> bool:
        return True


@dataclass(frozen=True, eq=False)
class TransientCamera:
    """A video of the pulse that leaves the laser's spot and passes through the hidden scene: ``times`` (N,) are lengths
    of optical path from the spot, so that a voxel lights up at its distance from it. Volumes are (..., N, Z, Y, X).
    Needs a scan with one spot.
    """

    times: Tensor

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", _times(self.times, "TransientCamera"))

    @property
    def focuses_laser(self) -> bool:
        return False


Camera = DirectLight | ConfocalCamera | TransientCamera


def _times(values: Any, who: str) -> Tensor:
    plain = real_array(values)
    if plain is None or plain.ndim != 1 or len(plain) == 0:
        raise ShapeError(f"{who}: expected times (N,) in metres of optical path, got {shown(values)}.")
    times = torch.from_numpy(plain)
    if not bool(torch.isfinite(times).all()):
        raise UnitError(f"{who}: expected finite times, got {shown(plain.tolist())}.")
    return times
