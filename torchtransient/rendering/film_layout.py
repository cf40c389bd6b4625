"""Base of films on the side of torch, and the order of their tensors."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, Self

import torch

from torchtransient.axes import TimeAxis
from torchtransient.interfaces import FilmInterface

if TYPE_CHECKING:
    from torchtransient.scene.pilot import Arrivals


@dataclass(frozen=True)
class FilmLayout(abc.ABC):
    """Settings of a film, and where its measurements lie in a tensor.

    A subclass is a frozen dataclass with one field, the settings; outputs have them under the name of the field. It
    defines the names from ``measures`` to ``output`` and the abstract methods; the rest has defaults. Layouts with
    equal settings are equal.
    """

    # Word of the plugin's `measures`: the attribute of a RenderOutput, and the name in a result file.
    measures: ClassVar[str]
    plugin: ClassVar[str]
    # Letters of the dimensions between channels and rows.
    letter: ClassVar[str]
    # Name of the settings: the keyword of TransientRenderer and tt.plan, of films that have one. A call that asks for
    # the film, written out for messages ("film=..." of films without a keyword).
    argument: ClassVar[str]
    example: ClassVar[str]
    # Name of the measurements in messages.
    plural: ClassVar[str]
    # Name in tt.plan(outputs=...).
    output: ClassVar[str]
    # The film has bins of time: a temporal filter, an axis that a plan can find, a steady image that can be left out.
    has_bins: ClassVar[bool] = False
    is_complex: ClassVar[bool] = False
    # The film spreads every arrival by a line of its own, which has a slope over time.
    has_line: ClassVar[bool] = False
    # The film measures how fast paths get longer.
    knows_rates: ClassVar[bool] = False
    # The film spreads arrivals by a pulse and an impulse response.
    takes_pulse: ClassVar[bool] = False
    # Keyword of another film that this one takes beside its own, empty for none.
    beside: ClassVar[str] = ""
    # Remedy for a response over time without a slope (`jump`): the end of an error message.
    slope_remedy: ClassVar[str] = ""

    if TYPE_CHECKING:

        def __init__(self, settings: Any, /) -> None: ...

    # ----------------------------------------------------------------------------------------------------- settings

    @property
    @abc.abstractmethod
    def count(self) -> int:
        """Number of entries along the film's own dimension."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Sizes of the dimensions between channels and rows."""
        return (self.count,)

    @property
    def settings(self) -> Any:
        """Value of the keyword ``argument``: the field of the dataclass."""
        return getattr(self, fields(self)[0].name)

    def attributes(self) -> dict[str, Any]:
        """Return the settings by the name that renderers and outputs give them."""
        return {fields(self)[0].name: self.settings}

    def plain(self) -> Any:
        """Return the settings as plain data for JSON."""
        return self.settings

    def resolution_opl(self) -> float | None:
        """Return the width of bins that a plan takes, metres; None for the width of the scene's film."""
        return None

    def describe(self, temporal_filter: str) -> str:
        """Return the film's part of ``print(renderer)``.

        Args:
            temporal_filter: name of the filter in use, empty for none.
        """
        return f"{self.argument}={self.settings}"

    def over(self, axis: TimeAxis) -> FilmLayout:
        """Return the same film, one with bins, over other bins of time.

        Args:
            axis: bins of optical path length.
        """
        return type(self)(axis)

    def jump(self) -> str:
        """Return the name of a response over time that jumps and has no slope without a pulse; empty without one, and
        for films with bins, whose temporal filter decides.
        """
        return ""

    @classmethod
    def from_arguments(cls, arguments: Mapping[str, Any]) -> Self | None:
        """Return the film that the keywords of a call ask for, None for another one.

        Args:
            arguments: keywords of the call.
        """
        value = arguments.get(cls.argument)
        return None if value is None else cls(value)

    # ----------------------------------------------------------------------------------------------- scene and film

    @classmethod
    @abc.abstractmethod
    def from_film(cls, film: Any) -> Self:
        """Return the settings of a film plugin that ``measures`` this.

        Args:
            film: film of a built sensor.
        """

    @classmethod
    def from_properties(cls, props: Any) -> Self | None:
        """Return the settings of a described film node, None where a plan needs none before the scene is built.

        Args:
            props: properties of the node.

        Raises:
            SceneError: for properties that the plugin refuses.
        """
        return None

    @abc.abstractmethod
    def write(self, props: Any) -> None:
        """Write the settings into the properties of a film node of this plugin.

        Args:
            props: ``mitsuba.Properties`` of the node, changed in place.
        """

    @classmethod
    def fits(cls, plugin: str) -> bool:
        """Return whether a film plugin takes the properties that :meth:`write` writes.

        Args:
            plugin: plugin name.
        """
        return plugin == cls.plugin

    def describes(self, film: FilmInterface) -> bool:
        """Return whether a built film has these settings.

        Args:
            film: film of a built sensor.
        """
        return bool(film.measures == self.measures) and self.from_film(film) == self

    # ------------------------------------------------------------------------------------------------------ tensors

    def channels_first(self, cube: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
        """Return the array of a film in the order of torch.

        Args:
            cube: array (H, W, ..., C) of a film, with or without one dimension of items.
            leading: sizes of the dimensions of items.
            components: Stokes components that the film's channels are made of; more than one come before C.

        Returns:
            (C, ..., H, W) behind ``leading``.
        """
        return cube_channels_first(cube, leading, components)

    def tensor(self, output: Any) -> torch.Tensor | None:
        """Return the film's tensor in an output or a result.

        Args:
            output: ``RenderOutput`` or ``Result``.
        """
        tensor: torch.Tensor | None = measured(output, self.measures)
        return tensor

    @classmethod
    def from_output(cls, output: Any) -> Self | None:
        """Return the settings that an output or a result has, None where it holds nothing of this film.

        Args:
            output: ``RenderOutput`` or ``Result``.
        """
        settings = measured(output, fields(cls)[0].name)
        return None if settings is None or measured(output, cls.measures) is None else cls(settings)

    # ------------------------------------------------------------------------------------------------- result files

    @abc.abstractmethod
    def entries(self) -> dict[str, Any]:
        """Return the arrays, numbers and texts of a result file that hold the settings."""

    @classmethod
    @abc.abstractmethod
    def from_entries(cls, values: Mapping[str, Any]) -> Self | None:
        """Return the settings that a result file holds, None for a file of another film.

        Args:
            values: entries of the file by name.
        """

    # --------------------------------------------------------------------------------------------------- pilot runs

    @classmethod
    def seen(cls, film: FilmInterface, arrivals: Arrivals) -> Arrivals:
        """Return the arrivals of a pilot run, weighted by the response of a built ``film`` at their times.

        Args:
            film: film of a built sensor.
            arrivals: arrivals of the run.
        """
        return arrivals

    def parts(self, arrivals: Arrivals) -> list[Arrivals]:
        """Return parts of the light of a pilot run; a bound on depth has to keep enough of each.

        Args:
            arrivals: arrivals of the run, as the film sees them.
        """
        return [arrivals]


def measured(output: Any, name: str) -> Any:
    """Return an attribute of an output or a result, or one of its ``others``; None where it has neither.

    Args:
        output: `RenderOutput` or `Result`.
        name: name of the quantity that the film measures, such as "transient".
    """
    found = getattr(output, name, None)
    return getattr(output, "others", {}).get(name) if found is None else found


# ------------------------------------------------------------------------------------------- from memory order to torch

# Dimensions of the film of an exhaustive scan, without those of items.
_EXHAUSTIVE = 6


def steady_channels_first(steady: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
    """Return a steady image in the order of torch.

    Args:
        steady: steady image (H, W, C) of a film, with or without one dimension of items.
        leading: sizes of the dimensions of items.
        components: Stokes components that the film's channels are made of; more than one come before C.

    Returns:
        (C, H, W) behind ``leading``.
    """
    steady = steady.reshape(*leading, *steady.shape[-3:])
    return _stokes_first(steady.movedim(-1, -3), -3, components)


def cube_channels_first(cube: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
    """Return an array over time in the order of torch.

    Args:
        cube: array (H, W, T, C) of a film, or (H, W, Lh, Lw, T, C) of an exhaustive scan, with or without a dimension
            of items.
        leading: sizes of the dimensions of items.
        components: Stokes components that the film's channels are made of; more than one come before C.

    Returns:
        (C, T, H, W) behind ``leading``; (C, T, Lh, Lw, H, W) of an exhaustive scan.
    """
    if cube.ndim >= _EXHAUSTIVE:
        cube = cube.reshape(*leading, *cube.shape[-_EXHAUSTIVE:])
        return _stokes_first(cube.movedim((-1, -2, -4, -3), (-6, -5, -4, -3)), -6, components)
    cube = cube.reshape(*leading, *cube.shape[-4:])
    return _stokes_first(cube.movedim((-1, -2), (-4, -3)), -4, components)


def phasor_channels_first(cube: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
    """Return phasors in the order of torch, as :func:`cube_channels_first`.

    Args:
        cube: array (H, W, F, 2 C) of real and imaginary parts in turn.
        leading: sizes of the dimensions of items.
        components: Stokes components that the film's channels are made of; more than one come before C.

    Returns:
        Complex (C, F, H, W) behind ``leading``.
    """
    pairs = torch.view_as_complex(cube.reshape(*cube.shape[:-1], -1, 2))
    return cube_channels_first(pairs, leading, components)


def rows_channels_first(cube: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
    """Return several arrays a pixel in the order of torch, as :func:`cube_channels_first`.

    Args:
        cube: array (H, W, rows, entries, C) of a film.
        leading: sizes of the dimensions of items.
        components: Stokes components that the film's channels are made of; more than one come before C.

    Returns:
        (C, rows, entries, H, W) behind ``leading``.
    """
    cube = cube.reshape(*leading, *cube.shape[-5:])
    return _stokes_first(cube.movedim((-1, -3, -2), (-5, -4, -3)), -5, components)


def _stokes_first(tensor: torch.Tensor, channel_dim: int, components: int) -> torch.Tensor:
    if components == 1:
        return tensor
    split: torch.Tensor = tensor.unflatten(channel_dim, (components, -1))  # type: ignore[no-untyped-call]
    return split
