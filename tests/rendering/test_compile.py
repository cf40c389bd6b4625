"""``torch.compile`` leaves a render as it is and compiles what stands around it."""

from __future__ import annotations

import inspect
import subprocess
import sys

import pytest
import torch
from torch import nn

import torchtransient as tt
from support.marks import long
from support.sensing.all_entries import ENTRIES
from tools.small_room import COLOUR
from tools.small_room import VARIANT as VARIANT

START = torch.tensor([0.8, 0.5, 0.2])


@pytest.fixture(autouse=True)
def _fresh_compiler():
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


class Pipeline(nn.Module):
    """From a code to the counts of a detector."""

    def __init__(self, renderer):
        super().__init__()
        self.code = nn.Linear(3, 3)
        self.renderer = renderer
        responses = [entry for entry in ENTRIES if entry.name == "ImpulseResponse-gaussian"]
        self.response, self.noise = responses[0].module(torch.float32), tt.sensing.ShotNoise(grad="expected")

    def forward(self, x):
        out = self.renderer({COLOUR: torch.sigmoid(self.code(x))}, seed=0)
        seen = self.response(out.transient)
        counts = self.noise(seen.clamp_min(0), generator=torch.Generator().manual_seed(1))
        return counts.square().sum() + seen.sum() + out.stats.spp


def results(function, x, *modules):
    """Value and gradients, by the argument and by the parameters of modules."""
    leaf = x.clone().requires_grad_()
    wanted = [leaf, *(p for module in modules for p in module.parameters())]
    value = function(leaf)
    return value.detach(), [g for g in torch.autograd.grad(value, wanted, allow_unused=True) if g is not None]


def same(found, expected):
    torch.testing.assert_close(found[0], expected[0], rtol=1e-5, atol=1e-6)
    assert len(found[1]) == len(expected[1]) > 0
    for a, b in zip(found[1], expected[1], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)


BACKENDS = ["eager", "aot_eager"]


@pytest.mark.parametrize("backend", long(BACKENDS, ["eager"]))
def test_a_renderer(room_scene, backend):
    renderer = tt.TransientRenderer(room_scene, parameters=[COLOUR], spp=4)
    compiled = torch.compile(renderer, backend=backend)
    expected, out = renderer(seed=0), compiled(seed=0)
    assert torch.equal(out.transient, expected.transient) and out.axis == expected.axis and out.stats.seeds == (0,)
    same(
        results(lambda x: compiled({COLOUR: x}, seed=1).steady.sum(), START),
        results(lambda x: renderer({COLOUR: x}, seed=1).steady.sum(), START),
    )
    assert compiled(seed=5).stats.seeds == (5,)


@pytest.mark.slow
def test_what_a_whole_graph_would_need(room_scene):
    renderer = tt.TransientRenderer(room_scene, parameters=[COLOUR], spp=4)
    # The compiler of torch 2.6 takes no reason: it names the function that it was told to leave alone.
    reasons = "reason" in inspect.signature(torch._dynamo.disable).parameters
    named = r"disable\(\) wrapped function <function (_untraced|TransientRenderer)"
    said = "renders with Mitsuba, which the compiler cannot trace" if reasons else named
    for module in (renderer, Pipeline(renderer)):
        with pytest.raises(Exception, match=said):
            torch.compile(module, backend="eager", fullgraph=True)(START if module is not renderer else None)


@pytest.mark.slow
def test_a_render_does_not_import_the_compiler():
    code = (
        "import torchtransient as tt, sys, torch\n"
        "from tools.small_room import make_room\n"
        "before = 'torch._dynamo' in sys.modules\n"
        "out = tt.render(make_room(), spp=1, seed=0)\n"
        "print(before, 'torch._dynamo' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-2:] == ["False", "False"]
