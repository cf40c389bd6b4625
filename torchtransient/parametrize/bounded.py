"""Values between two bounds, by the logistic function: albedo, roughness, index of refraction; and values above a
bound: light, extinction, lengths, optical constants of metals.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from torchtransient.checks import as_number, finite, shown
from torchtransient.checks import positive as greater_than_zero
from torchtransient.errors import UnitError
from torchtransient.floating import floating, holds, number_tensor, without_autocast
from torchtransient.parametrize.settings import Settings, choice_code, choice_of

Bound = float | Tensor
PositiveFunction = Literal["softplus", "exp"]
_FUNCTIONS: tuple[str, ...] = get_args(PositiveFunction)
# What single precision makes of the ends of a range, as a share of it.
_SLACK = 1e-5
# Mitsuba renders the square of a principled roughness, no smaller than 0.001.
LEAST_PRINCIPLED = 0.0317


@without_autocast
def bounded(x: Tensor, low: Bound = 0.0, high: Bound = 1.0) -> Tensor:
    """Map all real numbers between two bounds: `low + (high - low) / (1 + exp(-x))`.

    Never beyond the bounds, and on them only where the precision of `x` has nothing in between. Values of bounds are
    not looked at inside of `torch.func.vmap` and `torch.compile`.

    Args:
        x: tensor of any shape.
        low, high: bounds, finite numbers or tensors that broadcast to `x`, low < high.

    Raises:
        UnitError, ShapeError: for other bounds and tensors.
    """
    where = "bounded"
    x = floating(x, where)
    _check_given(low, high, where)
    return _between(x, low, high)


def _between(x: Tensor, low: Bound, high: Bound) -> Tensor:
    below, above = _ends(x, low, high)
    width = above - below
    # From the nearer end: full precision at both, and no rounding past the upper one.
    return torch.where(x < 0, below + width * torch.sigmoid(x), above - width * torch.sigmoid(-x))


@without_autocast
def bounded_inverse(value: Tensor, low: Bound = 0.0, high: Bound = 1.0, *, margin: float | None = None) -> Tensor:
    """Return the `x` that `bounded` maps to `value`.

    Args:
        value: tensor of any shape, between the bounds.
        low, high: bounds, numbers or tensors that broadcast to `value`, see `bounded`.
        margin: least distance from the bounds, as a share of the range between 0 and 0.5; nearer values are moved
            there, and no nearer than the precision of `value` tells from the bound. None refuses the bounds themselves,
            which have no `x`.

    Raises:
        UnitError: for values at the bounds without a margin, beyond them by more than rounding, or not finite, and for
            bounds between which the precision has no number.
    """
    where = "bounded_inverse"
    _check_given(low, high, where)
    return _inverse(value, low, high, checked_margin(margin, where), where)


def _inverse(value: Tensor, low: Bound, high: Bound, margin: float | None, where: str) -> Tensor:
    value = floating(value, where)
    below, above = _ends(value, low, high)
    width = above - below
    if not holds(torch.isfinite(width)):
        raise UnitError(f"{where}: {value.dtype} has not the range from {_said(low)} to {_said(high)}.")
    share = (value - below) / width
    if not holds((share >= -_SLACK) & (share <= 1 + _SLACK)):
        raise UnitError(f"{where}: expected values between {_said(low)} and {_said(high)}, got {_span(value)}.")
    if margin is not None:
        least, most = (torch.maximum(margin * width, _step(end)) for end in (below, above))
        value = torch.minimum(torch.maximum(value, below + least), above - most)
    if not holds((value > below) & (value < above)):
        ends = f"{_said(low)} and {_said(high)}"
        raise UnitError(
            f"{where}: no finite number stands for the bounds {ends} themselves, got {_span(value)}. Start from values "
            f"inside, or give margin=1e-3 to move them inside by that share, as far as {value.dtype} has numbers there."
        )
    return torch.log((value - below) / (above - value))


def _step(end: Tensor) -> Tensor:
    """At least the distance to the next number."""
    kind = torch.finfo(end.dtype)
    return (kind.eps * end.abs()).clamp_min(kind.tiny)


class Bounded(Settings):
    """`bounded` as a parametrization: `forward` from all real numbers into (low, high), `right_inverse` back.

    The slope is (value - low) (high - value) / (high - low): steps of an optimiser get smaller near the bounds. The
    bounds are part of `state_dict`: a state that is loaded brings its own, of the same shapes. They stay float64 when
    the module is made half.

    Args:
        low, high: bounds, numbers or tensors that broadcast to the parameter.
        margin: least distance from the bounds, as a share of the range between 0 and 0.5, or None, see
            `bounded_inverse`.

    Raises:
        UnitError: for bounds in another order.
    """

    low: Tensor
    high: Tensor

    def __init__(self, low: Any = 0.0, high: Any = 1.0, margin: float | None = None) -> None:
        super().__init__()
        name = type(self).__name__
        self.margin = checked_margin(margin, name)
        ends = [_bound(given, name) for given in (low, high)]
        _check_order(ends[0], ends[1], name)
        self._keep("low", ends[0])
        self._keep("high", ends[1])

    @without_autocast
    def forward(self, x: Tensor) -> Tensor:
        """Return `bounded` of a tensor.

        Args:
            x: tensor of any shape to which the bounds broadcast.
        """
        # The bounds were looked at when they were given: looking at them again would wait for a GPU.
        return _between(floating(x, type(self).__name__), self.low, self.high)

    @without_autocast
    def right_inverse(self, value: Tensor) -> Tensor:
        """Return `bounded_inverse` of a value.

        Args:
            value: tensor of any shape, inside the range.

        Raises:
            UnitError: for values outside of it.
        """
        return _inverse(value, self.low, self.high, self.margin, type(self).__name__)

    def extra_repr(self) -> str:
        return f"{_said(self.low)} to {_said(self.high)}"


class Albedo(Bounded):
    """Shares of the light, 0 to 1: reflectances, transmittances, albedos of media, opacities, weights of lobes.

    Args:
        low, high: ends of the range.
        margin: least distance from the ends, as a share of the range between 0 and 0.5, or None, see `Bounded`.
    """


class Roughness(Bounded):
    """`alpha` of microfacets, 0.001 to 1. Not for `principled`: `PrincipledRoughness`.

    `diff_rough_dielectric` and others render smaller ones as 0.001, the rest as 0.0001 (`low=1e-4`), where the slope is
    zero.

    Args:
        low, high: ends of the range.
        margin: least distance from the ends, as a share of the range between 0 and 0.5, or None, see `Bounded`.
    """

    def __init__(self, low: Any = 1e-3, high: Any = 1.0, margin: float | None = None) -> None:
        super().__init__(low, high, margin)


class PrincipledRoughness(Bounded):
    """`roughness` of `principled` and `principledthin`, 0.0317 to 1.

    Mitsuba renders with its square, and squares below 0.001 as 0.001, where the slope is zero. With `anisotropic` of
    `a`, one of the two axes gets there at the fourth root of 1e-6 / (1 - 0.9 a), 0.0563 at most: give that as `low`.

    Args:
        low, high: ends of the range.
        margin: least distance from the ends, as a share of the range between 0 and 0.5, or None, see `Bounded`.
    """

    def __init__(self, low: Any = LEAST_PRINCIPLED, high: Any = 1.0, margin: float | None = None) -> None:
        super().__init__(low, high, margin)


class IndexOfRefraction(Bounded):
    """`eta` of dielectrics, inside over outside, 1 to 4: gases to germanium.

    Below 1 the inside is the thinner one: give another `low`, greater than 0. Not for metals, whose `eta` and `k` are
    `Positive`.

    Args:
        low, high: ends of the range.
        margin: least distance from the ends, as a share of the range between 0 and 0.5, or None, see `Bounded`.
    """

    def __init__(self, low: Any = 1.0, high: Any = 4.0, margin: float | None = None) -> None:
        super().__init__(low, high, margin)


class Anisotropy(Bounded):
    """`g` of the phase functions `hg`, the mean cosine of scattering, -0.99 to 0.99: Mitsuba takes -1 to 1 without the
    ends.

    Args:
        low, high: ends of the range.
        margin: least distance from the ends, as a share of the range between 0 and 0.5, or None, see `Bounded`.
    """

    def __init__(self, low: Any = -0.99, high: Any = 0.99, margin: float | None = None) -> None:
        super().__init__(low, high, margin)


@without_autocast
def positive(x: Tensor, *, low: float = 0.0, scale: float = 1.0, function: PositiveFunction = "softplus") -> Tensor:
    """Map all real numbers above a bound: `low + scale * log(1 + exp(x))`, or with `function="exp"` `low + scale *
    exp(x)`.

    "softplus" is linear in `x` above `scale` and goes to `low` exponentially: steps of an optimiser are steps of the
    value. With "exp" steps are factors, for values whose order of magnitude is not known.

    Args:
        x: tensor of any shape.
        low: the bound, in the unit of the value.
        scale: typical size of the value, above zero.
        function: "softplus" or "exp".

    Returns:
        Values above `low`, or `low` itself where the precision of `x` has no number in between (float32: below -104
            with low=0, below -17 with low=1). With "exp" infinite where it ends (float32: above 88).

    Raises:
        UnitError, ShapeError: for other settings and tensors.
    """
    base, unit = _checked_positive(low, scale, function, "positive")
    return _above(floating(x, "positive"), base, unit, function)


def _above(x: Tensor, base: float | Tensor, unit: float | Tensor, function: str) -> Tensor:
    return base + unit * (torch.exp(x) if function == "exp" else nn.functional.softplus(x))


@without_autocast
def positive_inverse(
    value: Tensor, *, low: float = 0.0, scale: float = 1.0, function: PositiveFunction = "softplus"
) -> Tensor:
    """Return the `x` that `positive` maps to `value`.

    Args:
        value: tensor of any shape, finite, above `low`.
        low: the bound, in the unit of the value.
        scale: typical size of the value, above zero, see `positive`.
        function: "softplus" or "exp".

    Raises:
        UnitError: for other values.
    """
    where = "positive_inverse"
    base, unit = _checked_positive(low, scale, function, where)
    return _above_inverse(floating(value, where), base, unit, function, where)


def _above_inverse(value: Tensor, base: float | Tensor, unit: float | Tensor, function: str, where: str) -> Tensor:
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
        low: the bound, in the unit of the value.
        scale: typical size of the value, above zero, see `positive`.
        function: "softplus" or "exp".
    """

    low: Tensor
    scale: Tensor

    def __init__(self, low: float = 0.0, scale: float = 1.0, function: PositiveFunction = "softplus") -> None:
        super().__init__()
        base, unit = _checked_positive(low, scale, function, "Positive")
        self._keep("low", base)
        self._keep("scale", unit)
        self.function: str = function

    @without_autocast
    def forward(self, x: Tensor) -> Tensor:
        """Return `positive` of a tensor.

        Args:
            x: tensor of any shape.
        """
        return _above(floating(x, "Positive"), self.low.to(x), self.scale.to(x), self.function)

    @without_autocast
    def right_inverse(self, value: Tensor) -> Tensor:
        """Return `positive_inverse` of a value.

        Args:
            value: tensor of any shape, above `low`.

        Raises:
            UnitError: for values out of range.
        """
        value = floating(value, "Positive")
        return _above_inverse(value, self.low.to(value), self.scale.to(value), self.function, "Positive")

    def get_extra_state(self) -> Tensor:
        return choice_code(_FUNCTIONS, self.function)

    def set_extra_state(self, state: Any) -> None:
        self.function = choice_of(_FUNCTIONS, state, "Positive")

    def extra_repr(self) -> str:
        return f"above {self.low.item():g}, scale={self.scale.item():g}, {self.function}"


