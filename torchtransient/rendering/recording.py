"""Execution of an integrator's jobs on a built scene: traced, recorded, or launched from a recording.

The library's integrators do a job in two steps. ``prepared`` computes what needs Python and numbers: tables, seeds, the
division of the samples into launches. ``run`` is made of operations on arrays alone, and these are executed in one of
three ways, with the same numbers:

- *traced*: Python executes ``run`` and Dr.Jit notes its operations, which become a kernel. The kernel may come from a
  cache; tracing takes some milliseconds at every call all the same.
- *recorded*: the call is traced inside of ``dr.freeze``, which keeps the kernels that it launches.
- *launched*: the kept kernels run on the arrays of this call. Python executes nothing of ``run``.

The first call is traced, since it fills the caches of the scene; the second is recorded; from the third on calls are
launched. That holds for calls of one *structure*, everything but arrays that kernels depend on: keys and film, samples,
plan, values that need derivatives, layout of the adjoint, numbers of the plugins (see
:func:`torchtransient.plugins.frozen_state.state_below`). Within a structure Dr.Jit has a recording for each combination
of types, sizes and flags of the arrays.

A call that cannot be recorded is traced; ``RenderStats.recorded`` shows the reason, one of the texts below. Recordings
hold kernels and no results, are bounded in number, and go with the built scene.

The engine calls :func:`execute` for each group of films with the same values. :class:`Recordings` belong to a built
scene and a set of keys, and have a :class:`Recording` for each structure.
"""

from __future__ import annotations

import sys
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol

import torch

from torchtransient.errors import SceneError, level_of_user
from torchtransient.interfaces import BACKWARD, FORWARD, RENDER
from torchtransient.plugins.frozen_state import WAITS, NotComparableError, not_recordable
from torchtransient.rendering.job import Item

# Structures of one built scene and set of keys, and recordings of each of them for other sizes and flags of arrays.
MAX_STRUCTURES, MAX_RECORDINGS = 64, 8
# Calls in a row that were not launched, after which there is a warning; at least as many as there may be structures,
# which may take turns.
MOST_UNLAUNCHED = 24

# Ways of a call, and reasons why it was traced, as ``RenderStats.recorded`` shows them.
FIRST, RECORDED, LAUNCHED = "traced: the first call", "recorded", "launched"
SWITCHED_OFF = "traced: freeze=False"
SEVERAL = "traced: it takes several kernel launches, beside which tracing costs little"
LARGE = "traced: a large film of a batch, beside which tracing costs little"
NO_FREEZING = "traced: the flag KernelFreezing of Dr.Jit is off"
PROGRESS = "traced: progress is reported"
OWN_ENTRY = "traced: the integrator has a render of its own"

# Items of one recording at most, and values of a film from which on each item is a call of its own.
MOST_AT_ONCE, LARGE_FILM = 16, 2**18

# An item and its number in the call.
Numbered = tuple[int, Item]


def groups_of(session: Any) -> Iterator[list[Numbered]]:
    """Yield the items of a call, numbered, in groups that share their values and are executed together.

    Args:
        session: session of a job.

    A group holds the sensors of one entry of a batch if their films are small, else a single item.
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


class Results(Protocol):
    """Destination of a call's results, one class for each kind of job (``Images``, ``Gradients``, ``Tangents`` of the
    engine). ``kind``: kind of the job; ``calls``: how each item was executed, in order.
    """

    kind: str
    calls: list[str]

    def install(self, item: Item, group: Sequence[Numbered], /) -> None:
        """Write the values of an item's entry into the scene, attached for derivatives."""

    def adjoint(self, n: int, /) -> tuple[Any, Any]:
        """Return the adjoints of steady image and response of item ``n``, None for each one that is zero."""

    def progress(self, n: int, /) -> Callable[[float], None] | None:
        """Return a function of the share of item ``n`` that is done, None where no progress is reported."""

    def storage(self, film: Any, n: int, /) -> AbstractContextManager[bool]:
        """Lend the film of item ``n`` memory of the output for a block; its value is whether any was lent."""

    def collect(self, n: int, item: Item, /) -> None:
        """Take the results of item ``n`` from its film, or from the leaves of the installed values."""

    def finish(self) -> tuple[torch.Tensor, ...]:
        """Return the results of all items."""


