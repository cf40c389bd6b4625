"""Look-ups by plugin pointer: values, derivatives, defaults."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

from torchtransient.errors import SceneError
from torchtransient.plugins.kernel_arrays import PointerTable, registry_number


@pytest.fixture(autouse=True)
def rgb():
    mi.set_variant("llvm_ad_rgb")


@pytest.fixture
def plugins():
    return [mi.load_dict({"type": kind}) for kind in ("diffuse", "conductor", "plastic")]


def pointers(plugins):
    numbers = mi.UInt32([0, *(registry_number(plugin) for plugin in plugins)])
    return dr.reinterpret_array(mi.BSDFPtr, numbers)


def test_values_by_plugin(plugins):
    table = PointerTable(plugins[1:], [7, 9])
    assert dr.all(table.look_up(pointers(plugins)) == mi.UInt32([0, 0, 7, 9]))
    assert dr.all(table.look_up(pointers(plugins), mi.Mask([True, True, False, True])) == mi.UInt32([0, 0, 0, 9]))


def test_default_for_all_others(plugins):
    table = PointerTable(plugins[:1], [mi.Float(0.25)], default=1)
    assert dr.all(table.look_up(pointers(plugins)) == mi.Float([1, 0.25, 1, 1]))
    assert dr.all(table.look_up(pointers(plugins), False) == 1)


def test_plugins_made_later_are_not_listed(plugins):
    table = PointerTable.marking(plugins)
    late = mi.load_dict({"type": "diffuse"})
    assert dr.all(table.lists(pointers([*plugins, late])) == mi.Mask([False, True, True, True, False]))


def test_nothing_to_mark():
    assert PointerTable.marking([]) is None


def test_derivatives_go_through(plugins):
    x, y = mi.Float(2), mi.Float(3)
    dr.enable_grad(x, y)
    table = PointerTable(plugins[:2], [x, y], default=1)
    found = table.look_up(pointers(plugins))
    dr.backward(dr.sum(found * mi.Float(10, 20, 30, 40)))
    assert (dr.grad(x)[0], dr.grad(y)[0]) == (20, 30)


def test_numbers_of_every_kind():
    scene = mi.load_dict({"type": "scene", "light": {"type": "point"}, "ball": {"type": "sphere"}})
    assert registry_number(scene.shapes()[0]) > 0 and registry_number(scene.emitters()[0]) > 0
    table = PointerTable(scene.emitters(), [5])
    assert dr.all(table.look_up(mi.EmitterPtr(scene.emitters()[0])) == 5)
    with pytest.raises(SceneError, match="BSDF, Emitter"):
        registry_number(scene)