def _checked_positive(low: float, scale: float, function: str, where: str) -> tuple[float, float]:
    if function not in _FUNCTIONS:
        raise UnitError(f"{where}: expected function 'softplus' or 'exp', got {shown(function)}.")
    return finite(f"{where}: low", low), greater_than_zero(f"{where}: scale", scale)


# ------------------------------------------------------------------------------------------------------------- checks


def _check_given(low: Bound, high: Bound, where: str) -> None:
    # Numbers of bounds would break the graph of a compiler in two.
    if not torch.compiler.is_compiling():
        _check_order(_bound(low, where), _bound(high, where), where)


def _bound(given: Any, where: str) -> Tensor:
    return number_tensor(given, f"{where}: expected bounds as numbers or tensors of numbers", UnitError).detach()


def _check_order(low: Tensor, high: Tensor, where: str) -> None:
    if not holds(torch.isfinite(low) & torch.isfinite(high) & (low < high)):
        raise UnitError(
            f"{where}: expected finite bounds, low < high, got {_said(low)} and {_said(high)}. Use Positive for values "
            "that have a lower bound alone."
        )


def _ends(like: Tensor, low: Bound, high: Bound) -> tuple[Tensor, Tensor]:
    """Return both in the value's shape. Raises torch's RuntimeError for bounds that do not broadcast to it."""
    below, above = (torch.as_tensor(end, dtype=like.dtype, device=like.device) for end in (low, high))
    return below.expand(like.shape), above.expand(like.shape)


def checked_margin(margin: Any, where: str) -> float | None:
    """Return a margin.

    Args:
        margin: share between 0 and 0.5, or None.
        where: begins the message.

    Raises:
        UnitError: for other values.
    """
    if margin is None:
        return None
    number = as_number(margin)
    if number is None or not 0 < number < 0.5:
        raise UnitError(f"{where}: expected margin as a share of the range between 0 and 0.5, got {shown(margin)}.")
    return number


def _said(bound: Bound) -> str:
    if isinstance(bound, Tensor):
        if bound.numel() < 2:
            return f"{bound.item():g}" if bound.numel() else "[]"
        return f"[{bound.min():g} ... {bound.max():g}]"
    return shown(bound)


def _span(value: Tensor) -> str:
    least, most = value.min().item(), value.max().item()
    return f"{least:.8g}" if least == most else f"values from {least:.8g} to {most:.8g}"
