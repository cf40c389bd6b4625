"""``frequencies=``: phasors at chosen frequencies behind every pixel (``phasor_hdr_film``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import torch
from numpy.typing import NDArray

from torchtransient.axes import FrequencyAxis
from torchtransient.errors import UnitError
from torchtransient.rendering.films.choice import CommandOption, FilmChoice, measured
from torchtransient.rendering.films.histogram import Histogram
from torchtransient.rendering.films.layout import phasor_channels_first

# Properties of a phasor film that say which frequencies it keeps; explicit frequencies replace them.
_PEER_FREQUENCIES = (
    "wl_mean", "wl_sigma", "temporal_bins", "bin_width_opl", "frequency_first", "frequency_step", "frequency_count",
)  # fmt: skip


@dataclass(frozen=True)
class Phasors(FilmChoice):
    """Radiance times ``exp(-2 pi i nu (opl - start_opl))`` for each of ``frequencies``: complex64 (C, F, H, W).

    A :class:`~torchtransient.axes.FrequencyAxis`, or numbers in cycles per metre. Raises ``UnitError`` or
    ``ShapeError`` for anything else.
    """

    measures: ClassVar[str] = "phasor"
    plugin: ClassVar[str] = "phasor_hdr_film"
    letter: ClassVar[str] = "F"
    argument: ClassVar[str] = "frequencies"
    example: ClassVar[str] = "frequencies=tt.FrequencyAxis(...)"
    output: ClassVar[str] = "phasor"
    plan_name: ClassVar[str] = "phasor"
    noun: ClassVar[str] = "phasor film"
    plural: ClassVar[str] = "phasors"
    options: ClassVar[tuple[CommandOption, ...]] = (
        CommandOption("frequencies", str, "Phasors at these cycles per metre instead of a transient.", "NU,NU,..."),
    )
    pictures: ClassVar[tuple[str, ...]] = ("video",)
    is_complex: ClassVar[bool] = True

    frequencies: FrequencyAxis

    def __post_init__(self) -> None:
        if not isinstance(self.frequencies, FrequencyAxis):
            object.__setattr__(self, "frequencies", FrequencyAxis(self.frequencies))

    @classmethod
    def from_argument(cls, value: Any) -> Self:
        return cls(value)

    @classmethod
    def from_film(cls, film: Any) -> Self:
        return cls(FrequencyAxis(tuple(film.frequencies.tolist()), film.start_opl))

    @classmethod
    def from_output(cls, output: Any) -> Self | None:
        frequencies = measured(output, "frequencies")
        return None if frequencies is None or measured(output, cls.measures) is None else cls(frequencies)

    @classmethod
    def from_entries(cls, values: Mapping[str, Any]) -> Self | None:
        if cls.measures not in values:
            return None
        return cls(FrequencyAxis(tuple(values["frequencies_per_metre"].tolist()), float(values["start_opl"])))

    @classmethod
    def from_options(cls, options: Mapping[str, Any]) -> Self | None:
        given = options.get("frequencies")
        if given is None:
            return None
        try:
            return cls(FrequencyAxis(tuple(float(text) for text in given.split(","))))
        except ValueError:
            raise UnitError(f"--frequencies: expected numbers with commas, got '{given}'.") from None

    @property
    def count(self) -> int:
        return self.frequencies.num_frequencies

    def attributes(self) -> dict[str, Any]:
        return {"frequencies": self.frequencies}

    def argument_value(self) -> FrequencyAxis:
        return self.frequencies

    def plain(self) -> list[float]:
        return list(self.frequencies.frequencies)

    def describe(self, temporal_filter: str) -> str:
        return f"frequencies={self.frequencies}"

    def write(self, props: Any) -> None:
        for name in _PEER_FREQUENCIES:
            if name in props:
                del props[name]
        props["frequencies"] = ", ".join(repr(f) for f in self.frequencies.frequencies)
        props["start_opl"] = self.frequencies.start_opl

    def channels_first(self, cube: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
        return phasor_channels_first(cube, leading, components)

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {"frequencies_per_metre": self.frequencies.per_metre.numpy()}

    def numbers(self) -> dict[str, Any]:
        return {"start_opl": self.frequencies.start_opl}

    def write_video(self, output: Any, path: Any, progress: bool) -> str:
        from torchtransient.vis.phasors import phasor_video

        phasor_video(output, path, progress=progress)
        return "the wave of the first frequency"

    @classmethod
    def _plan_note(cls) -> str:
        return "; no time axis is stored"

    @classmethod
    def film_of_pilot(cls, planned: FilmChoice | None) -> FilmChoice | None:
        return Histogram.film_of_pilot(None)
