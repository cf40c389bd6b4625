"""Frames and video files: what they show, when, and in which brightness."""

from __future__ import annotations

import struct
import sys
from contextlib import nullcontext

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.cubes import AXIS, read_gif, read_mp4, sweep
from torchtransient.errors import ArgumentError, MissingPackageError, ShapeError, StorageError, UnitError
from torchtransient.vis import video_file
from torchtransient.vis.files import to_bytes
from torchtransient.vis.stamps import moment, with_strip
from torchtransient.vis.video import _Running


def test_frame_shows_its_bin_alone():
    shown = tt.vis.frames(sweep(), axis=AXIS, stamp=False, scale=1)
    assert len(shown) == 10
    for index, frame in enumerate(shown):
        assert frame.dtype == np.uint8 and frame.shape == (6, 10, 3)
        expected = np.zeros((6, 10, 3), np.uint8)
        expected[:5, index] = 255
        np.testing.assert_array_equal(frame, expected)


def test_one_exposure_for_all_frames():
    cube = torch.zeros(1, 4, 20, 20)
    for index, value in enumerate((1.0, 0.5, 0.25, 0.0)):
        cube[:, index] = value
    exposure = tt.vis.exposure_of_video(cube)
    assert exposure == pytest.approx(1.0, rel=0.01)  # the quantile is found on a scale of steps
    levels = [int(frame[0, 0, 0]) for frame in tt.vis.frames(cube, stamp=False, scale=1, curve="linear", exposure=1)]
    assert levels == [255, 128, 64, 0]
    assert [int(f[0, 0, 0]) for f in tt.vis.frames(cube, stamp=False, scale=1, exposure=2, curve="linear")][1] == 255


def test_exposure_of_video_counts_lit_pixels_alone():
    cube = torch.zeros(3, 50, 8, 8)
    cube[1, 7] = torch.linspace(0.01, 1.0, 64).reshape(8, 8)
    cube[0, 3, 0, 0] = float("nan")
    cube[0, 3, 0, 1] = float("inf")
    assert tt.vis.exposure_of_video(cube, 1.0) == 1.0
    assert 1 / tt.vis.exposure_of_video(cube, 0.5) == pytest.approx(0.5, rel=0.03)
    assert tt.vis.exposure_of_video(torch.zeros(1, 3, 2, 2)) == 1.0
    with pytest.raises(UnitError, match="quantile"):
        tt.vis.exposure_of_video(cube, 0.0)
    with pytest.raises(ShapeError, match="C, T, H, W"):
        tt.vis.exposure_of_video(cube[0])


def test_accumulated_frames():
    shown = tt.vis.frames(sweep(), accumulate=True, stamp=False, scale=1)
    for index in (0, 4, 9, 2):  # not only in order
        lit = shown[index][0, :, 0] > 0
        assert lit.tolist() == [x <= index for x in range(10)]


def test_frames_of_several_bins():
    shown = tt.vis.frames(sweep(), every=4, stamp=False, scale=1)
    assert len(shown) == 3
    assert [(f[0, :, 0] > 0).nonzero()[0].tolist() for f in shown] == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]


def test_enlarged_and_stamped():
    plain = tt.vis.frames(sweep(), axis=AXIS, stamp=False)[3]
    assert plain.shape == (6 * 32, 320, 3)
    stamped = tt.vis.frames(sweep(), axis=AXIS)[3]
    np.testing.assert_array_equal(stamped[: plain.shape[0]], plain)  # the picture itself is not covered
    assert stamped.shape[0] > plain.shape[0]
    text = [tt.vis.frames(sweep(), axis=AXIS)[k][plain.shape[0] :] for k in (3, 4)]
    assert (text[0] != text[1]).any() and text[0].max() > 200
    assert moment(AXIS, 3, 10) == "3.8 m   12.5 ns"  # centre 3.75 m = 12.51 ns, to the digits of the bin width
    assert moment(None, 3, 10) == "bin 3 of 10"


