"""The scenes of a recipe: what it starts from, and the entries of it that are exchanged.

A *structure* is a scene with its exchanged entries: it is built once and kept, while parameters vary in it. Entries are
named by where they stand in the scene dictionary: ``box.filename``, ``box.bsdf``, ``lamp``; of an XML scene by their
``$name``.
"""

from __future__ import annotations

import copy
import functools
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torchtransient.capture import Scan
from torchtransient.checks import Numbers, shown
from torchtransient.data.recipes.distributions import checked_choices
from torchtransient.errors import SceneError
from torchtransient.files.content_key import content_key
from torchtransient.scene.description import DictDescription, Plain, XmlDescription, describe_dict
from torchtransient.scene.inventory import described_samplers
from torchtransient.scene.load import Scene, load
from torchtransient.scene.objects import LoadedScene
from torchtransient.scene.samplers import sampler_for, sampler_for_all

# The key that stands for the scan of a capture.
SCAN = "scan"


class OneOf:
    """Several scenes, one of which each sample takes: a list, or a mapping from names. ``weights``: how often each
    comes, None for evenly. Raises SceneError for no scene, UnitError for weights that are none.
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
    """``name``: of its scene. ``text``: for people. ``entries``: what is exchanged."""

    name: str
    text: str
    entries: tuple[tuple[str, Any], ...] = ()

    @functools.cached_property
    def key(self) -> str:
        """Equal for equal structures alone."""
        return content_key(self.name, *self.entries)


class Scenes:
    """What a recipe starts from: scenes by name (one, "", unless ``OneOf`` is given), or with ``scan`` hidden things.

    Raises SceneError for what cannot be described.
    """

    def __init__(self, given: Any, variant: str, scan: Scan | None, parameters: Mapping[str, Any] | None) -> None:
        several = given if isinstance(given, OneOf) else OneOf({"": given})
        self.weights, self.variant, self.scan = several.weights, variant, scan
        self.descriptions = {
            name: _description(scene, scan, parameters or {}) for name, scene in several.scenes.items()
        }

    @property
    def names(self) -> list[str]:
        """Of the scenes."""
        return list(self.descriptions)

    def sampler(self) -> str:
        """Return the sampler that renderers take for these scenes: a plugin name, or "auto" where scenes differ."""
        if self.scan is not None:  # the sensors of a capture name none
            return sampler_for(None)
        scenes = (Scene(description, self.variant) for description in self.descriptions.values())
        return sampler_for_all(name for scene in scenes for name in described_samplers(scene))

    def has_entry(self, key: str) -> bool:
        """Whether a key stands for an entry of the description of every scene."""
        return all(_has(description, key, self.scan) for description in self.descriptions.values())

    def parameters(self, bounces: Any, energy: Any) -> frozenset[str]:
        """Keys that have a derivative in the (first) scene as it is described."""
        given, scan = self.build(Structure(self.names[0], ""))
        if scan is not None:
            from torchtransient.nlos.scene import capture_scene

            given = load(capture_scene(given, scan, bounces=bounces, energy=energy), self.variant)
        return frozenset(given.parameters().differentiable())

    def build(self, structure: Structure) -> tuple[Any, Scan | None]:
        """The scene of a structure as ``tt.load`` takes it (hidden shapes for a capture), and its scan."""
        description, scan = self.descriptions[structure.name], self.scan
        # Nodes before what is in them.
        for key, value in sorted(structure.entries, key=lambda entry: entry[0].count(".")):
            if key == SCAN and self.scan is not None:
                scan = _checked_scan(value)
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
    # Imported where it is used: captures read files of this room.
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
    # Through the checks of a description of its own.
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


def _checked_scan(value: Any) -> Scan:
    if not isinstance(value, Scan):
        raise SceneError(f"recipe: expected tt.nlos.Scan as choices of 'scan', got {shown(value)}.")
    return value
