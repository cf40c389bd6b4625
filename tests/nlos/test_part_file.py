"""Part files: what is finished survives kills, full disks and other processes; what is damaged is said."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from torchtransient.errors import StorageError
from torchtransient.nlos import part_file
from torchtransient.nlos.part_file import PartFile, delete_part_file

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
    with PartFile(path, "key") as kept:
        assert [kept.has(n) for n in range(3)] == [True, False, True] and kept.last == 2
        assert kept.about == ABOUT and kept.seconds == 1.0
        np.testing.assert_array_equal(kept.rows(4, 2), rows(2))
        keep(kept, 1)
        np.testing.assert_array_equal(kept.everything(), np.concatenate([rows(n) for n in range(3)]))
        kept.remove()
    assert os.listdir(path.parent) == []


def test_others_can_read_the_rows(path):
    with PartFile(path, "key") as kept:
        keep(kept, 1)
    found = np.load(path.with_name(path.name + ".npy"))
    np.testing.assert_array_equal(found[2:4], rows(1))
    assert found.shape == (6, 5)


def test_a_part_in_the_place_of_another(path):
    """Sums take turns: the one before stays whole until the next is."""
    with PartFile(path, "key") as kept:
        keep(kept, 0, total=4, first=0)
        keep(kept, 1, total=4, first=2, instead_of=0)
        keep(kept, 2, total=4, first=0, instead_of=1)
    with PartFile(path, "key") as kept:
        assert kept.last == 2 and not kept.has(1)
        np.testing.assert_array_equal(kept.rows(0, 2), rows(2))


def test_another_simulation(path):
    with PartFile(path, "key") as kept:
        keep(kept, 0)
    with pytest.raises(StorageError, match=r"belongs to another simulation.*delete it"), PartFile(path, "other"):
        pass
    with PartFile(path, "key") as kept:
        assert kept.has(0)


@pytest.mark.parametrize("text", ["", "something else", "{}", '{"format": "torchtransient part 1"}', "[1]"])
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
            with pytest.raises(StorageError, match=r"No space left.*the same call goes on"):
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
    assert json.loads(path.read_text())["format"] == part_file.FORMAT
    delete_part_file(path)
    assert os.listdir(path.parent) == []


def test_a_folder_that_is_missing(tmp_path):
    with pytest.raises(StorageError, match="does not exist"), PartFile(tmp_path / "no" / "a.part", "key"):
        pass


def test_files_of_another_form(path):
    """Whatever their simulation: they are neither read nor deleted."""
    with PartFile(path, "key") as kept:
        keep(kept, 0)
    path.write_text(path.read_text().replace(part_file.FORMAT, "torchtransient part 1"))
    for opened in (lambda: PartFile(path, "key").__enter__(), lambda: delete_part_file(path)):
        with pytest.raises(StorageError, match="belongs to another simulation"):
            opened()
    assert path.exists()
