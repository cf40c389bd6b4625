"""Dependencies on classes and versions of Mitsuba: names of its classes, and mistakes that are corrected elsewhere.

Written against Mitsuba 3.9.1 (Dr.Jit 1.5). ``tests/plugins/test_mitsuba_compat.py`` shows some of the mistakes on
Mitsuba alone: when one of its tests fails, the entry that it names and what asks for it can go. Other entries have no
such test there. Our own plugins are told by what they declare, never by name.
"""

from __future__ import annotations

import functools
import math
import re
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError

# ----------------------------------------------------------------------------------------- what Mitsuba's BSDFs return

# Delta lobes of these return value over probability with the probability attached: a Fresnel term has cancelled itself.
# Those of the others (Mitsuba's dielectric, ours) divide by the detached probability.
_CANCELLING = ("ThinDielectric", "SmoothPlastic")
# Mixtures, and the slot of the texture or volume that says how much of the (second) nested one there is.
_WEIGHT_SLOTS = {"MaskBSDF": "opacity", "BlendBSDF": "weight", "BlendPhaseFunction": "weight"}


def cancels_lobe_probability(bsdf: Any) -> bool:
    """Return True if the weight of a BSDF's own delta lobe lacks the derivative of the lobe's probability.

    Args:
        bsdf: one ``mi.BSDF``; those that it holds are not asked.
    """
    return bsdf.class_name() in _CANCELLING


def weight_slot(bsdf: Any) -> str | None:
    """Return the name of the texture or volume that mixes the parts of a BSDF or phase function.

    Args:
        bsdf: one ``mi.BSDF`` or ``mi.PhaseFunction``.

    Returns:
        "weight" or "opacity", None for those that are no mixture. A mixture of one BSDF lets the rest of the light
        pass.
    """
    return _WEIGHT_SLOTS.get(bsdf.class_name())


def adds_up_wrongly(bsdf: Any, held: list[Any], nested: list[Any]) -> bool:
    """Return True for a blend whose values Mitsuba divides by another density than that of its samples.

    So it is where a part has a delta lobe or lets light through, or works on a side of the surface where another does
    nothing. Mitsuba divides the sum of both parts' values by the sum of their densities. The density of a delta lobe is
    a probability instead. Other parts draw directions that they throw away, on the other side of the surface: a diffuse
    one that is seen from behind, a rough one whose facet mirrors or refracts there. A part that lets light through has
    a value there, which counts once too often (rough glass and paint, from behind: 10 %).

    Args:
        bsdf: one ``mi.BSDF``.
        held: parts of the blend.
        nested: all BSDFs in the blend, asked themselves since a blend does not notice lobes that they get later.
    """
    if bsdf.class_name() != "BlendBSDF":
        return False
    lobes = (mi.BSDFFlags.Delta, mi.BSDFFlags.Transmission)
    behind = {bool(mi.has_flag(part.flags(), mi.BSDFFlags.BackSide)) for part in held}
    return len(behind) > 1 or any(mi.has_flag(part.flags(), lobe) for part in nested for lobe in lobes)


def is_two_sided_itself(bsdf: Any) -> bool:
    """Return True for ``twosided``, whose Mueller matrices are wrong from behind.

    Args:
        bsdf: one ``mi.BSDF``.
    """
    return bool(bsdf.class_name() == "TwoSidedBRDF")


def has_equal_sides(bsdf: Any) -> bool:
    """Return True if the same medium lies on both sides, although a lobe of transmission is not symmetric: a fibre.

    Args:
        bsdf: one ``mi.BSDF``; plugins of others declare it as ``has_equal_sides``.
    """
    return bool(bsdf.class_name() == "Hair" or getattr(bsdf, "has_equal_sides", False))


# Slots of BSDFs that hold a texture of normals or heights, which turns the frame that the nested BSDF works in.
_NORMAL_TEXTURES = {"NormalMap": "normalmap", "BumpMap": "nested_texture"}

