"""Hidden volumes as records: moved, put into batches, taken apart, the same after a file."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.utils import _pytree
from torch.utils.data import DataLoader

import torchtransient as tt
from support.sweeps import together
from torchtransient.errors import ShapeError, StorageError, UnitError

N = tt.nlos
SCAN = N.Scan.grid(N.Wall.plane(1.0, 1.0), (4, 3), kind="confocal")
GRID = N.VoxelGrid.before(SCAN, [0.3, 0.4])


def volume(seed=0, *, directions=False, times=None):
    generator = torch.Generator().manual_seed(seed)
    frames = [] if times is None else [len(times)]
    vectors = torch.rand(1, 3, *GRID.shape, generator=generator) if directions else None
    values = torch.rand(1, *frames, *GRID.shape, generator=generator)
    return N.HiddenVolume(values, GRID, "fk", metadata={"seed": seed}, times=times, directions=vectors)


KINDS = {
    "values": {}, "directions": {"directions": True}, "a film": {"times": torch.tensor([0.1, 0.2, 0.3])},
}  # fmt: skip
each_kind = pytest.mark.parametrize("kind", KINDS)


@each_kind
def test_moved_and_detached(kind):
    one = volume(**KINDS[kind])
    double = one.to(torch.float64)
    assert double.values.dtype == torch.float64 and torch.equal(double.values.float(), one.values)
    assert double != one and double.to(torch.float32) == one and double.grid == GRID
    assert one.to("meta").values.is_meta
    if one.times is not None:
        assert one.to(device="meta", dtype=torch.float64).times is one.times
    with_gradient = one.map(lambda x: x.clone().requires_grad_())
    assert with_gradient.values.requires_grad and not with_gradient.detach().values.requires_grad
    copy = one.clone()
    assert copy == one and hash(copy) == hash(one) and copy.values.data_ptr() != one.values.data_ptr()


@each_kind
def test_batches(kind):
    parts = [volume(seed, **KINDS[kind]) for seed in range(3)]
    stacked, behind = N.HiddenVolume.stack(parts), N.HiddenVolume.cat(parts)
    assert stacked.values.shape == (3, *parts[0].values.shape) and behind.values.shape[0] == 3
    assert stacked.metadata == {"batch": [{"seed": seed} for seed in range(3)]}
    assert torch.equal(stacked.values[1], parts[1].values) and torch.equal(stacked.picture(), parts[0].picture())
    (loaded,) = DataLoader(parts, batch_size=3)
    assert loaded == stacked
    for change, words in (({"method": "lct"}, "same method"), ({"grid": GRID.at_depths([0.3, 0.5])}, "same grid")):
        with pytest.raises(ShapeError, match=words):
            N.HiddenVolume.stack([parts[0], replace(parts[0], **change)])


@each_kind
def test_trees_see_the_tensors(kind):
    one = volume(**KINDS[kind])
    leaves, spec = _pytree.tree_flatten(one)
    assert len(leaves) == 1 + (one.directions is not None)
    assert _pytree.tree_unflatten(leaves, spec) == one
    doubled = _pytree.tree_map(lambda x: 2 * x, one)
    assert torch.equal(doubled.values, 2 * one.values) and doubled.metadata == one.metadata
    total = torch.func.grad(lambda v: v.values.square().sum())(one)
    torch.testing.assert_close(total.values, 2 * one.values)


@each_kind
def test_the_same_after_a_file(tmp_path, kind):
    one = volume(**KINDS[kind])
    for ending in ("h5", "npz"):
        back = N.read_volume(N.write_volume(tmp_path / f"a.{ending}", one))
        assert back == one and back.metadata == one.metadata
    assert "HiddenVolume(values=float32" in repr(one) and "method=fk" in repr(one)
    assert "<table>" in one._repr_html_()


def test_pictures_are_sums_over_channels_and_the_highest_of_a_film():
    sizes = (2, 4, 3)
    values = torch.rand(5, 3, *sizes, generator=torch.Generator().manual_seed(0))
    grid = replace(GRID.at_depths([0.3, 0.4]), size=sizes[1:])
    torch.testing.assert_close(N.HiddenVolume(values, grid, "fk").picture(), values[0].sum(0))
    torch.testing.assert_close(N.HiddenVolume(values[1], grid, "fk").picture(), values[1].sum(0))
    times = torch.tensor([0.1, 0.2, 0.3, 0.5])
    film = torch.rand(5, 3, 4, *sizes, generator=torch.Generator().manual_seed(1))
    # One channel, three channels, a batch: the highest value of all times at each voxel.
    for one, expected in ((film, film[0].sum(0).amax(0)), (film[2], film[2].sum(0).amax(0)),
                          (film[2, 1:2], film[2, 1].amax(0))):  # fmt: skip
        found = N.HiddenVolume(one, grid, "phasor_field", times=times).picture()
        assert found.shape == sizes
        torch.testing.assert_close(found, expected)
    assert "times=4 of them" in repr(N.HiddenVolume(film, grid, "phasor_field", times=times))


@together("change, error, words", [
    ({"values": torch.ones(2, 3, 4)}, ShapeError, r"expected values \(\.\.\., C, 2, 3, 4\), real, got \(2, 3, 4\)"),
    ({"values": torch.ones(1, 2, 3, 4, dtype=torch.complex64)}, ShapeError, "torch.complex64"),
    ({"times": torch.tensor([0.1, float("inf")])}, UnitError, "expected finite times"),
    ({"times": torch.ones(2)}, ShapeError, r"expected values \(\.\.\., C, 2, 2, 3, 4\)"),
    ({"directions": torch.ones(1, 2, 2, 3, 4)}, ShapeError, r"expected directions \(\.\.\., C, 3, 2, 3, 4\)"),
    ({"directions": torch.ones(2, 3, 2, 3, 4)}, ShapeError, "expected directions for each of the values"),
    ({"metadata": {"a": object()}}, StorageError, "HiddenVolume"),
])  # fmt: skip
def test_parts_that_do_not_belong_together(change, error, words):
    parts = {"values": torch.ones(1, 2, 3, 4), "grid": replace(GRID.at_depths([0.3, 0.4]), size=(3, 4)), "method": "fk"}
    N.HiddenVolume(**parts)
    with pytest.raises(error, match=words):
        N.HiddenVolume(**{**parts, **change})