def test_bar_fills_with_time():
    image = np.zeros((40, 100, 3), np.uint8)
    bars = [with_strip(image, "", share)[40, :, 0] for share in (0.0, 0.3, 1.0)]
    assert [(bar > 150).sum() for bar in bars] == [0, 30, 100]


def test_broken_pixels_are_magenta():
    cube = sweep()
    cube[0, 2, 0, 0] = float("nan")
    cube[0, 2, 0, 1] = float("inf")
    frame = tt.vis.frames(cube, stamp=False, scale=1)[2]
    assert frame[0, 0].tolist() == frame[0, 1].tolist() == [255, 0, 255]
    assert frame[0, 2].tolist() == [255, 255, 255]


@pytest.mark.parametrize("ending", ["gif", "mp4"])
def test_video_file(tmp_path, ending):
    path = tmp_path / f"light.{ending}"
    assert tt.vis.video(sweep(), path, axis=AXIS, fps=20) == path
    frames, info = read_gif(path) if ending == "gif" else read_mp4(path)
    expected = list(tt.vis.frames(sweep(), axis=AXIS))
    assert len(frames) == 10
    if ending == "gif":
        assert info["duration"] == 50
        assert info["loop"] == 0
    else:
        assert info["fps"] == pytest.approx(20)
        assert info["codec"] == "h264"
    for got, wanted in zip(frames, expected, strict=True):
        inner = got[: wanted.shape[0], : wanted.shape[1]].astype(int)
        assert inner.shape[0] - wanted.shape[0] in (0, 1)
        # video is lossy: no picture may be mistaken for its neighbour, where a tenth of the pixels differ by 255
        assert np.abs(inner - wanted[: inner.shape[0]]).mean() < 4


def test_gif_of_many_colours_is_close(tmp_path):
    generator = torch.Generator().manual_seed(0)
    cube = torch.rand((3, 3, 24, 24), generator=generator)
    wanted = list(tt.vis.frames(cube, stamp=False, scale=4, exposure=1.0))
    frames, _ = read_gif(tt.vis.write_video(tmp_path / "noise.gif", wanted, 3))
    for got, want in zip(frames, wanted, strict=True):
        # 256 colours fill the cube in steps of about 255 / 256^(1/3) = 40; half a step is a bound on the mean
        assert np.abs(got.astype(int) - want).mean() < 20


@pytest.mark.slow
def test_odd_sizes_become_even(tmp_path):
    frames = [np.full((33, 51, 3), 200, np.uint8)] * 2
    got, meta = read_mp4(tt.vis.write_video(tmp_path / "odd.mp4", frames, 2))
    assert meta["size"] == (52, 34)
    assert np.abs(got[0].astype(int) - 200).max() < 12


def test_side_by_side():
    a, b = tt.vis.frames(sweep(), stamp=False, scale=1), tt.vis.frames(sweep(), stamp=False, scale=2, every=2)
    both = tt.vis.side_by_side([a, b], gap=3)
    assert len(both) == 5
    assert both[1].shape == (12, 10 + 3 + 20, 3)
    np.testing.assert_array_equal(both[1][:6, :10], a[1])
    np.testing.assert_array_equal(both[1][:, 13:], b[1])
    assert (both[1][:, 10:13] == 255).all()
    with pytest.raises(ShapeError, match="at least one"):
        tt.vis.side_by_side([])


def test_progress_bar(tmp_path, capsys):
    tt.vis.video(sweep(), tmp_path / "a.gif", progress=True)
    assert "10/10" in capsys.readouterr().err


