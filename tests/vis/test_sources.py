"""Arrays, results and files: the same picture from each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.cubes import AXIS, sweep
from torchtransient.errors import ShapeError, StorageError
from torchtransient.files import read_result, write_result
from torchtransient.files.result_file import Result
from torchtransient.vis.sources import images_of, phasor_of, stokes_of, transient_of


@dataclass
class Output:
    """What the pictures need of a RenderOutput."""

    transient: Any = None
    steady: Any = None
    phasor: Any = None
    axis: Any = None
    frequencies: Any = None
    polarized: bool = False
    gated: Any = None


def test_files_hold_what_was_rendered(tmp_path):
    scene = tt.load(tt.scenes.cornell_box(resolution=4, num_bins=8, bin_width_opl=1.0, spp=4, max_depth=3))
    with torch.no_grad():
        output = tt.render(scene, seed=0)
    paths = [write_result(tmp_path / name, output) for name in ("a.h5", "a.npz")]
    for source in (output, *paths, *map(str, paths), *map(read_result, paths)):
        cube, axis = transient_of(source)
        assert torch.equal(cube, output.transient)
        assert axis == output.axis


def test_arrays(tmp_path):
    cube = sweep()
    np.save(tmp_path / "a.npy", cube.numpy())
    for source in (cube, cube.numpy(), cube.half(), cube.double(), tmp_path / "a.npy", cube.clone().requires_grad_()):
        got, axis = transient_of(source, AXIS)
        assert torch.equal(got.float(), cube)
        assert axis == AXIS and not got.requires_grad


def test_polarized_sources():
    stokes = torch.rand(4, 3, 10, 2, 5)
    assert torch.equal(transient_of(stokes)[0], stokes[0])
    assert torch.equal(stokes_of(stokes, 3), stokes[:, :, 3])
    assert torch.equal(stokes_of(stokes), stokes.sum(2))
    output = Output(stokes, stokes.sum(2), axis=AXIS, polarized=True)
    assert torch.equal(stokes_of(output), stokes.sum(2))
    assert torch.equal(stokes_of(output, 9), stokes[:, :, 9])
    with pytest.raises(ShapeError, match="expected Stokes vectors"):
        stokes_of(sweep())


def test_a_batch_of_four_is_not_polarization(tmp_path):
    batch = torch.rand(4, 3, 10, 2, 5)
    with pytest.raises(ShapeError, match="batch"):
        transient_of(Output(batch, batch.sum(2), axis=AXIS))
    for name, variant in (("a.npz", "llvm_ad_rgb"), ("b.npz", "llvm_ad_mono_polarized")):
        write_result(tmp_path / name, Result(batch, batch.sum(2), AXIS, {"stats": {"variant": variant}}))
    with pytest.raises(ShapeError, match="batch"):
        transient_of(tmp_path / "a.npz")
    assert torch.equal(transient_of(tmp_path / "b.npz")[0], batch[0])


def test_phasors():
    values = torch.randn(3, 2, 4, 5, dtype=torch.complex64)
    got, frequencies = phasor_of(Output(phasor=values, frequencies=tt.FrequencyAxis((1.0, 2.0))))
    assert torch.equal(got, values) and frequencies == (1.0, 2.0)
    assert torch.equal(phasor_of(values.numpy())[0], values)
    with pytest.raises(ShapeError, match="expected complex"):
        phasor_of(values.real)
    with pytest.raises(ShapeError, match="holds no phasor"):
        phasor_of(Output(sweep()))


def test_broken_files(tmp_path):
    for name in ("a.h5", "a.npz", "a.npy"):
        (tmp_path / name).write_bytes(b"nonsense")
        with pytest.raises(StorageError, match="is damaged"):
            transient_of(tmp_path / name)
    with pytest.raises(StorageError, match="does not exist"):
        transient_of(tmp_path / "b.h5")
    np.savez(tmp_path / "c.npz", other=np.zeros(3))
    with pytest.raises(StorageError, match="names no format"):
        transient_of(tmp_path / "c.npz")


def test_which_shapes_are_what():
    four = torch.rand(4, 5, 2, 3)
    with pytest.raises(ShapeError, match=r"got \(4, 5, 2, 3\)"):
        transient_of(four)
    assert torch.equal(transient_of(four, any_channels=True)[0], four)
    turned = torch.complex(torch.rand(4, 3, 2, 5, 6), torch.rand(4, 3, 2, 5, 6))
    assert torch.equal(phasor_of(turned)[0], turned[0])
    with pytest.raises(ShapeError, match="expected complex"):
        phasor_of(turned[:3])
    back = np.arange(30.0).reshape(1, 5, 2, 3)[..., ::-1]
    assert transient_of(back)[0].tolist() == back.tolist()


def test_films_in_files(tmp_path):
    cube, steady = torch.rand(1, 2, 4, 3), torch.rand(1, 4, 3)
    gates, frequencies = (tt.Gate.rectangular(1.0, 2.0), tt.Gate.gaussian(3.0, 0.5)), tt.FrequencyAxis((1.5, 2.5))
    write_result(tmp_path / "a.npz", Result(None, steady, None, gated=cube, gates=gates))
    write_result(tmp_path / "b.npz", Result(None, steady, None, phasor=cube * 1j, frequencies=frequencies))
    found, axis, word = images_of(tmp_path / "a.npz")
    assert torch.equal(found, cube) and axis is None and word == "gate"
    found, known = phasor_of(tmp_path / "b.npz")
    assert torch.equal(found, cube * 1j) and known == (1.5, 2.5)
