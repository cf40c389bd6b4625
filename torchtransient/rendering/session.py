"""A built scene in use: values are installed for one run under one lock, and the described ones put back before
anybody else looks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import torch

from torchtransient._collection import no_collection
from torchtransient.checks import one_line
from torchtransient.errors import SceneError, TorchTransientError, VariantError
from torchtransient.plugins.parameters import lifted
from torchtransient.plugins.unfinished import afterwards
from torchtransient.rendering.interrupts import quiet
from torchtransient.rendering.kernel_errors import named_errors
from torchtransient.rendering.overrides import boundary_term, max_depth, temporal_filter
from torchtransient.rendering.recordings import Recordings
from torchtransient.rendering.seeds import Item, Seeding
from torchtransient.rendering.values import detached, put_back, values_of
from torchtransient.rendering.variant import active_variant, in_variant
from torchtransient.scene.edits import BuildOptions
from torchtransient.scene.physics import PhysicsWatch
from torchtransient.scene.values import own_array

if TYPE_CHECKING:
    from torchtransient.scene.load import Scene
    from torchtransient.scene.pilot import DepthBound
    from torchtransient.scene.values import SlotTable


@dataclass(frozen=True)
class RunLog:
    """What one primal run reports, item by item. ``energy_before``, ``energy_after``: outside of the window;
    ``energy_total``: all light; ``recorded``: what became of its recording. ``max_depth``: of the integrator, -1 for no
    limit.
    """

    items: tuple[Item, ...]
    seconds: float
    integrator: str
    spp: int
    energy_before: tuple[float, ...]
    energy_after: tuple[float, ...]
    energy_total: tuple[float, ...]
    recorded: tuple[str, ...]
    max_depth: int | None = None


@dataclass(frozen=True)
class RenderJob:
    """Everything about a call that is not a tensor.

    ``items``: the films to fill, where the seed is known; ``seeding`` makes them of a seed that is known later.
    ``batched[i]``: value i has a leading batch dimension. ``needs[i]``: value i wants a derivative. ``bound``: on the
    depth, None for the scene's. ``boundary``: False leaves out what moving edges hide; ``spp_boundary``: samples of it,
    None for the integrator's. ``watch``: says what is unphysical. ``freeze``: calls are recorded. ``log`` collects
    what each primal run reports (seconds, seeds, energy outside the window) and belongs to one call: under ``vmap`` a
    call is several runs. ``derivative_log``: what became of the recordings of the call's derivatives. ``at_call``: of a
    scene that is shared, its values at the call.
    """

    scene: Scene
    options: BuildOptions
    keys: tuple[str, ...]
    items: tuple[Item, ...]
    seeding: Seeding
    batched: tuple[bool, ...]
    spp: int
    spp_grad: int
    temporal_filter: str | None
    watch: PhysicsWatch
    needs: tuple[bool, ...] = ()
    bound: DepthBound | None = None
    boundary: bool = True
    spp_boundary: int | None = None
    progress: Callable[[float], None] | None = None
    freeze: bool = True
    at_call: list[Mapping[str, Any]] = field(default_factory=list)
    log: list[RunLog] = field(default_factory=list)
    derivative_log: list[str] = field(default_factory=list)

    def seeded(self, seed: torch.Tensor | None) -> RenderJob:
        """The job with the items of a seed; with its own ones for None."""
        return self if seed is None else replace(self, items=self.seeding.items(int(seed.item())))


class Session:
    """A built scene in use."""

    def __init__(self, job: RenderJob, slots: SlotTable):
        self.job = job
        self.slots = slots
        self.scene = slots.built.scene
        self.params = slots.built.params
        self.integrator = self.scene.integrator()
        self.recordings = job.scene.recordings.setdefault(job.options, {}).setdefault(job.keys, Recordings())
        self.sensors = self.scene.sensors()

    def film(self, item: Item) -> Any:
        return self.sensors[item.sensor].film()

    def entries(self, item: Item) -> int:
        """Number of values behind the pixels of an item's film."""
        return math.prod(self.film(item).cube_shape())

    def install(self, item: Item, values: Sequence[torch.Tensor], needs: Sequence[bool]) -> list[Any]:
        """Write the values of one batch entry into the scene; leaves that need it carry gradients."""
        import drjit as dr

        leaves = []
        for slot, value, batched, need in zip(self.slots.slots, values, self.job.batched, needs, strict=True):
            entry = value[item.entry] if batched else value
            slot.check(entry)
            leaf = own_array(entry)
            if need and slot.loses_black():
                leaf = lifted(leaf)
            if need:
                dr.enable_grad(leaf)
            leaves.append(leaf)
        try:
            with quiet():
                self.slots.install(leaves)
        except (RuntimeError, ValueError, TypeError) as error:
            if isinstance(error, TorchTransientError):
                raise
            keys = ", ".join(self.job.keys)
            raise SceneError(f"values of {keys}: Mitsuba refuses them: {one_line(error)}") from error
        return leaves


def _check_flags() -> None:
    import drjit as dr

    if not dr.flag(dr.JitFlag.SymbolicLoops):
        raise VariantError(
            "the flag SymbolicLoops of Dr.Jit is off, without which gradients of a render are wrong; switch it on: "
            "drjit.set_flag(drjit.JitFlag.SymbolicLoops, True)."
        )


@contextmanager
def session_of(job: RenderJob) -> Iterator[Session]:
    with active_variant(job.scene.variant), no_collection(of_call=True):
        _check_flags()
        with _as_at_call(job):
            slots = job.scene.slots(job.keys, job.options)
            session = Session(job, slots)
            films = [sensor.film() for sensor in session.sensors]
            attached = True  # until the block has ended without an error: what raised may have left derivatives
            end = in_variant(job.scene.variant, lambda: job.scene.leave(job.options, slots, attached))
            with afterwards(end):
                depth = None if job.bound is None else job.bound.depth
                with (
                    named_errors(),
                    max_depth(depth, session.integrator),
                    temporal_filter(job.temporal_filter, session.integrator, films),
                    boundary_term(job.boundary, job.spp_boundary, session.integrator),
                ):
                    yield session
                attached = any(job.needs)


@contextmanager
def _as_at_call(job: RenderJob) -> Iterator[None]:
    """A scene that others may change, as it was when the job was called, and without derivatives of theirs."""
    import drjit as dr

    if not job.scene.is_shared:
        yield
        return
    params = job.scene.built(job.options).params
    with dr.resume_grad():
        now = values_of(params)

    def as_before() -> None:
        with dr.resume_grad():
            put_back(params, now)

    with afterwards(in_variant(job.scene.variant, as_before)):
        with dr.resume_grad():
            if not job.at_call:
                job.at_call.append(detached(now))
            put_back(params, job.at_call[0], now)
        yield
