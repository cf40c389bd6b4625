"""What parametrizations owe: there and back, derivatives, batches, precisions, torch's machinery. One entry each; and
every function of `tt.parametrize` and `tt.geometry`.
"""

from __future__ import annotations

import copy
import inspect
import pickle

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn.utils import parametrize as torch_parametrize

from support.marks import long
from support.sweeps import together
from torchtransient import geometry, parametrize
from torchtransient.errors import ShapeError, TorchTransientError
from torchtransient.scenes import look_at, rotate, scale, translate

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
    "PrincipledRoughness": (parametrize.PrincipledRoughness(), SHARES[1:]),
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


# -------------------------------------------------- every function, in autocast, in half precision, under vmap


def numbers(*shape, low=0.1, high=0.9):
    return low + (high - low) * torch.rand(shape, generator=torch.Generator().manual_seed(1))


POSE = torch.tensor(look_at([1.0, 2.0, 3.0], [0.2, 0.5, 0.0]), dtype=torch.float32)
LIGHT = torch.tensor([0.3, 0.1, 2.0])
MATRIX = geometry.intrinsics(50.0, (4, 5))
SIX = numbers(3, 6, low=-1.0, high=1.0)
POSES = parametrize.pose_from_axis_angle(SIX)
IMAGES = numbers(3, 4, 5, low=1.0, high=3.0)
WEIGHTS = torch.softmax(numbers(3, 4), -1)
TENTHS = numbers(3, 5)

# name: (function of a batch, the batch)
CALLS = {
    "bounded": (lambda x: parametrize.bounded(x, -1.0, 2.0), SIX),
    "bounded_inverse": (parametrize.bounded_inverse, TENTHS),
    "positive": (parametrize.positive, SIX),
    "positive_inverse": (parametrize.positive_inverse, TENTHS),
    "simplex": (parametrize.simplex, SIX),
    "simplex_inverse": (parametrize.simplex_inverse, WEIGHTS),
    "pose_from_axis_angle": (parametrize.pose_from_axis_angle, SIX),
    "axis_angle_from_pose": (parametrize.axis_angle_from_pose, POSES),
    "pose_from_twist": (parametrize.pose_from_twist, SIX),
    "twist_from_pose": (parametrize.twist_from_pose, POSES),
    "intrinsics": (lambda x: geometry.intrinsics(20 + 30 * x, (4, 5)), TENTHS[:, 0]),
    "extrinsics": (geometry.extrinsics, POSES),
    "to_world_from_extrinsics": (geometry.to_world_from_extrinsics, POSES),
    "camera_to_world": (geometry.camera_to_world, POSES),
    "ray_directions": (lambda x: geometry.ray_directions(x, (4, 5), POSE), MATRIX + 0.1 * numbers(3, 3, 3)),
    "distance_from_z_depth": (lambda x: geometry.distance_from_z_depth(x, MATRIX), IMAGES),
    "z_depth_from_distance": (lambda x: geometry.z_depth_from_distance(x, MATRIX), IMAGES),
    "points_from_distance": (lambda x: geometry.points_from_distance(x, MATRIX, POSE), IMAGES),
    "opl_from_distance": (lambda x: geometry.opl_from_distance(x, MATRIX, POSE, light=LIGHT), IMAGES),
    "distance_from_opl": (lambda x: geometry.distance_from_opl(x + 4, MATRIX, POSE, light=LIGHT), IMAGES),
    "normals_from_distance": (lambda x: geometry.normals_from_distance(x, MATRIX, POSE), IMAGES),
}  # fmt: skip
for key, (module, value) in CASES.items():
    x = module.right_inverse(value)
    if key not in ("Positive above 2", "Positive by exp", "PositiveSpectrum"):  # none in half precision
        CALLS[key] = (module, torch.stack([x, x + 0.1, x - 0.2]).float())
        CALLS[f"{key}, right_inverse"] = (module.right_inverse, torch.stack([value] * 3).float())
# No derivatives or batches: numpy's, and what takes a module.
OTHERS = {"spline_basis", "register", "original", "remove", "CopiesParametrized", "pinhole_camera", "PositiveSpectrum"}
EVERY = pytest.mark.parametrize("name", CALLS)


def test_nothing_public_is_missing():
    for room in (parametrize, geometry):
        public = {name for name, one in vars(room).items() if inspect.isfunction(one) or inspect.isclass(one)}
        assert public - OTHERS - set(CALLS) == set()


def forward_and_gradient(function, x):
    x = x.clone().requires_grad_()
    value = function(x)
    weights = torch.linspace(-1.0, 1.0, value.numel()).reshape(value.shape).to(value.dtype)
    return value, lambda: torch.autograd.grad(value, x, weights)[0]


@EVERY
def test_autocast_does_not_reach_in(name):
    (function, x), half, dtype = CALLS[name], torch.bfloat16, torch.float32
    wanted, slope = forward_and_gradient(function, x.to(dtype))
    with torch.autocast("cpu", half):
        assert torch.mm(torch.ones(2, 2), torch.ones(2, 2)).dtype == half  # it is at work here
        found, slope_within = forward_and_gradient(function, x.to(dtype))
    torch.testing.assert_close(found, wanted, rtol=0, atol=0)
    torch.testing.assert_close(slope_within(), slope(), rtol=0, atol=0)


@EVERY
@together("half", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_single(name, half):
    """What comes back is that of double precision, rounded once."""
    function, x = CALLS[name]
    found, eps = function(x.to(half)), torch.finfo(half).eps
    assert found.dtype == half and bool(torch.isfinite(found).all())
    # Rounded turns, and weights whose sum is rounded, are none for double precision: compared with those before, whose
    # inverse has slopes of 1 / 0.17 at most.
    before = x.shape[-2:] == (4, 4) or name in ("simplex_inverse", "Simplex, right_inverse")
    known, slack = function(x.double() if before else x.to(half).double()), (16 if before else 1) * eps
    torch.testing.assert_close(found.double(), known, rtol=slack, atol=slack, check_dtype=False)


@EVERY
def test_vmap(name):
    function, x = CALLS[name]
    torch.testing.assert_close(torch.func.vmap(function)(x), function(x), rtol=1e-5, atol=1e-5)


def test_bounds_under_vmap_and_their_gradient():
    x, low = torch.zeros(3), torch.tensor([0.0, 0.5, 1.0])
    found = torch.func.vmap(lambda x, low: parametrize.bounded(x, low, 2.0))(x, low)
    assert torch.equal(found, torch.tensor([1.0, 1.25, 1.5]))
    found = torch.func.vmap(lambda x, low: parametrize.bounded_inverse(x, low, 2.0))(found, low)
    assert torch.allclose(found, x, atol=1e-6)
    slope = torch.func.vmap(torch.func.grad(lambda low, x: parametrize.bounded(x, low, 2.0)))(low, x)
    assert torch.allclose(slope, torch.full((3,), 0.5))


@pytest.mark.slow
@pytest.mark.parametrize(
    "function", [parametrize.Albedo(), parametrize.Positive(), lambda x: geometry.distance_from_opl(x[None])]
)
def test_compiled_in_one_graph(function):
    x = torch.linspace(0.1, 0.9, 6)
    whole = torch.compile(function, backend="eager", fullgraph=True)
    assert torch.equal(whole(x), function(x))
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(whole(x), function(x))
