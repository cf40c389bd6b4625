"""Samples of shards by number: windows, pixels, transforms, workers; and as streams, each once an epoch over ranks and
workers, in an order that the seed and the epoch decide.
"""

from __future__ import annotations

import itertools
import pickle
import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import torchtransient as tt
from support.marks import long_rows
from support.stored_samples import AXIS, cube, folder, header, sample, write
from torchtransient.data import TransientDataset, TransientStream, build_manifest
from torchtransient.errors import ArgumentError, StorageError, TorchTransientError, TorchTransientWarning, UnitError


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return folder(tmp_path_factory.mktemp("data") / "set")


def doubled(transient):
    return 2 * transient


def test_samples(data):
    found = TransientDataset(data)
    assert len(found) == 10 and found.axis == tt.TimeAxis(**AXIS) and found.about["spp"] == 16
    for i in (0, 5, 9):
        item, made = found[i], sample(i)
        assert item["index"] == i and set(item) == {*made.arrays, "values", "outside", "index"}
        for name, array in made.arrays.items():
            assert item[name].dtype == torch.from_numpy(array).dtype and np.array_equal(item[name].numpy(), array)
        assert item["values"]["box.filename"] == f"größe_{i}.ply" and int(item["values"]["count"]) == i
    assert found[-1]["index"] == 9 and found.index.tolist() == list(range(10))
    with pytest.raises(IndexError):
        found[10]
    assert len(list(found)) == 10  # the old way of iterating, which ends with an IndexError


def test_where(data, tmp_path):
    names = sorted(map(str, data.glob("shard*")))
    for where in (str(data), str(data / "shard-*.h5"), [data], str(data.parent / "s*"), [names[0], *names[1:]]):
        assert len(TransientDataset(where)) == 10
    assert len(TransientDataset(names[2])) == 2 and TransientDataset(names[2])[0]["index"] == 8
    for where, message in ((tmp_path, "there is none"), ([], "there is none"), ([names[0], names[0]], "twice")):
        with pytest.raises(StorageError, match=message):
            TransientDataset(where)


@pytest.mark.filterwarnings("error")
def test_shards_that_are_gone_are_said(data, tmp_path):
    place = shutil.copytree(data, tmp_path / "set")
    build_manifest(place)
    assert len(TransientDataset(place)) == 10
    (place / "shard-000001.h5").unlink()
    words = r"'.*set' lacks 1 of the \d+ shards of its manifest.json: \['shard-000001.h5'\]"
    for where in (place, [place], str(tmp_path / "s*")):
        with pytest.warns(TorchTransientWarning, match=words) as said:
            assert len(TransientDataset(where)) < 10
        assert said[0].filename == __file__
    TransientDataset(sorted(map(str, place.glob("shard*"))))  # asked for by name


def test_failed_samples_are_left_out(tmp_path):
    write(tmp_path / "shard-000000.h5", [ValueError("dark"), sample(1), ValueError("dark")])
    write(tmp_path / "shard-000001.h5", [ValueError("x")])
    found = TransientDataset(tmp_path)
    assert len(found) == 1 and found[0]["index"] == 1 and found.failed == {0: "x", 2: "dark"}
    with pytest.raises(StorageError, match="all of them failed"):
        TransientDataset(tmp_path / "shard-000001.h5")


@pytest.mark.parametrize(
    ("window", "bins"),
    [
        (slice(64, 128), slice(64, 128)), (slice(-10, None), slice(246, 256)), ((3.5, 3.7), slice(0, 10)),
        ((4.005, 4.995), slice(25, 75)), ((4.001, 4.002), slice(25, 26)), ((None, 4.0), slice(0, 25)),
        ([8.0, None], slice(225, 256)), (None, slice(0, 256)),
        # Borders are those of a bin up to a millionth of one.
        ((4.0 - 1e-8, 5.0 + 1e-8), slice(25, 75)), ((4.0 - 1e-7, 5.0 + 1e-7), slice(24, 76)),
    ],
)  # fmt: skip
def test_windows(data, window, bins):
    found = TransientDataset(data, window=window)
    x = found[3]
    assert np.array_equal(x["transient"].numpy(), cube(3)[:, bins]) and x["steady"].shape == (1, 16, 16)
    edges = tt.TimeAxis(**AXIS).edges_opl[bins.start : bins.stop + 1]
    assert found.axis.num_bins == bins.stop - bins.start
    assert torch.allclose(found.axis.edges_opl, edges, rtol=0, atol=1e-12)


