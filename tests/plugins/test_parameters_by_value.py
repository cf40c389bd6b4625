"""Rows of the table of parameters that depend on what the scene says: which phase function, which weight of a lobe."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins
from torchtransient.plugins.parameters import CORRECT, ParameterTracker, effect_of


@pytest.fixture(autouse=True)
def rgb():
    mi.set_variant("llvm_ad_rgb")
    plugins.sync()


def effect_in(description, key):
    """The effect of the one parameter of a scene whose name contains ``key``."""
    scene = mi.load_dict({"type": "scene", "it": description})
    tracker = ParameterTracker(scene)
    ((_, _, node, flags),) = (entry for name, entry in named(scene) if key in name)
    last = next(name for name, _ in named(scene) if key in name).rsplit(".", 1)[-1]
    return tracker.effect_of(node, last, flags)


def named(scene):
    return list(mi.traverse(scene).properties.items())


@pytest.mark.parametrize("medium", ["homogeneous", "heterogeneous"])
@pytest.mark.parametrize(("phase", "attenuates"), [("sggx", True), ("tabphase", False)])
def test_flakes_are_part_of_the_extinction(medium, phase, attenuates):
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(np.ones((2, 2, 2, 6), dtype=np.float32))}
    function = {"type": "sggx", "S": grid} if phase == "sggx" else {"type": "tabphase", "values": "1,2"}
    cube = {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": medium, "phase": function}}
    effect = effect_in(cube, "phase_function.S.data" if phase == "sggx" else "phase_function.values")
    assert (effect.moves_medium, effect.role) == (attenuates, "medium" if attenuates else "value")


@pytest.mark.parametrize(("weight", "lost"), [(0.0, True), (0.3, False)])
def test_a_lobe_of_weight_zero_needs_another_plugin(weight, lost):
    ball = {"type": "sphere", "bsdf": {"type": "principled", "clearcoat": weight, "metallic": weight}}
    for key, needed in (("clearcoat.value", lost), ("metallic.value", False)):
        effect = effect_in(ball, key)
        assert effect.stand_in == "diff_principled" and not effect.biased
        assert effect.stand_in_needed == needed
    assert effect_in(ball, "base_color.value").stand_in == ""


@pytest.mark.parametrize(("key", "lost", "kept"), [
    ("specular", (0.0, 1e-3), (5e-4, 1.5e-3, 0.5)), ("eta", (1.0, 1.001), (1.0005, 1.0015, 1.3)),
])  # fmt: skip
def test_an_index_of_one_needs_another_plugin(key, lost, kept):
    """And what Mitsuba takes for one; beside it, its own has the derivative."""
    for value in (*lost, *kept):
        ball = {"type": "sphere", "bsdf": {"type": "principled", "spec_trans": 0.5, key: value}}
        effect = effect_in(ball, f"bsdf.{key}")
        assert effect.stand_in == "diff_principled" and effect.stand_in_needed == (value in lost), value


def test_only_the_numbers_of_a_colour_are_coefficients():
    mi.set_variant("llvm_ad_spectral")
    texture = mi.load_dict({"type": "rgb", "value": [0.5, 0.4, 0.3]})
    assert "coefficients" in effect_of(texture, "value").reason
    assert effect_of(texture, "to_uv").reason == CORRECT
