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
    key = object()
    try:
        _owed[key] = put_back
        yield
    finally:
        # It may be done already: where a traceback keeps this frame, it ends long after its call.
        _carry_out(key)


def make_good() -> list[Exception]:
    """Put back what interrupted calls have left, newest first; returns why some of it cannot be. To be called under the
    engine lock where no call is under way.
    """
    failed, handled = [], sys.exc_info()[1]
    try:
        for key in reversed(list(_owed)):
            try:
                _carry_out(key)
            except Exception as error:
                if interrupt_behind(error, handled) is not None:
                    raise
                failed.append(error)
        return failed
    finally:
        del handled  # its traceback may hold this frame


def _carry_out(key: object) -> None:
    put_back, handled = _owed.get(key), sys.exc_info()[1]
    if put_back is None:
        return
    try:
        put_back()
    except Exception as error:
        if interrupt_behind(error, handled) is None:
            _owed.pop(key, None)  # it would fail again
        raise
    finally:
        del handled
    _owed.pop(key, None)