# Flags of these that a built one does not show.
HIDDEN_FLAGS = ("flip_invalid_normals", "use_shadowing_function")


def normal_texture(bsdf: Any) -> str | None:
    """Return the name of the texture by which a BSDF turns the shading frame, None for BSDFs that leave it.

    Args:
        bsdf: one ``mi.BSDF``.
    """
    return _NORMAL_TEXTURES.get(bsdf.class_name())


def forgets_black_samples(bsdf: Any) -> bool:
    """Return True if a BSDF drops samples of weight zero of the one that it holds.

    The derivative of a reflectance of zero, by the light that comes from elsewhere, is lost then. A normal map reports
    no density for them, and paths end there; a bump map masks the weight, of which a delta lobe has no other value.

    Args:
        bsdf: one ``mi.BSDF``.
    """
    return bsdf.class_name() in ("NormalMap", "BumpMap")


# The key of an environment map's image.
PIXELS = "data"


def is_bump_map(bsdf: Any) -> bool:
    """Return True if a BSDF takes its normals from the slope of a texture, which jumps at each texel of a bitmap.

    Args:
        bsdf: one ``mi.BSDF``.
    """
    return bool(bsdf.class_name() == "BumpMap")


# Built in place of Mitsuba's when a key is asked for whose derivative it lacks: its dielectric and its plastic have a
# plain number for the index, its rough dielectric detaches it where directions are sampled, and its rough plastic
# computes tables from roughness and index outside of the graph. Plastics and principled surfaces lose lobes, see below.
# The lobes of its hair are not those of its samples: a Bessel function that is up to 0.6 % too small, of a slope that
# is wrong by as much; less one, as derivatives have it, 12 %. What crosses a fibre three times or more is sent into
# one plane.
DIFFERENTIABLE_PLUGINS = {
    "dielectric": "diff_dielectric",
    "roughdielectric": "diff_rough_dielectric",
    "plastic": "diff_plastic",
    "roughplastic": "diff_rough_plastic",
    "pplastic": "diff_pplastic",
    "conductor": "diff_conductor",
    "roughconductor": "diff_rough_conductor",
    "principled": "diff_principled",
    "principledthin": "diff_principled_thin",
    "hair": "diff_hair",
}
# Where the weight of a lobe has one of these values, these lose a lobe: they never sample it, or do not evaluate it,
# and the derivative by the weight is zero or wrong there although its slope is not. By class and the slot of the
# texture; plastics go by its mean. Where a principled surface transmits and its base is black, the derivative by the
# colour is NaN, or counts samples that were thrown away. Metals go by `loses_slope_of_metal`, near these values too.
PLASTICS = {"SmoothPlastic": "plastic", "RoughPlastic": "roughplastic", "PolarizedPlastic": "pplastic"}
METALS = {"SmoothConductor": "conductor", "RoughConductor": "roughconductor"}
LOSING = PLASTICS | METALS | {"Principled": "principled", "PrincipledThin": "principledthin"}
LOST_AT: dict[str, dict[str, tuple[float, ...]]] = {
    **{name: {"diffuse_reflectance": (0,), "specular_reflectance": (0,)} for name in PLASTICS},
    **{name: {"eta": (0,), "k": (0,)} for name in METALS},
    "Principled": {"clearcoat": (0,), "sheen": (0,), "spec_trans": (0, 1), "metallic": (1,)},
    "PrincipledThin": {"spec_trans": (0, 1), "diff_trans": (0, 2)},
}
# Plugins that build only the lobes whose weights are given and not the number zero, and the others once their weight is
# changed: too late for what holds them. Their twins take the names of weights to build lobes for.
BUILDS_LOBES = ("principled", "principledthin", "diff_principled", "diff_principled_thin")


