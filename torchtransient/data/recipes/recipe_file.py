"""Recipes in files: YAML, JSON and plain data, and the text that stands for one.

A file has the arguments of :class:`~torchtransient.data.Recipe` as entries. ``scene`` is the name of an XML file, a
scene dictionary, ``{builtin: cornell_box, resolution: 32}`` for a function of ``tt.scenes``, or ``{one_of: {a: ..., b:
...}, weights: [...]}``. A capture has ``hidden`` instead, with ``wall`` and ``scan`` as in the YAML files of captures
(:mod:`torchtransient.nlos.setup_files`).
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from torchtransient.array_files.part_files import write_text
from torchtransient.array_files.plain_texts import json_data, text_of_file
from torchtransient.axes import RateAxis, TimeAxis
from torchtransient.checks import path_of, short_errors, short_message, shown
from torchtransient.chirps import Chirps
from torchtransient.data.recipes.places import files_of, without_places
from torchtransient.data.recipes.specification import Specification
from torchtransient.data.recipes.structures import OneOf
from torchtransient.data.recipes.written import (
    read,
    read_distribution,
    read_frequencies,
    read_gate,
    read_pulse,
    written,
    written_axis,
    written_frequencies,
    written_shape,
)
from torchtransient.errors import MissingPackageError, SceneError, TorchTransientError
from torchtransient.files.plain_data import scan_data, scan_from_data
from torchtransient.files.yaml_files import Section, read_yaml
from torchtransient.scene.description import DictDescription, XmlDescription, describe_dict
from torchtransient.scene.load import Scene
from torchtransient.scene.motions import BodyMotion
from torchtransient.scene.samplers import OF_SCENE

FORMAT = "torchtransient recipe 1"
# Entries that are the constructor's arguments as they are.
_PLAIN = (
    "labels", "keep", "temporal_filter", "spp", "max_depth", "sensors", "bounces", "energy", "physics", "sampler",
    "variant", "seed", "n", "plugins",
)  # fmt: skip
_ENTRIES = (
    "format", "scene", "parameters", "hidden", "wall", "scan", "vary", "time_axis", "frequencies", "gates", "rates",
    "chirps", "pulse", "irf", "device", *_PLAIN,
)  # fmt: skip
_MOVING = {"rates": RateAxis, "chirps": Chirps}
# What a recipe's samples do not depend on.
_NO_NUMBERS = ("n", "format")


# ------------------------------------------------------------------------------------------------------------ written


def to_dict(recipe: Specification) -> dict[str, Any]:
    """See :meth:`Recipe.to_dict`."""
    settings = recipe.settings
    found: dict[str, Any] = {"format": FORMAT, "scene": _written_scenes(recipe)}
    if recipe.scan is not None:
        found["scan"] = scan_data(recipe.scan)
        found |= {"bounces": written(settings.bounces), "energy": written(settings.energy)}
    found |= {
        "vary": {key: written(one) for key, one in recipe.vary.items()},
        "labels": list(settings.labels),
        "keep": None if settings.keep is None else list(settings.keep),
        "time_axis": written_axis(settings.time_axis),
        "frequencies": written_frequencies(settings.frequencies),
        "gates": None if settings.gates is None else [written_shape(gate) for gate in settings.gates],
        "temporal_filter": settings.temporal_filter,
        "spp": settings.spp,
        "max_depth": settings.max_depth,
        "sensors": written(settings.sensors),
        "pulse": written_shape(settings.pulse),
        "irf": written_shape(settings.irf),
        "device": None if recipe.device is None else recipe.device.to_dict(),
        "physics": settings.physics,
        "variant": recipe.variant,
        "seed": recipe.seed,
        "n": recipe.n,
    }
    # Not in the keys of recipes without them, which are older than these settings.
    found |= {name: asdict(one) for name in _MOVING if (one := getattr(settings, name)) is not None}
    if settings.sampler != OF_SCENE:
        found["sampler"] = settings.sampler
    if recipe.plugins:
        found["plugins"] = list(recipe.plugins)
    # Of JSON: no tuples, and nothing that is not plain.
    try:
        plain: dict[str, Any] = json.loads(json.dumps(found, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise SceneError(f"recipe: expected finite numbers and plain data throughout: {error}.") from error
    return plain


def _written_scenes(recipe: Specification) -> Any:
    scenes = recipe.scenes
    described = {name: _written_scene(one) for name, one in scenes.descriptions.items()}
    if list(described) == [""]:
        return described[""]
    return {"one_of": described} | ({} if scenes.weights is None else {"weights": scenes.weights})


def _written_scene(description: Any) -> dict[str, Any]:
    motions = {"motions": [asdict(motion) for motion in description.motions]} if description.motions else {}
    if isinstance(description, XmlDescription):
        text = hashlib.sha256(description.text.encode()).hexdigest()
        return {"xml": description.path, "parameters": dict(description.parameters), "sha256": text, **motions}
    return {"tree": written(description.tree), "folder": description.folder, **motions}


def _motions(given: Mapping[str, Any]) -> tuple[BodyMotion, ...]:
    parts = ("linear", "angular", "center")
    return tuple(
        BodyMotion(str(one["of"]), *(tuple(map(float, one[part])) for part in parts))  # type: ignore[arg-type]
        for one in given.get("motions", ())
    )


def to_yaml(recipe: Specification, path: str | Path | None) -> str:
    """See :meth:`Recipe.to_yaml`."""
    try:
        import yaml
    except ImportError as error:
        raise MissingPackageError(
            "recipe: YAML needs PyYAML. Install it with pip install 'torchtransient[yaml]', or write "
            "json.dumps(recipe.to_dict())."
        ) from error
    text: str = yaml.safe_dump(to_dict(recipe), sort_keys=False, width=120)
    if path is not None:
        write_text(path, text, "recipe")
    return text


def key_of(recipe: Specification) -> str:
    """See :meth:`Recipe.key`."""
    plain = {name: entry for name, entry in to_dict(recipe).items() if name not in _NO_NUMBERS}
    exchanged = [written(recipe.vary[key]) for key in recipe.exchanged]
    files = {name: files_of(description, exchanged) for name, description in recipe.scenes.descriptions.items()}
    # A class of one's own may make other samples.
    kind = type(recipe)
    own = "" if kind.__module__.startswith("torchtransient.") else f"{kind.__module__}.{kind.__qualname__}"
    text = json.dumps([without_places(plain), files, own], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


# --------------------------------------------------------------------------------------------------------------- read


def read_file(source: str | Path) -> tuple[Mapping[str, Any], Path]:
    """What a file says, and its folder; see :meth:`Recipe.read`."""
    is_text = isinstance(source, str) and "\n" in source
    if not is_text and path_of(source, "recipe").suffix.lower() == ".json":
        return json_data(text_of_file(source, "recipe"), "recipe"), Path(source).resolve().parent
    return read_yaml(source, "recipe")


def from_dict(data: Mapping[str, Any], folder: str | Path | None) -> tuple[Any, dict[str, Any]]:
    """The scene and the other arguments of a recipe; see :meth:`Recipe.from_dict`."""
    section = Section(data, "recipe", _ENTRIES)
    if section.text("format", FORMAT) != FORMAT:
        raise SceneError(f"recipe: expected the format {FORMAT!r}, got {shown(data['format'])}.")
    place = Path.cwd() if folder is None else Path(folder)
    arguments: dict[str, Any] = {name: read(section.get(name)) for name in _PLAIN if name in section}
    vary = section.get("vary", {})
    if not isinstance(vary, Mapping):
        raise SceneError(f"recipe: vary: expected distributions by key, got {shown(vary)}.")
    # Files without it are older than the setting: they go on with what they were rendered with.
    arguments.setdefault("sampler", OF_SCENE)
    arguments["vary"] = {str(key): read_distribution(f"recipe: vary: {key}", one) for key, one in vary.items()}
    arguments["time_axis"] = _axis(section)
    arguments["frequencies"] = read_frequencies(section.get("frequencies", None))
    arguments["pulse"], arguments["irf"] = (read_pulse(section.get(name, None)) for name in ("pulse", "irf"))
    gates = section.get("gates", None)
    arguments["gates"] = None if gates is None else [read_gate(gate) for gate in gates]
    arguments |= {name: kind(**section.get(name)) for name, kind in _MOVING.items() if section.get(name, None)}
    arguments["device"] = _device(section.get("device", None), place)
    if ("hidden" in section) == ("scene" in section):
        raise SceneError("recipe: expected an entry 'scene', or 'hidden' for a capture around a corner; one of them.")
    if "hidden" in section:
        return _capture(section, place, arguments)
    if "scan" in section:
        arguments["scan"] = scan_from_data(section.get("scan"))
        return _hidden(section.get("scene")), arguments
    if "parameters" in section:
        arguments["parameters"] = section.get("parameters")
    return _scene(section.get("scene"), place), arguments


@contextlib.contextmanager
def faults_said() -> Iterator[None]:
    """Entries of a file that are something else than they should be, as SceneError: what is wrong in them is found
    where they are used.
    """
    try:
        with short_errors("recipe"):
            yield
    except (TypeError, KeyError, ValueError, AttributeError, IndexError, OverflowError, RecursionError) as error:
        if isinstance(error, TorchTransientError):
            raise
        said = f"{type(error).__name__}: {short_message(error)}"
        raise SceneError(f"recipe: an entry is not what it should be: {said}.") from error


def _axis(section: Section) -> TimeAxis | None:
    given = section.get("time_axis", None)
    if given is None or isinstance(given, TimeAxis):
        return given
    seconds = isinstance(given, Mapping) and any(str(name).endswith("_s") for name in given)
    names = ("start_s", "bin_width_s", "num_bins") if seconds else ("start_opl", "bin_width_opl", "num_bins")
    part = Section(given, "recipe: time_axis", names)
    numbers = part.number(names[0]), part.number(names[1]), part.whole("num_bins")
    return TimeAxis.from_seconds(*numbers) if seconds else TimeAxis(*numbers)


def _device(given: Any, folder: Path) -> Any:
    if isinstance(given, str) and (folder / given).is_file():
        return folder / given
    return given


def _scene(given: Any, folder: Path) -> Any:
    if isinstance(given, str):
        path = folder / given
        return path if path.is_file() else given
    if not isinstance(given, Mapping):
        raise SceneError(f"recipe: scene: expected a file, a scene dictionary or a builtin, got {shown(given)}.")
    if "type" in given:
        description = describe_dict(read(given))
        return Scene(DictDescription(description.tree, str(folder)), None)
    if "one_of" in given:
        several = given["one_of"]
        scenes = (
            {name: _scene(one, folder) for name, one in several.items()}
            if isinstance(several, Mapping)
            else [_scene(one, folder) for one in several]
        )
        return OneOf(scenes, given.get("weights"))
    if "builtin" in given:
        return _builtin(given)
    if "xml" in given:
        return _xml(given, folder)
    if "tree" in given:
        return Scene(_of_tree(given), None)
    raise SceneError(f"recipe: scene: expected a 'type', 'builtin', 'xml' or 'one_of' in it, got {shown(given)}.")


def _of_tree(given: Mapping[str, Any]) -> DictDescription:
    tree = describe_dict(read(given["tree"])).tree
    return DictDescription(tree, str(given.get("folder", os.getcwd())), _motions(given))


def _hidden(given: Any) -> Any:
    """What :func:`to_dict` has written of hidden things."""
    if isinstance(given, Mapping) and "one_of" in given:
        return OneOf({name: _hidden(one) for name, one in given["one_of"].items()}, given.get("weights"))
    return dict(_of_tree(given).tree)


def _xml(given: Mapping[str, Any], folder: Path) -> Any:
    from torchtransient.scene.load import load

    path = Path(given["xml"])
    path = path if path.is_absolute() else folder / path
    scene = load(path, **given.get("parameters", {}))
    found = hashlib.sha256(scene._description.text.encode()).hexdigest()  # type: ignore[union-attr]
    if given.get("sha256", found) != found:
        raise SceneError(f"recipe: scene: '{path}' has changed since the recipe was written; it is another recipe now.")
    motions = _motions(given)
    return Scene(replace(scene._description, motions=motions), None) if motions else scene  # type: ignore[arg-type]


def _builtin(given: Mapping[str, Any]) -> Any:
    import torchtransient.scenes as scenes

    name = given["builtin"]
    known = [made for made in dir(scenes) if inspect.isfunction(getattr(scenes, made))]
    if name not in known:
        raise SceneError(f"recipe: scene: unknown builtin {shown(name)}. Known ones are {', '.join(known)}.")
    arguments = {key: read(value) for key, value in given.items() if key != "builtin"}
    try:
        return getattr(scenes, name)(**arguments)
    except TypeError as error:
        raise SceneError(f"recipe: scene: {name}: {error}.") from error


def _capture(section: Section, folder: Path, arguments: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    from torchtransient.nlos.setup_files import described_shapes, scan_of, wall_of

    hidden = described_shapes(section.get("hidden"), folder)
    arguments["scan"] = scan_of(section.get("scan"), wall_of(section.get("wall", {}), folder))
    return dict(hidden), arguments

