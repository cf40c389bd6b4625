"""``tt.data.Recipe``: a scene, what varies in it, and what is measured; sample i of it can be made alone."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Scan
from torchtransient.data.recipes.distribution import Distribution, Place
from torchtransient.data.recipes.distributions import Choice, pick
from torchtransient.data.recipes.sample import Sample
from torchtransient.data.recipes.streams import Stream
from torchtransient.data.recipes.structures import OneOf, Scenes, Structure
from torchtransient.data.recipes.written import read_distribution
from torchtransient.errors import SceneError, ShapeError
from torchtransient.gates import Gate
from torchtransient.pulses import Pulse
from torchtransient.quantities import count, shown
from torchtransient.render.variant import resolve_variant
from torchtransient.sensing import DEVICES, Device
from torchtransient.sensing import device as device_by_name

if TYPE_CHECKING:
    from torchtransient.data.recipes.forecast import Cost
    from torchtransient.data.recipes.maker import Maker

# The key of what a device's stages vary in: "device.PhotonBudget.cycles".
DEVICE = "device"
# Purposes of random numbers that are no keys.
_SCENE, RENDER, NOISE, SECOND = "scene of OneOf", "seed of the render", "seed of the noise", "seed of another render"


@dataclass(frozen=True)
class Settings:
    """What is rendered, as arguments of :class:`Recipe`; see there."""

    labels: tuple[str, ...] = ()
    time_axis: TimeAxis | None = None
    frequencies: FrequencyAxis | None = None
    gates: tuple[Gate, ...] | None = None
    temporal_filter: str = "auto"
    spp: int | None = None
    max_depth: int | None = None
    sensors: Any = 0
    pulse: Pulse | None = None
    irf: Pulse | None = None
    bounces: tuple[int, ...] | str = (3,)
    energy: Any = 1.0
    physics: str = "ignore"


class Recipe:
    """What may vary in a scene, and what is measured of it. Plain data: pickles, is equal to its copy, and stands in a
    YAML file (:meth:`to_yaml`, :meth:`read`).

    ``scene``: what :func:`torchtransient.load` takes, or :class:`OneOf` several. ``vary``: distributions by key:

    - keys of ``scene.parameters()`` that have a derivative vary as values: nothing is built, traced or compiled anew;
    - entries of a scene dictionary (``box.filename``, ``lamp.bsdf``, a whole node) and ``$names`` of an XML file are
      exchanged: each combination is a *structure*, a scene that is built when it first comes and then kept;
    - ``device.STAGE.ARGUMENT`` for an argument of a stage of ``device`` (a kind or a number);
    - ``scan``, of a capture: a :class:`Choice` of scans of one shape.

    ``labels``: names of :func:`torchtransient.render.labels.scene_labels` and ``first_return``, of the same scene and
    camera. ``time_axis``, ``frequencies``, ``gates``, ``max_depth``, ``spp``, ``sensors``, ``pulse``, ``irf``: as in
    :class:`~torchtransient.TransientRenderer`. ``temporal_filter``: "auto" is that of the scene's film, whatever
    varies. ``variant``: None settles it here as :func:`torchtransient.load` does.

    ``scan``: makes it a capture around a corner: ``scene`` is what is hidden, ``bounces`` and ``energy`` as in
    :class:`~torchtransient.nlos.CaptureRenderer`, and a time axis (or frequencies) has to be given, since what is
    hidden moves.

    ``device``: a :class:`~torchtransient.sensing.Device`, or its name or file: what the transient is measured with. Its
    draw is ``measurement``, beside the transient itself. ``physics``: "ignore" or "error", as in the renderer.

    ``seed``: another one is another data set. Every number of sample i is drawn from (seed, i, key) alone: samples can
    be made in any order, anywhere, and another key leaves the others' draws as they were. ``parameters`` fill the
    $names of an XML scene. ``n``: how many samples a data set has unless :func:`generate` is told otherwise.

    What is wrong with a recipe is said before anything is rendered: by :meth:`check`, which :func:`generate` and
    :meth:`preview` call first. Raises SceneError, ShapeError, UnitError. Not supported: gradients, and samples of
    different shapes.
    """

    def __init__(
        self,
        scene: Any,
        vary: Mapping[str, Any] | None = None,
        *,
        labels: Sequence[str] = (),
        time_axis: TimeAxis | None = None,
        frequencies: FrequencyAxis | Sequence[float] | None = None,
        gates: Sequence[Gate] | None = None,
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
        seed: int = 0,
        parameters: Mapping[str, Any] | None = None,
        n: int | None = None,
    ) -> None:
        if isinstance(labels, str):
            raise SceneError(f"recipe: labels: expected a list of names, got the text {labels!r}; write [{labels!r}].")
        if physics not in ("ignore", "error"):
            raise SceneError(f"recipe: physics: expected 'ignore' or 'error', got {physics!r}.")
        if scan is not None and not isinstance(scan, Scan):
            raise SceneError(f"recipe: scan: expected a tt.nlos.Scan, got {shown(scan)}.")
        if frequencies is not None and not isinstance(frequencies, FrequencyAxis):
            frequencies = FrequencyAxis(tuple(float(number) for number in frequencies))
        self.seed = count("recipe: seed", seed, 0)
        self.n = None if n is None else count("recipe: n", n)
        self.variant = resolve_variant(variant)
        self.settings = Settings(
            labels=tuple(labels), time_axis=time_axis, frequencies=frequencies,
            gates=None if gates is None else tuple(gates), temporal_filter=temporal_filter,
            spp=None if spp is None else count("recipe: spp", spp), max_depth=max_depth,
            sensors=sensors if isinstance(sensors, int | str) else tuple(sensors), pulse=pulse, irf=irf,
            bounces=bounces if isinstance(bounces, str) else tuple(bounces), energy=energy, physics=physics,
        )  # fmt: skip
        self.scan = scan
        self.device = _device(device)
        self.scenes = Scenes(scene, self.variant, scan, parameters)
        self.vary = {str(key): read_distribution(f"recipe: {key!r}", given) for key, given in (vary or {}).items()}
        self._check_settings()

    def _check_settings(self) -> None:
        if self.scan is not None and self.settings.time_axis is None and self.settings.frequencies is None:
            raise SceneError(
                "recipe: a capture whose hidden things move needs a time_axis= that holds all of their places. "
                "scan.default_axis(bounds) finds one for the corners (2, 3) of the space that they stay in."
            )
        if self.device is None and any(key.split(".")[0] == DEVICE for key in self.vary):
            raise SceneError("recipe: keys of 'device.' vary a device; give device= too.")

    # --------------------------------------------------------------------------------------------------- samples

    @functools.cached_property
    def _maker(self) -> Maker:
        return self.maker()

    def maker(self) -> Maker:
        """What makes samples, and keeps the scenes that it has built. One for each process."""
        from torchtransient.data.recipes.maker import Maker

        return Maker(self)

    def sample(self, index: int) -> Sample:
        """Sample ``index``, whatever was made before. Raises the errors of :meth:`check` and of the renderer."""
        return self._maker.sample(index)

    def draw(self, index: int) -> dict[str, Any]:
        """What sample ``index`` draws, by key, without rendering it: numbers as float64 arrays."""
        return self._maker.draw(index)

    def structure(self, index: int) -> Structure:
        """Which structure sample ``index`` is of."""
        names = self.scenes.names
        name = names[pick(Stream(self.seed, index, _SCENE), len(names), self.scenes.weights)]
        entries, words = [], [name] if name else []
        for key in self.exchanged:
            value = self.vary[key].draw(Stream(self.seed, index, key), Place(key))
            entries.append((key, value))
            words.append(f"{key}={label_of(self.vary[key], value)}")
        return Structure(name, ", ".join(words), tuple(entries))

    @functools.cached_property
    def exchanged(self) -> list[str]:
        """The keys that exchange an entry of the description."""
        return [key for key, one in self.vary.items() if self._is_exchanged(key, one)]

    def _is_exchanged(self, key: str, distribution: Distribution) -> bool:
        if key.split(".")[0] == DEVICE or not self.scenes.has_entry(key):
            return False
        # Of what stands in the description and is a parameter too, numbers vary as values.
        texts = isinstance(distribution, Choice) and any(is_entry(value) for value in distribution.values)
        return texts or key not in self._parameters

    @functools.cached_property
    def _parameters(self) -> frozenset[str]:
        """Parameters with a derivative of the scenes as they are described."""
        from torchtransient.data.recipes.maker import described_parameters

        return described_parameters(self)

    # --------------------------------------------------------------------------------------- before it is used

    def check(self) -> None:
        """Raise what is wrong with the recipe, before anything is rendered: unknown keys, distributions that do not fit
        them, numbers outside of what is physical, poses whose light leaves the window, a scene without light. Looks at
        the ends of every distribution and at the first samples.
        """
        from torchtransient.data.recipes.checks import check_recipe

        check_recipe(self, self._maker)

    def cost(self, samples: int = 5, *, progress: bool = False) -> Cost:
        """What a sample costs: what is built anew and what is only a value, seconds, bytes, light outside the window.
        Renders some ``samples`` of each structure that comes first. ``str`` of it is a table.
        """
        from torchtransient.data.recipes.forecast import forecast

        self.check()
        return forecast(self, self._maker, samples, progress)

    def preview(self, samples: int = 16, path: str | Path | None = None, *, progress: bool = False) -> Any:
        """A contact sheet of the first samples: the steady picture (or what stands for it), labels, and the light over
        time. ``path``: where to write it (.png, .pdf, .svg), else the matplotlib figure is returned. Needs matplotlib.
        """
        from torchtransient.data.recipes.contact_sheet import contact_sheet

        self.check()
        return contact_sheet(self, range(count("preview: samples", samples)), path, progress)

    # ------------------------------------------------------------------------------------------------- as plain data

    def to_dict(self) -> dict[str, Any]:
        """The recipe as data that JSON can hold; :meth:`from_dict` makes an equal recipe of it."""
        from torchtransient.data.recipes.recipe_file import to_dict

        return to_dict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], folder: str | Path | None = None) -> Recipe:
        """A recipe from plain data: what :meth:`to_dict` made, or what a YAML file says. ``folder``: where files that
        it names are looked up, None for where they were. Raises SceneError for unknown and wrong entries.
        """
        from torchtransient.data.recipes.recipe_file import from_dict

        return from_dict(data, folder)

    def to_yaml(self, path: str | Path | None = None) -> str:
        """As YAML text, also written to ``path``."""
        from torchtransient.data.recipes.recipe_file import to_yaml

        return to_yaml(self, path)

    @classmethod
    def read(cls, source: str | Path) -> Recipe:
        """A recipe from a YAML or JSON file, or YAML text. Nothing is executed. Raises SceneError, StorageError."""
        from torchtransient.data.recipes.recipe_file import read_recipe

        return read_recipe(source)

    def key(self) -> str:
        """A text that stands for all that decides about the samples; files that the recipe names count with what is in
        them.
        """
        from torchtransient.data.recipes.recipe_file import key_of

        return key_of(self)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Recipe) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash((self.seed, tuple(self.vary)))

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in ("_maker", "_parameters")}

    def __repr__(self) -> str:
        scenes = "" if self.scenes.names == [""] else f"{len(self.scenes.names)} scenes, "
        return f"tt.data.Recipe({scenes}{self.variant}, varies {', '.join(self.vary) or 'nothing'})"


def _device(given: Any) -> Device | None:
    if given is None or isinstance(given, Device):
        return given
    if isinstance(given, Mapping):
        return Device.from_dict(given)
    if isinstance(given, str) and given in DEVICES:
        return device_by_name(given)
    if isinstance(given, str | Path):
        return Device.from_json(Path(given)) if Path(given).suffix == ".json" else Device.from_yaml(Path(given))
    raise SceneError(f"recipe: device: expected a device, its name or its file, got {shown(given)}.")


def is_entry(value: Any) -> bool:
    """Whether a choice is no number or array, but an entry of a description."""
    return isinstance(value, str | Mapping | Scan | bool) or value is None


def label_of(distribution: Distribution, value: Any) -> str:
    """A short text for a drawn entry: texts and numbers themselves, others by their number among the choices."""
    if isinstance(value, str | int | float):
        return str(value)
    if isinstance(distribution, Choice):
        return f"#{next(i for i, one in enumerate(distribution.values) if one is value)}"
    return str(value)


def samples_of(indices: Iterable[int]) -> list[int]:
    """Numbers of samples, checked. Raises ShapeError."""
    found = [int(index) for index in indices]
    if any(index < 0 for index in found):
        raise ShapeError(f"recipe: expected sample numbers of at least 0, got {min(found)}.")
    return found


__all__ = ["DEVICE", "NOISE", "RENDER", "SECOND", "OneOf", "Recipe", "Settings", "label_of", "samples_of"]
