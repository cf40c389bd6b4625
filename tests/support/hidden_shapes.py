"""Hidden geometry as arrays and as Mitsuba meshes; the relay wall lies in z = 0 and faces +z."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from torchtransient.scenes.meshes import joined as join
from torchtransient.scenes.meshes import octahedral_ellipsoid as ball
from torchtransient.scenes.meshes import plate as plate


def disc(radius, z, corners=720):
    """A regular polygon of the area of a disc, facing the wall."""
    a = 2 * np.pi * np.arange(corners) / corners
    outer = radius * np.sqrt(2 * np.pi / corners / np.sin(2 * np.pi / corners))
    v = np.concatenate([[[0, 0, z]], np.stack([outer * np.cos(a), outer * np.sin(a), 0 * a + z], 1)])
    k = np.arange(corners)
    return v, np.stack([0 * k, 1 + (k + 1) % corners, 1 + k], 1)


def mannequin(level=2, z=1.2):
    """A closed body of ellipsoids that hide each other, one arm stretched towards the wall."""
    return join(
        ball([0, 0.55, z], [0.11, 0.14, 0.12], level),
        ball([0, 0.15, z], [0.2, 0.28, 0.13], level),
        ball([0.12, -0.38, z], [0.08, 0.34, 0.09], level),
        ball([-0.12, -0.38, z], [0.08, 0.34, 0.09], level),
        ball([0.33, 0.2, z - 0.05], [0.22, 0.06, 0.06], level),
        ball([-0.2, 0.2, z - 0.27], [0.06, 0.06, 0.24], level),
    )


def folded_plates(z=1.0):
    """Two plates in a V that opens towards the wall, and a small one in front of one of them."""
    a, f = plate(1, 1, (0.5, 0, 0))
    left = np.stack([-0.5 + 0.5 * a[:, 0], a[:, 1], z + 0.5 * a[:, 0]], 1)
    right = np.stack([0.5 * a[:, 0], a[:, 1], z + 0.5 - 0.5 * a[:, 0]], 1)
    return join((left, f), (right, f), plate(0.25, 0.25, (0.3, 0.2, z - 0.1)))


def mesh(name, arrays, albedo=0.7, two_sided=False, vertex_normals=False, back=None):
    """A Mitsuba mesh of (vertices, faces). ``back``: the albedo of its other side, where that is another one."""
    v, f = arrays
    if not isinstance(albedo, dict):
        albedo = float(albedo)
    bsdf = {"type": "diffuse", "reflectance": albedo}
    properties = mi.Properties()
    sides = {} if back is None else {"back": {"type": "diffuse", "reflectance": back}}
    properties["mesh_bsdf"] = mi.load_dict({"type": "twosided", "front": bsdf, **sides} if two_sided else bsdf)
    made = mi.Mesh(name, len(v), len(f), has_vertex_normals=vertex_normals, props=properties)
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = mi.Float(np.ravel(v).astype(np.float32))
    parameters["faces"] = mi.UInt32(np.ravel(f).astype(np.uint32))
    parameters.update()
    if vertex_normals:
        made.recompute_vertex_normals()
    return made


def scene_of(*shapes):
    """A scene of built shapes, each one kept as it is."""
    return mi.load_dict({"type": "scene", **{f"shape{i}": shape for i, shape in enumerate(shapes)}}, optimize=False)


def wall_grid(count, half=0.5):
    """Points of a grid on the wall, ``(count^2, 3)``, and their normals."""
    c = (np.arange(count) + 0.5) / count * 2 * half - half
    X, Y = np.meshgrid(c, c)
    points = np.stack([X, Y, 0 * X], -1).reshape(-1, 3)
    return points, np.tile([0.0, 0.0, 1.0], (len(points), 1))
