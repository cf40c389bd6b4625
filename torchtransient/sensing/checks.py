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


def tensor_of(array: np.ndarray[Any, Any], where: str) -> Tensor:
    """A tensor of an array of numbers, of any byte order. UnitError for what holds none."""
    native = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("=")) if array.dtype.kind != "O" else array
    try:
        return torch.from_numpy(native if native.flags.writeable else native.copy())
    except TypeError as error:
        raise UnitError(f"{where}: expected numbers as a tensor or an array, got {shown(array)}.") from error


def check_dense(x: Tensor, where: str, name: str = "") -> Tensor:
    """The tensor. ShapeError for a sparse one."""
    if x.layout != torch.strided:
        said = f"{name} as a dense tensor" if name else "a dense tensor"
        raise ShapeError(f"{where}: expected {said}, got {x.layout}. x.to_dense() makes one.")
    return x


def no_arrays(value: Any, where: str) -> Any:
    """The value, or a tensor of an array with dimensions."""
    return tensor_of(value, where) if isinstance(value, np.ndarray) and value.ndim else value


def numbers_of(value: Any, name: str, where: str) -> Any:
    """A list of the numbers of a tensor of one dimension; anything else as it is. GradientError as `refuse_cut_off`."""
    refuse_cut_off(value, name, where)
    return value.tolist() if isinstance(value, Tensor) and value.ndim == 1 else value


def refuse_cut_off(value: object, name: str, where: str) -> None:
    """GradientError for a number that requires a gradient and is about to be taken without it."""
    if isinstance(value, Tensor) and (is_dual(value) or (value.requires_grad and torch.is_grad_enabled())):
        raise GradientError(_cut_off_message(name, where))


def is_dual(value: Tensor) -> bool:
    """Whether a tensor carries a tangent of forward-mode differentiation."""
    if torch.compiler.is_compiling():
        return False
    return forward_ad.unpack_dual(value).tangent is not None  # type: ignore[no-untyped-call]


def _cut_off_message(name: str, where: str) -> str:
    return (
        f"{where}: expected {name} without a gradient, which is not supported here and would be cut off in silence; "
        f"got a tensor that requires one. Give its value, {name}.detach(), and learn it by learnable=True where "
        f"{where} has that, or by an nn.Parameter where it takes one; a buffer of a module is learnt by "
        "torch.func.functional_call(module, {its name: tensor}, (x,))."
    )


# ------------------------------------------------------------------------------------------------- of constructors


def careful_init(init: Callable[..., None]) -> Callable[..., None]:
    """An ``__init__`` that takes arrays, and refuses tensors whose gradient the module has not kept."""

    @functools.wraps(init)
    def run(self: nn.Module, *args: Any, **keywords: Any) -> None:
        where = type(self).__name__
        given = [no_arrays(value, where) for value in args]
        named = {name: no_arrays(value, where) for name, value in keywords.items()}
        for value in (*given, *named.values()):
            if isinstance(value, Tensor):
                check_dense(value, where)
        init(self, *given, **named)
        # once, when the whole object is there; private parts are looked at with what they are part of
        if getattr(type(self).__init__, "__wrapped__", None) is init and not where.startswith("_"):
            names = init.__code__.co_varnames[1:] if hasattr(init, "__code__") else ()
            places = {names[i] if i < len(names) else f"argument {i}": value for i, value in enumerate(given)}
            check_kept(self, {**places, **named}, where)

    return run


def check_kept(module: nn.Module, given: Mapping[str, Any], where: str) -> None:
    """GradientError for a given tensor that requires a gradient, of which the module holds neither it nor a result."""
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


def refuse_gradients(record: object) -> None:
    """GradientError for fields of a dataclass that require a gradient; for records whose numbers are taken as such."""
    where = type(record).__name__
    for field in fields(record):  # type: ignore[arg-type]
        for tensor in _tensors(getattr(record, field.name)):
            refuse_cut_off(tensor, field.name, where)


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
    """`x` when it is a tensor, else ShapeError: a renderer's output, or the transient that a film does not measure."""
    if not isinstance(x, Tensor):
        raise ShapeError(f"{where}: expected a tensor (..., C, T, H, W), got {not_a_transient(x)}")
    return check_dense(x, where)


def check_tensors(where: str, **given: object) -> None:
    """ShapeError that names the first argument that is no tensor."""
    for name, value in given.items():
        if not isinstance(value, Tensor):
            raise ShapeError(f"{where}: expected {name} as a tensor, got {shown(value)}. torch.as_tensor makes one.")
        check_dense(value, where, name)


