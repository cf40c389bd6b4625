"""Runs of a Mitsuba scene on torch tensors: primal, reverse and forward mode, without any torch graph.

Every run installs its values in the scene, renders and reads the result, under one lock. The described values are put
back before anybody else looks at the scene (:meth:`.load.Scene.leave`), and no Dr.Jit graph outlives a run.

Tensors are real and in the film's layout here: steady (H, W, C) and the film's response, which is the transient (H, W,
T, C) or the phasors (H, W, F, 2 C) with real and imaginary parts in turn; with a leading dimension of items when there
are several.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from torchtransient.errors import ArgumentError, SceneError, UnitError
from torchtransient.interfaces import BACKWARD, FORWARD, RENDER
from torchtransient.plugins.parameters import check_slope
from torchtransient.rendering.batch import Batch, take
from torchtransient.rendering.broken_numbers import broken_entries, fill_broken
from torchtransient.rendering.carry_out import Numbered, carry_out, groups_of
from torchtransient.rendering.films import FilmLayout, layout_of_film
from torchtransient.rendering.interrupts import ends_frames
from torchtransient.rendering.memory import check_fits
from torchtransient.rendering.sample_counts import samples_taken
from torchtransient.rendering.seeds import Item
from torchtransient.rendering.session import RenderJob, RunLog, Session, session_of
from torchtransient.scene.edits import built_depth
from torchtransient.scene.parameters import needing_slope
from torchtransient.scene.physics import all_finite, are_finite, smallest_and_largest
from torchtransient.scene.values import own_array, wait_for_torch

# ---------------------------------------------------------------------------------------------------------- primal


@ends_frames
def primal(job: RenderJob, values: Sequence[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
    """Render every item. Returns (steady, response); a single item is a view of the film's own memory."""
    check_values(job, values)
    with session_of(job) as session:
        started = time.perf_counter()
        check_items(session.sensors, job.items)
        check_fits(session.film(job.items[0]).cube_shape(), len(job.items), job.scene.variant)
        steady, response, before, after, said = _render_items(session, values)
        seconds, spp = time.perf_counter() - started, _drawn_samples(session)
        channels = len(session.film(job.items[0]).channel_names())
        light = steady[..., :channels].sum((-3, -2, -1), dtype=torch.float64) / channels
        total: tuple[float, ...] = tuple(light.reshape(-1).tolist())
        integrator, depth = session.slots.built.integrator, built_depth(session.integrator)
        job.log.append(RunLog(job.items, seconds, integrator, spp, before, after, total, said, depth))
    if job.watch.enabled:
        job.watch.window(sum(total), sum(before), sum(after))
    return steady, response


def _render_items(
    session: Session, values: Sequence[torch.Tensor]
) -> tuple[torch.Tensor, torch.Tensor, tuple[float, ...], tuple[float, ...], tuple[str, ...]]:
    job = session.job
    batch = Batch(len(job.items), [session.film(item) for item in job.items], session.integrator)
    energies: list[tuple[float, float]] = []
    said: list[str] = []
    for group in groups_of(session):

        def install(item: Item, group: Sequence[Numbered] = group) -> None:
            session.install(item, values, [False] * len(values))
            for _, each in group:
                job.watch.placed(session.scene, each.sensor)

        def collect(n: int, item: Item) -> None:
            film = session.film(item)
            energies.append(film.energies_outside())
            batch.take(film, n)

        with batch.lent_to(session.film(group[0][1]), group[0][0], job.spp) as lent:
            said += carry_out(session, RENDER, group, install, collect, report=lambda n: _fraction(job, n), lent=lent)
    steady, response = batch.tensors()
    before, after = zip(*energies, strict=True)
    return steady, response, before, after, tuple(said)


def _drawn_samples(session: Session) -> int:
    """Samples per pixel that are really drawn: stratified samplers round the number that is asked for."""
    return samples_taken(session.sensors[session.job.items[0].sensor].sampler().clone(), session.job.spp)