def lost_at(bsdf: Any, slot: str) -> tuple[float, ...]:
    """Return the values of a texture at which a BSDF loses the lobe that the texture weighs.

    Args:
        bsdf: one ``mi.BSDF``.
        slot: name under which it holds the texture.
    """
    name = bsdf.class_name()
    if slot == "base_color" and name in LOST_AT and mi.has_flag(bsdf.flags(), mi.BSDFFlags.GlossyTransmission):
        return (0,)
    return LOST_AT.get(name, {}).get(slot, ())


# Below this share of `1 + k^2` in `eta k`, Mitsuba's Fresnel term of a metal loses more than 0.1 % of its slopes.
_LEAST_PRODUCT = 0.008


def loses_slope_of_metal(slot: str, eta: tuple[float, float], k: tuple[float, float]) -> bool:
    """Return True if Mitsuba's Fresnel term of a metal loses its derivative by the index or by the absorption.

    It takes a root of the difference of ``n^2 = |(eta - i k)^2 - sin^2|`` and its real part's modulus, which are equal
    in single precision where ``eta k`` is small: in total reflection (``eta < 1``), and in metals without losses. Its
    Mueller matrix takes a complex root instead, and loses that of no absorption alone.

    Args:
        slot: "eta" or "k", by which the derivative is taken.
        eta, k: least and largest value of each in the scene, of the complex index ``eta - i k``.
    """
    least, (low, high) = eta[0], k
    if mi.is_polarized:
        return slot == "k" and low == 0 and 0 < least < 1
    # The slope by one of them is proportional to the other, and truly zero without it.
    if (high if slot == "eta" else eta[1]) <= 0:
        return False
    return any(least * x < _LEAST_PRODUCT * (1 + x * x) and (least < 1 or x > least) for x in (low, high))


def is_absorption_of_hair(bsdf: Any, slot: str) -> bool:
    """Return True if a texture is the absorption of Mitsuba's ``hair``.

    Args:
        bsdf: one ``mi.BSDF``.
        slot: name under which it holds the texture.
    """
    return bool(bsdf.class_name() == "Hair" and slot == "sigma_a")


def is_replaced_for(bsdf: Any, slot: str) -> bool:
    """Return True if another BSDF is built in place of one where a derivative by one of its textures is asked for.

    Args:
        bsdf: one ``mi.BSDF``.
        slot: name under which it holds the texture.
    """
    return bool(lost_at(bsdf, slot)) or is_absorption_of_hair(bsdf, slot)


# In polarized variants these stand in for Mitsuba's always. At normal incidence, where frames coincide, derivatives of
# its conductor, dielectric, polarizer and retarder by the direction are NaN; its rough dielectric depolarises; its wave
# plate jumps at oblique incidence.
POLARIZED_PLUGINS = {
    **{name: f"diff_{name}" for name in ("dielectric", "conductor", "polarizer", "retarder", "circular")},
    "roughdielectric": "diff_rough_dielectric",
}
# These stand in for Mitsuba's always. `directionalarea` lacks `eval_direction`: it raises while kernels are traced, for
# the other lights of a scene too. `hair` is wrong as said above, and black or infinite where it is hardly rough.
COMPLETED_PLUGINS = {"directionalarea": "diff_directionalarea", "hair": "diff_hair"}
# Textures that know no mean, which Mitsuba's plastics ask for: with one of these their twins are built.
TEXTURES_WITHOUT_MEAN = {"mesh_attribute": "MeshAttribute", "volume": "VolumeAdapter"}

# -------------------------------------------------------------------------------------------------------------- meshes

