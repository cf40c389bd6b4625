"""``scene.save``: writes a scene with values as an XML file, reads it back and compares."""

from __future__ import annotations

import os
import shutil
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from torchtransient import plugins
from torchtransient.array_files.part_files import writing_said
from torchtransient.checks import check_folder, path_of
from torchtransient.errors import SceneError, ShapeError, TorchTransientError, UnitError
from torchtransient.plugins import kind_of
from torchtransient.plugins.dictionaries import double_transform
from torchtransient.plugins.drjit_pool import threads_for_files
from torchtransient.plugins.mitsuba_compat import (
    DIFFERENTIABLE_PLUGINS,
    POLARIZED_PLUGINS,
    VERTEX_COLUMNS,
    has_normals,
)
from torchtransient.plugins.node_walk import ShownValue, objects_below, objects_of
from torchtransient.plugins.spectral_colours import as_colours, keeps_coefficients, same_spectra
from torchtransient.scene.build import BuiltScene
from torchtransient.scene.description import Plain
from torchtransient.scene.motions import moved_names
from torchtransient.scene.nodes import children, name_children, node_kind, split_merged_shapes
from torchtransient.scene.parameters import read_value
from torchtransient.scene.values import Slot, SlotTable, as_float, fit_shape, flat_drjit_copy
from torchtransient.scene.variant import device_type

# Numbers that went through a file differ by the rounding of single precision.
_RTOL, _ATOL = 1e-5, 1e-6
WAY_OUT = "Leave such keys out of values, or keep the values and the description: pickle.dumps(scene)."


@contextmanager
def replaced_files(path: str | os.PathLike[str]) -> Iterator[tuple[Path, Path, Path]]:
    """Yield the path of an XML file, and drafts of the file and of its folder, which replace both after the block.

    Args:
        path: name of an XML file in an existing folder.

    Raises:
        SceneError, StorageError: for other paths, and files that cannot be written. An error leaves the old files.
    """
    target = path_of(path, "scene.save")
    if target.suffix != ".xml":
        raise SceneError(f"scene.save: expected the name of an XML file, such as scene.xml, got {str(target)!r}.")
    if not target.parent.is_dir():
        raise SceneError(f"scene.save: there is no folder {str(target.parent)!r}; make it first.")
    check_folder(target, "scene.save")
    files = f"{target.stem}_files"
    with writing_said(target, "scene.save"), tempfile.TemporaryDirectory(dir=target.parent) as place:
        draft, folder = Path(place) / target.name, Path(place) / files
        try:
            yield target, draft, folder
        except SceneError as error:
            # The folder of the draft is gone.
            raise SceneError(str(error).replace(f"{place}{os.sep}", "")) from error
        if (target.parent / files).is_dir():
            shutil.rmtree(target.parent / files)
        if folder.is_dir():
            shutil.move(str(folder), str(target.parent / files))
        os.replace(draft, target)


def write_scene(
    description: Plain, variant: str, slots: SlotTable, values: Mapping[str, Any], draft: Path, folder: Path
) -> dict[str, np.ndarray]:
    """Write a scene with values, which are installed in its built scene.

    Args:
        description: description of the scene.
        variant: name of the active variant.
        slots: slots of the values.
        values: values by key.
        draft: path of the XML file.
        folder: path of the folder for arrays and files beside it.

    Returns:
        All numbers of the scene with these values, by key.

    Raises:
        SceneError: for values that XML cannot hold.
        ShapeError, UnitError, DeviceError: for values, as a renderer raises them.
    """
    import mitsuba as mi

    built = slots.built
    try:
        slots.install([_leaf(slot, values[slot.key], variant) for slot in slots.slots])
        with description.resolved_files(), plugins.plugin_errors():
            state = _parsed(description, variant)
            writer = XmlWriter(state, folder)
            places = _places(built.scene, state)
            for slot in slots.slots:
                shape = slot.shape if slot.kind != "mesh_transform" else (4, 4)
                given = values[slot.key]
                given = given.detach().cpu() if isinstance(given, torch.Tensor) else given
                _write_value(writer, built, places, slot, np.asarray(given, dtype=np.float64).reshape(shape))
            for value in objects_below(built.scene, mi.Object):
                place = places.get(value.ptr)
                if place is None or place.names:
                    continue
                writer.note_kind(place.node, value)
                if isinstance(value, mi.Mesh) and state.nodes[place.node].props.plugin_name() == "mesh_arrays":
                    _save_mesh(writer, place.node, value)
            draft.write_text(writer.text(), encoding="utf-8")
        return _numbers(built)
    except (RuntimeError, ValueError, TypeError) as error:
        if isinstance(error, TorchTransientError):
            raise
        raise SceneError(f"scene.save: {description.name} cannot be written: {error}") from error


