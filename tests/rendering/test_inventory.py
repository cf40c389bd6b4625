"""The lists of what plugins do, held against what the plugins really do."""

import struct
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.sweeps import together
from torchtransient import plugins
from torchtransient.plugins._registry import PLUGIN_MODULES
from torchtransient.rendering.inventory import POLARIZING_ELEMENTS, POLARIZING_INTERFACES, like_mitsuba
from torchtransient.rendering.inventory_colour import (
    _constant,
    colour_of_node,
    colour_of_value,
)

VARIANT = "llvm_ad_mono_polarized"
# Every BSDF of Mitsuba 3.9 that stands alone. `hair` needs wavelengths, the measured ones need files.
MITSUBA = (
    "diffuse", "dielectric", "thindielectric", "roughdielectric", "conductor", "roughconductor", "plastic",
    "roughplastic", "pplastic", "principled", "principledthin", "null", "polarizer", "retarder", "circular",
)  # fmt: skip
OURS = tuple(name for module in PLUGIN_MODULES for kind, name in module.plugins if kind == "bsdf")

# What some cannot do without in this variant.
NEEDED = {"delayed": {"lifetime": 0.1, "bsdf": {"type": "diffuse"}}, "diff_hair": {"sigma_a": 0.5}}


def mueller_matrices(bsdf) -> np.ndarray:
    """(N, 4, 4): weights of sampled directions and values at them, over angles of incidence."""
    count = 256
    generator = np.random.default_rng(4)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    angle = np.linspace(0.1, 1.4, count)
    si.t, si.n, si.sh_frame.n = 1.0, mi.Normal3f(0, 0, 1), mi.Normal3f(0, 0, 1)
    si.initialize_sh_frame()
    si.wi = mi.Vector3f(np.sin(angle), 0, np.cos(angle))
    u, v = mi.Float(generator.random(count)), mi.Point2f(generator.random((2, count)))
    sample, weight = bsdf.sample(mi.BSDFContext(), si, u, v)
    value = bsdf.eval(mi.BSDFContext(), si, sample.wo)
    dr.eval(weight, value)  # in one kernel
    found = [
        [[np.broadcast_to(np.array(m[i, j]).ravel(), count) for j in range(4)] for i in range(4)]
        for m in (weight, value)
    ]
    return np.nan_to_num(np.concatenate(np.moveaxis(np.array(found), -1, 1)))


def polarizes(matrices: np.ndarray) -> bool:
    """Whether some matrix is neither an ideal depolarizer nor a multiple of the identity."""
    depolarizer, identity = np.zeros((4, 4)), np.eye(4)
    depolarizer[0, 0] = 1
    scale = matrices[:, :1, :1]
    errors = [np.abs(matrices - scale * m).max((1, 2)) for m in (depolarizer, identity)]
    return bool((np.minimum(*errors) > 1e-4 * np.abs(matrices).max()).any())


@together("name", [*MITSUBA, *OURS])
def test_what_polarizes_is_listed(name):
    plugins.sync()
    found = polarizes(mueller_matrices(mi.load_dict({"type": name, **NEEDED.get(name, {})})))
    listed = like_mitsuba(name) in (*POLARIZING_ELEMENTS, *POLARIZING_INTERFACES)
    # Mitsuba's rough dielectric depolarizes; polarized renders replace it by one that does not.
    assert listed == (found or name == "roughdielectric")


def verdict(plugin, lookup=Path, **properties):
    """The kind of what the description of one plugin says, and why; None for grey."""
    node = mi.parser.SceneNode()
    node.type, node.props = mi.ObjectType.Texture, mi.Properties(plugin)
    for key, value in properties.items():
        node.props[key] = value
    said = colour_of_node(node, lookup)
    return said and (said.kind, said.why)


def test_grids_in_files_are_coloured_by_the_channels_in_their_head(tmp_path):
    def grid(name, head):
        (tmp_path / name).write_bytes(head)
        said = verdict("gridvolume", tmp_path.joinpath, filename=name)
        return said and said[1]

    numbers = struct.pack("<5i", 1, 5, 4, 2, 1)
    assert grid("one.vol", b"VOL\x03" + numbers) is None
    assert grid("six.vol", b"VOL\x03" + numbers[:-4] + struct.pack("<i", 6)) == "grid 'six.vol' with 6 channels"
    # What has no such head may be anything.
    assert grid("short.vol", (b"VOL\x03" + numbers)[:-1]) == "grid 'short.vol' with 3 channels"
    assert grid("other.vol", b"VDB\x03" + numbers) == "grid 'other.vol' with 3 channels"
    assert verdict("gridvolume", tmp_path.joinpath, filename="no.vol") == ("colour", "grid 'no.vol' with 3 channels")


