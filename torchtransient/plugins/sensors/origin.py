"""Where the time of flight of a sensor's rays begins."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def length_to_sensor_origin(sensor, ray):
    """Distance in metres from the sensor's origin to ``ray.o``.

    Mitsuba's projective cameras start their rays on the near clip plane; their light travels on to the pinhole
    (perspective), to the sampled point of the aperture (thin lens) or to the sensor plane (orthographic). Other sensors
    start rays where they are.
    """
    near = getattr(sensor, "near_clip", None)
    if near is None:
        return mi.Float(0)
    axis = sensor.world_transform() @ mi.Vector3f(0, 0, 1)
    return near() / dr.dot(dr.normalize(axis), ray.d)