def reals(where: str, whole: torch.dtype | None = None, **given: object) -> tuple[Tensor, ...]:
    """Tensors of real numbers; whole numbers and truth values, which counts may be, in the default dtype
    or `whole`, which holds all their digits. ShapeError for no tensors, UnitError for complex numbers.
    """
    check_tensors(where, **given)
    found = []
    for name, value in given.items():
        assert isinstance(value, Tensor)  # as was checked
        if value.is_complex():
            raise UnitError(f"{where}: expected {name} as real numbers, got {value.dtype}.")
        found.append(value if value.is_floating_point() else value.to(whole or torch.get_default_dtype()))
    return tuple(found)


def complex_tensor(where: str, **given: object) -> Tensor:
    """The one tensor given, of complex numbers. ShapeError for no tensor, UnitError for real numbers."""
    check_tensors(where, **given)
    ((name, value),) = given.items()
    if not isinstance(value, Tensor) or not value.is_complex():
        kind = getattr(value, "dtype", None)
        raise UnitError(f"{where}: expected {name} as complex numbers, got {kind}. torch.complex makes some.")
    return value


def check_broadcast(where: str, **given: Tensor) -> None:
    """ShapeError for tensors whose shapes do not go together."""
    shapes = [tuple(x.shape) for x in given.values()]
    ends = [{shape[-k] for shape in shapes if len(shape) >= k} - {1} for k in range(1, max(map(len, shapes)) + 1)]
    if any(len(sizes) > 1 for sizes in ends):
        got = " and ".join(map(str, shapes))
        raise ShapeError(f"{where}: expected {' and '.join(given)} of shapes that broadcast, got {got}.")


def going_together(where: str, **given: object) -> tuple[Tensor, ...]:
    """`reals` whose shapes broadcast. ShapeError for others."""
    found = reals(where, None, **given)
    check_broadcast(where, **dict(zip(given, found, strict=True)))
    return found


def number_or_tensor(value: Any, name: str, where: str) -> Any:
    """A finite number as a float, or a tensor as `reals` takes it, with its gradient. UnitError, ShapeError."""
    if isinstance(value, Tensor):
        return reals(where, None, **{name: value})[0]
    return check_number(value, name, where, low=-math.inf)


def check_transient(x: Tensor, where: str) -> Tensor:
    """`x` when it is a floating tensor (..., C, T, H, W), else ShapeError or UnitError."""
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
    """As `check_transient`, of one bin at least: nothing is the largest of none. ShapeError."""
    if not check_transient(x, where).shape[TIME]:
        raise ShapeError(f"{where}: expected one bin or more along time, got {tuple(x.shape)}.")
    return x


def not_a_transient(x: object) -> str:
    """What was given instead of a transient, and what to do: the end of a message."""
    if x is None:
        return f"None, which is the transient of a render with another film. {_OTHER_FILMS}"
    if getattr(x, "transient", None) is not None:
        return f"{type(x).__name__}. Give its tensor, out.transient, or put the sensor into Compose([...])."
    if hasattr(x, "transient"):
        there = [name for name in ("phasor", "gated", "rates", "beats", "steady") if getattr(x, name, None) is not None]
        there += [name for name, value in getattr(x, "others", {}).items() if isinstance(value, Tensor)]
        held = f"holds {', '.join(there)} and no transient" if there else "holds no transient"
        return f"{type(x).__name__}, which {held}. {_OTHER_FILMS}"
    return f"{type(x).__name__}."


def check_number(
    value: float, name: str, where: str, *, low: float = 0.0, high: float = math.inf, open_low: bool = False
) -> float:
    """`value` as a float when it is finite and in [low, high] (or (low, high] with `open_low`), else UnitError.

    GradientError for a tensor that requires a gradient, which a float cannot carry.
    """
    refuse_cut_off(value, name, where)
    if isinstance(value, Tensor):
        check_dense(value, where, name)
    number = as_number(value)
    if number is None:
        raise UnitError(f"{where}: expected {name} to be one number, got {shown(value)}.")
    below = number <= low if open_low else number < low
    if not math.isfinite(number) or below or number > high:
        left = "(" if open_low else "["
        raise UnitError(f"{where}: expected {name} in {left}{low:g}, {high:g}]{unit_of(name)}, got {number!r}.")
    return number


def one_number(value: Any, name: str, where: str) -> Any:
    """One real number as a float, or a tensor of one as it is, with its gradient. UnitError."""
    plain = isinstance(value, Tensor) and value.numel() == 1 and value.layout == torch.strided
    if plain and not value.is_complex() and value.dtype != torch.bool:
        return value
    number = None if plain or getattr(value, "layout", torch.strided) != torch.strided else as_number(value)
    if number is None:
        raise UnitError(f"{where}: expected {name} to be one number, got {shown(value)}.")
    return number


