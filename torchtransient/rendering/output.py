"""Result of a render: tensors with their axes, and statistics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

import torch

from torchtransient.axes import FrequencyAxis, RateAxis, TimeAxis
from torchtransient.chirps import Chirps
from torchtransient.errors import ShapeError
from torchtransient.gates import Gate
from torchtransient.rendering.error_bars import ErrorBars, ErrorCells
from torchtransient.rendering.film_layout import FilmLayout
from torchtransient.scene.variant import stokes_components
from torchtransient.tensor_record import TensorRecord

if TYPE_CHECKING:
    from torchtransient.rendering.job import RenderJob


@dataclass(frozen=True)
class RenderStats:
    """Statistics of a render.

    Attributes:
        spp: samples per pixel.
        seconds: wall time, without loading and without the wait for other threads.
        samples_per_second: camera paths per second.
        variant, integrator: names of variant and integrator.
        temporal_filter: temporal filter of the film; empty for films without one.
        seeds: one per item (entry of the batch and sensor); of a mean of passes those of all, in turn.
        energy_before, energy_after: light outside of the time axis, per item: sum over pixels of the mean over
            channels; zero for films without a window (phasors, gates). ``RenderOutput.outside`` has the shares.
        energy_total: all light of ``steady``, per item, summed in the same way.
        recorded: per item "launched", "recorded", or "traced: " and the reason.
        derivatives_recorded: the same of the derivatives since.
        max_depth: bound on the depth of the paths, -1 for no limit, None for integrators without one.
        light_beyond: share of the light in deeper paths, where a pilot run has found ``max_depth`` for derivatives of a
            scene that states none; else None. It is that of the described values: brighter ones, given or learnt, have
            the same ``max_depth`` and more light beyond it.
        sampler: plugin name of the sampler; "owen" where the scene names ``independent``, or none.
    """

    _: KW_ONLY
    spp: int
    seconds: float
    samples_per_second: float
    variant: str
    integrator: str
    temporal_filter: str
    seeds: tuple[int, ...]
    energy_before: tuple[float, ...]
    energy_after: tuple[float, ...]
    energy_total: tuple[float, ...]
    recorded: tuple[str, ...] = ()
    derivatives_recorded: list[str] = field(default_factory=list, compare=False)
    max_depth: int | None = None
    light_beyond: float | None = None
    sampler: str = ""

    @classmethod
    def of_job(cls, job: RenderJob, pixels: int) -> RenderStats:
        """Return the statistics of a job that has run.

        Args:
            job: the job, with the log of its runs.
            pixels: number of pixels of each film.
        """
        runs = job.log
        items, seconds = [item for run in runs for item in run.items], sum(run.seconds for run in runs)
        return cls(
            spp=runs[0].spp,
            seconds=seconds,
            samples_per_second=runs[0].spp * pixels * len(items) / seconds,
            variant=job.scene.variant,
            integrator=runs[0].integrator,
            temporal_filter=job.temporal_filter or "",
            seeds=tuple(item.seed for item in items),
            energy_before=tuple(energy for run in runs for energy in run.energy_before),
            energy_after=tuple(energy for run in runs for energy in run.energy_after),
            energy_total=tuple(energy for run in runs for energy in run.energy_total),
            recorded=tuple(call for run in runs for call in run.recorded),
            derivatives_recorded=job.derivative_log,
            max_depth=runs[0].max_depth,
            light_beyond=None if job.bound is None else job.bound.beyond,
            sampler=runs[0].sampler,
        )

    @classmethod
    def of_batch(cls, several: Sequence[RenderStats]) -> RenderStats:
        """Join the statistics of renders of one batch: seeds and energies in a row, times added up.

        Args:
            several: statistics of renders that were made alike.

        Raises:
            ShapeError: for renders of different samples, variants, integrators, filters or depths.
        """
        first = several[0]
        for name in ("spp", "variant", "integrator", "temporal_filter", "max_depth"):
            values = list(dict.fromkeys(getattr(stats, name) for stats in several))
            if len(values) > 1:
                raise ShapeError(
                    f"a batch of renders: expected the same {name} in all of them, got {values[0]!r} and "
                    f"{values[1]!r}. Put together their tensors alone, out.transient for instance."
                )
        seconds = sum(stats.seconds for stats in several)
        paths = sum(stats.samples_per_second * stats.seconds for stats in several)
        return replace(
            first,
            seconds=seconds,
            samples_per_second=paths / seconds,
            seeds=tuple(seed for stats in several for seed in stats.seeds),
            energy_before=tuple(energy for stats in several for energy in stats.energy_before),
            energy_after=tuple(energy for stats in several for energy in stats.energy_after),
            energy_total=tuple(energy for stats in several for energy in stats.energy_total),
            recorded=tuple(call for stats in several for call in stats.recorded),
            derivatives_recorded=[call for stats in several for call in stats.derivatives_recorded],
        )


# Fields that belong to a film: None in the output of another one.
_OF_FILMS = (
    "transient", "phasor", "gated", "rates", "beats", "slow_phasor", "axis", "frequencies", "gates", "rate_axis",
    "chirps", "slow_times",
)  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class RenderOutput(ErrorBars, TensorRecord):
    """A rendered scene. Made by renderers.

    Attributes:
        transient: float32 (C, T, H, W), radiance integrated over each bin of ``axis``, so that its sum over T is
            ``steady`` as far as the axis reaches. None, as all measurements, if the film measures something else.
        steady: float32 (C, H, W), light of all times.
        phasor: complex64 (C, F, H, W), radiance times ``exp(-2 pi i nu (opl - start_opl))`` for each of
            ``frequencies``, so that its value at zero frequency is ``steady``.
        axis: bins of optical path length of transients, rates and beats, metres.
        stats: statistics of the render.
        frequencies: frequencies of phasors, cycles per metre.
        channels: names of the C channels: 1 in monochromatic variants, the response curves of a film that has some, and
            otherwise 3 (linear sRGB).
        gates: gates of ``gated``.
        gated: float32 (C, G, H, W), the light as each gate sees it; ``steady`` is the sum over the gates.
        rates: float32 (C, R, T, H, W), the light by the bins of ``rate_axis`` and of ``axis``.
        beats: float32 (C, 2, T, H, W), expected power spectra of the beat of ``chirps``, up and down, over ``axis``.
        rate_axis: bins of the rate at which paths get longer, m/s.
        chirps: chirps of beats.
        slow_phasor: complex64 (C, S, F, H, W), phasors of ``frequencies`` at each of ``slow_times``.
        slow_times: times of slow phasors, seconds.
        others: tensors and settings of films that have no attribute here, by name.
        differences, squares, steady_differences, cells: (..., T', H', W', R), (..., T', H', W') and (..., H, W, R) of
            renders with ``errors=``: differences between independent batches of samples, mean over channels, for
            :meth:`standard_error` and :meth:`error_map`.

    Leading dimensions come in the order (batch, sensor), each present only when asked for. In polarized variants the
    Stokes components S0, S1, S2, S3 come before C in all measurements, as (4, C, T, H, W), in the sensor's frame: x to
    the right of the picture, y up, as the sensor sees it. All but ``steady`` are views of the film's own memory with
    the rows first: ``.contiguous()`` makes a copy in torch's order.

    ``to``, ``cpu``, ``detach``, ``clone`` and ``map`` make copies; ``stack`` and ``cat`` put several together, as
    ``torch.utils.data.default_collate`` does. Torch's pytrees see the tensors.
    """

    notes: ClassVar[tuple[str, ...]] = ("stats",)

    transient: torch.Tensor | None
    steady: torch.Tensor
    phasor: torch.Tensor | None
    _: KW_ONLY
    axis: TimeAxis | None
    stats: RenderStats
    frequencies: FrequencyAxis | None = None
    channels: tuple[str, ...] = ()
    gates: tuple[Gate, ...] | None = None
    gated: torch.Tensor | None = None
    rates: torch.Tensor | None = None
    beats: torch.Tensor | None = None
    rate_axis: RateAxis | None = None
    chirps: Chirps | None = None
    slow_phasor: torch.Tensor | None = None
    slow_times: tuple[float, ...] | None = None
    others: Mapping[str, Any] = field(default_factory=dict)
    differences: torch.Tensor | None = None
    squares: torch.Tensor | None = None
    steady_differences: torch.Tensor | None = None
    cells: ErrorCells | None = None

    @property
    def polarized(self) -> bool:
        """Stokes components come before the channels."""
        return stokes_components(self.stats.variant) > 1

    @property
    def outside(self) -> tuple[float, float]:
        """Shares of the light before and after the time window, over all items of the render; of polarized light of
        S0. Of a film of rates, light at other rates than those of the axis counts as after it. Zero where that light is
        not followed: without a window, and with ``steady=False``.
        """
        before, after, total = map(sum, (self.stats.energy_before, self.stats.energy_after, self.stats.energy_total))
        return (before / total, after / total) if total > 0 and before + after > 0 else (0.0, 0.0)

    @classmethod
    def merged_notes(cls, records: Sequence[RenderOutput]) -> dict[str, Any]:
        return {"stats": RenderStats.of_batch([record.stats for record in records])}

    def _shown_notes(self) -> dict[str, str]:
        stats = self.stats
        seeds = f"seed {stats.seeds[0]}" if len(stats.seeds) == 1 else f"{len(stats.seeds)} seeds"
        made = f"{stats.spp} spp in {stats.seconds:.3g} s, {stats.integrator}, {stats.variant}, {seeds}"
        outside = sum(self.outside)
        made += f", {outside:.2%} of the light outside of the window" if outside else ""
        if self.cells is not None and (found := self.relative_error()) is not None:
            made += f", sum known to {found:.2%}"
        if stats.light_beyond is not None:
            made += f", max_depth {stats.max_depth} with {stats.light_beyond:.2g} of the light beyond"
        return {"stats": made}

    @classmethod
    def of(
        cls,
        film: FilmLayout,
        steady: torch.Tensor,
        response: torch.Tensor,
        *,
        stats: RenderStats,
        channels: Sequence[str],
    ) -> RenderOutput:
        """Build the output of a film.

        Args:
            film: layout of the film.
            steady: steady image in torch's order, (..., C, H, W).
            response: the film's measurement in torch's order, such as (..., C, T, H, W).
            stats: statistics of the render.
            channels: names of the C channels.
        """
        return cls(steady=steady, stats=stats, channels=tuple(channels), **named_fields(film, response))


def named_fields(film: FilmLayout, response: torch.Tensor) -> dict[str, Any]:
    """Return a film's tensor and settings as arguments of ``RenderOutput`` and dataclasses like it.

    Args:
        film: layout of the film.
        response: tensor of the film, in torch's order.

    Returns:
        Values of all fields of films, None for those of other films; ``others`` holds quantities without a field.
    """
    found = {film.measures: response, **film.attributes()}
    named = {name: found.pop(name, None) for name in _OF_FILMS}
    return {**named, "others": found}
