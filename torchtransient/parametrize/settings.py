"""Settings of a parametrization as part of its state."""

from __future__ import annotations

from typing import Any, Self

import torch
from torch import Tensor

from torchtransient.errors import SceneError
from torchtransient.modules import ScalarState


class Settings(ScalarState):
    """Base of parametrizations. Numbers that the value depends on are buffers of `state_dict`, so that loading a state
    brings the value back; they stay in double precision when the module is made half.
    """

    def _keep(self, name: str, numbers: Tensor | float) -> None:
        """``numbers``: without a derivative."""
        self.register_buffer(name, torch.as_tensor(numbers).to(torch.float64, copy=True))

    def _apply(self, fn: Any, recurse: bool = True) -> Self:
        before = dict(self._buffers)
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        for name, old in before.items():
            new = self._buffers[name]
            if old is not None and new is not None and new.dtype != old.dtype:
                self._buffers[name] = old.to(new.device)
        return self


def choice_code(names: tuple[str, ...], chosen: str) -> Tensor:
    """Return a choice as a number, which every format of files takes.

    Args:
        names: all choices.
        chosen: one of them.
    """
    return torch.tensor(names.index(chosen))


def choice_of(names: tuple[str, ...], code: Any, where: str) -> str:
    """Return the choice that a `state_dict` holds as a number.

    Args:
        names: all choices.
        code: number that :func:`choice_code` made of the choice.
        where: begins the message.

    Raises:
        SceneError: for other codes.
    """
    number = int(code)
    if not 0 <= number < len(names):
        raise SceneError(f"{where}: expected the state of one of {', '.join(names)}, got number {number}.")
    return names[number]
