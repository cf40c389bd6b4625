"""Values above a bound: light, extinction, lengths, optical constants of metals."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor, nn

from torchtransient.errors import UnitError
from torchtransient.parametrize.bounded import floating
from torchtransient.quantities import finite, shown
from torchtransient.quantities import positive as greater_than_zero

Shape = Literal["softplus", "exp"]


def positive(x: Tensor, low: float = 0.0, scale: float = 1.0, function: Shape = "softplus") -> Tensor:
    """`low + scale * log(1 + exp(x))`, or of `function="exp"` `low + scale * exp(x)`: above `low` for any real `x`.

    "softplus" is linear in `x` above `scale` and goes to `low` exponentially: steps of an optimiser are steps of the
    value. With "exp" steps are factors, for values whose order of magnitude is not known. `scale` > 0, in the unit of
    the value: what is typical of it. Raises UnitError, ShapeError.
    """
    base, unit = _settings(low, scale, function, "positive")
    x = floating(x, "positive")
    return base + unit * (torch.exp(x) if function == "exp" else nn.functional.softplus(x))


def positive_inverse(value: Tensor, low: float = 0.0, scale: float = 1.0, function: Shape = "softplus") -> Tensor:
    """The `x` of which `positive` makes `value`. Raises UnitError for values that are not finite and above `low`."""
    return _inverse(value, low, scale, function, "positive_inverse")


def _inverse(value: Tensor, low: float, scale: float, function: Shape, where: str) -> Tensor:
    base, unit = _settings(low, scale, function, where)
    y = (floating(value, where) - base) / unit
    if not bool(((y > 0) & torch.isfinite(y)).all()):
        raise UnitError(
            f"{where}: expected finite values above {base:g}, got some from {value.min().item():g} to "
            f"{value.max().item():g}. Start from greater ones."
        )
    # log(exp(y) - 1), which neither overflows for large nor loses digits for small y.
    return torch.log(y) if function == "exp" else y + torch.log(-torch.expm1(-y))


class Positive(nn.Module):
    """`positive` as a parametrization: `forward` from all real numbers to above `low`, `right_inverse` back."""

    def __init__(self, low: float = 0.0, scale: float = 1.0, function: Shape = "softplus") -> None:
        super().__init__()
        self.low, self.scale = _settings(low, scale, function, "Positive")
        self.function: Shape = function

    def forward(self, x: Tensor) -> Tensor:
        return positive(x, self.low, self.scale, self.function)

    def right_inverse(self, value: Tensor) -> Tensor:
        """Raises UnitError as `positive_inverse`."""
        return _inverse(value, self.low, self.scale, self.function, "Positive")

    def extra_repr(self) -> str:
        return f"above {self.low:g}, scale={self.scale:g}, {self.function}"


def _settings(low: float, scale: float, function: str, where: str) -> tuple[float, float]:
    if function not in get_args(Shape):
        raise UnitError(f"{where}: expected function 'softplus' or 'exp', got {shown(function)}.")
    return finite(f"{where}: low", low), greater_than_zero(f"{where}: scale", scale)
