"""Hidden scenes of captures around a corner: shapes without light or camera. Lengths in metres.

The relay wall lies in the plane z = 0 and looks along +z (`relay_wall`); hidden things are at positive z and face it.
Each function returns a dictionary of shapes by name, for `tt.nlos.simulate` or as parts of a scene. Seen in pictures of
a scan, x runs to the right and y up, so that letters read as usual.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import finite, flag, positive, transform
from torchtransient.errors import ArgumentError, SceneError
from torchtransient.scenes.meshes import Albedo, Mesh, ellipsoid, joined, plate, sheet, solid, subdivided, triangle_mesh
from torchtransient.scenes.parts import SceneDict, diffuse
from torchtransient.scenes.transforms import rotate, scale, translate

# Width of a stroke of a letter, and half of it.
_S = 0.2
_H = 0.5 * _S

# Corners (x, y) of block letters without holes in [0, 1]^2, against the clock.
OUTLINES: dict[str, tuple[tuple[float, float], ...]] = {
    "C": ((0, 0), (1, 0), (1, _S), (_S, _S), (_S, 1 - _S), (1, 1 - _S), (1, 1), (0, 1)),
    "E": ((0, 0), (1, 0), (1, _S), (_S, _S), (_S, 0.5 - _H), (0.8, 0.5 - _H), (0.8, 0.5 + _H), (_S, 0.5 + _H),
          (_S, 1 - _S), (1, 1 - _S), (1, 1), (0, 1)),
    "F": ((0, 0), (_S, 0), (_S, 0.5 - _H), (0.8, 0.5 - _H), (0.8, 0.5 + _H), (_S, 0.5 + _H), (_S, 1 - _S), (1, 1 - _S),
          (1, 1), (0, 1)),
    "H": ((0, 0), (_S, 0), (_S, 0.5 - _H), (1 - _S, 0.5 - _H), (1 - _S, 0), (1, 0), (1, 1), (1 - _S, 1),
          (1 - _S, 0.5 + _H), (_S, 0.5 + _H), (_S, 1), (0, 1)),
    "I": ((0.5 - _H, 0), (0.5 + _H, 0), (0.5 + _H, 1), (0.5 - _H, 1)),
    "K": ((0, 0), (_S, 0), (_S, 0.38), (0.34, 0.5), (0.75, 0), (1, 0), (0.48, 0.62), (0.95, 1), (0.65, 1), (_S, 0.64),
          (_S, 1), (0, 1)),
    "L": ((0, 0), (1, 0), (1, _S), (_S, _S), (_S, 1), (0, 1)),
    "N": ((0, 0), (_S, 0), (_S, 0.66), (1 - _S, 0), (1, 0), (1, 1), (1 - _S, 1), (1 - _S, 0.34), (_S, 1), (0, 1)),
    "S": ((0, 0), (1, 0), (1, 0.5 + _H), (_S, 0.5 + _H), (_S, 1 - _S), (1, 1 - _S), (1, 1), (0, 1), (0, 0.5 - _H),
          (1 - _S, 0.5 - _H), (1 - _S, _S), (0, _S)),
    "T": ((0.5 - _H, 0), (0.5 + _H, 0), (0.5 + _H, 1 - _S), (1, 1 - _S), (1, 1), (0, 1), (0, 1 - _S),
          (0.5 - _H, 1 - _S)),
    "U": ((0, 0), (1, 0), (1, 1), (1 - _S, 1), (1 - _S, _S), (_S, _S), (_S, 1), (0, 1)),
    "V": ((0.5 - _H, 0), (0.5 + _H, 0), (1, 1), (1 - _S, 1), (0.5, 0.25), (_S, 1), (0, 1)),
    "X": ((0, 0), (0.23, 0), (0.5, 0.36), (0.77, 0), (1, 0), (0.62, 0.5), (1, 1), (0.77, 1), (0.5, 0.64), (0.23, 1),
          (0, 1), (0.38, 0.5)),
    "Y": ((0.5 - _H, 0), (0.5 + _H, 0), (0.5 + _H, 0.45), (1, 1), (0.77, 1), (0.5, 0.65), (0.23, 1), (0, 1),
          (0.5 - _H, 0.45)),
    "Z": ((0, 0), (1, 0), (1, _S), (0.27, _S), (1, 1 - _S), (1, 1), (0, 1), (0, 1 - _S), (0.73, 1 - _S), (0, _S)),
}  # fmt: skip
# Albedos by what they are of.
COLOURS = {"walls": 0.7, "floor": 0.4, "ceiling": 0.8, "desk": 0.5, "shelf": 0.45, "books": 0.6, "chair": 0.3,
           "person": 0.6}  # fmt: skip


def relay_wall(width: float = 2.0, height: float = 2.0, albedo: Albedo = 0.5) -> SceneDict:
    """Return the relay wall: a diffuse rectangle around the origin that faces +z.

    Args:
        width: width of the wall, metres.
        height: height of the body, metres.
        albedo: albedo, one number or a linear sRGB triple.
    """
    half = [positive("width", width) / 2, positive("height", height) / 2, 1.0]
    return {"type": "rectangle", "to_world": scale(half), "bsdf": diffuse(albedo)}


def nlos_z(*, size: float = 1.0, depth: float = 1.0, albedo: Albedo = 0.9, thickness: float = 0.0) -> SceneDict:
    """Return the letter Z: `nlos_letter("Z")`.

    Args:
        size: height and width, metres.
        depth: distance from the wall, metres.
        albedo: albedo, one number or a linear sRGB triple.
        thickness: thickness of the letter, metres, 0 for a sheet.
    """
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
    """Return a block letter as the mesh `letter`, the side that faces the wall at z = `depth`.

    Args:
        letter: name of the letter, one of `scenes.nlos.OUTLINES`.
        size: height and width, metres.
        depth: distance from the wall, metres.
        albedo: albedo, one number or a linear sRGB triple.
        thickness: thickness of the letter, metres. 0 is a sheet, whose back is black; more is a closed body, which
            reaches to `depth + thickness`.
        subdivide: number of times that every triangle is split in four, for fits of its vertices.

    Raises:
        ArgumentError: for other letters.
        UnitError: for lengths that are not positive.
    """
    corners = outline(letter, positive("size", size))
    z = positive("depth", depth)
    mesh = sheet(corners, z) if finite("thickness", thickness) == 0 else solid(corners, z, thickness)
    return {"letter": triangle_mesh(*subdivided(mesh, subdivide), reflectance=albedo)}


def outline(letter: str, size: float = 1.0) -> NDArray[np.float64]:
    """Return the corners of a letter around the origin, against the clock.

    Args:
        letter: name of the letter, one of `OUTLINES`, which have no holes.
        size: height and width, metres.

    Returns:
        (N, 2), metres.

    Raises:
        ArgumentError: for other letters.
    """
    if letter not in OUTLINES:
        raise ArgumentError(f"letter: expected one of {', '.join(OUTLINES)}, got {letter!r}")
    return (np.array(OUTLINES[letter], dtype=np.float64) - 0.5) * size


def nlos_plates(
    *,
    size: float = 0.8, depth: float = 0.8, gap: float = 0.5, albedo: Albedo = 0.9, second_size: float | None = None
) -> SceneDict:
    """Return a square plate `front` before the wall and another one, `back`, behind it.

    Args:
        size: side of the front plate, metres.
        depth: distance of the front plate from the wall, metres.
        gap: distance between the two plates, metres.
        albedo: albedo, one number or a linear sRGB triple.
        second_size: side of the back plate, metres, None for that of the front plate.
    """
    z = positive("depth", depth)
    far = positive("second_size", size if second_size is None else second_size)
    return {
        "front": triangle_mesh(*plate(size, size, [0.0, 0.0, z]), reflectance=albedo),
        "back": triangle_mesh(*plate(far, far, [0.0, 0.0, z + positive("gap", gap)]), reflectance=albedo),
    }


def nlos_corner(size: float = 1.0, depth: float = 1.0, albedo: Albedo = 0.9) -> SceneDict:
    """Return two plates that meet at a right angle and light each other, open towards the wall, and a small one before
    them.

    `left` and `right` start at z = `depth` at x = -size / 2 and size / 2 and meet at x = 0, `size / 2` deeper. `small`
    hides a part of `right`.

    Args:
        size: width and height, metres.
        depth: distance from the wall, metres.
        albedo: albedo, one number or a linear sRGB triple.
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
    """Return a body of six closed ellipsoids that overlap and hide each other, around the origin; one arm reaches
    towards -z.

    Args:
        height: height from the soles to the top of the head, metres.
        level: number of times that triangles are split; 120 4^level triangles in all.
    """
    factor = positive("height", height) / 1.41
    parts = [ellipsoid(factor * np.array(center), factor * np.array(radii), level) for center, radii in _BODY]
    return joined(*parts)


