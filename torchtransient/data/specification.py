"""Content of a recipe: its scenes, the entries that are exchanged, the distributions and the measurement. Nothing is
rendered here.

A *structure* is a scene with its exchanged entries: it is built once and kept, while parameters vary in it. Entries are
named by their place in the scene dictionary: ``box.filename``, ``box.bsdf``, ``lamp``; of an XML scene by their
``$name``.
"""

from __future__ import annotations

import copy
import functools
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from torchtransient.axes import FrequencyAxis, RateAxis, TimeAxis
from torchtransient.capture import Scan
from torchtransient.checks import (
    Numbers,
    count,
    is_one_of,
    numbers,
    several,
    shown,
)
from torchtransient.chirps import Chirps
from torchtransient.data.distributions import Choice, Distribution, Place, Stream, checked_choices, pick
from torchtransient.data.serialization import read_distribution
from torchtransient.errors import ArgumentError, SceneError, ShapeError
from torchtransient.files.content_key import content_key
from torchtransient.gates import Gate
from torchtransient.pulses import Pulse
from torchtransient.rendering.arguments import checked_filter, checked_sampler
from torchtransient.scene.description import DictDescription, Plain, XmlDescription, describe_dict
from torchtransient.scene.inventory import described_samplers
from torchtransient.scene.load import Scene, load
from torchtransient.scene.objects import LoadedScene
from torchtransient.scene.samplers import OF_SCENE, sampler_for, sampler_for_all
from torchtransient.scene.variant import resolve_variant
from torchtransient.sensing import Device
from torchtransient.sensing import device as device_by_name

# Key of the scan of a capture.
SCAN = "scan"


class OneOf:
    """Several scenes, one of which each sample takes.

    Args:
        scenes: list of scenes, or scenes by name.
        weights: relative frequencies, None for even ones.

    Raises:
        SceneError: for no scene.
        UnitError: for other weights.
    """

    def __init__(self, scenes: Sequence[Any] | Mapping[str, Any], weights: Numbers | None = None) -> None:
        names: list[str] = []
        values: Any = scenes
        if isinstance(scenes, Mapping):
            if "type" in scenes:
                raise SceneError("OneOf: expected several scenes by name, got one. Give it to the recipe itself.")
            names, values = [str(name) for name in scenes], list(scenes.values())
        plain, self.weights = checked_choices("OneOf", values, weights)
        names = names or [str(number) for number in range(len(plain))]
        self.scenes = dict(zip(names, plain, strict=True))


@dataclass(frozen=True)
class Structure:
    """Scene with its exchanged entries.

    Args:
        name: name of the scene.
        text: short text that names the structure in messages and contact sheets.
        entries: pairs of a key and its value.
    """

    name: str
    text: str
    entries: tuple[tuple[str, Any], ...] = ()

    @functools.cached_property
    def key(self) -> str:
        """Hash, equal for equal structures alone."""
        return content_key(self.name, *self.entries)