# Users' keys of the arrays of a mesh, which are those of this library with every version of Mitsuba.
POSITIONS, NORMALS, TEXCOORDS, FACES = "vertex_positions", "vertex_normals", "vertex_texcoords", "faces"
# Columns of the arrays that a user can replace.
VERTEX_COLUMNS = {POSITIONS: 3, NORMALS: 3, TEXCOORDS: 2}
# Attribute of a mesh, three numbers a vertex: metres per second in the world.
VELOCITY = "vertex_velocity"
# Mitsuba 3.10 (pull request 1933) renames these, shows all arrays as tensors of rows, makes meshes of arrays that are
# given to the constructor, and has no buffers. Its vertices may share rows of positions and normals, so that there are
# fewer rows than vertices. Silhouette tables, which it makes on demand, are not used here.
_NEW_NAMES = {POSITIONS: "positions", NORMALS: "normals", TEXCOORDS: "texcoords"}
_USERS_NAMES = {new: name for name, new in _NEW_NAMES.items()}
# Row of each vertex in these arrays of Mitsuba 3.10, empty where vertex i has row i.
_SHARED_ROWS = {POSITIONS: "position_index", NORMALS: "normal_index"}
# Material of each face of Mitsuba 3.10, empty for meshes of one material.
_MATERIALS = "bsdf_index"
_WEIGHT = "silhouette_sampling_weight"
_OWN_PARAMETERS = frozenset((*VERTEX_COLUMNS, FACES, _WEIGHT, *_SHARED_ROWS.values()))


def shows_rows() -> bool:
    """Return True if Mitsuba shows the arrays of meshes as rows, under the names of version 3.10."""
    major, minor, *_ = mi.__version__.split(".")
    return (int(major), int(minor)) >= (3, 10)


def users_name(node: Any, name: str) -> str:
    """Return users' name of a parameter, which is the same for all versions of Mitsuba.

    Args:
        node: plugin that shows it.
        name: name under which Mitsuba shows it, without the path to the plugin.
    """
    return _USERS_NAMES.get(name, name) if shows_rows() and isinstance(node, mi.Mesh) else name


def scene_parameters(scene: Any) -> Any:
    """Return the ``mi.SceneParameters`` of a scene by users' keys.

    Args:
        scene: Mitsuba scene, or another plugin.
    """
    shown = mi.traverse(scene)
    if not shows_rows():
        return shown
    properties = {}
    for key, entry in shown.properties.items():
        prefix, dot, name = key.rpartition(".")
        properties[prefix + dot + users_name(entry[2], name)] = entry
    return _users_parameters(mi.SceneParameters)(properties, shown.hierarchy)


@functools.cache
def _users_parameters(base: type) -> type:
    """Return the class of parameters by users' keys, of which meshes hear under Mitsuba's names."""

    class UsersParameters(base):  # type: ignore[misc, valid-type]
        def set_dirty(self, key: str) -> Any:
            entry = super().set_dirty(key)
            node = entry[2]
            if isinstance(node, mi.Mesh):
                changed = (self.hierarchy[node][1], node)
                self.nodes_to_update[changed] = {_NEW_NAMES.get(name, name) for name in self.nodes_to_update[changed]}
            return entry

    return UsersParameters


def names_array(key: str, name: str) -> bool:
    """Return True if a key of scene parameters, users' or Mitsuba's, names an array of a mesh.

    Args:
        key: key of ``mi.traverse``, such as "box.vertex_positions".
        name: the array, such as POSITIONS.
    """
    own = key.rsplit(".", 1)[-1]
    return own == name or (shows_rows() and own == _NEW_NAMES.get(name))


def key_beside(key: str, name: str) -> str:
    """Return the key of another array of the mesh that a parameter belongs to, in the spelling of that parameter.

    Args:
        key: key of an array of the mesh.
        name: the other array, such as POSITIONS.
    """
    prefix, dot, own = key.rpartition(".")
    return prefix + dot + (_NEW_NAMES.get(name, name) if own in _USERS_NAMES else name)


def flat_array(value: Any) -> Any:
    """Return the numbers of an array of a mesh in a row.

    Args:
        value: array of the mesh as ``mi.traverse`` shows it: a tensor with a row for each vertex in newer versions of
            Mitsuba, a flat array in others.
    """
    return value.array if dr.is_tensor_v(value) else value


