"""Recorded or traced: how the jobs of an integrator are executed on a built scene.

The first call of a kind is traced as it comes, and fills the caches of the scene; the second is recorded
(``dr.freeze``), and from the third on its kernels are launched. A recording is good for one structure: keys and film,
samples, plan, values that need derivatives, layout of the adjoint, numbers of the plugins, see
:func:`torchtransient.plugins.frozen_state.state_below`; Dr.Jit tells types, sizes and flags of the arrays apart within
it. Recordings hold kernels alone, no results; they are bounded in number and go with the scene.
"""

from __future__ import annotations

import sys
import warnings
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from typing import Any

from torchtransient.errors import SceneError, level_of_user
from torchtransient.interfaces import BACKWARD, FORWARD, RENDER
from torchtransient.plugins.frozen_state import WAITS, NotComparableError, not_recordable
from torchtransient.rendering.job import Item

# Structures of one built scene and set of keys, and recordings of each of them for other sizes and flags of arrays.
MAX_STRUCTURES, MAX_RECORDINGS = 64, 8
# Calls in a row that could not be launched, after which there is a warning; as many kinds as are kept may take turns.
IN_VAIN = 24

FIRST, RECORDED, LAUNCHED = "traced: the first call", "recorded", "launched"
SWITCHED_OFF = "traced: freeze=False"
SEVERAL = "traced: it takes several kernel launches, beside which tracing costs little"
LARGE = "traced: a large film of a batch, beside which tracing costs little"
NO_FREEZING = "traced: the flag KernelFreezing of Dr.Jit is off"
PROGRESS = "traced: progress is reported"
OWN_ENTRY = "traced: the integrator has a render of its own"


# Items of one recording at most, and values of a film from which on each item is a call of its own.
MOST_AT_ONCE, LARGE_FILM = 16, 2**18

Numbered = tuple[int, Item]


def groups_of(session: Any) -> Iterator[list[Numbered]]:
    """Yield the items of a call, numbered, in groups that share their values and are one call of kernels.

    A group holds the sensors of an entry of a batch where their films are small.
    """
    group: list[Numbered] = []
    for n, item in enumerate(session.job.items):
        most = 1 if session.entries(item) >= LARGE_FILM else MOST_AT_ONCE
        if group and (len(group) >= most or item.entry != group[-1][1].entry):
            yield group
            group = []
        group.append((n, item))
    if group:
        yield group


def execute(session: Any, results: Any, group: Sequence[Numbered]) -> None:
    """Execute the jobs of items with the same values: launched, recorded, or traced.

    Args:
        session: the built scene in use (:class:`.engine.Session`).
        results: receives the results; installs values and has adjoints (:class:`.engine.Images` and its siblings).
        group: the items.
    """
    job, integrator, kind = session.job, session.integrator, results.kind

    def prepared(n: int, item: Item) -> Any:
        seed, spp = (item.seed, job.spp) if kind == RENDER else (item.grad_seed, job.spp_grad)
        return integrator.prepared(session.scene, item.sensor, seed, spp, kind, results.adjoint(n))

    with results.storage(session.film(group[0][1]), group[0][0]) as lent:
        own = _entry_of_its_own(integrator, kind)
        reason = OWN_ENTRY if own is not None else refusal(session, results.progress(group[0][0]) is not None, lent)
        results.install(group[0][1], group)
        if reason is None:
            jobs = [prepared(n, item) for n, item in group]
            try:
                call, arrays = session.recordings.run(jobs)
            except NotRecordedError as error:
                check_whole(session, error)
                reason = str(error)
                del jobs
                if kind != RENDER:
                    # Derivatives have used up the graph from the scene to the values.
                    results.install(group[0][1], group)
            else:
                results.calls += [call] * len(group)
                if kind == BACKWARD:
                    results.collect(*group[-1])
                    return
                for (n, item), each, of_film in zip(group, jobs, arrays, strict=True):
                    each.film.adopt_storage(of_film)
                    results.collect(n, item)
                return
        results.calls += [reason] * len(group)
        for i, (n, item) in enumerate(group):
            if i > 0 and kind != RENDER:
                results.install(item, group)
            if own is None:
                integrator.run(prepared(n, item), progress=results.progress(n))
            else:
                _call(own, session, results, n, item)
            results.collect(n, item)


