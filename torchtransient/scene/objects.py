"""Objects and scenes of Mitsuba that users have loaded themselves: described if possible, otherwise used as they are.

A description is plain data: it can be pickled, and built in any variant. A loaded object no longer has the properties
that it was made of. It belongs to its variant and process, is shared with its owner, and keeps its plugins: calls that
need another plugin in its place are refused.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass, replace
from typing import Any, NoReturn

import numpy as np

from torchtransient.errors import SceneError
from torchtransient.plugins.dictionaries import Voxels
from torchtransient.plugins.mitsuba_compat import (
    has_more_than_arrays,
    has_normals,
    has_texcoords,
    mesh_faces,
    mesh_normals,
    mesh_positions,
    mesh_texcoords,
    silhouette_weight,
)
from torchtransient.plugins.node_walk import objects_below, objects_of
from torchtransient.plugins.parameter_effect import ParameterEffect, class_of
from torchtransient.scene.edits import pixel_format, printed_properties
from torchtransient.scene.variant import active_variant

# Meshes that are nothing but their buffers and what their base class holds.
_PLAIN_MESHES = ("Mesh", "PLYMesh", "OBJMesh", "SerializedMesh", "Cube", "MergeShape")
WAY_OUT = "Give the scene as a dictionary or an XML file instead"


class Description(abc.ABC):
    """Source of a scene: an XML file, a dictionary, or a loaded scene of Mitsuba."""

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """Name of the scene in messages."""

    @property
    def objects(self) -> tuple[Any, ...]:
        """Loaded objects of Mitsuba in the scene, which have no description."""
        return ()

    def check_described(self, caller: str) -> None:
        """Raise ``SceneError`` for loaded objects in the scene: ``caller`` needs a description.

        Args:
            caller: name of the caller, for the message.
        """
        if self.objects:
            raise SceneError(
                f"{caller} needs a scene that is described; {self.objects[0]} is a Mitsuba object that was taken as it "
                f"is. {WAY_OUT}."
            )

    def check_variant(self, variant: str | None) -> None:
        """Raise ``SceneError`` for loaded objects of another variant than the scene's.

        Args:
            variant: variant of the scene, None for that of the objects.
        """
        for entry in self.objects:
            wanted = variant or self.objects[0].variant
            if entry.variant != wanted:
                raise SceneError(
                    f"tt.load: {entry} is a Mitsuba object of {entry.variant} and was taken as it is, so that it "
                    f"cannot be rendered in {wanted}. {WAY_OUT}, or leave variant out."
                )


@dataclass(frozen=True, eq=False)
class LoadedObject:
    """Object of Mitsuba inside a scene dictionary, and the path of its keys there.

    Args:
        value: the object.
        where: path of its keys.
    """

    value: Any
    where: str

    @property
    def variant(self) -> str:
        """Variant of the object."""
        return str(self.value.variant_name())

    def to_mitsuba(self) -> Any:
        """Return the object, for the parser of dictionaries."""
        return self.value

    def __str__(self) -> str:
        return f"the {class_of(self.value)} at {self.where}"

    def __reduce__(self) -> NoReturn:
        _refuse_pickling(self)


@dataclass(frozen=True, eq=False)
class LoadedScene(Description):
    """``mitsuba.Scene`` that is rendered as it is, in place of a description.

    Args:
        scene: the scene.
    """

    scene: Any

    @property
    def name(self) -> str:
        """Name of the scene in messages."""
        return "ready mi.Scene"

    @property
    def variant(self) -> str:
        """Variant of the scene."""
        return str(self.scene.variant_name())

    @property
    def objects(self) -> tuple[Any, ...]:
        """The scene itself."""
        return (self,)

    def __str__(self) -> str:
        return "the mi.Scene"

    def __reduce__(self) -> NoReturn:
        _refuse_pickling(self)


def _refuse_pickling(loaded: Any) -> NoReturn:
    raise SceneError(
        f"tt.Scene: {loaded} is a Mitsuba object that was taken as it is; it lives in this process and in "
        f"{loaded.variant} alone, and cannot be pickled or described. {WAY_OUT}."
    )


def objects_inside(tree: Any) -> tuple[LoadedObject, ...]:
    """Return the loaded objects in a scene dictionary.

    Args:
        tree: dictionary, or an entry of one.
    """
    if isinstance(tree, LoadedObject):
        return (tree,)
    return tuple(found for entry in tree.values() for found in objects_inside(entry)) if isinstance(tree, dict) else ()


def pointers(objects: tuple[Any, ...]) -> frozenset[int]:
    """Return the addresses of loaded objects and of all plugins inside them.

    Args:
        objects: loaded objects and scenes.
    """
    import mitsuba as mi

    starts = [entry.scene if isinstance(entry, LoadedScene) else entry.value for entry in objects]
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
    """Return the effect of a parameter of a loaded plugin, in whose place no other can be built.

    Args:
        effect: effect of the parameter in a described plugin.
        plugin: the loaded plugin.
    """
    if not effect.stand_in_needed:
        return replace(effect, stand_in="")
    reason = (
        f"{class_of(plugin)} {plugin.id()!r} was taken as it is, and its derivative needs {effect.stand_in!r} in "
        "its place: make it one, or give the scene as a dictionary or an XML file"
    )
    return replace(effect, supported=False, reason=reason, stand_in="")


# ------------------------------------------------------------------------------------------------------ descriptions


def describe_object(value: Any, where: str) -> Any:
    """Return plain data for an object of Mitsuba, or a :class:`LoadedObject` where there is none.

    Args:
        value: the object.
        where: path of its keys in the scene dictionary.

    Raises:
        SceneError: for a whole scene.
    """
    if value.class_name() == "VolumeGrid":
        return Voxels.of(value)
    if value.class_name() == "Scene":
        raise SceneError(f"tt.load: {where} is a whole mi.Scene; load that alone, tt.load(scene).")
    if class_of(value) in _PLAIN_MESHES:
        with active_variant(value.variant_name()):
            return _described_mesh(value) or LoadedObject(value, where)
    return LoadedObject(value, where)


def _described_mesh(mesh: Any) -> dict[str, Any] | None:
    """Return a mesh as arrays; None for one with attributes, light, media or a surface of another kind."""
    import mitsuba as mi

    surface = _described_surface(mesh.bsdf())
    held = [value for _, value in objects_of(mesh) if not isinstance(value, mi.BSDF)]
    if surface is None or held or mesh.is_emitter() or mesh.is_sensor() or not mesh.face_count():
        return None
    if has_more_than_arrays(mesh):
        return None
    described: dict[str, Any] = {
        "type": "mesh_arrays",
        "vertices": np.array(mesh_positions(mesh), dtype=np.float64).reshape(-1, 3),
        "faces": np.array(mesh_faces(mesh), dtype=np.int64).reshape(-1, 3),
        "bsdf": surface,
    }
    if has_normals(mesh):
        described["normals"] = np.array(mesh_normals(mesh), dtype=np.float64).reshape(-1, 3)
    if has_texcoords(mesh):
        described["texcoords"] = np.array(mesh_texcoords(mesh), dtype=np.float64).reshape(-1, 2)
    described |= silhouette_weight(mesh)
    flags = {"face_normals": mesh.has_face_normals(), "flip_normals": mesh.has_flipped_normals()}
    return described | {name: True for name, is_set in flags.items() if is_set}


def _described_surface(bsdf: Any) -> dict[str, Any] | None:
    """Return a diffuse surface of one colour, where its variant has kept the colour; None for others."""
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


# ----------------------------------------------------------------------------------------- scenes for steady pictures

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
    "OrthogonalSampler": "orthogonal", "LowDiscrepancySampler": "ldsampler", "OwenSampler": "owen",
}  # fmt: skip


def transient_dictionary(scene: Any) -> dict[str, Any] | None:
    """Return a dictionary of a ``mi.Scene`` with a steady integrator or film; None for one without.

    A film belongs to its sensor and an integrator to its scene; neither can be exchanged in a loaded scene. Cameras
    with a steady film and steady path tracers are described by the parameters that they show, without the seeds of
    their samplers; all else is used as it is.

    Args:
        scene: a loaded ``mitsuba.Scene``.
    """
    import mitsuba as mi

    tree: dict[str, Any] = {"type": "scene"}
    with active_variant(scene.variant_name()):
        for number, (name, value) in enumerate(objects_of(scene)):
            found = None
            if isinstance(value, mi.Integrator):
                found = _integrator(value)
            elif isinstance(value, mi.Sensor):
                found = _sensor(value)
            tree[value.id() or f"{name}_{number}"] = found or LoadedObject(value, value.id() or name)
    return tree if any(isinstance(entry, dict) for entry in tree.values()) else None


def _integrator(value: Any) -> dict[str, Any] | None:
    plugin, printed = _INTEGRATORS.get(value.class_name()), printed_properties(value)
    if plugin is None or not {"max_depth", "rr_depth"} <= printed.keys():
        return None
    # Without a bound it is -1, as a number without sign.
    depths = {name: int(printed[name]) for name in ("max_depth", "rr_depth")}
    depths = {name: -1 if depth >= 2**31 else depth for name, depth in depths.items()}
    return {"type": plugin, **depths, "hide_emitters": bool(value.hide_emitters)}


def _sensor(value: Any) -> dict[str, Any] | None:
    """Return a camera in vacuum with a steady film; None for other sensors."""
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
        "pixel_format": pixel_format(film),
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


def sampler_plugin(sampler: Any) -> str:
    """Return the plugin name of a sampler, or its class for one of others.

    Args:
        sampler: a built sampler.
    """
    name = sampler.class_name() if type(sampler).__module__ == "mitsuba" else type(sampler).__name__
    return _SAMPLERS.get(name, name)


def _sampler(sampler: Any) -> dict[str, Any] | None:
    plugin, printed = sampler_plugin(sampler), printed_properties(sampler)
    if plugin not in _SAMPLERS.values():
        return None
    found: dict[str, Any] = {"type": plugin, "sample_count": int(sampler.sample_count())}
    if "jitter" in printed:
        found["jitter"] = printed["jitter"].strip() in ("1", "true")
    return found
