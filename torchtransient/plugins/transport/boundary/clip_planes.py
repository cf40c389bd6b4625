"""Shapes that a camera's clip planes cut: the line of the cut is no edge of theirs, so that no table of edges holds it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.kernel_arrays import registry_number
from torchtransient.plugins.node_walk import shapes_of_scene
from torchtransient.plugins.sensors.origin import sensors_of
from torchtransient.plugins.sensors.seen_from import clip_planes_at, has_clip_planes
from torchtransient.plugins.transport.scene_contents import is_open

# Lines across the picture, in each direction, along which clip planes are searched; surfaces that are met along each.
_LINES, _MOST_HITS = 64, 1024


def clipped_shapes(scene: Any, sensors: Sequence[Any]) -> list[Any]:
    """Return the shapes, instances included, through which clip planes go within the picture, hidden ones too.

    Searched along lines of the planes, so that a cut that is shorter than 1 / 64 of the picture may be missed.

    Args:
        scene: Mitsuba scene.
        sensors: some of its sensors.
    """
    found: set[int] = set()
    with dr.suspend_grad():
        for camera in [one for sensor in sensors for one in sensors_of(sensor) if has_clip_planes(one)]:
            across = (dr.arange(mi.Float, _LINES) + 0.5) / _LINES
            low, high = dr.zeros(mi.Float, _LINES), dr.ones(mi.Float, _LINES)
            starts = mi.Point2f(dr.concat([low, across]), dr.concat([across, low]))
            stops = mi.Point2f(dr.concat([high, across]), dr.concat([across, high]))
            for start, stop in zip(clip_planes_at(camera, starts), clip_planes_at(camera, stops), strict=True):
                found |= _met(scene, mi.Ray3f(start, stop - start))
    shapes = [shape for shape in shapes_of_scene(scene) if registry_number(shape) in found]
    return [shape for shape in shapes if not (shape.is_medium_transition() and is_open(shape))]


def _met(scene: Any, ray: Any) -> set[int]:
    """Return the registry numbers of shapes and instances that rays meet at distances below one."""
    found: set[int] = set()
    ray.maxt = mi.Float(1)
    active = mi.Bool(True)
    for _ in range(_MOST_HITS):
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        active &= pi.is_valid()
        numbers = [dr.reinterpret_array(mi.UInt32, pointer) for pointer in (pi.shape, pi.instance)]
        met = [np.array(dr.select(active, number, 0)) for number in numbers]
        if not any(one.any() for one in met):
            break
        found |= {int(number) for one in met for number in np.unique(one)}
        step = pi.t + 1e-4
        ray.o, ray.maxt = ray.o + ray.d * step, ray.maxt - step
        active &= ray.maxt > 0
    return found - {0}
