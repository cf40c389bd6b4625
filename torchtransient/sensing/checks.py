"""Checks of arguments: layout (..., C, T, H, W), units, time axes, and gradients that would be cut off."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

from torchtransient.axes import WIDEST_BIN_S, TimeAxis
from torchtransient.checks import MOST, as_number, as_whole, is_one_of, shown, unit_of
from torchtransient.errors import ArgumentError, GradientError, ShapeError, UnitError


def tensor_of(array: np.ndarray[Any, Any]) -> Tensor:
    """Make a tensor of an array of numbers, on its memory where that can be written to.

    Args:
        array: numbers of any byte order, read-only arrays too.
    """
    native = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("="))
    return torch.from_numpy(native if native.flags.writeable else native.copy())


def no_arrays(value: Any) -> Any:
    """Return a value, or a tensor of an array with dimensions.

    Args:
        value: any object.
    """
    return tensor_of(value) if isinstance(value, np.ndarray) and value.ndim else value


def numbers_of(value: Any, name: str, where: str) -> Any:
    """Return the list of numbers of a tensor of one dimension, and anything else as it is.

    Args:
        value: number, sequence or tensor.
        name: name of the argument.
        where: name of the caller, for errors.

    Raises:
        GradientError: for a tensor that requires a gradient.
    """
    refuse_cut_off(value, name, where)
    return value.tolist() if isinstance(value, Tensor) and value.ndim == 1 else value


def refuse_cut_off(value: object, name: str, where: str) -> None:
    """Refuse a tensor that requires a gradient where its value alone is used.

    Args:
        value: any object.
        name: name of the argument.
        where: name of the caller, for errors.

    Raises:
        GradientError: for a tensor with a gradient or a forward-mode tangent.
    """
    if isinstance(value, Tensor) and (is_dual(value) or (value.requires_grad and torch.is_grad_enabled())):
        raise GradientError(_cut_off_message(name, where))


def is_dual(value: Tensor) -> bool:
    """Return True for a tensor with a tangent of forward-mode differentiation.

    Args:
        value: tensor.
    """
    if torch.compiler.is_compiling():
        return False
    return forward_ad.unpack_dual(value).tangent is not None  # type: ignore[no-untyped-call]


def _cut_off_message(name: str, where: str) -> str:
    return (
        f"{where}: expected {name} without a gradient, which would be cut off in silence; got a tensor that requires "
        f"one. Give {name}.detach(); learn it by learnable=True or an nn.Parameter where {where} takes them, or as a "
        "buffer by torch.func.functional_call."
    )


# ------------------------------------------------------------------------------------------------- of constructors


def careful_init(init: Callable[..., None]) -> Callable[..., None]:
    """Wrap an ``__init__`` to take arrays, and to refuse tensors whose gradient the module has not kept.

    Args:
        init: the ``__init__`` of a class.

    Returns:
        The wrapped method.
    """

    @functools.wraps(init)
    def run(self: nn.Module, *args: Any, **keywords: Any) -> None:
        where = type(self).__name__
        given = [no_arrays(value) for value in args]
        named = {name: no_arrays(value) for name, value in keywords.items()}
        init(self, *given, **named)
        # once, when the whole object is there; private parts are looked at with what they are part of
        if getattr(type(self).__init__, "__wrapped__", None) is init and not where.startswith("_"):
            names = init.__code__.co_varnames[1 : init.__code__.co_argcount]
            places = {names[i] if i < len(names) else f"argument {i}": value for i, value in enumerate(given)}
            check_kept(self, {**places, **named}, where)

    return run


def check_kept(module: nn.Module, given: Mapping[str, Any], where: str) -> None:
    """Check that a module holds every argument that requires a gradient, or a result of it.

    Args:
        module: the module that was made.
        given: arguments of the class by their names.
        where: name of the class, for errors.

    Raises:
        GradientError: for an argument that was lost.
    """
    wanted = [(name, t) for name, value in given.items() for t in _tensors(value) if t.requires_grad or is_dual(t)]
    if not wanted:
        return
    held = list(_held(module))
    same = {id(t) for t in held}
    lost = [(name, t) for name, t in wanted if id(t) not in same]
    reached = _reached(held) if lost else set()
    for name, tensor in lost:
        if is_dual(tensor) and any(is_dual(t) for t in held):
            continue  # tangents have no graph to follow
        if id(tensor) not in reached and (tensor.grad_fn is None or id(tensor.grad_fn) not in reached):
            raise GradientError(_cut_off_message(name, where))


def _tensors(value: Any) -> Iterator[Tensor]:
    """The tensors of an argument and of the containers in it; modules keep their own."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, Mapping):
        for part in value.values():
            yield from _tensors(part)
    elif isinstance(value, (list, tuple)):
        for part in value:
            yield from _tensors(part)
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from _tensors(getattr(value, field.name))