def test_missing_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingPackageError, match=r"imageio-ffmpeg.*pip install 'torchtransient\[vis\]'.*\.gif"):
        tt.vis.video(sweep(), tmp_path / "a.mp4")
    tt.vis.video(sweep(), tmp_path / "a.gif")


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"path": "a.avi"}, StorageError, ".mp4 or .gif"),
        ({"path": "missing/a.gif"}, StorageError, "does not exist"),
        ({"fps": 0}, UnitError, "fps > 0"),
        ({"fps": 100}, UnitError, "at most 50"),
        ({"exposure": -1}, UnitError, "exposure > 0"),
        ({"curve": "sepia"}, ArgumentError, "srgb, gamma"),
        ({"every": 0}, ShapeError, "every"),
        ({"scale": 0}, ShapeError, "scale"),
        ({"source": torch.zeros(3, 0, 4, 4)}, ShapeError, "C, T, H, W"),
        ({"source": torch.zeros(2, 5, 4, 4)}, ShapeError, "choose one or three"),
        ({"source": torch.zeros(5, 3, 5, 4, 4)}, ShapeError, "of a batch, choose one"),
        ({"source": "cube"}, StorageError, ".npy"),
        ({"source": [1.0]}, ArgumentError, "got list"),
        ({"axis": tt.TimeAxis(0, 1, 3)}, ShapeError, "3 bins"),
    ],
)
def test_refused(tmp_path, arguments, error, message):
    path = tmp_path / arguments.pop("path", "a.gif")
    source = arguments.pop("source", sweep())
    with pytest.raises(error, match=message):
        tt.vis.video(source, path, **arguments)
    assert not path.exists()


def test_black_video(tmp_path):
    frames, _ = read_gif(tt.vis.video(torch.zeros(1, 2, 8, 8), tmp_path / "dark.gif", stamp=False))
    assert max(frame.max() for frame in frames) == 0


def test_moments_and_shares_of_stamps(monkeypatch):
    """The middle bin of those that are added up, the last one of those that are accumulated."""
    told = []
    module = sys.modules["torchtransient.vis.video"]  # of the package, the name is that of a function
    monkeypatch.setattr(module, "with_strip", lambda image, text, share: told.append((text, share)) or image)
    axis, cube = tt.TimeAxis(1.0, 0.5, 7), torch.rand(1, 7, 2, 3, generator=torch.Generator().manual_seed(6))
    for accumulate, bins in ((False, (1, 4, 6)), (True, (2, 5, 6))):
        told.clear()
        assert len(list(tt.vis.frames(cube, axis=axis, every=3, accumulate=accumulate, scale=1))) == 3
        assert told == [(moment(axis, k, 7), share) for k, share in zip(bins, (3 / 7, 6 / 7, 1), strict=True)]
    told.clear()
    assert tt.vis.frames(cube)[3].shape == (2 * 107, 3 * 107, 3) and told == [("bin 3 of 7", 4 / 7)]
    assert tt.vis.frames(torch.ones(1, 2, 700, 3))[0].shape == (700, 3, 3)


def test_exposure_of_what_a_frame_adds_up():
    """White is that of the frames as they are shown; that of all the light where it is accumulated."""
    cube = torch.zeros(1, 5, 1, 2)
    cube[0, :, 0, 0], cube[0, :, 0, 1] = torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0]), 0.5
    added = torch.stack([cube[:, :2].sum(1), cube[:, 2:4].sum(1), cube[:, 4]], 1)
    for every, accumulate, exposure in (
        (1, False, tt.vis.exposure_of_video(cube)), (2, False, tt.vis.exposure_of_video(added)),
        (2, True, tt.vis.exposure_of(cube.sum(1))),
    ):  # fmt: skip
        shown = tt.vis.frames(cube, every=every, accumulate=accumulate, stamp=False, scale=1)
        told = tt.vis.frames(cube, every=every, accumulate=accumulate, stamp=False, scale=1, exposure=exposure)
        for one, other in zip(shown, told, strict=True):
            np.testing.assert_array_equal(one, other)
        weak = cube[:, :every].sum(1)
        np.testing.assert_array_equal(told[0], to_bytes(tt.vis.tone_map(weak, exposure)))


def test_parts_of_several_heights():
    low, high = np.full((2, 3, 3), 40, np.uint8), np.full((5, 1, 3), 90, np.uint8)
    both = tt.vis.side_by_side([[low, low], [high]])
    assert len(both) == 1 and both[0].shape == (5, 3 + 4 + 1, 3)
    assert (both[0][:2, :3] == 40).all() and not both[0][2:, :3].any() and (both[0][:, 7:] == 90).all()
    np.testing.assert_array_equal(tt.vis.side_by_side([[high], [low]], gap=0)[0][:, 0], high[:, 0])


