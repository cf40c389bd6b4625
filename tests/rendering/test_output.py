"""A result as torch knows one: batches, trees, hooks, devices, and how it is shown."""

from __future__ import annotations

import pickle
from dataclasses import replace

import pytest
import torch
from torch.utils import _pytree
from torch.utils.data import DataLoader, Dataset, default_collate

import torchtransient as tt
from tools.small_room import COLOUR, VARIANT, make_room
from torchtransient.files import read_result, write_result


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


def test_batches_one_behind_another(renderer):
    with torch.no_grad():
        batches = [renderer({COLOUR: torch.rand(n, 3)}, seed=n) for n in (2, 3)]
    together = tt.RenderOutput.cat(batches)
    assert together.transient.shape == (5, 3, 24, 3, 4) and len(together.stats.seeds) == 5
    assert torch.equal(together.transient[2:], batches[1].transient)


def test_films_of_every_kind_make_batches(room_scene):
    for settings in ({"frequencies": [0.0, 0.3]}, {"gates": [tt.Gate.rectangular(6.0, 9.0)]}):
        outs = [tt.render(room_scene, spp=4, seed=seed, **settings) for seed in (0, 1)]
        batch = default_collate(outs)
        found = batch.gated if "gates" in settings else batch.phasor
        assert found.shape[0] == 2 and found.dtype == (torch.float32 if "gates" in settings else torch.complex64)


def test_what_is_no_batch(outputs):
    first, second = outputs
    other = replace(second, axis=tt.TimeAxis(0.0, 0.25, 24))
    with pytest.raises(tt.errors.ShapeError, match=r"the same axis.*TimeAxis"):
        default_collate([first, other])
    with pytest.raises(tt.errors.ShapeError, match="the same spp in all of them, got 4 and 16"):
        default_collate([first, replace(second, stats=replace(second.stats, spp=16))])
    with pytest.raises(tt.errors.ShapeError, match=r"transient cannot be put together, got \(3, 24, 3, 4\), \(3, 24,"):
        tt.RenderOutput.stack([first, replace(second, transient=second.transient[..., :2])])
    with pytest.raises(tt.errors.ShapeError, match="at least one"):
        tt.RenderOutput.stack([])
    with pytest.raises(tt.errors.ShapeError, match="the same tensors"):
        default_collate([first, replace(second, transient=None)])
    for odd, words in ((3, "got int as entry 1"), (None, "got NoneType as entry 1")):
        with pytest.raises(tt.errors.ArgumentError, match=rf"of RenderOutput: expected these alone, {words}\.$"):
            tt.RenderOutput.stack([first, odd, second])
    for none in (3, "outputs", b"outputs", {first}):
        with pytest.raises(tt.errors.ArgumentError, match=f"expected a list of them, got {type(none).__name__}"):
            tt.RenderOutput.cat(none)


def test_a_render_and_the_result_of_its_file_are_two_classes(outputs, tmp_path):
    out, again = outputs
    read = [read_result(write_result(tmp_path / f"{k}.npz", one)) for k, one in enumerate(outputs)]
    assert torch.equal(read[0].transient, out.transient) and read[0] != out
    assert read[0] == read_result(tmp_path / "0.npz") and read[0] != read[1]
    with pytest.raises(tt.errors.ArgumentError, match=r"got Result as entry 1\. Result\.stack is for those of its c"):
        tt.RenderOutput.stack([out, read[0]])
    with pytest.raises(tt.errors.ArgumentError, match=r"a batch of Result: .* got RenderOutput as entry 1"):
        default_collate([read[0], again])
    batch = type(read[0]).stack(read)
    assert torch.equal(batch.steady, torch.stack([out.steady, again.steady]))
    assert read[0].metadata["stats"]["spp"] == out.stats.spp
    assert [one["stats"]["seeds"] for one in batch.metadata["batch"]] == [[*one.stats.seeds] for one in outputs]


class Renders(Dataset):
    def __len__(self):
        return 4

    def __getitem__(self, n):
        return {"out": tt.render(tt.load(make_room(), variant=VARIANT), spp=2, seed=n), "number": n}


@pytest.mark.slow
def test_workers_of_a_data_loader_hand_over_renders():
    loader = DataLoader(Renders(), batch_size=2, num_workers=1, multiprocessing_context="spawn")
    batches = list(loader)
    assert [batch["out"].transient.shape for batch in batches] == [(2, 3, 24, 3, 4)] * 2
    assert batches[1]["out"].stats.seeds == (2, 3)


def test_results_from_files_make_batches(outputs, tmp_path):
    results = [read_result(write_result(tmp_path / f"{n}.npz", out, {"n": n})) for n, out in enumerate(outputs)]
    batch = default_collate(results)
    assert torch.equal(batch.transient[1], outputs[1].transient)
    assert [one["n"] for one in batch.metadata["batch"]] == [0, 1]
    assert "metadata" in repr(results[0]) and "float32 (3, 24, 3, 4)" in repr(results[0])


def test_what_sensing_returns_makes_batches_too(outputs):
    returns = [tt.sensing.first_return(out.transient, 0.01) for out in outputs]
    batch = default_collate(returns)
    assert batch.position.shape == (2, 3, 1, 3, 4) and batch.valid.dtype == torch.bool
    double = batch.to(torch.float64)
    assert double.position.dtype == torch.float64 and double.valid.dtype == torch.bool
    assert len(repr(batch)) < 200


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


def test_hooks_of_modules_see_and_replace_outputs(renderer):
    seen = []

    def halved(module, args, kwargs, out):
        seen.append((kwargs["seed"], type(out)))
        return _pytree.tree_map(lambda tensor: tensor / 2, out)

    expected = renderer(seed=7).steady
    before = renderer.register_forward_pre_hook(lambda m, args, kwargs: (args, {**kwargs, "seed": 7}), with_kwargs=True)
    after = renderer.register_forward_hook(halved, with_kwargs=True)
    try:
        out = renderer(seed=0)
    finally:
        before.remove()
        after.remove()
    assert seen == [(7, tt.RenderOutput)]
    torch.testing.assert_close(out.steady, expected / 2)
    grads = []
    out.transient.register_hook(grads.append)
    out.transient.sum().backward()
    assert grads[0].shape == out.transient.shape


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


def test_it_is_shown_in_few_words(outputs, room_scene):
    text = repr(outputs[0])
    assert len(text) < 500 and "\n" not in text
    for part in (
        "RenderOutput(",
        "transient=float32 (3, 24, 3, 4)",
        "axis=TimeAxis(",
        "channels=R/G/B",
        "4 spp",
        "seed 3",
    ):
        assert part in text
    assert "None" not in text
    page = outputs[0]._repr_html_()
    assert page.startswith("<table>") and "float32 (3, 24, 3, 4)" in page and page.count("<tr>") == 5
    gates = [tt.Gate.rectangular(6.0 + n, 7.0 + n) for n in range(30)]
    assert len(repr(tt.render(room_scene, spp=2, seed=0, gates=gates))) < 500
