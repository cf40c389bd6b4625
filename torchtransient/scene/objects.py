"""Objects and scenes of Mitsuba that are loaded already: described where that is possible, otherwise taken as they are.

What is described is plain data again: it can be pickled, and built in any variant. An object holds no description: what
it was made of is gone. One that is taken as it is belongs to its variant and its process, is shared with whoever made
it, and keeps its plugins: nothing is built in their place. What that rules out is refused in words.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NoReturn

import numpy as np

from torchtransient.errors import SceneError
from torchtransient.plugins.dictionaries import Voxels
from torchtransient.plugins.node_walk import objects_below, objects_of
from torchtransient.plugins.parameter_effect import ParameterEffect, class_of
from torchtransient.rendering.variant import active_variant
from torchtransient.scene.edits import pixels_of, shown_properties

# Meshes that are nothing but their buffers and what their base class holds.
_PLAIN_MESHES = ("Mesh", "PLYMesh", "OBJMesh", "SerializedMesh", "Cube", "MergeShape")
WAY_OUT = "Give the scene as a dictionary or an XML file instead"


@dataclass(frozen=True, eq=False)
class Taken:
    """An object of Mitsuba inside a scene dictionary; ``where``: its place there."""

    value: Any
    where: str

    @property
    def variant(self) -> str:
        """The variant that the object belongs to."""
        return str(self.value.variant_name())

    def to_mitsuba(self) -> Any:
        """The object."""
        return self.value

    def __str__(self) -> str:
        return f"the {class_of(self.value)} at {self.where}"

    def __reduce__(self) -> NoReturn:
        raise SceneError(_cannot_travel(str(self), self.variant))


def _cannot_travel(what: str, variant: str) -> str:
    return (
        f"tt.Scene: {what} is a Mitsuba object that was taken as it is; it lives in this process and in {variant} "
        f"alone, and cannot be pickled or described. {WAY_OUT}."
    )


@dataclass(frozen=True, eq=False)
class ReadyScene:
    """A ``mitsuba.Scene`` that is rendered as it is, in place of a description."""

    scene: Any

    name = "ready mi.Scene"

    @property
    def variant(self) -> str:
        """The variant that the scene belongs to."""
        return str(self.scene.variant_name())

    @property
    def taken(self) -> tuple[Any, ...]:
        """What is not described."""
        return (self,)

    def check_described(self, what: str) -> None:
        """Raise ``SceneError``: ``what`` needs a description."""
        refuse(what, (self,))

    def check_variant(self, variant: str | None) -> None:
        """Raise ``SceneError`` for another variant."""
        check_variant((self,), variant)

    def __str__(self) -> str:
        return "the mi.Scene"

    def __reduce__(self) -> NoReturn:
        raise SceneError(_cannot_travel(str(self), self.variant))


def refuse(what: str, taken: tuple[Any, ...]) -> None:
    """Raise ``SceneError`` where something is not described."""
    if taken:
        raise SceneError(
            f"{what} needs a scene that is described; {taken[0]} is a Mitsuba object that was taken as it is. "
            f"{WAY_OUT}."
        )


def check_variant(taken: tuple[Any, ...], variant: str | None) -> None:
    """Raise ``SceneError`` where an object belongs to another variant than the scene is for."""
    for entry in taken:
        wanted = variant or taken[0].variant
        if entry.variant != wanted:
            raise SceneError(
                f"tt.load: {entry} is a Mitsuba object of {entry.variant} and was taken as it is, so that it cannot be "
                f"rendered in {wanted}. {WAY_OUT}, or leave variant out."
            )


def taken_below(tree: Any) -> tuple[Taken, ...]:
    """The objects that are not described in a tree of plain data."""
    if isinstance(tree, Taken):
        return (tree,)
    return tuple(found for entry in tree.values() for found in taken_below(entry)) if isinstance(tree, dict) else ()


def describe_object(value: Any, where: str) -> Any:
    """Plain data for an object of Mitsuba, or the object as it is. Raises ``SceneError`` for a scene inside another."""
    if value.class_name() == "VolumeGrid":
        return Voxels.of(value)
    if value.class_name() == "Scene":
        raise SceneError(f"tt.load: {where} is a whole mi.Scene; load that alone, tt.load(scene).")
    if class_of(value) in _PLAIN_MESHES:
        with active_variant(value.variant_name()):
            return _described_mesh(value) or Taken(value, where)
    return Taken(value, where)


def _described_mesh(mesh: Any) -> dict[str, Any] | None:
    """A mesh as arrays, None where it has more than these: attributes, light, media, a surface of other kinds."""
    import mitsuba as mi

    surface = _described_surface(mesh.bsdf())
    held = [value for _, value in objects_of(mesh) if not isinstance(value, mi.BSDF)]
    numbers = {name for name in mi.traverse(mesh).properties if "." not in name}
    known = {"vertex_positions", "vertex_normals", "vertex_texcoords", "faces", "silhouette_sampling_weight"}
    if surface is None or held or mesh.is_emitter() or mesh.is_sensor() or numbers - known or not mesh.face_count():
        return None
    described: dict[str, Any] = {
        "type": "mesh_arrays",
        "vertices": np.array(mesh.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3),
        "faces": np.array(mesh.faces_buffer(), dtype=np.int64).reshape(-1, 3),
        "bsdf": surface,
    }
    if mesh.has_vertex_normals():
        described["normals"] = np.array(mesh.vertex_normals_buffer(), dtype=np.float64).reshape(-1, 3)
    if mesh.has_vertex_texcoords():
        described["texcoords"] = np.array(mesh.vertex_texcoords_buffer(), dtype=np.float64).reshape(-1, 2)
    weight = float(mesh.silhouette_sampling_weight())
    described |= {} if weight == 1 else {"silhouette_sampling_weight": weight}
    flags = {"face_normals": mesh.has_face_normals(), "flip_normals": mesh.has_flipped_normals()}
    return described | {name: True for name, is_set in flags.items() if is_set}


def _described_surface(bsdf: Any) -> dict[str, Any] | None:
    """A diffuse surface of one colour, where its variant has kept the colour; None for others."""
    import mitsuba as mi

    if bsdf is None or bsdf.class_name() != "SmoothDiffuse" or mi.is_monochromatic:
        return None
    params = mi.traverse(bsdf)
    texture = dict(objects_of(bsdf))["reflectance"]
    value = np.array(params["reflectance.value"], dtype=np.float64).ravel() if len(params.keys()) == 1 else None
    if value is not None and texture.class_name() == "UniformSpectrum":
        return {"type": "diffuse", "reflectance": {"type": "uniform", "value": float(value[0])}}
    if value is not None and texture.class_name() == "SRGBReflectanceSpectrum" and mi.is_rgb:
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value.tolist()}}
    return None


# ------------------------------------------------------------------------------------------------------ when built


def pointers(taken: tuple[Any, ...]) -> frozenset[int]:
    """Which plugins of a built scene were taken as they are, with everything inside them."""
    import mitsuba as mi

    starts = [entry.scene if isinstance(entry, ReadyScene) else entry.value for entry in taken]
    found: set[int] = set()
    for start in starts:
        found |= {start.ptr, *(value.ptr for value in objects_below(start, mi.Object))}
        if isinstance(start, mi.Sensor):
            found.add(start.film().ptr)
        for sensor in start.sensors() if isinstance(start, mi.Scene) else ():
            found |= {sensor.ptr, sensor.film().ptr}
        if isinstance(start, mi.Scene) and start.integrator() is not None:
            found.add(start.integrator().ptr)
    return frozenset(found)


def without_stand_in(effect: ParameterEffect, plugin: Any) -> ParameterEffect:
    """Of a plugin that was taken as it is: another cannot be built in its place."""
    if not effect.stand_in_needed:
        return replace(effect, stand_in="")
    reason = (
        f"{class_of(plugin)} {plugin.id()!r} was taken as it is, and its derivative needs {effect.stand_in!r} in "
        "its place: make it one, or give the scene as a dictionary or an XML file"
    )
    return replace(effect, supported=False, reason=reason, stand_in="")


_INTEGRATORS = {
    "PathIntegrator": "path", "VolumetricPathIntegrator": "volpath", "VolpathMisIntegratorImpl": "volpathmis",
}  # fmt: skip
# Cameras with the parameters that they show and read under one name.
_CAMERAS = {
    "PerspectiveCamera": ("perspective", ("principal_point_offset_x", "principal_point_offset_y")),
    "ThinLensCamera": ("thinlens", ("aperture_radius", "focus_distance")),
    "OrthographicCamera": ("orthographic", ()),
}
_SAMPLERS = {
    "IndependentSampler": "independent", "StratifiedSampler": "stratified", "MultijitterSampler": "multijitter",
    "OrthogonalSampler": "orthogonal", "LowDiscrepancySampler": "ldsampler",
}  # fmt: skip


def described_for_time(scene: Any) -> dict[str, Any] | None:
    """Return a scene dictionary for a ``mi.Scene`` with a steady integrator or film; None for one without."""
    import mitsuba as mi

    tree: dict[str, Any] = {"type": "scene"}
    with active_variant(scene.variant_name()):
        for number, (name, value) in enumerate(objects_of(scene)):
            found = None
            if isinstance(value, mi.Integrator):
                found = _integrator(value)
            elif isinstance(value, mi.Sensor):
                found = _sensor(value)
            tree[value.id() or f"{name}_{number}"] = found or Taken(value, value.id() or name)
    return tree if any(isinstance(entry, dict) for entry in tree.values()) else None


def _integrator(value: Any) -> dict[str, Any] | None:
    plugin, said = _INTEGRATORS.get(value.class_name()), shown_properties(value)
    if plugin is None or not {"max_depth", "rr_depth"} <= said.keys():
        return None
    # Without a bound it is -1, as a number without sign.
    depths = {name: int(said[name]) for name in ("max_depth", "rr_depth")}
    depths = {name: -1 if depth >= 2**31 else depth for name, depth in depths.items()}
    return {"type": plugin, **depths, "hide_emitters": bool(value.hide_emitters)}


def _sensor(value: Any) -> dict[str, Any] | None:
    """A camera in vacuum with a steady film; None for other sensors."""
    import mitsuba as mi

    known, film, sampler = _CAMERAS.get(value.class_name()), _film(value.film()), _sampler(value.sampler())
    if known is None or film is None or sampler is None or value.get_medium() is not None:
        return None
    plugin, names = known
    shown = mi.traverse(value)
    camera = {
        "type": plugin,
        "near_clip": float(value.near_clip()),
        "far_clip": float(value.far_clip()),
        "shutter_open": float(value.shutter_open()),
        "shutter_close": float(value.shutter_open()) + float(value.shutter_open_time()),
        "to_world": np.array(shown["to_world"].matrix, dtype=np.float64).reshape(4, 4),
        **{name: float(np.ravel(shown[name])[0]) for name in names},
    }
    if "x_fov" in shown:
        camera |= {"fov": float(np.ravel(shown["x_fov"])[0]), "fov_axis": "x"}
    return camera | {"film": film, "sampler": sampler}


def _film(film: Any) -> dict[str, Any] | None:
    rfilter = _rfilter(film.rfilter())
    if film.class_name() != "HDRFilm" or film.sensor_response_function() is not None or rfilter is None:
        return None
    (width, height), (crop_width, crop_height) = film.size(), film.crop_size()
    left, top = film.crop_offset()
    return {
        "type": "hdrfilm",
        "width": int(width),
        "height": int(height),
        "crop_width": int(crop_width),
        "crop_height": int(crop_height),
        "crop_offset_x": int(left),
        "crop_offset_y": int(top),
        "sample_border": bool(film.sample_border()),
        "pixel_format": pixels_of(film),
        "rfilter": rfilter,
    }


def _rfilter(rfilter: Any) -> dict[str, Any] | None:
    kind, radius = rfilter.class_name(), float(rfilter.radius())
    found: dict[str, dict[str, Any]] = {
        "BoxFilter": {"type": "box"},
        "TentFilter": {"type": "tent", "radius": radius},
        "GaussianFilter": {"type": "gaussian", "stddev": radius / 4},
        "CatmullRomFilter": {"type": "catmullrom"},
        "LanczosSincFilter": {"type": "lanczos", "lobes": round(radius)},
    }
    return found.get(kind)


def _sampler(sampler: Any) -> dict[str, Any] | None:
    plugin, said = _SAMPLERS.get(sampler.class_name()), shown_properties(sampler)
    if plugin is None:
        return None
    found: dict[str, Any] = {"type": plugin, "sample_count": int(sampler.sample_count())}
    if "jitter" in said:
        found["jitter"] = said["jitter"].strip() in ("1", "true")
    return found
