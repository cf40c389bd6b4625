"""Whether a scan still looks at its points with the values of a call: things that have moved between the wall and an
origin, or behind the wall.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from torchtransient.nlos.scene_scan import SAME_POINT, reaches_before


class ScanWatch:
    """Says what is wrong with a scene of a capture as it is, in one pass of rays to scan points and laser spots.

    It is asked in every render, so it does not look up which shapes are met: every end in the wrong place counts.
    """

    def __call__(self, scene: Any, number: int) -> dict[str, str]:
        """Findings about sensor ``number`` of a scene that holds the values of a call, by what they are about."""
        import drjit as dr
        import mitsuba as mi

        from torchtransient.plugins.around_corner.scan_table import aims_of, origin_of, scanned_points

        sensor, integrator = scene.sensors()[number], scene.integrator()
        with dr.suspend_grad():
            points, origin = dr.detach(scanned_points(scene, sensor)), dr.detach(mi.Point3f(sensor.origin))
            laser = dr.detach(origin_of(scene, sensor))
            spots = laser + dr.detach(aims_of(scene, sensor, integrator.capture, None))
            seen, normals = _end(scene, origin, points)
            lit, _ = _end(scene, laser, spots)
            dr.eval(points, spots, seen, lit, normals)
        places, marks = np.array(points).T, np.array(spots).T
        found = {}
        for who, ends, wanted, start in (("sensor", seen, places, origin), ("laser", lit, marks, laser)):
            legs = np.linalg.norm(wanted - np.array(start).reshape(3), axis=1)
            size = max(float(np.linalg.norm(np.ptp(places, axis=0))), float(legs.max()))
            off = int((~(np.abs(np.array(ends) - legs) <= SAME_POINT * size)).sum())
            if off:
                found[f"{who} of a scan"] = (
                    f"{off} of {len(legs)} rays of the {who} do not end at their points of the wall, for values of a "
                    f"call: something stands between the wall and {who}_origin, or points and wall have parted. What "
                    "the rays meet is what is rendered there."
                )
        wall = sensor.get_shape()
        hidden = [shape for shape in scene.shapes() if shape.ptr != wall.ptr]
        if not reaches_before(hidden, places, np.array(normals).T):
            found["hidden things of a scan"] = (
                "nothing hidden is before the wall, for values of a call: what is behind it sends it no light, and "
                "has no gradient that would bring it back."
            )
        return found


def _end(scene: Any, origin: Any, points: Any) -> tuple[Any, Any]:
    """How far rays from an origin to points go (Float), and normals there on the side that they come from."""
    import drjit as dr
    import mitsuba as mi

    ray = mi.Ray3f(origin, dr.normalize(points - origin))
    pi = scene.ray_intersect_preliminary(ray, coherent=True)
    si = pi.compute_surface_interaction(ray, +mi.RayFlags.Minimal)
    return pi.t, dr.select(dr.dot(si.n, ray.d) > 0, -si.n, si.n)
