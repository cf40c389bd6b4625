"""Checks of arguments: numbers, flags, rows, mappings, functions, names and paths, and values as messages show them.

Each check returns the value, or raises a typed error with what was expected and what came. Their common arguments:
``name`` begins the message ("simulate: tiles"), ``what`` is the subject of messages about files, ``error`` is the type
that is raised. Numbers are those of Python, numpy and torch; truth values, texts and dates are refused, although Python
or numpy convert them. Nothing here imports torch: the command line and the plugins use these checks.
"""

from __future__ import annotations

import contextlib
import difflib
import inspect
import math
import operator
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from torchtransient.errors import ArgumentError, SceneError, ShapeError, StorageError, TorchTransientError, UnitError

if TYPE_CHECKING:
    import torch

Kind = TypeVar("Kind")
# Several numbers. A text: nothing here imports torch.
Numbers: TypeAlias = "Sequence[float] | NDArray[Any] | torch.Tensor"

# Units by the ends of names, with what is most often mistaken.
_UNITS = {
    "hz": "hertz (20 MHz are 20e6)",
    "s": "seconds (50 ps are 50e-12)",
    "opl": "metres of optical path",
    "m": "metres",
    "m2": "square metres (10 um by 10 um are 100e-12)",
    "nm": "nanometres",
    "j": "joules",
    "sr": "steradians",
    "deg": "degrees",
    "rad": "radians",
    "e": "electrons",
}
# Files and tensors count in 64 bits.
MOST = 2**63 - 1
# Most objects that one call makes.
MOST_MADE = 2**24
# Farthest point of a mesh, metres: squares of areas are numbers of single precision in kernels.
_FAR = 1e9
# Types that need no further look.
_PLAIN = {int, float}
# Most numbers of an array that a message shows.
_WRITTEN = 16
# Longest message of another package that is quoted, and of one that quotes a file: all of it, or beginning and end.
_SHORT = 160
_MOST, _BEGINNING, _END = 360, 220, 120
# Tracebacks of Python and places in C++ in messages of Mitsuba, and the longest one that is quoted.
_TRACEBACK = re.compile(r"Traceback \(most recent call last\):\n(?:[ \t].*\n)*")
_PLACE_IN_SOURCE = re.compile(r"\[\w+\.(?:cpp|h):\d+\] ")
_LONGEST = 600


def finite(name: str, value: Any) -> float:
    """Return a finite number as a float.

    Args:
        name: name in the message.
        value: number of any library.

    Raises:
        UnitError: for anything else.
    """
    number = _number(value)
    if not math.isfinite(number):
        raise UnitError(f"{name}: expected a finite number, got {shown(value)}.")
    return number


def positive(name: str, value: Any) -> float:
    """Return a finite number greater than zero as a float.

    Args:
        name: name in the message.
        value: number of any library.

    Raises:
        UnitError: for anything else.
    """
    number = _number(value)
    if not math.isfinite(number) or number <= 0:
        raise UnitError(f"{name}: expected a finite number greater than zero, got {shown(value)}.")
    return number


def share(name: str, value: Any) -> float:
    """Return a number in [0, 1] as a float, an albedo for instance.

    Args:
        name: name in the message.
        value: number of any library.

    Raises:
        UnitError: for anything else.
    """
    number = _number(value)
    if not 0.0 <= number <= 1.0:
        raise UnitError(f"{name}: expected a number between 0 and 1, got {shown(value)}.")
    return number


def shares(name: str, values: Any) -> float | tuple[float, float, float]:
    """Return one share, or three of a linear sRGB colour.

    Args:
        name: name in the message.
        values: number, or sequence or array of three.

    Raises:
        UnitError: for anything else.
    """
    if not isinstance(values, (list, tuple)) and getattr(values, "ndim", None) != 1:
        return share(name, values)
    plain = list(values)
    if len(plain) != 3:
        raise UnitError(f"{name}: expected one number between 0 and 1 or three, got {shown(values)}.")
    red, green, blue = (share(name, value) for value in plain)
    return red, green, blue