def check_same(built: BuiltScene, wanted: Mapping[str, np.ndarray]) -> None:
    """Raise ``SceneError`` if a scene that was read back has other numbers than were written.

    Args:
        built: the scene that was read back.
        wanted: numbers by key, as :func:`write_scene` returns them; compared to single precision.
    """
    found = _numbers(built)
    other = sorted(found.keys() ^ wanted.keys())
    params = built.params.properties
    for key, value in wanted.items():
        if key in found and not _same(value, found[key]):
            spectral = keeps_coefficients(params[key][2], key.rsplit(".", 1)[-1])
            if not (spectral and same_spectra(value, found[key])):
                other.append(key)
    if other:
        raise SceneError(
            f"scene.save: {', '.join(other[:5])}{' ...' if len(other) > 5 else ''} cannot be said in XML: what was "
            f"read back is different. {WAY_OUT}"
        )


def _leaf(slot: Any, value: Any, variant: str) -> Any:
    numbers = as_float(slot.key, value, device_type(variant))
    odd = numbers[~numbers.isfinite()]
    if odd.numel():
        share = f" ({odd.numel()} of {numbers.numel()})" if numbers.numel() > 1 else ""
        raise UnitError(f"scene.save: value of {slot.key!r}: expected finite numbers, got {odd[0].item()}{share}.")
    tensor, batched = fit_shape(slot.key, numbers, slot.shape)
    if batched:
        raise ShapeError(f"scene.save: expected shape {slot.shape} for {slot.key!r}, got {tuple(tensor.shape)}.")
    slot.check(tensor)
    return flat_drjit_copy(tensor)


def _parsed(description: Plain, variant: str) -> Any:
    import mitsuba as mi

    config = mi.parser.ParserConfig(variant)
    state = description.parse(config)
    mi.parser.transform_upgrade(config, state)
    mi.parser.transform_resolve(config, state)
    name_children(state)
    split_merged_shapes(state)
    return state


def _numbers(built: BuiltScene) -> dict[str, np.ndarray]:
    found = {}
    for key, (handle, cpptype, node, _) in built.params.properties.items():
        current = ShownValue(key, handle, 0, cpptype).read(node)  # type: ignore[call-arg]
        found[key] = np.array(read_value(current, None) if np.ndim(current) == 0 else current)
    return found


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    if a.shape != b.shape or a.dtype.kind not in "fiub":
        return a.shape == b.shape and bool(np.all(a == b))
    return bool(np.allclose(a, b, rtol=_RTOL, atol=_ATOL * max(1.0, float(np.abs(a).max(initial=0)))))


# ------------------------------------------------------------------------------------- values as properties of nodes

# Properties of three numbers that are no colour.
_VECTORS = ("position", "direction", "sensor_origin", "laser_origin", "sun_direction", "target")
# Properties that a mesh file holds itself.
_IN_MESH_FILE = ("filename", "to_world", "vertices", "faces", "normals", "texcoords", "shape_index")
# Properties that another one replaces: files, names of glasses and metals, other forms of an angle.
_REPLACES = {
    "data": ("filename", "bitmap", "grid"),
    "bitmap": ("filename", "data"),
    "fov": ("focal_length",),
    "to_world": ("center", "radius", "p0", "p1", "direction"),
    "eta": ("material",),
    "k": ("material",),
}
# Plugins that show the ratio of two indices as `eta`.
_GLASSES = ("dielectric", "thindielectric", "roughdielectric", "plastic", "roughplastic", "pplastic", "hair")
_TWINS = {**DIFFERENTIABLE_PLUGINS, **POLARIZED_PLUGINS}
_RATIOS = (*_GLASSES, *(_TWINS[plugin] for plugin in _GLASSES if plugin in _TWINS))
# Lists of numbers in a text.
_TEXTS = ("values", "wavelengths")
# Numbers that Mitsuba derives from another one where they are not described.
_DERIVED = {("spot", "cutoff_angle"): ("beam_width",)}


class _Place(NamedTuple):
    """Place of a built object in the description.

    Attributes:
        node: index of the node that the object was made of, or of one above it.
        names: names that lead from the object of that node to this one, which Mitsuba has made of a number, a colour
            or a default; empty for an object with a node.
        made: the first object on that way.
    """

    node: int
    names: tuple[str, ...] = ()
    made: Any = None


