"""What parametrizations owe: there and back, derivatives, batches, precisions, torch's machinery. One entry each."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn.utils import parametrize as torch_parametrize

from support.marks import long
from torchtransient import parametrize
from torchtransient.errors import ShapeError, TorchTransientError
from torchtransient.scenes import rotate, scale, translate

BASE = translate([0.3, -0.5, 2.0]) @ rotate([1.0, 2.0, -1.0], 40.0) @ scale([0.2, 1.5, 0.7])
MOVED = translate([0.1, 0.2, -0.3]) @ rotate([0.0, 1.0, 0.3], 25.0)
WAVELENGTHS = np.linspace(400.0, 700.0, 16)
CURVE = torch.linspace(-1.0, 1.0, 16, dtype=torch.float64)
SHARES = torch.tensor([0.02, 0.4, 0.97], dtype=torch.float64)


def pose(matrix):
    return torch.tensor(np.asarray(matrix))


# (parametrization, a value that it can have)
CASES = {
    "Bounded": (parametrize.Bounded(-2.0, 3.0), torch.tensor([-1.9, 0.0, 2.5], dtype=torch.float64)),
    "Bounded by tensors": (parametrize.Bounded([0.0, 1, 2], torch.tensor([1.0, 2, 4])), SHARES + torch.arange(3)),
    "Albedo": (parametrize.Albedo(), SHARES),
    "Roughness": (parametrize.Roughness(), torch.tensor(0.1, dtype=torch.float64)),
    "IndexOfRefraction": (parametrize.IndexOfRefraction(), torch.tensor(1.5, dtype=torch.float64)),
    "Anisotropy": (parametrize.Anisotropy(), torch.tensor(-0.7, dtype=torch.float64)),
    "Positive": (parametrize.Positive(), torch.tensor([1e-3, 1.0, 50.0], dtype=torch.float64)),
    "Positive above 2": (parametrize.Positive(2.0, scale=0.1), torch.tensor([2.01, 3.0], dtype=torch.float64)),
    "Positive by exp": (parametrize.Positive(0.0, 3.0, "exp"), torch.tensor([1e-6, 1e4], dtype=torch.float64)),
    "PositiveSpectrum": (parametrize.PositiveSpectrum(WAVELENGTHS, 6), torch.exp(0.5 - CURVE)),
    "ReflectanceSpectrum": (parametrize.ReflectanceSpectrum(WAVELENGTHS, 6), torch.sigmoid(CURVE)),
    "Simplex": (parametrize.Simplex(), torch.tensor([0.1, 0.2, 0.7], dtype=torch.float64)),
    "AxisAnglePose": (parametrize.AxisAnglePose(), pose(MOVED)),
    "AxisAnglePose of a base": (parametrize.AxisAnglePose(BASE), pose(MOVED @ BASE)),
    "AxisAnglePose about a point": (parametrize.AxisAnglePose(BASE, about=[1.0, 0.0, 0.0]), pose(MOVED @ BASE)),
    "AxisAnglePose, local": (parametrize.AxisAnglePose(BASE, frame="local"), pose(BASE @ MOVED)),
    "AxisAnglePose in millimetres": (parametrize.AxisAnglePose(BASE, about="world", length_scale=1e-3),
        pose(MOVED @ BASE)),
    "SE3Pose": (parametrize.SE3Pose(BASE), pose(MOVED @ BASE)),
    "SE3Pose, local, about a point": (parametrize.SE3Pose(BASE, about=[1.0, 0.0, 0.0], frame="local"),
        pose(BASE @ MOVED)),
}  # fmt: skip
ALL = pytest.mark.parametrize("name", CASES)


class Holder(nn.Module):
    """A module with a parameter whose name is one of Mitsuba's keys."""

    def __init__(self, value):
        super().__init__()
        self.register_parameter("box/key", nn.Parameter(value.clone()))


@ALL
def test_there_and_back(name):
    function, value = CASES[name]
    x = function.right_inverse(value)
    assert x.dtype == value.dtype
    assert torch.allclose(function(x), value, rtol=1e-12, atol=1e-13)
    assert torch.allclose(function.right_inverse(function(x)), x, rtol=1e-9, atol=1e-9)


@ALL
@pytest.mark.parametrize("place", long(["value", "zero", "far"], ["value", "zero"]))
def test_derivatives(name, place):
    function, value = CASES[name]
    x = function.right_inverse(value)
    x = {"value": x, "zero": torch.zeros_like(x), "far": torch.full_like(x, 1.7)}[place].requires_grad_()
    assert torch.autograd.gradcheck(function, (x,), check_forward_ad=True, fast_mode=True, check_undefined_grad=False)
    if place == "zero":
        assert torch.autograd.gradgradcheck(function, (x,), fast_mode=True, check_undefined_grad=False)


@ALL
def test_batches(name):
    function, value = CASES[name]
    x = function.right_inverse(value)
    many = torch.stack([x, x + 0.1, x - 0.2])
    alone = torch.stack([function(one) for one in many])
    assert torch.allclose(function(many), alone, rtol=1e-12, atol=1e-14)
    assert torch.allclose(function.right_inverse(alone), many if "Simplex" not in name else x.expand(3, -1), atol=1e-9)
    none = many[:0]
    assert function(none).shape == (0, *value.shape) and function.right_inverse(alone[:0]).shape == none.shape


@ALL
def test_torch_registers_it(name):
    function, value = CASES[name]
    module = torch_parametrize.register_parametrization(Holder(value), "box/key", copy.deepcopy(function))
    assert torch.allclose(getattr(module, "box/key"), value, atol=1e-12)
    state = copy.deepcopy(module.state_dict())
    optimizer = torch.optim.SGD(module.parameters(), lr=0.1)
    weights = torch.arange(1.0, value.numel() + 1, dtype=value.dtype).reshape(value.shape)
    (getattr(module, "box/key") * weights).sum().backward()
    optimizer.step()
    assert not torch.allclose(getattr(module, "box/key"), value, atol=1e-5)
    module.load_state_dict(state)
    assert torch.allclose(getattr(module, "box/key"), value, atol=1e-12)
    assert sum(parameter.numel() for parameter in module.parameters()) == function.right_inverse(value).numel()


@ALL
def test_pickle_and_precision_of_the_module(name):
    function, value = CASES[name]
    x = function.right_inverse(value)
    twin = pickle.loads(pickle.dumps(function))
    assert torch.equal(twin(x), function(x)) and repr(twin) == repr(function)
    single = twin.float()
    assert torch.allclose(single(x.float()).double(), function(x), rtol=1e-5, atol=1e-5)
    assert torch.allclose(single(single.right_inverse(value.float())).double(), value, rtol=1e-5, atol=2e-6)


@ALL
def test_what_it_refuses(name):
    function, value = CASES[name]
    for wrong in (None, torch.ones(3, dtype=torch.long), value.to(torch.complex64)):
        with pytest.raises(ShapeError, match="expected"):
            function(wrong)
        with pytest.raises(ShapeError, match="expected"):
            function.right_inverse(wrong)
    with pytest.raises(TorchTransientError, match="expected"):
        function.right_inverse(torch.full_like(value, torch.nan))
