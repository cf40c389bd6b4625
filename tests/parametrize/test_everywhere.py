"""Every function and module of `tt.parametrize` and `tt.geometry` inside of autocast, in half precision, under vmap."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
import torch

from support.sweeps import together
from torchtransient import geometry, parametrize
from torchtransient.scenes import look_at, rotate, scale, translate


def numbers(*shape, low=0.1, high=0.9):
    return low + (high - low) * torch.rand(shape, generator=torch.Generator().manual_seed(1))


WAVELENGTHS = np.linspace(400.0, 700.0, 16)
BASE = torch.tensor(translate([1.0, 2.0, 0.5]) @ rotate([1.0, 2.0, -1.0], 40.0) @ scale(0.3))
POSE = torch.tensor(look_at([1.0, 2.0, 3.0], [0.2, 0.5, 0.0]), dtype=torch.float32)
LIGHT = torch.tensor([0.3, 0.1, 2.0])
MATRIX = geometry.intrinsics(50.0, (4, 5))
SIX = numbers(3, 6, low=-1.0, high=1.0)
POSES = parametrize.pose_from_axis_angle(SIX)
IMAGES = numbers(3, 4, 5, low=1.0, high=3.0)
WEIGHTS = torch.softmax(numbers(3, 4), -1)
SHARES, CURVES = numbers(3, 5), 0.3 + 0.4 * torch.rand(3, 16, generator=torch.Generator().manual_seed(2))

# name: (function of a batch, the batch)
CALLS = {
    "bounded": (lambda x: parametrize.bounded(x, -1.0, 2.0), SIX),
    "bounded_inverse": (parametrize.bounded_inverse, SHARES),
    "positive": (parametrize.positive, SIX),
    "positive_inverse": (parametrize.positive_inverse, SHARES),
    "simplex": (parametrize.simplex, SIX),
    "simplex_inverse": (parametrize.simplex_inverse, WEIGHTS),
    "pose_from_axis_angle": (parametrize.pose_from_axis_angle, SIX),
    "axis_angle_from_pose": (parametrize.axis_angle_from_pose, POSES),
    "pose_from_twist": (parametrize.pose_from_twist, SIX),
    "twist_from_pose": (parametrize.twist_from_pose, POSES),
    "intrinsics": (lambda x: geometry.intrinsics(20 + 30 * x, (4, 5)), SHARES[:, 0]),
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
MODULES = {
    "Bounded": (parametrize.Bounded(-1.0, 2.0), SHARES),
    "Albedo": (parametrize.Albedo(margin=1e-3), SHARES),
    "Roughness": (parametrize.Roughness(), SHARES),
    "PrincipledRoughness": (parametrize.PrincipledRoughness(), SHARES),
    "IndexOfRefraction": (parametrize.IndexOfRefraction(), 1 + SHARES),
    "Anisotropy": (parametrize.Anisotropy(), SHARES),
    "Positive": (parametrize.Positive(), SHARES),
    "Simplex": (parametrize.Simplex(), WEIGHTS),
    "PositiveSpectrum": (parametrize.PositiveSpectrum(WAVELENGTHS, 6), CURVES),
    "ReflectanceSpectrum": (parametrize.ReflectanceSpectrum(WAVELENGTHS, 6), CURVES),
    "AxisAnglePose": (parametrize.AxisAnglePose(BASE), (POSES.double() @ BASE).float()),
    "SE3Pose": (parametrize.SE3Pose(BASE, frame="local"), (BASE @ POSES.double()).float()),
}
for key, (module, value) in MODULES.items():
    CALLS[f"{key}, right_inverse"] = (module.right_inverse, value)
    CALLS[key] = (module, module.right_inverse(value))
# No derivatives or batches: numpy's, and what takes a module.
OTHERS = {"spline_basis", "register", "original", "remove", "CopiesParametrized", "pinhole_camera"}
ALL = pytest.mark.parametrize("name", CALLS)


def test_nothing_public_is_missing():
    for room in (parametrize, geometry):
        public = {name for name, one in vars(room).items() if inspect.isfunction(one) or inspect.isclass(one)}
        assert public - OTHERS - set(CALLS) == set()


def forward_and_gradient(function, x):
    x = x.clone().requires_grad_()
    value = function(x)
    weights = torch.linspace(-1.0, 1.0, value.numel()).reshape(value.shape).to(value.dtype)
    return value, lambda: torch.autograd.grad(value, x, weights)[0]


@ALL
def test_autocast_does_not_reach_in(name):
    (function, x), half, dtype = CALLS[name], torch.bfloat16, torch.float32
    wanted, slope = forward_and_gradient(function, x.to(dtype))
    with torch.autocast("cpu", half):
        assert torch.mm(torch.ones(2, 2), torch.ones(2, 2)).dtype == half  # it is at work here
        found, slope_within = forward_and_gradient(function, x.to(dtype))
    torch.testing.assert_close(found, wanted, rtol=0, atol=0)
    torch.testing.assert_close(slope_within(), slope(), rtol=0, atol=0)


@ALL
@together("half", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_single(name, half):
    """What comes back is that of double precision, rounded once."""
    function, x = CALLS[name]
    found, eps = function(x.to(half)), torch.finfo(half).eps
    assert found.dtype == half and bool(torch.isfinite(found).all())
    # Rounded turns, and weights whose sum is rounded, are none for double precision: compared with those before, whose
    # inverse has slopes of 1 / 0.17 at most.
    before = x.shape[-2:] == (4, 4) or x is WEIGHTS
    known, slack = function(x.double() if before else x.to(half).double()), (16 if before else 1) * eps
    torch.testing.assert_close(found.double(), known, rtol=slack, atol=slack, check_dtype=False)


@ALL
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
