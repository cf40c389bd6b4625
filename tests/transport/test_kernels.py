"""A kernel holds what its scene calls for and nothing else."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

from support.gradient_cases.scenes import room, transform

VARIANT = "llvm_ad_mono"
pytestmark = pytest.mark.usefixtures("no_leftovers")
KEY = "side.bsdf.reflectance.value"


def hashes(description, backward=False):
    """Hashes and operation counts of the kernels of a render, or of a backward pass to a colour."""
    scene = mi.load_dict(description, optimize=False)
    integrator, params = scene.integrator(), mi.traverse(scene)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        if backward:
            value = type(params[KEY])(params[KEY])
            dr.enable_grad(value)
            params[KEY] = value
            params.update()
            shape = scene.sensors()[0].film().cube_shape()
            integrator.render_backward(scene, params, (None, dr.ones(mi.TensorXf, shape)), seed=0, spp=4)
        else:
            dr.eval(integrator.render(scene, seed=0, spp=4))
        history = dr.kernel_history([dr.KernelType.JIT])
    largest = max(history, key=lambda entry: entry["operation_count"])
    return largest["hash"], largest["operation_count"]


def under(plugin, **changes):
    result = room(depth=4, **changes)
    result["integrator"] = result["integrator"] | {"type": plugin}
    return result


@pytest.mark.parametrize("backward", [False, True], ids=["render", "backward"])
def test_media_cost_nothing_where_there_are_none(backward):
    """The volumetric integrator compiles the kernel of the one for surfaces, down to the hash."""
    assert hashes(under("transient_prbvolpath"), backward) == hashes(under("transient_path"), backward)


def test_an_effect_is_in_the_kernel_of_its_scene_alone():
    """Scenes rendered before, with media, delays and delta lobes, leave the kernel of a plain one as it was."""
    plain = hashes(under("transient_path"))
    fog = under("transient_prbvolpath") | {"block": {
        "type": "cube", "to_world": transform().translate([0, 0, 1.5]).scale(0.5), "bsdf": {"type": "null"},
        "interior": {"type": "homogeneous", "sigma_t": 0.4, "albedo": 0.8}}}  # fmt: skip
    others = [
        hashes(fog),
        hashes(under("transient_path", bsdf={"type": "delayed", "lifetime": 0.3, "nested": {"type": "diffuse"}})),
        hashes(under("transient_path", bsdf={"type": "thindielectric"}), backward=True),
    ]
    assert all(operations > plain[1] for _, operations in others)
    assert hashes(under("transient_path")) == plain


def test_paths_are_traced_once_for_all_entries_of_a_pose():
    """Each entry of a pose is a sum over lanes, which are not computed anew for it."""
    described = under("transient_path")
    described["integrator"] |= {"boundary": False}  # the term has kernels of its own
    scene = mi.load_dict(described, optimize=False)
    params, shape = mi.traverse(scene), scene.sensors()[0].film().cube_shape()
    pose = mi.AffineTransform4f(params["sensor.to_world"])
    dr.enable_grad(pose.matrix)
    params["sensor.to_world"] = pose
    params.update()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        scene.integrator().render_backward(scene, params, (None, dr.ones(mi.TensorXf, shape)), seed=0, spp=4)
        dr.eval(dr.grad(params["sensor.to_world"].matrix))
        operations = sorted(entry["operation_count"] for entry in dr.kernel_history([dr.KernelType.JIT]))
    assert operations[-2] < 0.3 * operations[-1]