def mesh_positions(mesh: Any) -> Any:
    """Return the places of the vertices of a mesh, Float (3 V,), metres in the world, attached where they are.

    Args:
        mesh: ``mi.Mesh``.
    """
    return _mesh_array(mesh, POSITIONS)


def mesh_normals(mesh: Any) -> Any:
    """Return the normals at the vertices of a mesh, Float (3 V,), empty for meshes without.

    Args:
        mesh: ``mi.Mesh``.
    """
    return _mesh_array(mesh, NORMALS)


def mesh_texcoords(mesh: Any) -> Any:
    """Return the texture coordinates of the vertices of a mesh, Float (2 V,), empty for meshes without.

    Args:
        mesh: ``mi.Mesh``.
    """
    return _mesh_array(mesh, TEXCOORDS)


def mesh_faces(mesh: Any) -> Any:
    """Return the numbers of the vertices of the faces of a mesh, UInt32 (3 F,).

    Args:
        mesh: ``mi.Mesh``.
    """
    return _mesh_array(mesh, FACES)


def _mesh_array(mesh: Any, name: str) -> Any:
    if not shows_rows():
        return getattr(mesh, f"{name}_buffer")()
    shown = mi.traverse(mesh)
    if _NEW_NAMES.get(name, name) not in shown:
        return mi.Float()
    rows = shown[_NEW_NAMES.get(name, name)].array
    index = _shared_rows(mesh, name)
    return rows if index is None else dr.ravel(dr.gather(mi.Point3f, rows, index))


def _shared_rows(mesh: Any, name: str) -> Any:
    """Return the row of each vertex in an array, None where vertex i has row i."""
    if not shows_rows() or name not in _SHARED_ROWS:
        return None
    index = mi.traverse(mesh)[_SHARED_ROWS[name]]
    return index if dr.width(index) else None


def rows_of_faces(mesh: Any, name: str) -> np.ndarray:
    """Return the numbers of the rows of an array or attribute at vertices that faces refer to, in order.

    Args:
        mesh: ``mi.Mesh``.
        name: array or attribute, such as POSITIONS or "vertex_color".
    """
    faces, index = np.array(mesh_faces(mesh)), _shared_rows(mesh, name)
    vertices = np.unique(faces[faces < mesh.vertex_count()])
    return vertices if index is None else np.unique(np.array(index)[vertices])


def has_normals(mesh: Any) -> bool:
    """Return True if a mesh has normals at its vertices.

    Args:
        mesh: ``mi.Mesh``.
    """
    return bool(mesh.has_normals() if shows_rows() else mesh.has_vertex_normals())


def has_texcoords(mesh: Any) -> bool:
    """Return True if a mesh has texture coordinates at its vertices.

    Args:
        mesh: ``mi.Mesh``.
    """
    return bool(mesh.has_texcoords() if shows_rows() else mesh.has_vertex_texcoords())


def has_velocities(shape: Any) -> bool:
    """Return True for meshes with velocities at their vertices.

    Args:
        shape: one ``mi.Shape``.
    """
    return isinstance(shape, mi.Mesh) and shape.has_attribute(VELOCITY)


def moved_by(plugin: Any) -> str | None:
    """Return the name of the medium whose velocities a volume holds.

    Args:
        plugin: any plugin; a volume of velocities is named "NAME.velocity".

    Returns:
        The name, None for other plugins.
    """
    name, _, last = plugin.id().rpartition(".") if isinstance(plugin, mi.Volume) else ("", "", "")
    return name if name and last == "velocity" else None


def has_more_than_arrays(mesh: Any) -> bool:
    """Return True if a mesh has parameters beside its arrays and its weight: attributes, or a material by face.

    Args:
        mesh: ``mi.Mesh``.
    """
    shown = mi.traverse(mesh)
    names = {users_name(mesh, name) for name in shown.properties if "." not in name} - _OWN_PARAMETERS
    return any(name != _MATERIALS or dr.width(shown[name]) for name in names)


