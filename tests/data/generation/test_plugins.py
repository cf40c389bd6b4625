"""Mitsuba plugins of others: in the processes that render too, and told apart when their source changes."""

from __future__ import annotations

import sys

import mitsuba as mi
import pytest

import torchtransient as tt
from support.fake_recipe import FakeRecipe
from torchtransient import plugins
from torchtransient.data import OnlineDataset, generate, verify
from torchtransient.data.processes import registered_plugins
from torchtransient.data.run_settings import RunSettings
from torchtransient.data.shard_making import ShardMaker
from torchtransient.errors import PluginRegistrationError, SceneError, StorageError
from torchtransient.plugins import _registry

PAINT = """
import mitsuba as mi
from torchtransient.plugins import register

class Paint(mi.Texture):
    def __init__(self, props):
        super().__init__(props)
        self.gain = mi.Float(props.get("gain", 0.5))

    def traverse(self, callback):
        callback.put("gain", self.gain, mi.ParamFlags.Differentiable)

    def eval(self, si, active=True):
        return mi.UnpolarizedSpectrum(self.gain)

    def mean(self):
        return self.gain

register("texture", "their_paint", Paint)
"""
QUICK = {"n": 4, "per_shard": 2, "workers": 1, "progress": False}


@pytest.fixture
def theirs(tmp_path, monkeypatch):
    """The folder of a module that can be imported, and its name; nobody knows of it afterwards."""
    place = tmp_path / "modules"
    place.mkdir()
    (place / "their_paint_module.py").write_text(PAINT)
    monkeypatch.syspath_prepend(place)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    mi.set_variant("llvm_ad_mono")
    # Other tests have modules of their own.
    others, _registry._state.third_party = _registry._state.third_party, []
    yield place / "their_paint_module.py"
    sys.modules.pop("their_paint_module", None)
    _registry._state.third_party = others
    _registry._state.variant = None


def painted(**more):
    scene = tt.scenes.cornell_box(resolution=8, num_bins=60, bin_width_opl=0.2, start_opl=2.0)
    scene["red"] = {"type": "diffuse", "reflectance": {"type": "their_paint", "gain": 0.3}}
    vary = {"red.reflectance.gain": tt.data.Uniform(0.1, 0.9)}
    return tt.data.Recipe(scene, vary, variant="llvm_ad_mono", spp=4, **more)


def settings_of(recipe, folder, added):
    return RunSettings(recipe, str(folder), 4, "exact", "blosc2", 0, added)


def test_what_is_registered_is_handed_on(theirs, tmp_path):
    assert registered_plugins() == ()
    plugins.register_module(theirs.stem, (("texture", "their_paint"),))
    added = registered_plugins()
    assert added == (("their_paint_module", (("texture", "their_paint"),)),)
    _registry._state.third_party = []
    with tt.threads(1):
        ShardMaker(settings_of(FakeRecipe(), tmp_path, added)).close()
        wanted = r"the process that renders cannot use the plugin module 'their\.absent': .* PYTHONPATH"
        with pytest.raises(PluginRegistrationError, match=wanted):
            ShardMaker(settings_of(FakeRecipe(), tmp_path, (("their.absent", ()),)))
    assert registered_plugins() == added


def test_recipes_name_their_modules(theirs):
    recipe = painted(plugins=[theirs.stem])
    assert recipe.to_dict()["plugins"] == ["their_paint_module"]
    _registry._state.third_party = []
    again = tt.data.Recipe.from_dict(recipe.to_dict())
    assert again == recipe and registered_plugins() == (("their_paint_module", ()),)
    before = recipe.maker().about()["versions"]["their_paint_module"]
    assert before.startswith("sha256 ")
    theirs.write_text(PAINT.replace("trum(self.gain)", "trum(self.gain / 2)"))
    assert recipe.maker().about()["versions"]["their_paint_module"] != before
    with pytest.raises(SceneError, match="plugins: expected several names of modules in a list"):
        painted(plugins="their_paint_module")
    with pytest.raises(PluginRegistrationError, match="no module named"):
        painted(plugins=["their_absent_module"])


@pytest.mark.slow
def test_other_processes_have_them(theirs, tmp_path):
    plugins.register_module(theirs.stem)
    recipe = painted()
    assert generate(recipe, tmp_path / "set", **QUICK).samples == 4
    with OnlineDataset(recipe, capacity=4, warm=1) as data:
        assert data.draw()["transient"].shape == (1, 60, 8, 8)
    # Another source makes other samples: they are not put beside these.
    (tmp_path / "set" / "shard-000001.h5").unlink()
    theirs.write_text(PAINT.replace("trum(self.gain)", "trum(self.gain / 2)"))
    with pytest.raises(StorageError, match="versions is"):
        generate(recipe, tmp_path / "set", **QUICK)
    assert verify(tmp_path / "set").missing == (2, 3)


@pytest.mark.slow
def test_a_module_that_other_processes_do_not_find(theirs, tmp_path):
    """Its name is in the error, which is that of a recipe made there."""
    recipe = painted(plugins=[theirs.stem])
    theirs.unlink()
    wanted = "no module named 'their_paint_module'"
    with pytest.raises(PluginRegistrationError, match=wanted):
        generate(recipe, tmp_path / "set", **QUICK)
    with OnlineDataset(recipe, capacity=4, warm=1) as data, pytest.raises(PluginRegistrationError, match=wanted):
        data.draw()
