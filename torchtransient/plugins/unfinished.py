"""What a call changes and puts back, also when an interrupt cuts off the putting back: the next call does it first."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from torchtransient.plugins.interrupted import interrupt_behind

# What calls have changed and still have to put back, oldest first.
_owed: dict[object, Callable[[], object]] = {}


@contextmanager
def afterwards(put_back: Callable[[], object]) -> Iterator[None]:
    """Call ``put_back`` after the block; where an interrupt keeps it from that, or comes in the middle of it, at the
    beginning of the next call (:func:`make_good`). So it may run twice, and the second time has to mend the first.

    What is put back late must not be what others set in between without the engine lock, as states of generators.
    """
    key = object()
    try:
        _owed[key] = put_back
        yield
    finally:
        # By then it may be done: a traceback that is kept keeps this frame waiting.
        if key in _owed:
            _carry_out(key)


def make_good() -> None:
    """Put back what interrupted calls have left: when no call is under way. Warns of what cannot be put back."""
    for key in reversed(list(_owed)):
        try:
            _carry_out(key)
        except Exception as error:
            if interrupt_behind(error) is not None:
                raise
            warnings.warn(
                f"a call was interrupted, and what it had changed cannot be put back: {type(error).__name__}: "
                f"{str(error)[:300]}. Load its scene again.",
                RuntimeWarning,
                stacklevel=2,
            )


def _carry_out(key: object) -> None:
    try:
        _owed[key]()
    except Exception as error:
        if interrupt_behind(error) is None:
            _owed.pop(key, None)  # it would fail again
        raise
    _owed.pop(key, None)
