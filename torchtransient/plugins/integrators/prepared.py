"""A job of an integrator whose look-ups, checks and tables are made: what is left is a function of arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr

from torchtransient.plugins.frozen_state import state_below


@dataclass
class Prepared:
    """One render or one derivative of it. Made outside of recorded code by
    :meth:`~.base.TransientIntegrator.prepared`, carried out by :meth:`~.base.TransientIntegrator.run`.

    ``kind``: one of :data:`~torchtransient.interfaces.JOBS`. ``launches``: the :class:`.launch.Pass` of its paths;
    ``seed`` (``UInt32``) of the job; ``samples``: the largest number of a pixel. ``incoming``: the film's adjoint in
    reverse mode. ``beside``: what derivatives have beside paths. ``plugins``: those of the scene that are
    written in Python, whose numbers become part of the kernels. ``refusal``: why it cannot be recorded, None where it
    can.
    """

    kind: str
    integrator: Any
    scene: Any
    sensor: Any
    film: Any
    world: Any
    launches: list[Any]
    seed: Any
    samples: int
    incoming: Any = None
    beside: list[Any] = field(default_factory=list)
    plugins: list[Any] = field(default_factory=list)
    refusal: str | None = None

    def tables(self) -> list[Any]:
        """What has been computed of the scene's parameters: attached where they are."""
        tables = self.world.tables() + [table for part in self.beside for table in part.tables()]
        with dr.resume_grad():
            return [table for table in tables if dr.grad_enabled(table)]


def state_of(jobs: list[Prepared]) -> tuple[tuple[Any, ...], list[Any]]:
    """(structure, arrays): what the traced kernels of jobs depend on beside arrays, and the arrays and structures of
    arrays that they read beside the scene's parameters.
    """
    held = [
        [job.kind, job.integrator, job.film, job.world, job.launches, job.seed, job.samples, job.incoming, job.beside]
        for job in jobs
    ]
    return state_below([held, [vars(plugin) for plugin in jobs[0].plugins]])
