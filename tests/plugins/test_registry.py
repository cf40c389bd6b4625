"""Plugins are there in whichever variant is active, whenever it was chosen."""

from __future__ import annotations

import subprocess
import sys
import textwrap

import mitsuba as mi
import pytest

from torchtransient import plugins
from torchtransient.errors import PluginRegistrationError, VariantError
from torchtransient.plugins import _registry

JIT_VARIANTS = (
    "llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_mono_polarized", "llvm_ad_spectral_polarized",
)  # fmt: skip


@pytest.fixture(autouse=True)
def _restore():
    """Each test starts in llvm_ad_rgb and leaves no third-party module behind."""
    mi.set_variant("llvm_ad_rgb")
    yield
    _registry._state.third_party = []
    _registry._state.variant = None
    mi.set_variant("llvm_ad_rgb")
    plugins.sync()


def build(name):
    with plugins.plugin_errors():
        return mi.load_dict({"type": name})


def run(code):
    result = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    return result.stdout.split()


@pytest.mark.parametrize("variant", JIT_VARIANTS)
def test_every_plugin_belongs_to_the_active_variant(variant):
    mi.set_variant(variant)
    plugins.sync()
    assert isinstance(build("transient_hdr_film"), mi.Film)
    assert isinstance(build("transient_path"), mi.Integrator)
    assert isinstance(build("diff_dielectric"), mi.BSDF)
    assert isinstance(build("diff_rough_dielectric"), mi.BSDF)


def test_a_plugin_is_imported_at_its_first_use():
    """Hair is built on the class of plastic: both are imported by one use, and belong to each later variant."""
    found = run(
        """
        import sys
        import torchtransient
        import mitsuba as mi
        def loaded():
            return sum(f"torchtransient.plugins.bsdfs.{name}" in sys.modules for name in ("hair", "plastic", "delayed"))
        mi.set_variant("llvm_ad_rgb")
        print(loaded())
        rgb = type(mi.load_dict({"type": "diff_hair"}))
        print(loaded())
        mi.set_variant("llvm_ad_spectral")
        for plugin in ("diff_hair", "diff_plastic"):
            made = mi.load_dict({"type": plugin})
            print(isinstance(made, mi.BSDF), isinstance(made, rgb))
        """
    )
    assert found == ["0", "2", "True", "False", "True", "False"]


THIRD_PARTY = """
import drjit as dr
import mitsuba as mi
from torchtransient.plugins import register
class Dim(mi.Texture):
    def __init__(self, props):
        super().__init__(props)
    def to_string(self):
        return "Dim of " + mi.variant()
register("texture", "dim", Dim)
"""


@pytest.fixture
def third_party(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # a module rewritten within a second would look unchanged

    def write(text, name="their_texture"):
        (tmp_path / f"{name}.py").write_text(text)
        sys.modules.pop(name, None)
        return name

    yield write
    for name in ("their_texture", "their_rival"):
        sys.modules.pop(name, None)


def test_third_party_module_follows_the_variant(third_party):
    plugins.register_module(third_party(THIRD_PARTY), (("texture", "dim"),))
    assert str(build("dim")) == "Dim of llvm_ad_rgb"
    with mi.variant_context("llvm_ad_mono"):
        assert str(build("dim")) == "Dim of llvm_ad_mono"
    with mi.variant_context("scalar_rgb"), pytest.raises(VariantError, match="texture plugin 'dim'"):
        build("dim")


def test_broken_third_party_module_is_refused_and_forgotten(third_party):
    with pytest.raises(PluginRegistrationError, match=r"their_texture.*llvm_ad_rgb.*ZeroDivisionError"):
        plugins.register_module(third_party("1 / 0"))
    assert plugins.sync() == "llvm_ad_rgb"
    build("transient_path")


def test_failure_during_a_switch_warns_and_is_raised_by_the_next_call(third_party):
    name = third_party(THIRD_PARTY)
    plugins.register_module(name)
    text = THIRD_PARTY + "\nif mi.variant() == 'llvm_ad_mono':\n    raise OSError('no table for mono')\n"
    path = sys.modules[name].__file__
    with open(path, "w") as f:
        f.write(text)
    with pytest.warns(RuntimeWarning, match="no table for mono"):
        mi.set_variant("llvm_ad_mono")
    assert mi.variant() == "llvm_ad_mono"
    for _ in range(2):
        with pytest.raises(PluginRegistrationError, match="no table for mono"):
            plugins.sync()
    mi.set_variant("llvm_ad_rgb")
    assert plugins.sync() == "llvm_ad_rgb"


# ------------------------------------------------------------------------------------------- first use, several threads


def test_a_module_loads_a_scene_of_other_plugins_while_it_is_executed(tmp_path):
    """Mitsuba builds the parts of a scene in threads of its own."""
    (tmp_path / "loads_a_scene.py").write_text(
        textwrap.dedent(
            """
            import mitsuba as mi
            from torchtransient.plugins import register
            mi.load_dict({
                "type": "scene", "a": {"type": "sphere", "bsdf": {"type": "diff_hair"}},
                "b": {"type": "sphere", "bsdf": {"type": "diff_plastic"}},
            })
            class Mine(mi.BSDF):
                def __init__(self, props):
                    mi.BSDF.__init__(self, props)
            register("bsdf", "mine", Mine)
            """
        )
    )
    assert run(
        f"""
        import sys
        sys.path.insert(0, {str(tmp_path)!r})
        from torchtransient import plugins
        import mitsuba as mi
        mi.set_variant("llvm_ad_rgb")
        plugins.register_module("loads_a_scene")
        print(type(mi.load_dict({{"type": "mine"}})).__name__)
        """
    ) == ["Mine"]


def test_mitsuba_keeps_the_constructors_that_its_threads_call(tmp_path):
    """A module of the library that is imported while another one is executed hands Mitsuba no second constructor."""
    (tmp_path / "loads_hair.py").write_text(
        textwrap.dedent(
            """
            import mitsuba as mi
            first, again = mi.register_bsdf, []
            mi.register_bsdf = lambda name, constructor: (first(name, constructor), again.append(name))[0]
            mi.load_dict({"type": "diff_hair"})
            mi.register_bsdf = first
            """
        )
    )
    assert run(
        f"""
        import sys
        sys.path.insert(0, {str(tmp_path)!r})
        from torchtransient import plugins
        import mitsuba as mi
        mi.set_variant("llvm_ad_rgb")
        plugins.register_module("loads_hair")
        print(len(sys.modules["loads_hair"].again))
        """
    ) == ["0"]



def test_a_scene_may_be_freed_before_its_render_is_read():
    """Spheres are met through their addresses: what is rendered must not wait for the scene to be gone."""
    assert run(
        """
        import numpy as np
        import torchtransient
        import mitsuba as mi
        mi.set_variant("llvm_ad_rgb")
        film = {"type": "transient_hdr_film", "width": 32, "height": 32, "temporal_bins": 8, "bin_width_opl": 2.0}
        for _ in range(6):
            steady, _ = mi.render(mi.load_dict({
                "type": "scene", "integrator": {"type": "transient_path", "max_depth": 3},
                "sensor": {"type": "perspective", "film": film},
                "light": {"type": "point"}, "ball": {"type": "sphere", "center": [0, 0, 5]},
            }), spp=4)
            print(np.isfinite(np.array(steady)).all())
        """
    ) == ["True"] * 6
