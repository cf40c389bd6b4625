"""What a node of a scene is as XML, and how values of parameters come into it, one by one."""

import xml.etree.ElementTree as ElementTree
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from torchtransient.errors import SceneError
from torchtransient.plugins.drjit_pool import threads_for_files
from torchtransient.rendering.saving import values
from torchtransient.rendering.saving.save import _same
from torchtransient.rendering.saving.xml_nodes import XmlWriter

VARIANT = "llvm_ad_rgb"


def node(plugin, kind, **properties):
    found = mi.parser.SceneNode()
    found.type, found.props = kind, mi.Properties(plugin)
    for key, value in properties.items():
        found.props[key] = value
    return found


def written(folder, *nodes):
    """The root of the XML of nodes that stand in a scene."""
    scene = node("scene", mi.ObjectType.Scene)
    for n in range(len(nodes)):
        scene.props[f"object_{n}"] = mi.Properties.ResolvedReference(n + 1)
    state = SimpleNamespace(nodes=[scene, *nodes], root=scene, id_to_index={})
    return ElementTree.fromstring(XmlWriter(state, folder).text())


def said(folder, plugin="sphere", kind=None, **properties):
    """(tag, name, value) of what a node with these properties says."""
    (element,) = written(folder, node(plugin, kind or mi.ObjectType.Shape, **properties))
    return [(child.tag, child.get("name"), child.get("value")) for child in element]


def test_numbers_and_words_as_xml(tmp_path):
    folder = tmp_path / "files"
    assert said(folder, on=True, off=False) == [("boolean", "on", "true"), ("boolean", "off", "false")]
    assert said(folder, n=-3, x=0.1) == [("integer", "n", "-3"), ("float", "x", "0.1")]
    assert said(folder, text="some text") == [("string", "text", "some text")]
    assert said(folder, v=[0.25, -2.0, 3.0]) == [("vector", "v", "0.25, -2.0, 3.0")]
    assert said(folder, c=mi.ScalarColor3f(0.25, 0.5, 0.75)) == [("rgb", "c", "0.25, 0.5, 0.75")]
    with pytest.raises(SceneError, match=r"the text 'a\$b' at sphere\.text has a '\$'"):
        said(folder, text="a$b")
    with pytest.raises(SceneError, match=r"the TensorXf at sphere\.t cannot be said in XML"):
        said(folder, t=mi.TensorXf(np.zeros((2, 3), np.float32)))
    assert not folder.exists()


def test_transforms_as_rows_of_numbers(tmp_path):
    matrix = np.arange(1.0, 17.0).reshape(4, 4)
    matrix[3] = 0, 0, 0, 1
    (element,) = written(tmp_path, node("sphere", mi.ObjectType.Shape, to_world=mi.ScalarTransform4d(matrix)))
    assert element.find("transform").get("name") == "to_world"
    numbers = element.find("transform/matrix").get("value").split(", ")
    np.testing.assert_array_equal(np.array(numbers, float).reshape(4, 4), matrix)


def test_files_come_along_under_names_of_their_own(tmp_path):
    folder, given = tmp_path / "files", tmp_path / "a b.ply"
    given.write_bytes(b"ply")
    first, second = written(folder, *(node("ply", mi.ObjectType.Shape, filename=str(given)) for _ in range(2)))
    assert [element[0].get("value") for element in (first, second)] == ["files/a_b.ply", "files/a_b_1.ply"]
    assert [path.read_bytes() for path in folder.iterdir()] == [b"ply"] * 2
    # Texts that are no files stay as they are, and so do names of files under other keys.
    assert said(folder, filename="nowhere.ply", note=str(given)) == [
        ("string", "filename", "nowhere.ply"), ("string", "note", str(given))]  # fmt: skip
    state = SimpleNamespace(nodes=[node("scene", mi.ObjectType.Scene)])
    state.root = state.nodes[0]
    assert XmlWriter(SimpleNamespace(**vars(state), id_to_index={}), folder).file("", ".x").name == "data.x"


