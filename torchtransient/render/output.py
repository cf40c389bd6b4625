"""What a render returns."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.gates import Gate
from torchtransient.render.variant import stokes_components


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

    ``steady``: float32 (C, H, W). Beside it, what the film measures:

    - ``transient``: float32 (C, T, H, W), radiance integrated over each bin of ``axis``, so that its sum over T is
      ``steady`` as far as the axis reaches;
    - ``phasor``: complex64 (C, F, H, W), radiance times ``exp(-2 pi i nu (opl - start_opl))`` for each of
      ``frequencies``, so that its value at zero frequency is ``steady``;
    - of a gated film, ``transient``: float32 (C, G, H, W), the light as each of ``gates`` sees it, and ``axis`` None;
      ``steady`` is the sum over the gates then.

    Leading dimensions come in the order (batch, sensor), each present only when asked for. C is 1 in monochromatic
    variants, the number of response curves of a film that has some, and 3 (linear sRGB) otherwise; ``channels`` holds
    their names. In polarized variants the Stokes components S0, S1, S2, S3 come before C in all three, as (4, C, T, H,
    W), in the sensor's frame: x to the right of the picture, y up, as the sensor sees it. ``transient`` and ``phasor``
    are views of the film's own memory with the rows first: ``.contiguous()`` makes a copy in torch's order.
    """

    transient: torch.Tensor | None
    steady: torch.Tensor
    phasor: torch.Tensor | None
    axis: TimeAxis | None
    stats: RenderStats
    frequencies: FrequencyAxis | None = None
    channels: tuple[str, ...] = ()
    gates: tuple[Gate, ...] | None = None

    @property
    def polarized(self) -> bool:
        """Whether the Stokes components come before the channels."""
        return stokes_components(self.stats.variant) > 1


def steady_channels_first(steady: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
    """From the film's (H, W, C), with or without one dimension of items, to (C, H, W) behind ``leading``.

    ``components``: Stokes components that the film's channels are made of; more than one come before C.
    """
    steady = steady.reshape(*leading, *steady.shape[-3:])
    return _stokes_first(steady.movedim(-1, -3), -3, components)


def transient_channels_first(cube: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
    """From the film's (H, W, T, C), with or without one dimension of items, to (C, T, H, W) behind ``leading``."""
    cube = cube.reshape(*leading, *cube.shape[-4:])
    return _stokes_first(cube.movedim((-1, -2), (-4, -3)), -4, components)


def phasor_channels_first(cube: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
    """From the film's (H, W, F, 2 C) of real and imaginary parts to complex (C, F, H, W) behind ``leading``."""
    pairs = cube.reshape(*leading, *cube.shape[-4:-1], -1, 2)
    return _stokes_first(torch.view_as_complex(pairs).movedim((-1, -2), (-4, -3)), -4, components)


def _stokes_first(tensor: torch.Tensor, channel_dim: int, components: int) -> torch.Tensor:
    return tensor if components == 1 else tensor.unflatten(channel_dim, (components, -1))
