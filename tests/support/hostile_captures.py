"""Capture files that were damaged, or made to harm: bytes, names, shapes, kinds of numbers, links, YAML."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import h5py
import numpy as np

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join(['*' + a] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
TEXTS = (
    BOMB, "!!python/object/apply:os.system ['touch {executed}']", "!!python/object/new:os.system ['touch {executed}']",
    "[" * 100_000, "{" * 100_000, "a: *b", "&a [*a]", "a: !!int 9e999", "\0", "- " * 5_000, "!!binary '%'",
    "torchtransient: '[]'", "torchtransient: '{\"wall\": 3}'", "torchtransient: '{'",
    "config: {histogram_mode: frequency, wl_mean: 1.0e-300, wl_sigma: .nan, num_bins: 9999999999, bin_width_opl: .inf}",
    "? [a]\n: b", "1: 2", "~",
    "torchtransient: '" + "[" * 3_000 + "'", "!!timestamp 2020-01-01", "a: " + "9" * 10_000, "[" + "1, " * 2**17 + "]",
)  # fmt: skip


def old_mat(path):
    """A MATLAB file before 7.3 in the layout of phasor fields, compressed."""
    import scipy.io

    dataset = {
        "data": np.arange(12.0).reshape(3, 1, 4), "laserPos": np.eye(3), "cameraPos": np.zeros((1, 3)), "deltat": 0.003,
        "t0": 0.0, "t": 4.0, "laserOrigin": np.ones((1, 3)), "cameraOrigin": np.ones((1, 3)),
    }  # fmt: skip
    scipy.io.savemat(path, {"dataset": dataset, "minimalpos": np.zeros(3)}, do_compression=True)
    return path


def lead_elsewhere(file, name, way):
    """Put a dataset into an HDF5 file whose numbers lie in another file, or nowhere, in one of WAYS ways."""
    shape = (4, 4, 4, 4)
    if way == 0:
        file.create_dataset(name, shape, "u1", external=[("/etc/passwd", 0, 256)])
    elif way == 1:
        layout = h5py.VirtualLayout(shape=shape, dtype="u1")
        layout[:] = h5py.VirtualSource("/etc/passwd", "a", shape=shape)
        file.create_virtual_dataset(name, layout)
    elif way in (2, 3):
        file[name] = h5py.ExternalLink("/etc/passwd", "/a") if way == 2 else h5py.SoftLink("/steady")
    elif way in (4, 5):  # terabytes
        file.create_dataset(name, (2**14, 2**14, 2**14), "f4", chunks=True, compression="gzip" if way == 5 else None)
    elif way == 6:
        file.create_group(name)
    else:
        settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        settings.set_chunk(shape)
        # No library on this machine knows it, and HDF5 would look for it in its folders of plugins.
        settings.set_filter(31999, h5py.h5z.FLAG_OPTIONAL, (1,))
        h5py.h5d.create(file.id, name.encode(), h5py.h5t.IEEE_F32LE, h5py.h5s.create_simple(shape), settings)


WAYS = 8


def structure_changed(source: Path, target: Path, rng: random.Random) -> None:
    """A dataset of an HDF5 file is missing, or is another in shape, kind, size or place."""
    shutil.copyfile(source, target)
    with h5py.File(target, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        name = rng.choice(names)
        old = file[name]
        attributes = dict(old.attrs)
        shape = getattr(old, "shape", None)
        del file[name]
        _CHANGES[rng.randrange(len(_CHANGES))](file, name, shape, rng)
        if name in file and isinstance(file.get(name, getlink=True), h5py.HardLink):
            file[name].attrs.update(attributes)


def _missing(file, name, shape, rng):
    pass


def _empty(file, name, shape, rng):
    file[name] = h5py.Empty("f4")


def _huge(file, name, shape, rng):
    # Terabytes that nobody stored: contiguous, in chunks, compressed.
    sizes = tuple(2**14 for _ in (shape or (1, 1, 1)))
    settings = rng.choice([{}, {"chunks": True}, {"chunks": True, "compression": "gzip"}])
    file.create_dataset(name, sizes, "f8", **settings)


def _other_numbers(file, name, shape, rng):
    kind = rng.choice(["i1", "u8", "f2", "f8", ">f4", "c8", "?", "S5", "V3", "f16", "u4"])
    file.create_dataset(name, shape or (), kind)


def _other_shape(file, name, shape, rng):
    axes = [rng.choice([0, 1, 2, 3, 4, 5, 6, 7, 100]) for _ in range(rng.randrange(8))]
    file.create_dataset(name, tuple(axes), "f4") if np.prod(axes) < 1e6 else _missing(file, name, shape, rng)


def _not_finite(file, name, shape, rng):
    file[name] = np.full(shape or (), rng.choice([np.nan, np.inf, -1.0, 0.0, 1e308, -1e308]))


def _objects(file, name, shape, rng):
    kind = rng.choice(
        [h5py.ref_dtype, h5py.vlen_dtype(np.int32), h5py.string_dtype(), np.dtype([("a", "f4"), ("b", "i4")])]
    )
    file.create_dataset(name, shape or (), kind)


def _text(file, name, shape, rng):
    file[name] = rng.choice([text for text in TEXTS if "\0" not in text])


def _group(file, name, shape, rng):
    file.create_group(name)["inner"] = 3.0


def _link(file, name, shape, rng):
    file[name] = rng.choice([h5py.SoftLink("/"), h5py.SoftLink("/nowhere"), h5py.ExternalLink("/etc/passwd", "/a")])


def _elsewhere(file, name, shape, rng):
    file.create_dataset(name, shape or (4,), "u1", external=[("/etc/passwd", 0, 2**20)])


def _virtual(file, name, shape, rng):
    layout = h5py.VirtualLayout(shape=(4,), dtype="f4")
    layout[:] = h5py.VirtualSource("/etc/passwd", "a", shape=(4,))
    file.create_virtual_dataset(name, layout)


_CHANGES = (
    _missing, _empty, _huge, _other_numbers, _other_shape, _not_finite, _objects, _text, _group, _link, _elsewhere,
    _virtual,
)  # fmt: skip
