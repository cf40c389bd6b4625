"""Gaps in the derivatives of moving edges, in words: for the table of parameters and for warnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.edges.topology import Body
from torchtransient.plugins.kernel_arrays import host_numbers, registry_number
from torchtransient.plugins.mitsuba_compat import (
    NORMALS,
    TEXCOORDS,
    attribute_name,
    has_normals,
    is_bump_map,
    mesh_faces,
    mesh_positions,
    near_clip,
    normal_texture,
)
from torchtransient.plugins.mitsuba_shapes import (
    has_limb,
    has_surface,
    has_vertices,
    is_flat,
    is_instance,
    is_sphere,
    lacks_edges,
)
from torchtransient.plugins.node_walk import bsdfs_of_scene, objects_below, objects_of, shapes_of_scene
from torchtransient.plugins.parameter_effect import CORRECT, ParameterEffect
from torchtransient.plugins.sampling.lights import MovingSun
from torchtransient.plugins.sensors.seen_from import SensorPlaces, can_be_connected, has_eye, sees_one_line
from torchtransient.plugins.transport.boundary.crossings import clipped_shapes, crossing_bodies
from torchtransient.plugins.transport.scene_contents import is_open
from torchtransient.plugins.transport.strategy import Local

# Roles of what moves edges against what is behind them, and of what bends light, which moves edges that are seen
# through it.
_MOVE, _BEND = ("shape", "emitter", "sun", "sensor"), ("index", "normal")
# Of a mesh: they move no point.
_PLACELESS = (NORMALS, TEXCOORDS)
# Delta vertices at most between a sensor and the edges that it sees through them: a slab of glass has two, one that is
# seen in a mirror three.
LONGEST = 4
# Planes of a shape up to which all chains of them are found.
_PLANES = 32
_SEEN = "where edges are seen in mirrors, or through smooth glass or masks"
_TAKE_ROUGH = "Take a rough surface in place of the smooth one, or keep edges out of its view."
# Places at which a texture is asked whether it is smooth, along each side.
_PROBES = 64


@dataclass(frozen=True)
class Gap:
    """Edges that a derivative does not follow.

    Attributes:
        where: words that go on from "correct except".
        remedy: sentence that says what to do.
        is_asked_for: the boundary term was switched off.
    """

    where: str
    remedy: str
    is_asked_for: bool = False

    def message(self, keys: Sequence[str]) -> str:
        """Return the warning that names the parameters ``keys``."""
        named = ", ".join(map(repr, keys))
        lacking = "it lacks what moving edges hide and uncover there"
        return f"the derivative by {named} is wrong {self.where}: {lacking}. {self.remedy}"


def moves_edges(key: str, effect: ParameterEffect) -> bool:
    """Return True if a parameter moves the hiding shape, the hidden one, or the viewer.

    Args:
        key: name of the parameter in its plugin.
        effect: effect of the parameter.
    """
    return effect.moves_silhouette and effect.role in _MOVE and not key.endswith(_PLACELESS)


class MovingEdges:
    """Gaps in a scene's derivatives where edges move, looked up by parameter (:meth:`lacking`).

    Args:
        always: gaps of every parameter that moves edges.
        bent: gaps of parameters that bend light alone.
        scene: scene that is searched for textures with steps, for bodies that run into each other, for shapes that clip
            planes cut and for normals that turn away, or None.
        words: gaps that only the table of parameters names, whatever the scene.
        has_term: there is a boundary term.
        sensors: sensors of the scene that see the edges.
    """

    def __init__(
        self,
        always: Sequence[Gap] = (),
        bent: Sequence[Gap] = (),
        scene: Any = None,
        words: Sequence[str] = (),
        has_term: bool = True,
        sensors: Sequence[Any] = (),
    ) -> None:
        self.always, self.bent, self.words = tuple(always), tuple(bent), tuple(words)
        self.has_term = has_term
        self._scene, self._sensors = scene, tuple(sensors)
        self._steps: dict[int, list[str]] = {}

    def lacking(self, node: Any, key: str, effect: ParameterEffect) -> tuple[Gap, ...]:
        """Return the gaps of the derivative by a parameter.

        Args:
            node, key: plugin, and name of the parameter there.
            effect: effect of the parameter.
        """
        if not (effect.moves_silhouette and effect.supported):
            return ()
        name, moves = key.rsplit(".", 1)[-1], moves_edges(key, effect)
        found = self.always if moves else ()
        if not moves and (effect.role in _BEND or name == NORMALS):
            found += self.bent
        if (moves and effect.role in ("shape", "sensor")) or name == TEXCOORDS:
            # Mitsuba does not show the members of an instance; relative to a moving sensor all shapes move.
            alone = effect.role != "sensor" and isinstance(node, mi.Shape) and not is_instance(node)
            found += self._jumps(node if alone else None)
        if (moves and effect.role in ("shape", "sensor")) or effect.role == "value":
            found += self._turned_away(None if effect.role == "sensor" or is_instance(node) else node)
        if name == NORMALS and any(node.ptr == shape.ptr for shape in self._turned_away_shapes[1]):
            where = f"at the rim of {_name(node)}, where normals of its vertices turn away from the camera"
            found += (Gap(where, "Move its vertices, or take finer faces, of which the rim is narrower."),)
        if moves and (effect.role == "sensor" or isinstance(node, mi.Shape)):
            moving = None if effect.role == "sensor" else node
            found += self._crossings(moving) + self._clipped(moving)
        if effect.role == "sun" and self._scene is not None and _is_in_view(self._scene, node):
            found += (Gap("at the rim of the sun where it is itself in view", "Keep it out of the picture."),)
        return tuple(dict.fromkeys(found))

    def reason(self, node: Any, key: str, effect: ParameterEffect) -> str:
        """Return the reason of an effect, with the gaps of the derivative; arguments as in :meth:`lacking`."""
        words = list(self.words) if effect.supported and moves_edges(key, effect) else []
        words += [gap.where for gap in self.lacking(node, key, effect)]
        if not words:
            return effect.reason
        text = f"{CORRECT} except {', '.join(words)} (no boundary term)"
        more = effect.reason.removeprefix(CORRECT).removeprefix("; ")
        return f"{text}; {more}" if more else text

    def _jumps(self, shape: Any) -> tuple[Gap, ...]:
        """Return the gap of textures with steps on a shape, on any for None."""
        if self._scene is None:
            return ()
        address = 0 if shape is None else shape.ptr
        if address not in self._steps:
            shapes = shapes_of_scene(self._scene) if shape is None else [shape]
            self._steps[address] = [_name(one) for one in shapes if has_surface(one) and _is_stepped(one)]
        names = self._steps[address]
        if not names:
            return ()
        where = f"at the steps of textures on what moves (on {_listed(names)})"
        return (Gap(where, "Take a smooth texture there, of filter_type 'bilinear'."),)

    @cached_property
    def _crossing_pairs(self) -> list[tuple[Body, Body]]:
        return [] if self._scene is None else crossing_bodies(self._scene)

    def _crossings(self, shape: Any) -> tuple[Gap, ...]:
        """Return the gap of bodies that run into each other, one of which moves with a shape; a sensor (None) sees any.
        """
        pairs = self._crossing_pairs
        if shape is not None:
            moving = frozenset([shape.ptr])
            pairs = [pair for pair in pairs if any(body.moves(moving) for body in pair)]
        if not pairs:
            return ()
        where = f"where {_listed([_named_pair(*pair) for pair in pairs])} run into each other"
        return (Gap(where, "Keep a gap between them, or join them to one mesh that has an edge there."),)

    @cached_property
    def _turned_away_shapes(self) -> tuple[list[Any], list[Any]]:
        return ([], []) if self._scene is None else _shapes_turned_away(self._scene, self._sensors)

    def _turned_away(self, node: Any) -> tuple[Gap, ...]:
        """Return the gap of normal maps on a shape, or in a texture, that turn away from a sensor; of any for None."""
        shapes, _ = self._turned_away_shapes
        if node is not None:
            shapes = [one for one in shapes if node.ptr in _addresses(one)]
        if not shapes:
            return ()
        where = f"where the normal maps of {_listed_shapes(shapes)} turn normals away from the camera"
        return (Gap(where, "Take flatter normals, or look at them less obliquely."),)

    @cached_property
    def _clipped_shapes(self) -> list[Any]:
        return [] if self._scene is None else clipped_shapes(self._scene, self._sensors)

    def _clipped(self, shape: Any) -> tuple[Gap, ...]:
        """Return the gap of clip planes that cut a shape in view; relative to a sensor that moves (None) any does."""
        cut = [one for one in self._clipped_shapes if shape is None or one.ptr == shape.ptr]
        if not cut:
            return ()
        where = f"where the clip planes of the camera cut {_listed_shapes(cut)}"
        return (Gap(where, "Take a near_clip and a far_clip between which all lies that is in view."),)


def missing(reason: str, remedy: str, *, is_asked_for: bool = False) -> MovingEdges:
    """Return the gaps of an integrator without a boundary term.

    Args:
        reason: reason why it has none, in words that go on from "since".
        remedy: sentence that says what to do.
        is_asked_for: it was switched off.
    """
    gap = Gap(f"where silhouettes move, since {reason}", remedy, is_asked_for)
    return MovingEdges((gap,), (gap,), has_term=False)


def switched_off() -> MovingEdges:
    """Return the gaps of an integrator whose ``boundary`` is false."""
    remedy = "Take out boundary=False, of the renderer or of the scene's integrator."
    return missing("boundary is false", remedy, is_asked_for=True)


def moving_edges(scene: Any, sensors: Sequence[Any], max_depth: int | None = None) -> MovingEdges:
    """Return the gaps that the passes of the boundary term (:mod:`.term`) leave in a scene.

    Args:
        scene: scene.
        sensors: sensors that see the edges.
        max_depth: largest number of segments of a path, None for any.
    """
    always, bent = rims_without_edges(scene), []
    if rims := [emitter.get_shape() or emitter for emitter in scene.emitters() if _has_rim(emitter)]:
        where = f"at the rim of the light of {_listed_shapes(rims)}"
        always.append(Gap(where, "Let the light fade out, by a beam_width below the cutoff_angle for instance."))
    shapeless = [emitter for emitter in scene.emitters() if emitter.get_shape() is None]
    if stepped := [one for one in shapeless if any(map(_has_steps, objects_below(one, mi.Texture)))]:
        where = f"at the steps in the light of {_listed_shapes(stepped)}"
        always.append(Gap(where, "Take a smooth texture there, of filter_type 'bilinear'."))
    for sensor in sensors:
        if sees_one_line(sensor):
            if lights := [emitter for emitter in scene.emitters() if _is_met_by_connections_alone(emitter)]:
                names = _listed([_name(one.get_shape() or one) for one in lights])
                where = f"at the edges of shadows of {names} that the sensor {_name(sensor)} sees"
                always.append(Gap(where, "Take an area light that is no sphere, or a camera of one small pixel."))
        elif not can_be_connected(sensor):
            where = f"what the sensor {_name(sensor)} sees of edges"
            always.append(Gap(where, "Take a perspective, thinlens or orthographic camera, or an irradiancemeter."))
    if delayed := [bsdf for bsdf in bsdfs_of_scene(scene) if getattr(bsdf, "shift", None) is not None]:
        where = f"in light of other wavelengths at the edges of shadows on {_listed([_name(one) for one in delayed])}"
        always.append(Gap(where, "Keep edges that move out of the light of what fluoresces."))
    if smooth := _smooth_shapes(scene):
        always += _seen_through_delta_lobes(scene, sensors, smooth, max_depth)
        bent = edges_in_mirrors(scene)
    return MovingEdges(always, bent, scene, sensors=sensors)


def rims_without_edges(scene: Any) -> list[Gap]:
    """Return the gap of shapes with outlines that the table of edges does not hold, if there are some.

    Args:
        scene: Mitsuba scene.
    """
    if not (shapes := [shape for shape in shapes_of_scene(scene) if lacks_edges(shape)]):
        return []
    where = f"at the rims of {_listed_shapes(shapes)}, which have no edges"
    return [Gap(where, "Use a mesh of the same form.")]


def edges_in_mirrors(scene: Any) -> list[Gap]:
    """Return the gap of edges that are seen by way of delta lobes, if some surface has one.

    Args:
        scene: Mitsuba scene.
    """
    smooth = _smooth_shapes(scene)
    return [Gap(f"{_SEEN} ({_listed_shapes(smooth)})", _TAKE_ROUGH)] if smooth else []


def _seen_through_delta_lobes(
    scene: Any, sensors: Sequence[Any], smooth: Sequence[Any], max_depth: int | None
) -> list[Gap]:
    """Return gaps where delta lobes of the shapes ``smooth`` show edges, or send light past them."""
    media = any(shape.is_medium_transition() for shape in shapes_of_scene(scene))
    followed = not media and all(has_eye(sensor) and sensor.get_medium() is None for sensor in sensors)
    plane = [one for one in smooth if followed and _is_plane(one)]
    gaps = []
    if other := [one for one in smooth if one not in plane]:
        gaps.append(Gap(f"{_SEEN} ({_listed_shapes(other)})", _TAKE_ROUGH))
    if plane and (max_depth is None or max_depth > 2):
        seen = f"{_SEEN} ({_listed_shapes(plane)}), but for a camera behind at most {LONGEST} planes"
        gaps.append(Gap(f"{seen}, and where they cast shadows in light from there", _TAKE_ROUGH))
    refracting = [one for one in plane if mi.has_flag(one.bsdf().flags(), mi.BSDFFlags.DeltaTransmission)]
    if refracting and (limbs := [one for one in shapes_of_scene(scene) if has_limb(one)]):
        names = _listed_shapes(refracting)
        where = f"where outlines of {_listed_shapes(limbs)} are seen through smooth glass ({names})"
        gaps.append(Gap(where, "Use a mesh of the same form."))
    return gaps


def _smooth_shapes(scene: Any) -> list[Any]:
    """Return the shapes with delta lobes, but for open boundaries of media, which paths pass."""
    shapes = [shape for shape in shapes_of_scene(scene) if has_surface(shape) and has_delta_lobe(shape)]
    return [shape for shape in shapes if not (shape.is_medium_transition() and is_open(shape))]


def _is_plane(shape: Any) -> bool:
    """Return True if a shape consists of few planes that mirror or refract by their own normals."""
    if not is_flat(shape):
        return False
    if isinstance(shape, mi.Mesh) and _number_of_planes(shape) > _PLANES:
        return False
    n = _PROBES * _PROBES
    random = mi.PCG32(size=n)
    uniform = lambda: mi.Point2f(random.next_float32(), random.next_float32())  # noqa: E731
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wavelengths, si.uv, si.t = dr.full(type(si.wavelengths), 550, n), uniform(), mi.Float(1)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    wi = mi.warp.square_to_uniform_sphere(uniform())
    si.wi = wi
    bs, _ = shape.bsdf().sample(mi.BSDFContext(), si, random.next_float32(), uniform())
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) & (bs.pdf > 0)
    bent = dr.select(wi.z * bs.wo.z > 0, 1, dr.rcp(bs.eta))
    off = dr.norm(mi.Vector2f(bs.wo.x + bent * wi.x, bs.wo.y + bent * wi.y))
    return not bool(dr.any(delta & (off > 1e-3)))


def _number_of_planes(mesh: Any) -> int:
    faces = np.array(mesh_faces(mesh)).reshape(-1, 3)
    p = host_numbers(mesh_positions(mesh), np.float64).reshape(-1, 3)[faces]
    n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-30)
    offset = (n * p[:, 0]).sum(1, keepdims=True) / max(np.abs(p).max(), 1e-30)
    return len(np.unique(np.concatenate([n, offset], 1).round(3), axis=0))


def _is_met_by_connections_alone(emitter: Any) -> bool:
    """Return True if connections alone differentiate an emitter: points, directions and spheres."""
    delta = mi.EmitterFlags.DeltaPosition | mi.EmitterFlags.DeltaDirection
    shape = emitter.get_shape()
    return bool(mi.has_flag(emitter.flags(), delta)) or (shape is not None and is_sphere(shape))


def _is_in_view(scene: Any, sky: Any) -> bool:
    """Return True if a sensor looks into the sun of a sky, whatever is in between."""
    at, d = dr.zeros(mi.Interaction3f), dr.detach(MovingSun(scene, sky).direction)
    for sensor in filter(can_be_connected, scene.sensors()):
        places = SensorPlaces(sensor, sensor.film(), mi.Float(1))
        for number, camera in enumerate(places.cameras):
            carrier = camera.get_shape()
            o = camera.world_transform() @ mi.Point3f(0) if carrier is None else carrier.bbox().center()
            at.p = mi.Point3f(o) + d * (near_clip(camera) or 0) * 2 + d
            numbers = Local(aperture=mi.Point2f(0.5), wavelength=mi.Float(0), camera=mi.UInt32(number))
            seen, _ = places.seen_from(at, numbers, mi.Bool(True))
            inside = (seen.pdf > 0) & dr.all((seen.uv >= 0) & (seen.uv <= places.size))
            if bool(dr.any(inside)):
                return True
    return False


def has_delta_lobe(shape: Any) -> bool:
    """Return True if a shape has a BSDF with a delta lobe.

    Args:
        shape: one ``mi.Shape``.
    """
    bsdf = shape.bsdf()
    return bsdf is not None and bool(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta))


def _addresses(shape: Any) -> set[int]:
    """Return the addresses of a shape and of the textures of its BSDF."""
    return {shape.ptr, *(texture.ptr for texture in objects_below(shape.bsdf(), mi.Texture))}


def _normal_maps(shape: Any) -> list[Any]:
    """Return the textures of normals of a shape's BSDF."""
    if not has_surface(shape) or shape.bsdf() is None:
        return []
    bsdfs = [one for one in (shape.bsdf(), *objects_below(shape.bsdf(), mi.BSDF)) if isinstance(one, mi.BSDF)]
    names = [(bsdf, normal_texture(bsdf)) for bsdf in bsdfs if not is_bump_map(bsdf)]
    return [dict(objects_of(bsdf))[name] for bsdf, name in names if name is not None]


