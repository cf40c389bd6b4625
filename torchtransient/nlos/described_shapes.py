"""Hidden shapes of a YAML description as Mitsuba dictionaries."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchtransient import scenes
from torchtransient.checks import shown
from torchtransient.errors import SceneError, TorchTransientError
from torchtransient.files.yaml_files import Section, file_beside
from torchtransient.nlos.mesh_file import mesh_arrays_shape, mesh_file
from torchtransient.scenes.parts import diffuse
from torchtransient.scenes.transforms import Matrix, rotate, scale, translate

# Functions of `tt.scenes` that return hidden shapes.
SCENES: dict[str, Callable[..., dict[str, Any]]] = {
    name: getattr(scenes, name)
    for name in ("nlos_z", "nlos_letter", "nlos_plates", "nlos_corner", "nlos_mannequin", "nlos_room")
}
SHAPES = ("rectangle", "disk", "cube", "sphere")
_KINDS = ("scene", "file", "shape", "vertices")
_PLACEMENT = ("scale", "rotate", "translate", "to_world")
_SURFACE = ("albedo", "bsdf", "flip_normals")


def described_shapes(data: Any, folder: Path) -> dict[str, Any]:
    """The entry `hidden` of a description: things by name, each with one of

    - `scene`: a function of `tt.scenes` (`nlos_letter`, ...) and its arguments; its shapes are called after both;
    - `file`: a mesh (:func:`.mesh_file.mesh_file`);
    - `shape`: rectangle, disk, cube or sphere, as Mitsuba defines them;
    - `vertices` and `faces`: lists of rows;

    and, but for scenes, `albedo` (a number or a list of three, 0.5) or `bsdf` (a dictionary of Mitsuba), `flip_normals`
    and a place: `scale` (a number or three), then `rotate` ([[x, y, z], degrees], or a list of those, the first one
    first), then `translate`; or `to_world`, a matrix of 4 x 4. Raises SceneError, StorageError for mesh files, and the
    errors of scenes and albedos.
    """
    if not isinstance(data, Mapping) or not data:
        raise SceneError(
            f"hidden: expected things by name, 'letter: {{scene: nlos_letter}}' for instance, got {shown(data)}."
        )
    shapes: dict[str, Any] = {}
    for name, entry in data.items():
        where = f"hidden: {name}"
        given = [kind for kind in _KINDS if isinstance(entry, Mapping) and kind in entry]
        if not isinstance(name, str) or not name or "." in name or len(given) != 1:
            raise SceneError(
                f"{where}: expected a name without dots, and one of {', '.join(_KINDS)}, got {given or shown(entry)}."
            )
        if given == ["scene"]:
            shapes.update(_scene(name, entry, where))
        else:
            shapes[name] = _shape(entry, given[0], where, folder)
    return shapes


def _scene(name: str, entry: Mapping[str, Any], where: str) -> dict[str, Any]:
    chosen = Section(entry, where, entry).choice("scene", tuple(SCENES))
    function = SCENES[chosen]
    known = ("scene", *inspect.signature(function).parameters)
    arguments = dict(Section(entry, f"{where}: {chosen}", known).data)
    del arguments["scene"]
    if isinstance(arguments.get("albedo"), list):
        arguments["albedo"] = tuple(arguments["albedo"])
    try:
        made = function(**arguments)
    except TorchTransientError as error:
        raise type(error)(f"{where}: {error}") from error
    # A scene of one shape is called as it is here; parts of larger ones say which.
    return {name if len(made) == 1 else f"{name}_{part}": shape for part, shape in made.items()}


def _shape(entry: Mapping[str, Any], kind: str, where: str, folder: Path) -> dict[str, Any]:
    own = ("vertices", "faces") if kind == "vertices" else (kind,)
    section = Section(entry, where, (*own, *_SURFACE, *_PLACEMENT))
    if kind == "shape":
        shape: dict[str, Any] = {"type": section.choice("shape", SHAPES)}
    elif kind == "vertices":
        shape = mesh_arrays_shape(section.get("vertices"), section.get("faces"), where)
    else:
        shape = mesh_file(file_beside(section.text("file"), (folder,), where), where)
    place = _place(section)
    if place is not None:
        shape["to_world"] = place
    if section.flag("flip_normals", False):
        shape["flip_normals"] = True
    if "bsdf" in section and "albedo" in section:
        raise SceneError(f"{where}: albedo and bsdf exclude each other; give one.")
    shape["bsdf"] = _bsdf(section) if "bsdf" in section else diffuse(albedo_of(section))
    return shape


def _bsdf(section: Section) -> dict[str, Any]:
    given = section.get("bsdf")
    if not isinstance(given, Mapping) or not isinstance(given.get("type"), str):
        raise SceneError(
            f"{section.where}: bsdf: expected a dictionary of Mitsuba, {{type: conductor}} for instance, got "
            f"{shown(given)}."
        )
    return dict(given)


def albedo_of(section: Section, default: float = 0.5) -> Any:
    """The entry `albedo`: a number, or three as a tuple."""
    if isinstance(section.get("albedo", default), list):
        return tuple(section.numbers("albedo", (3,)))
    return section.number("albedo", default)


def _place(section: Section) -> Matrix | None:
    if "to_world" in section:
        if any(name in section for name in ("scale", "rotate", "translate")):
            raise SceneError(f"{section.where}: to_world excludes scale, rotate and translate.")
        rows = section.get("to_world")
        if not isinstance(rows, list) or len(rows) != 4:
            raise SceneError(f"{section.where}: to_world: expected four rows of four numbers, got {shown(rows)}.")
        return np.array([Section({"row": row}, section.where, ("row",)).numbers("row", (4,)) for row in rows])
    matrix = None
    if "scale" in section:
        size = section.get("scale")
        matrix = scale(section.numbers("scale", (3,)) if isinstance(size, list) else section.number("scale"))
    for turn in _turns(section):
        matrix = turn if matrix is None else turn @ matrix
    if "translate" in section:
        moved = translate(section.numbers("translate", (3,)))
        matrix = moved if matrix is None else moved @ matrix
    return matrix


def _turns(section: Section) -> list[Matrix]:
    given = section.get("rotate", [])
    pairs = [given] if _is_pair(given) else given
    if not isinstance(pairs, list) or not all(map(_is_pair, pairs)):
        raise SceneError(
            f"{section.where}: rotate: expected [[x, y, z], degrees], [[0, 1, 0], 30] for instance, or a list of "
            f"those, got {shown(given)}."
        )
    turns = []
    for pair in pairs:
        part = Section({"axis": pair[0], "degrees": pair[1]}, f"{section.where}: rotate", ("axis", "degrees"))
        turns.append(rotate(part.numbers("axis", (3,)), part.number("degrees")))
    return turns


def _is_pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and isinstance(value[0], list) and not isinstance(value[1], list)