class Scenes:
    """Scenes of a recipe by name (one, "", unless ``OneOf`` is given), or hidden things.

    Args:
        given: scene, OneOf, or the hidden things where there is a ``scan``.
        variant: variant of Mitsuba.
        scan: scan of a capture, or None.
        parameters: values of the $names of an XML scene.

    Raises:
        SceneError: for scenes that cannot be described.
    """

    def __init__(self, given: Any, variant: str, scan: Scan | None, parameters: Mapping[str, Any] | None) -> None:
        several = given if isinstance(given, OneOf) else OneOf({"": given})
        self.weights, self.variant, self.scan = several.weights, variant, scan
        self.descriptions = {
            name: _description(scene, scan, parameters or {}) for name, scene in several.scenes.items()
        }

    @property
    def names(self) -> list[str]:
        """Names of the scenes."""
        return list(self.descriptions)

    def sampler(self) -> str:
        """Return the sampler that renderers take for these scenes: a plugin name, or "auto" where scenes differ."""
        if self.scan is not None:  # sensors of captures have none
            return sampler_for(None)
        scenes = (Scene(description, self.variant) for description in self.descriptions.values())
        return sampler_for_all(name for scene in scenes for name in described_samplers(scene))

    def has_entry(self, key: str) -> bool:
        """Return True for a key of an entry in the description of every scene.

        Args:
            key: key in the ``vary`` of the recipe.

        Returns:
            Truth value.
        """
        return all(_has(description, key, self.scan) for description in self.descriptions.values())

    def parameters(self, bounces: Any, energy: Any) -> frozenset[str]:
        """Return the keys with a derivative in the first scene as it is described.

        Args:
            bounces: numbers of bounces that count in a capture.
            energy: joules of the laser of a capture.

        Returns:
            Keys.
        """
        given, scan = self.build(Structure(self.names[0], ""))
        if scan is not None:
            from torchtransient.nlos.scene import capture_scene

            given = load(capture_scene(given, scan, bounces=bounces, energy=energy), self.variant)
        return frozenset(given.parameters().differentiable())

    def build(self, structure: Structure) -> tuple[Any, Scan | None]:
        """Build the scene of a structure.

        Args:
            structure: scene of the recipe with its exchanged entries.

        Returns:
            Scene as ``tt.load`` takes it (hidden shapes for a capture), and its scan.
        """
        description, scan = self.descriptions[structure.name], self.scan
        # Nodes before their entries.
        for key, value in sorted(structure.entries, key=lambda entry: entry[0].count(".")):
            if key == SCAN and self.scan is not None:
                scan = value
            else:
                description = _exchanged(description, key, value)
        if scan is not None:
            assert isinstance(description, DictDescription)
            return {name: node for name, node in description.tree.items() if name != "type"}, scan
        return Scene(description, self.variant), None


def _description(given: Any, scan: Scan | None, parameters: Mapping[str, Any]) -> Plain:
    if scan is None:
        scene = load(given, **parameters) if isinstance(given, str | os.PathLike) else load(given)
        if parameters and not isinstance(scene._description, XmlDescription):
            raise SceneError("recipe: parameters fill the $names of XML files; a dictionary has none. Leave them out.")
        scene._description.check_described("recipe")
        assert not isinstance(scene._description, LoadedScene)
        return scene._description
    if parameters:
        raise SceneError("recipe: parameters fill the $names of XML files; a capture has none. Leave them out.")
    # Here, since captures import files of this room.
    from torchtransient.nlos.scene import shapes_of

    return describe_dict({"type": "scene", **shapes_of(given)})


def _has(description: Plain, key: str, scan: Scan | None) -> bool:
    if key == SCAN:
        return scan is not None
    if isinstance(description, XmlDescription):
        return key.startswith("$")
    node: Any = description.tree
    *above, last = key.split(".")
    for name in above:
        node = node.get(name) if isinstance(node, dict) else None
    return isinstance(node, dict) and last in node and key != "type"


def _exchanged(description: Plain, key: str, value: Any) -> Plain:
    if isinstance(description, XmlDescription):
        parameters = dict(description.parameters) | {key.removeprefix("$"): str(_plain(value))}
        return replace(description, parameters=tuple(sorted(parameters.items())))
    # Checked as a description of its own.
    fresh = describe_dict({"type": "scene", "entry": {"type": "entry", "value": value}}).tree["entry"]["value"]
    tree = copy.deepcopy(description.tree)
    *above, last = key.split(".")
    node: Any = tree
    for name in above:
        node = node.get(name) if isinstance(node, dict) else None
    if not isinstance(node, dict) or last not in node:
        raise SceneError(
            f"recipe: vary: {key!r} is no entry of the scene any more, where another node stands in its place. Give "
            "that entry to all nodes to choose from."
        )
    if isinstance(node[last], dict) and not above and not isinstance(fresh, dict):
        raise SceneError(
            f"recipe: vary: {key!r} is a whole {node[last].get('type', 'node')!r}: expected a Choice of dictionaries, "
            f"got {shown(value)}. To vary a number in it, name that: scene.parameters() lists the keys."
        )
    node[last] = fresh
    return replace(description, tree=tree)


def _plain(value: Any) -> Any:
    if isinstance(value, bool):
        return str(value).lower()
    if hasattr(value, "item") and np.size(value) == 1:
        return value.item()
    if not isinstance(value, str | int | float):
        raise SceneError(f"recipe: $names of XML files take texts and numbers, got {shown(value)}.")
    return value