def test_windows_that_are_none(data, tmp_path):
    for window in ((3.0, 4.0), (4.0, 9.0), (5, 4), (4, 4), slice(9, 9)):
        with pytest.raises(StorageError, match="window"):
            TransientDataset(data, window=window)
    path = write(tmp_path / "a.h5", [sample(0)], about={"axis": {"frequencies": [1.0, 2.0]}})
    assert TransientDataset(path).axis is None
    with pytest.raises(StorageError, match="no time axis"):
        TransientDataset(path, window=slice(0, 3))


def test_a_window_reads_its_slabs_alone(tmp_path):
    """Chunks outside the window are damaged, and nobody looks at them."""
    about = {"axis": {**AXIS, "num_bins": 1024}}
    path = write(tmp_path / "shard-000000.h5", [sample(0, (1, 1024, 16, 16))], about=about)
    with h5py.File(path) as file:
        infos = [file["arrays/transient"].id.get_chunk_info(k) for k in range(16)]
    raw = bytearray(path.read_bytes())
    for info in infos:
        if info.chunk_offset[2] not in (128, 192):
            raw[info.byte_offset + 50] ^= 255
    path.write_bytes(raw)
    x = cube(0, (1, 1024, 16, 16))
    assert np.array_equal(
        TransientDataset(path, fields=["transient"], window=slice(130, 194))[0]["transient"], x[:, 130:194]
    )
    with pytest.raises(StorageError, match="damaged"):
        TransientDataset(path)[0]


def test_pixels(data):
    item = TransientDataset(data, pixels=(slice(2, 6), slice(8, None)))[0]
    made = sample(0).arrays
    assert item["transient"].shape == (1, 256, 4, 8) and item["normals"].shape == (3, 4, 8)
    for name, array in made.items():
        assert np.array_equal(item[name].numpy(), array[..., 2:6, 8:])
    for pixels in ((slice(16, 20), slice(None)), (slice(0, 9, 2), slice(None))):
        with pytest.raises(StorageError, match="pixels"):
            TransientDataset(data, pixels=pixels)


def test_fields(data):
    always = {"outside", "index"}
    assert set(TransientDataset(data, fields=["depth"])[0]) == {"depth", *always}
    assert set(TransientDataset(data, fields=["depth", "values", "index"])[0]) == {"depth", "values", *always}
    with pytest.raises(ArgumentError, match="expected fields among"):
        TransientDataset(data, fields=["albedo"])


def test_transforms(data, tmp_path):
    found = TransientDataset(data, fields=["depth"], window=slice(0, 64), transform=doubled)
    assert set(found[2]) == {"depth", "measurement", "outside", "index"} == {*found.fields, "outside", "index"}
    assert np.array_equal(found[2]["measurement"].numpy(), 2 * cube(2)[:, :64])
    chain = tt.sensing.Compose([tt.sensing.ShotNoise()])
    noisy = [TransientDataset(data, transform=chain.sample, seed=seed)[4]["measurement"] for seed in (1, 1, 2)]
    mean = TransientDataset(data, transform=chain, seed=1)[4]  # under its policy, "expected"
    assert torch.equal(mean["measurement"], mean["transient"])
    assert torch.equal(noisy[0], noisy[1]) and not torch.equal(noisy[0], noisy[2])
    one = TransientDataset(data, transform=chain.set_grad("straight_through"), seed=1)
    assert not torch.equal(one.sample(4, 0)["measurement"], one.sample(4, 1)["measurement"])
    module = torch.nn.Conv3d(1, 1, 1)
    assert not TransientDataset(data, transform=module)[0]["measurement"].requires_grad
    with pytest.raises(UnitError, match="seed"):
        TransientDataset(data, transform=chain, seed=-1)
    with pytest.raises(UnitError, match="epoch"):
        one.sample(4, -1)
    write(tmp_path / "shard-000000.h5", [replace(sample(0), arrays={"steady": np.ones((2, 3, 5))})])
    with pytest.raises(StorageError, match="transform= is for transients, and the samples have steady"):
        TransientDataset(tmp_path, transform=doubled)


def test_counts(tmp_path):
    folder(tmp_path, 3, store="rounded")
    samples = [sample(i, counts=True) for i in range(3)]
    samples[1].arrays["measurement"][0, 0, 0, 0] = 300
    path = write(tmp_path / "a.h5", samples, "counts")
    found, stored = TransientDataset(path), TransientDataset(path, as_stored=True)
    for i in range(3):
        assert found[i]["measurement"].dtype == torch.float32 and stored[i]["measurement"].dtype == torch.uint16
        assert np.array_equal(found[i]["measurement"].numpy(), samples[i].arrays["measurement"])
        assert np.array_equal(stored[i]["measurement"].numpy(), samples[i].arrays["measurement"])
        assert np.array_equal(found[i]["depth"].numpy(), samples[i].arrays["depth"])
    assert TransientDataset(path, window=slice(3, 9))[0]["measurement"].shape == (1, 6, 16, 16)