def count(
    name: str, value: Any, least: int | None = 1, error: type[TorchTransientError] = SceneError, most: int | None = MOST
) -> int:
    """Return ``value`` as an int; 3.0 is three.

    Args:
        name: name in the message.
        value: number of any library.
        least: smallest value, None for no bound.
        error: type of the error.
        most: largest value, None for no bound.

    Raises:
        error: unless ``value`` is whole and within the bounds.
    """
    number = as_whole(value)
    if number is None:
        whole = _number(value)
        number = int(whole) if math.isfinite(whole) and whole == round(whole) else None
    if number is None or number < (-MOST if least is None else least):
        bound = "" if least is None else f" of at least {least}"
        raise error(f"{name}: expected a whole number{bound}, got {shown(value)}.")
    if most is not None and number > most:
        raise error(f"{name}: expected a whole number of at most {most}, got {shown(value)}.")
    return number


def index(name: str, value: Any, size: int, error: type[TorchTransientError] = ArgumentError) -> int:
    """Return an index from 0 on.

    Args:
        name: name in the message.
        value: index; negative ones count from the end.
        size: number of entries.
        error: type of the error.

    Raises:
        error: for an index out of range.
    """
    number = as_whole(value)
    if number is None or not -size <= number < size:
        raise error(f"{name}: expected a whole number from {-size} to {size - 1}, got {shown(value)}.")
    return number % size


def as_whole(value: Any) -> int | None:
    """Return a whole number as an int; None for 2.0, texts, truth values.

    Args:
        value: value of any kind; whole numbers of other libraries, such as NumPy and torch, count.
    """
    if _is_no_number(value) or getattr(value, "ndim", None):
        return None
    try:
        return operator.index(value)
    except (TypeError, RuntimeError):  # tensors on "meta" and in vmap have no number
        return None


def flag(name: str, value: Any) -> bool:
    """Return a truth value as a bool.

    Args:
        name: name in the message.
        value: truth value of any library.

    Raises:
        ArgumentError: for other types: the text "False" would count as true.
    """
    if not _is_truth(value) or getattr(value, "ndim", None):
        raise ArgumentError(f"{name}: expected True or False, got {shown(value)}.")
    return bool(value)


def real_array(values: Any) -> NDArray[np.float64] | None:
    """Return real numbers as a detached float64 array.

    Args:
        values: numbers of any library and shape.

    Returns:
        The array; None for texts, None, truth values, rows of different lengths and numbers that float64 cannot hold.
    """
    try:
        if _has_no_number(values):
            return None
        plain = _array(values.detach().cpu()) if hasattr(values, "detach") else np.asarray(values)
        if plain.dtype.kind in "iuf":
            return plain.astype(np.float64)
        # Lists of tensors or of whole numbers beyond 64 bits.
        listed = plain.dtype == object and all(hasattr(one, "__float__") for one in plain.reshape(-1))
        return np.asarray(plain.tolist(), dtype=np.float64) if listed else None
    except (TypeError, ValueError, OverflowError, RuntimeError):
        return None


def _array(tensor: Any) -> NDArray[Any]:
    try:
        return np.asarray(tensor)
    except RuntimeError:  # inside of torch.func, where tensors have no memory
        return np.asarray(tensor.tolist())


def numbers(name: str, values: Any) -> NDArray[np.float64]:
    """Return numbers as :func:`real_array` does.

    Args:
        name: name in the message.
        values: numbers of any library and shape.

    Raises:
        UnitError: for anything else.
    """
    array = real_array(values)
    if array is None:
        raise UnitError(f"{name}: expected real numbers, got {shown(values)}.")
    return array


def _has_no_number(values: Any) -> bool:
    """Return True for values that numpy converts and that are no numbers, truth values beside numbers for instance."""
    if not isinstance(values, (list, tuple)):
        return _is_no_number(values)
    return any(type(one) not in _PLAIN and _has_no_number(one) for one in values)


def transform(name: str, given: Any) -> NDArray[np.float64]:
    """Return a transform (4, 4).

    Args:
        name: name in the message.
        given: numbers of any library, or a transform of Mitsuba.

    Raises:
        ShapeError: unless it has as many finite numbers.
    """
    matrix = real_array(getattr(given, "matrix", given))
    if matrix is not None and matrix.ndim == 3:  # Dr.Jit's, of one entry
        matrix = matrix[..., 0]
    if matrix is None or matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ShapeError(f"{name}: expected a (4, 4) array of finite numbers, got {shown(given)}.")
    return matrix


