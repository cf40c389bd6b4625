"""Functions that ``torch.compile`` calls as they are.

The compiler follows Python calls and runs them on tensors without data; a render is locks, objects of Mitsuba and
kernels of Dr.Jit. An opaque function runs between the compiled parts around it.
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch

from torchtransient.scene.variant import clear_frames

_P = ParamSpec("_P")
_R = TypeVar("_R")

_REASON = (
    "torchtransient renders with Mitsuba, which the compiler cannot trace: the call stays as it is between compiled "
    "parts. Leave out fullgraph=True, or compile what comes before and after the render"
)


def opaque(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Keep the compiler out of a function, as ``torch.compiler.disable`` does.

    That one imports the compiler, which takes longer than all other imports of this library; here it is called only if
    the compiler is loaded.

    Args:
        function: any function.
    """

    # Kept by the function, not in a table: it is freed with the function and the scenes that it holds.
    disabled: list[Callable[..., Any]] = []

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        handled = sys.exc_info()[1]
        try:
            if "torch._dynamo" not in sys.modules:
                return function(*args, **kwargs)
            return _untraced(function, disabled, args, kwargs)
        except Exception:
            raise
        except BaseException as interrupt:
            clear_frames(interrupt, handled)  # blocks that it has cut off at their end are ended now
            raise
        finally:
            del handled

    return _stopping(call)


def _stopping(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Mark a function as disabled, so that the compiler stops before a call of it."""
    function._torchdynamo_disable = True  # type: ignore[attr-defined]
    function._torchdynamo_disable_msg = _REASON  # type: ignore[attr-defined]
    return function


@_stopping
def _untraced(
    function: Callable[..., _R], disabled: list[Callable[..., Any]], args: tuple[Any, ...], kwargs: dict[str, Any]
) -> _R:
    if not disabled:
        # torch 2.7 and later show the reason
        why = {"reason": _REASON} if "reason" in inspect.signature(torch.compiler.disable).parameters else {}
        disabled.append(torch.compiler.disable(function, **why))  # type: ignore[no-untyped-call]
    result: _R = disabled[0](*args, **kwargs)
    return result
