"""``torch.compile`` leaves a render as it is and compiles what stands around it."""

from __future__ import annotations

import pytest
import torch

import torchtransient as tt
from tools.small_room import COLOUR
from tools.small_room import VARIANT as VARIANT


@pytest.fixture(autouse=True)
def _fresh_compiler():
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


def test_a_renderer(room_scene):
    renderer = tt.TransientRenderer(room_scene, parameters=[COLOUR], spp=4)
    compiled = torch.compile(renderer, backend="eager")
    expected, out = renderer(seed=0), compiled(seed=0)
    assert torch.equal(out.transient, expected.transient) and out.axis == expected.axis and out.stats.seeds == (0,)
    x = torch.tensor([0.8, 0.5, 0.2], requires_grad=True)
    found, known = (torch.autograd.grad(f({COLOUR: x}, seed=1).steady.sum(), x)[0] for f in (compiled, renderer))
    torch.testing.assert_close(found, known, rtol=1e-4, atol=1e-6)
    assert compiled(seed=5).stats.seeds == (5,)
