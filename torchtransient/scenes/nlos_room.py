"""An office behind the corner, of which the relay wall is one wall. Lengths in metres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchtransient.checks import flag, positive
from torchtransient.scenes.meshes import triangle_mesh
from torchtransient.scenes.nlos import mannequin
from torchtransient.scenes.parts import SceneDict, diffuse
from torchtransient.scenes.transforms import rotate, scale, translate

# Albedos by what they are of.
COLOURS = {"walls": 0.7, "floor": 0.4, "ceiling": 0.8, "desk": 0.5, "shelf": 0.45, "books": 0.6, "chair": 0.3,
           "person": 0.6}  # fmt: skip


def nlos_room(
    width: float = 3.6,
    height: float = 2.6,
    depth: float = 3.2,
    *,
    albedo: float | None = None,
    person: bool = True,
    level: int = 3,
) -> SceneDict:
    """A room before `relay_wall(width, height)`: floor, ceiling, three walls, desk, shelf, chair and a person.

    The room fills |x| <= width / 2, |y| <= height / 2 and 0 <= z <= depth. `albedo` None takes those of `COLOURS`.
    `person=False` leaves the room empty of people, as a background to subtract. `level`: fineness of the person's mesh.
    Furniture is placed from the walls and keeps its size: widths and depths below 2.4 m and heights below 2.2 m raise
    UnitError.
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
    """A shelf of five boards between two sides before the back wall, with books on three of them."""
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
