"""Objects and scenes of Mitsuba that are loaded already: described where that is possible, otherwise taken as they are.

What is described is plain data again: it can be pickled, and built in any variant. An object holds no description: what
it was made of is gone. One that is taken as it is belongs to its variant and its process, is shared with whoever made
it, and keeps its plugins: nothing is built in their place. What that rules out is refused in words.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from torchtransient.errors import SceneError
from torchtransient.interfaces import IntegratorInterface, is_time_resolved
from torchtransient.plugins.dictionaries import Voxels
from torchtransient.plugins.mitsuba_compat import (
    MESH_PARAMETERS,
    mesh_faces,
    mesh_normals,
    mesh_positions,
    mesh_texcoords,
    silhouette_weight,
    users_name,
)
from torchtransient.plugins.node_walk import objects_below, objects_of
from torchtransient.plugins.parameter_effect import ParameterEffect, class_of
from torchtransient.rendering.films.choices import of_film, plugins_in_words
from torchtransient.rendering.variant import active_variant

if TYPE_CHECKING:
    from torchtransient.rendering.build_options import BuildOptions

# Classes of Mitsuba that this library builds others in place of: always, and in polarized variants.
_COMPLETED = {"DirectionalArea": "diff_directionalarea"}
_POLARIZED = {
    "SmoothDielectric": "diff_dielectric",
    "SmoothConductor": "diff_conductor",
    "RoughDielectric": "diff_rough_dielectric",
    "LinearPolarizer": "diff_polarizer",
    "LinearRetarder": "diff_retarder",
    "CircularPolarizer": "diff_circular",
}
# Meshes that are nothing but their buffers and what their base class holds.
_PLAIN_MESHES = ("Mesh", "PLYMesh", "OBJMesh", "SerializedMesh", "Cube", "MergeShape")
_WAY_OUT = "Give the scene as a dictionary or an XML file instead"


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
        f"alone, and cannot be pickled or described. {_WAY_OUT}."
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
            f"{_WAY_OUT}."
        )


def check_variant(taken: tuple[Any, ...], variant: str | None) -> None:
    """Raise ``SceneError`` where an object belongs to another variant than the scene is for."""
    for entry in taken:
        wanted = variant or taken[0].variant
        if entry.variant != wanted:
            raise SceneError(
                f"tt.load: {entry} is a Mitsuba object of {entry.variant} and was taken as it is, so that it cannot be "
                f"rendered in {wanted}. {_WAY_OUT}, or leave variant out."
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
    numbers = {users_name(mesh, name) for name in mi.traverse(mesh).properties if "." not in name} - MESH_PARAMETERS
    if surface is None or held or mesh.is_emitter() or mesh.is_sensor() or numbers or not mesh.face_count():
        return None
    described: dict[str, Any] = {
        "type": "mesh_arrays",
        "vertices": np.array(mesh_positions(mesh), dtype=np.float64).reshape(-1, 3),
        "faces": np.array(mesh_faces(mesh), dtype=np.int64).reshape(-1, 3),
        "bsdf": surface,
    }
    if mesh.has_vertex_normals():
        described["normals"] = np.array(mesh_normals(mesh), dtype=np.float64).reshape(-1, 3)
    if mesh.has_vertex_texcoords():
        described["texcoords"] = np.array(mesh_texcoords(mesh), dtype=np.float64).reshape(-1, 2)
    described |= silhouette_weight(mesh)
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


def check_taken(scene: Any, taken: tuple[Any, ...], options: BuildOptions) -> None:
    """Raise ``SceneError`` where a built scene holds something as it was taken, and ``options`` ask for another.

    Of what is described, the options were carried out before.
    """
    import mitsuba as mi

    kept = pointers(taken)
    for value in (scene, *objects_below(scene, mi.Object)):
        if value.ptr in kept:
            _check_complete(value)
    integrator = scene.integrator()
    if integrator is not None and integrator.ptr in kept and options.transient:
        _check_integrator(integrator, options)
    for number, sensor in enumerate(scene.sensors()):
        if sensor.ptr in kept or sensor.film().ptr in kept:
            _check_sensor(number, sensor, options)


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


def _check_complete(value: Any) -> None:
    import mitsuba as mi

    twins = _COMPLETED | (_POLARIZED if mi.is_polarized else {})
    twin = twins.get(value.class_name())
    if twin is not None:
        raise SceneError(
            f"tt.load: {value.class_name()} {value.id()!r} was taken as it is. Mitsuba's own is wrong or incomplete in "
            f"{mi.variant()}, and {twin!r} is built in its place where a scene is described. Make it a {twin!r}, or "
            "give the scene as a dictionary or an XML file."
        )


def _check_integrator(integrator: Any, options: BuildOptions) -> None:
    depth = getattr(integrator, "max_depth", None)
    same_depth = options.max_depth is None or (
        depth is not None and int(depth) % 2**32 == options.max_depth % 2**32
    )
    if isinstance(integrator, IntegratorInterface) and same_depth and options.integrator is None:
        return
    asked = f"max_depth={options.max_depth}" if isinstance(integrator, IntegratorInterface) else "a transient one"
    raise SceneError(
        f"the integrator {class_of(integrator)} was taken as it is, and {options.integrator or asked} is asked for. "
        "Make the scene with the integrator that you want, transient_path or transient_prbvolpath, or path, volpath or "
        f"volpathmis, which these stand in for. {_WAY_OUT}."
    )


def _check_sensor(number: int, sensor: Any, options: BuildOptions) -> None:
    film = sensor.film()
    asked = [name for name in ("sampler", "pulse", "irf") if getattr(options, name) is not None]
    asked += [] if options.steady or not getattr(film, "keeps_steady", True) else ["steady"]
    if options.transient and not is_time_resolved(film):
        raise SceneError(
            f"sensor {number} was taken as it is with its film, a {class_of(film)}, which has no time axis; no other "
            f"film is built in its place. Make the scene with one of {plugins_in_words()}. {_WAY_OUT}."
        )
    has = of_film(film) if options.transient else None
    if options.film is not None and options.film != has:
        asked.append(options.film.argument)
    if asked:
        raise SceneError(
            f"sensor {number} was taken as it is with its film and sampler, and {', '.join(asked)} would change it. "
            f"Leave {'it' if len(asked) == 1 else 'them'} out, or make the scene with what you want. {_WAY_OUT}."
        )