def nlos_mannequin(
    *,
    depth: float = 1.2, height: float = 1.45, albedo: Albedo = 0.7, level: int = 3, x: float = 0.0
) -> SceneDict:
    """Return a standing `mannequin` as the mesh `body`.

    Args:
        depth: distance of the body's axis from the wall, metres.
        height: height of the body, metres.
        albedo: albedo, one number or a linear sRGB triple.
        level: number of times that the triangles of the mesh are split.
        x: x coordinate of the body's axis, metres.

    Raises:
        SceneError: if the outstretched arm would reach through the wall.
    """
    vertices, faces = mannequin(height, level)
    vertices = vertices + np.array([finite("x", x), 0.0, positive("depth", depth)])
    if vertices[:, 2].min() <= 0:
        needed = depth - vertices[:, 2].min()
        raise SceneError(f"depth: expected more than {needed:.3g} m, the reach of the arm, got {depth!r}")
    return {"body": triangle_mesh(vertices, faces, reflectance=albedo)}


def bounds(shapes: SceneDict) -> NDArray[np.float64]:
    """Return the box (2, 3) around the shapes of a dictionary: lowest and highest coordinates, metres.

    Args:
        shapes: rectangles, disks, cubes, spheres and meshes as arrays, by name.

    Raises:
        SceneError: for other shapes, and for a dictionary without any.
    """
    boxes = [_bounds_of(name, shape) for name, shape in shapes.items() if isinstance(shape, dict)]
    if not boxes:
        raise SceneError("bounds: expected a dictionary of shapes, got one without any")
    return np.stack([np.min([low for low, _ in boxes], axis=0), np.max([high for _, high in boxes], axis=0)])


