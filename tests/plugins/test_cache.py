"""What follows from the numbers of plugins is computed again when one of them is replaced, and only then."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

from support.plain_scenes import as_mitsuba
from torchtransient import plugins
from torchtransient.plugins.cache import Cache
from torchtransient.plugins.frozen_state import arrays_below
from torchtransient.scenes import cornell_box


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_mono")
    plugins.sync()


def box():
    return mi.load_dict(as_mitsuba(cornell_box(resolution=4, num_bins=40, bin_width_opl=0.2)), optimize=False)


class Counted:
    """A computation that counts how often it is made."""

    def __init__(self):
        self.times = 0

    def __call__(self):
        self.times += 1
        return self.times


def moved(params, key):
    """The value of a parameter, shifted."""
    value = params[key]
    if "Transform" in type(value).__name__:
        return mi.Transform4f().translate([0.1, 0, 0]) @ value
    return value + 0.1


@pytest.mark.parametrize("key", ["red-wall.to_world", "small-box.vertex_positions", "sensor.x_fov"])
def test_replaced_numbers(key):
    scene, compute = box(), Counted()
    cache, params = Cache([*scene.shapes(), *scene.sensors()]), mi.traverse(scene)
    assert [cache.get("", None, compute) for _ in range(3)] == [1, 1, 1]
    params[key] = moved(params, key)
    params.update()
    assert [cache.get("", None, compute) for _ in range(3)] == [2, 2, 2]
    # Others have nothing to do with it.
    scene.integrator().render(scene, spp=1)
    params["red.reflectance.value"] = params["red.reflectance.value"] * 0.5
    params.update()
    assert cache.get("", None, compute) == 2


def test_array_that_is_written_in_place():
    scene, compute = box(), Counted()
    cache, params = Cache(scene.shapes()), mi.traverse(scene)
    cache.get("", None, compute)
    positions = params["small-box.vertex_positions"]
    dr.scatter(positions, mi.Float(3), mi.UInt32(0))
    params["small-box.vertex_positions"] = positions
    params.update()
    assert cache.get("", None, compute) == 2


def test_attached_numbers_are_the_same_numbers():
    """Where derivatives are asked for is no other state of the scene; the value is detached."""
    scene, compute = box(), Counted()
    cache, params = Cache(scene.shapes()), mi.traverse(scene)
    cache.get("", None, compute)
    dr.enable_grad(params["small-box.vertex_positions"])
    assert cache.get("", None, compute) == 1


def test_plugins_written_in_python_show_their_numbers_anew():
    """A film's layout is a plain number of its own."""
    scene, compute = box(), Counted()
    film = scene.sensors()[0].film()
    cache = Cache([film])
    cache.get("", None, compute)
    assert cache.get("", None, compute) == 1
    film.start_opl = 0.5
    assert cache.get("", None, compute) == 2


def test_plain_numbers_that_count_too():
    compute, cache = Counted(), Cache([])
    assert [cache.get("", also, compute) for also in ((1, 2), (1, 2), (1, 3))] == [1, 1, 2]


def test_nothing_is_kept_of_a_computation_that_failed():
    def fail():
        raise ValueError("no")

    compute, cache = Counted(), Cache([])
    with pytest.raises(ValueError, match="no"):
        cache.get("", None, fail)
    assert cache.get("", None, compute) == 1


def test_recordings_compute_for_themselves():
    compute, cache = Counted(), Cache([])
    cache.get("", None, compute)
    with dr.scoped_set_flag(dr.JitFlag.FreezingScope, True):
        assert [cache.get("", None, compute), cache.get("", None, compute)] == [2, 3]
    assert cache.get("", None, compute) == 1


def test_what_is_held_is_no_state_of_kernels():
    scene = box()
    cache = Cache(scene.shapes())
    cache.get("", None, lambda: mi.Float(1, 2))
    assert arrays_below([cache]) == []
