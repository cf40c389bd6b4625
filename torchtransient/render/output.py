"""What a render returns."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchtransient.axes import TimeAxis
from torchtransient.render.variant import stokes_components


@dataclass(frozen=True)
class RenderStats:
    """How a result was made.

    ``seconds`` is wall time, without loading and without the wait for other threads; ``samples_per_second``
    counts camera paths. ``energy_before`` and ``energy_after`` hold, per rendered item, the light outside the time
    axis: sum over pixels of the mean over channels. ``seeds`` are the items' seeds.
    """

    spp: int
    seconds: float
    samples_per_second: float
    variant: str
    integrator: str
    temporal_filter: str
    seeds: tuple[int, ...]
    energy_before: tuple[float, ...]
    energy_after: tuple[float, ...]


@dataclass(frozen=True)
class RenderOutput:
    """A rendered scene.

    ``transient``: float32 (C, T, H, W), radiance integrated over each bin, so that its sum over T is ``steady`` (C,
    H, W) as far as the axis reaches. Leading dimensions come in the order (batch, sensor), each present only when
    asked for. C is 1 in monochromatic variants and 3 (linear sRGB) otherwise. In polarized variants the Stokes
    components S0, S1, S2, S3 come before C: (4, C, T, H, W) and (4, C, H, W), in the sensor's frame (x to the right of
    the picture, y up, as the sensor sees it). ``phasor`` is None: phasor films are
    not supported yet. ``transient`` is a view of the film's own memory in the order (H, W, T, C): ``.contiguous()``
    makes a copy in torch's order.
    """

    transient: torch.Tensor
    steady: torch.Tensor
    phasor: torch.Tensor | None
    axis: TimeAxis
    stats: RenderStats

    @property
    def polarized(self) -> bool:
        """Whether the Stokes components come before the channels."""
        return stokes_components(self.stats.variant) > 1


def channels_first(
    steady: torch.Tensor, transient: torch.Tensor, leading: tuple[int, ...], components: int = 1
) -> tuple[torch.Tensor, torch.Tensor]:
    """From the film's layout, with or without one dimension of items, to torch's with the ``leading`` dimensions.

    ``components``: Stokes components that the film's channels consist of; more than one get a dimension of their own.
    """
    steady = steady.reshape(*leading, *steady.shape[-3:])
    transient = transient.reshape(*leading, *transient.shape[-4:])
    if components > 1:
        steady, transient = steady.unflatten(-1, (components, -1)), transient.unflatten(-1, (components, -1))
    n = len(leading)
    lead = tuple(range(n))
    return (
        steady.permute(*lead, *range(n + 2, steady.ndim), n, n + 1),
        transient.permute(*lead, *range(n + 3, transient.ndim), n + 2, n, n + 1),
    )
