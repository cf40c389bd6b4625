"""What a scene contains, looked up once a scene and sensor, so that the loops hold only what the scene calls for."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.bsdfs.delay_table import delays_of
from torchtransient.plugins.bsdfs.mixtures import hides_lobe_probability, mirrors_matrices, mixtures_of
from torchtransient.plugins.bsdfs.refraction_table import RefractiveBSDFs
from torchtransient.plugins.cache import Cache
from torchtransient.plugins.films.colour import StandardObserver
from torchtransient.plugins.kernel_arrays import PointerTable
from torchtransient.plugins.mitsuba_compat import (
    has_no_material,
    has_smooth_shape,
    has_vertices,
    is_flat,
    lacks_directions,
)
from torchtransient.plugins.node_walk import bsdfs_below, bsdfs_of_scene, shapes_of_scene
from torchtransient.plugins.sampling.lights import DistantReference
from torchtransient.plugins.sampling.sphere_lights import ShapeLights, SphereLights
from torchtransient.plugins.sensors.surroundings import Surroundings
from torchtransient.plugins.transport.hits import DetachedHits
from torchtransient.plugins.transport.instances import Instances
from torchtransient.plugins.transport.media_contents import media_of
from torchtransient.plugins.transport.patterns import emits_by_place, scatters_by_place

# Derivatives drag points along with the vertex that sees them where they are nearer than this share of the scene's
# radius and of the path's first segment: in corners and gaps the motion of a direction has no bounded variance. The
# boundary term counts what edges so near do.
DAMPING = 0.05


class SceneContents:
    """The static choices of the kernels. Does not change once built.

    ``sensor``: the one that looks. ``bsdfs``: those that paths can meet. ``delta``, ``glossy``: some BSDF has such a
    lobe. ``instances``: those of shape groups (:class:`.instances.Instances`). ``detached_hits``: the shapes that leave
    their hit points detached (:class:`.hits.DetachedHits`). ``distant``: reference sphere of infinitely distant
    emitters. ``refraction``: the transmissive rough BSDFs, which have an index. ``surroundings``: what may lie around
    the sensor (:class:`~..sensors.surroundings.Surroundings`). ``delays``: the BSDFs that scatter late. ``mixtures``:
    masks and blends, of which a path may be handed one part. ``two_sided``: the two-sided BSDFs in polarized variants.
    ``hidden_probability``: BSDFs whose delta lobes hide the derivative of their probability. ``media``: the
    participating media (:class:`.media_contents.MediaContents`). ``sphere_lights``: the spherical area lights
    (:class:`~..sampling.sphere_lights.SphereLights`). ``shape_lights``: the area lights that are sampled over their
    shapes (:class:`~..sampling.shape_lights.ShapeLights`). ``emitting_meshes``: those with vertices of their own;
    ``meshes``: all of those, of shape groups, too; ``sliding``: the shapes without material points;
    ``smooth_lights``: lights on meshes with normals at their vertices. Tables, instances, surroundings, mixtures, media
    and lights are None where the scene has no such thing.

    ``damping_radius`` (Float): see :func:`.scattering.geometry_terms.damped_motion`. ``patterned_lights``: what leaves
    some surface differs from place to place. ``patterned``: that, or how a surface scatters does, or its normal.
    ``untraceable``: names of the emitters that derivatives cannot be traced beside. ``observer``: the
    :class:`~..films.colour.StandardObserver` in spectral variants.

    A plain class on purpose: Dr.Jit loops would take a dataclass apart as loop state.
    """

    def __init__(self, scene: Any, sensor: Any, reference: DistantReference) -> None:
        self.sensor = sensor
        outermost = bsdfs_of_scene(scene)
        met, self.delays = delays_of(outermost)
        self.bsdfs, self.mixtures = mixtures_of(met, mi.BSDF, shapes_of_scene(scene))
        self.delta = any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta) for bsdf in self.bsdfs)
        self.glossy = any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy) for bsdf in self.bsdfs)
        self.instances, self.detached_hits = Instances.of(scene), DetachedHits.of(scene)
        infinite = any(mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in scene.emitters())
        self.distant = reference if infinite else None
        self.refraction = RefractiveBSDFs.of(scene, self.bsdfs)
        self.surroundings = Surroundings.of(scene, sensor, outermost)
        self.two_sided = _two_sided(self.bsdfs) if mi.is_polarized else None
        self.hidden_probability = PointerTable.marking([bsdf for bsdf in self.bsdfs if hides_lobe_probability(bsdf)])
        self.media = media_of(scene, sensor)
        self.sphere_lights = SphereLights.of(scene)
        self.shape_lights = ShapeLights(scene) if self.sphere_lights is None else self.sphere_lights.others
        self.smooth_lights = PointerTable.marking([e for e in scene.emitters() if has_smooth_shape(e)])
        self.emitting_meshes = PointerTable.marking([s for s in scene.shapes() if s.is_emitter() and has_vertices(s)])
        self.meshes = PointerTable.marking([s for s in shapes_of_scene(scene) if has_vertices(s)])
        self.sliding = PointerTable.marking([s for s in scene.shapes() if has_no_material(s)])
        self.damping_radius = dr.opaque(mi.Float, DAMPING * reference.radius)
        self.patterned_lights = any(emits_by_place(e) for e in scene.emitters())
        self.patterned = self.patterned_lights or not all(is_flat(shape) for shape in scene.shapes())
        self.patterned |= any(scatters_by_place(bsdf) for bsdf in outermost)
        self.untraceable = [emitter.id() for emitter in scene.emitters() if lacks_directions(emitter)]
        self.observer = StandardObserver.of_variant()
        # What was computed of the scene as it was: renders of one that stays as it is begin sooner.
        self.memory = Cache()
        self._built = True

    def hidden_from_mitsuba(self) -> AbstractContextManager[None]:
        """For the time of a derivative: what is attached here instead of by Mitsuba."""
        return nullcontext() if self.instances is None else self.instances.detached()

    def __setattr__(self, name: str, value: Any) -> None:
        if getattr(self, "_built", False):
            raise AttributeError(f"SceneContents does not change once built; tried to set {name!r}.")
        super().__setattr__(name, value)


def _two_sided(bsdfs: list[Any]) -> PointerTable | None:
    found = [bsdf for bsdf in bsdfs if mirrors_matrices(bsdf)]
    # A path may be handed a part of a BSDF by the part's own pointer.
    found += [part for bsdf in found for part in bsdfs_below(bsdf) if mirrors_matrices(part)]
    return PointerTable.marking(found)
