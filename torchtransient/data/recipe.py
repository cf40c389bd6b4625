"""``tt.data.Recipe``: a scene, distributions of what varies in it, and the measurement; and recipes in files.

A file has the arguments of :class:`~torchtransient.data.Recipe` as entries. ``scene`` is the name of an XML file, a
scene dictionary, ``{builtin: cornell_box, resolution: 32}`` for a function of ``tt.scenes``, or ``{one_of: {a: ..., b:
...}, weights: [...]}``. A capture has ``hidden`` instead, with ``wall`` and ``scan`` as in the YAML files of captures
(:mod:`torchtransient.nlos.setup_files`).
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Self

from torchtransient.array_files.part_files import write_text
from torchtransient.array_files.plain_texts import json_data, text_of_file, yaml_package
from torchtransient.axes import RateAxis, TimeAxis
from torchtransient.checks import count, path_of, short_errors, short_message, shown
from torchtransient.chirps import Chirps
from torchtransient.data.checks import Cost, check_recipe, forecast, light_outside
from torchtransient.data.maker import Maker
from torchtransient.data.overview import contact_sheet
from torchtransient.data.sample import OutsideLight, Sample
from torchtransient.data.serialization import (
    files_of,
    read,
    read_distribution,
    read_frequencies,
    read_record,
    record_fields,
    without_places,
    written,
)
from torchtransient.data.specification import OneOf, Specification
from torchtransient.errors import SceneError, TorchTransientError
from torchtransient.files.plain_data import scan_data, scan_from_data
from torchtransient.files.yaml_files import Section, read_yaml
from torchtransient.gates import Gate
from torchtransient.pulses import Pulse
from torchtransient.scene.description import DictDescription, XmlDescription, describe_dict
from torchtransient.scene.load import Scene
from torchtransient.scene.motions import BodyMotion
from torchtransient.scene.samplers import OF_SCENE

FORMAT = "torchtransient recipe 1"
# Entries that are arguments of the constructor unchanged.
_PLAIN = (
    "labels", "keep", "temporal_filter", "spp", "max_depth", "sensors", "bounces", "energy", "physics", "sampler",
    "variant", "seed", "n", "plugins",
)  # fmt: skip
_ENTRIES = (
    "format", "scene", "parameters", "hidden", "wall", "scan", "vary", "time_axis", "frequencies", "gates", "rates",
    "chirps", "pulse", "irf", "device", *_PLAIN,
)  # fmt: skip
_RECORDS = ("time_axis", "frequencies", "gates", "pulse", "irf")
_MOVING = {"rates": RateAxis, "chirps": Chirps}
# Entries that samples do not depend on.
_NO_NUMBERS = ("n", "format")
# State of the process, which is not pickled or copied.
_OF_PROCESS = ("_maker", "_parameters", "_outside")


class Recipe(Specification):
    """Scene, distributions of what varies in it, and the measurement. Plain data: it pickles, is equal to its copy, and
    stands in a YAML file (:meth:`to_yaml`, :meth:`read`). Every number of sample i is drawn from (seed, i, key) alone:
    samples can be made in any order, anywhere, and another key leaves the draws of the others as they were.

    Keys of ``vary``:

    - keys of ``scene.parameters()`` that have a derivative vary as values: nothing is built, traced or compiled anew;
    - entries of a scene dictionary (``box.filename``, ``lamp.bsdf``, a whole node) and ``$names`` of an XML file are
      exchanged: each combination is a *structure*, a scene of its own that is built when a sample needs it;
    - ``device.STAGE.ARGUMENT`` for an argument of a stage of ``device`` (a kind or a number);
    - ``scan``, of a capture: a :class:`Choice` of scans of one shape.

    :meth:`check` raises the errors of a recipe before anything is rendered; :func:`generate` and :meth:`preview` call
    it first. Not supported: gradients, and samples of different shapes.

    Args:
        scene: scene as :func:`torchtransient.load` takes it, or :class:`OneOf` several; with ``scan`` the hidden
            things.
        vary: distributions by key.
        labels: names of :func:`torchtransient.data.scene_labels` and ``first_return``, of the same scene and camera.
        keep: names of arrays that samples keep, of ``transient`` (``phasor``, ``gated``, ``rates``, ``beats``),
            ``steady``, labels and ``measurement``; None for all. ``["measurement", "depth"]`` makes small data sets.
        time_axis: bins of the film, see :class:`~torchtransient.TransientRenderer`, which explains ``frequencies``,
            ``gates``, ``rates``, ``chirps``, ``max_depth``, ``spp``, ``sensors``, ``pulse`` and ``irf``.
        temporal_filter: filter over time; "auto" is that of the scene's film, whatever varies.
        variant: variant of Mitsuba; None settles it here as :func:`torchtransient.load` does.
        scan: scan, which makes it a capture around a corner; that needs a time axis (or frequencies), since hidden
            things move.
        bounces: numbers of bounces that count in a capture, see :class:`~torchtransient.nlos.CaptureRenderer`.
        energy: joules of the laser of a capture, see :class:`~torchtransient.nlos.CaptureRenderer`.
        device: :class:`~torchtransient.sensing.Device`, or its name or file: its draw from the transient is
            ``measurement``. A chain of one's own is written as one, see docs/data_sheet_to_chain.md.
        physics: "ignore" or "error", as in the renderer.
        sampler: plugin name, as in the renderer. None settles it here: "owen" for scenes that name ``independent`` or
            none, else what they name ("auto" where scenes differ, "scene" where a key of ``vary`` stands for it).
            "scene" is what the scene names, ``independent`` included, which recipes without the entry ``sampler`` have:
            folders of older versions go on with it.
        seed: seed of all draws; another one makes another data set.
        parameters: values of the $names of an XML scene.
        n: number of samples in a data set, unless :func:`generate` gets another one.
        plugins: names of modules with Mitsuba plugins of one's own, which are added
            (:func:`torchtransient.plugins.register_module`) wherever the recipe is made, read or unpickled.

    Raises:
        SceneError: and ShapeError, UnitError, ArgumentError for arguments that cannot be used.
    """

    # --------------------------------------------------------------------------------------------------- samples

    # Result of `check` in this process.
    _outside: OutsideLight | None = None

    @functools.cached_property
    def _maker(self) -> Maker:
        return self.maker()

    def maker(self) -> Maker:
        """Return a new `Maker` of samples, which keeps the scene that it has built. Each process needs its own."""
        return Maker(self)

    def sample(self, index: int) -> Sample:
        """Render a sample, whatever was made before.

        Args:
            index: number of the sample in the recipe, from 0.

        Returns:
            :class:`Sample`.

        Raises:
            SceneError: and the other errors of :meth:`check` and of the renderer.
        """
        return self._maker.sample(index)

    def draw(self, index: int) -> dict[str, Any]:
        """Draw the values of a sample without rendering it.

        Args:
            index: number of the sample in the recipe, from 0.

        Returns:
            Values by key, numbers as float64 arrays.
        """
        return self._maker.draw(index)

    # --------------------------------------------------------------------------------------- before it is used

    def check(self, maker: Maker | None = None, *, progress: bool = False) -> OutsideLight:
        """Check the recipe: unknown keys, distributions that do not fit them, numbers outside of what is physical,
        poses whose light leaves the window, a scene without light. Covers the ends of every distribution and the first
        64 samples (of 8 structures at most).

        Then renders these samples, with 65536 camera paths each at most; a PhysicsWarning reports samples with more
        than 1 % of their light outside of the time window, a TorchTransientWarning samples that fail. A recipe that has
        passed is not checked again in its process.

        Args:
            maker: maker whose scenes are used, None for the recipe's own.
            progress: show a bar.

        Returns:
            Light of these samples outside of the time window.

        Raises:
            SceneError: and ShapeError, UnitError for a recipe that cannot be rendered.
        """
        if self._outside is None:
            maker = self._maker if maker is None else maker
            check_recipe(self, maker)
            self._outside = light_outside(self, maker, progress)
        self._outside.warn("recipe")
        return self._outside

    def cost(self, samples: int = 5, *, progress: bool = False) -> Cost:
        """Forecast the cost of a data set: entries that are built anew, values, seconds, bytes, light outside of the
        window.

        Args:
            samples: number of samples that are timed of each of the first 4 structures.
            progress: show a bar.

        Returns:
            Cost; ``str`` of it is a table.
        """
        return forecast(self, self._maker, samples, progress, self.check(progress=progress))

    def preview(self, samples: int = 16, path: str | Path | None = None, *, progress: bool = False) -> Any:
        """Draw a contact sheet of the first samples: steady picture, labels, and the light over time. Needs matplotlib.

        Args:
            samples: number of them.
            path: path of the picture (.png, .pdf, .svg), or None.
            progress: show a bar.

        Returns:
            Figure of matplotlib without a path.
        """
        self.check(progress=progress)
        return contact_sheet(self, self._maker, range(count("preview: samples", samples)), path, progress)

    # ------------------------------------------------------------------------------------------------- as plain data

    def to_dict(self) -> dict[str, Any]:
        """Return the recipe as data that JSON can hold; :meth:`from_dict` makes an equal recipe of it."""
        return _recipe_data(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], folder: str | Path | None = None) -> Self:
        """Make a recipe from plain data.

        Args:
            data: result of :meth:`to_dict`, or the content of a YAML file.
            folder: folder of the files that it names, None for where they were.

        Returns:
            Recipe.

        Raises:
            SceneError: for unknown and wrong entries.
        """
        with _entry_errors():
            scene, arguments = _recipe_arguments(data, folder)
            return cls(scene, **arguments)

    def to_yaml(self, path: str | Path | None = None) -> str:
        """Write the recipe as YAML.

        Args:
            path: path of the file, or None.

        Returns:
            Text.
        """
        text: str = yaml_package("recipe").safe_dump(self.to_dict(), sort_keys=False, width=120)
        if path is not None:
            write_text(path, text, "recipe")
        return text

    @classmethod
    def read(cls, source: str | Path) -> Self:
        """Read a recipe. Nothing is executed.

        Args:
            source: YAML or JSON file, or YAML text.

        Returns:
            Recipe.

        Raises:
            SceneError: for wrong entries.
            StorageError: for files that cannot be read.
        """
        is_text = isinstance(source, str) and "\n" in source
        if not is_text and path_of(source, "recipe").suffix.lower() == ".json":
            return cls.from_dict(json_data(text_of_file(source, "recipe"), "recipe"), Path(source).resolve().parent)
        return cls.from_dict(*read_yaml(source, "recipe"))

    def key(self) -> str:
        """Return the hash of all that determines the samples; files that the recipe names count with their contents."""
        plain = {name: entry for name, entry in self.to_dict().items() if name not in _NO_NUMBERS}
        exchanged = [written(self.vary[key]) for key in self.exchanged]
        files = {name: files_of(description, exchanged) for name, description in self.scenes.descriptions.items()}
        # A class of one's own may make other samples.
        kind = type(self)
        own = "" if kind.__module__.startswith("torchtransient.") else f"{kind.__module__}.{kind.__qualname__}"
        text = json.dumps([without_places(plain), files, own], sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Recipe) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash((self.seed, tuple(self.vary)))

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in _OF_PROCESS}

    def __repr__(self) -> str:
        scenes = "" if self.scenes.names == [""] else f"{len(self.scenes.names)} scenes, "
        return f"tt.data.Recipe({scenes}{self.variant}, varies {', '.join(self.vary) or 'nothing'})"


def _recipe_data(recipe: Specification) -> dict[str, Any]:
    """Plain data of a recipe."""
    settings = recipe.settings
    found: dict[str, Any] = {"format": FORMAT, "scene": _written_scenes(recipe)}
    if recipe.scan is not None:
        found["scan"] = scan_data(recipe.scan)
        found |= {"bounces": written(settings.bounces), "energy": written(settings.energy)}
    found |= {
        "vary": {key: written(one) for key, one in recipe.vary.items()},
        "labels": list(settings.labels),
        "keep": None if settings.keep is None else list(settings.keep),
        **{name: record_fields(getattr(settings, name)) for name in _RECORDS},
        "temporal_filter": settings.temporal_filter,
        "spp": settings.spp,
        "max_depth": settings.max_depth,
        "sensors": written(settings.sensors),
        "device": None if recipe.device is None else recipe.device.to_dict(),
        "physics": settings.physics,
        "variant": recipe.variant,
        "seed": recipe.seed,
        "n": recipe.n,
    }
    # Left out where None, so that older recipes keep their keys.
    found |= {name: record_fields(one) for name in _MOVING if (one := getattr(settings, name)) is not None}
    if settings.sampler != OF_SCENE:
        found["sampler"] = settings.sampler
    if recipe.plugins:
        found["plugins"] = list(recipe.plugins)
    # Through JSON: lists in place of tuples, plain data alone.
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


def _recipe_arguments(data: Mapping[str, Any], folder: str | Path | None) -> tuple[Any, dict[str, Any]]:
    """Scene and other arguments of a recipe."""
    section = Section(data, "recipe", _ENTRIES)
    if section.text("format", FORMAT) != FORMAT:
        raise SceneError(f"recipe: expected the format {FORMAT!r}, got {shown(data['format'])}.")
    place = Path.cwd() if folder is None else Path(folder)
    arguments: dict[str, Any] = {name: read(section.get(name)) for name in _PLAIN if name in section}
    vary = section.get("vary", {})
    if not isinstance(vary, Mapping):
        raise SceneError(f"recipe: vary: expected distributions by key, got {shown(vary)}.")
    # Older files have no such entry, and keep the sampler of their scene.
    arguments.setdefault("sampler", OF_SCENE)
    arguments["vary"] = {str(key): read_distribution(f"recipe: vary: {key}", one) for key, one in vary.items()}
    arguments["time_axis"] = _axis(section)
    arguments["frequencies"] = read_frequencies(section.get("frequencies", None))
    arguments["pulse"], arguments["irf"] = (read_record(Pulse, section.get(name, None)) for name in ("pulse", "irf"))
    gates = section.get("gates", None)
    arguments["gates"] = None if gates is None else [read_record(Gate, gate) for gate in gates]
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
def _entry_errors() -> Iterator[None]:
    """Raise SceneError for entries of a file that are found to be wrong where they are used."""
    try:
        with short_errors("recipe"):
            yield
    except (TypeError, KeyError, ValueError, AttributeError, IndexError, OverflowError, RecursionError) as error:
        if isinstance(error, TorchTransientError):
            raise
        text = f"{type(error).__name__}: {short_message(error)}"
        raise SceneError(f"recipe: an entry is not what it should be: {text}.") from error


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
    """Hidden things from plain data."""
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
