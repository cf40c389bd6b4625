"""What a render returns."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchtransient.axes import FrequencyAxis, TimeAxis


@dataclass(frozen=True)
class RenderStats:
    """How a result was made.

    ``seconds`` is wall time, without loading and without the wait for other threads; ``samples_per_second``
    counts camera paths. ``energy_before`` and ``energy_after`` hold, per rendered item, the light outside the time
    axis: sum over pixels of the mean over channels; zero for a phasor film, which has no window. ``temporal_filter`` is
    empty for a phasor film. ``seeds`` are the items' seeds.
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

    ``steady``: float32 (C, H, W). Beside it, what the film measures, the other one None:

    - ``transient``: float32 (C, T, H, W), radiance integrated over each bin of ``axis``, so that its sum over T is
      ``steady`` as far as the axis reaches;
    - ``phasor``: complex64 (C, F, H, W), radiance times ``exp(-2 pi i nu (opl - start_opl))`` for each of
      ``frequencies``, so that its value at zero frequency is ``steady``.

    Leading dimensions come in the order (batch, sensor), each present only when asked for. C is 1 in monochromatic
    variants, the number of response curves of a film that has some, and 3 (linear sRGB) otherwise; ``channels`` holds
    their names. ``transient`` and ``phasor`` are views of the film's own memory with the
    rows first: ``.contiguous()`` makes a copy in torch's order.
    """

    transient: torch.Tensor | None
    steady: torch.Tensor
    phasor: torch.Tensor | None
    axis: TimeAxis | None
    stats: RenderStats
    frequencies: FrequencyAxis | None = None
    channels: tuple[str, ...] = ()


def steady_channels_first(steady: torch.Tensor, leading: tuple[int, ...]) -> torch.Tensor:
    """From the film's (H, W, C), with or without one dimension of items, to (C, H, W) behind ``leading``."""
    steady = steady.reshape(*leading, *steady.shape[-3:])
    return steady.movedim(-1, -3)


def transient_channels_first(cube: torch.Tensor, leading: tuple[int, ...]) -> torch.Tensor:
    """From the film's (H, W, T, C), with or without one dimension of items, to (C, T, H, W) behind ``leading``."""
    cube = cube.reshape(*leading, *cube.shape[-4:])
    return cube.movedim((-1, -2), (-4, -3))


def phasor_channels_first(cube: torch.Tensor, leading: tuple[int, ...]) -> torch.Tensor:
    """From the film's (H, W, F, 2 C) of real and imaginary parts to complex (C, F, H, W) behind ``leading``."""
    pairs = cube.reshape(*leading, *cube.shape[-4:-1], -1, 2)
    return torch.view_as_complex(pairs).movedim((-1, -2), (-4, -3))