def _shapes_turned_away(scene: Any, sensors: Sequence[Any]) -> tuple[list[Any], list[Any]]:
    """Return the shapes of which a sensor sees places where a normal map turns the normal away from it, and those where
    normals at vertices do.

    Mitsuba draws such places with another normal, or black: the light jumps there.
    """
    shapes = [shape for shape in shapes_of_scene(scene) if has_surface(shape)]
    mapped = [(shape, maps) for shape in shapes if (maps := _normal_maps(shape))]
    smooth = [shape for shape in shapes if has_vertices(shape) and has_normals(shape)]
    found: tuple[dict[int, Any], dict[int, Any]] = {}, {}
    if not (mapped or smooth):
        return [], []
    with dr.suspend_grad():
        for sensor in sensors:
            random = mi.PCG32(size=_PROBES * _PROBES)
            uniform = lambda random=random: mi.Point2f(random.next_float32(), random.next_float32())  # noqa: E731
            ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, uniform(), uniform())
            si = scene.ray_intersect(ray)
            dr.eval(si)  # read once for each texture
            wi = mi.Vector3f(si.wi.x, si.wi.y, dr.abs(si.wi.z))
            for shape, maps in mapped:
                hit = si.is_valid() & (si.shape == mi.ShapePtr(shape))
                for texture in maps:
                    n = mi.Vector3f(texture.eval_3(si, hit)) * 2 - 1
                    if bool(dr.any(hit & (dr.dot(n, wi) < 0))):
                        found[0][shape.ptr] = shape
            # Of faces that turn another side out than their normals, all hits have the one sign, which is no rim.
            sign = dr.select(si.is_valid(), dr.dot(si.sh_frame.n, ray.d) * dr.dot(si.n, ray.d), 0)
            number = dr.reinterpret_array(mi.UInt32, si.shape)
            away, towards = (np.unique(np.array(dr.select(one, number, 0))) for one in (sign < 0, sign > 0))
            both = np.intersect1d(away, towards)
            found[1].update({shape.ptr: shape for shape in smooth if registry_number(shape) in both})
    return list(found[0].values()), list(found[1].values())


