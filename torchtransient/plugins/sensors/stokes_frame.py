"""The frame in which a sensor reports polarization."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.polarized import rotation_between, stokes_frame_of


def sensor_rotation(seen, ray):
    """Rotation from the frame of the primary ray to the sensor's, attached where the sensor's pose is.

    ``seen``: the :class:`~.origin.View` of every sensor that the rays belong to. The sensor's horizontal axis is
    ``cross(d, up)`` with the ray's direction ``d`` and ``up`` the sensor's local +y in
    the world: to the right of the picture, as in Mitsuba's ``stokes`` integrator. Rays along ``up`` have no such axis;
    they keep the implicit frame of their direction.
    """
    up = seen[0].sensor.world_transform() @ mi.Vector3f(0, 1, 0)
    for view in seen[1:]:
        up = dr.select(view.active, view.sensor.world_transform() @ mi.Vector3f(0, 1, 0), up)
    horizontal = dr.cross(ray.d, up)
    # The frame of the ray is the projection of a fixed vector: unit length only where nothing is attached.
    current = stokes_frame_of(ray.d)
    current = dr.normalize(current - ray.d * dr.dot(current, ray.d))
    return rotation_between(-ray.d, current, horizontal)
