"""What a function reaches in its surroundings: the variables that it names, and Mitsuba's scenes behind them.

Followed are the variables of a function, of the functions that it names and of the methods of its objects; defaults,
bound arguments, attributes, and entries of containers. The code of installed packages is not: it holds no scene of the
user's.
"""

from __future__ import annotations

import contextlib
import contextvars
import dis
import functools
import inspect
import os
import site
import sys
import sysconfig
import types
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import numpy as np
import torch

# Entries and attributes are followed so deep below a variable, and one level where there are many: data, as a rule.
_DEPTH = 3
_LONG = 1000
_LEAVES = (str, bytes, int, float, complex, type(None), torch.Tensor, np.ndarray, np.generic, range, slice)
_CONTAINERS = (list, tuple, dict, set, frozenset)
_FUNCTIONS = (types.FunctionType, types.MethodType, functools.partial)


class Reached:
    """``named``: the variables (name, value) of a function and of the functions that it calls by their names;
    ``parameters``: every ``mitsuba.SceneParameters`` in its reach; ``objects``: every other object of Mitsuba.
    """

    def __init__(self, function: Any, arguments: Iterable[Any] = ()) -> None:
        import mitsuba as mi

        self.named: list[tuple[str, Any]] = []
        self.parameters: list[Any] = []
        self.objects: list[Any] = []
        self._kinds = mi.SceneParameters, mi.Object
        # By address, with the value itself, so that it lives for as long as its address counts.
        self._values: dict[int, tuple[int, Any]] = {}
        self._visits: set[tuple[int, Any]] = set()
        for value in arguments:
            self._look_at(value, frozenset(), 1)
        self._follow(function, is_named=True)

    def _look_at(self, value: Any, attributes: frozenset[str], depth: int = 0) -> None:
        """``attributes``: the names that the code which holds the value asks for."""
        if isinstance(value, _LEAVES):
            return
        before = self._values.get(id(value), (_DEPTH + 1, None))[0]
        # Nearer than before, more of what is below it is in reach, and a function is called for certain.
        if (id(value), attributes) in self._visits and depth >= before:
            return
        self._visits.add((id(value), attributes))
        is_new = id(value) not in self._values
        self._values[id(value)] = min(depth, before), value
        scene_parameters, mitsuba_object = self._kinds
        if isinstance(value, scene_parameters):
            self.parameters += [value] if is_new else []
        elif isinstance(value, mitsuba_object):
            self.objects += [value] if is_new else []
        elif isinstance(value, (types.ModuleType, type)):
            for name in attributes & vars(value).keys() if not _is_of_library(value) else ():
                self._look_at_variable(f"{value.__name__}.{name}", vars(value)[name], attributes, True)
        elif isinstance(value, _FUNCTIONS):
            if not _is_of_library(inspect.unwrap(value)):
                self._follow(value, is_named=depth == 0)
        elif not type(value).__module__.startswith("torchtransient."):  # the scenes of these look after themselves
            if not isinstance(value, _CONTAINERS):
                self._look_at_methods(type(value), attributes)
            parts = _parts_of(value) if depth < before else ()
            if len(parts) > _LONG:
                parts = tuple(part for part in parts if isinstance(part, self._kinds))
            for part in parts:
                if not isinstance(part, _LEAVES):
                    self._look_at(part, attributes, depth + 1)

    def _look_at_methods(self, kind: type, attributes: frozenset[str]) -> None:
        if _is_of_library(kind):
            return
        for name in (*attributes, "__call__"):
            found = next((vars(base)[name] for base in kind.__mro__ if name in vars(base)), None)
            if isinstance(found, (staticmethod, classmethod)):
                for base in kind.__mro__ if isinstance(found, classmethod) else ():
                    self._look_at(base, _attributes_of(found.__func__.__code__))
                found = found.__func__
            elif isinstance(found, (property, functools.cached_property)):
                found = found.fget if isinstance(found, property) else found.func
            if isinstance(found, types.FunctionType):
                self._follow(found, is_named=False)
            else:
                self._look_at(found, attributes, 1)

    def _look_at_variable(self, name: str, value: Any, attributes: frozenset[str], is_named: bool) -> None:
        if is_named:
            self.named.append((name, value))
        self._look_at(value, attributes)

    def _follow(self, function: Any, is_named: bool) -> None:
        """``is_named``: it is called for certain, other than a method that has the name of some attribute."""
        while isinstance(function, functools.partial):
            for n, value in enumerate(function.args):
                self._look_at_variable(f"argument {n}", value, frozenset(), is_named)
            for name, value in function.keywords.items():
                self._look_at_variable(name, value, frozenset(), is_named)
            function = function.func
        owner = getattr(function, "__self__", None)
        plain = inspect.unwrap(getattr(function, "__func__", function))
        code = getattr(plain, "__code__", None)
        if code is None:
            self._look_at(plain if owner is None else owner, frozenset(("__call__",)))
            return
        attributes = _attributes_of(code)
        self._look_at(owner, attributes)
        self._look_at_decorators(getattr(function, "__func__", function), is_named)
        if (id(plain), is_named) not in self._visits:
            self._visits.add((id(plain), is_named))
            for name, value in _variables_of(plain, code):
                self._look_at_variable(name, value, attributes, is_named)

    def _look_at_decorators(self, function: Any, is_named: bool) -> None:
        """What is around a function that ``functools.wraps`` calls by the name of another."""
        while (inner := getattr(function, "__wrapped__", None)) is not None:
            code = getattr(function, "__code__", None)
            if code is not None and not _is_library_file(code.co_filename):
                for name, value in _variables_of(function, code):
                    if not isinstance(value, types.FunctionType):
                        self._look_at_variable(name, value, _attributes_of(code), is_named)
            function = inner


