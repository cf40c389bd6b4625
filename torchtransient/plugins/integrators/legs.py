"""The straight legs of a path from vertex to vertex, through media where a scene has any.

``place`` is what a path with media knows of the vertex it has reached, as loop state: whether it lies in a medium
(``scatter``) at distance ``t`` from the ray's origin, the ``medium`` that the leg ended in, and the weight ``walk`` of
the leg (see :class:`~.media.free_flight.Walk`); for derivatives also the medium at its ``begin`` and the boundary
``entry`` that it passed last. It is empty in scenes without media.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.integrators.media.free_flight import medium_interaction, transmittance, walk
from torchtransient.plugins.integrators.media.medium_vertex import medium_behind, reference
from torchtransient.plugins.polarized import faded
from torchtransient.plugins.sampling.visible_lights import behind_area_lights


class Arrival:
    """The vertex at the end of a leg; a plain object that only lives within one iteration.

    ``si``: valid at surfaces. ``at``: the point of reference. ``valid``: something was hit. ``surface``: not in a
    medium. ``scatter, mei``: in a medium; None without media. ``medium``: that of the leg's end, None without media.
    """

    def __init__(self, si, at, valid, surface, scatter=None, mei=None, medium=None):
        self.si, self.at, self.valid, self.surface = si, at, valid, surface
        self.scatter, self.mei, self.medium = scatter, mei, medium


def first_leg(scene, media, ray, sampler, hide_emitters):
    """From the sensor to the first vertex: (next surface, place)."""
    if media is None:
        pi = scene.ray_intersect_preliminary(ray, coherent=True)
        return (behind_area_lights(scene, ray, pi) if hide_emitters else pi), {}
    medium = dr.zeros(mi.MediumPtr, dr.width(ray.d))
    if media.at_sensor is not None:
        medium = mi.MediumPtr(media.at_sensor)
    u, lanes, carried = sampler.next_1d(), lane_numbers(sampler), mi.UnpolarizedSpectrum(1)
    return place_of(walk(scene, media, ray, medium, carried, u, lanes, mi.Bool(True), first=True), media, medium)


def next_leg(scene, media, ray, here, carried, sampler, active):
    """From the vertex ``here`` to the next one: (next surface, place). ``carried``: throughput at the start."""
    if media is None:
        return scene.ray_intersect_preliminary(ray, active=active), {}
    medium = medium_behind(here.si, ray.d, here.medium, ~here.scatter)
    carried = mi.unpolarized_spectrum(carried)
    end = walk(scene, media, ray, medium, carried, sampler.next_1d(), lane_numbers(sampler), active)
    return place_of(end, media, medium)


def place_of(end, media, begin):
    """The end of a walk as (next surface, place); ``begin`` is the medium at its start."""
    place = {"scatter": end.scatter, "t": end.t, "medium": end.medium, "walk": end.weight}
    if media.recorded:
        place["begin"] = begin
    if media.keeps_entry:
        place["entry"] = end.entry
    return end.pi, place


def carried_on(β, place):
    """The throughput at the end of a leg."""
    return faded(β, place["walk"]) if place else β


def connectable(media, here, smooth):
    """Whether a vertex is connected to emitters: at surfaces where ``smooth``, in media that allow it."""
    if media is None:
        return smooth
    allowed = True if media.emitter_sampling else here.mei.medium.use_emitter_sampling()
    return dr.select(here.scatter, allowed, smooth)


def unconnected(media, here, delta):
    """Whether emission found from a vertex has no other strategy: at surfaces after a ``delta`` lobe."""
    if media is None or media.emitter_sampling:
        return delta
    return delta | (here.scatter & ~here.mei.medium.use_emitter_sampling())


def lane_numbers(sampler):
    """The number of each lane."""
    return dr.arange(mi.UInt32, sampler.wavefront_size())


def arrive(pi, ray, place):
    """The vertex at the end of a leg."""
    if not place:
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
        return Arrival(si, si, si.is_valid(), mi.Bool(True))
    scatter = place["scatter"]
    mei = medium_interaction(ray, place["medium"], place["t"])
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All, ~scatter)
    at = reference(si, mei, scatter)
    return Arrival(si, at, si.is_valid() | scatter, ~scatter, scatter, mei, place["medium"])


def connect(scene, media, here, ds, u_em, sampler, active):
    """Whether the emitter sample ``ds`` can be seen from ``here``, and the transmittance on the way."""
    ray = here.at.spawn_ray_to(ds.p)
    if media is None:
        return active & ~scene.ray_test(ray, active), mi.UnpolarizedSpectrum(1)
    medium = medium_behind(here.si, ds.d, here.medium, ~here.scatter)
    numbers = [u_em.x, u_em.y]
    T, visible = transmittance(scene, media, ray, ds.dist, medium, numbers, lane_numbers(sampler), active)
    return visible, T
