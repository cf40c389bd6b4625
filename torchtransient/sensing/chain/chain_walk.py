"""How a chain is gone through: one walk for its checks, its means, its draws and their normal surrogate.

A row is what light passes one after another: a `Compose`, an ``nn.Sequential``, an ``nn.ModuleList``. Branches are what
it passes one of: the sensors of `PixelGroups`. Everything else is one stage.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import torch
from torch import Tensor, nn

from torchtransient.errors import ArgumentError
from torchtransient.sensing.base.policies import GradPolicy
from torchtransient.sensing.base.sensor import Quantity, RandomSensor, Sensor

Step = Callable[[nn.Module, Tensor], Tensor]


def row_of(stage: nn.Module) -> nn.Module | None:
    """The container of the stages that a row is made of; None for a single stage."""
    if isinstance(stage, nn.ModuleList):
        return stage
    if isinstance(stage, nn.Sequential):
        return stage if type(stage).forward is nn.Sequential.forward else None
    inner = getattr(stage, "stages", None) if isinstance(stage, Sensor) else None
    return inner if isinstance(inner, (nn.Sequential, nn.ModuleList)) else None


def branches_of(stage: nn.Module) -> Sequence[tuple[str, nn.Module]]:
    """The sensors of which every pixel passes one, with their names; none for a stage that has no branches."""
    inner = getattr(stage, "sensors", None) if isinstance(stage, Sensor) else None
    return named(inner) if isinstance(inner, nn.ModuleList) else []


def named(row: nn.Module) -> list[tuple[str, nn.Module]]:
    """The stages of a container, a stage that stands there twice as well, which torch lists once."""
    return [(name, stage) for name, stage in row._modules.items() if stage is not None]


def in_order(stages: Iterable[tuple[str, nn.Module]], prefix: str = "") -> Iterator[tuple[str, nn.Module]]:
    """The single stages of rows in rows, in the order of the light, with their places: ``0``, ``1.0``, ``1.1``."""
    for name, stage in stages:
        row = row_of(stage)
        if row is None:
            yield f"{prefix}{name}", stage
        else:
            yield from in_order(named(row), f"{prefix}{name}.")


def numbered(stages: Iterable[nn.Module]) -> Iterator[tuple[str, nn.Module]]:
    """Stages with their numbers for names."""
    return ((str(number), stage) for number, stage in enumerate(stages))


def parts_of(chain: nn.Module) -> Iterator[tuple[str, Sensor]]:
    """Every sensor in a chain with its place, those that other sensors are made of too."""
    for name, part in chain.named_modules(remove_duplicate=False):
        if part is not chain and isinstance(part, Sensor):
            yield name.replace("stages.", ""), part


def unrolled(stages: Iterable[nn.Module]) -> list[nn.Module]:
    """Stages to call one after another. Rows of torch's own with sensors in them are opened: they know no generator."""
    found: list[nn.Module] = []
    for stage in stages:
        row = None if isinstance(stage, Sensor) else row_of(stage)
        if row is None or (isinstance(row, nn.Sequential) and not any(isinstance(p, Sensor) for p in row.modules())):
            found.append(stage)
        else:
            found += unrolled(part for _, part in named(row))
    return found


def draws(stage: nn.Module) -> bool:
    """Whether anything in a stage draws."""
    return any(isinstance(part, RandomSensor) for part in stage.modules())


def policies_of(stage: nn.Module) -> set[GradPolicy]:
    """The policies of the random stages in it; those of what a sensor is made of are its own affair."""
    found: set[GradPolicy] = set()
    for _, part in in_order([("", stage)]):
        inner = branches_of(part)
        if inner:
            found = found.union(*(policies_of(sensor) for _, sensor in inner))
        elif isinstance(part, RandomSensor):
            found.add(part.grad)
    return found


def check_draws(stages: Iterable[nn.Module], where: str) -> None:
    """ShapeError for a stage with random sensors inside that does not say how it is drawn: it would hand on means."""
    for name, stage in in_order(numbered(stages)):
        if draws(stage) and not (isinstance(stage, Sensor) and callable(getattr(stage, "sample", None))):
            inside = sorted({type(part).__name__ for part in stage.modules() if isinstance(part, RandomSensor)})
            raise ArgumentError(
                f"{where}: expected sensors that can be drawn, got stage '{name}' ({type(stage).__name__}) with "
                f"{', '.join(inside)} inside and without expected(x) and sample(x, generator) of a RandomSensor. Give "
                "its parts as stages, or make it a RandomSensor."
            )


def ends_of(stages: Iterable[nn.Module]) -> tuple[tuple[Quantity, ...], Quantity | str | None]:
    """What a row takes and gives, as `Sensor.takes` and `Sensor.gives`."""
    takes: tuple[Quantity, ...] = ()
    gives: Quantity | str | None = "the same"
    for _, stage in in_order(numbered(stages)):
        if not isinstance(stage, Sensor):
            gives = None
            continue
        if gives == "the same" and not takes:
            takes = stage.takes
        if stage.gives != "the same":
            gives = stage.gives
    return takes, gives


# --------------------------------------------------------------------------------------- one stage, in four ways


def mean_of(stage: nn.Module, x: Tensor) -> Tensor:
    """The mean of one stage."""
    result: Tensor = stage.expected(x) if isinstance(stage, Sensor) else stage(x)
    return result


def draw_of(stage: nn.Module, x: Tensor, generator: torch.Generator | None) -> Tensor:
    """A draw of one stage whatever its policy; the mean of one that draws nothing."""
    if isinstance(stage, Sensor) and hasattr(stage, "sample"):
        result: Tensor = stage.sample(x, generator)  # type: ignore[operator]
        return result
    return mean_of(stage, x)


def normal_of(stage: nn.Module, x: Tensor, generator: torch.Generator | None) -> Tensor:
    """The normal surrogate of one stage; the mean of one that draws nothing."""
    if isinstance(stage, Sensor) and hasattr(stage, "gaussian"):
        result: Tensor = stage.gaussian(x, generator)  # type: ignore[operator]
        return result
    return mean_of(stage, x)


def measurement_of(stage: nn.Module, x: Tensor, generator: torch.Generator | None) -> Tensor:
    """What one stage gives under its own policy."""
    result: Tensor = stage(x, generator=generator) if isinstance(stage, Sensor) else stage(x)
    return result
