"""Context of a walk: scene, contents, settings of the integrator, strategies and derivatives of one job."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.plugins.mitsuba_compat import NORMALS, POSITIONS
from torchtransient.plugins.parameter_effect import ParameterEffect
from torchtransient.plugins.sampling.lights import LightBox
from torchtransient.plugins.sensors.origin import sensors_of
from torchtransient.plugins.transport.boundary.moving_edges import moves_edges
from torchtransient.plugins.transport.record import record_room
from torchtransient.plugins.transport.surface_interactions import AttachedSurfaces


@dataclass(frozen=True)
class PathSettings:
    """Parameters of an integrator that a walk reads, see :class:`~..integrators.base.TransientIntegrator`.

    Attributes:
        min_depth: smallest depth of events that count.
        division: :class:`~..around_corner.division.Division` of depths among estimators, None if paths find all light.
        sharing: :class:`~..shared_paths.groups.Sharing` of light between pixels, None if no path hands over its light.
    """

    max_depth: int
    rr_depth: int
    hide_emitters: bool
    discard_direct_light: bool
    camera_unwarp: bool
    min_depth: int = 0
    division: Any = None
    sharing: Any = None


class RenderContext:
    """Context of a job, a render or a derivative, which every strategy receives.

    Built outside of traced code, not changed afterwards. A plain class: Dr.Jit loops would take a dataclass apart as
    loop state.

    Args:
        scene: Mitsuba scene.
        contents: :class:`.scene_contents.SceneContents`.
        settings: parameters of the integrator.
        strategies: (segment, scattering, list of connections), see :mod:`.strategy`.
        wanted: :class:`Wanted` derivatives, None in a render.
        window: :class:`~..films.block.ArrivalWindow` of the film, None if its steady image counts all arrivals.
        velocities: :class:`.velocities.Velocities` of films that measure rates, None for all others.

    Attributes:
        finds_light: some connection can have an event at the last vertex of a path.
        dark_at_first: no connection has an event at the first vertex.
        plays_roulette: paths can be long enough for Russian roulette.
        surfaces: :class:`.surface_interactions.AttachedSurfaces`, None where no path length changes.
        carried: fields of the :class:`.carry.Carry` that derivatives pass through.
        record_room: :class:`.record.RecordRoom` of the records of derivatives, None in a render.
    """

    def __init__(
        self, scene: Any, contents: Any, settings: PathSettings, strategies: Any, wanted=None, window=None,
        velocities=None,
    ):  # fmt: skip
        self.scene, self.contents, self.wanted = scene, contents, wanted
        self.max_depth, self.rr_depth, self.min_depth = settings.max_depth, settings.rr_depth, settings.min_depth
        self.division, self.sharing = settings.division, settings.sharing
        self.hide_emitters = settings.hide_emitters
        self.discard_direct_light = settings.discard_direct_light
        self.camera_unwarp = settings.camera_unwarp
        self.window, self.velocities = window, velocities
        # The motion of surfaces matters only where path lengths change.
        self.surfaces = AttachedSurfaces.from_contents(contents) if wanted is not None and wanted.geometry else None
        self.segment, self.scattering, self.connections = strategies
        self.finds_light = any(connection.finds_light for connection in self.connections)
        # In media connections draw random numbers, which derivatives draw as well.
        self.dark_at_first = contents.media is None and all(c.dark_at_first for c in self.connections)
        # Paths that end before Russian roulette draw no number for it.
        self.plays_roulette = self.finds_light or self.max_depth > self.rr_depth + 2
        self._check_names()
        # Lower bound of the remaining length of a path, where all light comes from emitters of the scene.
        bounded = window is not None and all(c.light_of_scene_alone for c in self.connections)
        self._light_box = LightBox.from_scene(scene, contents.bsdfs) if bounded else None
        with dr.resume_grad():  # tables are attached where the parameters are
            for strategy in self.strategies():
                strategy.prepare(self)
        # Fields of the Carry that derivatives pass through.
        self.carried = () if wanted is None else wanted.carried + self.segment.carried
        # Memory of the records of derivatives.
        self.record_room = None if wanted is None else record_room(self)
        self._built = True

    def __setattr__(self, name: str, value: Any) -> None:
        if getattr(self, "_built", False):
            raise AttributeError(f"RenderContext does not change once built; tried to set {name!r}.")
        super().__setattr__(name, value)

    def _check_names(self) -> None:
        names = [strategy.name for strategy in self.strategies()]
        wrong = [name for name in names if not name or name == "walk" or names.count(name) > 1]
        if wrong:
            raise SceneError(
                f"strategies of an integrator: expected a name of its own for each, not 'walk', got {', '.join(names)}."
            )

    def start(self, rays: Any) -> None:
        """Prepare all strategies for the primary rays of a launch (:class:`~..sensors.origin.PrimaryRays`)."""
        for strategy in self.strategies():
            strategy.start(self, rays)

    def strategies(self) -> list[Any]:
        """Return all strategies, each once: segment, connections, scattering."""
        return [self.segment, *self.connections, self.scattering]

    def most_events(self) -> int:
        """Return the largest number of events of a path, in a derivative of their terms."""
        return self.max_depth * sum(c.events(self.wanted) for c in self.connections)

    def tables(self) -> list[Any]:
        """Return the arrays that strategies and surfaces computed from parameters."""
        tables = [] if self.surfaces is None else self.surfaces.tables()
        tables += [] if self.velocities is None else self.velocities.tables()
        return tables + [table for strategy in self.strategies() for table in strategy.tables()]

    @property
    def walks(self) -> bool:
        """Return True if paths find some of the light."""
        return self.division is None or self.division.walks

    @property
    def index_changes(self) -> bool:
        """Return True if paths run in media of different indices of refraction, or through delta lobes."""
        return self.contents.delta or self.contents.refraction is not None

    def deep_enough(self, active: Any, depth: Any) -> Any:
        """Return a mask of events of depth ``depth`` (UInt32) that count."""
        active = active if self.min_depth == 0 else active & (depth >= self.min_depth)
        if self.division is None or not self.division.shared:
            return active
        shared = self.division.shared
        return active & ((depth < shared.start) | (depth >= shared.stop))

    def in_time(self, active: Any, τ: Any, p: Any) -> Any:
        """Return a mask of paths that can still have an event in the film's window.

        Args:
            active: mask of lanes.
            τ: optical path length up to ``p``, minus the film's start, metres (Float64).
            p: last vertex, Point3f; the way to the nearest light is a lower bound of the remaining length.
        """
        if self.window is None:
            return active
        least = τ if self._light_box is None else τ + mi.Float64(self._light_box.distance(p))
        return active & ~self.window.over(least)

    def taken_over(self, path: Any, vertex: Any) -> Any:
        """Return a mask of vertices behind which another estimator finds the light, None where there is none.

        A property of the path up to ``vertex`` alone, so that nothing is counted twice.
        """
        return None if self.sharing is None else self.sharing.takes_over(path, vertex)

    def counted(self, active: Any, τ: Any) -> Any:
        """Return a mask of arrivals at ``τ`` (Float64) that lie in the film's window."""
        return active if self.window is None else active & self.window.counts(τ)


