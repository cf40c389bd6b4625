"""Reverse and forward mode of boundary samples: events weighed by the film's adjoint, or put onto the film."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.films.block import FilmBlock
from torchtransient.plugins.transport.boundary.sides import in_memory
from torchtransient.plugins.transport.carry import total_of
from torchtransient.plugins.transport.derivative import tangents_of
from torchtransient.plugins.transport.sinks import AdjointSumSink, FilmSink, Sink
from torchtransient.plugins.transport.strategy import Local, rate_of
from torchtransient.plugins.transport.walk import walk


class Reverse:
    """Reverse mode: detached sums of events times the adjoint of the film, times attached speeds.

    Args:
        term: :class:`.term.BoundaryTerm` of the job.
        incoming: :class:`~...integrators.job.IncomingAdjoint` of the film.
    """

    def __init__(self, term, incoming):
        self.term, self.incoming = term, incoming

    def view(self, rays):
        """Return the adjoint block of primary rays."""
        return self.block(rays, rays)

    def rows_in_band(self, row):
        """Return (mask of rows of pixels that the launch writes, weight of a sample of the whole film)."""
        return mi.Bool(True), 1

    def block(self, rays, place):
        """Return the adjoint block of pixels.

        Args:
            rays: rays whose channels count.
            place: ``row, column, laser`` of the pixels.
        """
        term = self.term
        match = term.integrator.channel_match(term.context.contents, term.film, rays)
        pixel = dr.fma(place.row, int(term.film.crop_size()[0]), place.column)
        return self.incoming.block(place, pixel, match)

    def speeds(self, attached):
        """Return speeds as :meth:`follow` takes them."""
        return attached

    def follow(self, context, sampler, path, block, factor, speed):
        """Trace paths and return the contribution of their events to the loss, Float.

        Args:
            path: :class:`~..walk.Path` at x, with its leg.
            block: result of :meth:`view`.
            factor: detached weight of each path.
            speed: not used here.
        """
        _, state = walk(context, sampler, path, AdjointSumSink(block))
        return finite(state["sum"] * factor)

    def sink_of_pixels(self, middle, job, u, factor, speeds):
        """Return a sink of events that have a pixel each, and the factors of :meth:`sum_of_pixels`.

        Args:
            middle: primary rays of the middle of the film, whose channels count.
            u: two uniform numbers, which choose a pixel.
            factor: detached weight of each path.
            speeds: attached speeds by :data:`PixelSums.NAMES`.
        """
        return PixelSums(self, middle, u, len(speeds)), (factor, speeds)

    def sum_of_pixels(self, state, factors):
        """Return the attached objective, from the state of the sink and the factors."""
        factor, speeds = factors
        in_memory(self.term.context, None, state)
        with dr.resume_grad():
            names = PixelSums.NAMES[: len(speeds)]
            return sum(finite(state[name] * factor) * speed for name, speed in zip(names, speeds, strict=True))


class PixelSums(Sink):
    """Sink that sums events, weighed by the adjoint of the pixel of each.

    ``direct``: of the first vertex, seen by the sensor; ``rest``: of all others; ``through``: of the first vertex, seen
    through a chain.

    Args:
        mode: :class:`Reverse`.
        middle, u: as of :meth:`Reverse.sink_of_pixels`.
        count: number of sums.
    """

    NAMES = ("direct", "rest", "through")

    def __init__(self, mode, middle, u, count):
        self.mode, self.middle, self.u, self.names = mode, middle, u, self.NAMES[:count]

    def begin(self, context):
        return {name: mi.Float(0) for name in self.names}

    def event(self, state, event):
        term = self.mode.term
        row, column, weight, inside = term.pixel(event.uv, self.u)
        active, place = event.active & inside, Local(row=row, column=column, laser=None)
        A, *_ = self.mode.block(seen_along(self.middle, event.d), place).read(event.opl, active, **rate_of(event))
        value = dr.select(active, total_of(A, event.value) * weight, 0)
        name = self.NAMES[event.speed]
        state[name] = state[name] + dr.select(event.first, value, 0)
        state["rest"] = state["rest"] + dr.select(event.first, 0, value)


class Forward:
    """Forward mode: events written to the film, times the tangents of the speeds.

    Args:
        term: :class:`.term.BoundaryTerm` of the job.
        job: launch, whose band of the film is written.
    """

    def __init__(self, term, job):
        self.term, self.job = term, job
        # Samples see the whole film, of which a band of storage keeps some rows.
        self.first, rows = term.film.band_layout()[job.band]
        self.stop, self.scale = self.first + rows, int(term.film.crop_size()[1]) / rows

    def view(self, rays):
        """Return (film block, map to channels, pixel) of primary rays."""
        term, film = self.term, self.term.film
        match, (base, pixel) = term.integrator.channel_match(term.context.contents, film, rays), self._indices(rays)
        if rays.strata is not None:
            return film.create_event_block(self.job, base, match, term.context.most_events()), match, pixel
        # Rays that go anywhere are not in the order of pixels, which some films count on.
        return FilmBlock(film, self.job.band, base, match), match, pixel

    def rows_in_band(self, row):
        """Return as in reverse mode, for the rows of one band of storage."""
        return (row >= self.first) & (row < self.stop), self.scale

    def _indices(self, place):
        return self.term.integrator.pixel_indices(self.term.film, self.job, place)

    def speeds(self, attached):
        """Return the tangents of speeds."""
        with dr.resume_grad():
            if not any(dr.grad_enabled(speed) for speed in attached):
                return [mi.Float(0)] * len(attached)
            return tangents_of(list(attached))

    def follow(self, context, sampler, path, view, factor, speed):
        """Trace paths and write their events to the film, times ``factor * speed``."""
        film, (block, match, pixel) = self.term.film, view
        _, state = walk(context, sampler, path, ScaledFilmSink(block, finite(factor * speed)))
        film.add_steady(pixel, match.to_channels(state["L"]))
        block.finish()

    def sink_of_pixels(self, middle, job, u, factor, speeds):
        """Return the sink and factors, as in reverse mode."""
        return PixelFilmSink(self, middle, u, [finite(factor * speed) for speed in self.speeds(speeds)]), None

    def sum_of_pixels(self, state, factors):
        """Return zero: all is on the film."""
        return mi.Float(0)


class ScaledFilmSink(FilmSink):
    """Sink that writes events to a film, times a number for each path."""

    def __init__(self, block, scale):
        super().__init__(block)
        self.scale = scale

    def event(self, state, event):
        event.value = event.value * self.scale
        super().event(state, event)


class PixelFilmSink(Sink):
    """Sink that writes events to the pixel of each, times one number at the first vertex and another at all others."""

    def __init__(self, mode, middle, u, scales):
        self.mode, self.middle, self.u, self.scales = mode, middle, u, scales

    def event(self, state, event):
        mode, term = self.mode, self.mode.term
        film = term.film
        row, column, weight, inside = term.pixel(event.uv, self.u)
        own, share = mode.rows_in_band(row)
        active = event.active & inside & own
        place = Local(row=dr.select(active, row, mode.first), column=column, laser=None)
        match = term.integrator.channel_match(term.context.contents, film, seen_along(self.middle, event.d))
        base, pixel = mode._indices(place)
        scale = dr.select(event.first, self.scales[event.speed], self.scales[1]) * (weight * share)
        channels = [dr.select(active, c, 0) for c in match.to_channels(event.value * scale)]
        film.put(mode.job.band, base, event.opl, channels, active, **rate_of(event))
        if film.keeps_steady:
            for c, value in enumerate(channels):
                index = pixel * film.channel_count() + c
                dr.scatter_reduce(dr.ReduceOp.Add, film.steady, type(film.steady)(value), index, active)


def seen_along(rays, d):
    """Return primary rays, each of which arrives against ``d``, as channels of the film take them."""
    ray = mi.Ray3f(dr.detach(rays.ray))
    ray.d = -d
    return Local(ray=ray, weight=rays.weight, scale=rays.scale, seen=rays.seen)


def finite(value):
    """Return ``value``, zero where it is not finite."""
    return dr.select(dr.isfinite(value), value, 0)
