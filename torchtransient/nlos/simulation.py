"""``tt.nlos.simulate``: a capture with a bar, a forecast of memory and time, and a file that keeps finished parts.

With a part file, a scan of hidden things is rendered in tiles of sensor points, and a complete scene in passes over all
of them. A part is in the file whole or not at all, so that a simulation that was killed goes on where it was; parts
that were done keep their bits.
"""

from __future__ import annotations

import math
import os
import sys
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchtransient.array_files.array_file import path_of
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.checks import Numbers, count, of_class
from torchtransient.errors import ArgumentError, PhysicsWarning, StorageError
from torchtransient.nlos.part_file import PartFile, RowLayout, Rows
from torchtransient.nlos.renderer import (
    check_sensor,
    checked_module,
    checked_seed,
    in_film_shape,
    in_scan_shape,
    light_of,
    measured,
    say_black,
)
from torchtransient.nlos.scene import (
    DEFAULT_BIN_WIDTH_OPL,
    DEFAULT_BOUNCES,
    DEFAULT_ENERGY,
    DEFAULT_SEED,
    DEFAULT_SPP,
    capture_scene,
    hidden_bounds,
)
from torchtransient.nlos.work import Film, HiddenWork, SceneWork, Work, choose_variant, seed_of
from torchtransient.rendering.arguments import checked_samples
from torchtransient.rendering.memory import available_bytes
from torchtransient.scene.load import Scene, load
from torchtransient.scene.variant import active_variant
from torchtransient.sensing import Device

# Parts of a simulation with a part file, of which a kill loses one at most. Tiles of exhaustive captures each look at
# all laser spots anew: 16 of them take three times as long as one, 4 a quarter more (256 x 256 pairs).
PARTS, EXHAUSTIVE_PARTS = 16, 4
# Shares of the samples that the time is estimated by, and the fewest that tell something.
FEW, SOME, LEAST = 512, 128, 16
_NUMBER_BYTES = 4