def test_measurements_on_other_axes_are_left_whole(tmp_path):
    made = sample(0)
    made.arrays["measurement"] = np.ones((1, 7, 8, 8), np.float32)
    path = write(tmp_path / "a.h5", [made])
    item = TransientDataset(path, window=slice(0, 9), pixels=(slice(0, 2), slice(0, 2)))[0]
    assert item["measurement"].shape == (1, 7, 8, 8) and item["transient"].shape == (1, 9, 2, 2)


@pytest.mark.parametrize(
    ("shape", "time"),
    [
        ((4, 1, 32, 6, 5), None), ((1, 32, 2, 3, 4, 5), None),
        # As many bins as rows, sensors or components: the header says where the time is.
        ((2, 1, 4, 4, 4), 2), ((4, 4, 4, 5), 1), ((2, 4, 1, 4, 4, 5), 3), ((1, 4, 4), 1), ((1, 4, 4, 4, 4, 4), 1),
    ],
)  # fmt: skip
def test_polarized_and_scanned_samples(tmp_path, shape, time):
    about = {"behind_time": len(shape) - 1 - time} if time else {"variant": "llvm_mono_polarized"}
    place = time or shape.index(32)
    transient = np.random.default_rng(0).random(shape, dtype=np.float32)
    made = replace(sample(0), arrays={"transient": transient, "steady": transient.sum(place)})
    about |= {"axis": {**AXIS, "num_bins": shape[place]}, "measures": "transient"}
    item = TransientDataset(write(tmp_path / "a.h5", [made], about=about), window=slice(1, 3))[0]
    assert np.array_equal(item["transient"].numpy(), transient.take([1, 2], place))
    assert item["steady"].shape == made.arrays["steady"].shape


def test_shards_that_do_not_belong_together(data, tmp_path):
    write(tmp_path / "a.h5", [sample(0, (1, 256, 8, 8))])
    with pytest.raises(StorageError, match="the same arrays in all shards"):
        TransientDataset([data, tmp_path / "a.h5"])
    write(tmp_path / "a.h5", [sample(0)], about={**header()["about"], "axis": {**AXIS, "start_opl": 9.0}})
    with pytest.raises(StorageError, match="the same axis in all shards"):
        TransientDataset([data, tmp_path / "a.h5"])


@pytest.mark.parametrize("workers", [0, ("fork", 2), pytest.param(("spawn", 2), marks=pytest.mark.slow)])
def test_loaders(data, workers):
    found = TransientDataset(data, window=slice(0, 64), transform=doubled)
    assert found[7]["index"] == 7  # files are open here
    options = {} if not workers else {"num_workers": workers[1], "multiprocessing_context": workers[0]}
    batches = list(DataLoader(found, batch_size=4, **options))
    assert [b["index"].tolist() for b in batches] == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]
    assert batches[0]["values"]["red.reflectance.value"].shape == (4, 3)
    assert batches[2]["values"]["box.filename"] == ["größe_8.ply", "größe_9.ply"]
    for batch in batches:
        expected = np.stack([2 * cube(i)[:, :64] for i in batch["index"].tolist()])
        assert np.array_equal(batch["measurement"].numpy(), expected)


def test_pickles_without_files(data):
    found = TransientDataset(data)
    first = found[0]
    twin = pickle.loads(pickle.dumps(found))
    assert len(pickle.dumps(found)) < 20_000 and torch.equal(twin[0]["transient"], first["transient"])
    found.close()
    assert torch.equal(found[0]["transient"], first["transient"])


# -------------------------------------------------------------------------------------------------------------- streams


N = 23


@pytest.fixture(scope="module")
def streamed(tmp_path_factory):
    return folder(tmp_path_factory.mktemp("data") / "set", N)


def indices(stream):
    return [item["index"] for item in stream]


def test_each_sample_once_in_a_shuffled_order(streamed):
    stream = TransientStream(streamed, fields=["depth"])
    first = indices(stream)
    assert sorted(first) == list(range(N)) and first != list(range(N)) and indices(stream) == first
    stream.set_epoch(1)
    second = indices(stream)
    assert sorted(second) == list(range(N)) and second != first and stream.epoch == 1
    assert indices(TransientStream(streamed, fields=["depth"], seed=1)) != first
    stream.set_epoch(0)
    assert indices(stream) == first and stream.num_samples == N
    assert indices(TransientStream(streamed, fields=["depth"], shuffle=False)) == list(range(N))


