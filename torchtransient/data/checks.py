"""Checks of a recipe before anything is rendered, and the forecast of its cost."""

from __future__ import annotations

import contextlib
import tempfile
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import count
from torchtransient.data.distributions import POSE, Choice, Draw, Extreme, Fixed, Stream
from torchtransient.data.maker import Kept, Maker, check_film
from torchtransient.data.run_settings import bytes_text
from torchtransient.data.sample import OutsideLight, Sample
from torchtransient.data.specification import Specification, Structure
from torchtransient.errors import (
    SceneError,
    StorageError,
    TorchTransientError,
    TorchTransientWarning,
    UnitError,
    level_of_user,
)
from torchtransient.plugins.mitsuba_compat import POSITIONS
from torchtransient.plugins.parameters import PhysicalRange
from torchtransient.rendering.progress import with_bar
from torchtransient.rendering.threads import threads
from torchtransient.scene.physics import is_singular, outside_message, singular_message
from torchtransient.scene.variant import active_variant

# (2, 3): lower and upper corner of a box along the axes of the world; a point is a box without a size.
Box = NDArray[np.float64]
# Samples that are drawn, and structures that are built, for a check.
SAMPLES, STRUCTURES = 64, 8
# Structures that are measured, and calls of each before a time counts: the second one is recorded, the third launched.
_MEASURED, _WARM = 4, 3


def check_recipe(recipe: Specification, maker: Maker) -> None:
    """Check keys, distributions, physical ranges, light, labels and reach of a recipe, at the ends of all distributions
    and in the first 64 samples.

    Args:
        recipe: description.
        maker: maker whose scenes are used.

    Raises:
        SceneError: and ShapeError, UnitError and other errors of this library for a recipe that cannot be rendered.
    """
    _warn_of_many_scenes(recipe)
    named: dict[str, dict[str, list[str]]] = {}
    for structure, indices in structures_of(recipe, range(SAMPLES)):
        kept = maker.kept(structure)
        check_film(kept.film, maker.film, f"structure '{structure.text}'", "sample 0")
        kept.check_labels()
        _check_names(named.setdefault(structure.name, kept.named()), kept)
        draws = list(_draws(recipe, kept, indices))
        for number, (_, drawn) in enumerate(draws if kept.device_keys else draws[:1]):
            kept.check_device(drawn, measures=number == 0)
        with active_variant(recipe.variant):
            built = kept.renderer.scene.built(kept.renderer._options)
            ranges = built.ranges()
            for where, drawn in draws:
                _check_ranges(ranges, kept, where, drawn)
            if kept.scan is None:
                _check_light(built, kept, [drawn for _, drawn in draws])
            check_reach(built, kept, draws)


def light_outside(recipe: Specification, maker: Maker, progress: bool = False) -> OutsideLight:
    """Measure the light of the first samples outside of the time window.

    Args:
        recipe: description.
        maker: maker whose scenes are used.
        progress: show a bar.

    Returns:
        Shares over 64 samples; zero samples for films without a time window.
    """
    shares: list[tuple[float, float]] = []
    failed: list[str] = []
    found = structures_of(recipe, range(SAMPLES)) if maker.film["axis"] is not None else []
    pairs = [(structure, index) for structure, indices in found for index in indices]
    for structure, index in with_bar(pairs, "check", progress):
        # A sample that raises is a failed one of the data set, not a wrong recipe.
        try:
            shares.append(maker.kept(structure).outside(index))
        except TorchTransientError as error:
            failed.append(f"sample {index}: {error}")
    return OutsideLight.of(shares, failed)


def structures_of(recipe: Specification, indices: Iterable[int]) -> list[tuple[Structure, list[int]]]:
    """Return the structures of some samples in the order in which they come, 8 at most, each scene of the recipe among
    them.

    Args:
        recipe: description.
        indices: numbers of the samples in the recipe, from 0.

    Returns:
        Pairs of a structure and the samples that have it.
    """
    found: dict[str, tuple[Structure, list[int]]] = {}
    # Every scene, also one of small weight.
    for name in recipe.scenes.names if len(recipe.scenes.names) > 1 else ():
        structure = Structure(name, name, recipe.structure(0).entries)
        found[structure.key] = (structure, [])
    for index in indices:
        structure = recipe.structure(index)
        if structure.key in found or len(found) < STRUCTURES:
            found.setdefault(structure.key, (structure, []))[1].append(index)
    return list(found.values())


