"""``gates=``: the light behind every pixel as time gates see it (``gated_hdr_film``)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import torch

from torchtransient.errors import ArgumentError, SceneError, TorchTransientError
from torchtransient.gates import SLOPE_REMEDY, Gate, gates_from_text, gates_to_text, jump_in
from torchtransient.rendering.films.choice import CommandOption, FilmChoice, measured
from torchtransient.rendering.films.layout import cube_channels_first

if TYPE_CHECKING:
    from torchtransient.scene.pilot import Arrivals


@dataclass(frozen=True)
class Gates(FilmChoice):
    """The light as each of ``gates`` sees it: float32 (C, G, H, W). The steady image is the sum over the gates.

    One :class:`~torchtransient.gates.Gate` or several. Raises ``ArgumentError`` for anything else.
    """

    measures: ClassVar[str] = "gated"
    plugin: ClassVar[str] = "gated_hdr_film"
    letter: ClassVar[str] = "G"
    argument: ClassVar[str] = "gates"
    example: ClassVar[str] = "gates=[tt.Gate.gaussian(...)]"
    output: ClassVar[str] = "gates"
    plan_name: ClassVar[str] = "gated"
    noun: ClassVar[str] = "gated film"
    plural: ClassVar[str] = "gates"
    options: ClassVar[tuple[CommandOption, ...]] = (
        CommandOption("gates", str, "Gates as scene files write them, instead of a transient.", "GATE;GATE;..."),
    )
    pictures: ClassVar[tuple[str, ...]] = ("video",)
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

    @classmethod
    def from_argument(cls, value: Any) -> Self:
        return cls(value)

    @classmethod
    def from_film(cls, film: Any) -> Self:
        return cls(tuple(film.gates))

    @classmethod
    def from_output(cls, output: Any) -> Self | None:
        gates = measured(output, "gates")
        return None if gates is None or measured(output, cls.measures) is None else cls(tuple(gates))

    @classmethod
    def from_entries(cls, values: Mapping[str, Any]) -> Self | None:
        return cls(gates_from_text(str(values["gates"]))) if "gates" in values else None

    @classmethod
    def from_options(cls, options: Mapping[str, Any]) -> Self | None:
        given = options.get("gates")
        return None if given is None else cls(gates_from_text(given))

    @classmethod
    def tensor_in(cls, values: Mapping[str, Any]) -> Any:
        """Files of earlier versions call it a transient."""
        return values[cls.measures] if cls.measures in values else values["transient"]

    @property
    def count(self) -> int:
        return len(self.gates)

    def attributes(self) -> dict[str, Any]:
        return {"gates": self.gates}

    def argument_value(self) -> tuple[Gate, ...]:
        return self.gates

    def plain(self) -> list[dict[str, Any]]:
        return [asdict(gate) for gate in self.gates]

    def describe(self, temporal_filter: str) -> str:
        return f"gates={self.count}"

    def jump(self) -> str:
        return jump_in(self.gates)

    def write(self, props: Any) -> None:
        props["gates"] = gates_to_text(self.gates)

    def channels_first(self, cube: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
        return cube_channels_first(cube, leading, components)

    def numbers(self) -> dict[str, Any]:
        return {"gates": gates_to_text(self.gates)}

    def write_video(self, output: Any, path: Any, progress: bool) -> str:
        from torchtransient.vis.video import video

        video(output, path, progress=progress)
        return f"{self.count} frames, one for each gate"

    @classmethod
    def settings_in(cls, props: Any) -> Self | None:
        try:
            return cls(gates_from_text(str(props["gates"]))) if "gates" in props else None
        except TorchTransientError as error:
            raise SceneError(f"{cls.plugin}: {error}") from error

    @classmethod
    def film_of_pilot(cls, planned: FilmChoice | None) -> FilmChoice | None:
        """The gates themselves, whose pulses widen what they see."""
        return planned

    @classmethod
    def seen(cls, film: Any, arrivals: Arrivals) -> Arrivals:
        seen: tuple[Gate, ...] = tuple(film.gates)
        for pulse in film.pulses:
            seen = tuple(gate.spread(pulse) for gate in seen)
        return arrivals.through(seen)
