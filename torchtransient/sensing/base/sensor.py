"""The two bases of what happens after the light arrives: deterministic sensors and random ones."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable
from dataclasses import fields, is_dataclass
from typing import Any, Literal, Self

import torch
from torch import Tensor, nn

from torchtransient.axes import TimeAxis
from torchtransient.errors import GradientError, ShapeError, TorchTransientError, UnitError
from torchtransient.floating import in_single
from torchtransient.modules import ScalarState
from torchtransient.sensing.base.given import careful_init
from torchtransient.sensing.base.layout import TIME, check_generator
from torchtransient.sensing.base.policies import (
    GradPolicy,
    check_policy,
    gaussian_noise,
    record_score,
    straight_through,
)

Bins = tuple[float | None, int | None]  # width in seconds and number, None where any fits

# Two axes are the same when their bins agree to a millionth of a bin over the whole length.
SAME_BIN = 1e-6


class PhysicalModule(ScalarState):
    """A module whose own numbers are physical and stay in the precision they have when a model goes to half precision.

    In bfloat16 the logarithm of 60 ps is that of 62 ps, and 1e5 dark counts are infinite in float16. Devices, float32
    and float64 are followed; modules of another kind inside follow everything.

    Constructors of every subclass take arrays where they take tensors. An argument that requires a gradient is kept
    with it, or refused with GradientError: see `given`.
    """

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if "__init__" in cls.__dict__:
            cls.__init__ = careful_init(cls.__dict__["__init__"])  # type: ignore[method-assign]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        def careful(value: Tensor) -> Tensor:
            moved = fn(value)
            return value.to(moved.device) if moved.dtype in (torch.float16, torch.bfloat16) else moved

        if recurse:
            for child in self.children():
                child._apply(fn)  # type: ignore[no-untyped-call]
        super()._apply(careful, recurse=False)  # type: ignore[no-untyped-call]
        return self

    def extra_repr(self) -> str:
        """Arguments that the module was made with, by their names; tensors of many numbers by their size."""
        made = [cls.__init__ for cls in type(self).__mro__ if "__init__" in cls.__dict__ and issubclass(cls, nn.Module)]
        names = [name for init in made for name in inspect.signature(init).parameters]
        given = {name: _shown(self, name) for name in [*names, "bin_width_s", "num_bins"]}
        return ", ".join(f"{name}={text}" for name, text in given.items() if text)


_FEW = 8  # numbers of a list that a repr shows


def _shown(module: nn.Module, name: str) -> str:
    """An attribute as a repr shows it; nothing for one that is not there, or has learnt what it must not be."""
    try:
        return _text(getattr(module, name, None))
    except TorchTransientError:
        return ""


def _text(value: object) -> str:
    """A number, a choice or a record; nothing for None and for what torch shows itself."""
    if isinstance(value, Tensor):
        if value.ndim > 1 or value.numel() > _FEW or (value.is_meta and value.ndim):
            return f"(size {'x'.join(map(str, value.shape))})"
        if value.is_meta:
            return ""
        value = value.detach().tolist()
    if isinstance(value, (list, tuple)):
        items = [_text(item) for item in value]
        return f"({', '.join(items)})" if items and all(items) and len(items) <= _FEW else ""
    if isinstance(value, float):
        return f"{value:g}"
    if is_dataclass(value):
        held = {field.name: _text(getattr(value, field.name)) for field in fields(value)}
        return f"{type(value).__name__}({', '.join(f'{name}={text}' for name, text in held.items() if text)})"
    return repr(value) if isinstance(value, (bool, int, str)) else ""


# What stages hand on: W / (m^2 sr) per bin, detections per laser cycle and bin, the mean charge (or photons) of a whole
# exposure, or what a detector has drawn.
Quantity = Literal["radiance", "rate", "electrons", "counts"]

# Where light enters a sensor, and the place of the light among the arguments.
_ENTRANCES = {
    **dict.fromkeys(("expected", "forward", "sample", "variance", "gaussian", "probabilities"), 0),
    "log_prob": 1,
}


def _entrance(method: Callable[..., Any], place: int) -> Callable[..., Any]:
    """A method of a sensor that looks at the light before it takes it; see `Sensor`."""
    careful = in_single(method)
    names = list(inspect.signature(method).parameters)[1:]
    draws = names.index("generator") if "generator" in names else None

    @functools.wraps(method)
    def enter(self: Sensor, *args: Any, **keywords: Any) -> Any:
        if draws is not None:
            check_generator(args[draws] if len(args) > draws else keywords.get("generator"), type(self).__name__)
        self.check_bins(args[place] if len(args) > place else keywords.get("x"))
        return careful(self, *args, **keywords)

    return enter


class Sensor(PhysicalModule):
    """Maps a transient (..., C, T, H, W) to what is measured. Deterministic: `forward` is `expected`.

    `forward` takes `generator` in every sensor, so that chains need not know which of their links are random.

    `num_bins`: T of the axis that the sensor was made with, None for one that takes any. Light of another number of
    bins is refused with ShapeError. Half precision is taken and measured in float32, the least in which counts are
    counts. Both hold for the methods of every subclass that light enters by: `expected`, `forward`, `sample`,
    `variance`, `gaussian`, `probabilities` and `log_prob`.
    """

    num_bins: int | None = None
    # What chains compare: what the sensor takes (anything, if it does not say) and gives (None: nobody knows), and
    # whether it takes its bins for one whole laser period.
    takes: tuple[Quantity, ...] = ()
    gives: Quantity | Literal["the same"] | None = None
    window_is_period: bool = False

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        for name, place in _ENTRANCES.items():
            if name in cls.__dict__:
                setattr(cls, name, _entrance(cls.__dict__[name], place))

    def check_bins(self, x: object) -> None:
        """ShapeError for a tensor whose T is not that of the axis that the sensor was made with."""
        if self.num_bins is None or not isinstance(x, Tensor) or x.ndim < 4 or x.shape[TIME] == self.num_bins:
            return
        raise ShapeError(
            f"{type(self).__name__}: expected T = {self.num_bins} bins as in the axis (or period) it was made with, "
            f"got {x.shape[TIME]} of {tuple(x.shape)}. Make it with the axis of the light; bin_width_s= takes any T."
        )

    def expected(self, x: Tensor) -> Tensor:
        """The mean of the measurement, differentiable in `x` and in the parameters."""
        raise NotImplementedError(f"{type(self).__name__} has to define expected(x).")

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """`expected(x)`. `generator` is taken and not needed: nothing here is random."""
        return self.expected(x)


class RandomSensor(Sensor):
    """A sensor that draws. `grad` says what `forward` returns and how gradients pass (see `policies`).

    A subclass defines `expected`, `sample`, and as far as it supports the policy: `variance` (or `gaussian`) for
    "gaussian", `log_prob` for "score". GradientError when the policy is not supported.
    """

    def __init__(self, grad: GradPolicy = "expected") -> None:
        super().__init__()
        self.grad: GradPolicy = check_policy(grad, type(self).__name__)

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """One draw, without gradient, in the shape and dtype of `expected(x)`."""
        raise NotImplementedError(f"{type(self).__name__} has to define sample(x, generator).")

    def variance(self, x: Tensor) -> Tensor:
        """Variance of every entry of the measurement, in the shape of `expected(x)`."""
        raise GradientError(f"{type(self).__name__}: grad='gaussian' is not supported; choose another policy.")

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """A differentiable normal surrogate of `sample`. Independent entries unless a subclass knows better."""
        return self.expected(x) + gaussian_noise(self.variance(x), generator)

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        """Log-probability of a measurement, time summed: (..., C, H, W), differentiable in `x`."""
        raise GradientError(f"{type(self).__name__}: grad='score' is not supported; choose another policy.")

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The measurement under the policy `grad`; equal generators in equal states give equal measurements."""
        if self.grad == "expected":
            return self.expected(x)
        check_generator(generator, type(self).__name__)
        if self.grad == "gaussian":
            return self.gaussian(x, generator)
        with torch.no_grad():
            measurement = self.sample(x, generator)
        if self.grad == "straight_through":
            return straight_through(measurement, self.expected(x)) if torch.is_grad_enabled() else measurement
        record_score(lambda: self.log_prob(measurement, x), type(self).__name__)
        return measurement