def check_count(value: float, name: str, where: str, *, low: int = 1, most: int = MOST) -> int:
    """`value` as an int when it is a whole number from low to most, else UnitError."""
    number = check_number(value, name, where, low=low)
    if number != int(number):
        raise UnitError(f"{where}: expected {name} to be a whole number, got {shown(value)}.")
    whole = as_whole(value)  # all its digits
    whole = int(number) if whole is None else whole
    if whole > most:
        limit = "2^63 - 1" if most == MOST else most
        raise UnitError(f"{where}: expected {name} to be a whole number of at most {limit}, got {shown(value)}.")
    return whole


def check_choice(value: str, choices: object, name: str, where: str) -> None:
    """ArgumentError unless `value` is one of the strings of a Literal type."""
    allowed = get_args(choices)
    if not is_one_of(value, allowed):
        raise ArgumentError(f"{where}: expected {name} to be one of {', '.join(allowed)}, got {shown(value)}.")


def check_one_of(where: str, given: Mapping[str, Any]) -> None:
    """ArgumentError unless exactly one of the arguments named is there."""
    there = [name for name, value in given.items() if value is not None]
    if len(there) != 1:
        got = " and ".join(there) if there else "none of them"
        do = "leave one of them out" if there else "give one of them"
        raise ArgumentError(f"{where}: expected either {' or '.join(given)}, got {got}; {do}.")


def bin_width_of(axis: TimeAxis | None, bin_width_s: float | None, where: str) -> float:
    """Bin width in seconds from a TimeAxis or a number; exactly one of them. UnitError otherwise.

    A width of a microsecond or more is refused: it is most likely given in nanoseconds, picoseconds or bins. An axis in
    metres may be that wide.
    """
    check_one_of(where, {"axis= (the TimeAxis of the light)": axis, "bin_width_s=": bin_width_s})
    if axis is not None:
        return check_time_axis(axis, where).bin_width_s
    width = bin_width_s if bin_width_s is not None else 0.0
    return check_seconds(width, "bin_width_s", where, open_low=True, high=WIDEST_BIN_S)


def bins_of_period(period_s: float, bin_width_s: float, num_bins: int | None, where: str) -> int:
    """How many bins a laser period has. UnitError unless it is a whole number, and `num_bins` where that is given."""
    bins = check_seconds(period_s, "period_s", where, open_low=True, high=1.0) / bin_width_s
    # 1 in 1e6 for periods such as 1/rate that were rounded on the way
    if round(bins) < 1 or abs(bins - round(bins)) > 1e-6 * bins or num_bins not in (None, round(bins)):
        have = "a whole number of bins" if num_bins is None else f"the {num_bins} bins of the axis"
        raise UnitError(
            f"{where}: expected period_s to be {have} of {bin_width_s:g} s, got {period_s:g} s, {bins:g} of them. Take "
            "an axis of one whole laser period."
        )
    return round(bins)


def check_time_axis(axis: object, where: str) -> TimeAxis:
    """`axis` when it is a TimeAxis, else UnitError."""
    if not isinstance(axis, TimeAxis):
        raise ArgumentError(
            f"{where}: expected axis to be a TimeAxis, got {type(axis).__name__}. Take the renderer's, or "
            "TimeAxis.from_seconds(start, bin width, bins)."
        )
    return axis


def check_generator(generator: object, where: str) -> None:
    """UnitError for a generator that is none, a seed for instance."""
    if generator is not None and not isinstance(generator, torch.Generator):
        raise ArgumentError(
            f"{where}: expected generator to be a torch.Generator, got {generator!r}. "
            "Use torch.Generator().manual_seed(...)."
        )


def check_seconds(
    value: float, name: str, where: str, *, open_low: bool = False, signed: bool = False, high: float = 1e-3
) -> float:
    """A duration in seconds, finite, not negative unless `signed`, below `high`; UnitError otherwise.

    Widths, delays and dead times of detectors are far below the 1 ms that a picosecond is in nanoseconds; repetition
    periods of lasers are not, and take `high` = 1 s.
    """
    number = check_number(value, name, where, low=-math.inf if signed else 0.0, open_low=open_low)
    if abs(number) >= high:
        raise UnitError(
            f"{where}: expected {name} in seconds, below {high:g} s, got {number!r} s. Picoseconds, nanoseconds or "
            "bins? 50 ps are 50e-12 s, 75 ns are 75e-9 s."
        )
    return number