@pytest.mark.parametrize("key", ["grid", "data"])
def test_grids_of_numbers_are_coloured_where_channels_differ(key):
    values = np.full((2, 3, 4, 3), 0.25, np.float32)
    assert verdict("gridvolume", **{key: mi.TensorXf(values)}) is None
    assert verdict("gridvolume", **{key: mi.TensorXf(np.arange(24, dtype=np.float32).reshape(2, 4, 3))}) is None
    for channel in range(3):
        coloured = values.copy()
        coloured[1, 2, 3, channel] = 0.5
        assert verdict("gridvolume", **{key: mi.TensorXf(coloured)}) == ("colour", "coloured grid")


@pytest.mark.parametrize("plugin", ["bitmap", "envmap"])
def test_pictures_are_coloured_where_channels_differ(plugin, tmp_path):
    def picture(name, pixels):
        mi.Bitmap(pixels).write(str(tmp_path / name))
        said = verdict(plugin, tmp_path.joinpath, filename=name)
        return said and said[1]

    grey = np.full((2, 3, 3), 64, np.uint8)
    assert picture("grey.png", grey) is None
    assert picture("one.png", np.arange(6, dtype=np.uint8).reshape(2, 3, 1)) is None
    for channel in range(3):
        coloured = grey.copy()
        coloured[1, 0, channel] = 65
        assert picture(f"{channel}.png", coloured) == f"coloured picture '{channel}.png'"
        data = mi.TensorXf(coloured.astype(np.float32))
        assert verdict(plugin, data=data) == ("colour", "coloured picture")
    assert verdict(plugin, data=mi.TensorXf(grey.astype(np.float32))) is None


def test_large_pictures_are_taken_as_coloured(tmp_path):
    for size, why in ((1 << 18, "which cannot be read"), ((1 << 18) + 1, "without a look at its pixels")):
        (tmp_path / "p.png").write_bytes(bytes(size))
        kind, said = verdict("bitmap", tmp_path.joinpath, filename="p.png")
        assert kind == "colour" and said.endswith(why)
    found = verdict("bitmap", tmp_path.joinpath, filename="no.png")
    assert found == ("colour", "picture 'no.png', which was not found")


@pytest.mark.parametrize(
    ("plugin", "properties", "kind"),
    [
        ("conductor", {}, None),
        ("conductor", {"material": "None"}, None),
        ("roughconductor", {"material": "Au"}, "measured"),
        ("blackbody", {}, "measured"),
        ("sunsky", {}, "colour"),
        ("delayed", {}, None),
        ("delayed", {"lifetime": 0.1}, None),
        ("delayed", {"excitation": 500.0}, "measured"),
        ("delayed", {"emission": 500.0}, "measured"),
        ("roughplastic", {"emission": 500.0}, None),
        ("unheard_of", {}, "colour"),
    ],
)
def test_what_plugins_say_of_their_colours(plugin, properties, kind):
    said = verdict(plugin, **properties)
    assert (said and said[0]) == kind


@pytest.mark.parametrize(
    ("wavelengths", "values", "constant"),
    [
        ((380.0, 600.0, 780.0), (0.5, 0.5, 0.5), True),
        ((379.0, 781.0), (0.5, 0.5), True),
        ((381.0, 780.0), (0.5, 0.5), False),
        ((380.0, 779.0), (0.5, 0.5), False),
        ((380.0, 600.0, 780.0), (0.5, 0.5, 0.25), False),
        ((), (), False),
    ],
)
def test_tables_are_grey_where_they_are_one_value_over_all_that_is_visible(wavelengths, values, constant):
    table = SimpleNamespace(is_uniform=lambda: False, wavelengths=wavelengths, values=values)
    assert _constant(table) == constant
    assert _constant(SimpleNamespace(is_uniform=lambda: True))


def test_colours_of_properties():
    props = mi.Properties("diffuse")
    for key in ("reflectance", "alpha"):
        props[key] = mi.ScalarColor3f(0.1, 0.2, 0.1)
    node = SimpleNamespace(props=props)

    def said(*three):
        found = colour_of_value(node, "reflectance", three)
        return found and (found.kind, found.why)

    assert said(0.2, 0.2, 0.2) is None
    for three in ((0.3, 0.2, 0.2), (0.2, 0.3, 0.2), (0.2, 0.2, 0.3)):
        assert said(*three) == ("colour", "coloured reflectance")
    assert colour_of_value(node, "alpha", (0.3, 0.2, 0.2)) is None
