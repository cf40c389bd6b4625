"""What a recipe says: a scene, what varies in it, and what is measured. Nothing is rendered here."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from torchtransient.axes import FrequencyAxis, RateAxis, TimeAxis
from torchtransient.capture import Scan
from torchtransient.checks import MOST, Numbers, as_whole, count, is_one_of, mapping, of_class, real_array, shown
from torchtransient.chirps import Chirps
from torchtransient.data.recipes.distribution import Distribution, Place
from torchtransient.data.recipes.distributions import Choice, pick
from torchtransient.data.recipes.plugin_modules import check_plugins
from torchtransient.data.recipes.streams import Stream
from torchtransient.data.recipes.structures import Scenes, Structure
from torchtransient.data.recipes.written import read_distribution
from torchtransient.errors import ArgumentError, SceneError, ShapeError
from torchtransient.files.content_key import content_key
from torchtransient.gates import Gate
from torchtransient.pulses import Pulse
from torchtransient.rendering.arguments import checked_filter, checked_sampler
from torchtransient.scene.samplers import OF_SCENE
from torchtransient.scene.variant import resolve_variant
from torchtransient.sensing import DEVICES, Device
from torchtransient.sensing import device as device_by_name

# The key of what a device's stages vary in: "device.PhotonBudget.cycles".
DEVICE = "device"
# Purposes of random numbers that are no keys.
_SCENE, RENDER, NOISE, SECOND = "scene of OneOf", "seed of the render", "seed of the noise", "seed of another render"


@dataclass(frozen=True)
class Settings:
    """What is rendered, as arguments of :class:`Recipe`; see there."""

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
    # Recipes that say nothing of it, which are older than this setting.
    sampler: str = OF_SCENE


class Specification:
    """The data of :class:`~torchtransient.data.Recipe`, which has the arguments and says what they mean."""

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
        # Before the scene is looked at.
        self.plugins = check_plugins(plugins)
        labels, keep = _names("labels", labels), None if keep is None else _names("keep", keep)
        if not is_one_of(physics, ("ignore", "error")):
            raise ArgumentError(f"recipe: physics: expected 'ignore' or 'error', got {shown(physics)}.")
        if parameters is not None:
            mapping("recipe: parameters", parameters, "{name: value}")
        if scan is not None:
            of_class("recipe: scan", scan, Scan)
        for name, given, kind in (
            ("time_axis", time_axis, TimeAxis), ("pulse", pulse, Pulse), ("irf", irf, Pulse), ("vary", vary, Mapping),
            ("rates", rates, RateAxis), ("chirps", chirps, Chirps),
        ):  # fmt: skip
            if given is not None and not isinstance(given, kind):
                what = "dictionary {key: distribution}" if name == "vary" else kind.__name__
                raise ArgumentError(f"recipe: {name}: expected a {what}, got {shown(given)}.")
        if frequencies is not None and not isinstance(frequencies, FrequencyAxis):
            numbers = real_array(frequencies)
            if numbers is None or numbers.ndim != 1:
                raise ArgumentError(
                    f"recipe: frequencies: expected cycles per metre in a list, got {shown(frequencies)}."
                )
            frequencies = FrequencyAxis(tuple(numbers.tolist()))
        if gates is not None and (isinstance(gates, Gate) or not all(isinstance(g, Gate) for g in _listed(gates))):
            raise ArgumentError(f"recipe: gates: expected a list of tt.Gate, got {shown(gates)}.")
        self.seed = count("recipe: seed", seed, 0, most=None)
        self.n = None if n is None else count("recipe: n", n)
        self.variant = resolve_variant(variant)
        self.settings = Settings(
            labels=labels, keep=keep, time_axis=time_axis, frequencies=frequencies,
            gates=None if gates is None else tuple(gates), rates=rates, chirps=chirps,
            temporal_filter=checked_filter(temporal_filter),
            spp=None if spp is None else count("recipe: spp", spp),
            max_depth=None if max_depth is None else count("recipe: max_depth", max_depth, -1),
            sensors=_counts("sensors", sensors, 0, "all"), bounces=_counts("bounces", bounces, 1, "all"),
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
        check_plugins(self.plugins)

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
        """Distributions by key. A recipe does not change: make another one."""
        return MappingProxyType(self._vary)

    # ----------------------------------------------------------------------------------------------- structures

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

    def is_of_device(self, key: str) -> bool:
        """Whether a key stands for an argument of the device."""
        return self.device is not None and key.split(".")[0] == DEVICE

    @functools.cached_property
    def exchanged(self) -> list[str]:
        """The keys that exchange an entry of the description."""
        return [key for key, one in self.vary.items() if self._is_exchanged(key, one)]

    def _is_exchanged(self, key: str, distribution: Distribution) -> bool:
        if self.is_of_device(key) or not self.scenes.has_entry(key):
            return False
        # Of what stands in the description and is a parameter too, numbers vary as values.
        texts = isinstance(distribution, Choice) and any(is_entry(value) for value in distribution.values)
        return texts or key not in self._parameters

    @functools.cached_property
    def _parameters(self) -> frozenset[str]:
        """Parameters with a derivative of the scenes as they are described."""
        return self.scenes.parameters(self.settings.bounces, self.settings.energy)


def _listed(given: Any) -> list[Any]:
    """Of what is no list or row of things, itself."""
    is_row = isinstance(given, Sequence | np.ndarray) and not isinstance(given, str) and getattr(given, "ndim", 1) > 0
    return list(given) if is_row else [given]


def _names(what: str, given: Any) -> tuple[str, ...]:
    if isinstance(given, str) or not all(isinstance(one, str) for one in _listed(given)):
        hint = f"; write [{given!r}]" if isinstance(given, str) else ""
        raise SceneError(f"recipe: {what}: expected a list of names, got {shown(given)}{hint}.")
    found = tuple(given)
    if len(set(found)) < len(found):
        raise SceneError(f"recipe: {what}: expected each once, got {list(found)}.")
    return found


def _counts(what: str, given: Any, least: int, text: str) -> Any:
    """A number, a text, or a tuple of one or more numbers."""
    if isinstance(given, str) and given == text:
        return given
    several = (isinstance(given, Sequence) and not isinstance(given, (str, bytes))) or bool(getattr(given, "ndim", 0))
    whole = tuple(count(f"recipe: {what}", one, least) for one in (given if several else [given]))
    if not whole:
        raise SceneError(f"recipe: {what}: expected one or more whole numbers, or {text!r}, got {shown(given)}.")
    return whole if several else whole[0]


def _device(given: Any) -> Device | None:
    if given is None or isinstance(given, Device):
        return given
    if isinstance(given, Mapping):
        return Device.from_dict(given)
    if isinstance(given, str) and given in DEVICES:
        return device_by_name(given)
    if isinstance(given, str | Path):
        if not Path(given).is_file():
            known = ", ".join(sorted(DEVICES))
            raise SceneError(f"recipe: device: expected a device, its file, or one of {known}; got {str(given)!r}.")
        return Device.from_json(Path(given)) if Path(given).suffix == ".json" else Device.from_yaml(Path(given))
    raise SceneError(
        f"recipe: device: expected a device, its name or its file, got {shown(given)}. "
        "sensing.Device(..., stages=[...]) describes a chain of one's own."
    )


def is_entry(value: Any) -> bool:
    """Whether a choice is no number or array, but an entry of a description."""
    return isinstance(value, str | Mapping | Scan | bool) or value is None


def label_of(distribution: Distribution, value: Any) -> str:
    """A short text for a drawn entry: texts and numbers themselves, others by their number among the choices."""
    if isinstance(value, str | int | float):
        # Of a file its name: a data set is the same wherever its files are.
        if isinstance(value, str):
            return Path(value).name if Path(value).is_absolute() else value
        return repr(value.item() if isinstance(value, np.generic) else value)
    if isinstance(distribution, Choice):
        return f"#{next(i for i, one in enumerate(distribution.values) if one is value)}"
    return f"#{content_key(value)[:12]}"


def samples_of(indices: Iterable[int]) -> list[int]:
    """Numbers of samples, checked. Raises ShapeError."""
    found = []
    for index in indices:
        number = as_whole(index)
        if number is None or not 0 <= number <= MOST:
            raise ShapeError(f"recipe: expected whole numbers of samples of at least 0, got {shown(index)}.")
        found.append(number)
    return found

