"""What depends on a class or a version of Mitsuba: names of its classes, and its mistakes that are put right elsewhere.

Written against Mitsuba 3.9.1 (Dr.Jit 1.5). Everything that a later version may mend has a test in
``tests/plugins/test_mitsuba_compat.py`` that shows the mistake on Mitsuba alone: when one of them fails, the entry here
and what asks for it can go. Our own plugins are told by what they declare, never by name.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

WRITTEN_AGAINST = "3.9.1"

# ----------------------------------------------------------------------------------------- what Mitsuba's BSDFs return

# Delta lobes of these return value over probability with the probability attached: a Fresnel term has cancelled itself.
# Those of the others (Mitsuba's dielectric and mask, ours) divide by the detached probability.
_CANCELLING = ("ThinDielectric", "SmoothPlastic")
# A scene's BSDFs show themselves by their description, nested ones included.
_TWO_SIDED, _TWO_SIDED_DESCRIPTION = "TwoSidedBRDF", "TwoSided["


def hides_lobe_probability(bsdf: Any) -> bool:
    """Whether the weight of a delta lobe lacks the derivative of the lobe's probability, which has to be put back.

    Inside ``mask`` the opacity hides in the same place and is attached already; such nested lobes are left as they are.
    """
    name = bsdf.class_name()
    if name == _TWO_SIDED:
        return any(nested in str(bsdf) for nested in _CANCELLING)
    return name in _CANCELLING


def is_two_sided(bsdf: Any) -> bool:
    """Whether a BSDF is ``twosided`` or holds one (in a mask, in a blend).

    From behind, Mitsuba's ``twosided`` evaluates what it holds for the mirror images of the directions, and returns its
    Mueller matrix as if it belonged to the directions themselves: turned, and with the hands of circular light
    exchanged.
    """
    return _TWO_SIDED_DESCRIPTION in str(bsdf)


def has_equal_sides(bsdf: Any) -> bool:
    """Whether the same medium lies on both sides, although a lobe of transmission is not symmetric: a fibre."""
    return bool(bsdf.class_name() == "Hair")


# Slots of BSDFs that hold a texture of normals or heights, which turns the frame that the nested BSDF works in.
_NORMAL_TEXTURES = {"NormalMap": "normalmap", "BumpMap": "nested_texture"}


def normal_texture(bsdf: Any) -> str | None:
    """Name of the texture by which a BSDF turns the shading frame, None for BSDFs that leave it."""
    return _NORMAL_TEXTURES.get(bsdf.class_name())


# Built in place of Mitsuba's when the key of an index of refraction is asked for: Mitsuba's dielectric has a plain
# number for it, its rough dielectric detaches it where directions are sampled.
DIFFERENTIABLE_PLUGINS = {"dielectric": "diff_dielectric", "roughdielectric": "diff_rough_dielectric"}
# In polarized variants these stand in for Mitsuba's always. At normal incidence, where frames coincide, derivatives of
# its conductor, dielectric, polarizer and retarder by the direction are NaN; its rough dielectric depolarises; its wave
# plate jumps at oblique incidence.
POLARIZED_PLUGINS = {
    **DIFFERENTIABLE_PLUGINS,
    **{name: f"diff_{name}" for name in ("conductor", "polarizer", "retarder", "circular")},
}

# ------------------------------------------------------------------------------------------------------ shapes, lights


def is_instance(shape: Any) -> bool:
    """Whether a shape is one copy of a shape group."""
    return bool(shape.class_name() == "Instance")


def is_sphere(shape: Any) -> bool:
    """Whether a shape is Mitsuba's ``sphere``, which is sampled over the cone that it fills."""
    return bool(shape.class_name() == "Sphere")


# Their normal is the same everywhere.
_FLAT = ("Rectangle", "Disk")
# Meshes of more faces are not looked through.
_LARGE_MESH = 10_000


def is_flat(shape: Any) -> bool:
    """Whether the shading normal does not change along a face. Mitsuba's rectangles, its cube and the mesh that it
    merges them into have normals at their vertices: across the faces.
    """
    if not isinstance(shape, mi.Mesh):
        return bool(shape.class_name() in _FLAT)
    if not shape.has_vertex_normals():
        return True
    if shape.face_count() > _LARGE_MESH:
        return False
    corners = np.array(shape.faces_buffer()).reshape(-1, 3)
    normals = np.array(shape.vertex_normals_buffer()).reshape(-1, 3)[corners]
    return bool(np.ptp(normals, axis=1).max(initial=0) < 1e-5)


def is_patterned(emitter: Any) -> bool:
    """Whether the light that leaves a surface in a given direction differs from place to place: a texture, or what
    counts angles from the normal of a curved shape. Mitsuba's ``area`` asks for the side alone.
    """
    if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface):
        return False
    if mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying):
        return True
    return emitter.class_name() != "AreaLight" and emitter.get_shape().class_name() not in _FLAT


def bounds_of(shape: Any) -> Any:
    """The bounding box of a shape. Mitsuba leaves out that of a mesh that it merged from rectangles, and the scene's
    bounds lack it.
    """
    bounds = shape.bbox()
    if not bounds.valid() and isinstance(shape, mi.Mesh):
        shape.recompute_bbox()
        bounds = shape.bbox()
    return bounds


# ------------------------------------------------------------------------------------------------------------- sensors


def is_distant(sensor: Any) -> bool:
    """Whether a sensor sits at infinity (two classes, by the kind of target)."""
    return bool(sensor.class_name().startswith("DistantSensor"))


def is_batch(sensor: Any) -> bool:
    """Whether a sensor only holds others, which share its film. Derivatives through its virtual call to them end the
    process in forward mode, so they are asked one by one.
    """
    return bool(sensor.class_name() == "BatchSensor")


def starts_off_itself(sensor: Any) -> bool:
    """Whether the rays of a sensor start a little off the sensor, by ``mi.math.RayEpsilon``."""
    return bool(sensor.class_name() in ("RadianceMeter", "IrradianceMeter"))


def near_clip(sensor: Any) -> Any:
    """Distance along the axis at which the rays of a projective camera start, though their light goes on to the
    sensor; None for other sensors.
    """
    near = getattr(sensor, "near_clip", None)
    return None if near is None else near()


# ------------------------------------------------------------------------------------------------------------ textures

_COEFFICIENT_CLASSES = ("SRGBReflectanceSpectrum", "BitmapTextureImpl")


def keeps_coefficients(texture: Any) -> bool:
    """Whether the numbers of a texture are coefficients of a smooth spectrum (Jakob and Hanika 2019) instead of a
    colour: two kinds of textures, in spectral variants.
    """
    return bool(mi.is_spectral and texture.class_name().startswith(_COEFFICIENT_CLASSES))
