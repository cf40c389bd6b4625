"""What a simulation will take, said before it starts."""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import dataclass

import torch

from torchtransient.errors import PhysicsWarning, StorageError
from torchtransient.nlos.renderer import light_of
from torchtransient.nlos.work import Work
from torchtransient.rendering.memory import available_bytes
from torchtransient.scene.variant import active_variant

# Shares of the samples that the time is estimated by, and the fewest that tell something.
FEW, SOME, LEAST = 512, 128, 16
_BYTES = 4


@dataclass(frozen=True)
class Forecast:
    """``scan`` in words, ``shape`` of the measured tensor, ``bytes`` that it takes, ``seconds`` (None: not estimated),
    ``spp``, ``parts`` that it is rendered in, ``variant`` and why, ``light``: how which light is found. Printing it
    gives a few lines.
    """

    scan: str
    shape: tuple[int, ...]
    bytes: int
    seconds: float | None
    spp: int
    parts: int
    variant: str
    light: str

    def __str__(self) -> str:
        shape = " x ".join(map(str, self.shape))
        parts = f", in {self.parts} parts" if self.parts > 1 else ""
        taken = "" if self.seconds is None else f", about {duration(self.seconds)}"
        lines = [
            self.scan,
            f"{shape}: {size(self.bytes)}{taken}, {self.spp} samples a point{parts}",
            f"variant: {self.variant}",
            f"light: {self.light}",
        ]
        return "\n".join(lines)


def forecast_of(work: Work, *, timed: bool) -> Forecast:
    """Of what is about to start. ``timed``: with the time, from a small share of the samples.

    Raises StorageError for a capture that does not fit into memory.
    """
    shape = _shape(work)
    taken = math.prod(shape) * _BYTES * (1 if work.film.frequencies is None else 2)
    _check_fits(taken, shape, work)
    with active_variant(work.variant.name):
        light = light_of(work.renderer(0))
        seconds = _seconds(work) if timed else None
    return Forecast(
        scan=repr(work.scan), shape=shape, bytes=taken, seconds=seconds, spp=work.film.spp, parts=work.count,
        variant=f"{work.variant.name}, {work.variant.why}", light=light,
    )  # fmt: skip


def _shape(work: Work) -> tuple[int, ...]:
    """That of the measured tensor."""
    renderer = work.renderer(0)
    stokes = (4,) if renderer.scene.variant.endswith("_polarized") else ()
    cube = renderer._cube_shape
    times, channels = cube[-2:]
    channels = channels // 2 if renderer.frequencies is not None else channels
    # The components of polarization are channels of the film.
    channels = channels // 4 if stokes else channels
    return (*stokes, channels, times, *work.scan.shape)


def _seconds(work: Work) -> float:
    """Of all parts, from runs of the first with few samples: what starts it, and what a sample costs."""
    # Of few samples in all, those of a part: a render that has next to nothing to do says nothing of others.
    of_part = max(1, work.film.spp // work.count) if work.sums else work.film.spp
    few, some = max(LEAST, of_part // FEW), max(LEAST, of_part // SOME)
    few, some = (few, some) if some > few else (of_part, of_part)
    times = {}
    told = work.renderer(0).scene.warned
    before = set(told)
    with torch.no_grad(), warnings.catch_warnings():
        # What few samples see of a window is no warning yet.
        warnings.simplefilter("ignore", PhysicsWarning)
        for spp in (few, some, few, some) if some > few else (few, few):  # compiled, then timed
            began = time.perf_counter()
            work.render(0, 0, spp=spp)
            times[spp] = time.perf_counter() - began
    told &= before
    slope = max(0.0, (times[some] - times[few]) / (some - few)) if some > few else 0.0
    of_one = times[some] + slope * (of_part - some)
    if work.sums:
        return work.count * of_one
    return of_one / _share(work)


def _share(work: Work) -> float:
    """The sensor points of the first part, of all."""
    return work.run(0)[1] / math.prod(work.scan.sensor_shape)


def _check_fits(taken: int, shape: tuple[int, ...], work: Work) -> None:
    # The whole on the host, and what is being rendered: a part of it, or as much again.
    share = _share(work) if work.count > 1 else 0.0
    available = available_bytes("llvm")
    if available is not None and taken * (1 + share) > available:
        numbers = " x ".join(map(str, shape))
        raise StorageError(
            f"simulate: the capture would take {size(int(taken * (1 + share)))} ({numbers} numbers), and "
            f"{size(available)} are available. Use fewer bins, sensor points or laser spots, or simulate parts "
            "of the scan (Scan.single, Scan.points)."
        )


def size(count: int) -> str:
    """Bytes in words."""
    for unit, scale in (("TiB", 2**40), ("GiB", 2**30), ("MiB", 2**20)):
        if count >= scale:
            return f"{count / scale:.4g} {unit}"
    return f"{count / 2**10:.4g} KiB"


def duration(seconds: float) -> str:
    """Seconds in words."""
    if seconds < 100:
        return f"{seconds:.2g} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