def test_whole_shards_follow_each_other(streamed, monkeypatch):
    """With a buffer of one sample, the files come one behind another."""

    def read(size):
        monkeypatch.setattr("torchtransient.data.transient_dataset._BUFFER", size)
        return indices(TransientStream(streamed, fields=["depth"]))

    base = read(1)
    files = [i // 4 for i in base]
    runs = 1 + sum(a != b for a, b in itertools.pairwise(files))
    assert runs == 6 and files != sorted(files)
    # With a buffer of five, nobody comes more than four places early.
    order = read(5)
    assert order != base and sorted(order) == sorted(base)
    assert all(base.index(number) - place <= 4 for place, number in enumerate(order))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("even", "world_size"),
    long_rows(itertools.product([False, True], [1, 2, 5, 30]), [(False, 30), (True, 2), (True, 5)]),
)
def test_ranks(streamed, world_size, even):
    shares = [
        TransientStream(streamed, fields=["depth"], rank=r, world_size=world_size, even=even) for r in range(world_size)
    ]
    found = [indices(share) for share in shares]
    assert [len(one) for one in found] == [share.num_samples for share in shares]
    together = sorted(i for one in found for i in one)
    counts = {len(one) for one in found}
    if even:
        assert counts == {N // world_size} and len(set(together)) == N // world_size * world_size
    else:
        assert together == list(range(N)) and max(counts) - min(counts) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_workers(streamed, context):
    """Workers that stay learn of the epoch; each sample comes once, over two ranks of two workers."""
    options = {"num_workers": 2, "multiprocessing_context": context, "persistent_workers": True, "batch_size": 3}
    streams = [TransientStream(streamed, rank=r, world_size=2, transform=doubled) for r in range(2)]
    loaders = [DataLoader(stream, **options) for stream in streams]
    epochs = []
    for epoch in range(2):
        found = []
        for stream, loader in zip(streams, loaders, strict=True):
            stream.set_epoch(epoch)
            for batch in loader:
                found += batch["index"].tolist()
                for k, i in enumerate(batch["index"].tolist()):
                    assert np.array_equal(batch["measurement"][k].numpy(), 2 * cube(i))
        assert sorted(found) == list(range(N))
        epochs.append(found)
    assert epochs[0] != epochs[1]


def test_ranks_of_the_environment(streamed, monkeypatch):
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "3")
    stream = TransientStream(streamed, fields=["depth"])
    expected = indices(TransientStream(streamed, fields=["depth"], rank=1, world_size=3))
    assert indices(stream) == expected
    raw = pickle.dumps(stream)
    # That of a process group counts more; a worker that does not know either takes the one that it was sent with.
    for name, value in (("is_initialized", True), ("get_rank", 2), ("get_world_size", 3)):
        monkeypatch.setattr(torch.distributed, name, lambda value=value: value)
    assert indices(stream) == indices(TransientStream(streamed, fields=["depth"], rank=2, world_size=3))
    assert indices(pickle.loads(raw)) == expected
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: False)
    monkeypatch.setenv("RANK", "x")
    with pytest.raises(StorageError, match="whole numbers"):
        indices(stream)


def test_noise_of_epochs(streamed):
    chain = tt.sensing.ShotNoise()
    stream = TransientStream(streamed, fields=["values"], transform=chain.sample, noise_seed=1, shuffle=False)
    first, again = (next(iter(stream))["measurement"] for _ in range(2))
    stream.set_epoch(1)
    assert torch.equal(first, again) and not torch.equal(first, next(iter(stream))["measurement"])


@pytest.mark.parametrize("arguments", [{"rank": 0}, {"rank": 2, "world_size": 2}, {"seed": -1}])
def test_arguments_of_streams(streamed, arguments):
    with pytest.raises(TorchTransientError):
        TransientStream(streamed, **arguments)


# Of two workers one has a batch less than the other.
STOPPED = [(0, 4, None), (2, 11, None), (3, 2, (1, 2))]


@pytest.mark.parametrize(("workers", "size", "rank"), long_rows(STOPPED, [STOPPED[0]]))
@pytest.mark.filterwarnings("ignore:This DataLoader will create")  # more workers than cores, for once
def test_an_epoch_goes_on_where_it_was_stopped(streamed, workers, size, rank):
    share = {} if rank is None else {"rank": rank[0], "world_size": rank[1]}

    def read(batches):
        stream = TransientStream(streamed, fields=["depth"], **share)
        stream.set_epoch(3, batches, size)
        return [batch["index"].tolist() for batch in DataLoader(stream, batch_size=size, num_workers=workers)]

    whole = read(0)
    for stop in range(len(whole) + 1) if workers == 0 else (1, len(whole) - 1, len(whole)):
        assert read(stop) == whole[stop:]
    stream = TransientStream(streamed, fields=["depth"], **share)
    # The epoch after it begins at its beginning.
    stream.set_epoch(3, 2, size)
    stream.set_epoch(4)
    assert len(indices(stream)) == stream.num_samples