def _places(scene: Any, state: Any) -> dict[int, _Place]:
    """Return the places of the objects of a built scene in the list of nodes, by address."""
    found: dict[int, _Place] = {}
    waiting = [(scene, _Place(0))]
    while waiting:
        value, place = waiting.pop()
        for inner, its in _places_in(value, place, state):
            if inner.ptr not in found:
                found[inner.ptr] = its
                waiting.append((inner, its))
    return found


def _places_in(value: Any, place: _Place, state: Any) -> list[tuple[Any, _Place]]:
    """Return the objects inside an object with their places."""
    index = place.node
    if place.names:
        return [(inner, place._replace(names=(*place.names, name))) for name, inner in objects_of(value)]
    held = children(state, state.nodes[index])
    free = dict.fromkeys(child for _, child in held)
    found, unmatched = [], []
    for name, inner in objects_of(value):
        wanted = name if index else inner.id()
        match = next((c for key, c in held if (key if index else state.nodes[c].props.id()) == wanted), None)
        if match is None:
            unmatched.append((name, inner))
        else:
            free.pop(match, None)
            found.append((inner, _Place(match)))
    for name, inner in unmatched:
        match = next((c for c in free if _may_be(inner, state.nodes[c])), None)
        if name in state.nodes[index].props or match is None:
            found.append((inner, _Place(index, (name,), inner)))
        else:
            free.pop(match)
            found.append((inner, _Place(match)))
    return found


def _may_be(value: Any, node: Any) -> bool:
    """Return whether an object may have been made of a node."""
    import mitsuba as mi

    kind = getattr(mi, node_kind(node), None)
    return kind is not None and isinstance(value, kind)


def _write_value(writer: XmlWriter, built: Any, places: dict[int, _Place], slot: Slot, value: np.ndarray) -> None:
    """Write an installed value into its node. Raises ``SceneError`` for a node without a property for it."""
    import mitsuba as mi

    state = writer.state
    target = slot.targets[0]
    owner, name = built.params.properties[target][2], target.rsplit(".", 1)[-1]
    place = places.get(owner.ptr)
    if place is None:
        raise SceneError(f"scene.save: {slot.key!r} has no place in the description, and cannot be said in XML.")
    if name == "value" and keeps_coefficients(owner, name):
        if not owner.class_name().startswith("SRGBReflectance"):
            raise SceneError(
                f"scene.save: {slot.key!r} cannot be said in XML: in {mi.variant()} its numbers are those of a "
                "spectral model of light. Leave it out of values, or keep the values themselves."
            )
        value = as_colours(value, slot.key)
    index = place.node
    props = state.nodes[index].props
    if slot.kind == "mesh_transform" and props.plugin_name() != "mesh_arrays":
        props["to_world"] = double_transform()(value.astype(np.float64))
    elif slot.kind == "mesh_transform" or (isinstance(owner, mi.Mesh) and name in VERTEX_COLUMNS):
        _save_mesh(writer, index, owner)
    elif slot.kind == "transform":
        matrix = value.astype(np.float64)
        props[name] = double_transform()(matrix) if len(matrix) == 4 else mi.ScalarTransform3f(matrix)
        _drop_replaced(props, name)
    elif slot.kind == "tensor" and not place.names:
        name, value = _array_property(owner, name, value)
        props[name] = mi.TensorXf(np.ascontiguousarray(value, dtype=np.float32))
        _drop_replaced(props, name)
    elif place.names:
        is_metal = "material" in props and place.names in (("eta",), ("k",))
        _write_made(state, place, owner, value, slot.key)
        if is_metal:
            # The name of the metal gave both.
            (other,) = {"eta", "k"} - set(place.names)
            there = f"{slot.key.removesuffix(f'{place.names[0]}.{name}')}{other}.{name}"
            _write_numbers(props, other, np.array(built.params[there]), slot.key)
    else:
        for other in _DERIVED.get((props.plugin_name(), name), ()):
            if other not in props:
                props[other] = float(np.ravel(built.params[f"{target.rpartition('.')[0]}.{other}"])[0])
        _write_numbers(props, *_number_property(props, name, value), slot.key)


def _array_property(owner: Any, name: str, value: np.ndarray) -> tuple[str, np.ndarray]:
    """Return the property and the numbers of an array.

    Maps of surroundings repeat a column at either end, which files do not have.
    """
    return ("bitmap", value[:, 1:-1]) if owner.class_name() == "EnvironmentMapEmitter" else (name, value)


