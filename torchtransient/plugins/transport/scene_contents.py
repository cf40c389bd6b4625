"""Contents of a scene, looked up once a scene and sensor, so that the loops hold only what the scene calls for."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import GradientError
from torchtransient.plugins.bsdfs.delay_table import delays_of
from torchtransient.plugins.bsdfs.mixtures import hides_lobe_probability, mirrors_matrices, mixtures_of
from torchtransient.plugins.bsdfs.refraction_table import RefractiveBSDFs
from torchtransient.plugins.cache import Cache
from torchtransient.plugins.described_scene import check_scene, described
from torchtransient.plugins.films.colour import StandardObserver
from torchtransient.plugins.kernel_arrays import PointerTable
from torchtransient.plugins.mitsuba_compat import EMIT_ALIKE, SCATTER_ALIKE, lacks_directions, varies
from torchtransient.plugins.mitsuba_shapes import (
    has_no_material,
    has_smooth_shape,
    has_vertices,
    is_flat,
    is_flat_shape,
    is_instance,
)
from torchtransient.plugins.node_walk import bsdfs_below, bsdfs_of_scene, objects_below, shapes_of_scene
from torchtransient.plugins.parameters import ParameterTracker
from torchtransient.plugins.sampling.lights import DistantReference
from torchtransient.plugins.sampling.sphere_lights import ShapeLights, SphereLights
from torchtransient.plugins.sensors.surroundings import Surroundings
from torchtransient.plugins.transport.surface_interactions import DetachedHits, Instances

# Derivatives drag points along with the vertex that sees them where they are nearer than this share of the scene's
# radius and of the path's first segment: in corners and gaps the motion of a direction has no bounded variance. The
# boundary term counts what edges so near do.
DAMPING = 0.05


class SceneContents:
    """Contents of a scene that decide which kernels are traced. Does not change once built.

    Tables, instances, surroundings, mixtures, media and lights are None where the scene has no such thing.

    Attributes:
        sensor: the sensor of the job.
        bsdfs: BSDFs that paths can meet.
        delta, glossy: whether some BSDF has such a lobe.
        instances: shape groups (:class:`.surface_interactions.Instances`).
        detached_hits: shapes whose hit points Mitsuba leaves detached (:class:`.surface_interactions.DetachedHits`).
        distant: reference sphere of infinitely distant emitters.
        refraction: transmissive rough BSDFs, which have an index.
        surroundings: media and bodies around the sensor (:class:`~..sensors.surroundings.Surroundings`).
        delays: BSDFs that scatter late.
        mixtures: masks and blends, one part of which scatters a path.
        two_sided: two-sided BSDFs in polarized variants.
        hidden_probability: BSDFs whose delta lobes hide the derivative of their probability.
        media: participating media (:class:`MediaContents`).
        sphere_lights: spherical area lights (:class:`~..sampling.sphere_lights.SphereLights`).
        shape_lights: area lights that are sampled over their shapes (:class:`~..sampling.sphere_lights.ShapeLights`).
        meshes, emitting_meshes: meshes with vertices of their own, in shape groups too; those that emit.
        sliding: shapes without material points.
        smooth_lights: lights on meshes with normals at their vertices.
        damping_radius: ``Float``, metres, see :func:`.geometry_terms.damped_motion`.
        patterned_lights: whether the light that leaves some surface differs from place to place.
        patterned: whether that, the scattering of a surface, or its normal does.
        untraceable: names of emitters beside which derivatives cannot be traced.
        observer: :class:`~..films.colour.StandardObserver` in spectral variants.

    A plain class on purpose: Dr.Jit loops would take a dataclass apart as loop state.
    """

    def __init__(self, scene: Any, sensor: Any, reference: DistantReference) -> None:
        self.sensor = sensor
        outermost = bsdfs_of_scene(scene)
        met, self.delays = delays_of(outermost)
        self.bsdfs, self.mixtures = mixtures_of(met, mi.BSDF, shapes_of_scene(scene))
        self.delta = any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta) for bsdf in self.bsdfs)
        self.glossy = any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy) for bsdf in self.bsdfs)
        self.instances, self.detached_hits = Instances.from_scene(scene), DetachedHits.from_scene(scene)
        infinite = any(mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in scene.emitters())
        self.distant = reference if infinite else None
        self.refraction = RefractiveBSDFs.from_scene(scene, self.bsdfs)
        self.surroundings = Surroundings.from_scene(scene, sensor, outermost)
        self.two_sided = _two_sided(self.bsdfs) if mi.is_polarized else None
        self.hidden_probability = PointerTable.marking([bsdf for bsdf in self.bsdfs if hides_lobe_probability(bsdf)])
        self.media = _media_of(scene, sensor)
        self.sphere_lights = SphereLights.from_scene(scene)
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
        """Return a context manager that detaches in Mitsuba what is attached here instead, during a derivative."""
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


# --------------------------------------------------------------------------------------------------------------------
# Whether what happens at a surface differs from place to place: where a vertex slides, that changes too.

def scatters_by_place(bsdf: Any) -> bool:
    """Return True if a BSDF, or one inside it, may scatter otherwise at another place of a flat surface.

    Args:
        bsdf: one ``mi.BSDF``.
    """
    held = [bsdf, *objects_below(bsdf, mi.BSDF)]
    return _varies_by_texture(bsdf) or not all(_is_known(one, SCATTER_ALIKE) for one in held)


def emits_by_place(emitter: Any) -> bool:
    """Return True if the light that leaves a surface in a given direction may differ from place to place.

    It does with a texture, and where angles count from the normal of a curved shape. Mitsuba's ``area`` asks for the
    side alone.

    Args:
        emitter: one ``mi.Emitter``.
    """
    if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface):
        return False
    declared = mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)
    if declared or _varies_by_texture(emitter) or not _is_known(emitter, EMIT_ALIKE):
        return True
    return emitter.class_name() != "AreaLight" and not is_flat_shape(emitter.get_shape())


def _varies_by_texture(plugin: Any) -> bool:
    textures = objects_below(plugin, mi.Texture)
    return any(varies(t) or _room(t) not in ("mitsuba", "torchtransient") for t in textures)


def _is_known(plugin: Any, names: Iterable[str]) -> bool:
    """Return True for plugins of the library, and of these classes of Mitsuba."""
    return _room(plugin) == "torchtransient" or (_room(plugin) == "mitsuba" and plugin.class_name() in names)


def _room(plugin: Any) -> str:
    """Return the package that a plugin is written in."""
    return type(plugin).__module__.split(".")[0]


# --------------------------------------------------------------------------------------------------------------------
# What the participating media of a scene are like, looked up before tracing.

class MediaContents:
    """The participating media of a scene. Does not change once built.

    Args:
        media: the media, each once.
        at_sensor: the medium that the sensor stands in, or None.
        open_boundaries: some surface lets light through unbent (BSDF ``null``), so that straight lines go through
            several media.
        shapes_in_groups: there are instances.
        extent: the size of the scene, metres.
        transitions: there is more than one medium, or a place without one.

    Attributes:
        homogeneous, heterogeneous: there are media of that kind.
        emitter_sampling: every medium allows connections to emitters.
        phase_mixtures: blends of phase functions, None where there are none.

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
        """Return True if a straight line needs no loop: one medium up to the next surface, with one analytic step."""
        return not (self.heterogeneous or self.open_boundaries)

    def check_spheres(self, sphere_lights: bool) -> None:
        """Raise ``GradientError`` where a medium forbids connections and path lengths to spherical lights change.

        Spherical lights (``sphere_lights``) are sampled by connections alone then.
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
    """Media of one job: contents and wanted derivatives.

    Args:
        contents: media of the scene.
        wanted: :class:`.context.Wanted` derivatives, None in a render.
        hide_emitters: rays from the sensor pass light sources.
        surfaces: :class:`.surface_interactions.AttachedSurfaces`, or None.

    Attributes:
        recorded: paths are recorded for derivatives.
        extinction_changes: a transmittance can change.
        keeps_entry: the boundary before a vertex is recorded, since the vertex may move with it.
        rate_floor: smallest rate at which collisions are sampled, 1 / m; None when no extinction is differentiated.
            Where the density is zero, its derivative is not, and is found by collisions alone.
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


