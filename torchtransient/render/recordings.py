"""Jobs that are traced once and launched ever after: the recorded calls of one built scene.

The first job of a kind is traced as it comes, and fills what the scene remembers; the second is recorded
(``dr.freeze``), and from the third on its kernels are launched. A recording is good for one structure: keys and film,
samples, plan, which values need derivatives, layout of the adjoint, numbers of the plugins, see
:func:`torchtransient.plugins.frozen_state.structure_below`; Dr.Jit tells types, sizes and flags of the arrays apart
within it. Recordings hold kernels alone, no results; they are bounded in number and go with the scene.
"""

from __future__ import annotations

import warnings
from collections import OrderedDict
from typing import Any

from torchtransient.interfaces import BACKWARD
from torchtransient.plugins.frozen_state import not_recordable

# Structures of one built scene and set of keys, and recordings of each of them for other sizes and flags of arrays.
MAX_STRUCTURES, MAX_RECORDINGS = 16, 8
# Calls in a row none of which could be launched, after which it is said.
IN_VAIN = 24

FIRST, RECORDED, LAUNCHED = "traced: the first call", "recorded", "launched"
SWITCHED_OFF = "traced: freeze=False"
SEVERAL = "traced: it takes several kernel launches, beside which tracing costs little"
PROGRESS = "traced: progress is reported"


class NotRecordedError(Exception):
    """A job could not be recorded, and is to be done again from its installation on; the text says why."""


class Recordings:
    """Those of one built scene, with the values of one set of keys."""

    def __init__(self) -> None:
        self._found: OrderedDict[Any, _Recording] = OrderedDict()
        self._in_vain = 0
        self._before: tuple[Any, ...] = ()
        self._warned = False

    def __len__(self) -> int:
        return len(self._found)

    def run(self, job: Any, progress: Any = None) -> str:
        """Carry out a prepared job and say how. Raises NotRecordedError."""
        refusal = f"traced: {job.refusal}" if job.refusal else None
        if len(job.launches) > 1:
            refusal = SEVERAL
        if progress is not None:
            refusal = PROGRESS
        if refusal is not None:
            job.integrator.run(job, progress=progress)
            return refusal
        job.film.clear()
        structure = job.structure()
        found = self._found.get(structure)
        if found is None:
            found = self._found[structure] = _Recording()
            while len(self._found) > MAX_STRUCTURES:
                self._found.popitem(last=False)
        self._found.move_to_end(structure)
        said = found.run(job)
        self._watch(said, structure)
        return said

    def _watch(self, said: str, structure: tuple[Any, ...]) -> None:
        self._in_vain = 0 if said == LAUNCHED else self._in_vain + 1
        if self._in_vain >= IN_VAIN and not self._warned:
            self._warned = True
            warnings.warn(
                f"the last {IN_VAIN} renders and derivatives of a scene were all traced anew, none could use a "
                f"recording: {_difference(self._before, structure)}. Tracing costs some milliseconds a call; keep "
                "spp, keys, shapes and which values need gradients the same from call to call, or switch recordings "
                "off with freeze=False.",
                stacklevel=2,
            )
        self._before = structure


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


class _Recording:
    """The jobs of one structure."""

    def __init__(self) -> None:
        self._job: Any = None
        self._frozen: Any = None
        self._calls = 0
        self._refusal: str | None = None

    def run(self, job: Any) -> str:
        self._calls += 1
        if self._calls == 1 or self._refusal is not None:
            job.integrator.run(job)
            return self._refusal or FIRST
        if self._frozen is None:
            self._frozen = self._made()
        before, self._job = self._frozen.n_recordings, job
        try:
            arrays = self._frozen(job.scene, job.arrays())
        except BaseException as error:
            self._frozen = None
            reason = not_recordable(error)
            if reason is None:
                raise
            self._refusal = f"traced: Dr.Jit cannot record it: {reason}"
            raise NotRecordedError(self._refusal) from error
        finally:
            self._job = None
        if job.kind != BACKWARD:
            job.film.hold(arrays)
        return RECORDED if self._frozen.n_recordings > before else LAUNCHED

    def _made(self) -> Any:
        import drjit as dr

        def call(scene: Any, arrays: list[Any]) -> list[Any]:
            # The scene and the arrays are those of the job, which the recording finds by being handed them.
            job = self._job
            job.integrator.run(job)
            return [] if job.kind == BACKWARD else job.film.taken()

        return dr.freeze(call, limit=MAX_RECORDINGS, warn_after=2**31 - 1)