def execute(session: Any, results: Results, group: Sequence[Numbered]) -> None:
    """Install the values of a group of items, execute the integrator's job of each, and collect the results.

    All jobs of the group are one recording; where there can be none, they are traced one by one. What became of each
    call is added to ``results.calls``.

    Args:
        session: the built scene in use (:class:`.engine.Session`).
        results: destination of the results, which installs the values too.
        group: numbered items with the same values, as :func:`groups_of` yields them.
    """
    n, item = group[0]
    with results.storage(session.film(item), n) as lent:
        method = _overridden_method(session.integrator, results.kind)
        if method is not None:
            reason: str | None = OWN_ENTRY
        else:
            reason = reason_to_trace(session, results.progress(n) is not None, lent)
        results.install(item, group)
        if reason is None:
            reason = _execute_by_recording(session, results, group)
        if reason is None:
            return
        results.calls += [reason] * len(group)
        for i, (n, item) in enumerate(group):
            if i > 0 and results.kind != RENDER:
                results.install(item, group)
            if method is None:
                session.integrator.run(_prepared(session, results, n, item), progress=results.progress(n))
            else:
                _call_method(method, session, results, n, item)
            results.collect(n, item)


def _execute_by_recording(session: Any, results: Results, group: Sequence[Numbered]) -> str | None:
    """Record the jobs of a group or launch their recording; return the reason to trace them instead, None if done.

    Where a reason is returned, nothing has been rendered and the values are installed.
    """
    jobs = [_prepared(session, results, n, item) for n, item in group]
    try:
        call, arrays = session.recordings.run(jobs)
    except NotRecordedError as error:
        raise_if_broken(session, error)
        del jobs
        if results.kind != RENDER:
            # Derivatives have used up the graph from the scene to the values.
            results.install(group[0][1], group)
        return str(error)
    results.calls += [call] * len(group)
    if results.kind == BACKWARD:
        # The gradients of all items have arrived at the same leaves.
        results.collect(*group[-1])
        return None
    for (n, item), job, of_film in zip(group, jobs, arrays, strict=True):
        job.film.adopt_storage(of_film)
        results.collect(n, item)
    return None


def _seed_and_samples(session: Any, results: Results, item: Item) -> tuple[int, int]:
    """Return seed and samples per pixel of the render of an item, or of its derivatives."""
    job = session.job
    return (item.seed, job.spp) if results.kind == RENDER else (item.grad_seed, job.spp_grad)


def _prepared(session: Any, results: Results, n: int, item: Item) -> Any:
    """Return the job of an item, ready for the integrator's ``run``."""
    seed, spp = _seed_and_samples(session, results, item)
    return session.integrator.prepared(session.scene, item.sensor, seed, spp, results.kind, results.adjoint(n))


def _overridden_method(integrator: Any, kind: str) -> Any:
    """Return the method of an integrator for a kind of job, where its class overrides that of the library's base."""
    name = {RENDER: "render", BACKWARD: "render_backward", FORWARD: "render_forward"}[kind]
    owner = next(base for base in type(integrator).__mro__ if name in vars(base))
    return None if owner.__module__ == "torchtransient.plugins.integrators.base" else getattr(integrator, name)


def _call_method(method: Any, session: Any, results: Results, n: int, item: Item) -> None:
    """Call an integrator's own method for a job, with the arguments of Mitsuba's."""
    kind = results.kind
    seed, spp = _seed_and_samples(session, results, item)
    common = {"sensor": item.sensor, "seed": seed, "spp": spp}
    if kind == RENDER:
        method(session.scene, **common, develop=False, progress_callback=results.progress(n))
    elif kind == BACKWARD:
        method(session.scene, session.params, results.adjoint(n), **common)
    else:
        method(session.scene, session.params, **common, develop=False)


def reason_to_trace(session: Any, progress: bool = False, lent: bool = False) -> str | None:
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


def raise_if_broken(session: Any, error: NotRecordedError) -> None:
    """Raise ``SceneError``, and forget the built scene, where a recording that failed has left it broken.

    Args:
        session: session of the job.
        error: the recording's error.

    Raises:
        SceneError: if the scene is broken.
    """
    if error.broken:
        session.job.scene.drop(session.job.options)
        raise SceneError(
            "a plugin written in Python changed the type of an attribute while its calls were recorded, for instance "
            "from None to an array. Make it in parameters_changed, or take can_be_recorded = True out of its class. "
            f"{error}"
        ) from error