def _held(module: nn.Module) -> Iterator[Tensor]:
    for part in module.modules():
        # no attribute of any other kind: nothing that is merely kept, and not used as a tensor, counts
        yield from part.parameters(recurse=False)
        yield from part.buffers(recurse=False)
        yield from (v for v in part.__dict__.values() if isinstance(v, Tensor))


def _reached(held: Iterable[Tensor]) -> set[int]:
    """Identities of the tensors, and of the steps, that the held tensors were computed from."""
    nodes: list[Any] = [t.grad_fn for t in held if t.grad_fn is not None]
    found: set[int] = set()
    while nodes:
        node = nodes.pop()
        if id(node) in found:
            continue
        found.add(id(node))
        variable = getattr(node, "variable", None)
        if variable is not None:
            found.add(id(variable))
        nodes += [nxt for nxt, _ in node.next_functions if nxt is not None]
    return found


# -------------------------------------------------------------------------------------------------- layout, units, axes


TIME = -3  # the time dimension of (..., C, T, H, W)
_OTHER_FILMS = (
    "Render with time_axis=...; phasors (out.phasor) go to ItofCorrelation, as the first stage of Compose([...]), "
    "spectra of beats (out.beats) to Speckle and BeatNoise, the sum of light by rates (out.rates.sum(-4)) is a "
    "transient, and gated images (out.gated) are no bins: only what follows a gate may take them."
)


def check_tensor(x: object, where: str) -> Tensor:
    """Return `x` if it is a tensor.

    Args:
        x: any object; a renderer's output is answered with what to do.
        where: name of the caller, for errors.

    Raises:
        ShapeError: for anything else.
    """
    if not isinstance(x, Tensor):
        raise ShapeError(f"{where}: expected a tensor (..., C, T, H, W), got {not_a_transient(x)}")
    return x


def check_tensors(where: str, **given: object) -> None:
    """Check that arguments are tensors.

    Args:
        where: name of the caller, for errors.
        given: arguments by their names.

    Raises:
        ShapeError: names the first that is not.
    """
    for name, value in given.items():
        if not isinstance(value, Tensor):
            raise ShapeError(f"{where}: expected {name} as a tensor, got {shown(value)}. torch.as_tensor makes one.")


def reals(where: str, whole: torch.dtype | None = None, **given: object) -> tuple[Tensor, ...]:
    """Return arguments as floating tensors of real numbers.

    Args:
        where: name of the caller, for errors.
        whole: dtype of whole numbers and truth values; None takes the default dtype.
        given: tensors by their names.

    Returns:
        The tensors in their order; floating ones as they are.

    Raises:
        ShapeError: for anything that is no tensor.
        UnitError: for complex numbers.
    """
    check_tensors(where, **given)
    found = []
    for name, value in given.items():
        assert isinstance(value, Tensor)  # as was checked
        if value.is_complex():
            raise UnitError(f"{where}: expected {name} as real numbers, got {value.dtype}.")
        found.append(value if value.is_floating_point() else value.to(whole or torch.get_default_dtype()))
    return tuple(found)


def check_broadcast(where: str, **given: Tensor) -> None:
    """Check that tensors broadcast to one shape.

    Args:
        where: name of the caller, for errors.
        given: tensors by their names.

    Raises:
        ShapeError: if they do not.
    """
    try:
        torch.broadcast_shapes(*(x.shape for x in given.values()))  # type: ignore[no-untyped-call]
    except RuntimeError as error:
        raise ShapeError(f"{where}: expected {' and '.join(given)} of shapes that broadcast, got: {error}") from None


