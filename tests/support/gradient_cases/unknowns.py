"""How the unknown of a gradient case enters the parameters of its scene: each function gives a ``Case.apply``."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np


def set_color(key):
    def apply(params, x):
        params[key] = type(params[key])(x)

    return apply


def move(key, direction):
    """Translate a shape, light or sensor by ``x * direction``."""

    def apply(params, x):
        offset = mi.AffineTransform4f().translate(mi.Vector3f(*direction) * x)
        params[key] = offset @ mi.AffineTransform4f(params[key])

    return apply


def rotate(key, axis):
    def apply(params, x):
        params[key] = mi.AffineTransform4f(params[key]) @ mi.AffineTransform4f().rotate(mi.Vector3f(*axis), x)

    return apply


def move_vertices(key, direction):
    def apply(params, x):
        p = dr.unravel(mi.Point3f, params[key])
        params[key] = dr.ravel(p + mi.Vector3f(*direction) * x)

    return apply


def move_point(key, direction):
    def apply(params, x):
        params[key] = mi.Point3f(params[key]) + mi.Vector3f(*direction) * x

    return apply


def scale_texture(key):
    def apply(params, x):
        t = params[key]
        ramp = np.linspace(0.0, 1.0, int(np.prod(t.shape)), dtype=np.float32)
        params[key] = mi.TensorXf(t.array + mi.Float(ramp) * x, t.shape)

    return apply
