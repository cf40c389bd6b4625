"""What keeps a scene from the fast path is named."""

import mitsuba as mi

from torchtransient.plugins.around_corner.eligibility import reasons_against

VARIANT = "llvm_ad_rgb"


def reasons(hidden=None, **others):
    rectangle = {"type": "rectangle", "bsdf": {"type": "twosided", "nested": {"type": "diffuse"}}}
    scene = mi.load_dict({"type": "scene", "wall": rectangle, "hidden": hidden or rectangle, **others}, optimize=False)
    shapes = {shape.id(): shape for shape in scene.shapes()}
    return reasons_against(scene, [shapes["hidden"]], [shapes["wall"]])


def test_a_diffuse_scene_has_none():
    assert reasons() == []
    # What is not asked to scatter may be anything that is opaque.
    assert reasons(mirror={"type": "sphere", "bsdf": {"type": "conductor"}}) == []


def test_each_is_named():
    (line,) = reasons({"type": "rectangle", "bsdf": {"type": "plastic"}})
    assert "hidden" in line and "not diffuse" in line
    (line,) = reasons(pane={"type": "rectangle", "bsdf": {"type": "thindielectric"}})
    assert "pane" in line and "lets light through" in line
    fog = {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}
    (line,) = reasons(fog=fog)
    assert "fog" in line and "medium" in line
    group = {"type": "shapegroup", "inner": {"type": "rectangle"}}
    line, *_ = reasons({"type": "instance", "ref": {"type": "ref", "id": "group"}}, group=group)
    assert "hidden" in line and "cannot be drawn" in line


def test_variants_without_colours():
    with mi.variant_context("llvm_ad_spectral"):
        assert "llvm_ad_spectral" in reasons()[0]
