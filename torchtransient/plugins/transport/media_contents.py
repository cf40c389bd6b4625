"""What the participating media of a scene are like, looked up before tracing."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import GradientError
from torchtransient.plugins.bsdfs.mixtures import mixtures_of
from torchtransient.plugins.mitsuba_compat import is_instance
from torchtransient.plugins.node_walk import shapes_of_scene


class MediaContents:
    """The participating media of a scene. Does not change once built.

    ``at_sensor``: the medium that the sensor stands in, or None. ``homogeneous``, ``heterogeneous``: whether there are
    media of that kind. ``open_boundaries``: some surface lets light through unbent (BSDF ``null``), so that straight
    lines go through several media. ``transitions``: there is more than one medium, or a place without one.
    ``shapes_in_groups``: there are instances. ``emitter_sampling``: every medium allows
    connections to emitters. ``extent``: the size of the scene in metres. ``phase_mixtures``: blends of phase functions,
    None where there are none.

    A plain class on purpose: Dr.Jit loops would take a dataclass apart as loop state.
    """

    def __init__(
        self, media: list[Any], at_sensor: Any, open_boundaries: bool, shapes_in_groups: bool, extent: float,
        transitions: bool = False,
    ) -> None:  # fmt: skip
        self.media = media
        self.at_sensor = at_sensor
        self.homogeneous = any(m.is_homogeneous() for m in media)
        self.heterogeneous = any(not m.is_homogeneous() for m in media)
        self.emitter_sampling = all(m.use_emitter_sampling() for m in media)
        self.open_boundaries = open_boundaries
        self.transitions = transitions
        self.shapes_in_groups = shapes_in_groups
        self.extent = extent
        phases = {phase.ptr: phase for phase in (medium.phase_function() for medium in media)}
        _, self.phase_mixtures = mixtures_of(list(phases.values()), mi.PhaseFunction)

    @property
    def one_stretch(self) -> bool:
        """Whether a straight line needs no loop: one medium up to the next surface, with one analytic step."""
        return not (self.heterogeneous or self.open_boundaries)

    def check_spheres(self, sphere_lights: bool) -> None:
        """Where path lengths change, spherical lights (``sphere_lights``) are sampled by connections alone, which every
        medium has to allow. Raises ``GradientError`` otherwise.
        """
        if sphere_lights and not self.emitter_sampling:
            raise GradientError(
                "transient_prbvolpath: derivatives of path lengths reach spherical lights through connections only, "
                "and a medium has sample_emitters = false. Set it to true, or use lights of another shape."
            )

    @staticmethod
    def check_sun(moves: bool) -> None:
        """Raise ``GradientError`` where the direction of the sun has a derivative: the way of its light through a
        medium changes with it, which is not followed.
        """
        if moves:
            raise GradientError(
                "transient_prbvolpath: 'sun_direction' has no derivative in a scene with media, expected a scene "
                "without. Leave out the medium or the parameter; a moving 'point' light has one."
            )


class FlightSettings:
    """How the walks through media are made in one job: the contents, and what derivatives ask of them.

    ``recorded``: the path is kept. ``extinction_changes``: a transmittance can change. ``keeps_entry``: the boundary
    before a vertex is kept, since the vertex may move with it. ``rate_floor`` (1 / m, None when no extinction is
    differentiated): the smallest rate at which collisions are sampled: where the density is zero, its derivative is
    not, and is found by collisions alone. ``hide_emitters``: rays from the sensor pass light sources.
    ``surfaces``: what their derivatives need beside Mitsuba (:class:`.instances.AttachedSurfaces`), or None.
    """

    def __init__(self, contents: MediaContents, wanted: Any, hide_emitters: bool, surfaces: Any = None):
        self.surfaces = surfaces
        self.at_sensor, self.emitter_sampling = contents.at_sensor, contents.emitter_sampling
        self.homogeneous, self.heterogeneous = contents.homogeneous, contents.heterogeneous
        self.open_boundaries, self.one_stretch = contents.open_boundaries, contents.one_stretch
        self.transitions = contents.transitions
        self.shapes_in_groups = contents.shapes_in_groups
        self.hide_emitters = hide_emitters
        self.recorded = wanted is not None
        self.geometry = self.recorded and wanted.geometry
        self.extinction_changes = self.recorded and (wanted.geometry or wanted.extinction)
        self.keeps_entry = self.geometry and contents.open_boundaries
        self.rate_floor = None
        if self.recorded and wanted.extinction:
            # Opaque: as a literal, every change of the scene's size would compile another kernel.
            self.rate_floor = dr.opaque(mi.Float, 0.5 / contents.extent)


def media_of(scene: Any, sensor: Any) -> MediaContents | None:
    """The media of a scene, None when it has none."""
    shapes = shapes_of_scene(scene)
    found = [sensor.get_medium() if sensor is not None else None]
    for shape in shapes:
        if shape.is_medium_transition():
            found += [shape.interior_medium(), shape.exterior_medium()]
    media = {medium.ptr: medium for medium in found if medium is not None}
    if not media:
        return None
    box = scene.bbox()
    extent = float(dr.norm(box.extents())) if box.valid() else 1.0
    transitions = len(media) > 1 or any(medium is None for medium in found)
    open_boundaries, grouped = any(is_open(shape) for shape in shapes), any(is_instance(shape) for shape in shapes)
    return MediaContents(list(media.values()), found[0], open_boundaries, grouped, max(extent, 1e-6), transitions)


def is_open(shape: Any) -> bool:
    """Whether light passes ``shape`` unbent and unweakened, so that nothing happens there: a BSDF ``null``, no emitter.

    Works on one shape and on arrays of shape pointers.
    """
    sides = int(mi.BSDFFlags.FrontSide) | int(mi.BSDFFlags.BackSide)
    bsdf = shape.bsdf()
    if isinstance(shape, mi.Shape):
        return bsdf is not None and (int(bsdf.flags()) & ~sides) == int(mi.BSDFFlags.Null) and not shape.is_emitter()
    return ((bsdf.flags() & ~mi.UInt32(sides)) == int(mi.BSDFFlags.Null)) & ~shape.is_emitter()
