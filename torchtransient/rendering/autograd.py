"""A render as a function of torch: what :mod:`.derivatives` runs, and runs again for its derivatives.

All outputs are real: complex phasors are a view that torch differentiates itself. A derivative has samples of its own,
the job's (``grad_seed``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from torchtransient.rendering import engine
from torchtransient.rendering.derivatives import Asked, Tensors, run
from torchtransient.rendering.session import RenderJob


def rendered(job: RenderJob, seed: torch.Tensor | None, values: Sequence[torch.Tensor]) -> Tensors:
    """(steady, response) in the film's layout. ``seed``: None, or a number that is known only inside of a ``vmap``."""
    first = () if seed is None else (seed,)
    steady, response = run(_Render(job, len(first)), *first, *values)
    return steady, response


@dataclass(frozen=True)
class _Render:
    """A job as something to replay. ``seeds``: how many of the tensors are seeds, none or the first."""

    job: RenderJob
    seeds: int

    @property
    def what(self) -> str:
        return "a render"

    def primal(self, tensors: Sequence[torch.Tensor]) -> Tensors:
        """(steady, response)."""
        return engine.primal(self._seeded(tensors), tensors[self.seeds :])

    def pullback(self, asked: Asked, tensors: Sequence[torch.Tensor], cotangents: Sequence[torch.Tensor]) -> Tensors:
        """Gradients of the values that need one."""
        given = iter(cotangents)
        steady, response = (next(given) if is_given else None for is_given in asked.given)
        return tuple(engine.vjp(self._seeded(tensors, asked), tensors[self.seeds :], steady, response))

    def pushforward(self, asked: Asked, tensors: Sequence[torch.Tensor], tangents: Sequence[torch.Tensor]) -> Tensors:
        """Derivatives of (steady, response)."""
        return engine.jvp(self._seeded(tensors, asked), tensors[self.seeds :], tangents)

    def _seeded(self, tensors: Sequence[torch.Tensor], asked: Asked | None = None) -> RenderJob:
        job = self.job.seeded(tensors[0] if self.seeds else None)
        return job if asked is None else replace(job, needs=asked.needs[self.seeds :])