@pytest.mark.parametrize("key", ["points", "laser_points"])
def test_points_of_a_scan_are_a_text(tmp_path, key):
    points = mi.TensorXf(np.array([[[0.5, -2.0, 3.0], [4.0, 5.0, 6.25]]], np.float32))
    found = said(tmp_path, "nlos_capture_meter", mi.ObjectType.Sensor, **{key: points})
    assert found == [("string", key, "0.5, -2, 3, 4, 5, 6.25")]
    found = said(tmp_path, "nlos_capture_meter", mi.ObjectType.Sensor, **{key: "1, 2, 3"})
    assert found == [("string", key, "1, 2, 3")]


def test_pictures_keep_their_numbers(tmp_path):
    def read(name):
        with threads_for_files():
            return mi.Bitmap(str(tmp_path / name))

    pixels = np.arange(18, dtype=np.float32).reshape(2, 3, 3) / 32
    cases = {
        "eight": (mi.Bitmap((pixels * 255).astype(np.uint8)), ".png"),
        "float": (mi.Bitmap(pixels), ".exr"),
        "half": (mi.Bitmap(pixels.astype(np.float16)), ".exr"),
    }
    for name, (bitmap, ending) in cases.items():
        ((tag, key, value),) = said(tmp_path / name, "bitmap", mi.ObjectType.Texture, bitmap=bitmap)
        again = read(value)
        assert (tag, key, value) == ("string", "filename", f"{name}/bitmap_bitmap{ending}")
        assert again.component_format() == bitmap.component_format()
        np.testing.assert_array_equal(np.array(again), np.array(bitmap))
    data = said(tmp_path / "data", "bitmap", mi.ObjectType.Texture, data=mi.TensorXf(pixels))[0][2]
    np.testing.assert_array_equal(np.array(read(data)), pixels)
    # Eight bits that are not to be decoded, and no raw picture, are decoded once and for all.
    linear = mi.Bitmap((pixels * 255).astype(np.uint8))
    linear.set_srgb_gamma(False)
    assert said(tmp_path / "l", "bitmap", mi.ObjectType.Texture, bitmap=linear)[0][2].endswith(".exr")
    assert any(entry[2].endswith(".png") for entry in said(
        tmp_path / "r", "bitmap", mi.ObjectType.Texture, bitmap=linear, raw=True))  # fmt: skip


def test_nodes_are_written_once_and_referred_to(tmp_path):
    shared = node("diffuse", mi.ObjectType.BSDF)
    shapes = [node("sphere", mi.ObjectType.Shape, bsdf=mi.Properties.ResolvedReference(3)) for _ in range(2)]
    scene = node("scene", mi.ObjectType.Scene)
    for n, shape in enumerate(shapes, 1):
        shape.props.set_id(f"s{n}")
        scene.props[f"object_{n}"] = mi.Properties.ResolvedReference(n)
    state = SimpleNamespace(nodes=[scene, *shapes, shared], root=scene, id_to_index={})
    first, second = ElementTree.fromstring(XmlWriter(state, tmp_path).text())
    assert [first.get("id"), second.get("id")] == ["s1", "s2"]
    assert (first[0].tag, first[0].get("type"), first[0].get("id")) == ("bsdf", "diffuse", "node_3")
    assert (second[0].tag, second[0].get("name"), second[0].get("id")) == ("ref", "bsdf", "node_3")


def parsed(content):
    config = mi.parser.ParserConfig(VARIANT)
    return mi.parser.parse_string(config, f'<scene version="3.0.0">{content}</scene>')


def again(folder, content):
    """The elements of a parsed scene as they are written."""
    return list(ElementTree.fromstring(XmlWriter(parsed(content), folder).text()))


def test_spectra_as_pairs_or_one_number(tmp_path):
    (surface,) = again(tmp_path, '<bsdf type="a" id="a"><spectrum name="x" value="400:0.125, 500:0.5, 700:0.25"/>'
                                 '<spectrum name="y" value="0.75"/></bsdf>')  # fmt: skip
    assert [(one.tag, one.get("name")) for one in surface] == [("spectrum", "x"), (surface[1].tag, "y")]
    pairs = [tuple(map(float, pair.split(":"))) for pair in surface[0].get("value").split(",")]
    assert pairs == [(400, 0.125), (500, 0.5), (700, 0.25)] and float(surface[1].get("value")) == 0.75


