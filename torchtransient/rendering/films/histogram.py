"""``time_axis=``: a histogram over optical path length behind every pixel (``transient_hdr_film``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import torch
from numpy.typing import NDArray

from torchtransient.axes import TimeAxis
from torchtransient.errors import ArgumentError
from torchtransient.gates import Gate
from torchtransient.rendering.films.choice import CommandOption, FilmChoice, PlannedFilm, measured
from torchtransient.rendering.films.layout import cube_channels_first

if TYPE_CHECKING:
    from torchtransient.scene.pilot import Arrivals

# Under a pilot run nothing is stored: the film only has to be one that integrators take.
_ANY_AXIS = TimeAxis(0.0, 1.0, 1)


@dataclass(frozen=True)
class Histogram(FilmChoice):
    """Radiance integrated over each bin of ``axis``: float32 (C, T, H, W). ``ArgumentError`` for what is no axis."""

    measures: ClassVar[str] = "transient"
    plugin: ClassVar[str] = "transient_hdr_film"
    letter: ClassVar[str] = "T"
    argument: ClassVar[str] = "time_axis"
    example: ClassVar[str] = "time_axis=tt.TimeAxis(start_opl=..., bin_width_opl=..., num_bins=...)"
    output: ClassVar[str] = "transient"
    plan_name: ClassVar[str] = "transient"
    noun: ClassVar[str] = "histogram"
    plural: ClassVar[str] = "transients"
    options: ClassVar[tuple[CommandOption, ...]] = (
        CommandOption("start_opl", float, "Start of the time axis, metres of optical path."),
        CommandOption("bin_width_opl", float, "Width of a bin, metres of optical path."),
        CommandOption("num_bins", int, "Number of bins."),
    )
    pictures: ClassVar[tuple[str, ...]] = ("overview", "peak_time", "rainbow", "video")
    has_filter: ClassVar[bool] = True
    has_axis: ClassVar[bool] = True
    takes_pulse: ClassVar[bool] = True
    spares_steady: ClassVar[bool] = True

    axis: TimeAxis

    def __post_init__(self) -> None:
        given: Any = self.axis
        if not isinstance(given, TimeAxis):
            raise ArgumentError(f"time_axis: expected a tt.TimeAxis, got {type(given).__name__}; write {self.example}.")

    @classmethod
    def from_argument(cls, value: Any) -> Self:
        return cls(value)

    @classmethod
    def from_film(cls, film: Any) -> Self:
        return cls(TimeAxis(film.start_opl, film.bin_width_opl, film.temporal_bins))

    @classmethod
    def from_output(cls, output: Any) -> Self | None:
        axis = measured(output, "axis")
        return None if axis is None or measured(output, cls.measures) is None else cls(axis)

    @classmethod
    def from_entries(cls, values: Mapping[str, Any]) -> Self | None:
        if cls.measures not in values or "num_bins" not in values:
            return None
        return cls(TimeAxis(float(values["start_opl"]), float(values["bin_width_opl"]), int(values["num_bins"])))

    @classmethod
    def from_options(cls, options: Mapping[str, Any]) -> Self | None:
        start, width, bins = (options.get(option.name) for option in cls.options)
        if start is None and width is None and bins is None:
            return None
        if start is None or width is None or bins is None:
            raise ArgumentError(
                "--start-opl, --bin-width-opl and --num-bins replace the scene's axis together: give all."
            )
        return cls(TimeAxis(start, width, bins))

    @property
    def count(self) -> int:
        return self.axis.num_bins

    def attributes(self) -> dict[str, Any]:
        return {"axis": self.axis}

    def argument_value(self) -> TimeAxis:
        return self.axis

    def plain(self) -> dict[str, Any]:
        axis = self.axis
        return {"start_opl": axis.start_opl, "bin_width_opl": axis.bin_width_opl, "num_bins": axis.num_bins}

    def describe(self, temporal_filter: str) -> str:
        return f"axis={self.axis}, temporal_filter={temporal_filter!r}"

    def write(self, props: Any) -> None:
        props["start_opl"], props["bin_width_opl"] = self.axis.start_opl, self.axis.bin_width_opl
        props["temporal_bins"] = self.axis.num_bins

    @classmethod
    def fits(cls, plugin: str) -> bool:
        """Histograms of other packages are set by the same properties; one that is not says so when it is built."""
        return True

    def channels_first(self, cube: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
        return cube_channels_first(cube, leading, components)

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {"edges_opl": self.axis.edges_opl.numpy()}

    def numbers(self) -> dict[str, Any]:
        return self.plain()

    def summary(self, shape: str, stokes: str, temporal_filter: str) -> tuple[str, str]:
        return f"{shape} ({stokes}C x T x H x W)", f", {temporal_filter} filter"

    def write_video(self, output: Any, path: Any, progress: bool) -> str:
        from torchtransient.vis.video import video

        video(output, path, progress=progress)
        return f"{self.count} frames"

    @classmethod
    def planned(cls, outputs: Sequence[str]) -> PlannedFilm:
        if "steady" in outputs and cls.output not in outputs:
            why = "film: steady, one bin for all times, since nothing over time is asked for"
            return PlannedFilm(cls, "steady", why, all_times=True)
        asked = "transients are" if cls.output in outputs else f"{outputs[0]} over time is"
        return PlannedFilm(cls, cls.plan_name, f"film: transient, since {asked} asked for")

    @classmethod
    def needed(cls) -> str:
        return ""

    @classmethod
    def axis_in(cls, props: Any) -> TimeAxis | None:
        start, width = float(props.get("start_opl", 0.0)), float(props.get("bin_width_opl", 0.003))
        return TimeAxis(start, width, int(props.get("temporal_bins", 2048)))

    def parts(self, arrivals: Arrivals) -> list[Arrivals]:
        """All light, which the steady image holds, and that of the time window."""
        return [arrivals, arrivals.through([Gate.rectangular(self.axis.start_opl, self.axis.end_opl)])]

    @classmethod
    def film_of_pilot(cls, planned: FilmChoice | None) -> FilmChoice:
        return cls(_ANY_AXIS)
