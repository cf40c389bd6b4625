"""What can be wrong with a recipe, said before anything is rendered."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from torchtransient.data.recipes.distribution import POSE
from torchtransient.data.recipes.distributions import Choice
from torchtransient.data.recipes.kept_scene import Kept
from torchtransient.data.recipes.maker import Maker
from torchtransient.data.recipes.outside_light import OutsideLight
from torchtransient.data.recipes.reach import check_reach
from torchtransient.data.recipes.specification import Specification
from torchtransient.data.recipes.streams import Draw, Extreme, Fixed, Stream
from torchtransient.data.recipes.structures import Structure
from torchtransient.errors import SceneError, TorchTransientError, TorchTransientWarning, UnitError, level_of_user
from torchtransient.plugins.parameters import PhysicalRange
from torchtransient.rendering.progress import with_bar
from torchtransient.scene.physics import is_singular, outside_message, singular_message
from torchtransient.scene.variant import active_variant

# Samples that are drawn, and structures among them that are built, for a look.
SAMPLES, STRUCTURES = 64, 8


def check_recipe(recipe: Specification, maker: Maker) -> None:
    """Raise SceneError, ShapeError, UnitError, or another error of this library, for what is wrong."""
    _tell_of_many_scenes(recipe)
    expected = maker.measures()
    named: dict[str, dict[str, list[str]]] = {}
    for structure, indices in structures_of(recipe, range(SAMPLES)):
        kept = maker.kept(structure)
        kept.measures.check(expected, f"structure '{structure.text}'", "sample 0")
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
    """Light of the first samples that the time window misses; not looked at for films without one."""
    shares: list[tuple[float, float]] = []
    failed: list[str] = []
    found = structures_of(recipe, range(SAMPLES)) if maker.measures().axis is not None else []
    pairs = [(structure, index) for structure, indices in found for index in indices]
    for structure, index in with_bar(pairs, "check", progress):
        # A sample that raises is a failed one of the data set, not a wrong recipe.
        try:
            shares.append(maker.kept(structure).outside(index))
        except TorchTransientError as error:
            failed.append(f"sample {index}: {error}")
    return OutsideLight.of(shares, failed)


def _tell_of_many_scenes(recipe: Specification) -> None:
    """Warn of entries of which every sample has another one."""
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


def structures_of(recipe: Specification, indices: Iterable[int]) -> list[tuple[Structure, list[int]]]:
    """The structures of some samples, in the order in which they come, and which samples are theirs; at most
    ``STRUCTURES`` of them.
    """
    found: dict[str, tuple[Structure, list[int]]] = {}
    # Every scene, however seldom it comes.
    for name in recipe.scenes.names if len(recipe.scenes.names) > 1 else ():
        structure = Structure(name, name, recipe.structure(0).entries)
        found[structure.key] = (structure, [])
    for index in indices:
        structure = recipe.structure(index)
        if structure.key in found or len(found) < STRUCTURES:
            found.setdefault(structure.key, (structure, []))[1].append(index)
    return list(found.values())


def _draws(recipe: Specification, kept: Kept, indices: Iterable[int]) -> Iterator[tuple[str, dict[str, Any]]]:
    """What can come: the ends of every distribution, and the first samples."""
    for words, upper in (("lower", False), ("upper", True)):
        # What is wrong everywhere is wrong in samples, too; all ends at once may be what no sample ever draws.
        with contextlib.suppress(TorchTransientError):
            yield f"at the {words} end", kept.drawn({key: Extreme(upper) for key in recipe.vary})
    for index in indices:
        yield f"of sample {index}", kept.draw(index)
    # Of what seldom comes too.
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
    # A light that has no such number (a sky, a picture of the surroundings) shines.
    lights = [_emitter_of(built.params, key, mi.Emitter) for key in brightest]
    if max(brightest.values(), default=1.0) <= 0 and all(emitter in lights for emitter in emitters):
        dark = ", ".join(repr(key) for key in brightest)
        raise SceneError(f"recipe: {where}no light ever shines: {dark} is zero in the scene and in every sample.")


def _emitter_of(params: Any, key: str, kind: Any) -> Any:
    node = params.properties[key][2]
    while node is not None and not isinstance(node, kind):
        node = params.hierarchy[node][0]
    return node
