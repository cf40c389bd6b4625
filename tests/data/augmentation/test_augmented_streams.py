"""Augmented streams: the same sample comes out the same, whoever reads it, and anew in each epoch and use."""

from __future__ import annotations

import pickle

import pytest
import torch
from torch.utils.data import DataLoader, Subset

import torchtransient as tt
from support.stored_samples import folder
from torchtransient.data import Augment, Augmented, AugmentedStream, Flip, TransientDataset, TransientStream
from torchtransient.errors import ArgumentError, SceneError, UnitError

N = 11


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return folder(tmp_path_factory.mktemp("data") / "set", N)


def by_index(stream):
    found = {}
    for sample in stream:
        found.setdefault(int(sample["index"]), []).append(sample["depth"])
    return found


def test_maps_belong_to_samples_and_epochs(data):
    def streamed(seed=4, **order):
        return AugmentedStream(TransientStream(data, fields=["depth"], **order), Augment(Flip(p=0.5)), seed=seed)

    def same(found, other):
        return all(torch.equal(found[i][0], other[i][0]) for i in range(N))

    stream = streamed()
    first, plain = by_index(stream), by_index(TransientStream(data, fields=["depth"]))
    assert {i: len(one) for i, one in first.items()} == dict.fromkeys(range(N), 1)
    flipped = {i: torch.equal(first[i][0], plain[i][0].flip(-1)) for i in range(N)}
    assert set(flipped.values()) == {True, False}
    assert all(done or torch.equal(first[i][0], plain[i][0]) for i, done in flipped.items())
    # Other readers, other orders.
    halves = [by_index(streamed(rank=r, world_size=2)) for r in (0, 1)]
    for found in (by_index(streamed(seed=4, shuffle=False)), halves[0] | halves[1]):
        assert same(found, first)
    assert same(by_index(pickle.loads(pickle.dumps(stream))), first)
    stream.set_epoch(1)
    second = by_index(stream)
    assert stream.num_samples == N and stream.epoch == 1 and not same(second, first)
    assert not same(by_index(streamed(seed=5)), first)
    sizes = {tuple(batch["depth"].shape) for batch in DataLoader(stream, batch_size=N)}
    assert sizes == {(N, *plain[0][0].shape)}


@pytest.mark.parametrize("workers", [0, 1])
def test_an_epoch_of_a_data_set(data, workers):
    """Numbers alone do not tell epochs apart: the data set is told, and so are workers that stay."""
    augmented = Augmented(TransientDataset(data, fields=["depth"]), Augment(Flip(p=0.5)), seed=1)
    loader = DataLoader(augmented, batch_size=N, num_workers=workers, persistent_workers=workers > 0)
    first = next(iter(loader))["depth"]
    assert torch.equal(next(iter(loader))["depth"], first)
    augmented.set_epoch(1)
    second = next(iter(loader))["depth"]
    assert not torch.equal(second, first)
    expected = torch.stack([augmented.sample(n, 1)["depth"] for n in range(N)])
    assert torch.equal(second, expected) and augmented.epoch == 1
    augmented.set_epoch(0)
    assert torch.equal(next(iter(loader))["depth"], first)


@pytest.mark.parametrize("workers", [0, 1])
def test_batches_draw_maps_and_noise_anew_in_each_pass(data, workers):
    noisy = TransientDataset(data, fields=["depth"], transform=torch.poisson, seed=1)
    augmented = Augmented(noisy, Augment(Flip(p=0.5)), seed=1)
    batches, read = tt.training.Batches(N, 4), {}
    for _, batch in zip(range(6), batches.loader(augmented, workers=workers), strict=False):
        for number, *found in zip(batch["index"].tolist(), batch["depth"], batch["measurement"], strict=True):
            read.setdefault(number, []).append(found)
    for passes in (0, 1):
        for number, found in read.items():
            expected = augmented.sample(number, passes)
            assert torch.equal(found[passes][0], expected["depth"])
            assert torch.equal(found[passes][1], expected["measurement"])
    assert not all(torch.equal(first[0], second[0]) for first, second, *_ in read.values())