def _entry_of_its_own(integrator: Any, kind: str) -> Any:
    """Return the method of an integrator for a kind of job, where its class overrides that of the library's base."""
    name = {RENDER: "render", BACKWARD: "render_backward", FORWARD: "render_forward"}[kind]
    owner = next(base for base in type(integrator).__mro__ if name in vars(base))
    return None if owner.__module__ == "torchtransient.plugins.integrators.base" else getattr(integrator, name)


def _call(entry: Any, session: Any, results: Any, n: int, item: Item) -> None:
    """Call an integrator's own method for a job."""
    job, kind = session.job, results.kind
    seed, spp = (item.seed, job.spp) if kind == RENDER else (item.grad_seed, job.spp_grad)
    common = {"sensor": item.sensor, "seed": seed, "spp": spp}
    if kind == RENDER:
        entry(session.scene, **common, develop=False, progress_callback=results.progress(n))
    elif kind == BACKWARD:
        entry(session.scene, session.params, results.adjoint(n), **common)
    else:
        entry(session.scene, session.params, **common, develop=False)


def refusal(session: Any, progress: bool = False, lent: bool = False) -> str | None:
    """Return the reason why a call cannot be recorded, None where it can.

    Args:
        session: the built scene in use.
        progress: the call reports its progress.
        lent: its film writes to memory of a batch, of which a recording would have a copy.
    """
    import drjit as dr

    if not session.job.freeze:
        return SWITCHED_OFF
    if not dr.flag(dr.JitFlag.KernelFreezing):
        return NO_FREEZING
    for slot in session.slots.slots:
        if slot.is_number_of_kernels():
            return f"traced: numbers of {slot.key} become part of the kernels"
    return PROGRESS if progress else LARGE if lent else None


def check_whole(session: Any, error: NotRecordedError) -> None:
    """Raise ``SceneError``, and forget the built scene, where a recording that failed has left it broken."""
    if error.broken:
        session.job.scene.drop(session.job.options)
        raise SceneError(
            "a plugin written in Python changed the type of an attribute while its calls were recorded, for instance "
            "from None to an array. Make it in parameters_changed, or take can_be_recorded = True out of its class. "
            f"{error}"
        ) from error


class NotRecordedError(Exception):
    """A call could not be recorded, and is to be traced from its installation on; the text says why. ``broken``: the
    scene is not what it was.
    """

    broken = False


class Recordings:
    """Recorded calls of one built scene, with the values of one set of keys."""

    def __init__(self) -> None:
        self._found: OrderedDict[Any, Recording] = OrderedDict()
        self._in_vain = 0
        # The last structure of each kind of job.
        self._before: dict[str, tuple[Any, ...]] = {}
        self._warned = False

    def __len__(self) -> int:
        return len(self._found)

    def run(self, jobs: Sequence[Any]) -> tuple[str, list[list[Any]]]:
        """Execute prepared jobs of one scene with one set of values: recorded, or launched from a recording.

        Args:
            jobs: :class:`~torchtransient.plugins.integrators.job.Prepared` jobs.

        Returns:
            ``RECORDED`` or ``LAUNCHED``, and the arrays of each film for its ``hold``; none in reverse mode.

        Raises:
            NotRecordedError: where they are to be traced; nothing has been rendered then.
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
        # Calls that come again are launched from the third time on: of many kinds that take turns, each needs two.
        first = 2 * sum(found.calls > 1 for found in self._found.values())
        if self._in_vain >= max(IN_VAIN, MAX_STRUCTURES) + first and not self._warned:
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
    """Return where two structures part, in words."""
    for a, b in zip(before, now, strict=False):
        if a != b:
            return f"what they depend on changed from {_short(a)} to {_short(b)}"
    if len(before) != len(now):
        return f"what they depend on had {len(before)} parts and has {len(now)}"
    return "types, sizes or flags of the arrays change from call to call"


def _short(value: Any) -> str:
    text = repr(value[1] if isinstance(value, tuple) and len(value) == 2 else value)
    return text if len(text) <= 80 else text[:77] + "..."


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
                results.append([] if job.kind == BACKWARD else job.film.release_storage())
            return results

        return dr.freeze(call, limit=MAX_RECORDINGS, warn_after=2**31 - 1)
