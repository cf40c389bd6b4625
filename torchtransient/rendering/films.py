"""Films on the side of torch: the settings of each, the layout of its tensor, its entries of a result file.

A film is a plugin (``plugins/films``), which measures, and a :class:`FilmLayout` here, listed in :data:`FILMS`.
Renderer, plan and result files ask the layout and name no film.
"""

from __future__ import annotations

import abc
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self

import torch

from torchtransient.axes import FrequencyAxis, RateAxis, TimeAxis
from torchtransient.checks import finite, shown
from torchtransient.chirps import Chirps
from torchtransient.errors import ArgumentError, SceneError, TorchTransientError
from torchtransient.gates import SLOPE_REMEDY, Gate, gates_from_text, gates_to_text, jump_in
from torchtransient.interfaces import FilmInterface, is_time_resolved
from torchtransient.rendering.film_layout import FilmLayout as FilmLayout
from torchtransient.rendering.film_layout import (
    measured,
    phasor_channels_first,
    rows_channels_first,
)

if TYPE_CHECKING:
    from torchtransient.scene.pilot import Arrivals


@dataclass(frozen=True)
class Histogram(FilmLayout):
    """Radiance integrated over each bin of ``axis``: float32 (C, T, H, W).

    Args:
        axis: bins of optical path length.

    Raises:
        ArgumentError: for anything but a :class:`~torchtransient.axes.TimeAxis`.
    """

    measures: ClassVar[str] = "transient"
    plugin: ClassVar[str] = "transient_hdr_film"
    letter: ClassVar[str] = "T"
    argument: ClassVar[str] = "time_axis"
    example: ClassVar[str] = "time_axis=tt.TimeAxis(start_opl=..., bin_width_opl=..., num_bins=...)"
    plural: ClassVar[str] = "transients"
    output: ClassVar[str] = "transient"
    has_bins: ClassVar[bool] = True
    takes_pulse: ClassVar[bool] = True

    axis: TimeAxis

    def __post_init__(self) -> None:
        given: Any = self.axis
        if not isinstance(given, TimeAxis):
            raise ArgumentError(f"time_axis: expected a tt.TimeAxis, got {type(given).__name__}; write {self.example}.")

    @property
    def count(self) -> int:
        return self.axis.num_bins

    def plain(self) -> dict[str, Any]:
        axis = self.axis
        return {"start_opl": axis.start_opl, "bin_width_opl": axis.bin_width_opl, "num_bins": axis.num_bins}

    def describe(self, temporal_filter: str) -> str:
        return f"axis={self.axis}, temporal_filter={temporal_filter!r}"

    @classmethod
    def from_film(cls, film: Any) -> Self:
        return cls(TimeAxis(film.start_opl, film.bin_width_opl, film.temporal_bins))

    @classmethod
    def from_properties(cls, props: Any) -> Self | None:
        start, width = float(props.get("start_opl", 0.0)), float(props.get("bin_width_opl", 0.003))
        return cls(TimeAxis(start, width, int(props.get("temporal_bins", 2048))))

    def write(self, props: Any) -> None:
        props["start_opl"], props["bin_width_opl"] = self.axis.start_opl, self.axis.bin_width_opl
        props["temporal_bins"] = self.axis.num_bins

    @classmethod
    def fits(cls, plugin: str) -> bool:
        """Return True: histograms of other packages take the same properties; one that does not says so when built."""
        return True

    def entries(self) -> dict[str, Any]:
        return {"edges_opl": self.axis.edges_opl.numpy(), **self.plain()}

    @classmethod
    def from_entries(cls, values: Mapping[str, Any]) -> Self | None:
        if cls.measures not in values or "num_bins" not in values:
            return None
        return cls(TimeAxis(float(values["start_opl"]), float(values["bin_width_opl"]), int(values["num_bins"])))

    def parts(self, arrivals: Arrivals) -> list[Arrivals]:
        """Return all light, which the steady image holds, and that of the time window."""
        return [arrivals, arrivals.through([Gate.rectangular(self.axis.start_opl, self.axis.end_opl)])]


# Properties of a phasor film that choose its frequencies; explicit frequencies replace them.
_FREQUENCY_PROPERTIES = (
    "wl_mean", "wl_sigma", "temporal_bins", "bin_width_opl", "frequency_first", "frequency_step", "frequency_count",
)  # fmt: skip


