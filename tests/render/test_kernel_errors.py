"""What goes wrong while a kernel is traced is an error with its reason, and what comes after it is right."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.gradient_cases.scenes import room
from torchtransient.errors import GradientError, SceneError
from torchtransient.render.kernel_errors import named_errors


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def picture(channels):
    return {"type": "bitmap", "data": np.full((2, 2, channels), 0.4, np.float32), "raw": True}


def volume(channels):
    return {"type": "volume", "volume": {"type": "gridvolume", "data": np.full((2, 2, 2, channels), 0.4, np.float32)}}


MATTE = {"type": "diffuse", "reflectance": 0.5}
# Surface, variant and a word of the reason.
WRONG = {
    "colours in a spectral variant": (lambda: {"type": "diffuse", "reflectance": picture(3)}, "spectral", "raw=true"),
    "normals of one channel": (lambda: {"type": "normalmap", "normalmap": picture(1), "nested": MATTE}, "rgb", "channel"),
    "a volume of six": (lambda: {"type": "diffuse", "reflectance": volume(6)}, "rgb", "channel"),
}


@pytest.mark.parametrize("name", WRONG)
def test_textures_of_other_sizes(name):
    make, kind, word = WRONG[name]
    scene = tt.load(room(bsdf=make()), variant=f"llvm_ad_{kind}")
    for _ in range(2):
        with pytest.raises(SceneError, match=f"(?s)cannot be rendered.*{word}"):
            tt.render(scene, spp=1, seed=0)
    right = tt.load(room(), variant=f"llvm_ad_{kind}")
    assert float(tt.render(right, spp=4, seed=0).steady.sum()) > 0


def test_forward_mode_after_an_error():
    """What is attached does not live on in the frames of an exception that somebody holds."""
    key, right = "wall.bsdf.reflectance.value", tt.load(room(), variant="llvm_ad_rgb")
    value = torch.tensor(0.5)

    def slope():
        return torch.func.jvp(lambda x: tt.render(right, {key: x}, spp=64, seed=0).steady.sum(), (value,), (value,))[1]

    expected = slope()
    wrong = tt.load(room(bsdf={"type": "normalmap", "normalmap": picture(1), "nested": MATTE}), variant="llvm_ad_rgb")
    nested = "wall.bsdf.nested_bsdf.reflectance.value"
    with pytest.raises(SceneError) as held:
        torch.func.jvp(lambda x: tt.render(wrong, {nested: x}, spp=4, seed=0).steady.sum(), (value,), (value,))
    assert held.value is not None and slope() == pytest.approx(expected)


@named_errors()
def traced(reason):
    """What Dr.Jit makes of an exception inside a loop."""
    try:
        raise reason
    except type(reason) as error:
        raise RuntimeError("dr.while_loop(): encountered an exception (see above).") from error


def test_the_first_reason_is_named():
    with pytest.raises(SceneError, match=r"ValueError.*: no such lobe"):
        traced(ValueError("no such lobe"))


def test_errors_of_this_library_are_raised_as_they_are():
    reason = GradientError("not this one")
    with pytest.raises(GradientError) as found:
        traced(reason)
    assert found.value is reason


def test_other_errors_are_left_alone():
    with pytest.raises(RuntimeError, match=r"^elsewhere$"), named_errors():
        raise RuntimeError("elsewhere")