def test_names_that_parameters_are_called_by(tmp_path):
    """Of what the scene holds, and of shapes in groups and sensors in batches, where no other has the same."""
    group = '<shape type="shapegroup" id="g"><shape type="sphere" id="{}"/><shape type="cube" id="in"/></shape>'
    ball = '<shape type="sphere" id="s"><bsdf type="diffuse" id="b"/></shape>'
    (first, second) = again(tmp_path, group.format("free") + ball)
    assert [first.get("id"), *(one.get("id") for one in first)] == ["g", "free", "in"]
    assert second.get("id") == "s" and second[0].get("id") is None
    state = parsed(group.format("free"))
    next(one for one in state.nodes if one.props.id() == "free").props.set_id("in")
    (first,) = ElementTree.fromstring(XmlWriter(state, tmp_path).text())
    assert [one.get("id") for one in first] == [None, None]
    batch = '<sensor type="batch" id="both"><sensor type="perspective" id="one"><film type="hdrfilm" id="f"/></sensor>'
    (sensor,) = again(tmp_path, batch + "</sensor>")
    assert [one.get("id") for one in (sensor, sensor[0], sensor[0][0])] == ["both", "one", None]


def test_references_to_what_the_scene_holds(tmp_path):
    """Before and after it; names that Mitsuba makes up for places are not said, others are."""
    surface = '<bsdf type="diffuse" id="paint"/>'
    uses = '<shape type="sphere" id="s"><ref id="paint"/></shape>'
    uses += '<shape type="cube" id="c"><ref name="x" id="paint"/></shape>'
    for content in (surface + uses, uses + surface):
        state = parsed(content)
        mi.parser.transform_resolve(mi.parser.ParserConfig(VARIANT), state)
        by = {one.get("id"): one for one in ElementTree.fromstring(XmlWriter(state, tmp_path).text())}
        assert set(by) == {"paint", "s", "c"} and by["paint"].tag == "bsdf" and by["paint"].get("name") is None
        for shape, name in (("s", None), ("c", "x")):
            assert [(one.tag, one.get("id"), one.get("name")) for one in by[shape]] == [("ref", "paint", name)]


def test_tags_of_kinds(tmp_path):
    kinds = mi.ObjectType
    tags = {kinds.PhaseFunction: "phase", kinds.ReconstructionFilter: "rfilter", kinds.Medium: "medium",
            kinds.Volume: "volume", kinds.Sampler: "sampler", kinds.BSDF: "bsdf"}  # fmt: skip
    found = written(tmp_path, *(node("of_others", kind) for kind in tags))
    assert [element.tag for element in found] == list(tags.values())
    # The parser knows no kind of a plugin in Python: that of the object that was built of it.
    scene, inner = node("scene", kinds.Scene), node("of_others", kinds.Unknown)
    scene.props["a"] = mi.Properties.ResolvedReference(1)
    state = SimpleNamespace(nodes=[scene, inner], root=scene, id_to_index={})
    for built, tag in (({"type": "homogeneous"}, "medium"), ({"type": "diffuse"}, "bsdf"), ({"type": "hg"}, "phase")):
        writer = XmlWriter(state, tmp_path)
        writer.note_kind(1, mi.load_dict(built))
        assert ElementTree.fromstring(writer.text())[0].tag == tag
    writer = XmlWriter(state, tmp_path)
    writer.note_kind(1, "text")
    with pytest.raises(SceneError, match="the kind of plugin 'of_others' is not known"):
        writer.text()


