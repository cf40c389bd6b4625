"""``tt.threads``: the numbers of threads of torch and of Dr.Jit, set together."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import TracebackType

import torch

from torchtransient.checks import as_whole, shown
from torchtransient.errors import DeviceError, UnitError, VariantError
from torchtransient.plugins.drjit_pool import engine_lock, resize_pool, set_drjit_threads
from torchtransient.plugins.guards import interrupts_wait
from torchtransient.scene.variant import at_work

MOST_THREADS = 1024


@dataclass(frozen=True)
class Threads:
    """Numbers of threads in use, the calling one included. Returned by :func:`threads`.

    As a context manager it puts back the counts from before its call of :func:`threads`.

    Attributes:
        torch: threads of an operation of torch.
        drjit: threads of a kernel of Dr.Jit.
    """

    torch: int
    drjit: int
    _before: tuple[int, int] = field(default=(0, 0), repr=False, compare=False)

    def __enter__(self) -> Threads:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with at_work(), interrupts_wait():
            _set(*self._before)


def threads(n: int | None = None) -> Threads:
    """Set the number of threads that torch and Dr.Jit, which has a pool of its own, compute with.

    The result is a context manager that puts back the counts from before::

        with tt.threads(1):
            out = renderer(seed=0)

    Pools grow and shrink at any time; a call waits until renders of other threads are done. Numbers of a render depend
    on the count through the order of sums alone.

    Args:
        n: number of threads, 1 to 1024, the calling one included; 1 leaves no other thread at work. More threads than
            cores take turns, which is slower. None changes nothing.

    Returns:
        The counts in use.

    Raises:
        UnitError: if ``n`` is no such number.
        DeviceError: if the system or torch refuses so many threads; the counts stay as they were.
        VariantError: in a process that was forked from one whose threads of Dr.Jit were at work.

    Dr.Jit's count is the process's. Torch's is that of the calling thread, and the one that threads begin with which
    compute for the first time later; those that have computed before keep theirs. Neither reaches spawned processes:
    call it there. Only CPU variants compute with Dr.Jit's threads. No variant is needed, and none is activated.

    Mitsuba hands OpenEXR files to Dr.Jit's threads and waits for them, for ever where there is but one. Files that
    this library loads get a second thread meanwhile; for Mitsuba's own calls on such files (``mi.Bitmap``,
    ``mi.load_dict``) write ``with tt.threads(2):`` around them.
    """
    n = _checked(n)
    # What an interrupted call has left may be a number of threads.
    with engine_lock if n is None else at_work():
        before = _counts()
        if n is not None:
            with interrupts_wait():
                _set(n, n)
        return Threads(*_counts(), before)


def _checked(n: int | None) -> int | None:
    number = as_whole(n)
    if n is not None and (number is None or not 1 <= number <= MOST_THREADS):
        raise UnitError(f"threads: expected a whole number from 1 to {MOST_THREADS}, or None to ask, got {shown(n)}.")
    return number


def _counts() -> tuple[int, int]:
    import drjit as dr

    return torch.get_num_threads(), dr.thread_count()


def _set(for_torch: int, for_drjit: int) -> None:
    """Set both counts, or neither."""
    before = _counts()
    if (for_torch, for_drjit) == before:
        return
    try:
        if for_drjit != before[1]:
            set_drjit_threads(for_drjit)
        if for_torch != before[0]:
            torch.set_num_threads(for_torch)
    except RuntimeError as error:
        if isinstance(error, VariantError):
            raise
        _put_back(before)
        raise DeviceError(f"threads: {for_drjit} threads cannot be had: {error}; it stays at {before[1]}.") from error
    if _counts() != (for_torch, for_drjit):
        found = _counts()
        _put_back(before)
        raise DeviceError(
            f"threads: asked for {for_torch} of torch and {for_drjit} of Dr.Jit, which took {found[0]} and {found[1]}; "
            f"it stays at {before[0]} and {before[1]}."
        )


def _put_back(before: tuple[int, int]) -> None:
    resize_pool(before[1])
    torch.set_num_threads(before[0])