def _parts_of(value: Any) -> tuple[Any, ...]:
    if isinstance(value, weakref.ref):
        return (value(),)
    if isinstance(value, contextvars.ContextVar):
        return (value.get(None),)
    if _is_container_of_python(value):
        return tuple(value.values() if isinstance(value, Mapping) else value)
    named = _attributes_and_slots(value)
    if isinstance(value, torch.nn.Module):
        named = {name: part for name, part in named.items() if name not in _of_every_module()}
    if isinstance(value, _CONTAINERS):
        return (*named.values(), *(value.values() if isinstance(value, dict) else value))
    return tuple(named.values())


def _is_container_of_python(value: Any) -> bool:
    """A deque, a view of a dictionary and the like: what others call a sequence may be a file that is read."""
    is_container = isinstance(value, (Mapping, Sequence, Set)) and not isinstance(value, _CONTAINERS)
    return is_container and type(value).__module__.partition(".")[0] in sys.stdlib_module_names


def _attributes_and_slots(value: Any) -> dict[str, Any]:
    found = dict(getattr(value, "__dict__", {}))
    for base in type(value).__mro__:
        slots = vars(base).get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else tuple(slots):
            member = vars(base).get(f"_{base.__name__.lstrip('_')}{name}" if _is_private(name) else name)
            if isinstance(member, types.MemberDescriptorType):
                with contextlib.suppress(AttributeError):  # not assigned yet
                    found[f"{base.__name__}.{name}"] = member.__get__(value)
    return found


def _is_private(name: str) -> bool:
    return name.startswith("__") and not name.endswith("__")


@functools.cache
def _of_every_module() -> frozenset[str]:
    """Attributes of torch's modules that hold tensors and hooks."""
    return frozenset(vars(torch.nn.Module())) - {"_modules"}


def _variables_of(function: Any, code: types.CodeType) -> Iterator[tuple[str, Any]]:
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        try:
            yield name, cell.cell_contents
        except ValueError:  # not assigned yet
            continue
    for name in _globals_of(code):
        if name in function.__globals__:
            yield name, function.__globals__[name]
    defaults = function.__defaults__ or ()
    yield from zip(code.co_varnames[code.co_argcount - len(defaults) : code.co_argcount], defaults, strict=True)
    yield from (function.__kwdefaults__ or {}).items()


def _with_inner(code: types.CodeType) -> Iterator[types.CodeType]:
    """Code and that of the functions, lambdas and comprehensions which are defined in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _with_inner(constant)


@functools.cache
def _globals_of(code: types.CodeType) -> tuple[str, ...]:
    """The global variables that code reads; ``co_names`` has the names of attributes among them."""
    steps = (step for part in _with_inner(code) for step in dis.get_instructions(part))
    return tuple(dict.fromkeys(step.argval for step in steps if step.opname == "LOAD_GLOBAL"))


@functools.cache
def _attributes_of(code: types.CodeType) -> frozenset[str]:
    return frozenset(name for part in _with_inner(code) for name in part.co_names)


@functools.cache
def _library_folders() -> tuple[str, ...]:
    paths = sysconfig.get_paths()
    folders = {paths[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    folders |= {*site.getsitepackages(), site.getusersitepackages(), str(Path(__file__).parents[1])}
    return tuple(sorted(os.path.realpath(folder) + os.sep for folder in folders))


@functools.cache
def _is_library_file(path: str) -> bool:
    return os.path.realpath(path).startswith(_library_folders())


def _is_of_library(value: Any) -> bool:
    """Whether a function, a class or a module is Python's or of an installed package."""
    if isinstance(value, type):
        return _is_class_of_library(value)
    if isinstance(value, types.ModuleType):
        path = getattr(value, "__file__", None)
        is_made_by_hand = value.__name__ == "__main__" or value.__spec__ is None
        return not is_made_by_hand if path is None else _is_library_file(path)
    code = getattr(value, "__code__", None)
    return code is not None and _is_library_file(code.co_filename)


@functools.lru_cache(maxsize=4096)
def _is_class_of_library(kind: type) -> bool:
    module = sys.modules.get(kind.__module__)
    return module is not None and _is_of_library(module)