def test_grids_keep_their_numbers(tmp_path):
    grid = np.arange(24, dtype=np.float32).reshape(2, 3, 4, 1) / 32
    cases = {"a": ("gridvolume", "grid", mi.VolumeGrid(grid)), "b": ("gridvolume", "data", mi.TensorXf(grid)),
             "c": ("sdfgrid", "grid", mi.TensorXf(grid))}  # fmt: skip
    for name, (plugin, key, value) in cases.items():
        ((tag, said_key, file),) = said(tmp_path / name, plugin, mi.ObjectType.Volume, **{key: value})
        assert (tag, said_key, file) == ("string", "filename", f"{name}/{plugin}_{key}.vol")
        np.testing.assert_array_equal(np.array(mi.VolumeGrid(str(tmp_path / file))), grid[..., 0])
    # Of others an array has no file.
    with pytest.raises(SceneError, match=r"the TensorXf at sdfgrid\.data cannot be said in XML"):
        said(tmp_path / "d", "sdfgrid", mi.ObjectType.Shape, data=mi.TensorXf(grid))


def test_plugins_of_no_kind_have_no_tag(tmp_path):
    with pytest.raises(SceneError, match="the kind of plugin 'unheard_of' is not known"):
        written(tmp_path, node("unheard_of", mi.ObjectType.Unknown))


# ------------------------------------------------------------------------------------------------ values of parameters


def put(name, value, /, **properties):
    props = mi.Properties("some_plugin")
    for key, each in properties.items():
        props[key] = each
    values._put_numbers(props, name, np.array(value), "some.key")
    return props


def test_numbers_as_the_property_that_is_there():
    types = mi.Properties.Type
    assert put("values", [0.5, 2.0], values="1, 2, 3")["values"] == "0.5, 2"
    assert put("radius", [2.5])["radius"] == 2.5
    assert list(put("v", [1.0, 2.0, 3.0], v=[0.0, 0.0, 0.0])["v"]) == [1, 2, 3]
    for props in (put("c", [1.0, 2.0, 3.0]), put("c", [1.0, 2.0, 3.0], c=0.5),
                  put("c", [1.0, 2.0, 3.0], c=mi.ScalarColor3f(0.0))):  # fmt: skip
        assert props.type("c") == types.Color and [props["c"][n] for n in range(3)] == [1, 2, 3]
    assert put("position", [1.0, 2.0, 3.0]).type("position") == types.Vector
    points = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(np.array(put("points", points)["points"]), points[None])
    with pytest.raises(SceneError, match=r"a value of shape \(2,\) for 'some.key' .* no property 'x' of that kind"):
        put("x", [1.0, 2.0])
    # A text that is no list of numbers is none that three numbers can replace.
    with pytest.raises(SceneError, match="no property 'name'"):
        put("name", [1.0, 2.0, 3.0], name="text")


def test_what_says_the_same_otherwise_is_left_out():
    assert "material" not in put("eta", [1.5], material="Au") and "material" not in put("k", [1.5], material="Au")
    assert "focal_length" not in put("fov", [40.0], focal_length="50mm")
    assert "material" in put("alpha", [0.5], material="Au")


def test_properties_that_numbers_are_said_by():
    def of(plugin, name):
        props = mi.Properties(plugin)
        return values._property_of(props, name, np.array(2.0))[0], {key: props[key] for key, _ in props.items()}

    for plugin in ("dielectric", "plastic", "diff_dielectric"):
        assert of(plugin, "eta") == ("int_ior", {"ext_ior": 1.0})
    assert of("conductor", "eta") == ("eta", {})
    assert of("dielectric", "k") == ("k", {})
    assert of("perspective", "x_fov") == ("fov", {"fov_axis": "x"})
    assert of("d65", "value") == ("scale", {}) and of("d65", "scale") == ("scale", {})
    assert of("uniform", "value") == ("value", {})


def test_maps_of_surroundings_lose_the_columns_that_are_there_twice():
    value = np.arange(30.0).reshape(2, 5, 3)
    owner = SimpleNamespace(class_name=lambda: "EnvironmentMapEmitter")
    name, found = values._array_of(owner, "data", value)
    assert name == "bitmap"
    np.testing.assert_array_equal(found, value[:, 1:4])
    assert values._array_of(SimpleNamespace(class_name=lambda: "BitmapTexture"), "data", value) == ("data", value)


