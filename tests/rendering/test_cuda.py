"""The bridge on a GPU: torch's CUDA tensors in and out, and the same physics as on the CPU."""

from __future__ import annotations

import pytest
import torch

import torchtransient as tt
from tools.small_room import COLOUR, WALL_POSE, make_room

pytestmark = pytest.mark.gpu


@pytest.fixture(scope="module")
def on_gpu():
    return tt.TransientRenderer(tt.load(make_room(), variant="cuda_ad_rgb"), parameters=[COLOUR, WALL_POSE], spp=4096)


def test_tensors_live_on_the_gpu(on_gpu):
    out = on_gpu(seed=0)
    assert out.transient.device.type == "cuda" and on_gpu.values[COLOUR].device.type == "cuda"
    with pytest.raises(tt.errors.DeviceError, match="expected a tensor on 'cuda'"):
        on_gpu({COLOUR: torch.rand(3)}, seed=0)


def test_gpu_and_cpu_agree(on_gpu):
    on_cpu = tt.TransientRenderer(tt.load(make_room(), variant="llvm_ad_rgb"), parameters=[COLOUR, WALL_POSE], spp=4096)
    arrival = torch.linspace(0, 1, 24).view(1, 24, 1, 1)
    sums, slopes = [], []
    for renderer in (on_gpu, on_cpu):
        out = renderer(seed=0).transient
        (out * arrival.to(out.device)).sum().backward()
        sums.append(out.detach().sum((1, 2, 3)).cpu())
        slopes.append([p.grad.cpu() for p in renderer.parameters()])
    torch.testing.assert_close(sums[0], sums[1], rtol=5e-3, atol=0)
    for a, b in zip(*slopes, strict=True):
        torch.testing.assert_close(a, b, rtol=0.05, atol=0.05 * float(b.abs().max()))


def test_training_with_pending_work_on_torchs_stream(on_gpu):
    """Guards against Dr.Jit reusing a cube's memory while torch still reads it."""
    with torch.no_grad():
        expected = [on_gpu(seed=seed).transient.double().square().sum().item() for seed in range(8)]
        pending = [on_gpu(seed=seed).transient.double().square().sum() for seed in range(8)]
    assert [p.item() for p in pending] == pytest.approx(expected, rel=1e-5)
