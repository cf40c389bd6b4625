"""Plugins that users write: what ``mi.render`` does with them, the layer, plans and files do, too."""

from __future__ import annotations

import sys

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.mitsuba_room import FILM, as_mitsuba
from tools.small_room import VARIANT as VARIANT
from tools.small_room import make_room
from torchtransient import plugins
from torchtransient.plugins import _registry

MODULE = "support.plugins_of_ones_own"
KEYS = ("light.power", "wall.bsdf.colour.level")


@pytest.fixture(autouse=True)
def _own():
    others = list(_registry._state.third_party)
    plugins.register_module(MODULE)
    yield
    _registry._state.third_party = others
    _registry._state.variant = None
    plugins.sync()


def room():
    made = make_room()
    made["sensor"]["film"] |= FILM | {"rfilter": {"type": "box"}}
    made["integrator"] = {"type": "walker", "max_depth": 3}
    made["light"] = {"type": "spark", "power": 4.0}
    made["wall"]["bsdf"] = {"type": "paint", "colour": {"type": "stripes", "level": 0.6}}
    return made


def test_the_layer_renders_what_mitsuba_renders():
    scene = tt.load(room(), variant=VARIANT)
    found = tt.TransientRenderer(scene, spp=256, physics="ignore", temporal_filter="tent")(seed=0)
    expected = np.array(mi.render(mi.load_dict(as_mitsuba(room())), spp=256, seed=1)[1])
    assert found.stats.integrator == "walker"
    assert float(found.transient.sum()) == pytest.approx(expected.sum(), rel=0.02)


@pytest.mark.slow
def test_derivatives():
    key = KEYS[1]
    renderer = tt.TransientRenderer(room(), parameters=[key], spp=64, physics="ignore", grad_seed="same")
    renderer(seed=0).transient.sum().backward()
    found, start = float(renderer.values[key].grad), renderer.values[key].detach()
    with torch.no_grad():
        low, high = (float(renderer({key: start + step}, seed=0).transient.sum()) for step in (-0.05, 0.05))
    assert found == pytest.approx((high - low) / 0.1, rel=0.02) and found > 0


@pytest.mark.slow
def test_plans_keep_an_integrator_of_ones_own_and_see_no_colour_in_it():
    plan = tt.plan(room())
    assert plan.integrator == "walker" and not any("'walker'" in reason for reason in plan.reasons)


def test_files_name_the_kind_of_every_plugin(tmp_path):
    """Of those, too, that were registered with Mitsuba alone."""
    own = sys.modules[MODULE]
    mi.register_bsdf("bare", own.Paint)
    mi.register_emitter("bare_light", own.Spark)
    made = room()
    made["box"]["bsdf"], made["fill"] = {"type": "bare"}, {"type": "bare_light"}
    scene = tt.load(made, variant=VARIANT)
    again = tt.load(scene.save(tmp_path / "own.xml", {KEYS[0]: 2.5}), variant=VARIANT)
    text = (tmp_path / "own.xml").read_text()
    for tag in ('<integrator type="walker"', '<emitter type="spark"', '<bsdf type="paint"', '<texture type="stripes"'):
        assert tag in text
    assert '<bsdf type="bare"' in text and '<emitter type="bare_light"' in text
    assert again.parameters()[KEYS[0]].value == 2.5 and again.parameters().keys() == scene.parameters().keys()
