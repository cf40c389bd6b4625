"""Copies and pickles of modules with parametrizations, which torch alone does not make.

`register_parametrization` gives a module a class of its own, with a property for each parametrized name. Torch refuses
to pickle it, and a deep copy shares the class: what is removed from the copy is gone in the module it was copied from.
"""

from __future__ import annotations

import copy
from typing import Any, Self

import torch
from torch import nn
from torch.nn.utils import parametrize


class CopiesParametrized(nn.Module):
    """A module whose copies and pickles keep their parametrizations, each with a class of its own. Modules inherit from
    it in place of `nn.Module`.
    """

    def __reduce_ex__(self, protocol: Any) -> Any:
        if not parametrize.is_parametrized(self):
            return super().__reduce_ex__(protocol)
        # What the class itself would put away: torch's class on top refuses to.
        own: Any = parametrize.type_before_parametrizations(self)
        return _shell, _origin(self), own.__getstate__(self)

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        make, arguments, state = self.__reduce_ex__(4)[:3]
        made: Self = make(*arguments)
        memo[id(self)] = made
        made.__setstate__(copy.deepcopy(state, memo))  # type: ignore[no-untyped-call]
        return made


def _origin(module: nn.Module) -> tuple[type, tuple[str, ...]]:
    """The class before parametrizations, and their names."""
    names = tuple(module.parametrizations) if parametrize.is_parametrized(module) else ()  # type: ignore[arg-type]
    return parametrize.type_before_parametrizations(module), names


def _shell(cls: Any, names: tuple[str, ...]) -> Any:
    """A module of `cls` with properties for `names`, whose entries are still to come."""
    module = cls.__new__(cls)
    if names:
        nn.Module.__init__(module)
        for name in names:
            module.register_parameter(name, nn.Parameter(torch.zeros(())))
            parametrize.register_parametrization(module, name, nn.Identity())
    return module