def _fraction(job: RenderJob, n: int) -> Callable[[float], None] | None:
    report, count = job.progress, len(job.items)
    return None if report is None else lambda fraction: report((n + fraction) / count)


def check_items(sensors: Sequence[Any], items: Sequence[Item]) -> FilmLayout:
    """What the films of a call measure, which has to be the same in one shape. Raises ``SceneError``."""
    found: dict[int, tuple[FilmLayout, tuple[int, ...], tuple[str, ...]]] = {}
    for item in items:
        if not 0 <= item.sensor < len(sensors):
            raise ArgumentError(f"sensors: the scene has {len(sensors)}, numbered from 0; got {item.sensor}.")
        film = sensors[item.sensor].film()
        found[item.sensor] = layout_of_film(film), tuple(film.cube_shape()), tuple(film.channel_names())
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


def check_values(job: RenderJob, values: Sequence[torch.Tensor]) -> None:
    """Raise ``UnitError`` for values that are not finite; say what is unphysical."""
    for key, value in zip(job.keys, values, strict=True):
        low, high = smallest_and_largest(value)
        if not are_finite(low, high):
            bad = int((~torch.isfinite(value)).sum())
            raise UnitError(
                f"value of {key!r}: expected finite numbers, got {bad} of {value.numel()} that are NaN or infinite."
            )
        if job.watch.enabled:
            job.watch.value(key, value, low, high)


# ----------------------------------------------------------------------------------------------------- derivatives


@ends_frames
def vjp(
    job: RenderJob, values: Sequence[torch.Tensor], g_steady: torch.Tensor | None, g_response: torch.Tensor | None
) -> list[torch.Tensor]:
    """Gradients of ``<g_steady, steady> + <g_response, response>`` for the values that need one, in their shapes.

    The adjoint of a film that is not finite makes every gradient that the film can have NaN: that of its entry of the
    batch, and those of values without a batch.
    """
    import drjit as dr

    grads: list[torch.Tensor | None] = [
        torch.zeros_like(v) if need else None for v, need in zip(values, job.needs, strict=True)
    ]
    if g_steady is not None or g_response is not None:
        with session_of(job) as session:
            _check_slope(session)
            for group in groups_of(session):
                leaves: list[Any] = []

                def install(item: Item, leaves: list[Any] = leaves) -> None:
                    leaves[:] = session.install(item, values, job.needs)

                def adjoint(n: int) -> tuple[Any, Any]:
                    several = len(job.items) > 1
                    gs = None if g_steady is None else _steady_adjoint(g_steady[n] if several else g_steady)
                    gr = None if g_response is None else _cube_adjoint(g_response[n] if several else g_response)
                    return gs, gr

                def collect(n: int, item: Item, leaves: list[Any] = leaves) -> None:
                    _finish_backward(session, leaves)
                    for grad, leaf, batched in zip(grads, leaves, job.batched, strict=True):
                        if grad is not None:
                            target = grad[item.entry] if batched else grad
                            target += dr.grad(leaf).torch().view(target.shape)
                    leaves.clear()

                job.derivative_log.extend(carry_out(session, BACKWARD, group, install, collect, adjoint))
        for item in _broken_items(job, [g for g in (g_steady, g_response) if g is not None]):
            fill_broken(
                grad[item.entry] if batched else grad
                for grad, batched in zip(grads, job.batched, strict=True)
                if grad is not None
            )
    return [grad for grad in grads if grad is not None]


def _broken_items(job: RenderJob, adjoints: Sequence[torch.Tensor]) -> list[Item]:
    """The films whose adjoints are not finite."""
    if len(job.items) == 1:
        return [] if all(map(all_finite, adjoints)) else list(job.items)
    columns = [broken_entries(adjoint, len(job.items)) for adjoint in adjoints]
    return [item for item, broken in zip(job.items, zip(*columns, strict=True), strict=True) if any(broken)]