# First part of the keys of a device's stages: "device.PhotonBudget.cycles".
DEVICE = "device"
# Purposes of random numbers besides keys.
_SCENE, RENDER, NOISE, SECOND = "scene of OneOf", "seed of the render", "seed of the noise", "seed of another render"


@dataclass(frozen=True)
class Settings:
    """Arguments of the measurement, see :class:`Recipe`.

    Args:
        labels: see :class:`Recipe` for these and all others.
    """

    labels: tuple[str, ...] = ()
    keep: tuple[str, ...] | None = None
    time_axis: TimeAxis | None = None
    frequencies: FrequencyAxis | None = None
    gates: tuple[Gate, ...] | None = None
    rates: RateAxis | None = None
    chirps: Chirps | None = None
    temporal_filter: str = "auto"
    spp: int | None = None
    max_depth: int | None = None
    sensors: Any = 0
    pulse: Pulse | None = None
    irf: Pulse | None = None
    bounces: tuple[int, ...] | str = (3,)
    energy: Any = 1.0
    physics: str = "ignore"
    # The default of recipes that are older than this setting.
    sampler: str = OF_SCENE


class Specification:
    """Content of :class:`~torchtransient.data.Recipe`, which documents the arguments.

    Args:
        scene: see :class:`Recipe` for this and all others.
    """

    def __init__(
        self,
        scene: Any,
        vary: Mapping[str, Any] | None = None,
        *,
        labels: Sequence[str] = (),
        keep: Sequence[str] | None = None,
        time_axis: TimeAxis | None = None,
        frequencies: FrequencyAxis | Numbers | None = None,
        gates: Sequence[Gate] | None = None,
        rates: RateAxis | None = None,
        chirps: Chirps | None = None,
        temporal_filter: str = "auto",
        spp: int | None = None,
        max_depth: int | None = None,
        sensors: int | Sequence[int] | str = 0,
        variant: str | None = None,
        pulse: Pulse | None = None,
        irf: Pulse | None = None,
        scan: Scan | None = None,
        bounces: Sequence[int] | str = (3,),
        energy: Any = 1.0,
        device: Device | str | Path | Mapping[str, Any] | None = None,
        physics: str = "ignore",
        sampler: str | None = None,
        seed: int = 0,
        parameters: Mapping[str, Any] | None = None,
        n: int | None = None,
        plugins: Sequence[str] = (),
    ) -> None:
        # Before the scene, which may use them.
        self.plugins = _checked_plugins(plugins)
        if not is_one_of(physics, ("ignore", "error")):
            raise ArgumentError(f"recipe: physics: expected 'ignore' or 'error', got {shown(physics)}.")
        if frequencies is not None and not isinstance(frequencies, FrequencyAxis):
            frequencies = FrequencyAxis(tuple(numbers("recipe: frequencies", frequencies)))
        self.seed = count("recipe: seed", seed, 0, most=None)
        self.n = None if n is None else count("recipe: n", n)
        self.variant = resolve_variant(variant)
        self.settings = Settings(
            labels=tuple(labels), keep=None if keep is None else tuple(keep), time_axis=time_axis,
            frequencies=frequencies,
            gates=None if gates is None else tuple(gates), rates=rates, chirps=chirps,
            temporal_filter=checked_filter(temporal_filter),
            spp=None if spp is None else count("recipe: spp", spp),
            max_depth=None if max_depth is None else count("recipe: max_depth", max_depth, -1),
            sensors=_hashable(sensors), bounces=_hashable(bounces),
            pulse=pulse, irf=irf, energy=energy, physics=physics,
        )  # fmt: skip
        self.scan = scan
        self.device = _device(device)
        self.scenes = Scenes(scene, self.variant, scan, parameters)
        sampler = checked_sampler(sampler)
        if sampler is None:
            sampler = OF_SCENE if any("sampler" in str(key).split(".") for key in vary or ()) else self.scenes.sampler()
        self.settings = replace(self.settings, sampler=sampler)
        self._vary = {str(key): read_distribution(f"recipe: {key!r}", given) for key, given in (vary or {}).items()}
        self._check_settings()

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        _checked_plugins(self.plugins)

    def _check_settings(self) -> None:
        if self.scan is not None and self.settings.time_axis is None and self.settings.frequencies is None:
            raise SceneError(
                "recipe: a capture whose hidden things move needs a time_axis= that holds all of their places. "
                "scan.default_axis(bounds) finds one for the corners (2, 3) of the space that they stay in."
            )
        of_device = [key for key in self.vary if key.split(".")[0] == DEVICE and not self.scenes.has_entry(key)]
        if self.device is None and of_device:
            raise SceneError("recipe: keys of 'device.' vary a device; give device= too.")

    @property
    def vary(self) -> Mapping[str, Distribution]:
        """Distributions by key, read-only: make another recipe instead."""
        return MappingProxyType(self._vary)

    # ----------------------------------------------------------------------------------------------- structures

    def structure(self, index: int) -> Structure:
        """Return the structure of a sample.

        Args:
            index: number of the sample in the recipe, from 0.

        Returns:
            Structure.
        """
        names = self.scenes.names
        name = names[pick(Stream(self.seed, index, _SCENE), len(names), self.scenes.weights)]
        entries, words = [], [name] if name else []
        for key in self.exchanged:
            value = self.vary[key].draw(Stream(self.seed, index, key), Place(key))
            entries.append((key, value))
            words.append(f"{key}={label_of(self.vary[key], value)}")
        return Structure(name, ", ".join(words), tuple(entries))

    def is_of_device(self, key: str) -> bool:
        """Return True for the key of an argument of the device.

        Args:
            key: key in the ``vary`` of the recipe.

        Returns:
            Truth value.
        """
        return self.device is not None and key.split(".")[0] == DEVICE

    @functools.cached_property
    def exchanged(self) -> list[str]:
        """Keys that exchange an entry of the description."""
        return [key for key, one in self.vary.items() if self._is_exchanged(key, one)]

    def _is_exchanged(self, key: str, distribution: Distribution) -> bool:
        if self.is_of_device(key) or not self.scenes.has_entry(key):
            return False
        # Numbers of entries that are parameters too vary as values.
        texts = isinstance(distribution, Choice) and any(is_entry(value) for value in distribution.values)
        return texts or key not in self._parameters

    @functools.cached_property
    def _parameters(self) -> frozenset[str]:
        """Parameters with a derivative of the scenes as they are described."""
        return self.scenes.parameters(self.settings.bounces, self.settings.energy)