@pytest.mark.parametrize("spectrum", ["d65", "uniform"])
def test_light_of_a_spectral_model_cannot_be_said(monkeypatch, spectrum):
    owner = SimpleNamespace(ptr=1, class_name=lambda: spectrum)
    monkeypatch.setattr(values, "keeps_coefficients", lambda given, key: given is owner)
    built = SimpleNamespace(params=SimpleNamespace(properties={"a.value": (None, None, owner, None)}))
    slot = SimpleNamespace(key="a.value", targets=["a.value"], kind="number")
    with pytest.raises(SceneError, match=r"'a\.value' cannot be said in XML: .* a spectral model of light"):
        values.write_value(SimpleNamespace(state=None), built, {1: values.Place(0)}, slot, np.ones(3))


def put_into(plugin, key, value, kind="number", held=(), keeps=False, owner=None, **properties):
    """The properties of a node after a value of one of its parameters was written."""
    owner, name = owner or SimpleNamespace(ptr=1, class_name=lambda: "Some"), f"x.{key}"
    props = mi.Properties(plugin)
    for each, given in properties.items():
        props[each] = given
    params = {f"x.{each}": np.array([given]) for each, given in dict(held).items()}
    built = SimpleNamespace(params=type("Params", (dict,), {"properties": {name: (None, None, owner, None)}})(params))
    state = SimpleNamespace(nodes=[None, SimpleNamespace(props=props)])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(values, "keeps_coefficients", lambda *_: keeps)
        slot = SimpleNamespace(key=name, targets=[name], kind=kind)
        values.write_value(SimpleNamespace(state=state), built, {owner.ptr: values.Place(1)}, slot, np.array(value))
    return props


def test_values_come_into_the_node_that_they_belong_to():
    # What three numbers are in a spectral model is asked of values of spectra alone.
    assert put_into("sphere", "radius", 2.5, keeps=True)["radius"] == 2.5
    # The inner angle of a spot follows its outer one where it is not described, and keeps its value all the same.
    spot = put_into("spot", "cutoff_angle", 30.0, held={"beam_width": 15.0})
    assert (spot["cutoff_angle"], spot["beam_width"]) == (30.0, 15.0)
    spot = put_into("spot", "cutoff_angle", 30.0, held={"beam_width": 15.0}, beam_width=12.0)
    assert (spot["cutoff_angle"], spot["beam_width"]) == (30.0, 12.0)
    matrix = np.diag([2.0, 3.0, 4.0, 1.0])
    matrix[:3, 3] = 5, 6, 7
    placed = put_into("sphere", "to_world", matrix, "transform", center=[0.0, 0.0, 0.0], radius=2.0, alpha=1.0)
    np.testing.assert_array_equal(np.array(placed["to_world"].matrix), matrix)
    assert [key for key, _ in placed.items()] == ["alpha", "to_world"]
    np.testing.assert_array_equal(np.array(put_into("obj", "m", matrix, "mesh_transform")["to_world"].matrix), matrix)
    flat = np.array([[2.0, 0.0, 5.0], [0.0, 3.0, 6.0], [0.0, 0.0, 1.0]])
    turned = np.array(put_into("bitmap", "to_uv", flat, "transform")["to_uv"].matrix)
    np.testing.assert_array_equal(turned[:2][:, [0, 1, 3]], flat[:2])
    grid = np.arange(24.0).reshape(2, 3, 4)
    held = put_into("gridvolume", "data", grid, "tensor", filename="a.vol", raw=True)
    assert [key for key, _ in held.items()] == ["raw", "data"]
    np.testing.assert_array_equal(np.array(held["data"]), grid)


def test_meshes_of_other_vertices_become_files(monkeypatch):
    """Those whose node has no place for a transform, and those whose vertices are given."""
    made = []
    monkeypatch.setattr(values, "mesh_as_file", lambda writer, index, mesh: made.append((index, mesh)))
    other = SimpleNamespace(ptr=1, class_name=lambda: "Some")
    put_into("mesh_arrays", "m", np.eye(4), "mesh_transform", owner=other)
    assert made == [(1, other)]
    put_into("obj", "m", np.eye(4), "mesh_transform", owner=other)
    mesh = mi.load_dict({"type": "cube"})
    for count, name in enumerate(("vertex_positions", "vertex_normals", "vertex_texcoords"), 2):
        put_into("cube", name, np.zeros((24, 3)), "vertices", owner=mesh)
        assert made[count - 1 :] == [(1, mesh)]
    assert put_into("cube", "radius", 2.5, owner=mesh)["radius"] == 2.5 and len(made) == 4
    assert put_into("some", "vertex_positions", [1.0, 2, 3], owner=other).type("vertex_positions") == (
        mi.Properties.Type.Color) and len(made) == 4  # fmt: skip


