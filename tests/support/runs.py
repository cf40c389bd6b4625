"""Independent renders of a scene, stacked for statistics."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from torchtransient.plugins.guards import no_collection


def T():
    """Mitsuba's scalar affine transform of the active variant."""
    return mi.ScalarTransform4f()


def runs(scene, count=6, spp=256, seed=0):
    """Independent (steady, transient) renders, stacked along the first axis."""
    results = [scene.integrator().render(scene, seed=seed + k, spp=spp) for k in range(count)]
    return [np.array([np.array(r[i]) for r in results], dtype=float) for i in (0, 1)]


def mitsuba_image(scene, seed, spp):
    """Image of one of Mitsuba's integrators, with all its channels."""
    with no_collection():
        return np.array(mi.render(scene, seed=seed, spp=spp), dtype=float)


def steady_runs(scene, count=6, spp=256, seed=700):
    """Independent images of one of Mitsuba's integrators."""
    images = np.array([mitsuba_image(scene, seed + k, spp) for k in range(count)])
    return images[..., :1] if mi.is_monochromatic else images