def bins_of(sensor: Sensor) -> Bins:
    """Return the bins that a sensor, or the first stage of a chain with bins, was made for."""
    for part in sensor.modules():
        if not isinstance(part, Sensor):
            continue
        axis, width = getattr(part, "axis", None), getattr(part, "bin_width_s", None)
        if isinstance(axis, TimeAxis):
            return axis.bin_width_s, axis.num_bins
        if isinstance(width, float) or part.num_bins is not None:
            return (width if isinstance(width, float) else None), part.num_bins
    return None, None


def common_bins(sensors: Iterable[Sensor], where: str, own: Bins = (None, None)) -> Bins:
    """Return the bins of all sensors and of ``own``. Raises UnitError for sensors made for different ones."""
    width, number = own
    owner = where
    for sensor in sensors:
        name, (its_width, its_number) = type(sensor).__name__, bins_of(sensor)
        most = max(number or 1, its_number or 1)
        other_width = width and its_width and abs(width - its_width) * most > SAME_BIN * width
        if other_width or (number and its_number and number != its_number):
            raise UnitError(
                f"{where}: expected one time axis for all parts, got {_bins_text(width, number)} in {owner} and "
                f"{_bins_text(its_width, its_number)} in {name}. Make them with the axis of the light."
            )
        if (width is None and its_width) or (number is None and its_number):
            owner = name
        width, number = width or its_width, number or its_number
    return width, number


def _bins_text(width: float | None, number: int | None) -> str:
    many = "bins" if number is None else f"{number} bins"
    return many if width is None else f"{many} of {width:g} s"
