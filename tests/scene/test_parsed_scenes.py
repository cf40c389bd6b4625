"""Properties read off the nodes of a parsed scene, and nodes that are refused before anything is built."""

from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import pytest

from torchtransient.errors import SceneError
from torchtransient.scene.checks import check_nesting, check_nodes
from torchtransient.scene.inventory import take_inventory
from torchtransient.scene.nodes import node_label

VARIANT = "llvm_ad_rgb"
DIFFUSE = '<bsdf type="diffuse"><float name="reflectance" value="0.3"/></bsdf>'
BRIGHT = '<bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.7, 0.4"/></bsdf>'
FOG = '<medium name="interior" type="homogeneous"><phase type="{}"/></medium>'
GLASS = '<bsdf type="dielectric"/>'


def parsed(content):
    config = mi.parser.ParserConfig(mi.variant())
    return mi.parser.parse_string(config, f'<scene version="3.0.0">{content}</scene>')


def inventory(content, sensor=0):
    return take_inventory(parsed(content), Path, sensor)


def shape(inside, plugin="rectangle", name="wall"):
    return f'<shape type="{plugin}" id="{name}">{inside}</shape>'


def within(plugin, inside, times=1):
    return f'<bsdf type="{plugin}">' * times + inside + "</bsdf>" * times


def blend(a, b):
    return f'<bsdf type="blendbsdf"><float name="weight" value="0.5"/>{a}{b}</bsdf>'


# ------------------------------------------------------------------------------------------------------------ albedo


@pytest.mark.parametrize(
    ("surface", "albedo"),
    [
        ("", 0.5),
        ('<bsdf type="diffuse"/>', 0.5),
        (DIFFUSE, 0.3),
        (BRIGHT, 0.7),
        ('<bsdf type="diffuse"><spectrum name="reflectance" value="400:0.1, 500:0.6, 700:0.2"/></bsdf>', 0.6),
        ('<bsdf type="diffuse"><texture name="reflectance" type="checkerboard"/></bsdf>', 1.0),
        (within("twosided", DIFFUSE), 0.3),
        ('<bsdf type="twosided"/>', 1.0),
        (within("bumpmap", f'<texture type="checkerboard"/>{DIFFUSE}'), 0.3),
        (blend(DIFFUSE, BRIGHT), 0.7),
        (blend(BRIGHT, DIFFUSE), 0.7),
        (DIFFUSE + BRIGHT, 0.7),
        (BRIGHT + DIFFUSE, 0.7),
        (within("mask", DIFFUSE), 1.0),
        (GLASS, 1.0),
    ],
)
def test_share_of_the_light_that_leaves_a_surface_at_most(surface, albedo):
    found = inventory(shape(surface))
    assert found.albedo == pytest.approx(albedo, rel=1e-6) and found.brightest.startswith("rectangle 'wall'")


def test_the_brightest_of_surfaces_and_media_counts():
    walls = shape(DIFFUSE, name="dark") + shape(BRIGHT, name="bright") + shape(BRIGHT, name="other")
    assert inventory(walls).brightest.startswith("rectangle 'bright'")
    for albedo, fog in ((0.75, ""), (0.9, '<float name="albedo" value="0.9"/>')):
        medium = f'<medium name="interior" type="homogeneous" id="fog">{fog}</medium>'
        found = inventory(walls + shape(medium + DIFFUSE, "cube", "box"))
        assert found.albedo == pytest.approx(albedo) and found.brightest.startswith("homogeneous 'fog'")
        assert [finding.what for finding in found.media] == ["participating medium"]


def test_groups_have_no_surface_of_their_own():
    group = f'<shape type="shapegroup" id="group">{shape(DIFFUSE, name="inside")}</shape>'
    instance = '<shape type="instance" id="copy"><ref id="group"/></shape>'
    assert inventory(group + instance).albedo == pytest.approx(0.3)


# ------------------------------------------------------------------------------------------------------ polarization


@pytest.mark.parametrize(
    ("content", "in_a_row"),
    [
        (shape(DIFFUSE, "sphere"), False),
        (shape(GLASS), False),
        (shape(GLASS, "disk") + shape(DIFFUSE, "sphere", "other"), False),
        (shape(GLASS, "sphere"), True),
        (shape(GLASS) + shape(GLASS, name="other"), True),
        (shape(within("mask", GLASS)) + shape(GLASS, name="other"), True),
        (shape(FOG.format("rayleigh")), True),
        (shape(FOG.format("hg")) + shape(GLASS, name="other"), False),
    ],
)
def test_light_meets_polarizing_surfaces_in_a_row_unless_a_single_flat_one_is_there(content, in_a_row):
    assert inventory(content).interfaces_in_a_row is in_a_row


