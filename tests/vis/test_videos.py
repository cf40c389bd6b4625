"""Frames and video files: what they show, when, and in which brightness."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.captures import tilted
from support.cubes import AXIS, read_gif, read_mp4, sweep
from support.sweeps import together
from torchtransient.errors import ArgumentError, ShapeError, StorageError, UnitError

PLAIN = {"stamp": False, "scale": 1}


def columns(frame):
    """Columns of the first row that are lit."""
    return (frame[0, :, 0] > 0).nonzero()[0].tolist()


def test_frame_shows_its_bin_alone():
    shown = tt.vis.frames(sweep(), axis=AXIS, **PLAIN)
    assert len(shown) == 10
    for index, frame in enumerate(shown):
        expected = np.zeros((6, 10, 3), np.uint8)
        expected[:5, index] = 255
        assert frame.dtype == np.uint8
        np.testing.assert_array_equal(frame, expected)
    np.testing.assert_array_equal(shown[-1], shown[9])
    with pytest.raises(IndexError):
        shown[10]
    # Broken pixels are magenta.
    cube = sweep()
    cube[0, 2, 0, 0], cube[0, 2, 0, 1] = float("nan"), float("inf")
    assert tt.vis.frames(cube, **PLAIN)[2][0, :3].tolist() == [[255, 0, 255], [255, 0, 255], [255, 255, 255]]


def test_one_exposure_for_all_frames():
    cube = torch.zeros(1, 4, 20, 20)
    for index, value in enumerate((1.0, 0.5, 0.25, 0.0)):
        cube[:, index] = value
    given = tt.vis.frames(cube, curve="linear", exposure=1, **PLAIN)
    assert [int(frame[0, 0, 0]) for frame in given] == [255, 128, 64, 0]
    for own, wanted in zip(tt.vis.frames(cube, curve="linear", **PLAIN), given, strict=True):
        # White is found on a scale of 4096 steps over nine decades: to half a hundredth.
        np.testing.assert_allclose(own.astype(int), wanted, atol=2)


@pytest.mark.parametrize("value", [3.3e-4, 1.0, 330.0])
def test_white_is_that_of_lit_pixels_of_all_frames(value):
    """Of what is finite, over all frames, however few pixels are lit."""
    cube = torch.zeros(3, 50, 8, 8)
    cube[1, 7] = value * torch.linspace(0.01, 1.0, 64).reshape(8, 8)
    cube[0, 3, 0, 0], cube[0, 3, 0, 1] = float("nan"), float("inf")
    level = tt.vis.frames(cube, curve="linear", **PLAIN)[7][..., 1].astype(float) / 255
    np.testing.assert_allclose(level.ravel()[:60], np.linspace(0.01, 1.0, 64)[:60], atol=0.03)


@pytest.mark.parametrize("accumulate", [False, True])
def test_frames_of_several_bins(accumulate):
    shown = tt.vis.frames(sweep(), every=4, accumulate=accumulate, **PLAIN)
    starts = (0, 0, 0) if accumulate else (0, 4, 8)
    for index in (0, 2, 1):  # not only in order
        assert columns(shown[index]) == list(range(starts[index], min(10, 4 * index + 4)))


def test_enlarged_and_stamped():
    plain = tt.vis.frames(sweep(), axis=AXIS, stamp=False)[3]
    assert plain.shape == (6 * 32, 320, 3)
    stamped = [tt.vis.frames(sweep(), axis=AXIS)[k] for k in (3, 4)]
    np.testing.assert_array_equal(stamped[0][: plain.shape[0]], plain)  # the picture itself is not covered
    text = [frame[plain.shape[0] :] for frame in stamped]
    assert (text[0] != text[1]).any() and text[0].max() > 200
    # The bar below the picture fills with time.
    filled = [(frame[0, :, 0] > 150).sum() / frame.shape[1] for frame in text]
    assert filled == pytest.approx([0.4, 0.5], abs=0.01)


def test_captures_stand_as_the_wall(tmp_path):
    """A bin of the wall a frame, its highest row on top."""
    capture, index = tilted()
    capture.transient[:, :, 0] = 0.0
    shown = tt.vis.frames(capture, exposure=1.0, **PLAIN)
    assert len(shown) == capture.axis.num_bins
    for number in (0, int(index[0, 3]), int(index[0, 12])):
        np.testing.assert_array_equal(shown[number][..., 0], 255 * capture.transient[0, number].flip(0).numpy())
    images, _ = read_gif(tt.vis.video(capture.crop(1.4, 1.6), tmp_path / "wall.gif", fps=10, exposure=1.0, scale=4))
    assert len(images) == 10 and images[0].shape[1] == 64


# -------------------------------------------------------------------------------------------------------- files


@pytest.mark.parametrize("ending", ["gif", "mp4"])
def test_video_file(tmp_path, ending, capsys):
    path = tmp_path / f"light.{ending}"
    assert tt.vis.video(sweep(), path, axis=AXIS, fps=20, progress=True) == path
    assert "10/10" in capsys.readouterr().err
    frames, info = read_gif(path) if ending == "gif" else read_mp4(path)
    expected = list(tt.vis.frames(sweep(), axis=AXIS))
    assert len(frames) == 10
    if ending == "gif":
        assert info["duration"] == 50 and info["loop"] == 0
    else:
        assert info["fps"] == pytest.approx(20) and info["codec"] == "h264"
    for got, wanted in zip(frames, expected, strict=True):
        inner = got[: wanted.shape[0], : wanted.shape[1]].astype(int)
        assert inner.shape[0] - wanted.shape[0] in (0, 1)
        # video is lossy: no picture may be mistaken for its neighbour, where a tenth of the pixels differ by 255
        assert np.abs(inner - wanted[: inner.shape[0]]).mean() < 4


def test_palettes(tmp_path):
    """256 colours fill the cube in steps of about 255 / 256^(1/3) = 40: half a step is a bound on the mean of noise.
    Each second one of 30 frames is looked at: a colour that comes late is there.
    """
    cube = torch.rand((3, 3, 24, 24), generator=torch.Generator().manual_seed(0))
    wanted = list(tt.vis.frames(cube, stamp=False, scale=4, exposure=1.0))
    for got, want in zip(read_gif(tt.vis.write_video(tmp_path / "noise.gif", wanted, 3))[0], wanted, strict=True):
        assert np.abs(got.astype(int) - want).mean() < 20
    frames = [np.full((8, 6, 3), (200, 40, 12) if n < 15 else (12, 72, 220), np.uint8) for n in range(30)]
    frames = [np.where(np.arange(6)[:, None] == n % 6, np.uint8(255), one) for n, one in enumerate(frames)]
    found, _ = read_gif(tt.vis.write_video(tmp_path / "a.gif", frames, 30, fps=20))
    for got, wanted in zip(found, frames, strict=True):
        assert np.abs(got.astype(int) - wanted).max() < 8


def test_hundredths_of_a_second(tmp_path):
    frames = [np.full((4, 6, 3), 80 * k, np.uint8) for k in range(3)]
    for fps, duration in ((50, 20), (30, 30), (7, 140)):
        assert read_gif(tt.vis.write_video(tmp_path / "a.gif", frames, 3, fps=fps))[1]["duration"] == duration


def test_odd_sizes_become_even(tmp_path):
    frames = [np.full((33, 51, 3), 200, np.uint8)] * 2
    got, meta = read_mp4(tt.vis.write_video(tmp_path / "odd.mp4", frames, 2))
    assert meta["size"] == (52, 34)
    assert np.abs(got[0].astype(int) - 200).max() < 12


FRAME = np.zeros((4, 6, 3), np.uint8)


@together("arguments, error", [
    ({"path": "a.avi"}, StorageError), ({"path": "missing/a.gif"}, StorageError), ({"fps": 0}, UnitError),
    ({"fps": 100}, UnitError),  # which GIF players do not know
    ({"exposure": -1}, UnitError), ({"curve": "sepia"}, ArgumentError),
    ({"source": torch.zeros(3, 0, 4, 4)}, ShapeError), ({"source": torch.zeros(2, 5, 4, 4)}, ShapeError),
    ({"source": torch.zeros(5, 3, 5, 4, 4)}, ShapeError), ({"source": "cube"}, StorageError),
    ({"source": [1.0]}, ArgumentError), ({"axis": tt.TimeAxis(0, 1, 3)}, ShapeError),
])  # fmt: skip
def test_refused(tmp_path, arguments, error):
    given = {"source": sweep(), **arguments, "path": tmp_path / arguments.get("path", "a.gif")}
    with pytest.raises(error):
        tt.vis.video(**given)
    assert not list(tmp_path.iterdir())


@together("frames, count", [
    ([], 1), (iter([FRAME]), 1), ([FRAME, FRAME[1:]], 2), ([FRAME[..., :2]], 1), ([FRAME + 0.5], 1),
])  # fmt: skip
def test_what_is_no_row_of_frames(tmp_path, frames, count):
    """None, of several sizes, and of other numbers; a GIF looks at them twice."""
    with pytest.raises(ShapeError):
        tt.vis.write_video(tmp_path / "a.gif", frames, count)
    assert not list(tmp_path.iterdir())
