"""Jobs that are traced once and launched ever after: the recorded calls of one built scene.

The first call of a kind is traced as it comes, and fills what the scene remembers; the second is recorded
(``dr.freeze``), and from the third on its kernels are launched. A recording is good for one structure: keys and film,
samples, plan, which values need derivatives, layout of the adjoint, numbers of the plugins, see
:func:`torchtransient.plugins.frozen_state.state_below`; Dr.Jit tells types, sizes and flags of the arrays apart within
it. Recordings hold kernels alone, no results; they are bounded in number and go with the scene.
"""

from __future__ import annotations

import sys
import warnings
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

from torchtransient.errors import level_of_user
from torchtransient.interfaces import BACKWARD
from torchtransient.plugins.frozen_state import WAITS, NotComparableError, not_recordable

# Structures of one built scene and set of keys, and recordings of each of them for other sizes and flags of arrays.
MAX_STRUCTURES, MAX_RECORDINGS = 64, 8
# Calls in a row none of which could be launched, after which it is said; as many kinds as are kept may take turns.
IN_VAIN = 24

FIRST, RECORDED, LAUNCHED = "traced: the first call", "recorded", "launched"
SWITCHED_OFF = "traced: freeze=False"
SEVERAL = "traced: it takes several kernel launches, beside which tracing costs little"
LARGE = "traced: a large film of a batch, beside which tracing costs little"
NO_FREEZING = "traced: the flag KernelFreezing of Dr.Jit is off"
PROGRESS = "traced: progress is reported"
OWN_ENTRY = "traced: the integrator has a render of its own"


class NotRecordedError(Exception):
    """A call could not be recorded, and is to be traced from its installation on; the text says why. ``broken``: the
    scene is not what it was.
    """

    broken = False


class Recordings:
    """Those of one built scene, with the values of one set of keys."""

    def __init__(self) -> None:
        self._found: OrderedDict[Any, Recording] = OrderedDict()
        self._in_vain = 0
        # The last structure of each kind of job.
        self._before: dict[str, tuple[Any, ...]] = {}
        self._warned = False

    def __len__(self) -> int:
        return len(self._found)

    def run(self, jobs: Sequence[Any]) -> tuple[str, list[list[Any]]]:
        """Carry out prepared jobs (:class:`~torchtransient.plugins.integrators.job.Prepared`) of one scene with
        one set of values: how, and what each film has taken (:meth:`~.FilmInterface.taken`), nothing in reverse mode.
        Raises NotRecordedError where they are to be traced; nothing has been rendered then.
        """
        import drjit as dr

        from torchtransient.plugins.kernel_arrays import null_pointers

        for job in jobs:
            if job.refusal is not None or len(job.launches) > 1:
                raise NotRecordedError(SEVERAL if job.refusal is None else f"traced: {job.refusal}")
            job.film.clear()
        try:
            structure, arrays = jobs[0].integrator.state_of(jobs)
        except NotComparableError as error:
            raise NotRecordedError(f"traced: whether a call is like the last one cannot be told of {error}") from None
        # By a pointer of each kind Dr.Jit finds all plugins of that kind, which it has in every kernel, and with them
        # the arrays of those that are of no scene.
        arrays = [*arrays, *null_pointers()]
        # A recording holds memory for each thread's share of a sum.
        structure = (("threads", dr.thread_count()), *structure)
        found = self._found.get(structure)
        if found is None:
            found = self._found[structure] = Recording()
            while len(self._found) > MAX_STRUCTURES:
                self._found.popitem(last=False)
        self._found.move_to_end(structure)
        launched = False
        try:
            results, launched = found.run(jobs, arrays)
        finally:
            self._watch(launched, jobs[0].kind, structure)
        return LAUNCHED if launched else RECORDED, results

    def _watch(self, launched: bool, kind: str, structure: tuple[Any, ...]) -> None:
        self._in_vain = 0 if launched else self._in_vain + 1
        # Calls that come again are launched from the third time on: of many kinds that take turns, each is owed two.
        owed = 2 * sum(found.calls > 1 for found in self._found.values())
        if self._in_vain >= max(IN_VAIN, MAX_STRUCTURES) + owed and not self._warned:
            self._warned = True
            warnings.warn(
                f"the last {self._in_vain} renders and derivatives of a scene were all traced anew, none could use a "
                f"recording: {self._reason(kind, structure)}. Tracing costs some milliseconds a call; keep spp, keys, "
                "shapes and which values need gradients the same from call to call, or switch recordings off with "
                "freeze=False.",
                stacklevel=level_of_user(),
            )
        self._before[kind] = structure

    def _reason(self, kind: str, structure: tuple[Any, ...]) -> str:
        found = self._found[structure]
        if found.waits or found.refusal not in (None, FIRST):
            return found.waits or str(found.refusal)
        difference = _difference(self._before.get(kind, ()), structure)
        if len(self._found) < MAX_STRUCTURES:
            return difference
        return f"more than {MAX_STRUCTURES} kinds of calls take turns, and {difference}"