def _number_property(props: Any, name: str, value: np.ndarray) -> tuple[str, np.ndarray]:
    """Return the property of a number, and set the properties that it depends on."""
    plugin = props.plugin_name()
    if name == "eta" and plugin in _RATIOS:
        # The ratio alone counts, and what it was made of may have been names of glasses.
        props["ext_ior"] = 1.0
        return "int_ior", value
    if name == "x_fov":
        props["fov_axis"] = "x"
        return "fov", value
    return ("scale", value) if plugin == "d65" and name == "value" else (name, value)


def _write_made(state: Any, place: _Place, owner: Any, value: np.ndarray, key: str) -> None:
    """Write a value of an object that Mitsuba has made of a number or of a default."""
    import mitsuba as mi

    node, (first, *rest) = state.nodes[place.node], place.names
    is_emitter = node_kind(node) == "Emitter" or kind_of(node.props.plugin_name()) == "emitter"
    surface = isinstance(place.made, mi.BSDF) and place.made.class_name() == "SmoothDiffuse" and len(rest) == 1
    if surface:
        _write_numbers(_child(state, place.node, first, "diffuse", mi.ObjectType.BSDF), rest[0], value, key)
    elif not rest and first not in node.props and isinstance(owner, mi.Texture) and is_emitter:
        # Light that is not described is that of daylight.
        _write_numbers(_child(state, place.node, first, "d65", mi.ObjectType.Texture), "scale", value, key)
    elif not rest or (isinstance(place.made, mi.Volume) and len(rest) == 1):
        _write_numbers(node.props, first, value, key)
    else:
        raise SceneError(f"scene.save: {key!r} has no place in the description, and cannot be said in XML.")


def _child(state: Any, index: int, name: str, plugin: str, kind: Any) -> Any:
    """Return the properties of a child, which is added where there is none."""
    import mitsuba as mi

    there = dict(children(state, state.nodes[index])).get(name)
    if there is None:
        node = mi.parser.SceneNode()
        node.type = kind
        node.props = mi.Properties(plugin)
        state.nodes.append(node)
        there = len(state.nodes) - 1
        state.nodes[index].props[name] = mi.Properties.ResolvedReference(there)
    return state.nodes[there].props


def _drop_replaced(props: Any, name: str) -> None:
    for other in _REPLACES.get(name, ()):
        if other in props:
            del props[other]


def _write_numbers(props: Any, name: str, value: np.ndarray, key: str) -> None:
    import mitsuba as mi

    numbers, types = np.ravel(value).astype(np.float64), mi.Properties.Type
    kind = props.type(name) if name in props else None
    if kind == types.String and name in _TEXTS:
        props[name] = ", ".join(f"{number:.9g}" for number in numbers)
    elif numbers.size == 1:
        props[name] = float(numbers[0])
    elif numbers.size == 3 and kind == types.Vector:
        props[name] = numbers.tolist()
    elif numbers.size == 3 and kind in (types.Color, types.Float, types.Spectrum, None):
        props[name] = numbers.tolist() if name in _VECTORS else mi.ScalarColor3f(*numbers.tolist())
    elif name in ("points", "laser_points"):
        props[name] = mi.TensorXf(np.ascontiguousarray(value, dtype=np.float32).reshape(1, -1, 3))
    else:
        raise SceneError(
            f"scene.save: a value of shape {np.shape(value)} for {key!r} cannot be said in XML: the description has no "
            f"property {name!r} of that kind. Leave the key out of values, or keep the values themselves."
        )
    _drop_replaced(props, name)


def _save_mesh(writer: XmlWriter, index: int, mesh: Any) -> None:
    """Turn the node of a mesh into one that reads a file, and write that."""
    import mitsuba as mi

    node = writer.state.nodes[index]
    old = node.props
    path = writer.file(old.id() or old.plugin_name(), ".ply")
    mesh.write_ply(str(path))
    new = mi.Properties("ply")
    new.set_id(old.id())
    new["filename"] = str(path)
    new["face_normals"] = not has_normals(mesh)
    for key in list(old.keys()):
        if key not in (*_IN_MESH_FILE, "face_normals"):
            new[key] = old[key]
    node.props = new


# ----------------------------------------------------------------------------------------------------- nodes as XML