# --------------------------------------------------------------------------------------------------------------------
# Derivatives of a job, by the effects of the attached parameters.

class Wanted:
    """Derivatives of a job, by the effects of the attached parameters.

    Built outside of traced code, not changed afterwards.

    Args:
        effects: (plugin, key, effect) of the attached parameters, see :mod:`torchtransient.plugins.parameters`.
        sensor: sensor of the job.
        contents: :class:`.scene_contents.SceneContents`.
        rates: the film measures rates.

    Attributes:
        nodes: pointers of the plugins with attached parameters.
        geometry: path lengths change.
        silhouettes: edges move against their background.
        shapes: pointers of the shapes that move.
        light: an emitter without a shape moves.
        sky: emitter of the sun that moves, None without.
        emitter_shape: the shape of an emitter moves.
        sphere_lights: points move, and with them path lengths, and some emitters are spheres. An index of rough
            surfaces and a lifetime change lengths alone.
        sensor: the sensor moves.
        index: an index of refraction changes.
        ray: the Carry has the ray, behind delta lobes or a moving sensor.
        slides_position_only: path lengths change, and a hit that slides on its surface changes in position
            alone, since no ray is attached (``ray``), no normals or vertices of a mesh are parameters, and surfaces
            are flat and alike everywhere (``contents.patterned``). Its slide is then the vector
            ``o - d (n.o) / (n.d)`` for a shift ``o`` of the ray, in place of an attached ray, which Dr.Jit
            back-propagates through every shape.
        extinction: the extinction of a medium changes.
        rate: the rate of a path changes.
        carried: fields of the :class:`.carry.Carry` that derivatives pass through, without those of the segments.
    """

    def __init__(
        self, effects: Sequence[tuple[Any, str, ParameterEffect]], sensor: Any, contents: Any, rates: bool = False
    ) -> None:
        def moved(role):
            return [node for node, _, effect in effects if effect.role == role]

        sensors = {one.ptr for one in sensors_of(sensor)}
        carriers = {one.get_shape().ptr for one in sensors_of(sensor) if one.get_shape() is not None}
        self.nodes = frozenset(node.ptr for node, _, _ in effects)
        self.geometry = any(effect.moves_length and effect.role != "velocity" for _, _, effect in effects)
        self.rate = rates and any(effect.moves_length for _, _, effect in effects)
        self.silhouettes = any(moves_edges(key, effect) for _, key, effect in effects)
        self.shapes = frozenset(shape.ptr for shape in moved("shape"))
        self.light, self.index = bool(moved("emitter")), bool(moved("index"))
        self.sky = next(iter(moved("sun")), None)
        self.emitter_shape = any(isinstance(node, mi.Shape) and node.is_emitter() for node in moved("shape"))
        self.sensor = any(node.ptr in sensors for node in moved("sensor"))
        self.sensor |= any(node.ptr in carriers for node in moved("shape"))
        points_move = any(effect.moves_length and effect.moves_silhouette for _, _, effect in effects)
        self.sphere_lights = points_move and contents.sphere_lights is not None
        self.ray = self.geometry and (contents.delta or self.sensor)
        bent = any(key in (NORMALS, POSITIONS) for _, key, _ in effects)
        self.slides_position_only = self.geometry and not (self.ray or bent or contents.patterned)
        self.extinction = any(effect.moves_medium for _, _, effect in effects)
        self.carried: tuple[str, ...] = ("β",)
        if self.geometry:
            self.carried += ("slope", "w", "o")
        if self.geometry and contents.media is not None:
            self.carried += ("x",)
        if self.ray:
            self.carried += ("d",)
        if self.index:
            self.carried += ("η",)
        if self.rate:
            self.carried += ("rate",)
        if contents.media is not None:
            contents.media.check_spheres(self.sphere_lights)
            contents.media.check_sun(self.sky is not None)
