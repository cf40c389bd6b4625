"""Values above a bound: light, extinction, lengths, optical constants of metals."""

from __future__ import annotations

from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from torchtransient.checks import finite, shown
from torchtransient.checks import positive as greater_than_zero
from torchtransient.errors import UnitError
from torchtransient.floating import floating, holds, without_autocast
from torchtransient.parametrize.settings import Settings, choice_code, choice_of

PositiveFunction = Literal["softplus", "exp"]
_FUNCTIONS: tuple[str, ...] = get_args(PositiveFunction)


@without_autocast
def positive(x: Tensor, *, low: float = 0.0, scale: float = 1.0, function: PositiveFunction = "softplus") -> Tensor:
    """Map all real numbers above a bound: `low + scale * log(1 + exp(x))`, or with `function="exp"` `low + scale *
    exp(x)`.

    "softplus" is linear in `x` above `scale` and goes to `low` exponentially: steps of an optimiser are steps of the
    value. With "exp" steps are factors, for values whose order of magnitude is not known.

    Args:
        x: any shape.
        low: the bound, in the unit of the value.
        scale: typical size of the value, above zero.
        function: "softplus" or "exp".

    Returns:
        Values above `low`, or `low` itself where the precision of `x` has no number in between (float32: below -104
            with low=0, below -17 with low=1). With "exp" infinite where it ends (float32: above 88).

    Raises:
        UnitError, ShapeError: for other settings and tensors.
    """
    base, unit = _checked(low, scale, function, "positive")
    return _above(floating(x, "positive"), base, unit, function)


def _above(x: Tensor, base: float | Tensor, unit: float | Tensor, function: str) -> Tensor:
    return base + unit * (torch.exp(x) if function == "exp" else nn.functional.softplus(x))


@without_autocast
def positive_inverse(
    value: Tensor, *, low: float = 0.0, scale: float = 1.0, function: PositiveFunction = "softplus"
) -> Tensor:
    """Return the `x` of which `positive` makes `value`.

    Args:
        value: any shape, finite, above `low`.
        low, scale, function: as of `positive`.

    Raises:
        UnitError: for other values.
    """
    where = "positive_inverse"
    base, unit = _checked(low, scale, function, where)
    return _inverse(floating(value, where), base, unit, function, where)


def _inverse(value: Tensor, base: float | Tensor, unit: float | Tensor, function: str, where: str) -> Tensor:
    y = (value - base) / unit
    if not holds((y > 0) & torch.isfinite(y)):
        raise UnitError(
            f"{where}: expected finite values above {float(base):g}, got some from {value.min().item():g} to "
            f"{value.max().item():g}. Start from greater ones."
        )
    # log(exp(y) - 1), which neither overflows for large nor loses digits for small y.
    return torch.log(y) if function == "exp" else y + torch.log(-torch.expm1(-y))


class Positive(Settings):
    """`positive` as a parametrization: `forward` from all real numbers to above `low`, `right_inverse` back.

    All three settings are part of `state_dict`.

    Args:
        low, scale, function: as of `positive`.
    """

    low: Tensor
    scale: Tensor

    def __init__(self, low: float = 0.0, scale: float = 1.0, function: PositiveFunction = "softplus") -> None:
        super().__init__()
        base, unit = _checked(low, scale, function, "Positive")
        self._keep("low", base)
        self._keep("scale", unit)
        self.function: str = function

    @without_autocast
    def forward(self, x: Tensor) -> Tensor:
        return _above(floating(x, "Positive"), self.low.to(x), self.scale.to(x), self.function)

    @without_autocast
    def right_inverse(self, value: Tensor) -> Tensor:
        """Return `positive_inverse` of a value.

        Args:
            value: of any shape, positive.

        Raises:
            UnitError: for values out of range.
        """
        value = floating(value, "Positive")
        return _inverse(value, self.low.to(value), self.scale.to(value), self.function, "Positive")

    def get_extra_state(self) -> Tensor:
        return choice_code(_FUNCTIONS, self.function)

    def set_extra_state(self, state: Any) -> None:
        self.function = choice_of(_FUNCTIONS, state, "Positive")

    def extra_repr(self) -> str:
        return f"above {self.low.item():g}, scale={self.scale.item():g}, {self.function}"


def _checked(low: float, scale: float, function: str, where: str) -> tuple[float, float]:
    if function not in _FUNCTIONS:
        raise UnitError(f"{where}: expected function 'softplus' or 'exp', got {shown(function)}.")
    return finite(f"{where}: low", low), greater_than_zero(f"{where}: scale", scale)
