"""What counts as the same all over a surface: only that may be left out where a vertex slides."""

from __future__ import annotations

import mitsuba as mi

from support.sweeps import together
from support.walks import varies_by_place
from tools.every_plugin import bsdfs

VARIANT = "llvm_ad_rgb"
BOARD = {"type": "checkerboard"}
# They have a texture of normals or heights, or scatter late.
VARYING = ("bumpmap", "normalmap", "delayed")


def light(shape, **emitter):
    holder = mi.load_dict({"type": shape, "emitter": emitter})
    return varies_by_place(holder.emitter())  # which does not keep its shape alive


def test_lights():
    assert not light("rectangle", type="area", radiance=1.0)
    assert not light("cylinder", type="area", radiance=1.0)
    assert light("rectangle", type="area", radiance=BOARD)
    assert not light("rectangle", type="angulararea", radiance=1.0)
    assert light("rectangle", type="angulararea", radiance=BOARD)
    assert light("cylinder", type="angulararea", radiance=1.0)
    assert not varies_by_place(mi.load_dict({"type": "point"}))


@together("name", [name for name in bsdfs() if name not in VARYING])
def test_every_bsdf_without_a_varying_texture(name):
    """Guards against names of Mitsuba's classes that have changed: all would count as patterned, at a cost."""
    assert not varies_by_place(mi.load_dict(bsdfs()[name]))


def test_attributes_of_meshes():
    """Mitsuba's texture of them says that it does not vary."""
    attribute = {"type": "mesh_attribute", "name": "vertex_color"}
    assert varies_by_place(mi.load_dict({"type": "diffuse", "reflectance": attribute}))
    assert light("cube", type="area", radiance=attribute)


def register_those_of_another():
    class Stripes(mi.BSDF):
        """Asks the place itself, and says nothing of it."""

        def __init__(self, props):
            super().__init__(props)
            self.m_flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components = [self.m_flags]

        def to_string(self):
            return "Stripes"

    class Waves(mi.Texture):
        """Does not say that it varies."""

        def is_spatially_varying(self):
            return False

        def to_string(self):
            return "Waves"

    mi.register_bsdf("stripes_of_another", Stripes)
    mi.register_texture("waves_of_another", Waves)


def test_plugins_of_others_whatever_holds_them():
    register_those_of_another()
    stripes = {"type": "stripes_of_another"}
    assert varies_by_place(mi.load_dict(stripes))
    assert varies_by_place(mi.load_dict({"type": "twosided", "nested": stripes}))
    assert varies_by_place(mi.load_dict({"type": "diffuse", "reflectance": {"type": "waves_of_another"}}))
    assert light("rectangle", type="area", radiance={"type": "waves_of_another"})
