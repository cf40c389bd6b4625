"""Jobs of an integrator, their kernel launches, and the incoming adjoint."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.checks import as_whole, shown
from torchtransient.errors import GradientError, TorchTransientWarning, UnitError
from torchtransient.plugins.frozen_state import state_below

# Lanes of one kernel launch. Larger jobs run in several passes, which keeps a progress bar moving and indices in 32
# bits.
MAX_LANES = 2**26


@dataclass
class Pass:
    """Kernel launch: ``spp`` of ``total`` samples per pixel for some rows of one storage band.

    Attributes:
        band: number of the storage band.
        first_row, rows: first row of the film, number of rows.
        spp: samples per pixel of the launch.
        total: samples per pixel of all launches.
        seed: UInt32 in memory; a number would be a literal of the kernel.
    """

    band: int
    first_row: int
    rows: int
    spp: int
    total: int
    seed: Any


@dataclass
class Job:
    """Render, as estimators with samples of their own receive it.

    Attributes:
        passes: launches of the paths.
        seed: seed of the job, UInt32.
        samples: largest number of samples of a pixel.
        progress: function of the share that is done, or None.
    """

    passes: list[Pass]
    seed: Any
    samples: int
    progress: Any


def laser_count(film: Any) -> int:
    """Return the number of laser positions of every pixel of a film, 1 but for exhaustive scans.

    Args:
        film: film of this library.
    """
    return film.laser_count() if film.exhaustive_scan else 1


def passes_of(
    sampler: Any, film: Any, seed: Any, spp: int, most_events: int, record_lanes: int | None = None
) -> tuple[list[Pass], int]:
    """Divide a job into launches.

    Some samplers round the number of samples of a launch, so that storage bands of different heights may get different
    totals.

    Args:
        sampler: sampler of the sensor, whose sample count is changed.
        film: film of the sensor.
        seed: seed of the job, whole number or UInt32.
        spp: samples per pixel, 0 for the sampler's own number.
        most_events: largest number of events of a path.
        record_lanes: largest number of paths of a launch whose records fit into memory, None for any.

    Returns:
        (launches, largest number of samples of a pixel).

    Raises:
        GradientError: if ``record_lanes`` is less than a row of the film.
    """
    if spp:
        sampler.set_sample_count(spp)
    spp = sampler.sample_count()
    width = int(film.crop_size()[0]) * laser_count(film)
    most = min(MAX_LANES, film.lanes_at_most(most_events) or MAX_LANES, record_lanes or MAX_LANES)
    if record_lanes is not None:
        _check_row(width, record_lanes)
    result = []
    for band, (first_row, rows) in enumerate(film.band_layout()):
        counts = _launch_counts(sampler, spp, max(1, most // (width * rows)))
        # Samplers may round up to more samples than fit for all rows.
        rows_per_pass = min(rows, max(1, most // (width * max(counts))))
        for row in range(first_row, first_row + rows, rows_per_pass):
            some = min(rows_per_pass, first_row + rows - row)
            result += [Pass(band, row, some, count, sum(counts), None) for count in counts]
    for i, p in enumerate(result):
        p.seed = _seed_of_pass(seed, i, len(result))
    return result, max(p.total for p in result)


def _check_row(width: int, lanes: int) -> None:
    if width > lanes:
        raise GradientError(
            f"gradients keep a record of every bounce, and with this max_depth there is memory for those of {lanes} "
            f"paths at once: expected films at most so wide (times the laser positions), got {width}. Set max_depth to "
            "where the throughput that remains no longer matters, or crop the film."
        )


def _seed_of_pass(seed: Any, number: int, count: int) -> Any:
    # A single pass keeps the user's seed, so results agree with those of Mitsuba's convention.
    if count == 1:
        return seed_array(seed)
    if dr.is_array_v(seed):
        return mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(number))[0]
    # Of a number it is known here, without a kernel of its own.
    return seed_array(int(mi.sample_tea_32(mi.UInt32(_whole(seed)), mi.UInt32(number))[0][0]))


def seed_array(seed: Any) -> Any:
    """Return a seed as UInt32 in memory.

    Args:
        seed: array of one, or a whole number, of which the lowest 32 bits count, with a warning.

    Raises:
        UnitError: for other numbers.
    """
    return mi.UInt32(seed) if dr.is_array_v(seed) else dr.opaque(mi.UInt32, _whole(seed))


def _whole(seed: Any) -> int:
    number = as_whole(seed)
    if number is None:
        raise UnitError(f"seed: expected a whole number, got {shown(seed)}.")
    if not 0 <= number < 2**32:
        warnings.warn(
            f"seed: expected whole numbers from 0 to 2^32 - 1, got {shown(seed)}, which counts as {number % 2**32}: "
            "seeds count modulo 2^32.",
            TorchTransientWarning,
            stacklevel=2,
        )
    return number % 2**32


def _launch_counts(sampler: Any, spp: int, most: int) -> list[int]:
    """Return the samples per pixel of the launches that make up ``spp``, at most ``most`` each.

    Samplers such as multijitter or ldsampler round a number up; a pixel is divided by the number that they draw.
    """

    def drawn(count):
        logger = mi.logger()
        level = logger.log_level()
        # A number that is tried is no user's.
        logger.set_log_level(mi.LogLevel.Error)
        try:
            sampler.set_sample_count(count)
        finally:
            logger.set_log_level(level)
        return sampler.sample_count()

    if spp <= most:
        return [drawn(spp)]
    while most > 1 and drawn(most) > most:
        # Rounding up would exceed the launch; the sampler takes some smaller number.
        most -= max(1, most // 16)
    counts = []
    while (left := spp - sum(counts)) > 0:
        counts.append(drawn(min(most, left)))
    return counts


def share_of(progress: Any, part: int, count: int) -> Any:
    """Return the progress function of one of several parts of a job, None without one.

    Args:
        progress: function of the share of the job that is done, or None.
        part: number of the part.
        count: number of parts.
    """
    return progress and (lambda done: progress((part + done) / count))


# --------------------------------------------------------------------------------------------------------------------
# A job of an integrator whose look-ups, checks and tables are made: what is left is a function of arrays.

@dataclass
class Prepared:
    """Render, or derivative of one, with all look-ups, checks and tables done: a function of arrays is left.

    Made outside of recorded code by :meth:`~.base.TransientIntegrator.prepared`, executed by
    :meth:`~.base.TransientIntegrator.run`.

    Attributes:
        kind: one of :data:`~torchtransient.interfaces.JOBS`.
        integrator, scene, sensor, film: plugins of the job.
        context: :class:`~..transport.context.RenderContext` of its paths, with the wanted derivatives.
        launches: the :class:`Pass` of its paths.
        seed: seed of the job, UInt32.
        samples: largest number of samples of a pixel.
        incoming: :class:`IncomingAdjoint` in reverse mode.
        beside: terms of the derivative that paths do not have, see :meth:`~.base.TransientIntegrator.beside`.
        plugins: plugins of the scene that are written in Python, whose numbers become part of the kernels.
        refusal: reason why the job cannot be recorded, None if it can.
    """

    kind: str
    integrator: Any
    scene: Any
    sensor: Any
    film: Any
    context: Any
    launches: list[Any]
    seed: Any
    samples: int
    incoming: Any = None
    beside: list[Any] = field(default_factory=list)
    plugins: list[Any] = field(default_factory=list)
    refusal: str | None = None

    def tables(self) -> list[Any]:
        """Return the attached arrays that were computed from the scene's parameters."""
        tables = self.context.tables() + [table for part in self.beside for table in part.tables()]
        with dr.resume_grad():
            return [table for table in tables if dr.grad_enabled(table)]


