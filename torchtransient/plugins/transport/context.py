"""What a walk is told: scene, contents, settings of the integrator and strategies, fixed for one job."""

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
from torchtransient.plugins.sensors.origin import sensors_of, shapes_of_sensors
from torchtransient.plugins.transport.boundary.moving_edges import moves_edges
from torchtransient.plugins.transport.record import record_room
from torchtransient.plugins.transport.surface_interactions import AttachedSurfaces


@dataclass(frozen=True)
class PathSettings:
    """The parameters of an integrator that a walk asks for, see :class:`.TransientIntegrator`. ``min_depth``: events
    of smaller depths do not count. ``division``: who finds light of which depths
    (:class:`~..around_corner.division.Division`), None where paths find all.
    """

    max_depth: int
    rr_depth: int
    hide_emitters: bool
    discard_direct_light: bool
    camera_unwarp: bool
    min_depth: int = 0
    division: Any = None


class RenderContext:
    """One job: a render, or a pass over it for derivatives. Built outside of traced code, not changed afterwards.

    ``wanted``: which derivatives (:class:`.derivative.wanted.Wanted`), None in a render. ``window``: which arrivals the
    film counts, None where its steady image counts them all.

    A plain class on purpose: Dr.Jit loops would take a dataclass apart as loop state.
    """

    def __init__(self, scene: Any, contents: Any, settings: PathSettings, strategies: Any, wanted=None, window=None):
        self.scene, self.contents, self.wanted = scene, contents, wanted
        self.max_depth, self.rr_depth, self.min_depth = settings.max_depth, settings.rr_depth, settings.min_depth
        self.division = settings.division
        self.hide_emitters = settings.hide_emitters
        self.discard_direct_light = settings.discard_direct_light
        self.camera_unwarp = settings.camera_unwarp
        self.window = window
        # Only where path lengths change is it asked how surfaces move.
        self.surfaces = AttachedSurfaces.of(contents) if wanted is not None and wanted.geometry else None
        self.segment, self.scattering, self.connections = strategies
        self.finds_light = any(connection.finds_light for connection in self.connections)
        # Media have connections draw numbers, which derivatives have to draw as well.
        self.dark_at_first = contents.media is None and all(c.dark_at_first for c in self.connections)
        # Where paths end before they would be thinned out, no number is drawn for it.
        self.plays_roulette = self.finds_light or self.max_depth > self.rr_depth + 2
        self._check_names()
        # A lower bound of what a path still has to travel, where all light is that of the scene's emitters.
        bounded = window is not None and all(c.light_of_scene_alone for c in self.connections)
        self._light_box = LightBox.of(scene, contents.bsdfs) if bounded else None
        with dr.resume_grad():  # tables are attached where the parameters are
            for strategy in self.strategies():
                strategy.prepare(self)
        # The fields of the Carry that derivatives go through.
        self.carried = () if wanted is None else wanted.carried + self.segment.carried
        # Where derivatives keep what they record.
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
        """Tell all strategies of the primary rays of a launch."""
        for strategy in self.strategies():
            strategy.start(self, rays)

    def strategies(self) -> list[Any]:
        """All strategies, each once."""
        return [self.segment, *self.connections, self.scattering]

    def most_events(self) -> int:
        """How many events a path can have; in a derivative, how many terms."""
        return self.max_depth * sum(c.events(self.wanted) for c in self.connections)

    def tables(self) -> list[Any]:
        """What has been computed of the scene's parameters, by the strategies and for the surfaces."""
        tables = [] if self.surfaces is None else self.surfaces.tables()
        return tables + [table for strategy in self.strategies() for table in strategy.tables()]

    @property
    def walks(self) -> bool:
        """Whether there is light that paths have to find."""
        return self.division is None or self.division.walks

    @property
    def index_changes(self) -> bool:
        """Whether paths can run in media of different indices of refraction, or through delta lobes."""
        return self.contents.delta or self.contents.refraction is not None

    def deep_enough(self, active: Any, depth: Any) -> Any:
        """Which events of depth ``depth`` (UInt32) count."""
        active = active if self.min_depth == 0 else active & (depth >= self.min_depth)
        if self.division is None or not self.division.shared:
            return active
        shared = self.division.shared
        return active & ((depth < shared.start) | (depth >= shared.stop))

    def in_time(self, active: Any, τ: Any, p: Any) -> Any:
        """Which paths of length ``τ`` up to the point ``p`` can still have an event that the film counts."""
        if self.window is None:
            return active
        least = τ if self._light_box is None else τ + mi.Float64(self._light_box.distance(p))
        return active & ~self.window.over(least)

    def counted(self, active: Any, τ: Any) -> Any:
        """Which arrivals at ``τ`` the film counts."""
        return active if self.window is None else active & self.window.counts(τ)


# --------------------------------------------------------------------------------------------------------------------
# Which derivatives a job asks for, from what the scene's attached parameters move.

class Wanted:
    """Built once a job, outside of traced code; does not change afterwards.

    ``nodes``: pointers of the plugins with attached parameters. ``geometry``: path lengths change. ``silhouettes``:
    edges move against what is behind them. ``shapes``: pointers of the shapes that move. ``light``: an emitter without
    a shape moves. ``sky``: the emitter whose sun moves, or None.
    ``emitter_shape``: the shape of a light does. ``sphere_lights``: path lengths change and some lights are spheres.
    ``sensor``: the sensor moves. ``index``: an index of refraction changes. ``ray``: the ray itself is handed on,
    behind delta lobes or a sensor that moves. ``plain``: where a point slides on its surface, nothing but its place
    changes. ``extinction``: that of a medium changes. ``carried``: the fields of the :class:`~..carry.Carry` that
    derivatives go through, beside those of the segments.

    ``effects``: (plugin, key, effect) of the attached parameters, see :mod:`torchtransient.plugins.parameters`.
    """

    def __init__(self, effects: Sequence[tuple[Any, str, ParameterEffect]], sensor: Any, contents: Any) -> None:
        def moved(role):
            return [node for node, _, effect in effects if effect.role == role]

        sensors = {one.ptr for one in sensors_of(sensor)}
        carriers = {shape.ptr for shape in shapes_of_sensors(sensor) if shape is not None}
        self.nodes = frozenset(node.ptr for node, _, _ in effects)
        self.geometry = any(effect.moves_length for _, _, effect in effects)
        self.silhouettes = any(moves_edges(key, effect) for _, key, effect in effects)
        self.shapes = frozenset(shape.ptr for shape in moved("shape"))
        self.light, self.index = bool(moved("emitter")), bool(moved("index"))
        self.sky = next(iter(moved("sun")), None)
        self.emitter_shape = any(isinstance(node, mi.Shape) and node.is_emitter() for node in moved("shape"))
        self.sensor = any(node.ptr in sensors for node in moved("sensor"))
        self.sensor |= any(node.ptr in carriers for node in moved("shape"))
        self.sphere_lights = self.geometry and contents.sphere_lights is not None
        self.ray = self.geometry and (contents.delta or self.sensor)
        bent = any(key in (NORMALS, POSITIONS) for _, key, _ in effects)
        self.plain = self.geometry and not (self.ray or bent or contents.patterned)
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
        if contents.media is not None:
            contents.media.check_spheres(self.sphere_lights)
            contents.media.check_sun(self.sky is not None)
