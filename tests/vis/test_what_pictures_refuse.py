"""What is no picture: each is refused by a typed error that says what came."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from torchtransient.errors import ArgumentError, MissingPackageError, ShapeError, StorageError, UnitError
from torchtransient.vis import colour_maps, files, overview, video_file
from torchtransient.vis.sources import images_of, real_tensor, steady_of, transient_of

AXIS = tt.TimeAxis(1.0, 0.5, 5)
GATED = SimpleNamespace(gated=torch.arange(1.0, 91.0).reshape(3, 5, 2, 3))
FRAME = np.zeros((4, 6, 3), np.uint8)


@together(
    "call, error, said",
    [
        (lambda: transient_of(GATED, who="streak"), ShapeError, r"^streak: .* holds 5 images of time gates"),
        (lambda: images_of(GATED, AXIS, "frames"), ShapeError, r"^frames: images of time gates have no time axis"),
        (lambda: steady_of(torch.zeros(2, 4, 5), "x"), ShapeError, r"^x: expected an image .* got \(2, 4, 5\)"),
        (lambda: steady_of(torch.zeros(4, 5), "x"), ShapeError, r"^x: expected an image .* got \(4, 5\)"),
        (lambda: steady_of(torch.zeros(3, 0, 5), "x"), ShapeError, r"^x: expected an image .* got \(3, 0, 5\)"),
        (lambda: real_tensor(torch.ones(2) * 1j, "x"), ShapeError, r"^x: expected real numbers, got torch.complex64"),
        (lambda: tt.vis.histogram(torch.ones(1, 5, 2, 3), pixels=[5]), ShapeError, r"a pixel \(row, column\), got 5"),
        (lambda: tt.vis.histogram(torch.ones(1, 5, 2, 3), pixels=[(0, 1, 2)]), ShapeError, r"a pixel \(row, column\)"),
        (lambda: tt.vis.histogram(torch.ones(1, 5, 2, 3), pixels=[(0.5, 1)]), ShapeError, r"a pixel \(row, column\)"),
        (lambda: tt.vis.histogram(torch.ones(1, 5, 2, 3), pixels=[(0, 3)]), ShapeError, r"\(0, 3\) lies outside"),
        (lambda: tt.vis.histogram(torch.ones(1, 5, 2, 3), pixels=[(-1, 0)]), ShapeError, r"\(-1, 0\) lies outside"),
        (lambda: tt.vis.histogram(torch.ones(1, 5, 2, 3), pixels=[(0, -1)]), ShapeError, r"\(0, -1\) lies outside"),
        (lambda: tt.vis.streak(torch.ones(1, 5, 2, 3), column=-4), ShapeError, "column -4 lies outside"),
        (lambda: tt.vis.streak(torch.ones(1, 5, 2, 3), row=0.5), ShapeError, "row 0.5 lies outside"),
        (lambda: tt.vis.frame_grid(torch.ones(1, 5, 2, 3), bins=[-1]), ShapeError, "bin -1 lies outside of 5"),
        (lambda: tt.vis.frame_grid(torch.ones(1, 5, 2, 3), bins=[5]), ShapeError, "bin 5 lies outside of 5"),
        (lambda: tt.vis.phasor_picture(torch.ones(1, 1, 2, 3) * 1j, frequencies="x"), UnitError, "cycles per metre"),
        (lambda: tt.vis.phasor_picture(torch.ones(1, 2, 2, 3) * 1j, which=(2,)), ShapeError, "out of 2 frequencies"),
        (lambda: tt.vis.phasor_picture(torch.ones(1, 2, 2, 3) * 1j, which=(-1,)), ShapeError, "out of 2 frequencies"),
        (lambda: tt.vis.phasor_picture(torch.ones(1, 2, 2, 3) * 1j, which=(0, 9)), ShapeError, "out of 2 frequencies"),
        (lambda: tt.vis.phasor_picture(torch.ones(1, 2, 2, 3) * 1j, show=()), UnitError, "panels out of real"),
        (lambda: tt.vis.phasor_picture(torch.ones(1, 2, 0, 3) * 1j), ShapeError, "expected complex phasors"),
        (lambda: tt.vis.phasor_picture(torch.ones(2, 2, 3) * 1j), ShapeError, "expected complex phasors"),
        (lambda: tt.vis.domain_colors("red"), ShapeError, "expected complex numbers, got 'red'"),
        (lambda: tt.vis.domain_colors([[1.0], [2.0, 3.0]]), ShapeError, "expected complex numbers, got"),
        (lambda: colour_maps.cyclic_map("jet"), ArgumentError, "out of even, hsv, got 'jet'"),
        (lambda: colour_maps.symmetric_limit([1.0], -0.1), UnitError, "from 0 to 100, got -0.1"),
        (lambda: colour_maps.symmetric_limit([1.0], 100.1), UnitError, "from 0 to 100, got 100.1"),
        (lambda: colour_maps.symmetric_limit([1.0], "x"), UnitError, "from 0 to 100, got 'x'"),
        (lambda: tt.vis.gradient_picture(torch.ones(2, 3), percentile=100.1), UnitError, "<= 100, got 100.1"),
        (lambda: tt.vis.gradient_picture(torch.ones(2, 3), percentile="x"), UnitError, "<= 100, got 'x'"),
        (lambda: tt.vis.gradient_picture(torch.ones(0, 3)), ShapeError, r"got \(1, 0, 3\)"),
        (lambda: tt.vis.gradient_picture(1j * torch.ones(2, 3)), ShapeError, r"got \(1, 2, 3\)"),
        (lambda: tt.vis.rainbow(torch.ones(1, 5, 2, 3), limits=(1.0, 2.0, 3.0)), ShapeError, "two lengths in metres"),
        (lambda: tt.vis.rainbow(torch.ones(1, 5, 2, 3), limits=("a", "b")), ShapeError, "two lengths in metres"),
        (lambda: tt.vis.rainbow(torch.ones(1, 5, 2, 3), limits=(1.0, np.inf)), UnitError, "first below the second"),
        (lambda: tt.vis.rainbow(torch.ones(1, 5, 2, 3), limits=(2.0, 2.0)), UnitError, "first below the second"),
        (lambda: tt.vis.exposure_of(torch.ones(1, 2, 3), 1.01), UnitError, "quantile <= 1, got 1.01"),
        (lambda: tt.vis.exposure_of(torch.ones(1, 2, 3), "x"), UnitError, "quantile <= 1, got 'x'"),
        (lambda: tt.vis.exposure_of_video(torch.ones(2, 5, 2, 3)), ShapeError, r"got \(2, 5, 2, 3\)"),
        (lambda: tt.vis.tone_map(torch.ones(2, 2, 3)), ShapeError, r"got \(2, 2, 3\)"),
        (lambda: tt.vis.tone_map(torch.ones(1, 2, 3), np.inf), UnitError, "exposure > 0, got inf"),
        (lambda: tt.vis.tone_map(torch.ones(1, 2, 3), "x"), UnitError, "exposure > 0, got 'x'"),
        (lambda: overview.median_pixel(torch.ones(1, 0, 3)), ShapeError, r"got \(1, 0, 3\)"),
        (lambda: overview.light_curve(torch.ones(1, 5, 0, 3)), ShapeError, r"got \(1, 5, 0, 3\)"),
        (lambda: overview.light_curve(torch.ones(2, 5, 2, 3)), ShapeError, r"got \(2, 5, 2, 3\)"),
        (lambda: overview.check_picture("a.docx", "--plot"), StorageError, r"^--plot: .*\.png, .* got 'a.docx'"),
        (lambda: tt.vis.Frames(3, lambda n: FRAME)[3], IndexError, "frame 3 of 3"),
        (lambda: tt.vis.Frames(3, lambda n: FRAME)[-4], IndexError, "frame -4 of 3"),
        (lambda: tt.vis.side_by_side([[FRAME], 5]), ShapeError, "sequences of frames, got 5 among them"),
        (lambda: tt.vis.side_by_side([[FRAME], [5]])[0], ShapeError, r"side_by_side: expected frames .* got 5"),
        (lambda: tt.vis.write_video("a.gif", [FRAME], 0), ShapeError, "at least one frame, got none"),
        (lambda: tt.vis.write_video("a.gif", [], 1), ShapeError, "iterated twice for a GIF, got none.$"),
        (lambda: tt.vis.write_video("a.gif", iter([FRAME]), 1), ShapeError, "got none the second time"),
        (lambda: tt.vis.write_video("a.gif", [FRAME, FRAME[1:]], 2), ShapeError, r"equal size \(4, 6, 3\), got"),
        (lambda: tt.vis.write_video("a.gif", [[5]], 1), ShapeError, r"video: expected frames .* of uint8, got"),
        (lambda: tt.vis.write_video("a.gif", [FRAME[0]], 1), ShapeError, r"got uint8 \(6, 3\)"),
        (lambda: tt.vis.write_video("a.gif", [FRAME[..., :2]], 1), ShapeError, r"got uint8 \(4, 6, 2\)"),
        (lambda: tt.vis.write_video("a.gif", [FRAME + 0.5], 1), ShapeError, r"got float64 \(4, 6, 3\)"),
    ],
)  # fmt: skip
def test_refused(call, error, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=said):
        call()


def test_what_is_just_allowed(tmp_path):
    """The last pixel, bin, share and frame."""
    light = torch.rand(1, 5, 2, 3, generator=torch.Generator().manual_seed(1)) + 0.1
    assert len(tt.vis.histogram(light, pixels=[(1, 2), np.array([0, 0])]).axes) == 2
    assert tt.vis.streak(light, column=-3).axes[0].get_title().startswith("light along column 0")
    assert tt.vis.frame_grid(light, bins=[0, 4]).axes[1].get_title() == "bin 4 of 5"
    assert colour_maps.symmetric_limit([-3.0, 1.0, 2.0], 0) == 1 and colour_maps.symmetric_limit([-3.0, 1.0], 100) == 3
    assert overview.check_picture(tmp_path / "a.PDF") is None
    frames = tt.vis.Frames(3, lambda n: FRAME + np.uint8(n))
    assert [int(frames[n].max()) for n in (0, 2, -1, -3)] == [0, 2, 2, 0]
    assert [int(one.max()) for one in frames] == [0, 1, 2]
    cube, axis, word = images_of(GATED)
    assert word == "gate" and axis is None and torch.equal(cube, GATED.gated)
    assert torch.equal(steady_of(GATED), GATED.gated.sum(1))
    assert tt.vis.write_video(tmp_path / "a.gif", [FRAME], 1, fps=50).exists()


@pytest.mark.parametrize(
    "module, call, package",
    [
        ("PIL", lambda path: files.save_image(FRAME, path / "a.png", "x"), "pillow"),
        ("PIL", lambda path: tt.vis.frames(torch.ones(1, 5, 2, 3))[0], "pillow"),
        ("PIL", lambda path: video_file.check_video(path / "a.gif"), "pillow"),
        ("imageio_ffmpeg", lambda path: video_file.check_video(path / "a.mp4"), "imageio-ffmpeg"),
        ("matplotlib.figure", lambda path: tt.vis.streak(torch.ones(1, 5, 2, 3)), "matplotlib"),
    ],
)
def test_what_a_missing_package_is_called(module, call, package, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingPackageError, match=rf"package {package}.*pip install\s+'torchtransient\[vis\]'"):
        call(tmp_path)


def test_videos_that_end_too_early(tmp_path, monkeypatch):
    """What ffmpeg leaves is looked at; what the system says is passed on."""
    monkeypatch.setattr(video_file, "_is_whole", lambda target: False)
    with pytest.raises(StorageError, match="ended before the file was whole"):
        tt.vis.write_video(tmp_path / "a.mp4", [FRAME], 1)

    def full(*given):
        raise OSError("no space left")

    monkeypatch.setattr(video_file, "_write_gif", full)
    with pytest.raises(StorageError, match=r"a\.gif' could not be written: .*no space left"):
        tt.vis.write_video(tmp_path / "a.gif", [FRAME], 1)
    assert not list(tmp_path.iterdir())