def state_of(jobs: list[Prepared]) -> tuple[tuple[Any, ...], list[Any]]:
    """Return all data that the kernels of jobs depend on, beside the scene's parameters.

    Args:
        jobs: jobs of one scene.

    Returns:
        (structure: hashable, all that is no array; arrays that the kernels read), see
        :func:`~..frozen_state.state_below`.
    """
    held = [
        [job.kind, job.integrator, job.film, job.context, job.launches, job.seed, job.samples, job.incoming, job.beside]
        for job in jobs
    ]
    return state_below([held, [vars(plugin) for plugin in jobs[0].plugins]])


# --------------------------------------------------------------------------------------------------------------------
# The adjoint of a film's two images, as the lanes of a backward pass read it.

class IncomingAdjoint:
    """Adjoint of a film's images, the argument of ``render_backward``.

    Args:
        film: film of the job.
        steady: adjoint of the steady image, (H, W, C), or None.
        transient: TensorXf of the film's shape, the tuple (flat array, offset, strides), or None.

    Raises:
        GradientError: if the transient has another shape.
    """

    def __init__(self, film: Any, steady: Any, transient: Any) -> None:
        self.film, self.steady = film, steady
        self.transient = None if transient is None else film.stored_adjoint(self._layout(transient))

    def _layout(self, transient: Any) -> Any:
        if isinstance(transient, tuple):
            return transient
        expected = self.film.cube_shape()
        if tuple(transient.shape) != expected:
            raise GradientError(f"render_backward: adjoint of shape {expected} expected, got {tuple(transient.shape)}.")
        strides = np.cumprod((1, *expected[:0:-1]))[::-1]
        return transient.array, 0, tuple(int(stride) for stride in strides)

    def block(self, rays: Any, pixel: Any, match: Any) -> Any:
        """Return the film's :class:`~..films.block.AdjointBlock` for the samples of a launch.

        Args:
            rays: primary rays, with ``row``, ``column`` and ``laser``.
            pixel: index of their pixels in the film, UInt32.
            match: :class:`~..films.colour.ChannelMatch` of the rays.
        """
        film, channels = self.film, self.film.channel_count()
        steady = [mi.Float(0)] * channels
        if self.steady is not None:
            steady = [dr.gather(mi.Float, self.steady.array, pixel * channels + c) for c in range(channels)]
        transient, base = None, mi.UInt32(0)
        if self.transient is not None:
            flat, offset, strides = self.transient
            base = rays.row * strides[0] + rays.column * strides[1] + offset
            if rays.laser is not None:
                row = rays.laser // film.laser_scan_width
                base += row * strides[2] + (rays.laser - row * film.laser_scan_width) * strides[3]
            transient = (flat, *strides[-2 - film.knows_rates :])
        return film.create_adjoint_block(transient, base, steady, match)
