"""Points on a surface and directions at them, to ask BSDFs of, in whichever variant is active."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient import plugins


def activate(variant):
    mi.set_variant(variant)
    plugins.sync()


def start(request, variant):
    """Activate what a test is parametrised with as ``variant``, and ``variant`` for others: a switch takes 0.1 s."""
    activate((getattr(request.node, "callspec", None) and request.node.callspec.params.get("variant")) or variant)


def directions(seed, count, lowest=-1.0):
    """Directions above ``lowest``, along the normal and next to the surface among them."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(lowest, 1, count)
    z[:3] = 1, 0.999999, 1e-3
    phi = rng.uniform(0, 2 * np.pi, count)
    s = np.sqrt(1 - z * z)
    return mi.Vector3f(*np.array([s * np.cos(phi), s * np.sin(phi), z], dtype=np.float32))


def interaction(wi):
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(wi))
    si.wi, si.sh_frame, si.uv = wi, mi.Frame3f(mi.Normal3f(0, 0, 1)), mi.Point2f(0.5)
    if mi.is_spectral:
        si.wavelengths = mi.UnpolarizedSpectrum(450, 500, 550, 600)
    return si
