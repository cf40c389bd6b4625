"""Samples as makers of recipes return them, made of random numbers, for tests of data sets on disk."""

from __future__ import annotations

import numpy as np

from torchtransient.data import Sample, ShardWriter

AXIS = {"start_opl": 3.5, "bin_width_opl": 0.02, "num_bins": 256}


def cube(index, shape=(1, 256, 16, 16)):
    """Sparse positive numbers, as transients are."""
    rng = np.random.default_rng(index)
    return (rng.gamma(0.5, size=shape) * (rng.random(shape) < 0.3)).astype(np.float32)


def sample(index, shape=(1, 256, 16, 16), counts=False):
    """A transient with labels, a vector and a text."""
    x = cube(index, shape)
    rng = np.random.default_rng(index + 1000)
    arrays = {
        "transient": x, "steady": x.sum(-3), "depth": rng.random(shape[-2:], np.float32),
        "normals": rng.random((3, *shape[-2:]), np.float32), "shape": rng.integers(-1, 9, shape[-2:]).astype(np.int32),
    }  # fmt: skip
    if counts:
        arrays = {"measurement": rng.poisson(x * 5).astype(np.float32), "depth": arrays["depth"]}
    values = {"red.reflectance.value": rng.random(3, np.float32), "box.filename": f"größe_{index}.ply", "count": index}
    outside, structure = (0.01, index * 0.5), f"structure {index % 2}"
    return Sample(index, index * 7919 % 2**32, arrays=arrays, values=values, outside=outside, structure=structure)


def header(number=0, n=8, per_shard=4):
    """The header of a shard."""
    return {
        "recipe": {"scene": "cornell_box", "n": n}, "key": "abc123", "shard": number,
        "about": {"axis": AXIS, "channels": ["Y"], "spp": 16, "plan": ["a line"], "versions": {"torch": "2"}},
        "standard_error": 0.25, "store": "exact",
    }  # fmt: skip


def write(path, samples, store="exact", compression="blosc2", rows=None, **header_entries):
    """A shard of samples in order; exceptions among them are failures."""
    with ShardWriter(path, len(samples), {**header(), **header_entries}, store=store, compression=compression) as shard:
        for row in range(len(samples)) if rows is None else rows:
            if isinstance(samples[row], Exception):
                shard.fail(row, row, str(samples[row]))
            else:
                shard.put(row, samples[row])
    return path


def folder(path, n=10, per_shard=4, **options):
    """A data set of several shards."""
    path.mkdir(exist_ok=True)
    for number in range(-(-n // per_shard)):
        samples = [sample(i) for i in range(number * per_shard, min(n, (number + 1) * per_shard))]
        write(path / f"shard-{number:06d}.h5", samples, **options, shard=number)
    return path