def _finish_backward(session: Session, leaves: Sequence[Any]) -> None:
    """Carry what has arrived at the scene's parameters on to the leaves."""
    import drjit as dr

    for target in session.slots.originals:
        value = session.params[target]
        if dr.grad_enabled(value):
            dr.enqueue(dr.ADMode.Backward, value)
    dr.traverse(dr.ADMode.Backward)
    dr.eval([dr.grad(leaf) for leaf in leaves])
    dr.sync_thread()


@ends_frames
def jvp(
    job: RenderJob, values: Sequence[torch.Tensor], tangents: Sequence[torch.Tensor]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Derivatives of (steady, response) along ``tangents``, given for the values that need one. Tangents that are not
    finite make all of a film NaN.
    """
    steady_all, response_all = [], []
    batched = [batched for batched, need in zip(job.batched, job.needs, strict=True) if need]
    broken = {item.entry for item in job.items if not all(map(all_finite, _tangents_of(item, tangents, batched)))}
    with session_of(job) as session:
        _check_slope(session)
        for group in groups_of(session):
            leaves: list[Any] = []

            def install(item: Item, leaves: list[Any] = leaves) -> None:
                leaves[:] = session.install(item, values, job.needs)
                _set_tangents(job, item, leaves, tangents)

            def collect(n: int, item: Item) -> None:
                d_steady, d_response = take(session.film(item), None)
                if item.entry in broken:
                    fill_broken((d_steady, d_response))
                steady_all.append(d_steady)
                response_all.append(d_response)

            job.derivative_log.extend(carry_out(session, FORWARD, group, install, collect))
            leaves.clear()
    if len(job.items) == 1:
        return steady_all[0], response_all[0]
    return torch.stack(steady_all), torch.stack(response_all)


def _tangents_of(item: Item, tangents: Sequence[torch.Tensor], batched: Sequence[bool]) -> list[torch.Tensor]:
    return [tangent[item.entry] if several else tangent for tangent, several in zip(tangents, batched, strict=True)]


def _set_tangents(job: RenderJob, item: Item, leaves: Sequence[Any], tangents: Sequence[torch.Tensor]) -> None:
    """Bring tangents to the leaves that need one, and on to the scene's parameters."""
    import drjit as dr

    given = iter(tangents)
    for leaf, need, batched in zip(leaves, job.needs, job.batched, strict=True):
        if need:
            tangent = next(given)
            dr.set_grad(leaf, own_array(tangent[item.entry] if batched else tangent))
            dr.enqueue(dr.ADMode.Forward, leaf)
    # Interior nodes keep their tangents: the loops of the integrator read them at their boundary.
    dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)


def _check_slope(session: Session) -> None:
    """A path length that changes needs films whose response over time has a slope."""
    job = session.job
    wanted = [key for key, need in zip(job.keys, job.needs, strict=True) if need]
    moving = needing_slope(job.scene.known_parameters(), wanted)
    for item in job.items if moving else ():
        film = session.film(item)
        check_slope(moving, film.has_slope, film.response_name, film.slope_remedy)


def _steady_adjoint(g: torch.Tensor) -> Any:
    import mitsuba as mi

    g = g.resolve_neg().contiguous()
    wait_for_torch(g)
    return mi.TensorXf(g)


def _cube_adjoint(g: torch.Tensor) -> Any:
    """The adjoint cube as (flat array, offset, strides): read where it is, in whatever layout torch left it."""
    import mitsuba as mi

    g = g.detach().resolve_neg()
    wait_for_torch(g)
    span = 1 + sum((size - 1) * stride for size, stride in zip(g.shape, g.stride(), strict=True))
    if span >= 2**32:
        # Beyond 32-bit indices only the film's own layout is understood.
        return mi.TensorXf(g.contiguous())
    flat = g.as_strided((span,), (1,), g.storage_offset())
    return mi.Float(flat), 0, tuple(int(stride) for stride in g.stride())
