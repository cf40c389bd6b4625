"""What a render returns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.gates import Gate
from torchtransient.render.films.choice import FilmChoice
from torchtransient.render.variant import stokes_components


@dataclass(frozen=True)
class RenderStats:
    """How a result was made.

    ``seconds`` is wall time, without loading and without the wait for other threads; ``samples_per_second``
    counts camera paths. ``energy_before`` and ``energy_after`` hold, per rendered item, the light outside the time
    axis: sum over pixels of the mean over channels; zero for films without a window (phasors, gates).
    ``temporal_filter`` is empty for films without one. ``seeds`` are the items' seeds.
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


# Fields that belong to a film: None in the output of another one.
_OF_FILMS = ("transient", "phasor", "gated", "axis", "frequencies", "gates")


@dataclass(frozen=True)
class RenderOutput:
    """A rendered scene.

    ``steady``: float32 (C, H, W). Beside it, what the film measures, and None for what it does not:

    - ``transient``: float32 (C, T, H, W), radiance integrated over each bin of ``axis``, so that its sum over T is
      ``steady`` as far as the axis reaches;
    - ``phasor``: complex64 (C, F, H, W), radiance times ``exp(-2 pi i nu (opl - start_opl))`` for each of
      ``frequencies``, so that its value at zero frequency is ``steady``;
    - ``gated``: float32 (C, G, H, W), the light as each of ``gates`` sees it; ``steady`` is the sum over the gates.

    Leading dimensions come in the order (batch, sensor), each present only when asked for. C is 1 in monochromatic
    variants, the number of response curves of a film that has some, and 3 (linear sRGB) otherwise; ``channels`` holds
    their names. In polarized variants the Stokes components S0, S1, S2, S3 come before C in all of them, as (4, C, T,
    H, W), in the sensor's frame: x to the right of the picture, y up, as the sensor sees it. ``transient``, ``phasor``
    and ``gated`` are views of the film's own memory with the rows first: ``.contiguous()`` makes a copy in torch's
    order. ``others``: tensors and settings of films that have no attribute here, by name.
    """

    transient: torch.Tensor | None
    steady: torch.Tensor
    phasor: torch.Tensor | None
    axis: TimeAxis | None
    stats: RenderStats
    frequencies: FrequencyAxis | None = None
    channels: tuple[str, ...] = ()
    gates: tuple[Gate, ...] | None = None
    gated: torch.Tensor | None = None
    others: Mapping[str, Any] = field(default_factory=dict)

    @property
    def polarized(self) -> bool:
        """Whether the Stokes components come before the channels."""
        return stokes_components(self.stats.variant) > 1

    @classmethod
    def of(
        cls, film: FilmChoice, steady: torch.Tensor, response: torch.Tensor, stats: RenderStats, channels: Sequence[str]
    ) -> RenderOutput:
        """The output of a film whose tensors are in torch's order already."""
        return cls(steady=steady, stats=stats, channels=tuple(channels), **named_fields(film, response))


def named_fields(film: FilmChoice, response: torch.Tensor) -> dict[str, Any]:
    """What a film measured as arguments of a dataclass like ``RenderOutput``; what has no field goes to ``others``."""
    found = {film.measures: response, **film.attributes()}
    named = {name: found.pop(name, None) for name in _OF_FILMS}
    return {**named, "others": found}
