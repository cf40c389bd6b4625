"""Runs of a Mitsuba scene on torch tensors: primal, reverse and forward mode, without any torch graph.

Every run installs its values in the scene, renders, reads the result and puts the described values back, under one
lock: between two runs a scene is always in the state of its description, and no Dr.Jit graph outlives a run.

Tensors are real and in the film's layout here: steady (H, W, C) and the film's response, which is the transient (H, W,
T, C) or the phasors (H, W, F, 2 C) with real and imaginary parts in turn; with a leading dimension of items when there
are several.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import torch

from torchtransient._collection import no_collection
from torchtransient.errors import SceneError, ShapeError, TorchTransientError, UnitError
from torchtransient.plugins.black_textures import lifted
from torchtransient.plugins.parameters import check_slope
from torchtransient.render.build import BuildOptions
from torchtransient.render.films.choice import FilmChoice
from torchtransient.render.films.choices import of_film
from torchtransient.render.filter_override import temporal_filter
from torchtransient.render.kernel_errors import named_errors
from torchtransient.render.memory import check_fits
from torchtransient.render.parameters import needing_slope
from torchtransient.render.physics import PhysicsWatch, are_finite, smallest_and_largest
from torchtransient.render.seeds import Item, Seeding
from torchtransient.render.variant import active_variant

if TYPE_CHECKING:
    from torchtransient.render.parameters import SlotTable
    from torchtransient.render.scene_handle import Scene


@dataclass(frozen=True)
class RunLog:
    """What one primal run reports. ``energy_before``, ``energy_after``: outside of the window, item by item."""

    items: tuple[Item, ...]
    seconds: float
    integrator: str
    spp: int
    energy_before: tuple[float, ...]
    energy_after: tuple[float, ...]


@dataclass(frozen=True)
class RenderJob:
    """Everything about a call that is not a tensor.

    ``items``: the films to fill, where the seed is known; ``seeding`` makes them of a seed that is known later.
    ``batched[i]``: value i has a leading batch dimension. ``needs[i]``: value i wants a derivative. ``watch``: says
    what is unphysical. ``log`` collects what each primal run reports (seconds, seeds, energy outside the window) and
    belongs to one call: under ``vmap`` a call is several runs.
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
    progress: Callable[[float], None] | None = None
    log: list[RunLog] = field(default_factory=list)

    def seeded(self, seed: torch.Tensor | None) -> RenderJob:
        """The job with the items of a seed; with its own ones for None."""
        return self if seed is None else replace(self, items=self.seeding.items(int(seed)))


class _Session:
    """A built scene in use."""

    def __init__(self, job: RenderJob, slots: SlotTable):
        self.job = job
        self.slots = slots
        self.scene = slots.built.scene
        self.params = slots.built.params
        self.integrator = self.scene.integrator()
        self.sensors = self.scene.sensors()

    def film(self, item: Item) -> Any:
        return self.sensors[item.sensor].film()

    def install(self, item: Item, values: Sequence[torch.Tensor], needs: Sequence[bool]) -> list[Any]:
        """Write the values of one batch entry into the scene; leaves that need it carry gradients."""
        import drjit as dr

        leaves = []
        for slot, value, batched, need in zip(self.slots.slots, values, self.job.batched, needs, strict=True):
            entry = value[item.entry] if batched else value
            leaf = _own_array(entry)
            if need and slot.loses_black():
                leaf = lifted(leaf)
            if need:
                dr.enable_grad(leaf)
            leaves.append(leaf)
        try:
            with _quiet():
                self.slots.install(leaves)
        except (RuntimeError, ValueError, TypeError) as error:
            if isinstance(error, TorchTransientError):
                raise
            raise SceneError(f"values of {', '.join(self.job.keys)}: Mitsuba refuses them: {error}") from error
        return leaves


def _own_array(tensor: torch.Tensor) -> Any:
    """A flat Dr.Jit copy: the scene must not alias memory that belongs to the caller."""
    import mitsuba as mi

    flat = tensor.detach().reshape(-1).clone()
    _wait_for_torch(flat)
    return mi.Float(flat)


def _wait_for_torch(tensor: torch.Tensor) -> None:
    """Dr.Jit works on a stream of its own: what torch has queued must be done before Dr.Jit reads or reuses memory."""
    if tensor.is_cuda:
        torch.cuda.current_stream(tensor.device).synchronize()


@contextmanager
def _quiet() -> Iterator[None]:
    """Mitsuba warns of gradients through parameters it does not list as differentiable; which ones are right is
    in our own table.
    """
    import mitsuba as mi

    logger = mi.logger()
    before = logger.log_level()
    logger.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        logger.set_log_level(before)