def _media_of(scene: Any, sensor: Any) -> MediaContents | None:
    """Return the media of a scene, None when it has none."""
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
    """Return True for shapes that light passes unbent and unweakened: a BSDF ``null``, no emitter.

    Args:
        shape: one ``mi.Shape``, or an array of shape pointers, for which a mask is returned.
    """
    sides = int(mi.BSDFFlags.FrontSide) | int(mi.BSDFFlags.BackSide)
    bsdf = shape.bsdf()
    if isinstance(shape, mi.Shape):
        return bsdf is not None and (int(bsdf.flags()) & ~sides) == int(mi.BSDFFlags.Null) and not shape.is_emitter()
    return ((bsdf.flags() & ~mi.UInt32(sides)) == int(mi.BSDFFlags.Null)) & ~shape.is_emitter()


# --------------------------------------------------------------------------------------------------------------------
# What an integrator remembers of the scene that it has seen last.

class SceneCache:
    """Look-ups that need to be made once a scene: the ``reference`` sphere of distant light, the contents by sensor,
    the parameters, the BSDFs with all that they hold.

    The reference is that of the scene as described, see :mod:`..described_scene`: neither moving a shape nor an earlier
    render may shift the clock. The scene itself is not kept, since it owns the integrator and would never be
    freed.
    """

    # What recorded calls depend on is in the contexts of their jobs.
    only_remembers = True

    def __init__(self, scene: Any, integrator: Any) -> None:
        self._described = described(scene, integrator)
        check_scene(scene, known=self._described)
        self.reference: DistantReference = self._described.reference
        # So that no later scene can be taken for this one because it got the same addresses.
        self._kept = scene.shapes()[:1]
        own = {shape.ptr for shape in scene.shapes()}
        self._in_groups = [shape for shape in shapes_of_scene(scene) if shape.ptr not in own]
        self._pointers: tuple[int, ...] = ()
        self._lobes: list[int] = []
        self._bsdfs: list[Any] = []
        self._followers: list[Any] = []
        self._contents: dict[int, tuple[Any, SceneContents]] = {}
        self._tracker: ParameterTracker | None = None
        self._python: list[Any] | None = None
        self._samplers: dict[tuple[int, str], tuple[Any, Any]] = {}
        # Parameters, by plugin and key, whose gaps at moving edges a warning has named.
        self.warned_of_edges: set[tuple[int, str]] = set()
        # Likewise those that have no effect, and whether one has said that nothing moves.
        self.warned_of_velocities: set[tuple[int, str]] = set()
        self.warned_of_rest = False

    def is_of(self, scene: Any) -> bool:
        """Return True if the cache is that of ``scene``."""
        return self._described.is_of(scene)

    def follow_derivatives(self, scene: Any, asked: bool) -> None:
        """Let the BSDFs that sample otherwise for derivatives look up which parameters carry some now.

        The tables that they build for it belong to the scene's contents.

        Args:
            scene: scene of the job.
            asked: the job is a derivative.
        """
        self._forget_replaced(scene)
        with dr.resume_grad():
            for bsdf in self._followers:
                bsdf.follow_derivatives(asked)

    def contents_for(self, scene: Any, sensor: Any) -> SceneContents:
        """Return the contents of the scene for a sensor, which may stand in a medium."""
        self._forget_replaced(scene)
        if sensor.ptr not in self._contents:
            # With the sensor, so that no later one can be taken for it.
            self._contents[sensor.ptr] = sensor, SceneContents(scene, sensor, self.reference)
        return self._contents[sensor.ptr][1]

    def tracker(self, scene: Any) -> ParameterTracker:
        """Return the tracker of the scene's parameters, built when first asked for: a render has no use for it."""
        self._forget_replaced(scene)
        if self._tracker is None:
            self._tracker = ParameterTracker(scene)
        return self._tracker

    def sampler(self, sensor: Any, plugin: str) -> Any:
        """Return the sampler of a sensor, or one in its place with the same number of samples.

        Args:
            plugin: name of the other sampler; "" or "scene" for none, "auto" for ``owen`` in place of ``independent``,
                which scenes name by habit.
        """
        own = sensor.sampler()
        if plugin in ("", "scene") or (plugin == "auto" and own.class_name() != "IndependentSampler"):
            return own
        key = sensor.ptr, plugin
        if key not in self._samplers:
            name = "owen" if plugin == "auto" else plugin
            made = mi.load_dict({"type": name, "sample_count": own.sample_count()})
            self._samplers[key] = sensor, made
        return self._samplers[key][1]

    def python_plugins(self, scene: Any, others: Sequence[Any] = ()) -> list[Any]:
        """Return the plugins of the scene that are written in Python.

        Integrator, films, samplers and filters are included; what plugins do not show is not.

        Args:
            others: plugins beside the scene.
        """
        self._forget_replaced(scene)
        if self._python is None:
            # Of these alone: who holds a light or a sensor may hold its shape, and so on up to the scene.
            below = (mi.BSDF, mi.Texture, mi.Volume, mi.PhaseFunction, mi.Medium)
            found = [one for one in objects_below(scene, mi.Object) if isinstance(one, below)]
            self._python = list({one.ptr: one for one in found if _is_python(one)}.values())
        sensors = scene.sensors()
        films = [sensor.film() for sensor in sensors]
        others = [*others, *sensors, *films, *scene.emitters(), *scene.shapes(), scene.integrator()]
        others += [*(sensor.sampler() for sensor in sensors), *(film.rfilter() for film in films)]
        return [*self._python, *filter(_is_python, others)]

    def _forget_replaced(self, scene: Any) -> None:
        """Look up anew when a shape was given another BSDF (``shape.set_bsdf``) or a BSDF got another lobe."""
        bsdfs = [bsdf for bsdf in (shape.bsdf() for shape in [*scene.shapes(), *self._in_groups]) if bsdf is not None]
        # By address: those in use are kept by the scene.
        pointers = (*(bsdf.ptr for bsdf in bsdfs), *(emitter.ptr for emitter in scene.emitters()))
        if pointers != self._pointers:
            outermost = {bsdf.ptr: bsdf for bsdf in bsdfs}.values()
            nested = [part for bsdf in outermost for part in objects_below(bsdf, mi.BSDF)]
            self._bsdfs = list({bsdf.ptr: bsdf for bsdf in [*outermost, *nested]}.values())
            self._followers = [bsdf for bsdf in self._bsdfs if hasattr(bsdf, "follow_derivatives")]
        # Changed parameters may add a lobe, which those around a BSDF do not tell of.
        lobes = [bsdf.flags() for bsdf in self._bsdfs]
        if pointers != self._pointers or lobes != self._lobes:
            self._pointers, self._lobes = pointers, lobes
            self._tracker = self._python = None
            self._contents.clear()


def _is_python(plugin: Any) -> bool:
    return type(plugin).__module__ != "mitsuba"
