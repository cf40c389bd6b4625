"""Jobs of an integrator on a built scene: recorded where that is possible, traced otherwise."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from torchtransient.errors import SceneError
from torchtransient.interfaces import BACKWARD, FORWARD, RENDER
from torchtransient.rendering.recordings import LARGE, NO_FREEZING, OWN_ENTRY, PROGRESS, SWITCHED_OFF, NotRecordedError
from torchtransient.rendering.seeds import Item
from torchtransient.rendering.session import Session

# Items of one recording at most, and values of a film from which on each item is a call of its own.
MOST_AT_ONCE, LARGE_FILM = 16, 2**18

Numbered = tuple[int, Item]


def groups_of(session: Session) -> Iterator[list[Numbered]]:
    """The items of a call, numbered, in groups that have the same values and are one call of kernels: the sensors of an
    entry of a batch, where their films are small.
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


def carry_out(
    session: Session,
    kind: str,
    group: Sequence[Numbered],
    install: Callable[[Item], None],
    collect: Callable[[int, Item], None],
    grad_in: Callable[[int], tuple[Any, Any]] = lambda n: (None, None),
    report: Callable[[int], Callable[[float], None] | None] = lambda n: None,
    lent: bool = False,
) -> list[str]:
    """Carry out jobs of a ``kind`` for items with the same values; says how, item by item.

    ``install``: brings the values of an item to the scene, attached where derivatives are asked for; ``collect``: takes
    what has come of an item: its film's result, or in reverse mode the gradients that have arrived, of several items
    together. ``grad_in``: the adjoint of item n; ``report``: who is told of its progress. ``lent``: the film writes to
    memory that is not its own.
    """
    job, integrator = session.job, session.integrator

    def prepared(n: int, item: Item) -> Any:
        seed, spp = (item.seed, job.spp) if kind == RENDER else (item.grad_seed, job.spp_grad)
        return integrator.prepared(session.scene, item.sensor, seed, spp, kind, grad_in(n))

    own = _entry_of_its_own(integrator, kind)
    reason = OWN_ENTRY if own is not None else refusal(session, group, report, lent)
    install(group[0][1])
    if reason is None:
        jobs = [prepared(n, item) for n, item in group]
        try:
            said, results = session.recordings.run(jobs)
        except NotRecordedError as error:
            check_whole(session, error)
            reason = str(error)
            del jobs
            if kind != RENDER:
                # Derivatives have used up what leads from the scene to the values.
                install(group[0][1])
        else:
            for (n, item), prepared_job, arrays in zip(group, jobs, results, strict=True):
                if kind != BACKWARD:
                    prepared_job.film.hold(arrays)
                    collect(n, item)
            if kind == BACKWARD:
                collect(*group[-1])
            return [said] * len(group)
    for i, (n, item) in enumerate(group):
        if i > 0 and kind != RENDER:
            install(item)
        if own is None:
            integrator.run(prepared(n, item), progress=report(n))
        else:
            _call(own, session, kind, item, grad_in(n), report(n))
        collect(n, item)
    return [reason] * len(group)


def _entry_of_its_own(integrator: Any, kind: str) -> Any:
    """The method of an integrator for a kind of job, where its class has another one than the library's base."""
    name = {RENDER: "render", BACKWARD: "render_backward", FORWARD: "render_forward"}[kind]
    owner = next(base for base in type(integrator).__mro__ if name in vars(base))
    return None if owner.__module__ == "torchtransient.plugins.integrators.base" else getattr(integrator, name)


def check_whole(session: Session, error: NotRecordedError) -> None:
    """Raise ``SceneError``, and forget the built scene, where a recording that failed has left it broken."""
    if error.broken:
        session.job.scene.drop(session.job.options)
        raise SceneError(
            "a plugin written in Python changed the type of an attribute while its calls were recorded, for instance "
            "from None to an array. Make it in parameters_changed, or take can_be_recorded = True out of its class. "
            f"{error}"
        ) from error


def refusal(
    session: Session,
    group: Sequence[Numbered],
    report: Callable[[int], Callable[[float], None] | None] = lambda n: None,
    lent: bool = False,
) -> str | None:
    """Why the call of a group cannot be recorded, None where it can."""
    import drjit as dr

    if not session.job.freeze:
        return SWITCHED_OFF
    if not dr.flag(dr.JitFlag.KernelFreezing):
        return NO_FREEZING
    for slot in session.slots.slots:
        if slot.is_number_of_kernels():
            return f"traced: numbers of {slot.key} become part of the kernels"
    if report(group[0][0]) is not None:
        return PROGRESS
    # A recording would write to a copy of it.
    return LARGE if lent else None


def _call(entry: Any, session: Session, kind: str, item: Item, grad_in: tuple[Any, Any], report: Any) -> None:
    """A job by a method of the integrator's own."""
    job = session.job
    seed, spp = (item.seed, job.spp) if kind == RENDER else (item.grad_seed, job.spp_grad)
    common = {"sensor": item.sensor, "seed": seed, "spp": spp}
    if kind == RENDER:
        entry(session.scene, **common, develop=False, progress_callback=report)
    elif kind == BACKWARD:
        entry(session.scene, session.params, grad_in, **common)
    else:
        entry(session.scene, session.params, **common, develop=False)
