"""Velocities of what a path meets, and the rate at which its optical length changes.

With vertices ``x_i`` as material points of velocity ``v_i``, and the direction ``u_i`` from ``x_i`` to ``x_{i+1}``
along a segment of index ``eta_i``,

    tau = sum eta_i |x_{i+1} - x_i|,        rate = d tau / dt = sum eta_i (v_{i+1} - v_i) . u_i.

At mirrors and smooth glass the vertex slides over its surface, but by Fermat's principle the length does not change to
first order when it does: the sum is right there, too.

The rate is that of waves whose phase the scatterers carry (FMCW, laser Doppler, speckle). Envelopes see the derivative
of the whole image by time, with its weights and outlines: those are poses at several times.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.checks import some_of
from torchtransient.errors import SceneError
from torchtransient.plugins.kernel_arrays import PointerTable
from torchtransient.plugins.mitsuba_compat import VELOCITY, has_velocities, is_batch, moved_by
from torchtransient.plugins.mitsuba_shapes import is_instance
from torchtransient.plugins.node_walk import objects_of, shapes_of_scene
from torchtransient.plugins.sensors.origin import sensors_of
from torchtransient.plugins.transport.geometry_terms import point_of_light

# Rows of the table before those of the bodies: rest, and the sensor.
REST, SENSOR, FIRST = 0, 1, 2


class Movers:
    """Bodies of a scene that move, looked up once.

    Attributes:
        motions: ``rigid_motion`` plugins, each once.
        shapes, emitters, media: bodies of that kind and the numbers of their motions.
        sensors: number of the motion by the sensor's pointer.
        meshes: meshes with velocities at their vertices.
        winds: media that move, as (medium, volume of its velocities).

    Raises:
        SceneError: for motions of objects that are not there, of several at once, or that have none.
    """

    def __init__(self, scene: Any) -> None:
        shapes = shapes_of_scene(scene)
        pairs, self.winds = _motions(scene, shapes), _winds(scene, shapes)
        self.motions = list({motion.ptr: motion for _, motion in pairs}.values())
        numbers = {motion.ptr: FIRST + n for n, motion in enumerate(self.motions)}
        found: dict[int, int] = {}
        for body, motion in pairs:
            if found.setdefault(body.ptr, numbers[motion.ptr]) != numbers[motion.ptr]:
                raise SceneError(f"{body.id()!r}: expected one rigid_motion, got several.")
        bodies = list({body.ptr: body for body, _ in pairs}.values())

        def of_kind(kind: Any) -> list[tuple[Any, int]]:
            return [(body, found[body.ptr]) for body in bodies if isinstance(body, kind)]

        self.shapes, self.emitters, self.media = of_kind(mi.Shape), of_kind(mi.Emitter), of_kind(mi.Medium)
        self.sensors = {sensor.ptr: number for sensor, number in of_kind(mi.Sensor)}
        for medium, _ in self.winds:
            if found.setdefault(medium.ptr, REST) != REST:
                raise SceneError(f"{medium.id()!r}: expected one velocity, got a rigid_motion and a volume.")
        # What is part of a shape moves with it, and so does the medium inside.
        for medium, number in _inside(self.shapes, shapes):
            if found.setdefault(medium.ptr, number) == number:
                self.media.append((medium, number))
        for part in (*scene.emitters(), *scene.sensors()):
            shape = part.get_shape()
            if shape is not None and shape.ptr in found:
                if isinstance(part, mi.Sensor):
                    self.sensors.setdefault(part.ptr, found[shape.ptr])
                else:
                    self.emitters.append((part, found[shape.ptr]))
        self.meshes = [shape for shape in shapes if has_velocities(shape)]
        own = {shape.ptr for shape in scene.shapes()}
        if wrong := [mesh.id() for mesh in self.meshes if mesh.ptr not in own]:
            raise SceneError(
                f"{some_of(wrong)}: {VELOCITY} inside of a shape group is not supported; expected a mesh of the scene. "
                "Instances take a 'velocity' of type 'rigid_motion'."
            )

    def __bool__(self) -> bool:
        return bool(self.motions or self.meshes or self.winds)


def unmeasured(keys: Sequence[str]) -> str:
    """Return the warning of derivatives by velocities on a film without rates.

    Args:
        keys: parameters, at least one.
    """
    return (
        f"the derivative by {', '.join(map(repr, keys))} is zero: a velocity changes the rates of paths and nothing "
        "else, and the film measures none. Render with rates=tt.RateAxis(...) or chirps=tt.Chirps(...), or leave the "
        "key out."
    )


AT_REST = (
    "nothing moves: all light is at rate zero. Give bodies velocities with scene.moving({name: tt.Motion(...)}), or "
    "render with time_axis=tt.TimeAxis(...)."
)


def movers_of(scene: Any, contents: Any) -> Movers:
    """Return the bodies of a scene that move, looked up once.

    Args:
        scene: Mitsuba scene.
        contents: its :class:`.scene_contents.SceneContents`.
    """
    found: Movers = contents.memory.get("movers", 0, lambda: Movers(scene))
    return found


def _motions(scene: Any, shapes: list[Any]) -> list[tuple[Any, Any]]:
    """Return (body, ``rigid_motion``) of all bodies that have one. Raises SceneError for bodies that cannot."""
    bodies: dict[str, list[Any]] = {}
    for body in (*shapes, *scene.emitters(), *scene.sensors(), *_media_of(scene, shapes)):
        bodies.setdefault(body.id(), []).append(body)
    pairs = [(shape, held) for shape in shapes for _, held in objects_of(shape) if _is_motion(held)]
    for shape, held in pairs:
        if held.of not in ("", shape.id()):
            raise SceneError(f"rigid_motion: expected no other 'of' inside of {shape.id()!r}, got {held.of!r}.")
    for _, motion in objects_of(scene):
        if _is_motion(motion):
            if motion.of not in bodies:
                raise SceneError(
                    f"rigid_motion {motion.id()!r}: expected the name of a shape, an emitter, a sensor or a medium, "
                    f"one of {some_of(sorted(filter(None, bodies)))}, got {motion.of!r}. Mitsuba "
                    "merges shapes, which then have no names: load with tt.load, or mi.load_file(..., optimize=False)."
                )
            pairs += [(body, motion) for body in bodies[motion.of]]
    own = {shape.ptr for shape in scene.shapes()}
    for body, _ in pairs:
        if isinstance(body, mi.Shape) and body.ptr not in own:
            raise SceneError(f"{body.id()!r}: expected the motion of its instances; it is inside of a shape group.")
        part = body.get_shape() if isinstance(body, mi.Emitter | mi.Sensor) else None
        if part is not None:
            raise SceneError(f"{body.id()!r}: expected the motion of {part.id()!r}, the shape that it is part of.")
        if isinstance(body, mi.Emitter):
            far = mi.EmitterFlags.Infinite, mi.EmitterFlags.DeltaDirection
            if any(mi.has_flag(body.flags(), flag) for flag in far):
                raise SceneError(f"{body.id()!r}: expected a near light; light from infinity has no place that moves.")
    return pairs


def _winds(scene: Any, shapes: list[Any]) -> list[tuple[Any, Any]]:
    """Return (medium, volume) of the media whose velocities are volumes. Raises SceneError for others."""
    media = {medium.id(): medium for medium in _media_of(scene, shapes)}
    winds = [(moved_by(held), held) for _, held in objects_of(scene)]
    for name, volume in winds:
        if name is None:
            continue
        if name not in media:
            raise SceneError(f"{volume.id()!r}: expected the name of a medium, got {name!r}; other bodies are rigid.")
        if volume.channel_count() != 3:
            raise SceneError(
                f"{volume.id()!r}: expected velocities in three channels, m/s, got {volume.channel_count()}. A "
                "gridvolume of them has raw=true and data (Z, Y, X, 3)."
            )
    return [(media[name], volume) for name, volume in winds if name is not None]


def _inside(moving: list[tuple[Any, int]], shapes: list[Any]) -> list[tuple[Any, int]]:
    """Return the media inside of shapes that move, with the numbers of their motions, but for those that others bound.

    Args:
        moving: shapes that move, as (shape, number of its motion).
        shapes: all shapes of the scene.
    """
    bounding: dict[int, set[int]] = {}
    for shape in shapes:
        if shape.is_medium_transition() and shape.interior_medium() is not None:
            bounding.setdefault(shape.interior_medium().ptr, set()).add(shape.ptr)
    inside = [(shape, number) for shape, number in moving if shape.is_medium_transition()]
    media = [(shape.interior_medium(), number) for shape, number in inside if shape.interior_medium() is not None]
    return [(medium, number) for medium, number in media if len(bounding[medium.ptr]) == 1]


def _media_of(scene: Any, shapes: list[Any]) -> list[Any]:
    found = [sensor.get_medium() for sensor in scene.sensors()]
    for shape in shapes:
        if shape.is_medium_transition():
            found += [shape.interior_medium(), shape.exterior_medium()]
    return list({medium.ptr: medium for medium in found if medium is not None}.values())


def _is_motion(plugin: Any) -> bool:
    """Return True for a ``rigid_motion``."""
    return hasattr(plugin, "rows") and hasattr(plugin, "of")


class Velocities:
    """Velocities of one job. A plain object, which Dr.Jit loops leave alone.

    Velocities are Vector3f, m/s; attached where their motions and the points are.

    Attributes:
        sensor_moves: the sensor has a velocity.
        lights: emitters that have a motion.
    """

    @staticmethod
    def of_job(scene: Any, contents: Any, film: Any) -> Velocities | None:
        """Return the velocities of a job; None where the film measures no rates.

        Args:
            scene: scene of the job.
            contents: :class:`.scene_contents.SceneContents`, which keeps the result.
            film: film of the job.
        """
        return Velocities(movers_of(scene, contents), contents.sensor) if film.knows_rates else None

    def __init__(self, movers: Movers, sensor: Any) -> None:
        rows = [(mi.Vector3f(0), mi.Vector3f(0))] * FIRST + [motion.rows() for motion in movers.motions]
        if is_batch(sensor) and any(one.ptr in movers.sensors for one in (sensor, *sensors_of(sensor))):
            raise SceneError(f"{sensor.id()!r}: expected sensors of a batch at rest; render moving ones by themselves.")
        number = movers.sensors.get(sensor.ptr)
        if number is not None:
            rows[SENSOR] = rows[number]
        self.sensor_moves, self.lights = number is not None, [light for light, _ in movers.emitters]
        self._moving = {shape.ptr for shape, _ in movers.shapes} | {mesh.ptr for mesh in movers.meshes}
        self.table = dr.concat([mi.Float(part[k]) for row in rows for part in row for k in range(3)])
        self._shapes, self._emitters, self._media = (
            PointerTable([body for body, _ in found], [number for _, number in found]) if found else None
            for found in (movers.shapes, movers.emitters, movers.media)
        )
        self._winds = [volume for _, volume in movers.winds]
        numbers = range(1, 1 + len(self._winds))
        self._wind_of = PointerTable([body for body, _ in movers.winds], list(numbers)) if self._winds else None
        self._instances = any(is_instance(shape) for shape, _ in movers.shapes)
        self._meshes = PointerTable.marking(movers.meshes)
        self._mesh_lights = PointerTable.marking([mesh.emitter() for mesh in movers.meshes if mesh.is_emitter()])

    def tables(self) -> list[Any]:
        """Return the arrays that were computed from parameters."""
        return [self.table]

    def moves(self, shape: Any) -> bool:
        """Return True for a shape with a velocity, of the whole or of its vertices."""
        return shape.ptr in self._moving

    # ---------------------------------------------------------------------------------------------------- velocities

    def _row(self, row: Any, p: Any, active: Any) -> Any:
        active = active & (row > 0)  # not in place: the mask is the caller's
        linear, angular = (dr.gather(mi.Vector3f, self.table, row * 2 + k, active) for k in (0, 1))
        # Points of other lanes may be infinite.
        return linear + dr.cross(angular, dr.select(active, mi.Vector3f(p), 0))

    def _listed(self, table: PointerTable | None, plugin: Any, p: Any, active: Any) -> Any:
        if table is None:
            return mi.Vector3f(0)
        with dr.suspend_grad():
            row = table.look_up(plugin, active)
        return self._row(row, p, active)

    def of_sensor(self, p: Any) -> Any:
        """Return the velocity of the sensor's point ``p``."""
        return self._row(mi.UInt32(SENSOR), p, mi.Bool(True)) if self.sensor_moves else mi.Vector3f(0)

    def of_light(self, emitter: Any, p: Any, active: Any, found: Callable[[], Any]) -> Any:
        """Return the velocity of the point ``p`` of a light.

        Args:
            found: function that returns :func:`.geometry_terms.point_of_light`, called where vertices of lights move.
        """
        v = self._listed(self._emitters, emitter, p, active)
        if self._mesh_lights is None:
            return v
        with dr.suspend_grad():
            ray, pi, there, _ = found()
            there = active & there & self._mesh_lights.lists(emitter)
            si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, there)
        si.p = mi.Point3f(p)
        return v + dr.select(there, mi.Vector3f(si.shape.eval_attribute_3(VELOCITY, si, there)), 0)

    def of_sampled_light(self, context: Any, ref: Any, ds: Any, active: Any) -> Any:
        """Return the velocity of a sampled point of a light, zero for one outside of the scene.

        Args:
            ref: Interaction3f that the light is seen from.
            ds: the point, with ``p`` and ``emitter``, None outside of the scene.
        """
        if ds.emitter is None:
            return mi.Vector3f(0)
        return self.of_light(ds.emitter, ds.p, active, partial(point_of_light, context, ref, ds, active))

    def of_medium(self, medium: Any, p: Any, active: Any) -> Any:
        """Return the velocity of a medium at the point ``p``."""
        v = self._listed(self._media, medium, p, active)
        if self._wind_of is None:
            return v
        with dr.suspend_grad():
            number = self._wind_of.look_up(medium, active)
        for n, wind in enumerate(self._winds, 1):
            on, at = active & (number == n), dr.zeros(mi.Interaction3f)
            at.p = dr.select(on, mi.Point3f(p), 0)
            v += dr.select(on, mi.Vector3f(wind.eval_3(at, on)), 0)
        return v

    def of_surface(self, si: Any, active: Any) -> Any:
        """Return the velocity of the material point at a SurfaceInteraction3f."""
        v = self._listed(self._shapes, si.shape, si.p, active)
        if self._instances:
            v += self._listed(self._shapes, si.instance, si.p, active)
        if self._meshes is not None:
            with dr.suspend_grad():
                bends = active & self._meshes.lists(si.shape)
            v += dr.select(bends, mi.Vector3f(si.shape.eval_attribute_3(VELOCITY, si, bends)), 0)
        return v

    def of_vertex(self, vertex: Any, si: Any, active: Any) -> Any:
        """Return the velocity of a vertex.

        Args:
            vertex: :class:`.strategy.Vertex` or :class:`.strategy.AttachedVertex`.
            si: its SurfaceInteraction3f, at the point itself in a medium.
        """
        scatter = getattr(vertex, "scatter", None)
        if scatter is None:
            return self.of_surface(si, active)
        v = self.of_surface(si, active & ~scatter)
        return v + self.of_medium(vertex.mei.medium, vertex.mei.p, active & scatter)

    # --------------------------------------------------------------------------------------------------------- primal

    def arrive(self, context: Any, path: Any, vertex: Any) -> None:
        """Set the ``velocity`` of a vertex, and the ``rate`` of the path up to it."""
        vertex.velocity = self.of_vertex(vertex, vertex.si, vertex.valid)
        longer = path.η * dr.dot(vertex.velocity - path.prev_v, path.ray.d)
        vertex.rate = path.rate + (dr.select(path.depth == 0, 0, longer) if context.camera_unwarp else longer)

    def of_event(self, context: Any, connection: Any, vertex: Any, proposal: Any, answer: Any) -> Any:
        """Return the rate of the whole path of an event, Float."""
        if proposal is None or connection.unwarp:
            return vertex.rate
        v = connection.end_velocity(context, vertex, proposal)
        longer = vertex.η * answer.eta * dr.dot(v - vertex.velocity, proposal.d)
        return vertex.rate + longer + connection.rate_beyond(proposal)
