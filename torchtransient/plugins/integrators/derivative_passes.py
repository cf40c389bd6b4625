"""The kernel launches of a derivative: every pass records its paths and goes over the record again."""

from __future__ import annotations

import drjit as dr

from torchtransient.plugins.integrators.primary_carry import objective_of, tangent_of
from torchtransient.plugins.transport.derivative.forward import forward as forward_over
from torchtransient.plugins.transport.derivative.reverse import reverse as reverse_over
from torchtransient.plugins.transport.sinks.record import RecordSink


def backward(job):
    """Carry out a prepared job (:class:`.prepared.Prepared`) in reverse mode: gradients arrive at the scene's attached
    parameters and at the job's tables. To be called with gradients suspended.
    """
    world = job.world
    # Derivatives wait at the parameters until all passes are done: following the graph further uses up its edges, and
    # the first pass would be the only one to arrive.
    with dr.isolate_grad(), world.contents.hidden_from_mitsuba():
        for launch in job.launches if world.walks else ():
            _backward_pass(job, launch)
            dr.eval()
        for part in job.beside:
            part.backward(job.incoming)


def forward(job):
    """Carry out a prepared job in forward mode: its film holds the tangent then. As :func:`backward`."""
    world, film = job.world, job.film
    film.start_render(job.samples)
    with world.contents.hidden_from_mitsuba():
        for launch in job.launches if world.walks else ():
            _forward_pass(job, launch)
            dr.eval(film.bands[launch.band][2], film.steady)
        for part in job.beside:
            part.forward()
    film.finish_render()


def _start(job, launch):
    """(primary rays, map to the film's channels, base and pixel of each lane)."""
    integrator, world = job.integrator, job.world
    rays = integrator.start(world.scene, world.contents, job.sensor, job.film, launch)
    base, pixel = integrator.pixel_indices(job.film, launch, rays)
    return rays, integrator.channel_match(world.contents, job.film, rays), base, pixel


def _record(job, rays, block=None):
    """Record the paths of one pass, with their arrivals for the adjoint ``block``: (layout of the record, the record,
    number of vertices).
    """
    sink = RecordSink(block, dr.width(rays.ray) if job.world.record_room.in_memory else None)
    count, store = job.integrator.walk(job.world, job.film, rays, sink)
    return sink.layout, store, count


def _backward_pass(job, launch):
    world = job.world
    rays, match, _, pixel = _start(job, launch)
    block = job.incoming.block(rays, pixel, match)
    adjoint = reverse_over(world, *_record(job, rays, block), block, dr.detach(rays.ray))
    with dr.resume_grad():
        if world.wanted.sensor or dr.grad_enabled(rays.η):
            # What carries a sensor may move without its rays: they go to points that are given.
            flags = dr.ADFlag.Default | dr.ADFlag.AllowNoGrad
            dr.backward_from(objective_of(world, rays, adjoint), flags)


def _forward_pass(job, launch):
    world, film = job.world, job.film
    rays, match, base, pixel = _start(job, launch)
    block = film.create_event_block(launch, base, match, world.most_events(), tangents=True)
    tangent = tangent_of(world, rays)
    dL = forward_over(world, *_record(job, rays), block, dr.detach(rays.ray), tangent)
    film.add_steady(pixel, match.to_channels(dL))
    block.finish()
