"""What a film measures, as an object: everything outside of ``plugins/`` that differs from film to film.

A film is one plugin (``plugins/films``), one subclass of :class:`FilmChoice`, and one entry in the list of
:mod:`.choices`. Renderer, plan, result files and command line ask the choice and name no film themselves.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import torch
from numpy.typing import NDArray

from torchtransient.axes import TimeAxis
from torchtransient.errors import ArgumentError

if TYPE_CHECKING:
    from torchtransient.interfaces import FilmInterface
    from torchtransient.scene.pilot import Arrivals


@dataclass(frozen=True)
class CommandOption:
    """An option of the command line: ``--name-in-words``, how its value is read, and its line of help."""

    name: str
    kind: Callable[[str], Any]
    help: str
    metavar: str | None = None


@dataclass(frozen=True)
class FilmChoice(abc.ABC):
    """A film and its settings. Subclasses are frozen dataclasses: equal, hashable and picklable by their settings."""

    # The word of the plugin's `measures`: also the attribute of a RenderOutput, and the name in a result file.
    measures: ClassVar[str]
    plugin: ClassVar[str]
    # Letter of the dimension between channels and rows.
    letter: ClassVar[str]
    # What the settings are called: the keyword of TransientRenderer and tt.plan for films that have one. How a call
    # asks for this film, written out for messages ("film=..." for films without a keyword).
    argument: ClassVar[str]
    example: ClassVar[str]
    # What tt.plan(outputs=...) calls it, and what the plan calls the film.
    output: ClassVar[str]
    plan_name: ClassVar[str]
    # What messages call the film and, in the plural, its measurements.
    noun: ClassVar[str]
    plural: ClassVar[str]
    options: ClassVar[tuple[CommandOption, ...]] = ()
    # Pictures of `torchtransient render` that show it.
    pictures: ClassVar[tuple[str, ...]] = ()
    # Whether its numbers are complex; whether the film has a temporal filter; a time axis that a plan can find; whether
    # it spreads arrivals by pulses; whether its steady image can be left out.
    is_complex: ClassVar[bool] = False
    has_filter: ClassVar[bool] = False
    has_axis: ClassVar[bool] = False
    takes_pulse: ClassVar[bool] = False
    spares_steady: ClassVar[bool] = False
    # What to do where `jump` names a response over time without a slope: the end of an error message.
    slope_remedy: ClassVar[str] = ""

    # ------------------------------------------------------------------------------------------ where it comes from

    @classmethod
    @abc.abstractmethod
    def from_argument(cls, value: Any) -> Self:
        """From the value of the keyword. Raises ``ArgumentError``, ``UnitError`` or ``ShapeError``."""

    @classmethod
    @abc.abstractmethod
    def from_film(cls, film: FilmInterface) -> Self:
        """From a film plugin that ``measures`` this."""

    @classmethod
    @abc.abstractmethod
    def from_output(cls, output: Any) -> Self | None:
        """From what a render returned or a file held; None when it holds nothing of this film."""

    @classmethod
    @abc.abstractmethod
    def from_entries(cls, values: Mapping[str, Any]) -> Self | None:
        """From the arrays and numbers of a result file; None when the file is of another film."""

    @classmethod
    def from_options(cls, options: Mapping[str, Any]) -> Self | None:
        """From the options of a command line; None when none is given. Raises typed errors."""
        return None

    # ------------------------------------------------------------------------------------------------- what it says

    @property
    @abc.abstractmethod
    def count(self) -> int:
        """Entries along the film's own dimension."""

    @abc.abstractmethod
    def attributes(self) -> dict[str, Any]:
        """What a renderer and its output know of the settings, by the name of the attribute."""

    @abc.abstractmethod
    def argument_value(self) -> Any:
        """The value of the keyword."""

    @abc.abstractmethod
    def plain(self) -> Any:
        """The settings as plain data for JSON."""

    @abc.abstractmethod
    def describe(self, temporal_filter: str) -> str:
        """How ``print(renderer)`` shows it."""

    def jump(self) -> str:
        """What messages call the response over time where it jumps, so that there is no slope without a pulse; empty
        where it does not, and for films whose temporal filter decides.
        """
        return ""

    # ------------------------------------------------------------------------------------------------ scene and film

    @abc.abstractmethod
    def write(self, props: Any) -> None:
        """Write the settings into the properties of a film node of this plugin."""

    def describes(self, film: FilmInterface) -> bool:
        """Return whether a built film has these settings."""
        return film.measures == self.measures and self.from_film(film) == self

    @classmethod
    def fits(cls, plugin: str) -> bool:
        """Whether a film plugin takes the properties that :meth:`write` writes."""
        return plugin == cls.plugin

    # ------------------------------------------------------------------------------------------------------- tensors

    @abc.abstractmethod
    def channels_first(self, cube: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
        """From the film's (H, W, ..., C), with or without one dimension of items, to (C, ..., H, W) behind ``leading``.

        ``components``: Stokes components that the film's channels are made of; more than one come before C.
        """

    def tensor(self, output: Any) -> torch.Tensor | None:
        """The film's tensor in an output or a result."""
        tensor: torch.Tensor | None = measured(output, self.measures)
        return tensor

    @classmethod
    def tensor_in(cls, values: Mapping[str, Any]) -> Any:
        """The film's array among those of a result file."""
        return values[cls.measures]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays of a result file beside the film's tensor."""
        return {}

    @abc.abstractmethod
    def numbers(self) -> dict[str, Any]:
        """Numbers and texts of a result file that say how the film was set."""

    def summary(self, shape: str, stokes: str, temporal_filter: str) -> tuple[str, str]:
        """For the line about a written file: what is in it, and how it was made."""
        return f"{shape} ({stokes}C x {self.letter} x H x W) {self.plural}", ""

    def write_video(self, output: Any, path: Any, progress: bool) -> str:
        """Write a video of a render, and say what it shows. Raises as ``tt.vis.video``."""
        raise ArgumentError(f"--video shows nothing of {self.plural}; leave it out.")

    # ---------------------------------------------------------------------------------------------------------- plan

    @classmethod
    def planned(cls, outputs: Sequence[str]) -> PlannedFilm:
        """The film of a plan for some outputs, this film's among them, with the line that explains it."""
        return PlannedFilm(
            cls, cls.plan_name, f"film: {cls.plan_name}, since {cls.plural} are asked for{cls._plan_note()}"
        )

    @classmethod
    def _plan_note(cls) -> str:
        return ""

    @classmethod
    def needed(cls) -> str:
        """What to say when neither the scene nor the call has the settings; empty when the plan finds them."""
        return (
            f"tt.plan: {cls.plural} are asked for, and neither the film nor the call has {cls.argument}. Give "
            f"{cls.example}, or make the film a {cls.plugin}."
        )

    @classmethod
    def axis_in(cls, props: Any) -> TimeAxis | None:
        """The time axis that a film node describes, None for films without one."""
        return None

    @classmethod
    def settings_in(cls, props: Any) -> Self | None:
        """The settings that a film node describes, as far as a plan has to know them before a scene is built."""
        return None

    @classmethod
    @abc.abstractmethod
    def film_of_pilot(cls, planned: FilmChoice | None) -> FilmChoice | None:
        """The film under which a pilot run is built, None to keep the scene's; ``planned`` is that of the plan."""

    @classmethod
    def seen(cls, film: FilmInterface, arrivals: Arrivals) -> Arrivals:
        """The arrivals of a pilot run as the film sees them."""
        return arrivals

    def parts(self, arrivals: Arrivals) -> list[Arrivals]:
        """The light of a pilot run, and parts of it of each of which a bound on depth has to keep enough."""
        return [arrivals]


@dataclass(frozen=True)
class PlannedFilm:
    """``kind``: class of the film. ``name``: what the plan calls it. ``all_times``: one bin for the light of all times,
    where nothing over time is asked for.
    """

    kind: type[FilmChoice]
    name: str
    reason: str
    all_times: bool = False


def measured(output: Any, name: str) -> Any:
    """What an output or a result holds under a name: an attribute, or one of the ``others``; None if it has neither."""
    found = getattr(output, name, None)
    return getattr(output, "others", {}).get(name) if found is None else found