def shown(value: Any) -> str:
    """Return a value as a message shows it, at most 60 characters; large arrays and tensors as their shape.

    Args:
        value: any object.
    """
    shape = getattr(value, "shape", None)
    if isinstance(shape, tuple) and not isinstance(value, type) and math.prod(shape) > _WRITTEN:
        return f"{with_article(type(value).__name__)} {tuple(shape)}"
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # whole numbers of thousands of digits, lists in themselves
        text = f"a {type(value).__name__} that cannot be written"
    text = " ".join(text.split()) if "\n" in text else text
    return text if len(text) <= 60 else f"{text[:57]}..."


def unit_of(name: str) -> str:
    """Return the unit that a name ends in, as it follows a range in a message; empty for names without one.

    Args:
        name: name of an argument, such as "delay_s".
    """
    unit = _UNITS.get(name.rpartition("_")[2]) if "_" in name else None
    return f" {unit}" if unit else ""


def with_article(word: str) -> str:
    """Return "a confocal", "an exhaustive".

    Args:
        word: any word.
    """
    return f"{'an' if word[:1] in 'aeiou' else 'a'} {word}"


def as_number(value: Any) -> float | None:
    """Return a real number as a float, infinities and NaN included; None for anything else.

    Args:
        value: number of any library.
    """
    if _is_no_number(value) or getattr(value, "ndim", None):
        return None
    try:
        return float(value)
    except OverflowError:
        return math.inf
    except (TypeError, ValueError, RuntimeError):
        return None


def _number(value: Any) -> float:
    """Return a float, NaN for anything but a real number."""
    number = as_number(value)
    return math.nan if number is None else number


def _is_no_number(value: Any) -> bool:
    """Return True for values that Python or numpy convert to numbers and that are none."""
    # A hidden entry has a number behind it that numpy hands out. torch.compile does not follow `is_masked`.
    if isinstance(value, (str, bytes)) or (isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value)):
        return True
    dtype = getattr(value, "dtype", None)
    return _is_truth(value) or "complex" in str(dtype) or getattr(dtype, "kind", None) in {"m", "M", "S", "U", "V"}


def _is_truth(value: Any) -> bool:
    return isinstance(value, bool) or "bool" in str(getattr(value, "dtype", ""))


# ------------------------------------------------------------------------------------------------------ types and texts


def of_class(
    name: str, value: Any, kind: type[Kind], hint: str = "", error: type[TorchTransientError] = ArgumentError
) -> Kind:
    """Return an instance of a class.

    Args:
        name: name in the message.
        value: any object.
        kind: the class.
        hint: end of the message.
        error: type of the error.

    Raises:
        error: for other objects.
    """
    if not isinstance(value, kind):
        raise error(f"{name}: expected {with_article(kind.__name__)}, got {shown(value)}{hint}.")
    return value


def several(
    name: str, values: Any, what: str, kind: type[Kind] | None = None, error: type[TorchTransientError] = ShapeError
) -> list[Kind]:
    """Return ``values`` as a list.

    Args:
        name: name in the message.
        values: any iterable but a text and a mapping.
        what: plural of the values in the message, "pixels (row, column)".
        kind: class of each value, None for any.
        error: type of the error.

    Raises:
        error: for other objects, and for values of another class.
    """
    found = list(one_by_one(name, values, what, error))
    for one in found:
        if kind is not None and not isinstance(one, kind):
            raise error(f"{name}: expected several {what}, got {shown(one)} among them.")
    return found


def one_by_one(name: str, values: Any, what: str, error: type[TorchTransientError] = ShapeError) -> Iterator[Any]:
    """Return an iterator over values, as :func:`several`.

    Args:
        name: name in the message.
        values: any iterable but a text and a mapping.
        what: plural of the values in the message.
        error: type of the error.

    Raises:
        error: for other objects.
    """
    with contextlib.suppress(TypeError):
        if not isinstance(values, (str, bytes, Mapping)):
            return iter(values)
    raise error(f"{name}: expected several {what}, got {shown(values)}.")


def mapping(name: str, value: Any, what: str, error: type[TorchTransientError] = ArgumentError) -> Mapping[Any, Any]:
    """Return a mapping.

    Args:
        name: name in the message.
        value: any object.
        what: form of the mapping in the message, "{title: image}".
        error: type of the error.

    Raises:
        error: for other objects.
    """
    if not isinstance(value, Mapping):
        raise error(f"{name}: expected a dictionary {what}, got {shown(value)}.")
    return value


