"""One number in a state is not the first of several, in every version of torch."""

from __future__ import annotations

import pytest
import torch
from torch import nn

import torchtransient as tt
from tools.small_room import VARIANT, make_room
from torchtransient.parametrize import Bounded, register


def glossy():
    room = make_room()
    room["wall"]["bsdf"] = {"type": "roughconductor", "alpha": 0.3}
    return tt.TransientRenderer(tt.load(room, variant=VARIANT), parameters=["wall.bsdf.alpha.value"], physics="ignore")


def bounded():
    renderer = glossy()
    register(renderer, "wall.bsdf.alpha.value", Bounded(0.05, 1.0))
    return renderer


def in_a_list():
    """A module of torch alone inside one of this library."""
    response = tt.sensing.GaussianResponse(1e-10)
    response.gain = nn.Module()
    response.gain.register_parameter("factor", nn.Parameter(torch.ones(())))
    return response


MODULES = {
    "renderer": glossy,
    "parametrized renderer": bounded,
    "response": lambda: tt.sensing.GaussianResponse(1e-10, learnable=True),
    "module inside": in_a_list,
}


def load_several(make):
    """Two numbers for each that is one; how many those were."""
    module = make()
    singles = [name for name, value in module.state_dict().items() if not value.ndim]
    for name in singles:
        state = dict(module.state_dict())
        state[name] = torch.stack([state[name], state[name]])
        with pytest.raises((RuntimeError, tt.errors.TorchTransientError), match=name.rpartition(".")[2]):
            module.load_state_dict(state)
    return len(singles)


def test_where_torch_takes_the_first(monkeypatch):
    """As version 2.6 does, whichever is installed."""

    def lenient(self, state, prefix, *rest):
        for name, own in [*self._parameters.items(), *self._buffers.items()]:
            given = state.get(prefix + name)
            if own is not None and given is not None:
                with torch.no_grad():
                    own.copy_(given[0] if own.ndim == 0 and given.ndim == 1 else given)

    monkeypatch.setattr(nn.Module, "_load_from_state_dict", lenient)
    assert all(load_several(make) > 0 for make in MODULES.values())
