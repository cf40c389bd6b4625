"""Content of a page: light over a slider, a picture for each of its positions, of one thing or several of a kind.

Nothing here imports torch: the server of large files starts without it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from torchtransient.gates import Gate
from torchtransient.units import SPEED_OF_LIGHT

if TYPE_CHECKING:
    from torch import Tensor

_NS_PER_METRE = 1e9 / SPEED_OF_LIGHT


@dataclass(frozen=True)
class Slider:
    """Positions of the slider.

    Attributes:
        name, unit: name and unit of the quantity along it.
        centers: values of the quantity at the positions, (T,) float64.
        second, second_unit, factor: another quantity, ``factor`` times the first; empty for none.
        labels: texts of the positions, such as a gate from its start to its end; empty for centers alone.
    """

    name: str
    unit: str
    centers: NDArray[np.float64]
    second: str = ""
    second_unit: str = ""
    factor: float = 1.0
    labels: tuple[str, ...] = ()


@dataclass(frozen=True)
class Planes:
    """Numbers of one entry of a page, each tensor (..., T, H, W) on the CPU.

    Attributes:
        light: light (K, T, H, W), K = 1 or 3.
        ratios: S1, S2 and S3 over S0, (3, T, H, W).
        phase: phase (T, H, W), radians.
        error: standard errors of the mean over channels, (T, H, W).
    """

    light: Tensor
    ratios: Tensor | None = None
    phase: Tensor | None = None
    error: Tensor | None = None

    def named(self) -> dict[str, Tensor]:
        """Return the planes (T, H, W) by the names that pages give them."""
        found = {f"c{k}": channel for k, channel in enumerate(self.light)}
        if self.ratios is not None:
            found |= dict(zip(("s1", "s2", "s3"), self.ratios, strict=True))
        found |= {} if self.phase is None else {"phase": self.phase}
        return found | ({} if self.error is None else {"error": self.error})

    def map(self, function: Callable[[Tensor], Tensor]) -> Planes:
        """Return the planes with a function applied to each tensor.

        Args:
            function: function of one tensor (..., T, H, W).
        """
        parts = (self.light, self.ratios, self.phase, self.error)
        light, *others = (None if part is None else function(part) for part in parts)
        assert light is not None
        return Planes(light, *others)


@dataclass(frozen=True)
class Content:
    """Content of a page.

    Attributes:
        kind: "transient", "gates", "polarized", "phasors", "slow phasors", "rates", "beats", "capture" or "volume".
        slider: positions of the slider.
        items: names of results or samples.
        layers: names of rates, chirps, frequencies or laser spots, one empty name without any.
        planes: an entry for each item and layer, layers last.
        quantity: quantity of the numbers.
        layer_name: name of what differs between layers.
        layer_numbers: centres of rates, m/s, empty for other layers.
        layer_grid: rows and columns of laser spots, empty for other layers.
        extent: left, right, lower and upper end of the picture in ``unit``; row 0 is at the lower end.
        unit: "m", or "pixels".
        marks: points on the picture, such as the laser's.
        notes: sentences about what was left out.
        stride: rows and columns of the result from one pixel of the picture to the next.
        block: rows and columns of the result that a pixel is the mean of.
    """

    kind: str
    slider: Slider
    items: tuple[str, ...]
    layers: tuple[str, ...]
    planes: tuple[Planes, ...]
    quantity: str = "radiance in a bin"
    layer_name: str = ""
    layer_numbers: tuple[float, ...] = ()
    layer_grid: tuple[int, int] | tuple[()] = ()
    extent: tuple[float, float, float, float] | None = None
    unit: str = "pixels"
    marks: tuple[tuple[float, float], ...] = ()
    notes: tuple[str, ...] = field(default_factory=tuple)
    stride: int = 1
    block: int = 1

    @property
    def shape(self) -> tuple[int, int, int]:
        """Positions, rows, columns."""
        t, h, w = self.planes[0].light.shape[1:]
        return t, h, w


def time_slider(centers_opl: NDArray[np.float64]) -> Slider:
    """Return the slider of bins of time.

    Args:
        centers_opl: centres of the bins, (T,), metres of optical path.
    """
    return Slider("optical path length", "m", centers_opl, "time", "ns", _NS_PER_METRE)


def bin_slider(bins: int) -> Slider:
    """Return the slider of bins of unknown time.

    Args:
        bins: number of bins.
    """
    return Slider("bin", "", np.arange(bins, dtype=np.float64))


def gate_slider(count: int, gates: Sequence[Gate] | None) -> Slider:
    """Return the slider of gates, which count where they are not known.

    Args:
        count: number of gates.
        gates: the gates.
    """
    labels = tuple(f"{gate.start_opl:.4g} to {gate.end_opl:.4g} m" for gate in gates or ())
    return Slider("gate", "", np.arange(count, dtype=np.float64), labels=labels)


def frequency_slider(frequencies_per_metre: Sequence[float] | None, count: int) -> Slider:
    """Return the slider of frequencies, which count where they are not known.

    Args:
        frequencies_per_metre: cycles per metre.
        count: number of frequencies.
    """
    if frequencies_per_metre is None:
        return Slider("frequency", "", np.arange(count, dtype=np.float64))
    return Slider("frequency", "/m", np.array(frequencies_per_metre), "frequency", "GHz", SPEED_OF_LIGHT / 1e9)