def check_reach(built: Any, kept: Kept, draws: Iterable[tuple[str, Mapping[str, Any]]]) -> None:
    """Check that every moved shape can be seen before the time axis ends, by boxes around shapes, lights and sensors.

    Lights without a place (skies, directional ones) and films without a time axis are not checked.

    Args:
        built: scene of Mitsuba.
        kept: scene of the structure.
        draws: pairs of a text for messages and drawn values by key.

    Raises:
        SceneError: where the shortest path of light over the shape is longer than the axis.
    """
    axis = kept.renderer.axis
    # A pulse that is centred elsewhere brings light at other times.
    if axis is None or not kept.places or kept.renderer._pulsed:
        return
    boxes = {shape.id(): _box(shape.bbox()) for shape in built.scene.shapes() if shape.bbox().valid()}
    for where, drawn in draws:
        moved = _moved(kept, drawn, boxes)
        ends = _ends(built, kept, drawn, boxes | moved)
        if ends is None:
            return
        first, last = ends
        for name, box in moved.items():
            shines = any(box is light for light in first)
            way = min((0.0 if shines else _between(light, box)) for light in first)
            shortest = way + min(_between(box, eye) for eye in last)
            if shortest > axis.end_opl:
                key = next(key for key in kept.places if key.rsplit(".", 1)[0] == name)
                raise SceneError(
                    f"recipe: vary: {key!r} {where} leaves the window: the shortest way of light over {name!r} is "
                    f"{shortest:.4g} m, the time axis ends at {axis.end_opl:.4g} m. Make the axis longer, or keep it "
                    "closer."
                )


def _moved(kept: Kept, drawn: Mapping[str, Any], boxes: Mapping[str, Box]) -> dict[str, Box]:
    """Boxes of the shapes that a draw moves, by their names."""
    found = {}
    for key, place in kept.places.items():
        name, entry = key.rsplit(".", 1)
        if name not in boxes or place.described is None:
            continue
        if entry == "to_world" and place.kind == POSE:
            found[name] = _transformed(boxes[name], drawn[key] @ np.linalg.inv(place.described))
        elif entry == POSITIONS:
            vertices = np.asarray(drawn[key]).reshape(-1, 3)
            found[name] = np.stack([vertices.min(0), vertices.max(0)])
    return found


def _ends(built: Any, kept: Kept, drawn: Mapping[str, Any], boxes: Mapping[str, Box]) -> Any:
    """Boxes of light sources and of sensors; None where light comes from everywhere."""
    if kept.scan is not None:
        scan = kept.scan
        lit, seen = (points.detach().cpu().numpy().reshape(-1, 3) for points in (scan.laser_points, scan.sensor_points))
        return [np.stack([lit.min(0), lit.max(0)])], [np.stack([seen.min(0), seen.max(0)])]
    lights = []
    for emitter in built.scene.emitters():
        light = _place_of(emitter, drawn, boxes)
        if light is None:
            return None
        lights.append(light)
    if getattr(built.scene.integrator(), "camera_unwarp", False):
        # Lengths are counted to the first thing seen.
        return lights, [np.array([[-np.inf] * 3, [np.inf] * 3])]
    eyes = []
    for sensor in built.scene.sensors():
        shape = sensor.get_shape()
        if shape is not None:
            eyes.append(boxes.get(shape.id(), _box(shape.bbox())))
            continue
        pose = drawn.get(f"{sensor.id()}.to_world", np.array(sensor.world_transform().matrix).reshape(4, 4, -1)[..., 0])
        eyes.append(np.stack([pose[:3, 3]] * 2))
    return lights, eyes


def _place_of(emitter: Any, drawn: Mapping[str, Any], boxes: Mapping[str, Box]) -> Box | None:
    shape = emitter.get_shape()
    if shape is not None:
        return boxes.get(shape.id(), _box(shape.bbox()))
    box = emitter.bbox()
    for entry in ("position", "to_world"):
        value = drawn.get(f"{emitter.id()}.{entry}")
        if value is not None:
            point = np.asarray(value if entry == "position" else value[:3, 3], dtype=np.float64)
            return np.stack([point, point])
    return _box(box) if box.valid() else None


def _box(box: Any) -> Box:
    return np.stack([np.array(corner, dtype=np.float64).reshape(3) for corner in (box.min, box.max)])


