"""Where places of a texture lie on a triangle mesh."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.capture.triangles import first_hits
from torchtransient.errors import SceneError


class PlacesOnMesh:
    """The points of ``mesh`` that have texture coordinates ``places`` (N, 2), which stay those of the same material
    points when the mesh moves. Where coordinates are used twice, the first triangle counts.

    Mitsuba's own ``eval_parameterization`` builds a scene for it, which must not happen while a kernel is traced, and
    forgets vertices that have moved. The mesh is not kept: the sensor that keeps these places is a child of it, and
    neither would ever be freed. Raises SceneError where the mesh has no point.
    """

    def __init__(self, mesh: Any, places: np.ndarray) -> None:
        shown = mi.traverse(mesh)
        faces = np.array(shown["faces"]).reshape(-1, 3)
        corners = np.zeros((len(faces), 3, 3))
        corners[:, :, :2] = np.array(shown["vertex_texcoords"], dtype=np.float64).reshape(-1, 2)[faces]
        origins = np.column_stack([places, np.full(len(places), -1.0)])
        _, triangle = first_hits(origins, np.array([0.0, 0.0, 1.0]), corners)
        missed = int((triangle < 0).sum())
        if missed:
            raise SceneError(
                f"nlos_capture_meter: expected texture coordinates of the mesh {mesh.id()!r} that fill the square from "
                f"0 to 1, got none at {missed} of {len(places)} places of the film. Give the points: an array (N, 3), "
                "one for each pixel, and the laser's as laser_points."
            )
        a, b, c = corners[triangle, :, :2].transpose(1, 0, 2)
        edges = np.stack([b - a, c - a], axis=-1)
        along = np.linalg.solve(edges, (places - a)[..., None])[..., 0]
        self._triangle = mi.UInt32(triangle.astype(np.uint32))
        self._along = [mi.Float(np.ascontiguousarray(column, dtype=np.float32)) for column in along.T]
        dr.make_opaque(self._triangle, self._along)

    def points(self, mesh: Any, index: Any) -> Any:
        """The points (Point3f) of places given by their index, attached where the vertices of ``mesh`` are."""
        face = mesh.face_indices(dr.gather(mi.UInt32, self._triangle, index))
        a, b, c = (mi.Point3f(mesh.vertex_position(corner)) for corner in face)
        first, second = (dr.gather(mi.Float, column, index) for column in self._along)
        return a + (b - a) * first + (c - a) * second