def _difference(before: tuple[Any, ...], now: tuple[Any, ...]) -> str:
    """Where two structures part."""
    for a, b in zip(before, now, strict=False):
        if a != b:
            return f"what they depend on changed from {_short(a)} to {_short(b)}"
    if len(before) != len(now):
        return f"what they depend on had {len(before)} parts and has {len(now)}"
    return "types, sizes or flags of the arrays change from call to call"


def _short(value: Any) -> str:
    said = repr(value[1] if isinstance(value, tuple) and len(value) == 2 else value)
    return said if len(said) <= 80 else said[:77] + "..."


class Recording:
    """The calls of one structure."""

    def __init__(self) -> None:
        self._jobs: Sequence[Any] = ()
        self._frozen: Any = None
        self._traced = False
        self.refusal: str | None = FIRST
        # Why the last call was traced that may be recorded another time.
        self.waits = ""
        self.calls = 0

    def run(self, jobs: Sequence[Any], arrays: list[Any]) -> tuple[list[list[Any]], bool]:
        """(what the films have taken, whether kernels were launched without tracing). Raises NotRecordedError."""
        self.calls += 1
        if self.refusal is not None:
            refusal = self.refusal
            if refusal == FIRST:
                self.refusal = None
            raise NotRecordedError(refusal)
        if self._frozen is None:
            self._frozen = self._made()
        before, self._jobs, self._traced = sys.exc_info()[1], jobs, False
        try:
            results = self._frozen(jobs[0].scene, arrays)
            self.waits = ""
            return results, not self._traced
        except BaseException as error:
            self._frozen = None
            # What was to be written to its arrays is forgotten: they would wait for ever, and with them the calls of
            # every scene, since Dr.Jit finds all sensors.
            for job in jobs:
                job.film.clear()
            reason = not_recordable(error, before)
            if isinstance(reason, BaseException):
                below = error.__cause__ or error.__context__
                if reason is error or below is None:
                    raise
            else:
                refusal = f"traced: Dr.Jit cannot record it: {reason}"
                self.refusal, self.waits = (None, refusal) if reason == WAITS else (refusal, "")
                refused = NotRecordedError(refusal)
                refused.broken = "changes its type" in reason
                raise refused from error
        finally:
            self._jobs = ()
        # As a call that is traced raises it: without the recorder's own error, and with its causes as they are, which
        # raising it while that one is handled would change.
        try:
            raise below
        finally:
            del below

    def _made(self) -> Any:
        import drjit as dr

        def call(scene: Any, arrays: list[Any]) -> list[list[Any]]:
            # Scene and arrays are those of the jobs; a recording finds them by being handed them.
            self._traced = True
            results = []
            for job in self._jobs:
                job.integrator.run(job)
                results.append([] if job.kind == BACKWARD else job.film.taken())
            return results

        return dr.freeze(call, limit=MAX_RECORDINGS, warn_after=2**31 - 1)
