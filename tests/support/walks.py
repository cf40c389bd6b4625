"""Door to the core of the walk: a test whose subject no render shows by itself imports it from here, and from no module
of `plugins/transport`.

Renders, their gradients and errors are the first choice. Each name stands for a reason that they do not serve:

- the loop alone, on the first launch of a render and before any light: `primary_rays`, `recorded_paths`;
- mathematics with a closed form, at single points: `attached_interaction` and `attached_distance`, hits of curves,
  ellipsoids and instances with the derivatives that Mitsuba lacks; `varies_by_place`, a property of every
  plugin that costs time or derivatives where it is wrong;
- the same numbers by another way: `no_flat_shortcut`, `limit_records`;
- moments in the middle of a trace, for interrupts, errors and scenes that are dropped there: `before_each_turn`.

Beside it, `toy_strategies` and `toy_integrators` import what an author of strategies does.
"""

from __future__ import annotations

import sys
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.integrators.job import passes_of
from torchtransient.plugins.transport import scene_contents, walk
from torchtransient.plugins.transport.context import Wanted
from torchtransient.plugins.transport.record import RecordedVertex, RecordSink
from torchtransient.plugins.transport.surface_interactions import (
    AttachedSurfaces,
    DetachedHits,
    Instances,
    distance_to,
    surface_interaction,
)

__all__ = [
    "attached_distance",
    "attached_interaction",
    "before_each_turn",
    "limit_records",
    "no_flat_shortcut",
    "primary_rays",
    "recorded_paths",
    "varies_by_place",
]

CORE = "torchtransient.plugins.transport"


# --------------------------------------------------------------------------------------------------------------------
# The loop.

def primary_rays(scene, seed, spp):
    """Return the first launch of a render: ``integrator, sensor, film, contents, context, job, rays``."""
    integrator = scene.integrator()
    with dr.suspend_grad():
        sensor, film = integrator.resolve(scene, 0)
        contents = integrator.contents(scene, sensor)
        context = integrator.render_context(scene, contents)
        job = passes_of(sensor.sampler().clone(), film, seed, spp, context.most_events())[0][0]
        rays = integrator.start(scene, contents, sensor, film, job)
    return SimpleNamespace(
        integrator=integrator, sensor=sensor, film=film, contents=contents, context=context, job=job, rays=rays
    )


def recorded_paths(scene, lanes, seed):
    """Return the vertices of paths along the axis of a sensor.

    Returns:
        (positions (lanes, max_depth, 3); optical path lengths up to them, infinite behind the last one, and
        throughputs, (lanes, max_depth)).
    """
    integrator, sensor = scene.integrator(), scene.sensors()[0]
    contents = integrator.contents(scene, sensor)
    context = integrator.render_context(scene, contents, Wanted([], sensor, contents))
    sampler = sensor.sampler().clone()
    sampler.seed(seed, lanes)
    with dr.suspend_grad():
        ray, _ = sensor.sample_ray(mi.Float(0), mi.Float(0), mi.Point2f(0.5), mi.Point2f(0.5))
        ray.o, ray.d = [dr.repeat(x, lanes) if dr.width(x) == 1 else x for x in (ray.o, ray.d)]
        sink = RecordSink()
        path = walk.start(context, ray, mi.Float64(0), 1)
        path.leg = walk.first_leg(context, sampler, ray, None)
        count, store = walk.walk(context, sampler, path, sink)
        points, lengths, weights = [], [], []
        for k in range(integrator.max_depth):
            there = mi.UInt32(k) < count
            v = RecordedVertex(sink.layout, store, mi.UInt32(k), there, ray)
            points.append(v.ray(v.t))
            lengths.append(dr.select(there, v.τ, dr.inf))
            weights.append(v.β[0] * v.weight[0])
        dr.eval(points, lengths, weights)
    stack = [np.array(p).T for p in points], [np.array(x) for x in lengths], [np.array(x) for x in weights]
    return [np.stack(x, axis=1) for x in stack]


def before_each_turn(monkeypatch, call):
    """Have ``call()`` run whenever a turn of the loop is traced. It may raise."""
    loop = sys.modules[f"{CORE}.walk"]  # where integrators find it
    bounce = loop.bounce

    def turn(*arguments, **named):
        call()
        return bounce(*arguments, **named)

    monkeypatch.setattr(loop, "bounce", turn)


# --------------------------------------------------------------------------------------------------------------------
# Hits.

def _surfaces(scene):
    return AttachedSurfaces.from_contents(
        SimpleNamespace(instances=Instances.from_scene(scene), detached_hits=DetachedHits.from_scene(scene))
    )


def attached_interaction(scene, pi, ray, flags, active=True):
    """Return the SurfaceInteraction3f of ``pi``, attached to the ray, to its shape and to what moves that."""
    return surface_interaction(_surfaces(scene), pi, ray, flags, mi.Bool(active))


def attached_distance(scene, pi, ray, active=True):
    """Return the distance of the surface at ``pi`` along an attached ray."""
    return distance_to(_surfaces(scene), pi, ray, mi.Bool(active))


def varies_by_place(plugin):
    """Return whether a BSDF or an emitter is not the same all over its surface."""
    if isinstance(plugin, mi.Emitter):
        return scene_contents.emits_by_place(plugin)
    return scene_contents.scatters_by_place(plugin)


# --------------------------------------------------------------------------------------------------------------------
# Other ways to the same numbers.

def no_flat_shortcut(monkeypatch):
    """Points slide on flat surfaces as on all others."""
    monkeypatch.setattr(f"{CORE}.scene_contents.is_flat", lambda shape: False)


def limit_records(monkeypatch, stack, memory=None):
    """Set the bytes that the record of a path may take: of the stack, and of memory (None: as it is)."""
    monkeypatch.setattr(f"{CORE}.record.room_of_path", lambda: stack)
    if memory is not None:
        monkeypatch.setattr(f"{CORE}.record.MEMORY", memory)
