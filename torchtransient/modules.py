"""Base classes of the library's torch modules: states of single numbers, copies and pickles with parametrizations.

`register_parametrization` gives a module a class of its own, with a property for each parametrized name. Torch refuses
to pickle it, and copies share the class: what is removed from the copy is gone in the module it was copied from.
"""

from __future__ import annotations

import copy
import copyreg
import itertools
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

_CONTAINERS = ("_parameters", "_buffers", "_modules")


class ScalarState(nn.Module):
    """Base of modules with numbers in their state. Torch 2.6 loads the first number of several for one number without a
    word; later versions report it. Loading reports it here, for the numbers of inner modules too.
    """

    def _load_from_state_dict(self, state: Any, prefix: str, *rest: Any) -> None:
        super()._load_from_state_dict(state, prefix, *rest)
        errors = rest[-1]
        for name, own in itertools.chain(self.named_parameters(), self.named_buffers()):
            given, key = state.get(prefix + name), prefix + name
            several = isinstance(given, Tensor) and given.ndim == 1 and len(given) != 1
            if own.ndim == 0 and several and not any(key in error for error in errors):
                errors.append(f"size mismatch for {key}: {tuple(given.shape)} in the state, expected one number.")


class CopiesParametrized(ScalarState):
    """Module whose copies and pickles keep their parametrizations, each with a class of its own. Modules inherit from
    it in place of `nn.Module`, or are given their parametrizations by `register`.

    `copy.copy` shares tensors, as copies of all modules do: parametrizations that one of both takes away stay in the
    other, but one that is given to either changes the numbers of both.
    """

    def __reduce_ex__(self, protocol: Any) -> Any:
        if not parametrize.is_parametrized(self):
            return super().__reduce_ex__(protocol)
        return _reduced(self, protocol)

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        return _deep(self, memo)

    def __copy__(self) -> Any:
        return _shallow(self)


def let_copy(module: nn.Module) -> None:
    """Make copies and pickles of a parametrized module as those of `CopiesParametrized`, unless its class has its own.

    Args:
        module: module with or without parametrizations.
    """
    own: Any = parametrize.type_before_parametrizations(module)
    made: Any = type(module)
    if made is own or isinstance(module, CopiesParametrized) or copyreg._slotnames(own):  # type: ignore[attr-defined]
        return
    # The class that torch has made for this one module.
    if not hasattr(own, "__deepcopy__"):
        made.__deepcopy__ = _deep
    if not hasattr(own, "__copy__"):
        made.__copy__ = _shallow
    if own.__reduce_ex__ is object.__reduce_ex__ and own.__reduce__ is object.__reduce__:
        made.__reduce_ex__ = _reduced


def _reduced(module: nn.Module, _protocol: Any) -> tuple[Any, ...]:
    # What the class itself would put away: torch's class on top refuses to.
    own: Any = parametrize.type_before_parametrizations(module)
    names = tuple(module.parametrizations) if parametrize.is_parametrized(module) else ()  # type: ignore[arg-type]
    return _shell, (own, names), own.__getstate__(module)


def _parts(module: Any) -> tuple[Any, tuple[Any, ...], Any]:
    make, arguments, state = module.__reduce_ex__(4)[:3]
    return make, arguments, state


def _deep(module: nn.Module, memo: dict[int, Any]) -> Any:
    make, arguments, state = _parts(module)
    made = make(*arguments)
    memo[id(module)] = made
    made.__setstate__(copy.deepcopy(state, memo))
    return made


def _shallow(module: nn.Module) -> Any:
    make, arguments, state = _parts(module)
    made = make(*arguments)
    made.__setstate__(state)
    _own_containers(made)
    if parametrize.is_parametrized(made):
        lists = made.parametrizations = _with_own_containers(made.parametrizations)
        for name, one in lists.items():
            lists[name] = _with_own_containers(one)
    return made


def _own_containers(module: nn.Module) -> None:
    """Give a module dictionaries of its own, with the same tensors and modules."""
    module.__dict__.update({name: module.__dict__[name].copy() for name in _CONTAINERS})


def _with_own_containers(module: Any) -> Any:
    twin: Any = object.__new__(type(module))
    twin.__dict__.update(module.__dict__)
    _own_containers(twin)
    return twin


def _shell(cls: Any, names: tuple[str, ...]) -> Any:
    """Return a module of `cls` with properties for `names`, without entries."""
    module = cls.__new__(cls)
    if names:
        nn.Module.__init__(module)
        for name in names:
            module.register_parameter(name, nn.Parameter(torch.zeros(())))
            parametrize.register_parametrization(module, name, nn.Identity())
        let_copy(module)
    return module