def test_places_that_are_not_there():
    owner = SimpleNamespace(ptr=1)
    built = SimpleNamespace(params=SimpleNamespace(properties={"a.b": (None, None, owner, None)}))
    slot = SimpleNamespace(key="a.b", targets=["a.b"], kind="number")
    with pytest.raises(SceneError, match=r"'a\.b' has no place in the description, and cannot be said in XML"):
        values.write_value(SimpleNamespace(state=None), built, {2: values.Place(0)}, slot, np.ones(3))


def made_of(names, made, value, owner=None, plugin="diffuse", kind=mi.ObjectType.BSDF, **properties):
    """The nodes after a value was put into what Mitsuba has made of a number, of a colour or of nothing."""
    state = SimpleNamespace(nodes=[node(plugin, kind, **properties)], id_to_index={})
    values._put_into_made(state, values.Place(0, names, made), owner, np.array(value), "some.key")
    return [(one.props.plugin_name(), {key: one.props[key] for key, each in one.props.items()
                                       if not isinstance(each, mi.Properties.ResolvedReference)})
            for one in state.nodes]  # fmt: skip


def test_values_of_what_mitsuba_has_made():
    texture = mi.load_dict({"type": "uniform", "value": 0.5})
    # A number of the node itself.
    assert made_of(("eta",), texture, [1.5], texture) == [("diffuse", {"eta": 1.5})]
    # A surface that nobody has described, and light that is daylight's.
    surface = mi.load_dict({"type": "diffuse"})
    assert made_of(("bsdf", "reflectance"), surface, [0.25], plugin="sphere", kind=mi.ObjectType.Shape) == [
        ("sphere", {}), ("diffuse", {"reflectance": 0.25})]  # fmt: skip
    light = {"plugin": "point", "kind": mi.ObjectType.Emitter}
    assert made_of(("intensity",), texture, [2.5], texture, **light) == [("point", {}), ("d65", {"scale": 2.5})]
    assert made_of(("intensity",), texture, [2.5], texture, intensity=1.0, **light) == [("point", {"intensity": 2.5})]
    assert made_of(("intensity",), texture, [2.5], object(), **light) == [("point", {"intensity": 2.5})]
    # A volume of one number.
    volume = mi.load_dict({"type": "constvolume", "value": 0.5})
    assert made_of(("albedo", "value"), volume, [0.75], plugin="homogeneous") == [("homogeneous", {"albedo": 0.75})]
    for names, made in ((("a", "b"), texture), (("a", "b", "c"), volume), (("bsdf", "a", "b"), surface)):
        with pytest.raises(SceneError, match=r"'some\.key' has no place in the description"):
            made_of(names, made, [0.5])


def test_numbers_that_went_through_a_file_are_the_same():
    one = np.array([1.0, 1000.0])
    assert _same(one, one * (1 + 9e-6)) and not _same(one, one * (1 + 2.2e-5))
    # What is small beside the largest may differ by the rounding of that.
    small = np.array([1e-3, 0.0])
    for sign in (1, -1):
        assert _same(sign * one, sign * one + 0.9 * small) and not _same(sign * one, sign * one + 12 * small)
    assert _same(one / 2000, one / 2000 + 0.9e-3 * small) and not _same(one / 2000, one / 2000 + 2e-3 * small)
    assert not _same(one, one[:1]) and not _same(one, one[None])
    assert _same(np.array(["a"]), np.array(["a"])) and not _same(np.array(["a"]), np.array(["b"]))
    assert _same(np.zeros((0, 3)), np.zeros((0, 3)))
