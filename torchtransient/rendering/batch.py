"""The results of a call: from the memory of films to torch tensors, those of several items in one."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch

from torchtransient.errors import ShapeError
from torchtransient.plugins.frozen_state import says_it_can_be_recorded
from torchtransient.plugins.unfinished import afterwards
from torchtransient.rendering.carry_out import LARGE_FILM


class Batch:
    """The results of ``count`` renders of some ``films`` in one tensor each; of a single one the film's own memory.

    Large films write straight to their place: a copy would cost as much as a third of a render of 16 samples per pixel.
    """

    def __init__(self, count: int, films: Sequence[Any], integrator: Any) -> None:
        self.count, self.films, self.integrator = count, films, integrator
        self._steady: torch.Tensor | None = None
        self._response: torch.Tensor | None = None
        self._memory: Any = None
        self._shape: tuple[int, ...] = ()

    @contextmanager
    def lent_to(self, film: Any, n: int, spp: int) -> Iterator[bool]:
        """Whether the film writes to the place of item ``n``."""
        entries = math.prod(film.cube_shape())
        large = self.count > 1 and entries >= LARGE_FILM and self.count * entries < 2**32
        # An integrator of others may not know of first entries.
        able = large and says_it_can_be_recorded(self.integrator)
        if not able or not all(other.can_borrow(spp) for other in self.films):
            yield False
            return
        with afterwards(lambda: film.lend(None)):
            self._lend(film, n, entries)
            yield True

    def _lend(self, film: Any, n: int, entries: int) -> None:
        import mitsuba as mi

        from torchtransient.plugins.films.base import zeros

        if self._memory is None:
            self._memory, self._shape = zeros(mi.Float, self.count * entries), tuple(film.cube_shape())  # type: ignore[no-untyped-call]
        film.lend((self._memory, n * entries))

    def take(self, film: Any, n: int) -> None:
        """Take the result of item ``n`` from its film."""
        if self._memory is not None and film.bands and film.bands[0][2] is self._memory:
            steady, response = _take_steady(film), None
        else:
            steady, response = take(film, None if self._response is None else self._response[n])
        if self.count == 1:
            self._steady, self._response = steady, response
            return
        if self._steady is None:
            self._steady = steady.new_empty((self.count, *steady.shape))
        self._steady[n].copy_(steady)
        if response is not None:
            if self._response is None:
                self._response = response.new_empty((self.count, *response.shape))
            self._response[n].copy_(response)

    def tensors(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(steady, response) of all items. Raises ShapeError where there are none."""
        import mitsuba as mi

        if self._response is None and self._memory is not None:
            self._response = mi.TensorXf(self._memory, (self.count, *self._shape)).torch()
        if self._steady is None or self._response is None:
            raise ShapeError("a batch must have at least one entry, got 0.")
        return self._steady, self._response


def _take_steady(film: Any) -> torch.Tensor:
    """The film's steady image, where the array has been written to memory that was lent to it."""
    import drjit as dr
    import mitsuba as mi

    dr.eval(film.steady, film.bands[0][2])
    dr.sync_thread()
    shape = film.cube_shape()
    steady: torch.Tensor = mi.TensorXf(film.steady, (shape[0], shape[1], film.channel_count())).torch()
    film.clear()
    return steady


def take(film: Any, into: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
    """The film's result as torch tensors that own the film's memory. A cube stored in several bands is put together."""
    import drjit as dr
    import mitsuba as mi

    bands = film.transient_bands()
    shape = film.cube_shape()
    dr.eval(film.steady, *(band[2] for band in bands))
    dr.sync_thread()
    steady = mi.TensorXf(film.steady, (shape[0], shape[1], film.channel_count())).torch()
    if len(bands) == 1:
        response = mi.TensorXf(bands[0][2], shape).torch()
    else:
        response = torch.empty(shape, dtype=steady.dtype, device=steady.device) if into is None else into
        while bands:
            first, rows, flat = bands.pop(0)
            response[first : first + rows].copy_(flat.torch().view(rows, *shape[1:]))
            del flat
    film.clear()
    return steady, response
