"""Rigid motions against the matrix exponential and Rodrigues' formula, about points, in both frames."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from support.sweeps import together
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.parametrize import (
    AxisAnglePose,
    SE3Pose,
    axis_angle_from_pose,
    pose_from_axis_angle,
    pose_from_twist,
    twist_from_pose,
)  # fmt: skip
from torchtransient.scenes import rotate, scale, translate

AXIS = torch.tensor([1.0, 2.0, -2.0], dtype=torch.float64) / 3
SHIFT = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
ANGLES = [0.0, 1e-9, 1e-6, 1e-3, 0.1, 1.0, 3.0, math.pi - 1e-6, math.pi]
BASE = translate([0.3, -0.5, 2.0]) @ rotate([1.0, 2.0, -1.0], 40.0) @ scale([0.2, 1.5, 0.7])


BOTH = pytest.mark.parametrize(
    ("there", "back"), [(pose_from_axis_angle, axis_angle_from_pose), (pose_from_twist, twist_from_pose)]
)


def six(angle):
    return torch.cat([AXIS * angle, SHIFT])


def generator(x):
    """The matrix of se(3)."""
    (a, b, c), zero = x[:3].unbind(), x.new_zeros(())
    rows = [[zero, -c, b, x[3]], [c, zero, -a, x[4]], [-b, a, zero, x[5]], [zero] * 4]
    return torch.stack([torch.stack(row) for row in rows])


@pytest.mark.parametrize("angle", [*ANGLES, 5.0])
def test_axis_angle_is_rodrigues_formula(angle):
    known = translate(SHIFT.numpy()) @ rotate(AXIS.numpy(), math.degrees(angle))
    np.testing.assert_allclose(pose_from_axis_angle(six(angle)), known, atol=1e-14)


@pytest.mark.parametrize("angle", ANGLES[::2])
def test_twist_is_the_matrix_exponential(angle):
    x = six(angle)
    known = torch.linalg.matrix_exp(generator(x))
    assert torch.allclose(pose_from_twist(x), known, atol=1e-13)
    jacobian = torch.autograd.functional.jacobian
    slope = jacobian(lambda x: torch.linalg.matrix_exp(generator(x)), x)
    assert torch.allclose(jacobian(pose_from_twist, x), slope, atol=1e-9)


@pytest.mark.parametrize("angle", ANGLES[1:-1:3])
@BOTH
def test_there_and_back_with_derivatives(angle, there, back):
    """The Jacobian of both, one behind the other, is one: at zero and up to half a turn."""
    x = six(angle)
    assert torch.allclose(back(there(x)), x, atol=1e-9)
    slope = torch.autograd.functional.jacobian(lambda x: back(there(x)), x)
    assert torch.allclose(slope, torch.eye(6, dtype=torch.float64), atol=1e-6)
    slope = torch.func.jacfwd(lambda x: there(x))(x)
    assert torch.allclose(slope, torch.autograd.functional.jacobian(there, x), atol=1e-9)
    assert not there(x).requires_grad and not back(there(x)).requires_grad


@BOTH
@together("dtype", [torch.float32, torch.float64])
@together("axis", [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0.6, -0.8, 0], [-1 / 3, 2 / 3, -2 / 3]])
def test_half_a_turn(there, back, dtype, axis):
    x = torch.tensor([*(math.pi * a for a in axis), *SHIFT], dtype=dtype)
    pose = there(x)
    found = back(pose)
    assert found[:3].norm().item() == pytest.approx(math.pi, abs=1e-3)
    assert torch.allclose(there(found), pose, atol=1e-6)
    assert bool(torch.isfinite(found).all())


@pytest.mark.parametrize("kind", [AxisAnglePose, SE3Pose])
@pytest.mark.parametrize("frame", ["world", "local"])
@pytest.mark.parametrize("about", ["self", "world", [0.5, 1.0, -2.0]])
def test_turns_about_its_point(kind, frame, about):
    """A turn alone leaves the point where it is, and sends others along a circle about it."""
    pose = kind(BASE, about=about, frame=frame)
    turned = pose(torch.tensor([0.2, -0.4, 0.9, 0.0, 0.0, 0.0], dtype=torch.float64)).numpy()
    point = BASE[:3, 3] if about == "self" else np.zeros(3) if about == "world" else np.array(about)
    before = np.linalg.solve(BASE, [*point, 1.0])
    np.testing.assert_allclose((turned @ before)[:3], point, atol=1e-12)
    if frame == "world":
        other = np.array([0.4, 0.1, -0.2, 1.0])
        lengths = [np.linalg.norm((matrix @ other)[:3] - point) for matrix in (turned, BASE)]
        assert lengths[0] == pytest.approx(lengths[1], rel=1e-12)


@pytest.mark.parametrize("kind", [AxisAnglePose, SE3Pose])
def test_moves_along_the_axes_of_its_frame(kind):
    x = torch.tensor([0.0, 0, 0, 0.1, 0.2, 0.3], dtype=torch.float64)
    world = kind(BASE)(x).numpy()
    np.testing.assert_allclose(world, translate([0.1, 0.2, 0.3]) @ BASE, atol=1e-14)
    local = kind(BASE, frame="local", length_scale=10.0)(x).numpy()
    np.testing.assert_allclose(local, BASE @ translate([1.0, 2.0, 3.0]), atol=1e-14)


def test_batches_of_bases():
    bases = torch.stack([torch.tensor(BASE), torch.tensor(translate([1.0, 0, 0]) @ BASE)])
    x = torch.stack([six(0.5), six(-0.2)])
    together = AxisAnglePose(bases)(x)
    for k in range(2):
        assert torch.allclose(together[k], AxisAnglePose(bases[k])(x[k]), atol=1e-14)
    assert torch.allclose(AxisAnglePose(bases).right_inverse(together), x, atol=1e-10)
    assert torch.equal(AxisAnglePose(bases)(0 * x), bases)
    with pytest.raises(RuntimeError, match="size of tensor"):
        AxisAnglePose(bases)(torch.zeros(3, 6))


@together("function", [axis_angle_from_pose, twist_from_pose, AxisAnglePose().right_inverse])
@together(
    "matrix",
    [
        scale(1.1), scale([1.0, 1.0, -1.0]), np.full((4, 4), np.nan), np.diag([1.0, 1.0, 1.0, 2.0]), BASE,
        np.eye(4) + 0.1 * np.eye(4, k=-3), np.eye(4) + np.eye(4, k=-1) * [0, 0, 0.01, 0],
    ],
)  # fmt: skip
def test_what_is_no_rigid_motion(function, matrix):
    with pytest.raises(UnitError, match="expected a rigid motion"):
        function(torch.tensor(matrix))


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"base": np.eye(3)}, ShapeError, r"\(\.\.\., 4, 4\)"),
        ({"base": np.eye(4) + 2e-8 * np.eye(4, k=-2)}, UnitError, "last row 0, 0, 0, 1"),
        ({"base": np.zeros((4, 4))}, UnitError, "with an inverse"),
        ({"base": np.where(np.eye(4, k=3), np.nan, np.eye(4))}, UnitError, "with an inverse"),
        ({"about": [math.nan, 0.0, 0.0]}, ShapeError, "'self', 'world' or a point"),
        ({"about": "there"}, ShapeError, "'self', 'world' or a point"),
        ({"frame": "camera"}, ArgumentError, "'world' or 'local'"),
        ({"length_scale": 0.0}, UnitError, "length_scale"),
    ],
)
def test_settings_that_are_none(settings, error, message):
    with pytest.raises(error, match=message):
        AxisAnglePose(**settings)


INVERSES = [axis_angle_from_pose, twist_from_pose, AxisAnglePose().right_inverse, SE3Pose().right_inverse]


@pytest.mark.parametrize("inverse", INVERSES)
@pytest.mark.parametrize(("dtype", "near", "far"), [(torch.float64, 4e-5, 6e-5), (torch.bfloat16, 1 / 128, 3 / 128)])
def test_motions_are_rigid_to_the_precision_they_have(inverse, dtype, near, far):
    """Axes longer than one by 1e-4 of their square, or by four steps of the precision where that is more."""
    scaled = [torch.diag(torch.tensor([1.0, 1 + length, 1.0, 1.0], dtype=torch.float64)) for length in (near, far)]
    assert inverse(scaled[0].to(dtype)).abs().max() < 0.02
    with pytest.raises(UnitError, match="expected a rigid motion"):
        inverse(scaled[1].to(dtype))