def _bounds_of(name: str, shape: SceneDict) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    kind, matrix = shape["type"], transform(f"{name}: to_world", shape.get("to_world", np.eye(4)))
    if kind == "sphere":
        center = matrix[:3, :3] @ np.asarray(shape.get("center", [0.0, 0.0, 0.0])) + matrix[:3, 3]
        reach = positive(f"{name}: radius", shape.get("radius", 1.0)) * np.linalg.norm(matrix[:3, :3], axis=1)
        return center - reach, center + reach
    if kind == "disk":
        reach = np.linalg.norm(matrix[:3, :2], axis=1)
        return matrix[:3, 3] - reach, matrix[:3, 3] + reach
    if kind == "mesh_arrays":
        points = np.asarray(shape["vertices"], dtype=np.float64)
    elif kind in ("rectangle", "cube"):
        depths = (0.0,) if kind == "rectangle" else (-1.0, 1.0)
        points = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in depths], dtype=np.float64)
    else:
        raise SceneError(f"bounds: expected rectangles, disks, cubes, spheres or mesh_arrays, got {kind!r} at {name}")
    placed = points @ matrix[:3, :3].T + matrix[:3, 3]
    return placed.min(0), placed.max(0)


# --------------------------------------------------------------------------------------------------------------- a room


def nlos_room(
    width: float = 3.6,
    height: float = 2.6,
    depth: float = 3.2,
    *,
    albedo: float | None = None,
    person: bool = True,
    level: int = 3,
) -> SceneDict:
    """Return an office of which `relay_wall(width, height)` is one wall: floor, ceiling, walls, desk, shelf, chair,
    person.

    The room fills |x| <= width / 2, |y| <= height / 2 and 0 <= z <= depth. Furniture is placed from the walls and keeps
    its size.

    Args:
        width: width of the room, metres, at least 2.4.
        height: height of the room, metres, at least 2.2.
        depth: depth of the room, metres, at least 2.4.
        albedo: albedo of everything, None for those of `COLOURS`.
        person: False leaves the room empty, as a background to subtract.
        level: number of times that the triangles of the person are split.

    Raises:
        UnitError: for smaller rooms.
    """
    for name, size, least in (("width", width, 2.4), ("height", height, 2.2), ("depth", depth, 2.4)):
        positive(f"{name} beyond the {least} m of the furniture", positive(name, size) - least + 1e-9)
    flag("person", person)
    x, y, z = width / 2, height / 2, depth

    def of(what: str) -> float:
        return COLOURS[what] if albedo is None else albedo

    shapes: SceneDict = {
        "floor": _face([0, -y, z / 2], [x, z / 2], rotate([1, 0, 0], -90), of("floor")),
        "ceiling": _face([0, y, z / 2], [x, z / 2], rotate([1, 0, 0], 90), of("ceiling")),
        "left_wall": _face([-x, 0, z / 2], [z / 2, y], rotate([0, 1, 0], 90), of("walls")),
        "right_wall": _face([x, 0, z / 2], [z / 2, y], rotate([0, 1, 0], -90), of("walls")),
        "back_wall": _face([0, 0, z], [x, y], rotate([0, 1, 0], 180), of("walls")),
    }
    floor = -y
    desk = [x - 0.45, floor, z - 1.0]
    shapes["desk_top"] = _block([desk[0], floor + 0.73, desk[2]], [0.8, 0.04, 1.4], of("desk"))
    for number, (i, k) in enumerate(((-1, -1), (-1, 1), (1, -1), (1, 1))):
        leg = [desk[0] + i * 0.36, floor + 0.355, desk[2] + k * 0.65]
        shapes[f"desk_leg_{number}"] = _block(leg, [0.05, 0.71, 0.05], of("desk"))
    shapes["screen"] = _block([x - 0.35, floor + 0.98, desk[2]], [0.03, 0.36, 0.6], of("chair"))
    chair = [x - 1.15, floor, desk[2]]
    shapes["chair_seat"] = _block([chair[0], floor + 0.45, chair[2]], [0.44, 0.06, 0.44], of("chair"))
    shapes["chair_back"] = _block([chair[0] - 0.2, floor + 0.76, chair[2]], [0.05, 0.5, 0.42], of("chair"))
    shapes["chair_post"] = _block([chair[0], floor + 0.21, chair[2]], [0.08, 0.42, 0.08], of("chair"))
    _add_shelf(shapes, [-x + 0.75, floor, z - 0.17], of("shelf"), of("books"))
    if person:
        # Two metres before the wall at most, so that a deep room does not hide its person in the dark.
        place = [-0.25 * x, floor + 0.85, min(0.55 * z, 2.0)]
        vertices, faces = mannequin(1.7, level)
        vertices = vertices + np.array(place) - [0.0, vertices[:, 1].min() + 0.85, 0.0]
        shapes["person"] = triangle_mesh(vertices, faces, reflectance=of("person"))
    return shapes


