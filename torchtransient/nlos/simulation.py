"""``tt.nlos.simulate``: a capture with a bar, a forecast of memory and time, and a file that keeps finished parts.

With a part file, a scan of hidden things is rendered in tiles of sensor points, and a complete scene in passes over all
of them. A part is in the file whole or not at all, so that a simulation that was killed goes on where it was; parts
that were done keep their bits.
"""

from __future__ import annotations

import hashlib
import inspect
import math
import os
import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch

from torchtransient.array_files.array_file import path_of
from torchtransient.array_files.free_memory import size_in_words
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.checks import Numbers, count
from torchtransient.errors import ArgumentError, PhysicsWarning, StorageError
from torchtransient.files.content_key import content_key, contents_of
from torchtransient.nlos.part_file import PartFile, RowLayout, Rows
from torchtransient.nlos.renderer import (
    POINTS,
    SPOTS,
    CaptureRenderer,
    as_capture,
    check_scan,
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
from torchtransient.nlos.scene_scan import scan_of_scene
from torchtransient.rendering.arguments import checked_samples
from torchtransient.rendering.memory import available_bytes
from torchtransient.rendering.renderer import TransientRenderer
from torchtransient.scene.inventory import scene_inventory
from torchtransient.scene.load import Scene, load
from torchtransient.scene.objects import LoadedScene
from torchtransient.scene.plan import text_of
from torchtransient.scene.variant import active_variant, is_differentiable, resolve_variant
from torchtransient.sensing import Device

# Parts of a simulation with a part file, of which a kill loses one at most. Tiles of exhaustive captures each look at
# all laser spots anew: 16 of them take three times as long as one, 4 a quarter more (256 x 256 pairs).
PARTS, EXHAUSTIVE_PARTS = 16, 4
# Shares of the samples that the time is estimated by, and the fewest that tell something.
FEW, SOME, LEAST = 512, 128, 16
_NUMBER_BYTES = 4


@dataclass(frozen=True)
class VariantChoice:
    """``name`` of the variant, and ``why`` it was chosen."""

    name: str
    why: str


def _choose_variant(scene: Scene, requested: str | None) -> VariantChoice:
    """Choose the cheapest variant in which a capture loses nothing.

    ``requested``; else the active one where it is polarized; else one channel where every spectrum of a scene is grey,
    on the device of the variant that :func:`tt.load` would take; else that variant, but none of one channel.
    """
    import mitsuba as mi

    if requested is not None:
        return VariantChoice(resolve_variant(requested), "as asked for")
    active, name = mi.variant(), resolve_variant(None)
    if name.endswith("_polarized"):
        return VariantChoice(name, "the active one, which is polarized")
    # In the variant that is active, or becomes so: a switch takes time.
    found = scene_inventory(load(scene, variant=name if is_differentiable(active) else f"{name.split('_')[0]}_ad_mono"))
    coloured = [*found.colours, *found.measured, *found.bands]
    if not coloured:
        device = name.split("_")[0]
        return VariantChoice(f"{device}_ad_mono", "every spectrum is grey, so that one channel carries all of it")
    # One channel may have been chosen for the scene before.
    return VariantChoice(name.replace("_mono", "_rgb"), f"colour: {text_of(coloured)}")


def _files_of(scene: Scene) -> dict[str, str]:
    """Return the contents of the files that a scene names anywhere, by the name that it has there.

    Included files, defaults and values of ``$parameters`` count. The scene has been built before.
    """
    import mitsuba as mi

    description, found = scene._description, {}
    description.check_described("tt.nlos: a simulation that is kept in files")
    assert not isinstance(description, LoadedScene)  # refused above
    with active_variant(scene.variant), description.resolved_files():
        nodes = description.parse(mi.parser.ParserConfig(scene.variant)).nodes
        for props in (node.props for node in nodes):
            for name in list(props):
                if props.type(name) == mi.Properties.Type.String:
                    value = str(props[name])
                    found[value] = contents_of(Path(str(mi.file_resolver().resolve(value))))
    return {name: contents for name, contents in found.items() if contents}


@dataclass(frozen=True)
class Film:
    """Film and effort of a simulation: ``time_axis`` or ``frequencies``, and ``spp``."""

    time_axis: TimeAxis | None
    frequencies: FrequencyAxis | Numbers | None
    spp: int


class HiddenWork:
    """A scan of hidden things, rendered in runs of sensor points: ``tiles`` of them, or less where points are few."""

    def __init__(
        self, hidden: Any, scan: Scan, settings: dict[str, Any], film: Film, variant: VariantChoice, tiles: int
    ) -> None:
        self.hidden, self.scan, self.film, self.variant = hidden, scan.detach(), film, variant
        self._settings = settings | vars(film) | {"variant": variant.name}
        self._points = self.scan.sensor_points.reshape(-1, 3)
        size = -(-len(self._points) // min(tiles, len(self._points)))
        # Of equal sizes but for the last: a size is a scene to be built.
        self._runs = [(k, min(k + size, len(self._points))) for k in range(0, len(self._points), size)]
        self._renderers: dict[int, CaptureRenderer] = {}
        if self.count > 1:
            # Of all points before the first part, not of some when their turn comes.
            check_scan(load(capture_scene(hidden, self.scan, **settings), variant=variant.name), self.scan)

    @property
    def count(self) -> int:
        """The number of parts."""
        return len(self._runs)

    def run(self, number: int) -> tuple[int, int]:
        """Return the first sensor point of a part, and the one behind its last."""
        return self._runs[number]

    def key(self, seed: int) -> str:
        """Return the key of a part file of this work."""
        return content_key(self.hidden, self.scan, self._settings, seed, self._runs)

    def axes(self) -> tuple[TimeAxis | None, FrequencyAxis | None]:
        """Return time axis and frequencies of the film, one of which is None."""
        return self.renderer(0).axis, self.renderer(0).frequencies

    def renderer(self, number: int) -> TransientRenderer:
        """Return the renderer of a part."""
        return self._of(number).renderer

    def render(self, number: int, seed: int, *, spp: int | None = None, progress: bool = False) -> Capture:
        """Render a part as a capture: of a list of points where there are several parts."""
        first, last = self._runs[number]
        values = {} if self.count == 1 else {POINTS: self._points[first:last]}
        if values and self.scan.kind == "pairs":
            values[SPOTS] = self.scan.laser_points.reshape(-1, 3)[first:last]
        capture: Capture = self._of(number)(values, seed=seed, spp=spp, progress=progress)
        return capture

    def _of(self, number: int) -> CaptureRenderer:
        first, last = self._runs[number]
        if last - first not in self._renderers:
            scan, parameters = self.scan, ()  # type: Scan, tuple[str, ...]
            if self.count > 1:
                scan = _listed(self.scan, first, last)
                parameters = (POINTS, SPOTS) if scan.kind == "pairs" else (POINTS,)
            made = CaptureRenderer(self.hidden, scan, parameters, **self._settings)
            # Parts may be dark; of the whole capture it is said.
            made.says_black = False
            self._renderers[last - first] = made
        return self._renderers[last - first]


class SceneWork:
    """A complete scene, rendered in ``passes`` over all sensor points, with a share of the samples each."""

    def __init__(
        self, scene: Scene, time_axis: TimeAxis | None, frequencies: Any, spp: int | None, variant: VariantChoice,
        passes: int,
    ) -> None:  # fmt: skip
        self._renderer = TransientRenderer(scene, time_axis=time_axis, frequencies=frequencies, spp=spp)
        used = spp or self._renderer._scene_spp
        self.film = Film(self._renderer.axis, self._renderer.frequencies, used)
        self.variant = variant
        self.count = min(passes, used)
        with active_variant(scene.variant):
            self.scan = scan_of_scene(scene.built(self._renderer._options).scene)

    def run(self, number: int) -> tuple[int, int]:
        """Return the range of all sensor points."""
        return 0, math.prod(self.scan.sensor_shape)

    def share(self, number: int) -> int:
        """Return the samples of a pass."""
        whole, more = divmod(self.film.spp, self.count)
        return whole + (number < more)

    def key(self, seed: int) -> str:
        """Return the key of a part file of this work."""
        scene = self._renderer.scene
        return content_key(scene._description, _files_of(scene), self.film, self.variant.name, seed, self.count)

    def axes(self) -> tuple[TimeAxis | None, FrequencyAxis | None]:
        """Return time axis and frequencies of the film, one of which is None."""
        return self._renderer.axis, self._renderer.frequencies

    def renderer(self, number: int) -> TransientRenderer:
        """Return the renderer of all parts."""
        return self._renderer

    def render(self, number: int, seed: int, *, spp: int | None = None, progress: bool = False) -> Capture:
        """Render a pass as a capture."""
        out = self._renderer(seed=seed, spp=spp or self.share(number), progress=progress)
        return as_capture(out, self.scan)


Work: TypeAlias = "HiddenWork | SceneWork"


def _seed_of(seed: int, number: int) -> int:
    """Return the seed of a part, independent of the seeds of other parts."""
    return int.from_bytes(hashlib.sha256(f"{seed}:{number}".encode()).digest()[:4], "little")


def _listed(scan: Scan, first: int, last: int) -> Scan:
    """The scan of a run of its sensor points."""

    def part(values: torch.Tensor | None) -> torch.Tensor | None:
        return None if values is None else values.reshape(-1, 3)[first:last]

    points, normals = part(scan.sensor_points), part(scan.sensor_normals)
    assert points is not None
    changed: dict[str, Any] = {"sensor_points": points, "sensor_normals": normals}
    if scan.kind == "confocal":
        changed |= {"laser_points": points, "laser_normals": normals}
    elif scan.kind == "pairs":
        changed |= {"laser_points": part(scan.laser_points), "laser_normals": part(scan.laser_normals)}
    return replace(scan, **changed)


# --------------------------------------------------------------------------------------------------------- forecasts


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
        taken = "" if self.seconds is None else f", about {_duration_in_words(self.seconds)}"
        lines = [
            self.scan,
            f"{shape}: {size_in_words(self.bytes)}{taken}, {self.spp} samples a point{parts}",
            f"variant: {self.variant}",
            f"light: {self.light}",
        ]
        return "\n".join(lines)


def _forecast_of(work: Work, *, timed: bool) -> Forecast:
    """Forecast a simulation, ``timed`` from a small share of its samples. Raises StorageError beyond the memory."""
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
    of_part = max(1, work.film.spp // work.count) if isinstance(work, SceneWork) else work.film.spp
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
    return work.count * of_one if isinstance(work, SceneWork) else of_one / _share(work)


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
            f"simulate: the capture would take {size_in_words(taken * (1 + share))} ({numbers} numbers), and "
            f"{size_in_words(available)} are available. Use fewer bins, sensor points or laser spots, or simulate "
            "parts of the scan (Scan.single, Scan.points)."
        )


def _duration_in_words(seconds: float) -> str:
    """Return seconds in words."""
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
        hidden: hidden shapes, see :func:`~torchtransient.nlos.scene.capture_scene`. Without a ``scan``, a complete
            scene (as :func:`tt.load` takes it) with the integrator ``transient_nlos_path``, a laser, a sensor of any
            kind and a film with its bins. The scan is then read from the scene: its points are where the rays of pixel
            centres end. ``bounces`` and ``energy`` are then given by the scene; ``spp`` and the bins may be.
        scan: scan that knows its wall.
        time_axis, frequencies: time axis or frequencies of the film; without them bins of 16 ps that hold all light of
            three bounces.
        spp: paths for each sensor point, or for each pair of an exhaustive scan; default 4096.
        bounces: numbers of bounces that count; default (3,).
        energy: energy of the laser in joules; default 1.
        sensor: module of ``tt.sensing``, or a device, that the transient goes through at last; its answer has the same
            bins. Devices draw their counts.
        seed: whole number below 2^32. Same seed and parts, same capture, to the rounding of sums that threads add to in
            the order they come. Parts have seeds derived from it, so that another number of them is another draw. A
            :class:`CaptureRenderer` draws the paths of one part in the same variant (and spreads light by a tent in
            time where a parameter can change lengths).
        variant: Mitsuba variant; None takes one channel where all spectra are grey, else the variant of
            :func:`tt.load`.
        part: name of a file that keeps finished parts: with it a simulation that was killed goes on when it is called
            again. It is deleted at the end.
        tiles: number of parts; default 16, or 4 for exhaustive scans.
        keep_part: do not delete the part file at the end.
        progress: print memory and time before it starts, and show a bar.
        generator: source of randomness for the noise of ``sensor``.

    Returns:
        Capture. ``metadata``: ``spp``, ``seed``, ``seconds`` of rendering, ``variant`` with ``variant_reason``,
            ``light`` (the estimators of light), ``parts``.

    Raises:
        ArgumentError, SceneError, ShapeError, UnitError, VariantError: for a set-up that cannot be simulated.
        StorageError: where the capture does not fit into memory or the disk is full, and for a part file that belongs
            to another simulation, is damaged, or is worked on by another process.
    """
    seed, path = checked_seed("simulate", seed), None if part is None else path_of(part, "simulate: part")
    work = _work(hidden, scan, time_axis, frequencies, spp, (bounces, energy), variant, _parts(scan, path, tiles))
    chain, axis = None, work.axes()[0]
    if sensor is not None:
        if axis is None:
            raise ArgumentError(
                "simulate: a sensor takes transients, and phasors are asked for; leave out one of them."
            )
        # Counts as they are drawn: nothing of a simulation has gradients.
        chain = checked_module(sensor, axis, "straight_through")
    part_file = nullcontext() if path is None else PartFile(path, work.key(seed))
    with part_file as kept, active_variant(work.variant.name), torch.no_grad():
        finished = kept is not None and all(_has(kept, work, number) for number in range(work.count))
        forecast = _forecast_of(work, timed=progress and not finished)
        if progress:
            print(forecast, file=sys.stderr)
        if kept is None and work.count == 1:
            began = time.perf_counter()
            capture = work.render(0, seed, progress=progress)
            seconds = time.perf_counter() - began
        else:
            capture, seconds = _in_parts(work, seed, kept, progress)
        say_black("simulate", capture)
        if chain is not None and capture.transient is not None:
            light = measured(in_film_shape(capture.transient, capture.scan), capture.scan, chain, generator)
            capture = replace(capture, transient=in_scan_shape(light, capture.scan))
        if kept is not None and not keep_part:
            kept.remove()
    metadata = {
        "spp": work.film.spp, "seed": seed, "seconds": seconds, "parts": work.count, "variant": work.variant.name,
        "variant_reason": work.variant.why, "light": forecast.light,
    }  # fmt: skip
    return replace(capture, metadata=metadata)


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
        hidden: hidden shapes, or a complete scene, see :func:`simulate`.
        scan: scan that knows its wall, or None for a complete scene.
        part: name of the part file.
        tiles: number of parts.
        variant: Mitsuba variant, or None, see :func:`simulate`.
        settings: other arguments of :func:`simulate`.

    Raises:
        ArgumentError: for unknown arguments; others as :func:`simulate`.
    """
    checked_seed("forecast", settings.get("seed", DEFAULT_SEED))
    unknown = sorted(settings.keys() - inspect.signature(simulate).parameters.keys())
    if unknown:
        raise ArgumentError(f"forecast: expected the arguments of simulate, got {', '.join(unknown)}.")
    time_axis, frequencies, spp = (settings.get(name) for name in ("time_axis", "frequencies", "spp"))
    of_light = settings.get("bounces"), settings.get("energy")
    path = None if part is None else path_of(part, "simulate: part")
    work = _work(hidden, scan, time_axis, frequencies, spp, of_light, variant, _parts(scan, path, tiles))
    with active_variant(work.variant.name):
        return _forecast_of(work, timed=True)


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
    if isinstance(hidden, Scene):
        raise ArgumentError(
            "simulate: a tt.Scene has a sensor of its own. Leave scan out to simulate the scene as it is."
        )
    bounces, energy = of_light
    settings: dict[str, Any] = {
        "bounces": DEFAULT_BOUNCES if bounces is None else bounces,
        "energy": DEFAULT_ENERGY if energy is None else energy,
    }
    chosen = _choose_variant(load(capture_scene(hidden, scan, **settings)), variant)
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
            raise ArgumentError(f"simulate: {name} has no effect on a complete scene: {where} say so. Leave it out.")
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
    if variant is None and isinstance(scene, Scene):
        variant = scene._requested_variant
    chosen = _choose_variant(loaded, variant)
    return SceneWork(load(loaded, variant=chosen.name), time_axis, frequencies, spp, chosen, parts)


def _is_complete(scene: Mapping[str, Any]) -> bool:
    """Return True for a dictionary with an integrator: hidden things have none."""
    kinds = [str(node.get("type", "")) for node in scene.values() if isinstance(node, Mapping)]
    return any("path" in kind for kind in kinds) or "integrator" in scene


def _parts(scan: Any, part: Path | None, tiles: int | None) -> int:
    if tiles is None:
        many = EXHAUSTIVE_PARTS if getattr(scan, "kind", None) == "exhaustive" else PARTS
        return 1 if part is None else many
    return count("simulate: tiles", tiles, 1, ArgumentError)


# ------------------------------------------------------------------------------------------------------------- renders


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
            capture = work.render(number, _seed_of(seed, number))
            layout = RowLayout.of(capture)
            part = layout.rows(capture)
            seconds = time.perf_counter() - began
            done += seconds
            first, total, before = work.run(number)[0], points, None
            if isinstance(work, SceneWork):
                first, total, before = _slot(number, points), 2 * points, number - 1
                if rows is None and kept is not None and number > 0:
                    rows = kept.rows(_slot(number - 1, points), points)
                weighed = work.share(number) / work.film.spp * part
                part = rows = weighed if rows is None else np.add(rows, weighed, out=rows)
            elif kept is None:
                rows = np.empty((points, layout.columns), np.float32) if rows is None else rows
                rows[slice(*work.run(number))] = part
            if kept is not None:
                about = asdict(layout)
                kept.keep(number, first, part, total=total, seconds=seconds, about=about, instead_of=before)
            bar.update(1)
    assert layout is not None
    if kept is not None:
        whole = isinstance(work, HiddenWork)
        rows = kept.everything() if whole else kept.rows(_slot(work.count - 1, points), points)
        done = kept.seconds
    assert rows is not None
    return Capture(**layout.capture(rows, work.scan, *work.axes()), metadata={}), done


# A sum takes turns in two places, so that the one before is whole while the next is written.
def _slot(number: int, points: int) -> int:
    return (number % 2) * points


def _has(kept: PartFile, work: Work, number: int) -> bool:
    return kept.last is not None and number <= kept.last if isinstance(work, SceneWork) else kept.has(number)
