"""Pictures and videos from the command line: the same as from the library, and errors before the work."""

from __future__ import annotations

import pytest
import torch
from click.testing import CliRunner
from PIL import Image

import torchtransient as tt
from support.sweeps import together
from support.text_files import SCENE
from torchtransient.__main__ import main
from torchtransient.files import write_result

VARIANT = "llvm_ad_rgb"  # what the commands take when none is active, as in a process of their own
@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "box.xml").write_text(SCENE, encoding="utf-8")
    return tmp_path


@pytest.fixture
def result(folder):
    with torch.no_grad():
        return write_result(folder / "box.h5", tt.render("box.xml", seed=0))


def run(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.mark.slow
def test_render_with_every_picture(folder):
    pictures = ("--video", "v.gif", "--peak-time", "p.png", "--rainbow", "r.png")
    done = run("render", "box.xml", *pictures, "--quiet")
    assert done.exit_code == 0, done.output
    assert Image.open("v.gif").n_frames == 24
    assert Image.open("r.png").size == (4, 3)
    assert Image.open("p.png").size[0] > 300
    for line in ("v.gif: 24 frames", "p.png: arrival of the peak", "r.png: hue by arrival"):
        assert line in done.stdout
    # the file that was written beside them gives the same picture
    again = run("picture", "box.h5", "r2.png", "--kind", "rainbow")
    assert again.exit_code == 0, again.output
    assert (folder / "r.png").read_bytes() == (folder / "r2.png").read_bytes()


@pytest.mark.slow
def test_video_options(folder, result):
    done = run("video", "box.h5", "v.gif", "--fps", 10, "--every", 4, "--accumulate", "--no-stamp", "--scale", 2)
    assert done.exit_code == 0, done.output
    image = Image.open("v.gif")
    assert image.size == (8, 6)
    durations = []
    for index in range(image.n_frames):  # equal ones become one of their length
        image.seek(index)
        durations.append(image.info["duration"])
    assert sum(durations) == 600
    assert "6/6" in done.stderr
    done = run("video", "box.h5", "v.mp4", "--curve", "log", "--exposure", 3, "--quiet")
    assert done.exit_code == 0, done.output
    assert b"ftyp" in (folder / "v.mp4").read_bytes()[:16]
    assert done.stderr == ""


@together("kind, more", [
    ("overview", ("--pixel", 2, 3)), ("peak-time", ()), ("fusion", ()), ("streak", ("--column", 2)), ("frames", ()),
    ("histogram", ("--pixel", 2, 3)),
])  # fmt: skip
def test_kinds_of_pictures(folder, result, kind, more):
    done = run("picture", "box.h5", "out.png", "--kind", kind, *more)
    assert done.exit_code == 0, done.output
    assert Image.open("out.png").size[0] >= 4


def test_captures_have_an_overview(folder):
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(1.0, 1.0), 4, kind="confocal")
    tt.nlos.Capture(torch.rand(1, 9, 4, 4), tt.TimeAxis(2.0, 0.1, 9), scan).write("scan.h5")
    done = run("picture", "scan.h5", "out.png")
    assert done.exit_code == 0, done.output
    assert Image.open("out.png").size[0] > 300


@pytest.mark.slow
def test_polarization_and_phasors_from_files(folder, result):
    import numpy as np

    values = torch.rand(4, 1, 3, 5, 5).numpy()
    np.save("polarized.npy", values)
    np.save("phasor.npy", (values[0] + 1j * values[1]).astype(np.complex64))
    for name, kind in (("polarized.npy", "polarization"), ("phasor.npy", "phasor")):
        done = run("picture", name, f"{kind}.png", "--kind", kind)
        assert done.exit_code == 0, done.output
        assert Image.open(f"{kind}.png").size[0] > 300
        wrong = run("picture", "box.h5", "none.png", "--kind", kind)
        assert wrong.exit_code == 2 and "error: " in wrong.stderr
    assert not (folder / "none.png").exists()


@pytest.mark.slow
def test_phasors_become_a_wave(folder):
    done = run("render", "box.xml", "--frequencies", "0.5,1", "--video", "wave.gif", "--quiet")
    assert done.exit_code == 0, done.output
    assert Image.open("wave.gif").n_frames == 48
    done = run("render", "box.xml", "--frequencies", "0.5,1", "--rainbow", "r.png", "--quiet")
    assert done.exit_code == 2 and "--rainbow shows a histogram over time" in done.stderr
    assert run("render", "box.xml", "-o", "wave.h5", "--frequencies", "0.5,1", "--quiet").exit_code == 0
    done = run("picture", "wave.h5", "none.png", "--kind", "overview")
    assert done.exit_code == 2
    assert "--kind overview shows a histogram over time, and this file holds phasors" in done.stderr


@pytest.mark.slow
def test_gates_become_frames(folder):
    gates = "gaussian 8 0.5; gaussian 8.5 0.5; gaussian 9 0.5"
    done = run("render", "box.xml", "-o", "gated.h5", "--gates", gates, "--video", "gates.gif", "--quiet")
    assert done.exit_code == 0, done.output
    assert Image.open("gates.gif").n_frames == 3 and "gates.gif: 3 frames" in done.stdout
    assert run("picture", "gated.h5", "frames.png", "--kind", "frames").exit_code == 0
    done = run("picture", "gated.h5", "none.png", "--kind", "rainbow")
    assert done.exit_code == 2 and "gates" in done.stderr and not (folder / "none.png").exists()


@together("arguments, word", [
    (("video", "missing.h5", "v.gif"), "does not exist"), (("video", "box.h5", "v.avi"), ".mp4 or .gif"),
    (("video", "box.h5", "nowhere/v.gif"), "'nowhere' does not exist"),
    (("video", "box.xml", "v.gif"), "expected a name that ends in"),
    (("picture", "box.h5", "nowhere/a.png"), "'nowhere' does not exist"),
    (("picture", "box.h5", "a.png", "--kind", "histogram"), "needs --pixel"),
    (("picture", "box.h5", "a.png", "--kind", "rainbow", "--row", "1"), "--row has no effect"),
    (("picture", "box.h5", "a.png", "--kind", "streak", "--row", "99"), "outside of an image"),
])  # fmt: skip
def test_errors(folder, result, arguments, word):
    done = run(*arguments)
    assert done.exit_code == 2 and word in done.stderr and "Traceback" not in done.stderr
