"""Shapes of Mitsuba by their classes: what they are, and mistakes of their interactions that are corrected elsewhere.

Written against Mitsuba 3.9.1. ``tests/plugins/test_mitsuba_compat.py`` shows one of the mistakes on Mitsuba alone, the
bounds of merged rectangles (:func:`bounds_of`); the others have none there.
"""

from __future__ import annotations

import re
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError
from torchtransient.plugins.mitsuba_compat import has_normals, mesh_faces, mesh_normals


def is_instance(shape: Any) -> bool:
    """Return True if a shape is one copy of a shape group.

    Args:
        shape: one ``mi.Shape``.
    """
    return bool(shape.class_name() == "Instance")


def group_name(instance: Any) -> str:
    """Return the identifier of the shape group that an instance copies, which Mitsuba shows in its description alone.

    Args:
        instance: ``mi.Shape`` of :func:`is_instance`.

    Raises:
        SceneError: for a description without it.
    """
    found = re.search(r'name = "(.*?)",\n', str(instance))
    if found is None:
        raise SceneError(f"Instance: expected the name of a shape group in its description, got {instance}.")
    return found[1]


def has_surface(shape: Any) -> bool:
    """Return True if rays can meet a shape itself. Groups and their copies hold others, and have a BSDF nevertheless.

    Args:
        shape: one ``mi.Shape``.
    """
    return shape.class_name() not in ("Instance", "ShapeGroupPlugin")


def is_sphere(shape: Any) -> bool:
    """Return True for Mitsuba's ``sphere``, which is sampled over the cone that it fills.

    Args:
        shape: one ``mi.Shape``.
    """
    return bool(shape.class_name() == "Sphere")


def leaves_hits_detached(shape: Any) -> bool:
    """Return True if interactions lie at a detached distance along the ray.

    They follow neither the shape nor a ray that moves.

    Args:
        shape: one ``mi.Shape``.
    """
    return bool(shape.class_name() in ("Ellipsoids", "LinearCurve"))


def misplaces_hits(shape: Any) -> bool:
    """Return True if the place along a curve, at which a ray hits it, has a wrong derivative, and the normal with it.

    Mitsuba projects onto one of two directions of its surface as if they were perpendicular.

    Args:
        shape: one ``mi.Shape``.
    """
    return bool(shape.class_name() == "BSplineCurve")


def has_no_material(shape: Any) -> bool:
    """Return True if no point of a shape can be followed: Mitsuba's interactions follow the surface, not its points.

    Args:
        shape: one ``mi.Shape``.
    """
    return bool(shape.class_name() in ("Ellipsoids", "EllipsoidsMesh", "LinearCurve", "BSplineCurve", "SDFGrid"))


def has_vertices(shape: Any) -> bool:
    """Return True for a mesh of listed vertices: not for rectangles and disks, which are ``mi.Mesh`` too.

    Args:
        shape: one ``mi.Shape``.
    """
    return isinstance(shape, mi.Mesh) and shape.class_name() not in _FLAT


def has_smooth_shape(emitter: Any) -> bool:
    """Return True if a light lies on a mesh with normals at its vertices.

    Mitsuba's density per solid angle of a point on it is that of a face with the interpolated normal: lights of few
    faces are too bright or too dark, by 20 % and more.

    Args:
        emitter: one ``mi.Emitter``.
    """
    shape = emitter.get_shape() if mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface) else None
    return shape is not None and has_vertices(shape) and has_normals(shape)


# Meshes, and what of the others has edges or limbs in closed form.
_OUTLINED = ("Sphere", "Disk", "Cylinder", "Ellipsoids", "Instance", "ShapeGroupPlugin")


def lacks_edges(shape: Any) -> bool:
    """Return True if a shape has outlines that no table of edges holds: curves and grids of distances.

    Args:
        shape: one ``mi.Shape``.
    """
    return not (shape.is_mesh() or shape.class_name() in _OUTLINED)


def has_limb(shape: Any) -> bool:
    """Return True if the points of a shape's outline depend on where it is seen from.

    Args:
        shape: one ``mi.Shape``.
    """
    return bool(shape.class_name() in ("Sphere", "Cylinder", "Ellipsoids"))


# Their normal is the same everywhere.
_FLAT = ("Rectangle", "Disk")
# Meshes of more faces are not looked through.
_LARGE_MESH = 10_000


def is_flat_shape(shape: Any) -> bool:
    """Return True for rectangles and disks.

    Args:
        shape: one ``mi.Shape``.
    """
    return bool(shape.class_name() in _FLAT)


def is_flat(shape: Any) -> bool:
    """Return True if the shading normal does not change along a face.

    Mitsuba's rectangles, its cube and the mesh that it merges them into have normals at their vertices: across the
    faces.

    Args:
        shape: one ``mi.Shape``. Meshes of many faces with normals count as curved without a look at them.
    """
    if not isinstance(shape, mi.Mesh):
        return is_flat_shape(shape)
    if not has_normals(shape):
        return True
    if shape.face_count() > _LARGE_MESH:
        return False
    corners = np.array(mesh_faces(shape)).reshape(-1, 3)
    normals = np.array(mesh_normals(shape)).reshape(-1, 3)[corners]
    return bool(np.ptp(normals, axis=1).max(initial=0) < 1e-5)


def bounds_of(shape: Any) -> Any:
    """Return the bounding box of a shape, metres in the world.

    Mitsuba leaves out that of a mesh that it merged from rectangles, and the scene's bounds lack it.

    Args:
        shape: one ``mi.Shape``.
    """
    bounds = shape.bbox()
    if not bounds.valid() and isinstance(shape, mi.Mesh):
        shape.recompute_bbox()
        bounds = shape.bbox()
    return bounds


def attached_distance(pi: Any, si: Any, ray: Any, active: Any) -> Any:
    """Return the distance of a surface along an attached ray; it need not be the first surface that the ray meets.

    Mitsuba takes the derivative of the distance of spheres and cylinders from another intersection with the whole
    shape, so that where a ray leaves them from outside it is that of where it entered. This one intersects the ray with
    the plane that touches the shape at the hit point and moves with it.

    Args:
        pi: ``PreliminaryIntersection3f`` of the surface.
        si: interaction there, which follows its shape (``RayFlags.FollowShape``).
        ray: ``Ray3f``, attached or not.
        active: mask of lanes.

    Returns:
        ``pi.t``, metres, with the derivatives by ray and shape.
    """
    n = dr.detach(si.n)
    cosine = dr.dot(n, ray.d)
    meets = active & (cosine != 0)
    distance = dr.dot(si.p - ray.o, n) / dr.select(meets, cosine, 1)
    return dr.replace_grad(pi.t, dr.select(meets, distance, 0))
