"""Changes that a call puts back at its end, or, where an interrupt prevents that, the next call at its beginning.

A call is what runs inside of ``rendering.variant.at_work``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from torchtransient.plugins.interrupted import interrupt_behind

# What calls have changed and still have to put back, oldest first. Entries hold their scenes: one that was interrupted
# lives until the next call.
_owed: dict[object, Callable[[], object]] = {}


@contextmanager
def afterwards(put_back: Callable[[], object]) -> Iterator[None]:
    """Call ``put_back`` after the block. Where an interrupt prevents that or cuts it off, the outermost call does it at
    its end, or the next one at its beginning (:func:`make_good`). To be used under the engine lock.

    So ``put_back`` may run twice, and before anything was changed: running it again completes a first run that was cut
    off. Another variant may be active by then, and it must not overwrite what users have set meanwhile, outside of
    calls: it looks first whether it finds what the block had set.
    """
    key, failed = object(), None
    try:
        _owed[key] = put_back
        yield
    finally:
        try:
            # It may be done already: where a traceback keeps this frame, it ends long after its call.
            failed = _carry_out(key)
            if failed is not None:
                raise failed
        finally:
            del failed  # its traceback holds this frame


def make_good() -> list[Exception]:
    """Put back what interrupted calls have left, newest first; returns why some of it cannot be. To be called under the
    engine lock where no call is under way.
    """
    return [failed for key in reversed(list(_owed)) if (failed := _carry_out(key)) is not None]


def _carry_out(key: object) -> Exception | None:
    """Put one thing back; returns why it cannot be."""
    put_back, handled = _owed.get(key), sys.exc_info()[1]
    if put_back is None:
        return None
    try:
        put_back()
    except Exception as error:
        if interrupt_behind(error, handled) is not None:
            raise
        # Handlers of signals may raise any exception: what one of them has cut off succeeds now.
        try:
            put_back()
        except Exception as again:
            if interrupt_behind(again, error) is not None:
                raise
            _owed.pop(key, None)
            return error
        _owed.pop(key, None)
        raise
    finally:
        del handled
    _owed.pop(key, None)
    return None