@dataclass(frozen=True)
class Phasors(FilmLayout):
    """Radiance times ``exp(-2 pi i nu (opl - start_opl))`` for each of ``frequencies``: complex64 (C, F, H, W).

    Args:
        frequencies: a :class:`~torchtransient.axes.FrequencyAxis`, or numbers in cycles per metre.

    Raises:
        UnitError, ShapeError: for anything else.
    """

    measures: ClassVar[str] = "phasor"
    plugin: ClassVar[str] = "phasor_hdr_film"
    letter: ClassVar[str] = "F"
    argument: ClassVar[str] = "frequencies"
    example: ClassVar[str] = "frequencies=tt.FrequencyAxis(...)"
    plural: ClassVar[str] = "phasors"
    output: ClassVar[str] = "phasor"
    is_complex: ClassVar[bool] = True

    frequencies: FrequencyAxis

    def __post_init__(self) -> None:
        if not isinstance(self.frequencies, FrequencyAxis):
            object.__setattr__(self, "frequencies", FrequencyAxis(self.frequencies))

    @property
    def count(self) -> int:
        return self.frequencies.num_frequencies

    def plain(self) -> list[float]:
        return list(self.frequencies.frequencies)

    @classmethod
    def from_film(cls, film: Any) -> Self:
        return cls(FrequencyAxis(tuple(film.frequencies.tolist()), film.start_opl))

    def write(self, props: Any) -> None:
        for name in _FREQUENCY_PROPERTIES:
            if name in props:
                del props[name]
        props["frequencies"] = ", ".join(repr(f) for f in self.frequencies.frequencies)
        props["start_opl"] = self.frequencies.start_opl

    def channels_first(self, cube: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
        return phasor_channels_first(cube, leading, components)

    def entries(self) -> dict[str, Any]:
        return {"frequencies_per_metre": self.frequencies.per_metre.numpy(), "start_opl": self.frequencies.start_opl}

    @classmethod
    def from_entries(cls, values: Mapping[str, Any]) -> Self | None:
        if cls.measures not in values:
            return None
        return cls(FrequencyAxis(tuple(values["frequencies_per_metre"].tolist()), float(values["start_opl"])))


@dataclass(frozen=True)
class Gates(FilmLayout):
    """The light as each of ``gates`` sees it: float32 (C, G, H, W). The steady image is the sum over the gates.

    Args:
        gates: one :class:`~torchtransient.gates.Gate` or several.

    Raises:
        ArgumentError: for anything else.
    """

    measures: ClassVar[str] = "gated"
    plugin: ClassVar[str] = "gated_hdr_film"
    letter: ClassVar[str] = "G"
    argument: ClassVar[str] = "gates"
    example: ClassVar[str] = "gates=[tt.Gate.gaussian(...)]"
    plural: ClassVar[str] = "gates"
    output: ClassVar[str] = "gates"
    takes_pulse: ClassVar[bool] = True
    slope_remedy: ClassVar[str] = SLOPE_REMEDY

    gates: tuple[Gate, ...]

    def __post_init__(self) -> None:
        given: Any = self.gates
        gates = tuple(given) if isinstance(given, Iterable) else (given,)
        if not gates or not all(isinstance(gate, Gate) for gate in gates):
            raise ArgumentError(
                "gates: expected one or more tt.Gate objects, for instance [tt.Gate.gaussian(6.0, 0.2)], got "
                f"{given!r}."
            )
        object.__setattr__(self, "gates", gates)

    @property
    def count(self) -> int:
        return len(self.gates)

    def plain(self) -> list[dict[str, Any]]:
        return [asdict(gate) for gate in self.gates]

    def describe(self, temporal_filter: str) -> str:
        return f"gates={self.count}"

    def jump(self) -> str:
        return jump_in(self.gates)

    @classmethod
    def from_film(cls, film: Any) -> Self:
        return cls(tuple(film.gates))

    @classmethod
    def from_properties(cls, props: Any) -> Self | None:
        try:
            return cls(gates_from_text(str(props["gates"]))) if "gates" in props else None
        except TorchTransientError as error:
            raise SceneError(f"{cls.plugin}: {error}") from error

    def write(self, props: Any) -> None:
        props["gates"] = gates_to_text(self.gates)

    def entries(self) -> dict[str, Any]:
        return {"gates": gates_to_text(self.gates)}

    @classmethod
    def from_entries(cls, values: Mapping[str, Any]) -> Self | None:
        return cls(gates_from_text(str(values["gates"]))) if "gates" in values else None

    @classmethod
    def seen(cls, film: Any, arrivals: Arrivals) -> Arrivals:
        seen: tuple[Gate, ...] = tuple(film.gates)
        for pulse in film.pulses:
            seen = tuple(gate.spread(pulse) for gate in seen)
        return arrivals.through(seen)


@dataclass(frozen=True)
class RowsOfHistograms(FilmLayout):
    """Base of films with several histograms a pixel: float32 (C, rows, T, H, W).

    A subclass has two fields, its settings and ``axis``, the bins of all histograms; None for those of the scene's
    film.
    """

    has_bins: ClassVar[bool] = True
    knows_rates: ClassVar[bool] = True
    beside: ClassVar[str] = "time_axis"
    kind: ClassVar[type]
    # Names of the settings' fields as properties of the plugin.
    properties: ClassVar[dict[str, str]]

    def __post_init__(self) -> None:
        given: Any = self.settings
        if not isinstance(given, self.kind):
            raise ArgumentError(
                f"{self.argument}: expected a tt.{self.kind.__name__}, got {type(given).__name__}; write "
                f"{self.example}."
            )
        axis: Any = self.attributes()["axis"]
        if axis is not None:
            Histogram(axis)

    @property
    def count(self) -> int:
        axis = self.attributes()["axis"]
        assert isinstance(axis, TimeAxis)  # of a built film
        return axis.num_bins

    @property
    @abc.abstractmethod
    def row_count(self) -> int:
        """Number of histograms of a pixel."""

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.row_count, self.count)

    def attributes(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def plain(self) -> dict[str, Any]:
        axis, settings = self.attributes()["axis"], asdict(self.settings)
        named = {f"{self.argument}_{name}": value for name, value in settings.items()}
        return named | ({} if axis is None else Histogram(axis).plain())

    def describe(self, temporal_filter: str) -> str:
        words = ", ".join(f"{name}={value}" for name, value in self.attributes().items())
        return f"{words}, temporal_filter={temporal_filter!r}"

    def over(self, axis: TimeAxis) -> Self:
        return replace(self, axis=axis)  # type: ignore[call-arg]

    @classmethod
    def from_arguments(cls, arguments: Mapping[str, Any]) -> Self | None:
        value = arguments.get(cls.argument)
        return None if value is None else cls(value, arguments.get(cls.beside))  # type: ignore[call-arg]

    def write(self, props: Any) -> None:
        axis = self.attributes()["axis"]
        if axis is not None:
            Histogram(axis).write(props)
        for name, prop in self.properties.items():
            props[prop] = getattr(self.settings, name)

    @classmethod
    def from_properties(cls, props: Any) -> Self | None:
        given = {name: props[prop] for name, prop in cls.properties.items() if prop in props}
        axis = Histogram.from_properties(props)
        assert axis is not None
        try:
            return cls(cls.kind(**given), axis.axis)  # type: ignore[call-arg]
        except (TypeError, TorchTransientError) as error:
            raise SceneError(f"{cls.plugin}: {error}") from error

    def describes(self, film: FilmInterface) -> bool:
        if film.measures != self.measures:
            return False
        built = self.from_film(film).attributes()
        return all(value is None or built[name] == value for name, value in self.attributes().items())

    def parts(self, arrivals: Arrivals) -> list[Arrivals]:
        """Return all light, which the steady image holds, and that of the time window."""
        return Histogram(self.attributes()["axis"]).parts(arrivals)

    def channels_first(self, cube: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
        return rows_channels_first(cube, leading, components)

    @classmethod
    def from_output(cls, output: Any) -> Self | None:
        found = [measured(output, name) for name in (cls.measures, *(field.name for field in fields(cls)))]
        return None if any(value is None for value in found) else cls(*found[1:])

    def entries(self) -> dict[str, Any]:
        axis = self.attributes()["axis"]
        return self.plain() | ({} if axis is None else Histogram(axis).entries())

    @classmethod
    def from_entries(cls, values: Mapping[str, Any]) -> Self | None:
        if cls.measures not in values:
            return None
        given = {field.name: values[f"{cls.argument}_{field.name}"] for field in fields(cls.kind)}
        plain = {name: value.item() if hasattr(value, "item") else value for name, value in given.items()}
        axis = TimeAxis(float(values["start_opl"]), float(values["bin_width_opl"]), int(values["num_bins"]))
        return cls(cls.kind(**plain), axis)  # type: ignore[call-arg]


@dataclass(frozen=True)
class Rates(RowsOfHistograms):
    """Radiance integrated over each bin of the rate and of the optical path length: float32 (C, R, T, H, W).

    Args:
        rate_axis: bins of the rate d opl / dt.
        axis: bins of optical path length, None for those of the scene's film.

    Raises:
        ArgumentError: for anything else.
    """

    measures: ClassVar[str] = "rates"
    plugin: ClassVar[str] = "rate_hdr_film"
    letter: ClassVar[str] = "R x T"
    argument: ClassVar[str] = "rates"
    example: ClassVar[str] = "rates=tt.RateAxis(start=..., bin_width=..., num_bins=...)"
    plural: ClassVar[str] = "rates"
    output: ClassVar[str] = "rates"
    takes_pulse: ClassVar[bool] = True
    kind: ClassVar[type] = RateAxis
    properties: ClassVar[dict[str, str]] = {"start": "rate_start", "bin_width": "rate_width", "num_bins": "rate_bins"}

    rate_axis: RateAxis
    axis: TimeAxis | None = None

    @classmethod
    def from_film(cls, film: Any) -> Self:
        return cls(RateAxis(film.rate_start, film.rate_width, film.rate_bins), Histogram.from_film(film).axis)

    @property
    def row_count(self) -> int:
        return self.rate_axis.num_bins


@dataclass(frozen=True)
class Beats(RowsOfHistograms):
    """Expected power spectra of the beat of chirps, up and down: float32 (C, 2, T, H, W).

    Args:
        chirps: chirps of the light.
        axis: bins over ``opl +- k rate``, None for those of the scene's film; ``chirps.time_axis`` proposes some.

    Raises:
        ArgumentError: for anything else.
    """

    measures: ClassVar[str] = "beats"
    plugin: ClassVar[str] = "beat_hdr_film"
    has_line: ClassVar[bool] = True
    letter: ClassVar[str] = "2 x T"
    argument: ClassVar[str] = "chirps"
    example: ClassVar[str] = "chirps=tt.Chirps(bandwidth_hz=..., duration_s=..., wavelength_m=...)"
    plural: ClassVar[str] = "beats"
    output: ClassVar[str] = "beats"
    takes_pulse: ClassVar[bool] = True
    kind: ClassVar[type] = Chirps
    properties: ClassVar[dict[str, str]] = {
        "bandwidth_hz": "chirp_bandwidth", "duration_s": "chirp_duration", "wavelength_m": "chirp_wavelength",
        "window": "chirp_window",
    }  # fmt: skip

    chirps: Chirps
    axis: TimeAxis | None = None

    @classmethod
    def from_film(cls, film: Any) -> Self:
        return cls(film.chirps, Histogram.from_film(film).axis)

    @classmethod
    def seen(cls, film: Any, arrivals: Arrivals) -> Arrivals:
        """Return the arrivals of a pilot run at the places of their beats, of both spectra."""
        k = film.chirps.rate_scale_s
        return arrivals.shifted((k, -k))

    @property
    def row_count(self) -> int:
        return 2

    def resolution_opl(self) -> float:
        return self.chirps.resolution_opl


@dataclass(frozen=True)
class SlowPhasors(FilmLayout):
    """Phasors at slow times, those of each pulse of a radar: complex64 (C, S, F, H, W).

    Args:
        slow_times: times of the pulses, seconds; poses are those of 0.
        frequencies: a :class:`~torchtransient.axes.FrequencyAxis`, or numbers in cycles per metre.

    Raises:
        ArgumentError: without frequencies.
        UnitError, ShapeError: for other numbers.
    """

    measures: ClassVar[str] = "slow_phasor"
    plugin: ClassVar[str] = "slow_phasor_hdr_film"
    letter: ClassVar[str] = "S x F"
    argument: ClassVar[str] = "slow_times"
    example: ClassVar[str] = "slow_times=[...], frequencies=tt.FrequencyAxis(...)"
    plural: ClassVar[str] = "slow phasors"
    output: ClassVar[str] = "slow_phasor"
    is_complex: ClassVar[bool] = True
    knows_rates: ClassVar[bool] = True
    beside: ClassVar[str] = "frequencies"

    slow_times: tuple[float, ...]
    frequencies: FrequencyAxis

    def __post_init__(self) -> None:
        given: Any = self.slow_times
        values = given.tolist() if hasattr(given, "tolist") else given
        if not isinstance(values, Iterable) or not (times := tuple(finite("slow_times", t) for t in values)):
            raise ArgumentError(f"slow_times: expected times in seconds, got {shown(given)}; write {self.example}.")
        if self.frequencies is None:
            raise ArgumentError(f"slow_times: expected frequencies beside them; write {self.example}.")
        object.__setattr__(self, "slow_times", times)
        object.__setattr__(self, "frequencies", Phasors(self.frequencies).frequencies)

    @property
    def count(self) -> int:
        return self.frequencies.num_frequencies

    @property
    def shape(self) -> tuple[int, ...]:
        return (len(self.slow_times), self.count)

    def attributes(self) -> dict[str, Any]:
        return {"slow_times": self.slow_times, "frequencies": self.frequencies}

    def plain(self) -> dict[str, Any]:
        return {"slow_times": list(self.slow_times), "frequencies": Phasors(self.frequencies).plain()}

    @classmethod
    def from_arguments(cls, arguments: Mapping[str, Any]) -> Self | None:
        value = arguments.get(cls.argument)
        return None if value is None else cls(value, arguments.get(cls.beside))  # type: ignore[arg-type]

    @classmethod
    def from_film(cls, film: Any) -> Self:
        return cls(film.slow_times, Phasors.from_film(film).frequencies)

    def write(self, props: Any) -> None:
        Phasors(self.frequencies).write(props)
        props["slow_times"] = ", ".join(map(repr, self.slow_times))

    def channels_first(self, cube: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
        pairs = torch.view_as_complex(cube.reshape(*cube.shape[:-1], -1, 2))
        return rows_channels_first(pairs, leading, components)

    @classmethod
    def from_output(cls, output: Any) -> Self | None:
        found = [measured(output, name) for name in (cls.measures, "slow_times", "frequencies")]
        return None if any(value is None for value in found) else cls(*found[1:])

    def entries(self) -> dict[str, Any]:
        times = torch.tensor(self.slow_times, dtype=torch.float64).numpy()
        return {"slow_times": times, **Phasors(self.frequencies).entries()}

    @classmethod
    def from_entries(cls, values: Mapping[str, Any]) -> Self | None:
        if cls.measures not in values:
            return None
        axis = FrequencyAxis(tuple(values["frequencies_per_metre"].tolist()), float(values["start_opl"]))
        return cls(tuple(values["slow_times"].tolist()), axis)


# ------------------------------------------------------------------------------------------------------ list of films

# A new film is added here, one of a user's own too. The first one is that of a plan that is asked for no other.
FILMS: list[type[FilmLayout]] = [Histogram, Phasors, Gates, Rates, Beats, SlowPhasors]


def film_of_arguments(arguments: Mapping[str, Any]) -> FilmLayout | None:
    """Return the film that keyword arguments ask for, None without one.

    Args:
        arguments: ``time_axis``, ``frequencies``, ``gates``, ``rates``, ``chirps``: at most one that is not None,
            beside the time axis of a film that has one.

    Raises:
        ArgumentError: for several, and for wrong settings, as the layouts raise it.
    """
    given = [found for kind in FILMS if (found := kind.from_arguments(arguments)) is not None]
    beside = {found.beside for found in given}
    given = [found for found in given if found.argument not in beside]
    if len(given) > 1:
        names, films = ", ".join(kind.argument for kind in FILMS), [f"a {kind.measures} film" for kind in FILMS]
        raise ArgumentError(f"{names}: a film is {', '.join(films[:-1])} or {films[-1]}; give one of them.")
    return given[0] if given else None


def layout_of_film(film: Any) -> FilmLayout:
    """Return the layout of a built film.

    Args:
        film: film of a built sensor.

    Raises:
        SceneError: for films that are not time-resolved, or not listed.
    """
    if not is_time_resolved(film):
        raise SceneError(
            f"the sensor's film has no time axis; use one of {', '.join(kind.plugin for kind in FILMS)}, or give "
            f"{' or '.join(kind.example for kind in FILMS)}."
        )
    for kind in FILMS:
        if kind.measures == film.measures:
            return kind.from_film(film)
    known = ", ".join(kind.measures for kind in FILMS)
    raise SceneError(
        f"the film {film.plugin!r} measures {film.measures!r}, expected one of {known}; see "
        "torchtransient.rendering.films.FilmLayout."
    )


def layout_of_output(output: Any) -> FilmLayout | None:
    """Return the layout of a ``RenderOutput`` or a ``Result``, None where it holds a steady image alone.

    Args:
        output: the result.
    """
    return next((found for kind in FILMS if (found := kind.from_output(output)) is not None), None)


def layout_of_entries(values: Mapping[str, Any]) -> FilmLayout:
    """Return the layout of the arrays and numbers of a result file.

    Args:
        values: entries by name.

    Raises:
        KeyError: for a file of none of the films.
    """
    for kind in FILMS:
        found = kind.from_entries(values)
        if found is not None:
            return found
    raise KeyError(" or ".join(kind.measures for kind in FILMS))


def layout_of_plugin(plugin: str) -> type[FilmLayout] | None:
    """Return the class for a film plugin, None for plugins that are not listed.

    Args:
        plugin: plugin name.
    """
    return next((kind for kind in FILMS if kind.plugin == plugin), None)