@contextmanager
def _session(job: RenderJob) -> Iterator[_Session]:
    with active_variant(job.scene.variant), no_collection():
        slots = job.scene.slots(job.keys, job.options)
        session = _Session(job, slots)
        films = [sensor.film() for sensor in session.sensors]
        try:
            with named_errors(), temporal_filter(job.temporal_filter, session.integrator, films):
                yield session
        finally:
            try:
                slots.restore()
            except BaseException:
                job.scene.drop(job.options)
                raise


# ---------------------------------------------------------------------------------------------------------- primal


def primal(job: RenderJob, values: Sequence[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
    """Render every item. Returns (steady, response); a single item is a view of the film's own memory."""
    _check_values(job, values)
    with _session(job) as session:
        started = time.perf_counter()
        check_items(session.sensors, job.items)
        check_fits(session.film(job.items[0]).cube_shape(), len(job.items), job.scene.variant)
        steady, response, before, after = _render_items(session, values)
        seconds, spp = time.perf_counter() - started, _drawn_samples(session)
        job.log.append(RunLog(job.items, seconds, session.slots.built.integrator, spp, before, after))
        channels = len(session.film(job.items[0]).channel_names())
    if job.watch.looks:
        job.watch.window(steady, channels, sum(before), sum(after))
    return steady, response


def _render_items(
    session: _Session, values: Sequence[torch.Tensor]
) -> tuple[torch.Tensor, torch.Tensor, tuple[float, ...], tuple[float, ...]]:
    import drjit as dr

    job, count = session.job, len(session.job.items)
    steady_all = response_all = None
    before, after = [], []
    for n, item in enumerate(job.items):
        if n == 0 or item.entry != job.items[n - 1].entry:
            session.install(item, values, [False] * len(values))
            job.watch.placed(session.scene, item.sensor)
        film = session.film(item)
        with dr.suspend_grad():
            session.integrator.render(
                session.scene,
                sensor=item.sensor,
                seed=item.seed,
                spp=job.spp,
                develop=False,
                progress_callback=_fraction(job, n),
            )
            before.append(film.energy_before)
            after.append(film.energy_after)
            steady, response = _take(film, response_all[n] if response_all is not None else None)
        if count == 1:
            steady_all, response_all = steady, response
        elif steady_all is None or response_all is None:
            steady_all, response_all = (
                steady.new_empty((count, *steady.shape)),
                response.new_empty((count, *response.shape)),
            )
        if count > 1:
            steady_all[n].copy_(steady)
            response_all[n].copy_(response)
        del steady, response
    if steady_all is None or response_all is None:
        raise ShapeError("a batch must have at least one entry, got 0.")
    return steady_all, response_all, tuple(before), tuple(after)


def _drawn_samples(session: _Session) -> int:
    """Samples per pixel that are really drawn: stratified samplers round the number that is asked for."""
    sampler = session.sensors[session.job.items[0].sensor].sampler().clone()
    sampler.set_sample_count(session.job.spp)
    return int(sampler.sample_count())


def _fraction(job: RenderJob, n: int) -> Callable[[float], None] | None:
    report, count = job.progress, len(job.items)
    return None if report is None else lambda fraction: report((n + fraction) / count)


def _take(film: Any, into: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
    """The film's result as torch tensors that own the film's memory. A cube stored in several bands is put together."""
    import drjit as dr
    import mitsuba as mi

    bands = film.transient_bands()
    shape = film.cube_shape()
    dr.eval(film.steady, *(band[2] for band in bands))
    dr.sync_thread()
    steady = mi.TensorXf(film.steady, (shape[0], shape[1], film.channel_count())).torch()
    if len(bands) == 1:
        response = mi.TensorXf(bands[0][2], shape).torch()
    else:
        response = torch.empty(shape, dtype=steady.dtype, device=steady.device) if into is None else into
        while bands:
            first, rows, flat = bands.pop(0)
            response[first : first + rows].copy_(flat.torch().view(rows, *shape[1:]))
            del flat
    film.clear()
    return steady, response


def check_items(sensors: Sequence[Any], items: Sequence[Item]) -> FilmChoice:
    """What the films of a call measure, which has to be the same in one shape. Raises ``SceneError``."""
    found: dict[int, tuple[FilmChoice, tuple[int, ...], tuple[str, ...]]] = {}
    for item in items:
        if not 0 <= item.sensor < len(sensors):
            raise SceneError(f"sensors: the scene has {len(sensors)}, numbered from 0; got {item.sensor}.")
        film = sensors[item.sensor].film()
        found[item.sensor] = of_film(film), tuple(film.cube_shape()), tuple(film.channel_names())
    if len(set(found.values())) > 1:
        said = "; ".join(
            f"sensor {sensor}: {choice} of shape {shape} and channels {'/'.join(channels)}"
            for sensor, (choice, shape, channels) in found.items()
        )
        raise SceneError(
            f"sensors: films rendered in one call must measure the same in one shape, got {said}. Use one "
            "TransientRenderer per sensor."
        )
    return next(iter(found.values()))[0]


def _check_values(job: RenderJob, values: Sequence[torch.Tensor]) -> None:
    for key, value in zip(job.keys, values, strict=True):
        low, high = smallest_and_largest(value)
        if not are_finite(low, high):
            bad = int((~torch.isfinite(value)).sum())
            raise UnitError(
                f"value of {key!r}: expected finite numbers, got {bad} of {value.numel()} that are NaN or infinite."
            )
        if job.watch.looks:
            job.watch.value(key, value, low, high)


# ----------------------------------------------------------------------------------------------------- derivatives


def vjp(
    job: RenderJob, values: Sequence[torch.Tensor], g_steady: torch.Tensor | None, g_response: torch.Tensor | None
) -> list[torch.Tensor]:
    """Gradients of ``<g_steady, steady> + <g_response, response>`` for the values that need one, in their shapes."""
    import drjit as dr

    grads: list[torch.Tensor | None] = [
        torch.zeros_like(v) if need else None for v, need in zip(values, job.needs, strict=True)
    ]
    if g_steady is not None or g_response is not None:
        with _session(job) as session:
            _check_slope(session)
            for n, item in enumerate(job.items):
                leaves = session.install(item, values, job.needs)
                several = len(job.items) > 1
                gs = None if g_steady is None else _steady_adjoint(g_steady[n] if several else g_steady)
                gr = None if g_response is None else _cube_adjoint(g_response[n] if several else g_response)
                session.integrator.render_backward(
                    session.scene, session.params, (gs, gr), sensor=item.sensor, seed=item.grad_seed, spp=job.spp_grad
                )
                _finish_backward(session, leaves)
                for grad, leaf, batched in zip(grads, leaves, job.batched, strict=True):
                    if grad is not None:
                        target = grad[item.entry] if batched else grad
                        target += dr.grad(leaf).torch().view(target.shape)
                del leaves, gs, gr
    return [grad for grad in grads if grad is not None]


def _finish_backward(session: _Session, leaves: Sequence[Any]) -> None:
    """Carry what has arrived at the scene's parameters on to the leaves."""
    import drjit as dr

    for target in session.slots.originals:
        value = session.params[target]
        if dr.grad_enabled(value):
            dr.enqueue(dr.ADMode.Backward, value)
    dr.traverse(dr.ADMode.Backward)
    dr.eval([dr.grad(leaf) for leaf in leaves])
    dr.sync_thread()


def jvp(
    job: RenderJob, values: Sequence[torch.Tensor], tangents: Sequence[torch.Tensor]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Derivatives of (steady, response) along ``tangents``, given for the values that need one."""
    import drjit as dr

    steady_all, response_all = [], []
    with _session(job) as session:
        _check_slope(session)
        for item in job.items:
            leaves = session.install(item, values, job.needs)
            given = iter(tangents)
            for leaf, need, batched in zip(leaves, job.needs, job.batched, strict=True):
                if need:
                    tangent = next(given)
                    tangent = tangent[item.entry] if batched else tangent
                    dr.set_grad(leaf, _own_array(tangent))
                    dr.enqueue(dr.ADMode.Forward, leaf)
            # Interior nodes keep their tangents: the loops of the integrator read them at their boundary.
            dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)
            session.integrator.render_forward(
                session.scene, session.params, sensor=item.sensor, seed=item.grad_seed, spp=job.spp_grad, develop=False
            )
            d_steady, d_response = _take(session.film(item), None)
            steady_all.append(d_steady)
            response_all.append(d_response)
            del leaves, d_steady, d_response
    if len(job.items) == 1:
        return steady_all[0], response_all[0]
    return torch.stack(steady_all), torch.stack(response_all)


def _check_slope(session: _Session) -> None:
    """A path length that changes needs films whose response over time has a slope."""
    job = session.job
    wanted = [key for key, need in zip(job.keys, job.needs, strict=True) if need]
    moving = needing_slope(job.scene.parameters(), wanted)
    for item in job.items if moving else ():
        film = session.film(item)
        check_slope(moving, film.has_slope, film.response_name, film.slope_remedy)


def _steady_adjoint(g: torch.Tensor) -> Any:
    import mitsuba as mi

    g = g.detach().contiguous()
    _wait_for_torch(g)
    return mi.TensorXf(g)


def _cube_adjoint(g: torch.Tensor) -> Any:
    """The adjoint cube as (flat array, offset, strides): read where it is, in whatever layout torch left it."""
    import mitsuba as mi

    g = g.detach()
    _wait_for_torch(g)
    span = 1 + sum((size - 1) * stride for size, stride in zip(g.shape, g.stride(), strict=True))
    if span >= 2**32:
        # Beyond 32-bit indices only the film's own layout is understood.
        return mi.TensorXf(g.contiguous())
    flat = g.as_strided((span,), (1,), g.storage_offset())
    return mi.Float(flat), 0, tuple(int(stride) for stride in g.stride())