# Mitsuba's kinds, as its classes are called.
_KINDS = (
    "BSDF", "Shape", "Emitter", "Sensor", "Film", "Sampler", "Integrator", "Texture", "Volume", "Medium",
    "PhaseFunction", "ReconstructionFilter",
)  # fmt: skip
# Tags of Mitsuba's kinds that are not the kind in small letters.
_TAGS = {"PhaseFunction": "phase", "ReconstructionFilter": "rfilter"}
# Plugins whose array becomes the file that they can read instead.
_GRIDS = {"gridvolume": ("grid", "data"), "sdfgrid": ("grid",)}
_BITMAPS = {"bitmap": ("bitmap", "data"), "envmap": ("bitmap",)}
# Points in a text.
_POINTS = {"nlos_capture_meter": ("points", "laser_points")}


class XmlWriter:
    """Writer of parsed nodes as XML, with arrays and files of the scene in ``folder`` beside it.

    Mitsuba's own writer (``mi.parser.write_file``) drops the names of most nodes, and with them the keys of parameters,
    and decomposes transforms with errors of 1e-6.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
        folder: folder of the files.
    """

    def __init__(self, state: Any, folder: Path) -> None:
        self.state, self.folder = state, folder
        self._direct = {index for _, index in children(state, state.root)}
        self._names = [node.props.id() for node in state.nodes]
        self._moving = moved_names(state)
        self._written: dict[int, ElementTree.Element] = {}
        self._kinds: dict[int, str] = {}
        self._count = 0

    def note_kind(self, index: int, built: Any) -> None:
        """Note the kind of a node by its built object: the parser does not know that of plugins in Python.

        Args:
            index: index of the node.
            built: the object that was built of it.
        """
        import mitsuba as mi

        kinds = (kind for kind in _KINDS if isinstance(built, getattr(mi, kind)))
        self._kinds[index] = next(kinds, "Unknown")

    def text(self) -> str:
        """Return the scene as XML."""
        import mitsuba as mi

        root = ElementTree.Element("scene", version=mi.__version__)
        self._properties(root, 0)
        ElementTree.indent(root, "    ")
        return ElementTree.tostring(root, encoding="unicode") + "\n"

    def file(self, name: str, ending: str) -> Path:
        """Return the path of a new file in the folder.

        Args:
            name: name of the file; other characters than letters, digits, "-" and "_" are replaced.
            ending: ending with its dot.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        safe = "".join(c if c.isalnum() or c in "-_" else "_" for c in name) or "data"
        path = self.folder / f"{safe}{ending}"
        while path.exists():
            self._count += 1
            path = self.folder / f"{safe}_{self._count}{ending}"
        return path

    def name_of(self, path: Path) -> str:
        """Return the name of a file in the folder, as the scene refers to it.

        Args:
            path: path of the file.
        """
        return f"{self.folder.name}/{path.name}"

    # ------------------------------------------------------------------------------------------------------- nodes

    def _properties(self, element: ElementTree.Element, index: int) -> None:
        import mitsuba as mi

        props = self.state.nodes[index].props
        plugin = props.plugin_name()
        for key in list(props.keys()):
            value, where = props[key], f"{props.id() or plugin}.{key}"
            if isinstance(value, mi.Properties.ResolvedReference):
                self._child(element, "" if index == 0 else key, value.index(), direct=index == 0)
            elif plugin in _GRIDS and key in _GRIDS[plugin]:
                _add(element, "string", "filename", self._grid(value, where))
            elif plugin in _BITMAPS and key in _BITMAPS[plugin]:
                _add(element, "string", "filename", self._bitmap(value, where, bool(props.get("raw", False))))
            elif plugin in _POINTS and key in _POINTS[plugin] and not isinstance(value, str):
                numbers = np.asarray(value, dtype=np.float32).ravel()
                _add(element, "string", key, ", ".join(f"{number:.9g}" for number in numbers))
            else:
                self._value(element, key, props.type(key), value, where)

    def _child(self, parent: ElementTree.Element, name: str, index: int, direct: bool) -> None:
        node = self.state.nodes[index]
        label = "" if name.startswith("_arg") else name
        if index in self._written or (index in self._direct and not direct):
            reference = node.props.id()
            if index not in self._direct:
                reference = self._written[index].get("id") or f"node_{index}"
                self._written[index].set("id", reference)
            _named(ElementTree.SubElement(parent, "ref", id=reference), label)
            return
        plugin, kind = node.props.plugin_name(), str(node.type).rsplit(".", 1)[-1]
        kind = self._kinds.get(index, kind) if kind == "Unknown" else kind
        tag = plugins.kind_of(plugin) or _TAGS.get(kind, kind.lower())
        if tag == "unknown":
            raise SceneError(f"scene.save: the kind of plugin {plugin!r} is not known, so that XML has no tag for it.")
        element = ElementTree.SubElement(parent, tag, type=plugin)
        _named(element, label)
        # Keys of shapes in groups and of sensors in batches have their names too, and motions name what moves.
        named = direct or (kind in ("Shape", "Sensor") and self._names.count(node.props.id()) == 1)
        named |= node.props.id() in self._moving
        if named and node.props.id():
            element.set("id", node.props.id())
        self._written[index] = element
        self._properties(element, index)

    # ------------------------------------------------------------------------------------------------------ values

    def _value(self, element: ElementTree.Element, key: str, kind: Any, value: Any, where: str) -> None:
        import mitsuba as mi

        types = mi.Properties.Type
        if kind == types.Bool:
            _add(element, "boolean", key, "true" if value else "false")
        elif kind == types.Integer:
            _add(element, "integer", key, str(int(value)))
        elif kind == types.Float:
            _add(element, "float", key, repr(float(value)))
        elif kind == types.String:
            _add(element, "string", key, self._text(key, str(value), where))
        elif kind == types.Vector:
            _add(element, "vector", key, _row(value))
        elif kind == types.Color:
            _add(element, "rgb", key, _row(value))
        elif kind == types.Spectrum:
            pairs = [f"{w!r}:{v!r}" for w, v in zip(value.wavelengths, value.values, strict=False)]
            _add(element, "spectrum", key, ", ".join(pairs) if pairs else repr(value.values[0]))
        elif kind == types.Transform:
            matrix = np.array(value.matrix, dtype=np.float64)
            inner = ElementTree.SubElement(element, "transform", name=key)
            ElementTree.SubElement(inner, "matrix", value=_row(matrix.ravel()))
        else:
            raise SceneError(
                f"scene.save: the {type(value).__name__} at {where} cannot be said in XML, and its plugin reads no "
                "file in its place. Keep the description itself: pickle.dumps(scene)."
            )

    def _text(self, key: str, value: str, where: str) -> str:
        """Return a text; files that it names are copied into the folder."""
        import mitsuba as mi

        if "$" in value:
            raise SceneError(f"scene.save: the text {value!r} at {where} has a '$', which XML takes for a parameter.")
        found = Path(str(mi.file_resolver().resolve(value))) if "file" in key else None
        if found is None or not found.is_file():
            return value
        if found.parent == self.folder:
            return self.name_of(found)  # written for this scene
        copy = self.file(found.stem, found.suffix)
        shutil.copyfile(found, copy)
        return self.name_of(copy)

    def _grid(self, value: Any, where: str) -> str:
        import mitsuba as mi

        path = self.file(where, ".vol")
        grid = value if isinstance(value, mi.VolumeGrid) else mi.VolumeGrid(np.array(value, dtype=np.float32))
        grid.write(str(path))
        return self.name_of(path)

    def _bitmap(self, value: Any, where: str, raw: bool) -> str:
        import mitsuba as mi

        bitmap = value
        if not isinstance(value, mi.Bitmap):
            numbers = np.array(value, dtype=np.float32)
            if mi.is_spectral and not raw and numbers.shape[-1] == 3:
                # Arrays hold coefficients of spectra there, and files hold colours.
                numbers = as_colours(numbers, where).astype(np.float32)
            bitmap = mi.Bitmap(np.ascontiguousarray(numbers))
        small = "8" in str(bitmap.component_format()) and (raw or bitmap.srgb_gamma())
        path = self.file(where, ".png" if small else ".exr")
        with threads_for_files():
            if not small:
                half = "16" in str(bitmap.component_format()) and "float" in str(bitmap.component_format()).lower()
                kind = mi.Struct.Type.Float16 if half else mi.Struct.Type.Float32
                bitmap = bitmap.convert(component_format=kind, srgb_gamma=False)
            bitmap.write(str(path))
        return self.name_of(path)


def _named(element: ElementTree.Element, name: str) -> None:
    if name:
        element.set("name", name)


def _add(element: ElementTree.Element, tag: str, name: str, value: str) -> None:
    ElementTree.SubElement(element, tag, name=name, value=value)


def _row(values: Any) -> str:
    return ", ".join(repr(float(value)) for value in np.asarray(values, dtype=np.float64).ravel())
