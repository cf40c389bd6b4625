"""Places that move with one number, and the slopes of what follows them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

H = 1e-6
# A vertex, and how it moves.
PLACE, MOVE = np.array([0.3, -0.2, 0.5]), np.array([0.4, -0.3, 0.6])


def unit(v):
    return v / np.linalg.norm(v)


def vector(kind, value, slope, x):
    """``value + slope x``"""
    return kind(*np.asarray(value).tolist()) + mi.Vector3f(*np.asarray(slope).tolist()) * x


def slopes(x, *values):
    """The derivatives of ``values`` by ``x``."""
    values = [value * 1 for value in values]  # inner nodes keep no derivative
    dr.set_grad(x, 1)
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward)
    found = [dr.grad(value) for value in values]
    dr.eval(found)
    return [np.array(value, dtype=np.float64).ravel() for value in found]


def attached_zero():
    x = dr.opaque(mi.Float, 0)
    dr.enable_grad(x)
    return x


def difference(f):
    return (np.array(f(H)) - np.array(f(-H))) / (2 * H)


def painted_lamp(**kind):
    """A lamp of two by three metres, two metres above, that shines by place: ``7 u`` and ``7 v``; and its pose."""
    x = (np.arange(64) + 0.5) / 64
    image = np.stack([*np.meshgrid(x, x), np.ones((64, 64))], 2)
    radiance = {"type": "bitmap", "data": mi.TensorXf(7 * image.astype(np.float32)), "raw": True}
    pose = mi.ScalarTransform4f().translate([0, 0, 2]).rotate([0, 1, 0], 180).scale([1, 1.5, 1])
    lamp = {"type": "rectangle", "to_world": pose, "emitter": {"type": "area", "radiance": radiance} | kind}
    return mi.load_dict({"type": "scene", "lamp": lamp})
