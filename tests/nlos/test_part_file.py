"""Part files: what is finished survives kills, full disks and other processes; what is damaged is said. Captures as
rows of numbers come back without a change.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import asdict

import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.errors import StorageError
from torchtransient.nlos.part_file import FORMAT, PartFile, RowLayout, delete_part_file

ABOUT = {"a": [1, 2]}


def rows(number, count=2, columns=5):
    return np.full((count, columns), number + 0.1, dtype=np.float32)


def keep(kept, number, **settings):
    settings = {"total": 6, "seconds": 0.5, "about": ABOUT} | settings
    kept.keep(number, settings.pop("first", 2 * number), rows(number), **settings)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.h5.part"


def test_parts_come_back(path):
    with PartFile(path, "key") as kept:
        assert kept.last is None and not kept.has(0)
        keep(kept, 2)
        keep(kept, 0)
    np.testing.assert_array_equal(np.load(path.with_name(path.name + ".npy"))[4:6], rows(2))
    with PartFile(path, "key") as kept:
        assert [kept.has(n) for n in range(3)] == [True, False, True] and kept.last == 2
        assert kept.about == ABOUT and kept.seconds == 1.0
        np.testing.assert_array_equal(kept.rows(4, 2), rows(2))
        keep(kept, 1)
        np.testing.assert_array_equal(kept.everything(), np.concatenate([rows(n) for n in range(3)]))
        kept.remove()
    assert os.listdir(path.parent) == []


def test_a_part_in_the_place_of_another(path):
    """Sums take turns: the one before stays whole until the next is."""
    with PartFile(path, "key") as kept:
        keep(kept, 0, total=4, first=0)
        keep(kept, 1, total=4, first=2, instead_of=0)
        keep(kept, 2, total=4, first=0, instead_of=1)
    with PartFile(path, "key") as kept:
        assert kept.last == 2 and not kept.has(1)
        np.testing.assert_array_equal(kept.rows(0, 2), rows(2))


@pytest.mark.parametrize("text", ["", "something else", '{"format": "torchtransient part 1"}', "[1]"])
def test_files_that_are_no_part_files(path, text):
    path.write_text(text)
    for opened in (lambda: PartFile(path, "key").__enter__(), lambda: delete_part_file(path)):
        with pytest.raises(StorageError, match="not the part file of a simulation"):
            opened()
    assert path.read_text() == text and os.listdir(path.parent) == [path.name]


@pytest.mark.parametrize("cut", [0, 20, 130, -1])
def test_rows_that_are_cut_off(path, cut):
    with PartFile(path, "key") as kept:
        keep(kept, 2)
    data = path.with_name(path.name + ".npy")
    data.write_bytes(data.read_bytes()[:cut])
    with pytest.raises(StorageError, match=r"damaged or cut off|could not be read"), PartFile(path, "key"):
        pass


def test_rows_that_were_changed(path):
    with PartFile(path, "key") as kept:
        keep(kept, 1)
    data = path.with_name(path.name + ".npy")
    whole = bytearray(data.read_bytes())
    whole[-25] ^= 1  # of rows that nobody has written
    data.write_bytes(whole)
    with PartFile(path, "key") as kept:
        assert kept.has(1)
    whole[-50] ^= 1
    data.write_bytes(whole)
    words = r"^part file: '.*npy' is damaged .* rows 2 to 3 are not those.*Delete both"
    with pytest.raises(StorageError, match=words), PartFile(path, "key"):
        pass


def test_rows_that_are_gone(path):
    with PartFile(path, "key") as kept:
        keep(kept, 1)
    path.with_name(path.name + ".npy").unlink()
    words = r"part\.npy', which holds the rows .* is gone\. Put it back, or delete '.*a\.h5\.part' to start anew\.$"
    with pytest.raises(StorageError, match=words), PartFile(path, "key"):
        pass
    # As it says.
    path.unlink()
    with PartFile(path, "key") as kept:
        keep(kept, 1)
        assert kept.has(1)


def test_a_full_disk_loses_nothing(path, monkeypatch):
    real = os.fsync
    with PartFile(path, "key") as kept:
        keep(kept, 0)

        def full(_):
            raise OSError(28, "No space left on device")

        for number, fails_at in ((1, 1), (2, 2)):  # while rows are written, while the list of parts is
            calls = iter(range(1, 9))
            monkeypatch.setattr(os, "fsync", lambda f: full(f) if next(calls) == fails_at else real(f))  # noqa: B023
            with pytest.raises(StorageError, match="No space left"):
                keep(kept, number)
            assert not kept.has(number)
        monkeypatch.setattr(os, "fsync", real)
        keep(kept, 1)
    with PartFile(path, "key") as kept:
        assert kept.has(0) and kept.has(1) and not kept.has(2)
        np.testing.assert_array_equal(kept.rows(0, 4), np.concatenate([rows(0), rows(1)]))


@pytest.mark.slow
def test_one_process_at_a_time(path):
    script = (
        "import sys, time; from pathlib import Path; from torchtransient.nlos.part_file import PartFile\n"
        f"with PartFile(Path({str(path)!r}), 'key'):\n    print('in', flush=True); time.sleep(60)"
    )
    with PartFile(path, "key"), pytest.raises(StorageError, match=r"another process works on '.*a\.h5\.part'"):
        PartFile(path, "key").__enter__()
    child = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout.readline() == "in\n"
        with pytest.raises(StorageError, match="another process"), PartFile(path, "key"):
            pass
    finally:
        child.kill()
        child.wait()
    with PartFile(path, "key") as kept:  # a killed process holds nothing
        keep(kept, 0)
    delete_part_file(path)
    assert os.listdir(path.parent) == []


def test_files_of_others(path):
    """Of another simulation or another form: they are neither read nor deleted."""
    with PartFile(path, "key") as kept:
        keep(kept, 0)
    with pytest.raises(StorageError, match=r"belongs to another simulation.*delete it"), PartFile(path, "other"):
        pass
    with PartFile(path, "key") as kept:
        assert kept.has(0)
    path.write_text(path.read_text().replace(FORMAT, "torchtransient part 1"))
    for opened in (lambda: PartFile(path, "key").__enter__(), lambda: delete_part_file(path)):
        with pytest.raises(StorageError, match="belongs to another simulation"):
            opened()
    assert path.exists()


# ----------------------------------------------------------------------------------------------------- captures as rows

WALL = tt.nlos.Wall.plane(2.0, 1.6)
SCANS = {
    "exhaustive": tt.nlos.Scan.grid(WALL, (4, 3), kind="exhaustive", laser_grid=(2, 1)),
    "list": tt.nlos.Scan.points([[0.0, 0, 0], [0.1, 0.2, 0]], kind="confocal", sensor_origin=[0, 0, 1],
                                laser_origin=[0, 0, 1]),
}  # fmt: skip


@pytest.mark.parametrize("kind", SCANS)
@pytest.mark.parametrize("front", [(3,), (4, 1)])
@pytest.mark.parametrize("phasor", [False, True])
@pytest.mark.parametrize("steady", [False, True])
def test_there_and_back(kind, front, phasor, steady):
    """Without a copy where none is needed."""
    scan, generator = SCANS[kind], torch.Generator().manual_seed(0)
    polarized = len(front) == 2
    cube = torch.randn(*front, 3, *scan.shape, generator=generator, dtype=torch.complex64 if phasor else torch.float32)
    image = torch.randn(*front, *scan.shape, generator=generator) if steady else None
    axes = (None, tt.FrequencyAxis((0.1, 0.2, 0.3))) if phasor else (tt.TimeAxis(0.5, 0.1, 3), None)
    made = tt.nlos.Capture(
        None if phasor else cube, axes[0], scan, phasor=cube if phasor else None, frequencies=axes[1], steady=image,
        channels=tuple("abc"[: front[-1]]), polarized=polarized,
    )  # fmt: skip
    layout = RowLayout.of(made)
    found = layout.rows(made)
    assert found.shape == (len(scan.sensor_points.reshape(-1, 3)), layout.columns) and found.dtype == np.float32
    back = tt.nlos.Capture(**RowLayout.from_plain(asdict(layout)).capture(found, scan, *axes))
    assert back.tensors().keys() == made.tensors().keys()
    for name, tensor in made.tensors().items():
        assert torch.equal(back.tensors()[name], tensor)
    assert (back.channels, back.polarized) == (made.channels, made.polarized)
    if not phasor:
        assert back.transient.data_ptr() == torch.from_numpy(found).data_ptr()