def _is_stepped(shape: Any) -> bool:
    """Return True if something jumps from place to place on a shape: a texture with steps, the slope of a bump map."""
    holders = [part for part in (shape.bsdf(), shape.emitter()) if part is not None]
    nested = [bsdf for holder in holders for bsdf in (holder, *objects_below(holder, mi.BSDF))]
    if any(isinstance(bsdf, mi.BSDF) and is_bump_map(bsdf) for bsdf in nested):
        return True
    return any(_has_steps(texture) for holder in holders for texture in objects_below(holder, mi.Texture))


def _has_steps(texture: Any) -> bool:
    """Return True if a texture is flat at all probes, and not the same everywhere; Mitsuba does not show its filter."""
    attribute = attribute_name(texture)
    if attribute is not None:
        return attribute.startswith("face_")
    if not texture.is_spatially_varying():
        return False
    si = dr.zeros(mi.SurfaceInteraction3f, _PROBES * _PROBES)
    si.wavelengths = dr.full(type(si.wavelengths), 550, _PROBES * _PROBES)
    random = mi.PCG32(size=_PROBES * _PROBES)
    si.uv = mi.Point2f(random.next_float32(), random.next_float32())
    with dr.resume_grad():
        # Forwards, and from the places alone: the numbers of the texture may be attached themselves.
        dr.enable_grad(si.uv)
        dr.set_grad(si.uv, mi.Point2f(1, 0.7))
        value = dr.sum(texture.eval(si), axis=0)
        dr.forward_from(si.uv)
        slope = dr.grad(value)
    value = dr.detach(value)
    return bool(dr.all(slope == 0)) and bool(dr.max(value)[0] > dr.min(value)[0])


def _has_rim(emitter: Any) -> bool:
    """Return True if the light of an emitter ends at once beside its direction."""
    if emitter.class_name() == "Projector":
        return True
    if emitter.class_name() == "SpotLight":
        shown = mi.traverse(emitter)
        return bool(dr.all(shown["beam_width"] >= shown["cutoff_angle"]))
    cutoff = getattr(emitter, "cutoff_angle", None)
    return cutoff is not None and cutoff < 90 and cutoff == emitter.beam_width


def _listed_shapes(shapes: Sequence[Any]) -> str:
    return _listed([_name(shape) for shape in shapes])


def _named_pair(one: Body, two: Body) -> str:
    """Return the names of two bodies: of instances, where these differ."""
    if one is two:
        return f"parts of {_name(one.shape)}"
    within = one.instance is not None and two.instance is not None and one.instance.ptr == two.instance.ptr
    return " and ".join(_name(body.shape if within or body.instance is None else body.instance) for body in (one, two))


def _name(plugin: Any) -> str:
    own = plugin.id()
    return plugin.class_name() if not own or own.startswith("_") else repr(own)


def _listed(names: Sequence[str], most: int = 3) -> str:
    """Return the first few names in words, each once."""
    names = list(dict.fromkeys(names))
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
