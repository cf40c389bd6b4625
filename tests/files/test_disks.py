"""Whatever is read or written by name: devices and pipes are no files, a full disk leaves the old file, and files
appear whole or not at all, on disks without locks or links too.
"""

from __future__ import annotations

import errno
import fcntl
import os
import platform
import resource
import signal
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import torchtransient as tt
from support.capture_files import ENDINGS, grids, holdable, made, volume
from support.fake_recipe import FakeRecipe
from support.killed_writers import output
from support.stored_samples import sample, write
from support.sweeps import together
from torchtransient.array_files import part_files
from torchtransient.errors import SceneError, StorageError, TorchTransientError
from torchtransient.files import read_result, write_result

SCENE = tt.scenes.parallel_plates()
AXIS = tt.TimeAxis(0.0, 0.1, 4)
LIGHT = torch.rand(3, 4, 8, 8, generator=torch.Generator().manual_seed(0))
PARTS = {"a": torch.nn.Linear(2, 2)}
DEVICE = tt.sensing.device("vl53l8_like")
READERS = {
    "result": (read_result, ".h5"), "archive": (read_result, ".npz"), "capture": (tt.nlos.Capture.read, ".mat"),
    "volume": (tt.nlos.read_volume, ".h5"), "setup": (tt.nlos.read_setup, ".yaml"),
    "recipe": (tt.data.Recipe.read, ".yaml"), "recipe in JSON": (tt.data.Recipe.read, ".json"),
    "device": (tt.sensing.Device.from_yaml, ".yaml"), "device in JSON": (tt.sensing.Device.from_json, ".json"),
    "checkpoint": (lambda path: tt.training.load_checkpoint(path, PARTS), ".pt"), "scene": (tt.load, ".xml"),
    "shard": (tt.data.Shard, ".h5"), "data set": (tt.data.TransientDataset, ".h5"), "verify": (tt.data.verify, ""),
    "tar": (lambda path: next(tt.data.read_web_dataset(path)), ".tar"),
}  # fmt: skip
# Text and pictures; those of arrays follow.
WRITERS = {
    "device": (DEVICE.to_yaml, ".yaml"), "device in JSON": (DEVICE.to_json, ".json"),
    "recipe": (tt.data.Recipe(SCENE, {}, spp=1, n=1).to_yaml, ".yaml"),
    "report": (tt.accuracy.AccuracyReport([], "a", {"b": "c" * 5000}).to_json, ".json"),
    "checkpoint": (lambda path: tt.training.save_checkpoint(path, PARTS, step=1), ".pt"),
    "scene": (lambda path: tt.load(SCENE, variant="llvm_ad_mono").save(path), ".xml"),
    "picture": (lambda path: tt.vis.peak_time_picture(LIGHT, path, axis=AXIS), ".png"),
    "image": (lambda path: tt.vis.rainbow(LIGHT, path, axis=AXIS), ".png"),
    "gif": (lambda path: tt.vis.video(LIGHT, path, axis=AXIS), ".gif"),
    "mp4": (lambda path: tt.vis.video(LIGHT, path, axis=AXIS), ".mp4"),
}  # fmt: skip
# Those that bring matplotlib, ffmpeg or Mitsuba take a second each.
SLOW = {"picture", "gif", "mp4", "scene"}
EACH_WRITER = [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in WRITERS]
NO_NAMES = (None, 5, b"a", ["a"], object(), "a\0b", "x" * 5000)


@together("name", READERS)
def test_neither_devices_nor_what_is_no_name_are_read(tmp_path, name):
    read, ending = READERS[name]
    place = tmp_path / f"{name}{ending}"
    place.symlink_to("/dev/null")
    for given in (place, *NO_NAMES):
        with pytest.raises(TorchTransientError):
            read(given)


