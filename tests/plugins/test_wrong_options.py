"""Wrong values of options are errors of one sentence before Mitsuba, LLVM or Python meet them."""

from __future__ import annotations

import mitsuba as mi
import pytest
import torch

import torchtransient as tt
from support.option_cases import OPTIONS, VALUES, with_option
from support.sweeps import together
from tools.small_room import VARIANT, make_room
from torchtransient.errors import SceneError

# What ended the process, never answered, or was an error of Python's before: (kind of node, option, value).
DIED = [
    ("independent", "sample_count", "0"),
    ("ldsampler", "sample_count", "0"),
    ("orthogonal", "strength", "-1"),
    *[(film, size, "0") for film in ("transient_hdr_film", "phasor_hdr_film", "gated_hdr_film", "hdrfilm")
      for size in ("width", "crop_height")],
    ("hdrfilm", "width", "None"),
    ("perspective", "fov", "None"),
    ("perspective", "to_world", "1.5"),
    ("point", "to_world", "True"),
    ("rectangle", "to_world", "nan"),
    ("checkerboard", "to_uv", "0"),
    ("tent", "radius", "1e30"),
    ("gaussian", "stddev", "-1"),
    ("lanczos", "lobes", "0"),
    ("mitchell", "B", "1e30"),
    # Silently taken before:
    ("transient_hdr_film", "bin_width_opl", "True"),
    ("transient_hdr_film", "laser_scan_width", "-1"),
    ("phasor_hdr_film", "frequency_count", "1.5"),
    ("delayed", "lifetime", "True"),
]  # fmt: skip


def case(plugin, option):
    return next((place, node) for place, node, options in OPTIONS if node["type"] == plugin and option in options)


def render(description):
    axis = {}
    if description["sensor"]["film"]["type"] == "hdrfilm":
        axis["time_axis"] = tt.TimeAxis(start_opl=6.0, bin_width_opl=1.0, num_bins=8)
    return tt.TransientRenderer(tt.load(description, variant=VARIANT), **axis)(seed=0)


@together("plugin, option, value", DIED)
def test_wrong_value_is_an_error_of_one_sentence(plugin, option, value):
    with pytest.raises(SceneError, match=r"expected|range|Mitsuba could not build") as failure:
        render(with_option(*case(plugin, option), option, VALUES[value]))
    message = str(failure.value)
    assert option in message or "reconstruction filter" in message
    assert "\n" not in message and "Traceback" not in message and len(message) < 700


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plugin", "option", "value"),
    [("transient_hdr_film", "width", "np.int64(5)"), ("independent", "sample_count", "torch.tensor(3)")],
)
def test_whole_numbers_of_other_libraries_are_right(plugin, option, value):
    place, node = case(plugin, option)
    found = render(with_option(place, node, option, VALUES[value]))
    expected = render(with_option(place, node, option, int(VALUES[value])))
    assert torch.equal(found.transient, expected.transient)


def test_what_a_constructor_in_python_raises_is_an_error_of_the_scene():
    mi.set_variant(VARIANT)

    class Broken(mi.BSDF):
        def __init__(self, props):
            super().__init__(props)
            raise props.get("kind") and {"key": KeyError, "zero": ZeroDivisionError}[props["kind"]]("as it happens")

    mi.register_bsdf("broken_at_birth", Broken)
    for kind in ("key", "zero"):
        room = make_room()
        room["box"]["bsdf"] = {"type": "broken_at_birth", "kind": kind}
        with pytest.raises(SceneError, match=r"could not build the scene.*as it happens"):
            render(room)


# ----------------------------------------------------------------------------------------------------------- nesting


def nested(levels, inner=None):
    node = inner or {"type": "diffuse"}
    for _ in range(levels):
        node = {"type": "mask", "opacity": 0.5, "nested": node}
    return node


def test_nodes_inside_of_nodes_up_to_a_bound():
    room = make_room()
    room["box"]["bsdf"] = nested(3)
    assert render(room).transient.sum() > 0
    for levels in (40, 3000):
        room["box"]["bsdf"] = nested(levels)
        with pytest.raises(SceneError, match="at most 32 deep"):
            tt.load(room)


def test_a_dictionary_that_holds_itself():
    room = make_room()
    room["box"]["inside"] = room
    with pytest.raises(SceneError, match="hold itself"):
        tt.load(room)


@pytest.mark.parametrize(
    ("kind", "words"), [("chain", "at most 32 deep"), ("doubling", "at most 256 nodes"), ("circle", "ircular")]
)
def test_references_count_as_nesting(kind, words):
    room, last = make_room(), 40 if kind == "chain" else 12
    if kind == "circle":
        last = 2
    for n in range(last):
        inside = {"type": "ref", "id": f"b{n + 1}"}
        plugin = {"type": "mask", "nested": inside}
        if kind == "doubling":
            plugin = {"type": "blendbsdf", "weight": 0.5, "a": inside, "b": dict(inside)}
        room[f"b{n}"] = plugin
    back = {"type": "mask", "nested": {"type": "ref", "id": "b0"}}
    room[f"b{last}"] = back if kind == "circle" else {"type": "diffuse"}
    room["box"]["bsdf"] = {"type": "ref", "id": "b0"}
    with pytest.raises(SceneError, match=words):
        render(room)
    if kind != "circle":
        with pytest.raises(SceneError, match=words):
            tt.plan(room)


@pytest.mark.parametrize("depth", [100, 200_000])
def test_elements_of_xml_files(tmp_path, depth):
    path = tmp_path / "deep.xml"
    surface = '<bsdf type="mask">' * depth + '<bsdf type="diffuse"/>' + "</bsdf>" * depth
    path.write_text(f'<scene version="3.0.0"><shape type="sphere">{surface}</shape></scene>', encoding="utf-8")
    with pytest.raises(SceneError, match="at most 64 levels"):
        tt.load(path)


def test_a_scene_that_failed_is_gone():
    """Dr.Jit builds calls into all objects alive: a plugin that cannot be traced would spoil every later render."""
    room = make_room()
    room["light"] = {"type": "timed_sunsky"}
    expected = render(make_room()).transient
    with pytest.raises(SceneError, match="timed_sunsky"):
        render(room)
    torch.testing.assert_close(render(make_room()).transient, expected)