def silhouette_weight(mesh: Any) -> dict[str, float]:
    """Return the weight of a mesh among silhouettes, by its name in scene files, where it is not that of all meshes.

    Args:
        mesh: ``mi.Mesh``.
    """
    weight = float(mesh.silhouette_sampling_weight())
    return {} if weight == 1 else {_WEIGHT: weight}


def mesh_of_arrays(
    props: Any, positions: np.ndarray, faces: np.ndarray, normals: np.ndarray | None, texcoords: np.ndarray | None
) -> Any:
    """Return a ``mi.Mesh`` of arrays with a row for each vertex or face.

    Args:
        props: ``mi.Properties`` of the mesh, with its children.
        positions: places of the vertices, (V, 3), metres in the world.
        faces: numbers of vertices, (F, 3).
        normals: normals at the vertices, (V, 3), in the world, or None.
        texcoords: texture coordinates, (V, 2), or None.
    """
    arrays = {POSITIONS: positions, FACES: faces, TEXCOORDS: texcoords, NORMALS: normals}
    given = {name: array for name, array in arrays.items() if array is not None}
    if shows_rows():
        rows = {
            _NEW_NAMES.get(name, name): (mi.TensorXu if name == FACES else mi.TensorXf)(np.ascontiguousarray(array))
            for name, array in given.items()
        }
        return mi.Mesh(props.id(), props=props, **rows)
    mesh = mi.Mesh(props.id(), len(positions), len(faces), props, normals is not None, texcoords is not None)
    params = mi.traverse(mesh)
    for name, array in given.items():
        kind, dtype = (mi.UInt32, np.uint32) if name == FACES else (mi.Float, np.float32)
        params[name] = kind(np.ravel(array).astype(dtype))
    params.update()
    return mesh


# ------------------------------------------------------------------------------------------------------ shapes, lights


def samples_its_shape(emitter: Any) -> bool:
    """Return True if an emitter is an area light that asks its shape for a direction.

    Mitsuba's sphere answers with the solid angle ``2 pi (1 - cos)`` of its cone in single precision, which has no
    digits left for small spheres, and from a point on its own surface with one of two densities that are not the same;
    see ``sampling/sphere_lights.py``.

    Args:
        emitter: one ``mi.Emitter``; plugins of others declare it as ``samples_its_shape``.
    """
    return bool(emitter.class_name() == "AreaLight" or getattr(emitter, "samples_its_shape", False))


def is_dark(emitter: Any) -> bool:
    """Return True if no path that starts at a sensor finds an emitter: it shines along its normals and nowhere else.

    Args:
        emitter: one ``mi.Emitter``; plugins of others declare it as ``stays_dark``.
    """
    return bool(emitter.class_name() == "DirectionalArea" or getattr(emitter, "stays_dark", False))


def lacks_directions(emitter: Any) -> bool:
    """Return True if an emitter raises where it is asked for its light in a direction: derivatives cannot be traced.

    Args:
        emitter: one ``mi.Emitter``.
    """
    return bool(emitter.class_name() == "DirectionalArea")


# What scatters or emits alike all over a flat surface unless one of its textures varies. What classes of others ask the
# place for is not known.
SCATTER_ALIKE = frozenset(
    (
        "SmoothDiffuse", "SmoothDielectric", "RoughDielectric", "ThinDielectric", "SmoothConductor", "RoughConductor",
        "SmoothPlastic", "RoughPlastic", "PolarizedPlastic", "Principled", "PrincipledThin", "Hair", "Null",
        "LinearPolarizer", "LinearRetarder", "CircularPolarizer", "BlendBSDF", "MaskBSDF", "TwoSidedBRDF",
        "BumpMap", "NormalMap",
    )
)  # fmt: skip
EMIT_ALIKE = frozenset(("AreaLight", "DirectionalArea"))