@pytest.mark.parametrize("name", EACH_WRITER)
def test_neither_pipes_nor_what_is_no_name_are_written(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    write, ending = WRITERS[name]
    place = tmp_path / f"a{ending}"
    os.mkfifo(place)
    reading = os.open(place, os.O_RDONLY | os.O_NONBLOCK)  # or opening it would wait for a reader
    try:
        for given in (place, *NO_NAMES[1:]):  # without a name nothing is written
            with pytest.raises(TorchTransientError):
                write(given)
    finally:
        os.close(reading)
    assert stat.S_ISFIFO(place.stat().st_mode) and list(tmp_path.iterdir()) == [place]


@pytest.mark.parametrize("name", EACH_WRITER)
def test_full_disks(tmp_path, name):
    """A typed error of one line, the old file, nothing beside it."""
    write, ending = WRITERS[name]
    path = tmp_path / f"a{ending}"
    write(path)
    before, asked = path.read_bytes(), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 3, resource.RLIM_INFINITY))
    try:
        with pytest.raises(StorageError) as found:
            write(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        signal.signal(signal.SIGXFSZ, asked)
    assert "\n" not in str(found.value) and len(str(found.value)) < 500
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


XML = '<scene version="3.0.0"><integrator type="path"/><sensor type="perspective"/>{}</scene>'


MESH = '<shape type="{}"><string name="filename" value="a"/></shape>'
PICTURE = '<texture type="bitmap" name="reflectance"><string name="filename" value="a.png"/></texture>'


@together("content", [
    *map(MESH.format, ("ply", "obj", "serialized")), '<include filename="a"/>',
    f'<shape type="rectangle"><bsdf type="diffuse">{PICTURE}</bsdf></shape>',
    '<default name="here" value="a"/><include filename="inner.xml"/>',
])  # fmt: skip
def test_scenes_that_name_devices(tmp_path_factory, content):
    """Of meshes, textures and includes, those of included files too."""
    folder = tmp_path_factory.mktemp("scene")
    for name in ("a", "a.png"):
        (folder / name).symlink_to("/dev/null")
    (folder / "inner.xml").write_text('<scene version="3.0.0"><include filename="$here"/></scene>')
    (folder / "s.xml").write_text(XML.format(content))
    with pytest.raises(SceneError):
        tt.load(folder / "s.xml", variant="llvm_ad_mono").parameters()


# ------------------------------------------------------------------------------------------------------ files of arrays


def capture():
    return made(grids()["confocal"])


ARRAYS = {
    **{layout: lambda path, c=c, name=layout: c.write(path, format=name) for layout, _, c in holdable()},
    "volume": lambda path: tt.nlos.write_volume(path, volume()),
    "result": lambda path: write_result(path, output(0)),
    "npz": lambda path: capture().write(path),
}
SUFFIX = ENDINGS | {"volume": ".h5", "result": ".h5", "npz": ".npz"}


def full_disks_of_arrays(folder):
    """Every writer against limits of every size, over a file that is there. In a process of its own."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    for name, write_one in ARRAYS.items():
        path = folder / f"a{SUFFIX[name]}"
        write_one(path)
        before, size = path.read_bytes(), path.stat().st_size
        for limit in sorted({1, 600, 2048, 4096, 9000, size // 2, size - 100, size - 1} & set(range(1, size))):
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
            try:
                with pytest.raises(StorageError):
                    write_one(path)
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            assert path.read_bytes() == before and list(folder.iterdir()) == [path]
        path.unlink()


@pytest.mark.slow
def test_full_disks_of_arrays(tmp_path):
    """A typed error, the old file, nothing beside it, and a process that lives."""
    code = f"import sys; sys.path[:0] = {sys.path!r}; import torchtransient; from pathlib import Path; "
    code += "from files.test_disks import full_disks_of_arrays; "
    code += f"full_disks_of_arrays(Path({str(tmp_path)!r})); print('alive')"
    tests = Path(__file__).parents[1]
    environment = {**os.environ, "PYTHONPATH": f"{tests}:{os.environ.get('PYTHONPATH', '')}"}
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, cwd=tests)
    assert (found.returncode, found.stdout) == (0, "alive\n"), found.stderr


def test_the_longest_names(tmp_path):
    for layout in ("torchtransient", "tal"):
        path = capture().write(tmp_path / ("x" * 250 + ".h5"), format=layout)
        assert tt.nlos.Capture.read(path) == capture()


def test_links_are_followed_and_permissions_kept(tmp_path):
    for layout in ("torchtransient", "tal", "dirac"):
        real, link = tmp_path / f"real_{layout}.h5", tmp_path / f"link_{layout}.h5"
        capture().write(real, format=layout)
        real.chmod(0o660)
        link.symlink_to(real)
        size = real.stat().st_size
        replace(capture(), transient=capture().transient.double()).write(link, format=layout)
        assert link.is_symlink() and real.stat().st_size > size and stat.S_IMODE(real.stat().st_mode) == 0o660


# ----------------------------------------------------------------------------------------------------- unfinished files


def refuse(number):
    def refused(*_):
        raise OSError(number, os.strerror(number))

    return refused


@pytest.mark.parametrize(("call", "name", "code"), [
    (fcntl, "flock", "ENOLCK"), (fcntl, "flock", "EOPNOTSUPP"), (os, "link", "EPERM"), (os, "link", "EMLINK"),
])  # fmt: skip
def test_disks_without_locks_or_links(tmp_path, monkeypatch, call, name, code):
    """A file that is there stays unless another is to take its place."""
    monkeypatch.setattr(call, name, refuse(getattr(errno, code)))
    path = tmp_path / "a.txt"
    for over, text, expected in ((False, "one", "one"), (False, "two", "one"), (True, "two", "two")):
        with part_files.whole_file(path, "file", over=over) as part:
            part.write_text(text)
        assert path.read_text() == expected and list(tmp_path.iterdir()) == [path]
    write(tmp_path / "shard-000000.h5", [sample(0)])
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.txt", "shard-000000.h5"]


def test_systems_without_locks(tmp_path, monkeypatch):
    monkeypatch.setattr(platform, "system", lambda: "Windows")
    for call in (
        lambda: tt.data.generate(FakeRecipe(), tmp_path / "set", 4, progress=False),
        lambda: write(tmp_path / "a.h5", [sample(0)]),
    ):
        with pytest.raises(StorageError):
            call()
    assert list(tmp_path.iterdir()) == []


def test_errors_of_the_disk_are_typed(tmp_path, monkeypatch):
    for call, name in ((os, "open"), (fcntl, "flock")):
        with monkeypatch.context() as patched:
            patched.setattr(call, name, refuse(errno.EIO))
            with pytest.raises(StorageError):
                capture().write(tmp_path / "a.h5")


def test_parts_of_killed_writers(tmp_path):
    """They are told by their names and by their locks."""
    ours = (".a.h5.0123abcd.part", f".{40 * 'x'}.0123abcd.part")
    others = (
        ".a.h5.0123abcde.part", ".a.h5.0123abc.part", ".a.h5.0123ABCD.part", "a.h5.0123abcd.part", ".0123abcd.part",
        f".{41 * 'x'}.0123abcd.part", ".a.h5.0123abcd.parts", "a.part", ".c.tmp",
    )  # fmt: skip
    for name in (*ours, *others):
        (tmp_path / name).write_text("left")
    (tmp_path / ".d.h5.0123abcd.part").mkdir()
    path = capture().write(tmp_path / "e.h5")
    assert {one.name for one in tmp_path.iterdir()} == {*others, path.name, ".d.h5.0123abcd.part"}


def test_two_writers_at_once(tmp_path):
    """The one that begins later leaves the other's part alone."""
    target = tmp_path / "a.h5"
    with part_files.replacing(target, "test") as first:
        first.write_bytes(b"first")
        with part_files.replacing(target, "test") as second:
            second.write_bytes(b"second")
        assert first.read_bytes() == b"first" and target.read_bytes() == b"second"
    assert target.read_bytes() == b"first" and os.listdir(tmp_path) == ["a.h5"]
    with pytest.raises(FileNotFoundError), part_files.whole_file(target, "test") as part:
        part.with_name("none").read_bytes()
    assert target.read_bytes() == b"first" and os.listdir(tmp_path) == ["a.h5"]