@dataclass(frozen=True)
class Forecast:
    """Forecast of a simulation. Printing it gives a few lines.

    ``scan`` in words, ``shape`` of the measured tensor, its ``bytes``, ``seconds`` (None: not estimated), ``spp``,
    number of ``parts``, ``variant`` and its reason, ``light``: the estimators of light.
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
        taken = "" if self.seconds is None else f", about {duration_in_words(self.seconds)}"
        lines = [
            self.scan,
            f"{shape}: {size_in_words(self.bytes)}{taken}, {self.spp} samples a point{parts}",
            f"variant: {self.variant}",
            f"light: {self.light}",
        ]
        return "\n".join(lines)


def forecast_of(work: Work, *, timed: bool) -> Forecast:
    """Forecast a simulation that is about to start.

    Args:
        work: to be rendered.
        timed: with the time, from a small share of the samples.

    Raises:
        StorageError: for a capture that does not fit into memory.
    """
    shape = _measured_shape(work)
    taken = math.prod(shape) * _NUMBER_BYTES * (1 if work.film.frequencies is None else 2)
    _check_fits(taken, shape, work)
    with active_variant(work.variant.name):
        light = light_of(work.renderer(0))
        seconds = _seconds(work) if timed else None
    return Forecast(
        scan=repr(work.scan), shape=shape, bytes=taken, seconds=seconds, spp=work.film.spp, parts=work.count,
        variant=f"{work.variant.name}, {work.variant.why}", light=light,
    )  # fmt: skip


def _measured_shape(work: Work) -> tuple[int, ...]:
    """Shape of the measured tensor."""
    renderer = work.renderer(0)
    stokes = (4,) if renderer.scene.variant.endswith("_polarized") else ()
    cube = renderer._cube_shape
    times, channels = cube[-2:]
    channels = channels // 2 if renderer.frequencies is not None else channels
    # The components of polarization are channels of the film.
    channels = channels // 4 if stokes else channels
    return (*stokes, channels, times, *work.scan.shape)


def _seconds(work: Work) -> float:
    """Estimate the seconds of all parts from runs of the first with few samples: a start, and a cost of each sample."""
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
            f"simulate: the capture would take {size_in_words(int(taken * (1 + share)))} ({numbers} numbers), and "
            f"{size_in_words(available)} are available. Use fewer bins, sensor points or laser spots, or simulate "
            "parts of the scan (Scan.single, Scan.points)."
        )


def size_in_words(count: int) -> str:
    """Return bytes in words.

    Args:
        count: of bytes.
    """
    for unit, scale in (("TiB", 2**40), ("GiB", 2**30), ("MiB", 2**20)):
        if count >= scale:
            return f"{count / scale:.4g} {unit}"
    return f"{count / 2**10:.4g} KiB"


def duration_in_words(seconds: float) -> str:
    """Return seconds in words.

    Args:
        seconds: a duration.
    """
    if seconds < 100:
        return f"{seconds:.2g} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def simulate(
    hidden: Any,
    scan: Scan | None = None,
    *,
    time_axis: TimeAxis | None = None,
    frequencies: FrequencyAxis | Numbers | None = None,
    spp: int | None = None,
    bounces: Sequence[int] | str | None = None,
    energy: Any = None,
    sensor: torch.nn.Module | Device | None = None,
    seed: int = DEFAULT_SEED,
    variant: str | None = None,
    part: str | Path | None = None,
    tiles: int | None = None,
    keep_part: bool = False,
    progress: bool = True,
    generator: torch.Generator | None = None,
) -> Capture:
    """Simulate the capture of hidden things by a scan, without gradients (see :class:`CaptureRenderer`).

    Args:
        hidden: as in :func:`~torchtransient.nlos.scene.capture_scene`. Without a ``scan``, a complete scene (as
            :func:`tt.load` takes it) with the integrator ``transient_nlos_path``, a laser, a sensor of any kind and a
            film with its bins. The scan is read off the scene: points are the ends of the rays of pixel centres.
            ``bounces`` and ``energy`` stand in the scene then; ``spp`` and the bins may.
        scan: that knows its wall.
        time_axis, frequencies: of the film; without them bins of 16 ps that hold all light of three bounces.
        spp: paths for each sensor point, or for each pair of an exhaustive scan (4096).
        bounces: numbers of bounces that count, (3,).
        energy: of the laser, 1 joule.
        sensor: module of ``tt.sensing``, or a device, that the transient goes through at last; its answer has the same
            bins. Devices draw their counts.
        seed: whole number below 2^32. Same seed and parts, same capture, to the rounding of sums that threads add to in
            the order they come. Parts have seeds derived from it, so that another number of them is another draw. A
            :class:`CaptureRenderer` draws the paths of one part in the same variant (and spreads light by a tent in
            time where a parameter can change lengths).
        variant: of Mitsuba; None takes one channel where all spectra are grey, else the variant of :func:`tt.load`.
        part: name of a file that keeps finished parts: with it a simulation that was killed goes on when it is called
            again. It is deleted at the end.
        tiles: number of parts, 16, 4 of exhaustive scans.
        keep_part: leave the part file.
        progress: print memory and time before it starts, and show a bar.
        generator: of the noise of ``sensor``.

    Returns:
        Capture. ``metadata``: ``spp``, ``seed``, ``seconds`` of rendering, ``variant`` with ``variant_reason``,
            ``light`` (the estimators of light), ``parts``.

    Raises:
        ArgumentError, SceneError, ShapeError, UnitError, VariantError: for a set-up that cannot be simulated.
        StorageError: where the capture does not fit into memory or the disk is full, and for a part file that belongs
            to another simulation, is damaged, or is worked on by another process.
    """
    seed, path = checked_seed("simulate", seed), _part_path(part)
    check_sensor("simulate", sensor, generator)
    work = _work(hidden, scan, time_axis, frequencies, spp, (bounces, energy), variant, _parts(scan, path, tiles))
    chain = None if sensor is None else _chain(sensor, work.axes()[0])
    with _part_file(path, work, seed) as kept, active_variant(work.variant.name), torch.no_grad():
        finished = kept is not None and all(_has(kept, work, number) for number in range(work.count))
        forecast = forecast_of(work, timed=progress and not finished)
        if progress:
            print(forecast, file=sys.stderr)
        whole = kept is None and work.count == 1
        capture, seconds = _whole(work, seed, progress) if whole else _in_parts(work, seed, kept, progress)
        say_black("simulate", capture)
        if chain is not None and capture.transient is not None:
            light = measured(in_film_shape(capture.transient, capture.scan), capture.scan, chain, generator)
            capture = replace(capture, transient=in_scan_shape(light, capture.scan))
        if kept is not None and not keep_part:
            kept.remove()
    return replace(capture, metadata=_metadata(work, forecast, seed, seconds))


def forecast(
    hidden: Any,
    scan: Scan | None = None,
    *,
    part: str | Path | None = None,
    tiles: int | None = None,
    variant: str | None = None,
    **settings: Any,
) -> Forecast:
    """Forecast memory, time, variant and estimators of light of :func:`simulate` with the same arguments.

    Args:
        hidden, scan, part, tiles, variant: as of :func:`simulate`.
        settings: its other arguments.

    Raises:
        ArgumentError: for unknown arguments; others as :func:`simulate`.
    """
    checked_seed("forecast", settings.get("seed", DEFAULT_SEED))
    time_axis, frequencies, spp, *of_light = (
        settings.pop(name, None) for name in ("time_axis", "frequencies", "spp", "bounces", "energy")
    )
    unknown = sorted(set(settings) - {"seed", "sensor", "keep_part", "progress", "generator"})
    if unknown:
        raise ArgumentError(f"forecast: expected the arguments of simulate, got {', '.join(unknown)}.")
    path = _part_path(part)
    work = _work(
        hidden, scan, time_axis, frequencies, spp, (of_light[0], of_light[1]), variant, _parts(scan, path, tiles)
    )
    with active_variant(work.variant.name):
        return forecast_of(work, timed=True)


# ---------------------------------------------------------------------------------------------------------------- work


def _work(
    hidden: Any, scan: Scan | None, time_axis: Any, frequencies: Any, spp: Any, of_light: tuple[Any, Any],
    variant: str | None, parts: int,
) -> Work:  # fmt: skip
    if time_axis is not None and frequencies is not None:
        raise ArgumentError("simulate: expected time_axis or frequencies, got both. Leave out one of them.")
    spp = checked_samples("simulate: spp", spp)
    if scan is None:
        return _scene_work(hidden, time_axis, frequencies, spp, of_light, variant, parts)
    of_class("simulate: scan", scan, Scan)
    if isinstance(hidden, Scene):
        raise ArgumentError(
            "simulate: a tt.Scene has a sensor of its own; expected hidden shapes beside scan=. Leave scan out to "
            "simulate the scene as it is, or give shapes by name."
        )
    bounces, energy = of_light
    settings: dict[str, Any] = {
        "bounces": DEFAULT_BOUNCES if bounces is None else bounces,
        "energy": DEFAULT_ENERGY if energy is None else energy,
    }
    chosen = choose_variant(load(capture_scene(hidden, scan, **settings)), variant)
    if time_axis is None and frequencies is None:
        with active_variant(chosen.name):
            bounds = hidden_bounds(hidden, chosen.name)
        time_axis = scan.default_axis(bounds, DEFAULT_BIN_WIDTH_OPL)
    film = Film(time_axis, frequencies, DEFAULT_SPP if spp is None else spp)
    return HiddenWork(hidden, scan, settings, film, chosen, parts)


def _scene_work(
    scene: Any, time_axis: Any, frequencies: Any, spp: Any, of_light: tuple[Any, Any], variant: str | None, parts: int
) -> SceneWork:
    for name, value, where in zip(
        ("bounces", "energy"), of_light, ("its integrator's max_depth and filter_bounces", "its laser"), strict=True
    ):
        if value is not None:
            raise ArgumentError(
                f"simulate: {name} has no effect on a complete scene: {where} say so. Leave it out, or give scan= and "
                "hidden shapes."
            )
    if isinstance(scene, Mapping) and not _is_complete(scene):
        raise ArgumentError(
            "simulate: expected scan= beside hidden shapes, or a complete scene with integrator, laser and sensor, got "
            f"{', '.join(map(str, scene)) or 'nothing'} and no scan. Make one with tt.nlos.Scan.grid(wall, ...)."
        )
    if not isinstance(scene, str | os.PathLike | Mapping | Scene):
        raise ArgumentError(
            f"simulate: expected scan= beside a mesh, or a complete scene, got {type(scene).__name__} and no scan."
        )
    loaded = load(scene)
    given = variant
    if given is None and isinstance(scene, Scene):
        given = scene._requested_variant
    chosen = choose_variant(loaded, given)
    return SceneWork(load(loaded, variant=chosen.name), time_axis, frequencies, spp, chosen, parts)


def _is_complete(scene: Mapping[str, Any]) -> bool:
    """Return True for a dictionary with an integrator: hidden things have none."""
    kinds = [str(node.get("type", "")) for node in scene.values() if isinstance(node, Mapping)]
    return any("path" in kind for kind in kinds) or "integrator" in scene


def _part_path(part: Any) -> Path | None:
    return None if part is None else path_of(part, "simulate: part")


def _parts(scan: Any, part: Path | None, tiles: int | None) -> int:
    if tiles is None:
        many = EXHAUSTIVE_PARTS if getattr(scan, "kind", None) == "exhaustive" else PARTS
        return 1 if part is None else many
    return count("simulate: tiles", tiles, 1, ArgumentError)


# ------------------------------------------------------------------------------------------------------------- renders


def _whole(work: Work, seed: int, progress: bool) -> tuple[Capture, float]:
    began = time.perf_counter()
    return work.render(0, seed, progress=progress), time.perf_counter() - began


@contextmanager
def _part_file(path: Path | None, work: Work, seed: int) -> Iterator[PartFile | None]:
    if path is None:
        yield None
        return
    with PartFile(path, work.key(seed)) as kept:
        yield kept


def _in_parts(work: Work, seed: int, kept: PartFile | None, progress: bool) -> tuple[Capture, float]:
    """All parts that are not there yet, one after another."""
    from tqdm.auto import tqdm

    points, done = math.prod(work.scan.sensor_shape), 0.0
    layout = None if kept is None or not kept.about else RowLayout.from_plain(kept.about)
    rows: Rows | None = None  # without a file, or the sum so far
    with tqdm(total=work.count, desc="capture", unit=" part", disable=not progress) as bar:
        for number in range(work.count):
            if kept is not None and _has(kept, work, number):
                bar.update(1)
                continue
            began = time.perf_counter()
            capture = work.render(number, seed_of(seed, number))
            layout = RowLayout.of(capture)
            found = layout.rows(capture)
            seconds = time.perf_counter() - began
            done += seconds
            if work.sums:
                rows = _sum_so_far(kept, number, points) if rows is None else rows
                weighed = work.weight(number) * found
                rows = weighed if rows is None else np.add(rows, weighed, out=rows)
            elif kept is None:
                rows = np.empty((points, layout.columns), np.float32) if rows is None else rows
                rows[slice(*work.run(number))] = found
            if kept is not None:
                _keep(kept, work, number, rows if work.sums else found, seconds, layout)
            bar.update(1)
    assert layout is not None
    if kept is not None:
        rows, done = _everything(kept, work, points), kept.seconds
    assert rows is not None
    return Capture(**layout.capture(rows, work.scan, *work.axes()), metadata={}), done


# A sum takes turns in two places, so that the one before is whole while the next is written.
def _slot(number: int, points: int) -> int:
    return (number % 2) * points


def _has(kept: PartFile, work: Work, number: int) -> bool:
    return kept.last is not None and number <= kept.last if work.sums else kept.has(number)


def _sum_so_far(kept: PartFile | None, number: int, points: int) -> Rows | None:
    return None if kept is None or number == 0 else kept.rows(_slot(number - 1, points), points)


def _keep(kept: PartFile, work: Work, number: int, rows: Any, seconds: float, layout: RowLayout) -> None:
    points = math.prod(work.scan.sensor_shape)
    first, total, before = work.run(number)[0], points, None
    if work.sums:
        first, total, before = _slot(number, points), 2 * points, number - 1
    kept.keep(number, first, rows, total=total, seconds=seconds, about=layout.plain(), instead_of=before)


def _everything(kept: PartFile, work: Work, points: int) -> Rows:
    return kept.rows(_slot(work.count - 1, points), points) if work.sums else kept.everything()


# -------------------------------------------------------------------------------------------------------------- results


def _chain(sensor: torch.nn.Module | Device, axis: TimeAxis | None) -> torch.nn.Module:
    if axis is None:
        raise ArgumentError("simulate: a sensor takes transients, and phasors are asked for; leave out one of them.")
    # Counts as they are drawn: nothing of a simulation has gradients.
    return checked_module(sensor, axis, "straight_through")



def _metadata(work: Work, forecast: Forecast, seed: int, seconds: float) -> dict[str, Any]:
    return {
        "spp": work.film.spp, "seed": seed, "seconds": seconds, "parts": work.count, "variant": work.variant.name,
        "variant_reason": work.variant.why, "light": forecast.light,
    }  # fmt: skip
