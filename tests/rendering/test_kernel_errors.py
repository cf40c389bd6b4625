"""What goes wrong while a kernel is traced is an error with its reason, and what comes after it is right."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.gradient_cases.scenes import room
from torchtransient.errors import GradientError, SceneError


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


@pytest.fixture
def unreadable():
    """A scene that Mitsuba finds wrong when it is traced: a six-channel albedo of a medium."""
    grid = {"type": "gridvolume", "data": np.full((2, 2, 2, 6), 0.4, np.float32), "raw": True}
    fog = {"type": "heterogeneous", "sigma_t": {"type": "constvolume", "value": 0.5}, "albedo": grid}
    scene = room(fog={"type": "cube", "bsdf": {"type": "null"}, "interior": fog})
    scene["integrator"]["type"] = "transient_prbvolpath"
    return scene


def test_a_reason_inside_a_kernel(unreadable):
    """Calls are recorded from the second one on."""
    renderer = tt.TransientRenderer(tt.load(unreadable, variant="llvm_ad_rgb"), spp=1)
    said = []
    for seed in range(3):
        with pytest.raises(SceneError, match=r"cannot be rendered.*channels") as caught:
            renderer(seed=seed)
        said.append(str(caught.value))
    assert len(set(said)) == 1


@pytest.mark.slow
def test_forward_mode_after_an_error(unreadable):
    """What is attached does not live on in the frames of an exception that somebody holds."""
    key, right = "wall.bsdf.reflectance.value", tt.load(room(), variant="llvm_ad_rgb")
    value = torch.tensor([0.5, 0.4, 0.3])

    def slope(scene):
        return torch.func.jvp(lambda x: tt.render(scene, {key: x}, spp=64, seed=0).steady.sum(), (value,), (value,))[1]

    expected = slope(right)
    with pytest.raises(SceneError) as held:
        slope(unreadable)
    assert held.value is not None and slope(right) == pytest.approx(expected)


@pytest.mark.slow
def test_forward_mode_beside_a_scene_with_attached_values():
    """Calls are built into all objects alive: the tangent runs into values that somebody else attached."""
    key, right = "wall.bsdf.reflectance.value", tt.load(room(), variant="llvm_ad_rgb")
    value = torch.tensor([0.5, 0.4, 0.3])

    def slope():
        return torch.func.jvp(lambda x: tt.render(right, {key: x}, spp=64, seed=0).steady.sum(), (value,), (value,))[1]

    expected = slope()
    theirs = mi.load_dict(room(), optimize=False)
    params = mi.traverse(theirs)
    scale = mi.Float(1.0)
    dr.enable_grad(scale)
    params["side.bsdf.reflectance.value"] *= scale
    params.update()
    with pytest.raises(GradientError, match=r"attached.*Detach them"):
        slope()
    params["side.bsdf.reflectance.value"] = dr.detach(params["side.bsdf.reflectance.value"])
    params.update()
    assert slope() == pytest.approx(expected)