class NotRecordedError(Exception):
    """Error of a call that cannot be recorded; its text is the reason. The call is traced instead.

    Attributes:
        broken: recording has changed the scene, which has to be built anew.
    """

    broken = False


class Recordings:
    """Recordings of one built scene and one set of keys, by structure; ``len`` is the number of structures.

    Warns once of calls that are traced again and again.
    """

    def __init__(self) -> None:
        # The last one used is the last entry.
        self._by_structure: OrderedDict[Any, Recording] = OrderedDict()
        # Calls since the last launch.
        self._unlaunched = 0
        # The last structure of each kind of job.
        self._last_structures: dict[str, tuple[Any, ...]] = {}
        self._warned = False

    def __len__(self) -> int:
        return len(self._by_structure)

    def run(self, jobs: Sequence[Any]) -> tuple[str, list[list[Any]]]:
        """Execute prepared jobs of one scene with one set of values: record them, or launch their recording.

        Args:
            jobs: :class:`~torchtransient.plugins.integrators.job.Prepared` jobs.

        Returns:
            ``RECORDED`` or ``LAUNCHED``, and the arrays of each film for its ``adopt_storage``; none in reverse mode.

        Raises:
            NotRecordedError: for jobs to be traced: the first ones of a structure, and those that cannot be recorded.
                Nothing has been rendered then.
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
        recording = self._by_structure.get(structure)
        if recording is None:
            recording = self._by_structure[structure] = Recording()
            while len(self._by_structure) > MAX_STRUCTURES:
                self._by_structure.popitem(last=False)
        self._by_structure.move_to_end(structure)
        launched = False
        try:
            results, launched = recording.run(jobs, arrays)
        finally:
            self._count_call(launched, jobs[0].kind, structure)
        return LAUNCHED if launched else RECORDED, results

    def _count_call(self, launched: bool, kind: str, structure: tuple[Any, ...]) -> None:
        """Count calls since the last launch, and warn once there are too many."""
        self._unlaunched = 0 if launched else self._unlaunched + 1
        # Calls that come again are launched from the third time on: of many kinds that take turns, each needs two.
        first = 2 * sum(recording.calls > 1 for recording in self._by_structure.values())
        if self._unlaunched >= max(MOST_UNLAUNCHED, MAX_STRUCTURES) + first and not self._warned:
            self._warned = True
            warnings.warn(
                f"the last {self._unlaunched} renders and derivatives of a scene were all traced anew, none could use "
                f"a recording: {self._reason(kind, structure)}. Tracing costs some milliseconds a call; keep spp, "
                "keys, shapes and which values need gradients the same from call to call, or switch recordings off "
                "with freeze=False.",
                stacklevel=level_of_user(),
            )
        self._last_structures[kind] = structure

    def _reason(self, kind: str, structure: tuple[Any, ...]) -> str:
        """Return why calls of a kind are not launched, in words."""
        recording = self._by_structure[structure]
        if recording.waits or recording.refusal not in (None, FIRST):
            return recording.waits or str(recording.refusal)
        difference = _difference(self._last_structures.get(kind, ()), structure)
        if len(self._by_structure) < MAX_STRUCTURES:
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
    """Recording of the calls of one structure: a function under ``dr.freeze``.

    Attributes:
        refusal: reason why calls are not recorded, ``FIRST`` before the first one, None where they are.
        waits: reason why the last call was traced where the next one may be recorded, else empty.
        calls: number of calls.
    """

    def __init__(self) -> None:
        # Jobs of the call under way: the frozen function has no other way to them.
        self._jobs: Sequence[Any] = ()
        self._frozen: Any = None
        # The frozen function has been traced in the call under way.
        self._traced = False
        self.refusal: str | None = FIRST
        self.waits = ""
        self.calls = 0

    def run(self, jobs: Sequence[Any], arrays: list[Any]) -> tuple[list[list[Any]], bool]:
        """Record a call, or launch the recording.

        Args:
            jobs: prepared jobs.
            arrays: all arrays that their kernels read.

        Returns:
            The arrays of each film, and True for kernels that were launched without tracing.

        Raises:
            NotRecordedError: for a call to be traced.
        """
        self.calls += 1
        if self.refusal is not None:
            refusal = self.refusal
            if refusal == FIRST:
                self.refusal = None
            raise NotRecordedError(refusal)
        if self._frozen is None:
            self._frozen = self._freeze()
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

    def _freeze(self) -> Any:
        """Return the function that runs the jobs of a call, under ``dr.freeze``."""
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
