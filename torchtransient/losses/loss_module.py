"""Base class of losses as torch modules, made from their functions."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Collection
from typing import Any, ClassVar

from torch import Tensor, nn


def _described(function: Callable[..., Tensor], names: Collection[str]) -> str:
    """Return the lines about some arguments in the docstring of a function."""
    described = (inspect.getdoc(function) or "").partition("Args:\n")[2].partition("\n\n")[0]
    entries = re.findall(r"^    \w.*(?:\n     .*)*", described, flags=re.MULTILINE)
    return "\n".join(entry for entry in entries if set(entry.strip().partition(":")[0].split(", ")) & set(names))


class LossModule(nn.Module):
    """A loss function as a module that holds its options. ::

        class RootLoss(LossModule, function=root_loss, by_place=("root", "reduction")):
            \"\"\"`root_loss` with its options held.\"\"\"

    The constructor takes the options of `function`, those named in `by_place` by position too: the few that its users
    set first, in the order of the function, `reduction` last if it is one of them. They become attributes; tensors
    move with the module and are no part of its state, modules are submodules. The function checks them when the module
    is called. A function of other tensors than (input, target) has a `forward` with those.
    """

    function: ClassVar[Callable[..., Tensor]]
    _signature: ClassVar[inspect.Signature]

    def __init_subclass__(
        cls, *, function: Callable[..., Tensor] | None = None, by_place: tuple[str, ...] = (), **keywords: Any
    ) -> None:
        super().__init_subclass__(**keywords)
        if function is None:  # a subclass of a loss
            return
        tensors = len(inspect.signature(cls.forward).parameters.keys() - {"self", "mask"})
        options = dict(list(inspect.signature(function).parameters.items())[tensors:])
        del options["mask"]
        places = [options.pop(name).replace(kind=inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in by_place]
        named = [option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in options.values()]
        cls.function, cls._signature = staticmethod(function), inspect.Signature([*places, *named])

        def initialize(self: LossModule, *args: Any, **options: Any) -> None:
            nn.Module.__init__(self)
            bound = cls._signature.bind(*args, **options)
            bound.apply_defaults()
            for name, value in bound.arguments.items():
                if isinstance(value, Tensor) and not isinstance(value, nn.Parameter):
                    self.register_buffer(name, value, persistent=False)
                else:
                    setattr(self, name, value)

        own = inspect.Parameter("self", inspect.Parameter.POSITIONAL_OR_KEYWORD)
        initialize.__signature__ = inspect.Signature([own, *places, *named])  # type: ignore[attr-defined]
        initialize.__name__, initialize.__qualname__ = "__init__", f"{cls.__qualname__}.__init__"
        cls.__init__ = initialize  # type: ignore[method-assign,assignment]
        described = _described(function, cls._signature.parameters)
        cls.__doc__ = f"{inspect.cleandoc(cls.__doc__ or '')}\n\nArgs:\n{described}"

    def loss(self, *tensors: Any, mask: Tensor | None) -> Tensor:
        """Call the function on tensors, with the options that the module holds.

        Args:
            tensors: tensors that the function compares, input and target for most.
            mask: elements that count, None for all.
        """
        options = {name: getattr(self, name) for name in self._signature.parameters}
        return self.function(*tensors, mask=mask, **options)

    def forward(self, input: Any, target: Any, mask: Tensor | None = None) -> Tensor:
        return self.loss(input, target, mask=mask)

    def extra_repr(self) -> str:
        held = {name: getattr(self, name) for name in self._signature.parameters}
        return ", ".join(f"{name}={value!r}" for name, value in held.items() if not isinstance(value, nn.Module))