def check_transient(x: Tensor, where: str) -> Tensor:
    """Return `x` if it is a floating tensor (..., C, T, H, W).

    Args:
        x: any object.
        where: name of the caller, for errors.

    Raises:
        ShapeError: for fewer than four dimensions.
        UnitError: for complex or whole numbers.
    """
    if check_tensor(x, where).ndim < 4:
        raise ShapeError(
            f"{where}: expected a tensor (..., C, T, H, W), got {tuple(x.shape)}. Add the missing dimensions."
        )
    if x.is_complex():
        raise UnitError(
            f"{where}: expected a transient, got complex numbers ({x.dtype}): a phasor image? Render with "
            "time_axis=...; of the sensors ItofCorrelation alone takes phasors."
        )
    if not x.is_floating_point():
        raise UnitError(f"{where}: expected a floating dtype, got {x.dtype}. Convert with .float().")
    return x


def check_bins(x: Tensor, where: str) -> Tensor:
    """Return `x` if it is a floating tensor (..., C, T, H, W) of one bin or more.

    Args:
        x: any object.
        where: name of the caller, for errors.

    Raises:
        ShapeError: without bins, and errors of `check_transient`.
    """
    if not check_transient(x, where).shape[TIME]:
        raise ShapeError(f"{where}: expected one bin or more along time, got {tuple(x.shape)}.")
    return x


def not_a_transient(x: object) -> str:
    """Describe an object given in place of a transient, and the remedy: the end of a message.

    Args:
        x: the object.
    """
    if getattr(x, "transient", None) is not None:
        return f"{type(x).__name__}. Give its tensor, out.transient, or put the sensor into Compose([...])."
    if x is not None and not hasattr(x, "transient"):
        return f"{type(x).__name__}."
    there = [name for name in ("phasor", "gated", "rates", "beats", "steady") if getattr(x, name, None) is not None]
    return f"{type(x).__name__}, which holds {', '.join([*there, 'no transient'])}. {_OTHER_FILMS}"


def check_number(
    value: float, name: str, where: str, *, low: float = 0.0, high: float = math.inf, open_low: bool = False
) -> float:
    """Return a finite number as a float.

    Args:
        value: number, or a tensor of one without gradient.
        name: name of the argument, which ends in its unit.
        where: name of the caller, for errors.
        low: least value.
        high: largest value.
        open_low: exclude `low` itself.

    Raises:
        UnitError: outside of the range, for NaN, infinity and anything that is no number.
        GradientError: for a tensor that requires a gradient, which a float cannot carry.
    """
    refuse_cut_off(value, name, where)
    number = as_number(value)
    if number is None:
        raise UnitError(f"{where}: expected {name} to be one number, got {shown(value)}.")
    below = number <= low if open_low else number < low
    if not math.isfinite(number) or below or number > high:
        left = "(" if open_low else "["
        raise UnitError(f"{where}: expected {name} in {left}{low:g}, {high:g}]{unit_of(name)}, got {number!r}.")
    return number


def one_number(value: Any, name: str, where: str) -> Any:
    """Return one real number as a float, or a tensor of one element with its gradient.

    Args:
        value: number, or tensor of one element.
        name: name of the argument.
        where: name of the caller, for errors.

    Raises:
        UnitError: for anything else.
    """
    if isinstance(value, Tensor) and value.numel() == 1 and not value.is_complex():
        return value
    number = None if isinstance(value, Tensor) else as_number(value)
    if number is None:
        raise UnitError(f"{where}: expected {name} to be one number, got {shown(value)}.")
    return number


def check_count(value: float, name: str, where: str, *, low: int = 1, most: int = MOST) -> int:
    """Return a whole number as an int, with all its digits.

    Args:
        value: number.
        name: name of the argument.
        where: name of the caller, for errors.
        low: least value.
        most: largest value.

    Raises:
        UnitError: for fractions, and outside of the range.
    """
    number, exact = check_number(value, name, where, low=low), as_whole(value)
    whole = int(number) if exact is None else exact
    if (exact is None and whole != number) or whole > most:
        raise UnitError(f"{where}: expected {name} to be a whole number, at most {most}, got {shown(value)}.")
    return whole