def function(name: str, value: Any, what: str, error: type[TorchTransientError] = ArgumentError) -> Callable[..., Any]:
    """Return a callable.

    Args:
        name: name in the message.
        value: any object.
        what: its arguments in the message, "images (N, 1, H, W)".
        error: type of the error.

    Raises:
        error: for other objects.
    """
    if not callable(value):
        raise error(f"{name}: expected a function of {what}, got {shown(value)}.")
    called: Callable[..., Any] = value
    return called


def a_recipe(name: str, value: Any, *methods: str) -> Any:
    """Return a recipe.

    Args:
        name: name in the message.
        value: any object.
        methods: names of the methods that it needs.

    Raises:
        ArgumentError: for other objects, with the reader of files of recipes.
    """
    missing = [method for method in methods if isinstance(value, type) or not callable(getattr(value, method, None))]
    if not missing:
        return value
    hint = ""
    if isinstance(value, (str, os.PathLike)):
        hint = " tt.data.Recipe.read reads files."
    elif isinstance(value, Mapping):
        hint = " tt.data.Recipe.from_dict reads dictionaries."
    raise ArgumentError(f"{name}: expected a recipe, with {missing[0]}(), got {shown(value)}.{hint}")


def text(name: str, value: Any, what: str, error: type[TorchTransientError] = ArgumentError) -> str:
    """Return a text.

    Args:
        name: name in the message.
        value: any object.
        what: its meaning in the message, "the name of a sampler".
        error: type of the error.

    Raises:
        error: for other objects.
    """
    if not isinstance(value, str):
        raise error(f"{name}: expected {what}, got {shown(value)}.")
    return value


def is_one_of(value: Any, names: Collection[str]) -> bool:
    """Return True for one of some texts; arrays never are.

    Args:
        value: any object.
        names: the texts.
    """
    return isinstance(value, str) and value in names


# ----------------------------------------------------------------------------------------- names and errors in messages


def some_of(names: Any, letters: int = 240) -> str:
    """Return names as text for a message, with the number of names left out.

    Args:
        names: any iterable.
        letters: most characters.
    """
    names = [name if len(name) <= 60 else f"{name[:57]}..." for name in map(str, names)]
    text = ", ".join(names)
    if len(text) <= letters:
        return text
    kept = text[:letters].rpartition(", ")[0] or text[:letters]
    left = len(names) - kept.count(", ") - 1
    return f"{kept} and {left} more"


def short_message(error: BaseException) -> str:
    """Return the message of an error of another package, at most 160 characters in one line.

    Args:
        error: the error.
    """
    message = " ".join(str(error).split()).rstrip(".") or type(error).__name__
    return message if len(message) <= _SHORT else f"{message[: _SHORT - 3]}..."


def one_line(error: BaseException) -> str:
    """Return the message of an error of Mitsuba in one line, without tracebacks and places in its sources.

    Args:
        error: the error.
    """
    words = " ".join(_PLACE_IN_SOURCE.sub("", _TRACEBACK.sub("", str(error))).split())
    return words if len(words) <= _LONGEST else f"{words[: _LONGEST - 3]}..."


def cut_line(text: str) -> str:
    """Return a text in one line, of a long one its beginning and its end.

    Args:
        text: the text.
    """
    line = " ".join(text.split())
    return line if len(line) <= _MOST else f"{line[:_BEGINNING]} ... {line[-_END:]}"


@contextlib.contextmanager
def short_errors(what: str) -> Iterator[None]:
    """Shorten messages of this library's errors that quote a file to one line.

    Args:
        what: subject of the message.

    Raises:
        StorageError: in place of an OSError, for a file that ``what`` names.
    """
    try:
        yield
    except TorchTransientError as error:
        message = str(error)
        if len(message) <= _MOST and "\n" not in message:
            raise
        raise type(error)(cut_line(message)) from error
    except OSError as error:
        raise StorageError(f"{what}: a file that it names cannot be read: {short_message(error)}.") from error


# ---------------------------------------------------------------------------------------------------- keyword arguments


