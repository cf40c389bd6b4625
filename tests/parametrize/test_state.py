"""A state that is loaded brings the value, whatever the settings of what it is loaded into."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from torch import nn

import torchtransient as tt
from support.sweeps import together
from torchtransient.errors import SceneError
from torchtransient.parametrize import (
    Albedo,
    AxisAnglePose,
    Bounded,
    Positive,
    PositiveSpectrum,
    ReflectanceSpectrum,
    SE3Pose,
    Simplex,
    register,
)
from torchtransient.scenes import rotate, scale, translate

BASE = translate([0.3, -0.5, 2.0]) @ rotate([1.0, 2.0, -1.0], 40.0) @ scale([0.2, 1.5, 0.7])
OTHER = translate([1.0, 0.0, 0.1]) @ BASE
NEAR, FAR = np.linspace(400.0, 700.0, 16), np.geomspace(800.0, 1500.0, 16)
CURVE = torch.linspace(0.2, 0.7, 16)

# (what is saved, the same with other settings, a value that both can have)
PAIRS = {
    "bounds": (Albedo(), Bounded(-0.1, 0.9), torch.tensor([0.2, 0.7])),
    "bounds by tensors": (Bounded([0.0, 0.1], 1.0), Bounded([0.1, 0.0], 2.0), torch.tensor([0.2, 0.7])),
    "low and scale": (Positive(0.1, 2.0), Positive(0.0, 1.0), torch.tensor([0.2, 0.7])),
    "function": (Positive(function="exp"), Positive(), torch.tensor([0.2, 0.7])),
    "dim": (Simplex(0), Simplex(1), torch.full((2, 2), 0.5) + 0.1 * torch.tensor([[1, -1], [-1, 1]])),
    "wavelengths": (PositiveSpectrum(NEAR, 6), PositiveSpectrum(FAR, 6, scale=2.0), CURVE),
    "shares": (ReflectanceSpectrum(NEAR, 6), ReflectanceSpectrum(FAR, 6), CURVE),
    "base": (AxisAnglePose(BASE), AxisAnglePose(OTHER), torch.tensor(BASE)),
    "base and frame": (SE3Pose(BASE, frame="local"), SE3Pose(OTHER), torch.tensor(OTHER)),
    "about": (AxisAnglePose(BASE, about="world"), AxisAnglePose(BASE, about=[1.0, 2.0, 3.0]), torch.tensor(OTHER)),
    "length_scale": (AxisAnglePose(BASE, length_scale=0.1), AxisAnglePose(BASE), torch.tensor(OTHER)),
}
ALL = pytest.mark.parametrize("name", PAIRS)


class Holder(nn.Module):
    def __init__(self, kind, value):
        super().__init__()
        self.w = nn.Parameter(value.clone())
        register(self, "w", copy.deepcopy(kind))

    def forward(self):
        return self.w


def pair(name):
    """Two with different values, of which the first one is saved."""
    saved, other, value = PAIRS[name]
    modules = [Holder(saved, value), Holder(other, value)]
    with torch.no_grad():
        for parameter in modules[0].parameters():
            parameter.add_(torch.linspace(0.1, 0.2, parameter.numel()).reshape(parameter.shape))
            modules[1].parametrizations.w.original.sub_(0.1)
    return modules


@ALL
@together("way", ["loaded", "assigned", "of a checkpoint"])
def test_the_value_is_that_of_the_state(name, way, tmp_path):
    saved, other = pair(name)
    assert not torch.allclose(saved(), other(), rtol=1e-3)
    assert all(isinstance(one, torch.Tensor) for one in saved.state_dict().values())  # for formats of tensors alone
    if way == "of a checkpoint":
        tt.training.save_checkpoint(tmp_path / "run.pt", {"model": saved}, step=1)
        tt.training.load_checkpoint(tmp_path / "run.pt", {"model": other})
    else:
        other.load_state_dict(copy.deepcopy(saved.state_dict()), assign=way == "assigned")
    assert torch.equal(saved(), other())
    value = saved().detach()
    with torch.no_grad():
        other.w = value
    assert torch.allclose(other(), value, rtol=1e-5)


@ALL
@together("to_half", [nn.Module.half, nn.Module.bfloat16])
def test_settings_survive_half_precision(name, to_half):
    """Numbers behind are rounded, settings are not: they come back in double precision."""
    kind, _, _ = PAIRS[name]
    twin = to_half(copy.deepcopy(kind))
    for known, found in zip(kind.buffers(), twin.float().double().buffers(), strict=True):
        assert found.dtype == torch.float64 and torch.equal(known, found)
    moved = copy.deepcopy(kind).to("meta", torch.float16)
    assert {(one.device.type, one.dtype) for one in moved.buffers()} <= {("meta", torch.float64)}


def test_states_that_do_not_fit():
    colour = torch.tensor([0.2, 0.7])
    three = Holder(Bounded([0.0, 0.1], 1.0), colour).state_dict()
    pose, positive = SE3Pose().state_dict(), Positive().state_dict()
    for module, state, error, words in (
        (Holder(Albedo(), colour), three, RuntimeError, r"size mismatch for parametrizations\.w\.0\.low"),
        (SE3Pose(), AxisAnglePose().state_dict(), SceneError, "SE3Pose: expected the state of a pose"),
        (SE3Pose(), pose | {"_extra_state": torch.tensor(1)}, SceneError, "expected the state of a pose"),
        (Positive(), positive | {"_extra_state": torch.tensor(7)}, SceneError, "one of softplus, exp"),
    ):  # fmt: skip
        with pytest.raises(error, match=words):
            module.load_state_dict(state)