def sun_half_angle(emitter: Any) -> float:
    """Return half the angle that the sun of a ``sunsky`` fills, radians, which Mitsuba shows in its description alone.

    Args:
        emitter: one ``mi.Emitter``.

    Raises:
        SceneError: for a description without it.
    """
    shown = re.search(r"Sun aperture = ([-+.\de]+)", str(emitter))
    if shown is None:
        raise SceneError(f"{emitter.class_name()}: expected 'Sun aperture' in its description, got {emitter}.")
    return math.radians(float(shown[1])) / 2


# ------------------------------------------------------------------------------------------------------------- sensors


def is_distant(sensor: Any) -> bool:
    """Return True if a sensor sits at infinity (two classes, by the kind of target).

    Args:
        sensor: one ``mi.Sensor``.
    """
    return bool(sensor.class_name().startswith("DistantSensor"))


def is_batch(sensor: Any) -> bool:
    """Return True if a sensor holds others, which share its film.

    Derivatives through its virtual call to them end the process in forward mode, so they are asked one by one.

    Args:
        sensor: one ``mi.Sensor``.
    """
    return bool(sensor.class_name() == "BatchSensor")


def is_irradiance_meter(sensor: Any) -> bool:
    """Return True if a sensor collects light from all directions over a shape, without a pixel for each.

    Args:
        sensor: one ``mi.Sensor``.
    """
    return bool(sensor.class_name() == "IrradianceMeter")


def starts_off_itself(sensor: Any) -> bool:
    """Return True if the rays of a sensor start a little off the sensor, by ``mi.math.RayEpsilon``.

    Args:
        sensor: one ``mi.Sensor``.
    """
    return bool(sensor.class_name() in ("RadianceMeter", "IrradianceMeter"))


def near_clip(sensor: Any) -> Any:
    """Return the distance along the axis at which the rays of a projective camera start.

    Their light goes on to the sensor nevertheless.

    Args:
        sensor: one ``mi.Sensor``.

    Returns:
        Metres, None for sensors that are no projective cameras.
    """
    near = getattr(sensor, "near_clip", None)
    return None if near is None else near()


# ------------------------------------------------------------------------------------------------------------ textures


def attribute_name(texture: Any) -> str | None:
    """Return the name of the shape attribute that a texture reads, which Mitsuba shows in its description alone.

    Args:
        texture: one ``mi.Texture``.

    Returns:
        Such as "vertex_color", None for other textures.
    """
    if texture.class_name() != "MeshAttribute":
        return None
    found = re.search(r'name = "([^"]*)"', str(texture))
    return found.group(1) if found else None


def attribute_scale(texture: Any) -> float:
    """Return the factor of the attribute that a texture reads, 1 for other textures and volumes.

    Args:
        texture: one ``mi.Texture`` or ``mi.Volume``.
    """
    return 1.0 if texture.class_name() != "MeshAttribute" else float(mi.traverse(texture)["scale"])


# Slots of BSDFs of which Mitsuba reads a single number, and those of BSDFs and emitters of which it reads a spectrum.
_SINGLE = frozenset((
    "opacity", "weight", "alpha", "alpha_u", "alpha_v", "roughness", "anisotropic", "metallic", "spec_trans",
    "spec_tint", "sheen", "sheen_tint", "clearcoat", "clearcoat_gloss", "flatness", "diff_trans",
))  # fmt: skip
_SPECTRA = frozenset((
    "reflectance", "diffuse_reflectance", "specular_reflectance", "specular_transmittance", "base_color", "k",
    "transmittance", "radiance", "theta", "delta",
))  # fmt: skip