def check_choice(value: str, choices: object, name: str, where: str) -> None:
    """Check that a value is one of the strings of a Literal type.

    Args:
        value: any object.
        choices: the Literal type.
        name: name of the argument.
        where: name of the caller, for errors.

    Raises:
        ArgumentError: for anything else.
    """
    allowed = get_args(choices)
    if not is_one_of(value, allowed):
        raise ArgumentError(f"{where}: expected {name} to be one of {', '.join(allowed)}, got {shown(value)}.")


def check_one_of(where: str, given: Mapping[str, Any]) -> None:
    """Check that exactly one of several arguments is given.

    Args:
        where: name of the caller, for errors.
        given: arguments by their names, None for those left out.

    Raises:
        ArgumentError: for none or more than one.
    """
    there = [name for name, value in given.items() if value is not None]
    if len(there) != 1:
        got = " and ".join(there) if there else "none of them"
        do = "leave one of them out" if there else "give one of them"
        raise ArgumentError(f"{where}: expected either {' or '.join(given)}, got {got}; {do}.")


def bin_width_of(axis: TimeAxis | None, bin_width_s: float | None, where: str) -> float:
    """Return a bin width in seconds from an axis or a number.

    Args:
        axis: time axis, in seconds or metres, or None.
        bin_width_s: width in seconds, or None. A microsecond or more is most likely given in nanoseconds, picoseconds
            or bins.
        where: name of the caller, for errors.

    Raises:
        ArgumentError: unless exactly one is given.
        UnitError: for widths out of range.
    """
    check_one_of(where, {"axis= (the TimeAxis of the light)": axis, "bin_width_s=": bin_width_s})
    if axis is not None:
        return check_time_axis(axis, where).bin_width_s
    width = bin_width_s if bin_width_s is not None else 0.0
    return check_seconds(width, "bin_width_s", where, open_low=True, high=WIDEST_BIN_S)


def bins_from(axis: TimeAxis | None, bin_width_s: float | None, where: str) -> tuple[float, int | None]:
    """Return width in seconds and number of the bins of a sensor, from an axis or a width.

    Args:
        axis: time axis, or None.
        bin_width_s: width in seconds, which goes with any number of bins, or None.
        where: name of the caller, for errors.

    Raises:
        ArgumentError: unless exactly one is given.
        UnitError: for widths out of range.
    """
    return bin_width_of(axis, bin_width_s, where), None if axis is None else axis.num_bins


def check_time_axis(axis: object, where: str) -> TimeAxis:
    """Return `axis` if it is a TimeAxis.

    Args:
        axis: any object.
        where: name of the caller, for errors.

    Raises:
        ArgumentError: for anything else.
    """
    if not isinstance(axis, TimeAxis):
        raise ArgumentError(
            f"{where}: expected axis to be a TimeAxis, got {type(axis).__name__}. Take the renderer's, or "
            "TimeAxis.from_seconds(start, bin width, bins)."
        )
    return axis


def check_seconds(
    value: float, name: str, where: str, *, open_low: bool = False, signed: bool = False, high: float = 1e-3
) -> float:
    """Return a duration in seconds.

    Widths, delays and dead times of detectors are far below the 1 ms that a picosecond is in nanoseconds; repetition
    periods of lasers are not, and take `high` = 1 s.

    Args:
        value: number.
        name: name of the argument.
        where: name of the caller, for errors.
        open_low: exclude zero.
        signed: take negative durations.
        high: limit of the magnitude, in seconds, not included.

    Raises:
        UnitError: outside of the range.
    """
    number = check_number(value, name, where, low=-math.inf if signed else 0.0, open_low=open_low)
    if abs(number) >= high:
        raise UnitError(
            f"{where}: expected {name} in seconds, below {high:g} s, got {number!r} s. Picoseconds, nanoseconds or "
            "bins? 50 ps are 50e-12 s, 75 ns are 75e-9 s."
        )
    return number