def _hashable(given: Any) -> Any:
    """A number, a text, or a tuple of numbers."""
    if np.ndim(given) == 0:
        return given
    return tuple(np.asarray(given).tolist())


def _device(given: Any) -> Device | None:
    if given is None or isinstance(given, Device):
        return given
    if isinstance(given, Mapping):
        return Device.from_dict(given)
    path = Path(given)
    if not path.is_file():
        return device_by_name(given)
    return Device.from_json(path) if path.suffix == ".json" else Device.from_yaml(path)


def is_entry(value: Any) -> bool:
    """Return True for a choice that is an entry of a description, no number or array.

    Args:
        value: one of the values of a Choice.

    Returns:
        Truth value.
    """
    return isinstance(value, str | Mapping | Scan | bool) or value is None


def label_of(distribution: Distribution, value: Any) -> str:
    """Return a short text for a drawn entry: texts and numbers themselves, others by their number among the choices.

    Args:
        distribution: distribution of the key.
        value: value that was drawn.

    Returns:
        Text.
    """
    if isinstance(value, str | int | float):
        # The name of a file: data sets do not depend on its folder.
        if isinstance(value, str):
            return Path(value).name if Path(value).is_absolute() else value
        return repr(value.item() if isinstance(value, np.generic) else value)
    if isinstance(distribution, Choice):
        return f"#{next(i for i, one in enumerate(distribution.values) if one is value)}"
    return f"#{content_key(value)[:12]}"


def samples_of(indices: Iterable[int]) -> list[int]:
    """Check numbers of samples.

    Args:
        indices: numbers of the samples in the recipe, from 0.

    Returns:
        List.

    Raises:
        ShapeError: for other numbers.
    """
    return [count("recipe: sample", index, 0, ShapeError) for index in indices]


def _checked_plugins(modules: Sequence[str]) -> tuple[str, ...]:
    """Names of modules, which are added in this process. Raises SceneError, PluginRegistrationError."""
    from torchtransient.plugins import register_module

    found = tuple(several("recipe: plugins", modules, "names of modules in a list", str, SceneError))
    for module in found:
        register_module(module)
    return found