def read_as(node: Any, slot: str) -> str:
    """Return the texture method that a BSDF or emitter calls for one of its textures, empty if unknown.

    Args:
        node: one ``mi.BSDF`` or ``mi.Emitter``.
        slot: name under which it holds the texture.
    """
    if isinstance(node, mi.BSDF) and normal_texture(node) == slot:
        return "eval_1" if is_bump_map(node) else "eval_3"
    if slot == "eta":
        return "eval_1" if "Principled" in node.class_name() + type(node).__name__ else "eval"
    return "eval_1" if slot in _SINGLE else "eval" if slot in _SPECTRA else ""


def attribute_sizes(bsdf: Any, slot: str) -> tuple[int, ...]:
    """Return the numbers of channels that a BSDF can read from a mesh attribute; with others it reads zero.

    Args:
        bsdf: one ``mi.BSDF``.
        slot: name under which it holds the texture that reads the attribute.
    """
    return {"eval_1": (1,), "eval_3": (3,)}.get(read_as(bsdf, slot), (1, 3))


def varies(texture: Any) -> bool:
    """Return True if a texture may have another value at another place; Mitsuba's ``mesh_attribute`` does not say so.

    Args:
        texture: one ``mi.Texture``.
    """
    return bool(texture.is_spatially_varying() or texture.class_name() == "MeshAttribute")


# Of a texture or volume the numbers, not where they lie.
NUMBERS = ("value", "values", "data", "color0", "color1")


# ----------------------------------------------------------------------------------------------------------------------
# What Mitsuba 3.9.1 makes of installed values in plain numbers, outside of Dr.Jit's sight.
# ``tests/plugins/test_mitsuba_numbers.py`` shows each on Mitsuba alone.

# By class and name. The ends of an irregular spectrum are read when it is installed, and become part of the kernels: a
# recorded call would keep those of its own.
_READ_WHEN_INSTALLED = frozenset({("IrregularSpectrum", "wavelengths")})
# These flip their normals at every update with a pose that reflects, instead of once.
_TURNED_BY_REFLECTIONS = frozenset({("Sphere", "to_world"), ("Cylinder", "to_world")})


def is_number_of_kernels(class_name: str, name: str) -> bool:
    """Return True if kernels contain a parameter as a literal, so that each value compiles its own.

    Args:
        class_name: ``class_name()`` of the plugin.
        name: parameter, without the path to the plugin.
    """
    return (class_name, name) in _READ_WHEN_INSTALLED


def is_turned_by_reflections(class_name: str, name: str) -> bool:
    """Return True if a pose that reflects turns the shape inside out once more at every installation.

    Args:
        class_name: ``class_name()`` of the shape.
        name: name of the parameter, without the path to the shape.
    """
    return (class_name, name) in _TURNED_BY_REFLECTIONS


def check_pose(key: str, *poses: Any) -> None:
    """Check the poses of a shape that reflections would turn inside out.

    Args:
        key: key of the pose, for messages.
        poses: matrices, (4, 4).

    Raises:
        SceneError: for one with a negative determinant.
    """
    if any(np.linalg.det(np.asarray(pose, dtype=np.float64).reshape(4, 4)[:3, :3]) < 0 for pose in poses):
        raise SceneError(
            f"value of {key!r}: expected poses without a reflection, got one whose determinant is negative: Mitsuba "
            "turns such a shape inside out once more at every change. Turn it by a rotation, use flip_normals, or "
            "describe it as a mesh."
        )


# Their permutations are hashes of the number of the call. Calls two apart have hashes that are alike (Mitsuba 3.9), so
# that numbers of one vertex depend on those of the vertex before: the mean of sin(2 pi u) sin(2 pi v) is -0.13 for
# `ldsampler`, -0.10 for 16 and -0.006 for 256 samples of `stratified`, -0.08 for 4 and -0.02 for 16 of `multijitter`,
# where it should be 0. In the Cornell box the derivative by a wall's colour is 1.3 % too small with `ldsampler` (64
# samples), 0.6 % with `stratified` (16), and right to 0.25 % with `multijitter`.
CORRELATED_SAMPLERS = ("ldsampler", "stratified")