def _add_shelf(shapes: SceneDict, foot: Sequence[float], wood: float, books: float) -> None:
    """Add a shelf of five boards between two sides before the back wall, with books on three of them."""
    x, y, z = foot
    wide, deep, high = 1.0, 0.3, 1.8
    for number, side in enumerate((-1, 1)):
        shapes[f"shelf_side_{number}"] = _block([x + side * wide / 2, y + high / 2, z], [0.03, high, deep], wood)
    for number in range(5):
        board = [x, y + 0.05 + number * 0.42, z]
        shapes[f"shelf_board_{number}"] = _block(board, [wide - 0.03, 0.03, deep], wood)
    for number, (at, length) in enumerate(((-0.25, 0.4), (0.2, 0.5), (-0.1, 0.7))):
        middle = [x + at, y + 0.065 + (number + 1) * 0.42 + 0.13, z + 0.03]
        shapes[f"books_{number}"] = _block(middle, [length, 0.26, 0.2], books)


def _face(center: Sequence[float], half: Sequence[float], turn: np.ndarray, albedo: float) -> SceneDict:
    to_world = translate(center) @ turn @ scale([half[0], half[1], 1.0])
    return {"type": "rectangle", "to_world": to_world, "bsdf": diffuse(albedo)}


def _block(center: Sequence[float], size: Sequence[float], albedo: float) -> SceneDict:
    to_world = translate(center) @ scale(np.asarray(size) / 2)
    return {"type": "cube", "to_world": to_world, "bsdf": diffuse(albedo)}