@contextlib.contextmanager
def arguments_of(name: str, function: Callable[..., Any], given: Collection[str] = ()) -> Iterator[None]:
    """Report a TypeError about arguments of ``function`` as one of a function that passes its ``**options`` on.

    Args:
        name: name of the function that was called.
        function: function that the options are passed to; the message lists its arguments.
        given: arguments that the caller does not choose, which are left out of the list.

    Raises:
        TypeError: in place of that of ``function``.
    """
    try:
        yield
    except TypeError as error:
        head = f"{function.__qualname__}() "
        if not str(error).startswith(head):
            raise
        known = [n for n in inspect.signature(function).parameters if n not in ("self", "kwargs", *given)]
        wrong = re.search(r"unexpected keyword argument '(\w+)'", str(error))
        near = difflib.get_close_matches(wrong[1], known, 1) if wrong else []
        hint = f" Did you mean {near[0]!r}?" if near else ""
        says = str(error).removeprefix(head)
        raise TypeError(f"{name}() {says}.{hint} Its other arguments are {', '.join(known)}.") from None


# ------------------------------------------------------------------------------------------------------- paths of files


def path_of(path: Any, what: str) -> Path:
    """Return a path.

    Args:
        path: any object.
        what: subject of the message.

    Raises:
        StorageError: for names that this file system cannot have.
    """
    try:
        found = Path(path)
        os.lstat(found)
    except (FileNotFoundError, NotADirectoryError):
        return found
    except (TypeError, ValueError, OSError) as error:
        reason = "" if isinstance(error, TypeError) else f": {error}"
        raise StorageError(f"{what}: expected the name of a file, got {shown(path)}{reason}.") from None
    return found


def check_special(path: str | os.PathLike[str], what: str, error: type[TorchTransientError] = StorageError) -> None:
    """Refuse a device, which has no end, a pipe, which may have no writer, or a socket.

    Missing files pass: opening them fails with its own error.

    Args:
        path: any path.
        what: subject of the message.
        error: type of the error.

    Raises:
        error: for these.
    """
    if os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path)):
        raise error(f"{what}: '{path}' is no file on a disk (a device or a pipe). Give the name of a file.")


def check_source(path: Any, what: str) -> Path:
    """Return the path of a file to read.

    Args:
        path: any object.
        what: subject of the message.

    Raises:
        StorageError: for a missing file, a folder, a device or a pipe.
    """
    source = path_of(path, what)
    if source.is_file():
        return source
    problem = "is a folder" if source.is_dir() else "is no file on a disk" if source.exists() else "does not exist"
    raise StorageError(f"{what}: '{source}' {problem}. Give the name of a file.")


def check_folder(path: Any, what: str) -> Path:
    """Return the path of a file to write or replace.

    Args:
        path: any object.
        what: subject of the message.

    Raises:
        StorageError: for a folder that is missing or not writable, and for a path that is a folder, a device, a pipe or
            a file without permission.
    """
    target = path_of(path, what)
    # What a link points to is replaced, not the link.
    place = Path(os.path.realpath(target)) if target.is_symlink() else target
    if not place.parent.is_dir():
        raise StorageError(f"{what}: the folder '{place.parent}' does not exist. Create it first.")
    closed = next((p for p in (place.parent, place) if p.exists() and not os.access(p, os.W_OK)), None)
    if place.is_dir() or closed or (place.exists() and not place.is_file()):
        problem = f"cannot be written: no permission for '{closed}'" if closed else "is no file on a disk"
        raise StorageError(f"{what}: '{target}' {'is a folder' if place.is_dir() else problem}. Choose another place.")
    return target


def checked_mesh(who: str, vertices: Any, faces: Any) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return a triangle mesh as float64 (V, 3), metres, and int64 (F, 3).

    Args:
        who: subject of the message.
        vertices: numbers of any library.
        faces: whole numbers of any library.

    Raises:
        ShapeError: for other shapes and indices.
        UnitError: for vertices that are not finite or 1e9 m away.
    """
    points, given = real_array(vertices), real_array(faces)
    if points is None or given is None or points.shape[1:] != (3,) or given.shape[1:] != (3,) or not len(given):
        raise ShapeError(f"{who}: expected vertices (V, 3) and faces (F, 3), got {shown(vertices)} and {shown(faces)}.")
    if not (np.abs(points) < _FAR).all():
        raise UnitError(f"{who}: expected vertices in finite metres, less than {_FAR:g} from the origin, got others.")
    if not (given == np.round(given)).all() or given.min() < 0 or given.max() >= len(points):
        raise ShapeError(
            f"{who}: expected faces of whole numbers from 0 to {len(points) - 1}, one less than the vertices, got "
            f"numbers from {given.min():g} to {given.max():g}."
        )
    return points.copy(), given.astype(np.int64)
