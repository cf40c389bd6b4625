"""Hidden scenes of captures around a corner: shapes without light or camera. Lengths in metres.

The relay wall lies in the plane z = 0 and looks along +z (`relay_wall`); hidden things are at positive z and face it. A
dictionary of each function holds shapes by name, for `tt.nlos.simulate` or as parts of a scene. Seen in pictures of a
scan, x runs to the right and y up, which is how letters read.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import finite, positive, real_array, shown, transform
from torchtransient.errors import SceneError, ShapeError
from torchtransient.scenes.letters import outline
from torchtransient.scenes.meshes import Albedo, Mesh, ellipsoid, joined, plate, sheet, solid, subdivided, triangle_mesh
from torchtransient.scenes.parts import SceneDict, diffuse
from torchtransient.scenes.transforms import scale


def relay_wall(width: float = 2.0, height: float = 2.0, albedo: Albedo = 0.5) -> SceneDict:
    """The wall that light goes around the corner by: a diffuse rectangle around the origin that faces +z."""
    half = [positive("width", width) / 2, positive("height", height) / 2, 1.0]
    return {"type": "rectangle", "to_world": scale(half), "bsdf": diffuse(albedo)}


def nlos_z(*, size: float = 1.0, depth: float = 1.0, albedo: Albedo = 0.9, thickness: float = 0.0) -> SceneDict:
    """The letter Z, `size` high and wide, `depth` before the wall: `nlos_letter("Z")`."""
    return nlos_letter("Z", size=size, depth=depth, albedo=albedo, thickness=thickness)


def nlos_letter(
    letter: str = "T",
    *,
    size: float = 1.0,
    depth: float = 1.0,
    albedo: Albedo = 0.9,
    thickness: float = 0.0,
    subdivide: int = 0,
) -> SceneDict:
    """A block letter, `size` high and wide, as the mesh `letter`, the side that faces the wall at z = `depth`.

    `thickness` 0 is a sheet, whose back is black; more is a closed body, which reaches to `depth + thickness`.
    `subdivide`: every triangle as 4^subdivide, for fits of its vertices. Letters: `scenes.letters.OUTLINES`. Raises
    SceneError for others and UnitError for lengths that are not positive.
    """
    corners = outline(letter, positive("size", size))
    z = positive("depth", depth)
    mesh = sheet(corners, z) if finite("thickness", thickness) == 0 else solid(corners, z, thickness)
    return {"letter": triangle_mesh(*subdivided(mesh, subdivide), reflectance=albedo)}


def nlos_plates(
    *,
    size: float = 0.8, depth: float = 0.8, gap: float = 0.5, albedo: Albedo = 0.9, second_size: float | None = None
) -> SceneDict:
    """A square plate `front` before the wall and another one, `back`, `gap` behind it. `second_size` None: as large."""
    z = positive("depth", depth)
    far = positive("second_size", size if second_size is None else second_size)
    return {
        "front": triangle_mesh(*plate(size, size, [0.0, 0.0, z]), reflectance=albedo),
        "back": triangle_mesh(*plate(far, far, [0.0, 0.0, z + positive("gap", gap)]), reflectance=albedo),
    }


def nlos_corner(size: float = 1.0, depth: float = 1.0, albedo: Albedo = 0.9) -> SceneDict:
    """Two plates that meet at a right angle and light each other, open towards the wall, and a small one before them.

    `left` and `right` start at z = `depth` at x = -size / 2 and size / 2 and meet at x = 0, `size / 2` deeper. `small`
    hides a part of `right`.
    """
    s, z = positive("size", size), positive("depth", depth)
    y = np.array([-s / 2, s / 2])
    near, far = z, z + s / 2

    def side(x: float) -> Mesh:
        corners = [[x, y[0], near], [x, y[1], near], [0.0, y[1], far], [0.0, y[0], far]]
        faces = np.array([[0, 1, 2], [0, 2, 3]])
        # Against the clock as seen from the wall, whichever of the two sides it is.
        return np.array(corners), faces if x < 0 else faces[:, ::-1].copy()

    return {
        "left": triangle_mesh(*side(-s / 2), reflectance=albedo),
        "right": triangle_mesh(*side(s / 2), reflectance=albedo),
        "small": triangle_mesh(*plate(s / 4, s / 4, [0.3 * s, 0.2 * s, z - 0.1 * s]), reflectance=albedo),
    }


# Centres and radii of the parts of a body 1.45 m high around the origin, of which the wall sees the -z side.
_BODY = (
    ((0.0, 0.55, 0.0), (0.11, 0.14, 0.12)),  # head
    ((0.0, 0.15, 0.0), (0.20, 0.28, 0.13)),  # trunk
    ((0.12, -0.38, 0.0), (0.08, 0.34, 0.09)),
    ((-0.12, -0.38, 0.0), (0.08, 0.34, 0.09)),  # legs
    ((0.33, 0.20, -0.05), (0.22, 0.06, 0.06)),  # an arm to the side
    ((-0.20, 0.20, -0.27), (0.06, 0.06, 0.24)),  # an arm towards the wall, which hides a part of the trunk
)


def mannequin(height: float = 1.45, level: int = 3) -> Mesh:
    """A body of six closed ellipsoids that overlap and hide each other, around the origin; one arm reaches towards -z.

    `height` in metres from the soles to the top of the head; 120 4^level triangles.
    """
    factor = positive("height", height) / 1.41
    parts = [ellipsoid(factor * np.array(center), factor * np.array(radii), level) for center, radii in _BODY]
    return joined(*parts)


def nlos_mannequin(
    *,
    depth: float = 1.2, height: float = 1.45, albedo: Albedo = 0.7, level: int = 3, x: float = 0.0
) -> SceneDict:
    """A standing `mannequin` as the mesh `body`, its axis `depth` before the wall and `x` beside its middle.

    Raises SceneError when the outstretched arm would reach through the wall.
    """
    vertices, faces = mannequin(height, level)
    vertices = vertices + np.array([finite("x", x), 0.0, positive("depth", depth)])
    if vertices[:, 2].min() <= 0:
        needed = depth - vertices[:, 2].min()
        raise SceneError(f"depth: expected more than {needed:.3g} m, the reach of the arm, got {depth!r}")
    return {"body": triangle_mesh(vertices, faces, reflectance=albedo)}


def bounds(shapes: SceneDict) -> NDArray[np.float64]:
    """The box (2, 3) around the shapes of a dictionary: lowest and highest coordinates, metres.

    For shapes of this room: rectangles, disks, cubes, spheres and meshes as arrays. Raises SceneError for others, and
    for a dictionary without any.
    """
    if not isinstance(shapes, dict):
        raise SceneError(f"bounds: expected a dictionary of shapes, got {shown(shapes)}")
    boxes = [_bounds_of(name, shape) for name, shape in shapes.items() if isinstance(shape, dict)]
    if not boxes:
        raise SceneError("bounds: expected a dictionary of shapes, got one without any")
    return np.stack([np.min([low for low, _ in boxes], axis=0), np.max([high for _, high in boxes], axis=0)])


def _bounds_of(name: str, shape: SceneDict) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    kind, matrix = shape.get("type"), transform(f"{name}: to_world", shape.get("to_world", np.eye(4)))
    if kind == "sphere":
        center = matrix[:3, :3] @ _rows(name, "center", shape.get("center", [0.0, 0.0, 0.0])) + matrix[:3, 3]
        reach = positive(f"{name}: radius", shape.get("radius", 1.0)) * np.linalg.norm(matrix[:3, :3], axis=1)
        return center - reach, center + reach
    if kind == "disk":
        reach = np.linalg.norm(matrix[:3, :2], axis=1)
        return matrix[:3, 3] - reach, matrix[:3, 3] + reach
    if kind == "mesh_arrays":
        points = _rows(name, "vertices", shape.get("vertices"))
    elif kind in ("rectangle", "cube"):
        depths = (0.0,) if kind == "rectangle" else (-1.0, 1.0)
        points = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in depths], dtype=np.float64)
    else:
        raise SceneError(f"bounds: expected rectangles, disks, cubes, spheres or mesh_arrays, got {kind!r} at {name}")
    placed = points @ matrix[:3, :3].T + matrix[:3, 3]
    return placed.min(0), placed.max(0)


def _rows(name: str, entry: str, values: Any) -> NDArray[np.float64]:
    rows = real_array(values)
    if rows is None or not rows.size or rows.shape[-1] != 3:
        raise ShapeError(f"bounds: expected {entry} of {name} as rows of three numbers, got {shown(values)}")
    return rows