def test_what_nothing_refers_to_is_declared_only():
    unused = '<bsdf type="polarizer" id="p"/><bsdf type="dielectric" id="d"/><medium type="homogeneous" id="fog"/>'
    found = inventory(unused + shape(DIFFUSE))
    assert [finding.what for finding in found.declared_only] == ["polarizer", "homogeneous"]
    assert found.elements == found.interfaces == found.media == []
    found = inventory(unused + shape('<ref id="p"/>'))
    assert [finding.what for finding in found.declared_only] == ["homogeneous"]
    assert [finding.what for finding in found.elements] == ["polarizer"]


# --------------------------------------------------------------------------------------- sensors, films, integrators


def test_the_film_of_the_sensor_counts():
    def sensor(film, inside=""):
        return f'<sensor type="perspective"><film type="{film}">{inside}</film></sensor>'

    curve = '<spectrum name="red" value="400:0.1, 500:0.6"/>'
    both = sensor("hdrfilm") + sensor("specfilm", curve)
    assert [inventory(both, n).film for n in (0, 1, 2)] == ["hdrfilm", "specfilm", "hdrfilm"]
    bands = inventory(both).bands
    assert [(band.what, band.where) for band in bands] == [("response curve 'red'", "specfilm")]
    nested = '<texture name="green" type="checkerboard"/><rfilter type="box"/>'
    bands = inventory(sensor("specfilm", nested)).bands
    assert [(band.what, band.where) for band in bands] == [("response curve 'green'", "specfilm")]
    # Curves of a film are no colours of the scene.
    assert inventory(sensor("some_film", nested)).colours == [] == inventory(both).measured
    assert inventory(shape(DIFFUSE)).film is None
    pulses = [inventory(sensor("transient_hdr_film", inside)).pulsed for inside in (
        "", '<string name="pulse" value="gaussian"/>', '<string name="irf" value="gaussian"/>')]  # fmt: skip
    assert pulses == [False, True, True]


def test_depths_of_nested_integrators_count():
    path = '<integrator type="path"><integer name="max_depth" value="7"/></integrator>'
    assert (inventory(path).integrator, inventory(path).max_depth) == ("path", 7)
    nested = inventory(f'<integrator type="moment">{path}</integrator>')
    assert (nested.integrator, nested.max_depth) == ("moment", 7)
    assert [inventory(f'<integrator type="{name}"/>').max_depth for name in ("volpath", "prb", "direct")] == [-1, 6, 2]
    assert (inventory(shape(DIFFUSE)).integrator, inventory(shape(DIFFUSE)).max_depth) == (None, -1)
    named = '<integrator type="path"><string name="temporal_filter" value="{}"/></integrator>'
    assert [inventory(named.format(name)).temporal_filter for name in ("tent", "")] == ["tent", None]


# -------------------------------------------------------------------------------------------------- colours and names


def test_colours_of_nodes_and_of_their_properties_count():
    curve = '<bsdf type="diffuse"><spectrum name="reflectance" value="400:0.1, 700:0.2"/></bsdf>'
    flat = '<bsdf type="diffuse"><spectrum name="reflectance" value="0.25"/></bsdf>'
    gold = '<bsdf type="conductor"><string name="material" value="Au"/></bsdf>'
    found = inventory(shape(BRIGHT) + shape(curve, name="b") + shape(flat, name="c") + shape(gold, name="d"))
    assert [finding.what for finding in found.colours] == ["coloured reflectance"]
    assert [finding.what for finding in found.measured] == [
        "reflectance given over wavelength", "indices of 'Au' over wavelength"]  # fmt: skip
    assert found.plugins == {"rectangle", "diffuse", "conductor"}


