"""Values of parameters as properties of the nodes that a scene is parsed into."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from torchtransient.errors import SceneError
from torchtransient.plugins import kind_of
from torchtransient.plugins.dictionaries import double_transform
from torchtransient.plugins.mitsuba_compat import DIFFERENTIABLE_PLUGINS, POLARIZED_PLUGINS, VERTEX_COLUMNS
from torchtransient.plugins.node_walk import objects_of
from torchtransient.plugins.spectral_colours import as_colours, keeps_coefficients
from torchtransient.rendering.nodes import children, kind_of_node

if TYPE_CHECKING:
    from torchtransient.rendering.parameters import Slot
    from torchtransient.rendering.saving.xml_nodes import XmlWriter

# Properties of three numbers that are no colour.
_VECTORS = ("position", "direction", "sensor_origin", "laser_origin", "sun_direction", "target")
# What a mesh file says itself.
_SAID_BY_FILE = ("filename", "to_world", "vertices", "faces", "normals", "texcoords", "shape_index")
# What a property takes the place of: files, names of glasses and metals, other ways to say an angle.
_STANDS_FOR = {
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
# Numbers that Mitsuba makes of another one where they are not described.
_MADE_OF = {("spot", "cutoff_angle"): ("beam_width",)}


class Place(NamedTuple):
    """Where an object of a built scene is described: a node, and where Mitsuba has made it of a number, of a colour or
    of nothing, the names that lead to it from there, and the first object on that way.
    """

    node: int
    names: tuple[str, ...] = ()
    made: Any = None


def places_of(scene: Any, state: Any) -> dict[int, Place]:
    """The places of the objects of a built scene in the list of nodes, by address."""
    found: dict[int, Place] = {}
    waiting = [(scene, Place(0))]
    while waiting:
        value, place = waiting.pop()
        for inner, its in _places_in(value, place, state):
            if inner.ptr not in found:
                found[inner.ptr] = its
                waiting.append((inner, its))
    return found


def _places_in(value: Any, place: Place, state: Any) -> list[tuple[Any, Place]]:
    """The places of what an object holds."""
    index = place.node
    if place.names:
        return [(inner, place._replace(names=(*place.names, name))) for name, inner in objects_of(value)]
    held = children(state, state.nodes[index])
    free = dict.fromkeys(child for _, child in held)
    found, unmatched = [], []
    for name, inner in objects_of(value):
        said = name if index else inner.id()
        match = next((c for key, c in held if (key if index else state.nodes[c].props.id()) == said), None)
        if match is None:
            unmatched.append((name, inner))
        else:
            free.pop(match, None)
            found.append((inner, Place(match)))
    for name, inner in unmatched:
        match = next((c for c in free if _is_of_kind(inner, state.nodes[c])), None)
        if name in state.nodes[index].props or match is None:
            found.append((inner, Place(index, (name,), inner)))
        else:
            free.pop(match)
            found.append((inner, Place(match)))
    return found


def _is_of_kind(value: Any, node: Any) -> bool:
    """Whether a node may be what an object was made of."""
    import mitsuba as mi

    kind = getattr(mi, kind_of_node(node), None)
    return kind is not None and isinstance(value, kind)


def write_value(writer: XmlWriter, built: Any, places: dict[int, Place], slot: Slot, value: np.ndarray) -> None:
    """Put a value, which is installed in the built scene, into its node. Raises ``SceneError`` where that has no
    property for it.
    """
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
        mesh_as_file(writer, index, owner)
    elif slot.kind == "transform":
        matrix = value.astype(np.float64)
        props[name] = double_transform()(matrix) if len(matrix) == 4 else mi.ScalarTransform3f(matrix)
        _leave_only(props, name)
    elif slot.kind == "tensor" and not place.names:
        name, value = _array_of(owner, name, value)
        props[name] = mi.TensorXf(np.ascontiguousarray(value, dtype=np.float32))
        _leave_only(props, name)
    elif place.names:
        of_metal = "material" in props and place.names in (("eta",), ("k",))
        _put_into_made(state, place, owner, value, slot.key)
        if of_metal:
            # Its name stood for both.
            (other,) = {"eta", "k"} - set(place.names)
            there = f"{slot.key.removesuffix(f'{place.names[0]}.{name}')}{other}.{name}"
            _put_numbers(props, other, np.array(built.params[there]), slot.key)
    else:
        for other in _MADE_OF.get((props.plugin_name(), name), ()):
            if other not in props:
                props[other] = float(np.ravel(built.params[f"{target.rpartition('.')[0]}.{other}"])[0])
        _put_numbers(props, *_property_of(props, name, value), slot.key)


def _array_of(owner: Any, name: str, value: np.ndarray) -> tuple[str, np.ndarray]:
    """The property of a plugin that its array is read from. Maps of surroundings repeat a column at either end, which
    files do not have.
    """
    return ("bitmap", value[:, 1:-1]) if owner.class_name() == "EnvironmentMapEmitter" else (name, value)


def _property_of(props: Any, name: str, value: np.ndarray) -> tuple[str, np.ndarray]:
    """The property that a number of a plugin is said by, and what else that fixes."""
    plugin = props.plugin_name()
    if name == "eta" and plugin in _RATIOS:
        # The ratio alone counts, and what it was made of may have been names of glasses.
        props["ext_ior"] = 1.0
        return "int_ior", value
    if name == "x_fov":
        props["fov_axis"] = "x"
        return "fov", value
    return ("scale", value) if plugin == "d65" and name == "value" else (name, value)


def _put_into_made(state: Any, place: Place, owner: Any, value: np.ndarray, key: str) -> None:
    """Into what Mitsuba makes of a number or of nothing."""
    import mitsuba as mi

    node, (first, *rest) = state.nodes[place.node], place.names
    surface = isinstance(place.made, mi.BSDF) and place.made.class_name() == "SmoothDiffuse" and len(rest) == 1
    if surface:
        _put_numbers(_child_of(state, place.node, first, "diffuse", mi.ObjectType.BSDF), rest[0], value, key)
    elif not rest and first not in node.props and isinstance(owner, mi.Texture) and _is_emitter(node):
        # Light that is not described is that of daylight.
        _put_numbers(_child_of(state, place.node, first, "d65", mi.ObjectType.Texture), "scale", value, key)
    elif not rest or (isinstance(place.made, mi.Volume) and len(rest) == 1):
        _put_numbers(node.props, first, value, key)
    else:
        raise SceneError(f"scene.save: {key!r} has no place in the description, and cannot be said in XML.")


def _is_emitter(node: Any) -> bool:
    return kind_of_node(node) == "Emitter" or kind_of(node.props.plugin_name()) == "emitter"


def _child_of(state: Any, index: int, name: str, plugin: str, kind: Any) -> Any:
    """The properties of a child, which is made where there is none."""
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


def _leave_only(props: Any, name: str) -> None:
    for other in _STANDS_FOR.get(name, ()):
        if other in props:
            del props[other]


def _put_numbers(props: Any, name: str, value: np.ndarray, key: str) -> None:
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
    _leave_only(props, name)


def mesh_as_file(writer: XmlWriter, index: int, mesh: Any) -> None:
    """Make a mesh's node one that reads a file, which is written from the mesh as it is now."""
    import mitsuba as mi

    node = writer.state.nodes[index]
    old = node.props
    path = writer.file(old.id() or old.plugin_name(), ".ply")
    mesh.write_ply(str(path))
    new = mi.Properties("ply")
    new.set_id(old.id())
    new["filename"] = str(path)
    new["face_normals"] = not mesh.has_vertex_normals()
    for key in list(old.keys()):
        if key not in (*_SAID_BY_FILE, "face_normals"):
            new[key] = old[key]
    node.props = new