def test_batches_of_a_part_draw_anew_too(data):
    noisy = TransientDataset(data, fields=["depth"], transform=torch.poisson, seed=1)
    part = Subset(Subset(noisy, range(2, N)), [3, 1])
    batches = tt.training.Batches(2, 2, shuffle=False)
    for passes, batch in zip(range(2), batches.loader(part), strict=False):
        expected = [noisy.sample(number, passes)["measurement"] for number in (5, 3)]
        assert torch.equal(batch["measurement"], torch.stack(expected))


def test_samples_of_two_folders_with_one_number(data, tmp_path):
    """Draws of their own; those of a stream wherever it goes on."""
    folders = [data, folder(tmp_path / "other", N)]

    def noise(where):
        samples = TransientDataset(where, fields=["transient"], transform=noisy, seed=0)
        return [float((sample["measurement"] - sample["transient"]).double().sum()) for sample in samples]

    assert len(set(noise(folders))) == 2 * N and noise(folders)[:N] == noise(folders[0])
    stream = AugmentedStream(TransientStream(folders, fields=["depth"]), Augment(Flip(p=0.5)), seed=4)
    whole = [sample["depth"] for sample in stream]
    stream.set_epoch(0, 3, 4)
    rest = [sample["depth"] for sample in stream]
    assert len(rest) == 2 * N - 12 and all(torch.equal(a, b) for a, b in zip(rest, whole[12:], strict=True))


class Again(torch.utils.data.IterableDataset):
    """The same sample again and again."""

    def __init__(self, **entries):
        self.entries, self.closed = entries, False

    def __iter__(self):
        yield from ({"depth": torch.arange(6.0).reshape(2, 3), **self.entries} for _ in range(40))

    def close(self):
        self.closed = True


def test_samples_that_are_used_again_are_turned_anew():
    def found(seed, **entries):
        with AugmentedStream(Again(**entries), Augment(Flip(p=0.5)), seed=seed) as stream:
            drawn = [sample["depth"][0, 0].item() for sample in stream]
        assert stream.closed  # other attributes are those of the stream
        return drawn

    # 40 tosses of a coin are all alike once in 5e11 seeds.
    assert set(found(0, index=3)) == {0.0, 2.0}
    assert found(0, index=3) == found(0, index=3) != found(1, index=3)
    assert set(found(None)) == {0.0, 2.0}
    for entries in ({}, {"index": -1}):
        with pytest.raises(SceneError, match="index"):
            found(0, **entries)


def noisy(light, generator=None):
    return light + torch.rand(light.shape, generator=generator)


def test_an_epoch_is_one_of_the_data_set_too(data):
    """Else each epoch would turn the same noise."""
    stored = TransientDataset(data, fields=["depth"], transform=noisy, seed=1)
    augmented = Augmented(stored, Augment(Flip(p=0.0)), seed=2)
    for epoch in (None, 0, 1):
        assert torch.equal(augmented.sample(3, epoch)["measurement"], stored.sample(3, epoch)["measurement"])
    assert not torch.equal(augmented.sample(3, 0)["measurement"], augmented.sample(3, 1)["measurement"])
    assert torch.equal(augmented[3 - N]["measurement"], augmented[3]["measurement"])


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda data: Augmented(TransientStream(data), Augment(Flip())), ArgumentError, "AugmentedStream"),
        (lambda data: AugmentedStream(TransientDataset(data), Augment(Flip())), ArgumentError, "use Augmented"),
        (lambda data: Augmented([1], Augment(Flip()), seed=-1), UnitError, "seed"),
        (lambda data: Augmented([1], Augment(Flip()), seed=0).sample(0, -1), UnitError, "epoch"),
        (lambda data: Augmented([1, 2], Augment(Flip()))[2], IndexError, "from 0 to 1"),
        (lambda data: AugmentedStream(TransientStream(data), Augment(Flip())).nothing, AttributeError, "nothing"),
    ],
)
def test_what_it_refuses(data, call, error, message):
    with pytest.raises(error, match=message):
        call(data)