def test_nodes_are_called_by_plugin_name_and_place(tmp_path):
    folder = tmp_path / "a"
    folder.mkdir()
    lines = ["<shape type='sphere'/>", "<shape type='cube' id='box'/>"]
    (folder / "room.xml").write_text("<scene version='3.0.0'>\n" + "\n".join(lines) + "\n</scene>")
    config = mi.parser.ParserConfig(mi.variant())
    state = mi.parser.parse_file(config, str(folder / "room.xml"))
    assert node_label(state, 0) == "scene, room.xml (line 1, col 2)"
    assert [node_label(state, index) for index in (1, 2)] == [
        "sphere, room.xml (line 2, col 2)", "cube 'box', room.xml (line 3, col 2)"]  # fmt: skip
    described = {"type": "scene", "box": {"type": "cube"}, "wall": {"type": "rectangle", "id": "front"}}
    state = mi.parser.parse_dict(config, described)
    names = {node_label(state, index) for index in (1, 2)}
    assert names == {"cube 'box' at 'box'", "rectangle 'front' at 'wall'"}


# ----------------------------------------------------------------------------------------------------- what is refused


def test_nodes_inside_of_nodes_as_deep_as_they_may_be():
    # With the scene and the shape around them, and the surface inside.
    check_nesting(parsed(shape(within("mask", DIFFUSE, 29))))
    with pytest.raises(SceneError, match="at most 32 deep, got more"):
        check_nesting(parsed(shape(within("mask", DIFFUSE, 30))))


@pytest.mark.parametrize("order", [1, -1])
def test_the_deepest_of_several_counts(order):
    for levels, deep in ((29, False), (30, True)):
        both = [DIFFUSE, within("mask", DIFFUSE, levels)][::order]
        state = parsed(shape("".join(both)))
        if deep:
            with pytest.raises(SceneError, match="at most 32 deep, got more"):
                check_nesting(state)
        else:
            check_nesting(state)


def test_nodes_of_a_surface_as_many_as_there_may_be():
    # A two-sided surface reaches its inside twice: 2^(n + 1) - 1 nodes of n around one.
    half = within("twosided", DIFFUSE, 7)
    check_nesting(parsed(shape(within("mask", half))))
    with pytest.raises(SceneError, match=r"at most 256 nodes in one surface.*got 257\."):
        check_nesting(parsed(shape(within("mask", half, 2))))
    with pytest.raises(SceneError, match=r"got 511\."):
        check_nesting(parsed(shape(within("twosided", half))))
    # So does a blend of twice the same, here by reference; shapes do not add up.
    seven = within("twosided", DIFFUSE, 6).replace("<bsdf", '<bsdf id="s"', 1)
    check_nesting(parsed(seven + shape(within("mask", blend('<ref id="s"/>', '<ref name="b" id="s"/>')))))
    with pytest.raises(SceneError, match=r"got 257\."):
        check_nesting(parsed(seven + shape(within("mask", blend('<ref id="s"/>', '<ref name="b" id="s"/>'), 2))))
    check_nesting(parsed(shape(half, name="a") + shape(half, name="b") + shape(half, name="c")))


def refused(kind, plugin, **properties):
    """Return the error about one node, None without one."""
    node = mi.parser.SceneNode()
    node.type, node.props = kind, mi.Properties(plugin)
    for key, value in properties.items():
        node.props[key] = value
    try:
        check_nodes(SimpleNamespace(nodes=[node], id_to_index={}))
    except SceneError as error:
        return str(error)
    return None


@pytest.mark.parametrize("name", ["width", "height", "crop_width", "crop_height", "sample_count"])
def test_sizes_and_samples_are_whole_numbers_from_one(name):
    kind, plugin = (mi.ObjectType.Sampler, "independent") if name == "sample_count" else (mi.ObjectType.Film, "hdrfilm")
    for given in (1, 2**31 - 1, 4.0):
        assert refused(kind, plugin, **{name: given}) is None
    for given in (0, -3, 2**31, 1.5, True, "4"):
        assert f"{plugin}: {name}: expected a whole number from 1 to 2^31 - 1" in refused(kind, plugin, **{name: given})
    # Of others it may be anything.
    assert refused(mi.ObjectType.Shape, "rectangle", **{name: 0}) is None


def test_strength_of_orthogonal_samples():
    assert refused(mi.ObjectType.Sampler, "orthogonal", strength=2) is None
    assert "strength: expected a whole number from 2" in refused(mi.ObjectType.Sampler, "orthogonal", strength=1)
    assert refused(mi.ObjectType.Sampler, "independent", strength=1) is None