def test_bytes_are_the_nearest():
    assert to_bytes([-1.0, 0.0, 0.0999, 0.1, 0.5, 1.0, 2.0]).tolist() == [0, 0, 25, 26, 128, 255, 255]


@pytest.mark.parametrize("fps, duration", [(50, 20), (30, 30), (24, 40), (7, 140)])
def test_hundredths_of_a_second(tmp_path, fps, duration):
    frames = [np.full((4, 6, 3), 80 * k, np.uint8) for k in range(3)]
    assert read_gif(tt.vis.write_video(tmp_path / "a.gif", frames, 3, fps=fps))[1]["duration"] == duration


def box(kind, size, long=False):
    """A box of an MP4, of zeros."""
    head = struct.pack(">I4s", 1 if long else size, kind) + (struct.pack(">Q", size) if long else b"")
    return head + bytes(size - len(head))


@pytest.mark.parametrize(
    "content, whole",
    [
        (box(b"ftyp", 20) + box(b"moov", 30) + box(b"mdat", 50), True),
        (box(b"moov", 30) + box(b"mdat", 50, long=True) + box(b"free", 8), True),
        (box(b"moov", 30) + box(b"mdat", 50)[:-1], False),
        (box(b"moov", 30) + box(b"mdat", 50) + bytes(3), False),
        (box(b"ftyp", 20) + box(b"mdat", 50), False),
        (box(b"ftyp", 20) + box(b"moov", 50), False),
        (box(b"moov", 30) + struct.pack(">I4s", 7, b"mdat") + box(b"mdat", 50), False),
        (b"", False),
    ],
)
def test_what_is_a_whole_mp4(tmp_path, content, whole):
    (tmp_path / "a.mp4").write_bytes(content)
    assert video_file._is_whole(tmp_path / "a.mp4") == whole


def test_what_was_added_is_not_added_again():
    cube = torch.rand(2, 7, 3, 4, generator=torch.Generator().manual_seed(3))
    running = _Running(cube)
    np.testing.assert_allclose(running.until(5), cube[:, :5].sum(1), rtol=1e-6)
    running.cube = torch.zeros_like(cube)
    np.testing.assert_allclose(running.until(5), cube[:, :5].sum(1), rtol=1e-6)
    np.testing.assert_allclose(running.until(6), cube[:, :5].sum(1), rtol=1e-6)
    assert not running.until(4).any()


def test_colours_of_a_palette():
    """Those of the strip first; then what is seen in some pixels of large frames, to a sixty-fourth."""
    frame = np.full((200, 200, 3), (203, 43, 15), np.uint8)
    flat = frame.reshape(-1, 3)
    flat[1::3] = (15, 203, 43)  # of 40000, each third one is looked at
    flat[3] = (43, 15, 203)
    found = [tuple(colour) for colour in np.reshape(video_file._palette([frame], 1).getpalette(), (-1, 3)).tolist()]
    greys = [(level,) * 3 for level in range(44, 235, 24)]
    assert found[: 5 + len(greys)] == [(20,) * 3, (95,) * 3, (235,) * 3, (0,) * 3, (255,) * 3, *greys]
    assert {(200, 40, 12), (40, 12, 200)} <= set(found[5 + len(greys) :]) and (12, 200, 40) not in found


def test_an_mp4_may_be_fast(tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(video_file, "_write_mp4", lambda target, frames, fps: told.append((list(frames), fps)))
    monkeypatch.setattr(video_file, "replacing", lambda target, who: nullcontext(target))
    frame = np.zeros((4, 6, 3), np.uint8)
    assert tt.vis.write_video(tmp_path / "a.MP4", [frame, frame + 1], 2, fps=120) == tmp_path / "a.MP4"
    ((frames, fps),) = told
    assert fps == 120 and [int(one.max()) for one in frames] == [0, 1]
