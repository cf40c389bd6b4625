"""What goes wrong while a kernel is traced, as errors of this library: Dr.Jit's loops hide the reason in a chain."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from torchtransient.errors import GradientError, SceneError, TorchTransientError
from torchtransient.plugins.interrupted import chain_of
from torchtransient.rendering.interrupts import clear_frames

# Dr.Jit's words for an exception inside a loop or call that it traces, and for forward mode that it cannot do.
_INSIDE = "encountered an exception"
_ACROSS = "dr.isolate_grad() scope"
# And for a plugin that asks for the numbers of an array which is not there yet.
_EVALUATED = ": not permitted. "


@contextmanager
def named_errors() -> Iterator[None]:
    """For the time of a render: raise the error of this library that ended it, or one that names the reason."""
    raised: BaseException | None = None
    handled = sys.exc_info()[1]
    try:
        yield
    except RuntimeError as error:
        raised = _instead_of(error, handled)
        if raised is error:
            raise
        clear_frames(error, handled)
        raise raised from (None if raised in chain_of(error, handled) else error)
    finally:
        # A frame must not hold what it raises: both would stay until they are collected, and the scene with them.
        del raised, handled


def _instead_of(error: RuntimeError, handled: BaseException | None) -> BaseException:
    chain = chain_of(error, handled)
    own = next((cause for cause in chain if isinstance(cause, TorchTransientError)), None)
    if own is None and any(words in str(error) for words in (_INSIDE, _ACROSS)):
        return _named(_reason(chain))
    return own or error


def _reason(chain: list[BaseException]) -> BaseException:
    """The first cause that says more than that something happened inside."""
    return next((one for one in reversed(chain) if str(one) and "(see above)" not in str(one)), chain[-1])


def _named(reason: BaseException) -> TorchTransientError:
    words = " ".join(str(reason).split()).rstrip("!.")
    if _ACROSS in words:
        return GradientError(
            "forward mode: Dr.Jit cannot push the tangent of a value into the calls that read it (known of attributes "
            "of shapes with one number at each place, read as a roughness or the weight of a lobe). Use reverse mode, "
            "or a 'bitmap' in the surface itself. Or another scene of this process holds values that are attached "
            "(dr.enable_grad on its parameters, or values computed from such): Dr.Jit builds calls into all objects "
            "alive. Detach them, or let that scene go."
        )
    if _EVALUATED in words:
        return SceneError(
            f"the scene cannot be rendered: one of its plugins evaluates an array while its kernel is built "
            f"({words.split(_EVALUATED)[0]}). Mitsuba's 'timed_sunsky' does: describe a 'sunsky' at its time. A plugin "
            "of your own may not look at values (print them, compare them in an `if`, make numpy arrays of them) in "
            "methods that paths call."
        )
    hint = " A texture or volume may have another number of channels than the place that it stands in."
    return SceneError(
        f"the scene cannot be rendered, {type(reason).__name__} while its kernel was built: {words}."
        + (hint if isinstance(reason, RuntimeError) else "")
    )
