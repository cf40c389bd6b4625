"""Whether a scan still looks at its points with the values of a call: things that have moved between the wall and an
origin, or behind the wall.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.nlos.scene_scan import reaches_before

# What findings are about.
SENSOR_RAYS, LASER_RAYS, HIDDEN = "sensor of a scan", "laser of a scan", "hidden things of a scan"


@dataclass(frozen=True, eq=False)
class ScanWatch:
    """Says what is wrong with a scene of a capture as it is, in one pass of rays to scan points and laser spots.

    ``tolerance``: in metres, how far from its point a ray may end. ``normals``: those of the wall at the scan points
    (N, 3), None where they may change. It is asked in every render, so it does not look up which shapes are met: every
    end in the wrong place counts.
    """

    tolerance: float
    normals: NDArray[np.float64] | None

    def __call__(self, scene: Any, number: int) -> dict[str, str]:
        """Findings about sensor ``number`` of a scene that holds the values of a call, by what they are about."""
        import drjit as dr
        import mitsuba as mi

        from torchtransient.interfaces import CaptureType
        from torchtransient.plugins.around_corner.scan_table import aims_of, origin_of, scanned_points

        sensor, capture = scene.sensors()[number], scene.integrator().capture
        with dr.suspend_grad():
            points, origin = scanned_points(scene, sensor), mi.Point3f(sensor.origin)
            laser = origin_of(scene, sensor)
            rays = {"sensor": _rays(origin, points - origin)}
            if capture is not CaptureType.CONFOCAL or not np.array_equal(laser, origin):
                rays["laser"] = _rays(laser, aims_of(scene, sensor, capture, None))
            tolerance = dr.opaque(mi.Float, self.tolerance)
            off = {who: _end_elsewhere(scene, *ray, tolerance) for who, ray in rays.items()}
            normals = None if self.normals is not None else _normals(scene, rays["sensor"][0])
            dr.eval(points, normals, off)
        found = {}
        for who, wrong in ((who, np.array(wrong)) for who, wrong in off.items()):
            if wrong.any():
                found[SENSOR_RAYS if who == "sensor" else LASER_RAYS] = (
                    f"{wrong.sum()} of {len(wrong)} rays of the {who} do not end at their points of the wall, for the "
                    f"values of a call: something stands between the wall and {who}_origin, or points and wall have "
                    "parted. What the rays meet is what is rendered there."
                )
        wall = sensor.get_shape()
        hidden = [shape for shape in scene.shapes() if shape.ptr != wall.ptr]
        upright = self.normals if self.normals is not None else np.array(normals).T
        if not reaches_before(hidden, np.array(points).T, upright):
            found[HIDDEN] = (
                "nothing hidden is before the wall, for the values of a call: what is behind it sends it no light, and "
                "has no gradient that would bring it back."
            )
        return found


def _rays(origin: Any, way: Any) -> tuple[Any, Any]:
    """Rays (Ray3f) along ways, and their lengths."""
    import drjit as dr
    import mitsuba as mi

    length = dr.norm(way)
    return mi.Ray3f(origin, way / length), length


def _end_elsewhere(scene: Any, ray: Any, length: Any, tolerance: Any) -> Any:
    """Which rays meet something before their length, or nothing there (Bool); NaN is elsewhere, too."""
    import drjit as dr

    met = scene.ray_intersect_preliminary(ray, coherent=True)
    return ~(dr.abs(met.t - length) <= tolerance)


def _normals(scene: Any, ray: Any) -> Any:
    """Normals where rays end, on the side that they come from."""
    import drjit as dr
    import mitsuba as mi

    si = scene.ray_intersect(ray, +mi.RayFlags.Minimal, coherent=True)
    return dr.select(dr.dot(si.n, ray.d) > 0, -si.n, si.n)
