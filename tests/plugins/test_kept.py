"""What follows from the numbers of plugins is computed again when one of them is replaced, and only then."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

from support.plain_scenes import as_mitsuba
from torchtransient import plugins
from torchtransient.plugins.frozen_state import arrays_below
from torchtransient.plugins.kept import Kept
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
    kept, params = Kept([*scene.shapes(), *scene.sensors()]), mi.traverse(scene)
    assert [kept.get(compute) for _ in range(3)] == [1, 1, 1]
    params[key] = moved(params, key)
    params.update()
    assert [kept.get(compute) for _ in range(3)] == [2, 2, 2]
    # Others have nothing to do with it.
    scene.integrator().render(scene, spp=1)
    params["red.reflectance.value"] = params["red.reflectance.value"] * 0.5
    params.update()
    assert kept.get(compute) == 2


def test_array_that_is_written_in_place():
    scene, compute = box(), Counted()
    kept, params = Kept(scene.shapes()), mi.traverse(scene)
    kept.get(compute)
    positions = params["small-box.vertex_positions"]
    dr.scatter(positions, mi.Float(3), mi.UInt32(0))
    params["small-box.vertex_positions"] = positions
    params.update()
    assert kept.get(compute) == 2


def test_attached_numbers_are_the_same_numbers():
    """Where derivatives are asked for is no other state of the scene; the value is detached."""
    scene, compute = box(), Counted()
    kept, params = Kept(scene.shapes()), mi.traverse(scene)
    kept.get(compute)
    dr.enable_grad(params["small-box.vertex_positions"])
    assert kept.get(compute) == 1


def test_plugins_written_in_python_show_their_numbers_anew():
    """A film's layout is a plain number of its own."""
    scene, compute = box(), Counted()
    film = scene.sensors()[0].film()
    kept = Kept([film])
    kept.get(compute)
    assert kept.get(compute) == 1
    film.start_opl = 0.5
    assert kept.get(compute) == 2


def test_plain_numbers_that_count_too():
    compute, kept = Counted(), Kept([])
    assert [kept.get(compute, also=also) for also in ([1, 2], [1, 2], [1, 3])] == [1, 1, 2]


def test_nothing_is_kept_of_a_computation_that_failed():
    def fail():
        raise ValueError("no")

    compute, kept = Counted(), Kept([])
    with pytest.raises(ValueError, match="no"):
        kept.get(fail)
    assert kept.get(compute) == 1


def test_recordings_compute_for_themselves():
    compute, kept = Counted(), Kept([])
    kept.get(compute)
    with dr.scoped_set_flag(dr.JitFlag.FreezingScope, True):
        assert [kept.get(compute), kept.get(compute)] == [2, 3]
    assert kept.get(compute) == 1


def test_what_is_held_is_no_state_of_kernels():
    scene = box()
    kept = Kept(scene.shapes())
    kept.get(lambda: mi.Float(1, 2))
    assert arrays_below([kept]) == []
