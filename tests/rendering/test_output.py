"""A result as torch knows one: batches, trees, hooks, devices, and how it is shown."""

from __future__ import annotations

import pickle

import pytest
import torch
from torch.utils import _pytree
from torch.utils.data import default_collate

import torchtransient as tt
from tools.small_room import COLOUR
from tools.small_room import VARIANT as VARIANT


@pytest.fixture(scope="module")
def renderer(room_scene):
    return tt.TransientRenderer(room_scene, parameters=[COLOUR], spp=4)


@pytest.fixture(scope="module")
def outputs(renderer):
    with torch.no_grad():
        return [renderer(seed=seed) for seed in (3, 4)]


@pytest.mark.parametrize("together", [default_collate, tt.RenderOutput.stack])
def test_a_batch(outputs, together):
    batch = together(outputs)
    assert isinstance(batch, tt.RenderOutput)
    assert torch.equal(batch.transient, torch.stack([out.transient for out in outputs]))
    assert torch.equal(batch.steady[1], outputs[1].steady)
    assert batch.axis == outputs[0].axis and batch.channels == ("R", "G", "B") and batch.phasor is None
    assert batch.stats.seeds == (3, 4) and batch.stats.spp == 4 and len(batch.stats.energy_after) == 2
    assert batch.stats.seconds == pytest.approx(sum(out.stats.seconds for out in outputs))


def test_a_tree_of_tensors(outputs):
    leaves, spec = _pytree.tree_flatten({"a": outputs[0]})
    assert len(leaves) == 2 and all(isinstance(leaf, torch.Tensor) for leaf in leaves)
    back = _pytree.tree_unflatten(leaves, spec)["a"]
    assert torch.equal(back.transient, outputs[0].transient) and back.stats == outputs[0].stats
    total = _pytree.tree_map(torch.add, *outputs)
    assert torch.equal(total.steady, outputs[0].steady + outputs[1].steady)
    names = [str(path[0]) for path, _ in _pytree.tree_flatten_with_path(outputs[0])[0]]
    assert names == [".transient", ".steady"]


def test_a_whole_output_through_transforms(renderer):
    xs = torch.rand(2, 3)
    mapped = torch.func.vmap(lambda x: renderer({COLOUR: x}, seed=0))(xs)
    assert isinstance(mapped, tt.RenderOutput)
    torch.testing.assert_close(mapped.transient[1], renderer({COLOUR: xs[1]}, seed=0).transient)
    jacobian = torch.func.jacfwd(lambda x: renderer({COLOUR: x}, seed=0))(xs[0])
    assert jacobian.transient.shape == (3, 24, 3, 4, 3) and jacobian.steady.abs().max() > 0


def test_copies(outputs, room_scene):
    out = outputs[0]
    assert out.to(torch.float64).steady.dtype == torch.float64 and out.to("meta").transient.is_meta
    assert out.cpu().axis == out.axis
    assert out.clone().transient.is_contiguous() and not out.transient.is_contiguous()
    assert torch.equal(out.map(torch.neg).steady, -out.steady)
    with_gradient = out.map(lambda tensor: tensor.clone().requires_grad_())
    assert not with_gradient.detach().transient.requires_grad
    phasors = tt.render(room_scene, spp=2, seed=0, frequencies=[0.0, 0.3])
    assert phasors.to(dtype=torch.float64).phasor.dtype == torch.complex128
    assert phasors.to(torch.float64).steady.dtype == torch.float64
    again = pickle.loads(pickle.dumps(out))
    assert torch.equal(again.transient, out.transient) and again.stats == out.stats
