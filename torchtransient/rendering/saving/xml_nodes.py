"""Mitsuba's parsed list of nodes as XML, with what XML has no words for in files beside it.

Mitsuba's own writer (``mi.parser.write_file``) drops the names of most nodes, and with them the keys of parameters, and
takes transforms apart with errors of 1e-6; so numbers are written here as they are, transforms as matrices.
"""

from __future__ import annotations

import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np

from torchtransient import plugins
from torchtransient.errors import SceneError
from torchtransient.plugins.drjit_pool import threads_for_files
from torchtransient.plugins.spectral_colours import as_colours
from torchtransient.rendering.nodes import children

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
    """Writes the nodes of ``state`` with files into ``folder``, which the XML calls by the name of the folder."""

    def __init__(self, state: Any, folder: Path) -> None:
        self.state, self.folder = state, folder
        self._direct = {index for _, index in children(state, state.root)}
        self._names = [node.props.id() for node in state.nodes]
        self._written: dict[int, ElementTree.Element] = {}
        self._kinds: dict[int, str] = {}
        self._count = 0

    def note_kind(self, index: int, built: Any) -> None:
        """Tell the kind of a node by the object that was built of it: the parser knows that of no plugin in Python."""
        import mitsuba as mi

        kinds = (kind for kind in _KINDS if isinstance(built, getattr(mi, kind)))
        self._kinds[index] = next(kinds, "Unknown")

    def text(self) -> str:
        """The scene as XML."""
        import mitsuba as mi

        root = ElementTree.Element("scene", version=mi.__version__)
        self._properties(root, 0)
        ElementTree.indent(root, "    ")
        return ElementTree.tostring(root, encoding="unicode") + "\n"

    def file(self, name: str, ending: str) -> Path:
        """A new file beside the scene, called after what is in it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        safe = "".join(c if c.isalnum() or c in "-_" else "_" for c in name) or "data"
        path = self.folder / f"{safe}{ending}"
        while path.exists():
            self._count += 1
            path = self.folder / f"{safe}_{self._count}{ending}"
        return path

    def name_of(self, path: Path) -> str:
        """What the scene calls a file beside it."""
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
        said = "" if name.startswith("_arg") else name
        if index in self._written or (index in self._direct and not direct):
            reference = node.props.id()
            if index not in self._direct:
                reference = self._written[index].get("id") or f"node_{index}"
                self._written[index].set("id", reference)
            _named(ElementTree.SubElement(parent, "ref", id=reference), said)
            return
        plugin, kind = node.props.plugin_name(), str(node.type).rsplit(".", 1)[-1]
        kind = self._kinds.get(index, kind) if kind == "Unknown" else kind
        tag = plugins.kind_of(plugin) or _TAGS.get(kind, kind.lower())
        if tag == "unknown":
            raise SceneError(f"scene.save: the kind of plugin {plugin!r} is not known, so that XML has no tag for it.")
        element = ElementTree.SubElement(parent, tag, type=plugin)
        _named(element, said)
        # Parameters of shapes in groups and of sensors in batches are called after them, too.
        named = direct or (kind in ("Shape", "Sensor") and self._names.count(node.props.id()) == 1)
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
        """A text; files that it names come along."""
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
