"""Another temporal filter, depth or boundary term in a built scene, for as long as a call takes."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from torchtransient.interfaces import is_time_resolved
from torchtransient.plugins.unfinished import afterwards


@contextmanager
def temporal_filter(name: str | None, integrator: Any, films: Iterable[Any]) -> Iterator[None]:
    """Every film that has a temporal filter uses ``name`` inside of the block, and what it had before after it.

    None changes nothing. The integrator's own setting would replace that of a film when a render begins, so it is
    taken out meanwhile. What was changed is put back in every case: also when a film refuses the filter, or when one
    of them cannot be put back.
    """
    with ExitStack() as restore:
        if name:
            targets = [film for film in films if is_time_resolved(film) and film.temporal_filter]
            if getattr(integrator, "temporal_filter", ""):
                _set(restore, integrator, "")
            for film in targets:
                _set(restore, film, name)
        yield


def _set(restore: ExitStack, target: Any, name: str) -> None:
    restore.enter_context(afterwards(functools.partial(setattr, target, "temporal_filter", target.temporal_filter)))
    target.temporal_filter = name


@contextmanager
def max_depth(depth: int | None, integrator: Any) -> Iterator[None]:
    """Give an integrator a ``max_depth`` inside of the block; None changes nothing."""
    if depth is None:
        yield
        return
    before = integrator.max_depth

    def put_back() -> None:
        if integrator.max_depth == depth:
            integrator.max_depth = before

    with afterwards(put_back):
        integrator.max_depth = depth
        yield


@contextmanager
def boundary_term(on: bool, spp: int | None, integrator: Any) -> Iterator[None]:
    """Leave the boundary term out of derivatives inside of the block, or give each of its passes ``spp`` samples per
    pixel; True and None change nothing. What it lacks is said by the caller.
    """
    with ExitStack() as restore:
        changes: dict[str, Any] = {"warns_of_edges": False}
        changes |= ({} if on else {"boundary": False}) | ({} if spp is None else {"spp_boundary": spp})
        for name, value in changes.items():
            if hasattr(integrator, name):
                put_back = functools.partial(setattr, integrator, name, getattr(integrator, name))
                restore.enter_context(afterwards(put_back))
                setattr(integrator, name, value)
        yield
