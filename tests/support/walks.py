"""Door to the walk of light: tests that need paths, records or launches without a film import them from here."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr

from torchtransient.plugins.integrators.job import passes_of
from torchtransient.plugins.transport.record import RecordedVertex, RecordSink
from torchtransient.plugins.transport.walk import first_leg, start, walk

__all__ = ["RecordSink", "RecordedVertex", "launches", "primary_rays", "trace"]


def trace(context, sampler, ray, first_opl, sink, η=1, pi=None):
    """Trace the paths of primary rays into a sink.

    Args:
        context: ``RenderContext`` of a job.
        sampler: Mitsuba sampler of the lanes.
        ray: primary rays, Ray3f.
        first_opl: optical path length before their origins, minus the film's start, metres (Float64).
        sink: sink of events and vertices.
        η: index of refraction at their origins.
        pi: PreliminaryIntersection3f of their first surface, None if unknown.

    Returns:
        (number of vertices, UInt32; state of the sink).
    """
    path = start(context, ray, first_opl, η)
    path.leg = first_leg(context, sampler, ray, pi)
    return walk(context, sampler, path, sink)


def launches(context, sensor, film, seed, spp):
    """Return the launches of a render."""
    return passes_of(sensor.sampler().clone(), film, seed, spp, context.most_events())[0]


def primary_rays(scene, seed, spp):
    """Return the first launch of a render: ``integrator, sensor, film, contents, context, job, rays``."""
    integrator = scene.integrator()
    with dr.suspend_grad():
        sensor, film = integrator.resolve(scene, 0)
        contents = integrator.contents(scene, sensor)
        context = integrator.render_context(scene, contents)
        job = launches(context, sensor, film, seed, spp)[0]
        rays = integrator.start(scene, contents, sensor, film, job)
    return SimpleNamespace(
        integrator=integrator, sensor=sensor, film=film, contents=contents, context=context, job=job, rays=rays
    )
