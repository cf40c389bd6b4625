"""Whatever is read or written by name: devices and pipes are no files, and a disk that is full leaves the old file."""

from __future__ import annotations

import os
import resource
import signal
import stat

import pytest
import torch

import torchtransient as tt
from torchtransient.accuracy.report import AccuracyReport
from torchtransient.errors import SceneError, StorageError, TorchTransientError
from torchtransient.files.result_file import read_result

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
# Text and pictures among the writers: those of arrays are in `test_disks.py`.
WRITERS = {
    "device": (DEVICE.to_yaml, ".yaml"), "device in JSON": (DEVICE.to_json, ".json"),
    "recipe": (tt.data.Recipe(SCENE, {}, spp=1, n=1).to_yaml, ".yaml"),
    "report": (AccuracyReport([], "a", {"b": "c" * 5000}).to_json, ".json"),
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


@pytest.mark.parametrize("name", READERS)
def test_devices_are_not_read(tmp_path, name):
    read, ending = READERS[name]
    (tmp_path / f"a{ending}").symlink_to("/dev/null")
    with pytest.raises(TorchTransientError, match=r"no file on a disk|a device or a pipe|got '/.*/a'|there is none"):
        read(tmp_path / f"a{ending}")


@pytest.mark.parametrize("name", READERS)
def test_readers_of_what_is_no_name(name):
    for given in NO_NAMES:
        with pytest.raises(TorchTransientError):
            READERS[name][0](given)


@pytest.mark.parametrize("name", EACH_WRITER)
def test_pipes_are_not_replaced(tmp_path, name):
    write, ending = WRITERS[name]
    place = tmp_path / f"a{ending}"
    os.mkfifo(place)
    reading = os.open(place, os.O_RDONLY | os.O_NONBLOCK)  # so that nobody waits who opens it
    try:
        with pytest.raises(StorageError, match="is no file on a disk"):
            write(place)
    finally:
        os.close(reading)
    assert stat.S_ISFIFO(place.stat().st_mode) and list(tmp_path.iterdir()) == [place]


@pytest.mark.parametrize("name", EACH_WRITER)
def test_writers_to_what_is_no_name(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    for given in NO_NAMES[1:]:  # without a name nothing is written
        with pytest.raises(TorchTransientError):
            WRITERS[name][0](given)
    assert list(tmp_path.iterdir()) == []


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


@pytest.mark.parametrize("kind", ["ply", "obj", "serialized"])
def test_meshes_that_are_devices(tmp_path, kind):
    (tmp_path / "a").symlink_to("/dev/null")
    (tmp_path / "s.xml").write_text(XML.format(f'<shape type="{kind}"><string name="filename" value="a"/></shape>'))
    with pytest.raises(SceneError, match="no file on a disk"):
        tt.load(tmp_path / "s.xml", variant="llvm_ad_mono").parameters()


def test_textures_that_are_devices(tmp_path):
    (tmp_path / "a.png").symlink_to("/dev/null")
    texture = {"type": "bitmap", "filename": str(tmp_path / "a.png")}
    scene = {"type": "scene", "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}}}
    with pytest.raises(SceneError, match="no file on a disk"):
        tt.load(scene, variant="llvm_ad_mono").parameters()


def test_includes_that_are_devices(tmp_path):
    (tmp_path / "a").symlink_to("/dev/null")
    (tmp_path / "inner.xml").write_text('<scene version="3.0.0"><include filename="$here"/></scene>')
    outer = XML.format('<default name="here" value="a"/><include filename="inner.xml"/>')
    for text in (outer, XML.format('<include filename="a"/>')):
        (tmp_path / "s.xml").write_text(text)
        with pytest.raises(SceneError, match="no file on a disk"):
            tt.load(tmp_path / "s.xml")