def _transformed(box: Box, matrix: NDArray[np.float64]) -> Box:
    corners = np.array([[box[i, 0], box[j, 1], box[k, 2], 1.0] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    points = (corners @ matrix.T)[:, :3]
    return np.stack([points.min(0), points.max(0)])


def _between(a: Box, b: Box) -> float:
    """Shortest distance of two boxes."""
    gap = np.maximum(0.0, np.maximum(a[0] - b[1], b[0] - a[1]))
    return float(np.linalg.norm(gap))


def _warn_of_many_scenes(recipe: Specification) -> None:
    """Warn of exchanged entries that are another one in every sample, so that each builds a scene."""
    for key in recipe.exchanged:
        distribution = recipe.vary[key]
        if isinstance(distribution, Choice):
            continue
        better = sorted(name for name in recipe._parameters if name.startswith(f"{key}."))
        advice = f"{better[0]!r} varies as a value" if better else "a Choice builds as many as it has values"
        warnings.warn(
            f"recipe: vary: {key!r} is an entry of the scene's description, and {type(distribution).__name__} draws "
            f"another one for each sample: every sample builds a scene of its own; {advice}.",
            TorchTransientWarning,
            level_of_user(),
        )


def _draws(recipe: Specification, kept: Kept, indices: Iterable[int]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Draws that can come: the ends of every distribution, the first samples, and every choice."""
    for words, upper in (("lower", False), ("upper", True)):
        # Errors of all ends at once alone do not count: no sample may ever draw them together.
        with contextlib.suppress(TorchTransientError):
            yield f"at the {words} end", kept.drawn({key: Extreme(upper) for key in recipe.vary})
    for index in indices:
        yield f"of sample {index}", kept.draw(index)
    # Choices of small weight too.
    for key in (*kept.keys, *kept.device_keys):
        choices = recipe.vary[key]
        if isinstance(choices, Choice):
            streams: dict[str, Draw] = {other: Stream(recipe.seed, 0, other) for other in recipe.vary}
            for number in range(len(choices.values)):
                yield f"with choice {number} of {key!r}", kept.drawn(streams | {key: Fixed(choices.share(number))})


def _check_names(expected: Mapping[str, list[str]], kept: Kept) -> None:
    """Raise SceneError where a label would number other things in another structure of the same scene."""
    for label in ("shapes", "materials"):
        if kept.named().get(label) != expected.get(label):
            raise SceneError(
                f"recipe: labels: the {label} of structure '{kept.structure.text}' are {kept.named()[label]}, others "
                f"have {expected[label]}: a number would stand for another one. Exchange things of one name, or give "
                "each scene of its own to OneOf."
            )


def _check_ranges(ranges: Mapping[str, PhysicalRange], kept: Kept, where: str, drawn: Mapping[str, Any]) -> None:
    for key, place in kept.places.items():
        with np.errstate(over="ignore"):
            value = np.asarray(drawn[key], dtype=np.float32)
        if not np.isfinite(value).all():
            raise UnitError(f"recipe: vary: {key!r} {where}: expected finite numbers, got {value.tolist()}.")
        limits = ranges.get(key)
        if limits is not None and (limits.above(float(value.max())) or limits.below(float(value.min()))):
            message = outside_message(key, limits, float(value.min()), float(value.max()))
            first = message.split(". Keep ")[0].split(": expected ")
            wanted = f"; expected {first[1]}" if len(first) > 1 else ""
            raise UnitError(f"recipe: vary: {where}, {first[0]}{wanted}. Choose a smaller range, or cut it off.")
        if place.kind == POSE and is_singular(value):
            raise UnitError(f"recipe: vary: {where}: {singular_message(key)}")


def _check_light(built: Any, kept: Kept, draws: Sequence[Mapping[str, Any]]) -> None:
    """Raise SceneError for a scene without an emitter, and where none of them ever shines."""
    import mitsuba as mi

    from torchtransient.plugins.parameters import LIGHT, described_ranges

    emitters = list(built.scene.emitters())
    where = f"structure '{kept.structure.text}': " if kept.structure.text else ""
    if not emitters:
        raise SceneError(f"recipe: {where}expected a scene with a light, got one without any emitter. Add one.")
    brightest = {key: float(high) for key, limits, _, high in described_ranges(built.params) if limits == LIGHT}
    for key in set(brightest) & set(kept.places):
        brightest[key] = max(float(np.max(drawn[key])) for drawn in draws)
    # Lights without such a number (environment maps) shine.
    lights = [_emitter_of(built.params, key, mi.Emitter) for key in brightest]
    if max(brightest.values(), default=1.0) <= 0 and all(emitter in lights for emitter in emitters):
        dark = ", ".join(repr(key) for key in brightest)
        raise SceneError(f"recipe: {where}no light ever shines: {dark} is zero in the scene and in every sample.")


def _emitter_of(params: Any, key: str, kind: Any) -> Any:
    node = params.properties[key][2]
    while node is not None and not isinstance(node, kind):
        node = params.hierarchy[node][0]
    return node


@dataclass(frozen=True)
class StructureCost:
    """Cost of one structure, in seconds with one thread, which workers have.

    Args:
        text: name of the structure.
        first_s: seconds from nothing to its first sample (building, tracing, compiling).
        sample_s: seconds of each sample after that, median.
    """

    text: str
    first_s: float
    sample_s: float


@dataclass(frozen=True)
class Cost:
    """Forecast by :meth:`Recipe.cost`; ``str`` of it is a table.

    Args:
        values: keys that vary as values.
        exchanged: keys whose every new combination is a new structure.
        seen: number of structures among the first 64 samples.
        structures: cost of those that were measured.
        sample_bytes: bytes of a sample before compression.
        stored_bytes: bytes of a sample on disk by store, None where it could not be measured.
        outside: light outside of the time window, see :meth:`Recipe.check`.
        standard_error: relative standard error of the numbers of one sample.
        n: number of samples in the data set, None where the recipe does not say.
    """

    values: tuple[str, ...]
    exchanged: tuple[str, ...]
    seen: int
    structures: tuple[StructureCost, ...]
    sample_bytes: int
    stored_bytes: dict[str, float | None]
    outside: OutsideLight
    standard_error: float
    n: int | None

    @property
    def sample_s(self) -> float:
        """Seconds of a sample, with its share of building structures: in shards of 64 samples each structure is built
        once. The first one measured may have compiled, which happens once; it counts where it is the only one.
        """
        kept = float(np.mean([one.sample_s for one in self.structures]))
        if self.seen < 2:
            return kept
        built = float(np.mean([one.first_s for one in self.structures[1:]]))
        new = self.seen / SAMPLES
        return new * built + (1 - new) * kept

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        yield f"only values       {', '.join(self.values) or 'none'}"
        built = ", ".join(self.exchanged) or "nothing: one structure for all samples"
        seen = f"; {self.seen} structures in {SAMPLES} samples" if self.exchanged else ""
        yield f"built when new    {built}{seen}"
        for one in self.structures:
            name = f" ({one.text})" if one.text else ""
            yield f"seconds           {one.first_s:.2f} for the first sample, then {one.sample_s:.4f} each{name}"
        yield f"bytes a sample    {bytes_text(self.sample_bytes)} before compression"
        for store, size in self.stored_bytes.items():
            if size is not None:
                yield f"  store={store!r:<10} {bytes_text(size)}, {self.sample_bytes / size:.1f} times smaller"
        yield f"light outside     {self.outside}"
        yield f"standard error    {self.standard_error:.1%} of a sample's numbers (root mean square)"
        if self.n is not None:
            sizes = [self.n * size for size in (*self.stored_bytes.values(), self.sample_bytes) if size]
            least, most = bytes_text(min(sizes)), bytes_text(max(sizes))
            yield f"{self.n} samples    {_duration(self.n * self.sample_s / 3600)} of one worker, {least} to {most}"


def _duration(hours: float) -> str:
    if hours >= 1:
        return f"{hours:.2f} hours"
    return f"{60 * hours:.1f} minutes" if hours >= 1 / 60 else f"{3600 * hours:.2g} seconds"





def forecast(recipe: Specification, maker: Maker, samples: int, progress: bool, outside: OutsideLight) -> Cost:
    """Measure the cost of a recipe, see :meth:`Recipe.cost`.

    Args:
        recipe: description.
        maker: maker whose scenes are used; its scenes are built anew.
        samples: number of samples that are timed of each of the first 4 structures, after 3 that warm up.
        progress: show a bar.
        outside: result of :func:`light_outside`.

    Returns:
        Cost.
    """
    steps = _WARM + count("cost: samples", samples)
    found = structures_of(recipe, range(SAMPLES))
    costs, rendered = [], []
    times: list[float] = []
    # Workers compute with one thread.
    with threads(1):
        calls = [(one, step) for one in found[:_MEASURED] for step in range(steps)]
        for (structure, indices), step in with_bar(calls, "cost", progress):
            if step == 0:
                # From nothing, without the scenes that check() has built.
                maker.forget(structure)
                times = []
            start = time.perf_counter()
            rendered.append(maker.sample(indices[step % len(indices)]))
            times.append(time.perf_counter() - start)
            if step == steps - 1:
                costs.append(StructureCost(structure.text, times[0], float(np.median(times[_WARM:]))))
    return Cost(
        values=tuple(key for key in recipe.vary if key not in recipe.exchanged),
        exchanged=tuple(recipe.exchanged),
        seen=len({recipe.structure(index).key for index in range(SAMPLES)}),
        structures=tuple(costs),
        sample_bytes=sum(array.nbytes for array in rendered[0].arrays.values()),
        stored_bytes=_stored(rendered, maker),
        outside=outside,
        standard_error=maker.standard_error(found[0][1][0]),
        n=recipe.n,
    )


def _stored(samples: list[Sample], maker: Maker) -> dict[str, float | None]:
    """Bytes of a sample on disk, by store."""
    from torchtransient.data.shard_format import STORES
    from torchtransient.data.shards import ShardWriter

    several = list({sample.index: sample for sample in samples}.values())
    found: dict[str, float | None] = {}
    for store in STORES:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "shard.h5"
            try:
                with ShardWriter(path, len(several), {"about": maker.about()}, store=store) as shard:
                    for row, sample in enumerate(several):
                        shard.put(row, sample)
                found[store] = path.stat().st_size / len(several)
            except StorageError:
                # Light is no counts, and a package may be missing.
                found[store] = None
    return found
