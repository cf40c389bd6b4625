"""Another temporal filter on the films of a scene, for as long as a call takes."""

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
