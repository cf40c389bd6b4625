"""Still pictures against cubes whose answer is known: the arrays that matplotlib is given, and the files."""

from __future__ import annotations

import re
import sys

import numpy as np
import PIL.Image
import pytest
import torch

import torchtransient as tt
from support.captures import confocal_plane
from support.cubes import AXIS, read_png, sweep
from support.sweeps import together
from torchtransient.errors import ArgumentError, MissingPackageError, ShapeError, StorageError, UnitError
from torchtransient.vis import colour_maps
from torchtransient.vis.files import save_image, to_palette

NAN, INF = float("nan"), float("inf")
NS = 0.299792458  # metres of a nanosecond


def shown(figure, panel=0):
    """The array of the image of a panel."""
    return np.asarray(figure.axes[panel].images[0].get_array())


def linear(image):
    return np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)


def lightness(image):
    """Of sRGB colours in Oklab, from scratch: cube root of the mean cone response (Ottosson 2020, first row)."""
    lms = np.array([[0.4122214708, 0.5363325363, 0.0514459929], [0.2119034982, 0.6806995451, 0.1073969566],
                    [0.0883024619, 0.2817188376, 0.6299787005]])  # fmt: skip
    return np.cbrt(linear(image) @ lms.T) @ np.array([0.2104542553, 0.7936177850, -0.0040720468])


# ------------------------------------------------------------------------------------------------- colour maps


def test_colours_of_oklch():
    """White, black, and the primaries as Ottosson's matrices have them; the dark end of sRGB is a line."""
    np.testing.assert_allclose(colour_maps.oklch([1.0, 0.0], 0.0, 77.0), [[1, 1, 1], [0, 0, 0]], atol=1e-6)
    for oklch, rgb in (
        ((0.62796, 0.25768, 29.2339), [1, 0, 0]), ((0.86644, 0.29483, 142.4953), [0, 1, 0]),
        ((0.45201, 0.31321, 264.0520), [0, 0, 1]),
    ):  # fmt: skip
        np.testing.assert_allclose(colour_maps.oklch(*oklch), rgb, atol=3e-3)
    np.testing.assert_allclose(colour_maps.oklch(0.1, 0.0, 0.0), [12.92e-3] * 3, rtol=1e-5)


def test_cyclic_colours_are_equally_light_and_close_the_circle():
    turns = np.linspace(0, 1, 200)
    light = lightness(colour_maps.cyclic(turns))
    assert np.ptp(light) < 0.02 and light.mean() == pytest.approx(0.75, abs=0.01)
    np.testing.assert_allclose(colour_maps.cyclic(0.0), colour_maps.cyclic(1.0), atol=1e-9)
    steps = np.linalg.norm(np.diff(colour_maps.cyclic(turns), axis=0), axis=1)
    assert steps.max() < 4 * steps.mean()
    np.testing.assert_array_equal(colour_maps.cyclic(0.3, 0.0), np.zeros(3))
    np.testing.assert_allclose(colour_maps.cyclic_map()(128)[:3], colour_maps.cyclic(0.5 / 256), atol=1e-6)
    np.testing.assert_allclose(colour_maps.cyclic_map("hsv")(128)[:3], [1, 0, 0], atol=0.05)


def test_rainbow_is_monotone_in_value_and_equal_in_hue():
    for value in (0.3, 0.7):
        assert np.ptp(lightness(colour_maps.rainbow(np.linspace(0, 1, 50), value))) < 0.05
    assert (np.diff(lightness(colour_maps.rainbow(0.4, np.linspace(0, 1, 20)))) > 0).all()
    red, violet = colour_maps.rainbow([0.0, 1.0])
    assert red.argmax() == 0 and violet.argmax() == 2 and violet.argmin() == 1
    r, g, b = colour_maps.rainbow(NAN, 0.5)
    assert r == pytest.approx(g, abs=1e-3) and g == pytest.approx(b, abs=1e-3)


def test_symmetric_limit():
    values = np.r_[np.linspace(-1, 1, 201), 1e6]
    assert colour_maps.symmetric_limit(values) == pytest.approx(0.99, abs=0.01)
    assert colour_maps.symmetric_limit([0.0, 0.0]) == colour_maps.symmetric_limit([NAN, -INF]) == 1.0
    assert colour_maps.symmetric_limit(np.r_[np.zeros(1000), -3.0]) == 3.0


# ------------------------------------------------------------------------------------- exposure and tone curves


def test_white_of_an_image():
    image = torch.tensor([[[1.0, 7.0, 3.0], [INF, 5.0, 2.0]], [[4.0, 0.0, 6.0], [0.0, NAN, -1.0]]])
    image = torch.cat([image, 0 * image[:1].nan_to_num(posinf=0.0)])
    # The brightest channels are 4, 7, 6 and 2 among what is finite.
    for quantile, white in ((0.1, 2), (0.25, 4), (0.5, 6), (0.74, 6), (0.75, 7), (1.0, 7)):
        assert tt.vis.exposure_of(image, quantile) == 1 / white
    assert tt.vis.exposure_of(-image[:1]) == tt.vis.exposure_of(torch.zeros(3, 4, 4)) == 1.0
    spot = torch.zeros(1, 100, 100)
    spot[0, 3, 3] = 0.25
    assert tt.vis.exposure_of(spot) == 4.0


def test_curves():
    ramp = torch.tensor([0.0, 2.0**-10, 2.0**-5, 0.25, 1.0, 4.0, -1.0]).reshape(1, 1, 7).requires_grad_()
    assert tt.vis.tone_map(ramp, 1.0, "linear")[0, :, 0].tolist() == [0, 2**-10, 2**-5, 0.25, 1, 1, 0]
    gamma = tt.vis.tone_map(ramp, 1.0, "gamma")[0, :, 1]
    np.testing.assert_allclose(gamma, [*np.array([0, 2**-10, 2**-5, 0.25, 1, 1]) ** (1 / 2.2), 0], atol=1e-12)
    log = tt.vis.tone_map(ramp, 1.0, "log")[0, :, 2]
    np.testing.assert_allclose(log, [0, 0, 0.5, 0.8, 1, 1, 0], atol=1e-12)
    srgb = tt.vis.tone_map(torch.tensor([0.0, 0.0031308, 0.2140411, 1.0]).reshape(1, 1, 4), 1.0)
    np.testing.assert_allclose(srgb[0, :, 0], [0.0, 0.04045, 0.5, 1.0], atol=2e-6)


def test_log_curve_keeps_colours_apart():
    """A red of one hundredth the light has the colour of the bright red, only darker."""
    colour = torch.tensor([1.0, 0.5, 0.25]).reshape(3, 1, 1)
    bright, weak = tt.vis.tone_map(colour, 1.0, "log")[0, 0], tt.vis.tone_map(colour / 128, 1.0, "log")[0, 0]
    np.testing.assert_allclose(weak / weak[0], bright / bright[0], atol=1e-12)
    assert weak[0] == pytest.approx(0.3)


# --------------------------------------------------------------------------------------------- time of arrival


def test_peak_time(tmp_path):
    """Of all channels together; the first of equal bins; none without light."""
    cube = sweep()
    cube[:, 7, 0, 2] = 1.0
    cube[0, 9, 1, 3], cube[:, 6, 1, 3] = 1.2, 0.5
    expected = AXIS.centers_opl.repeat(6, 1)
    expected[5] = NAN
    expected[1, 3] = AXIS.centers_opl[3]
    assert torch.equal(tt.vis.peak_time(cube, AXIS).nan_to_num(-1), expected.nan_to_num(-1))
    figure = tt.vis.peak_time_picture(cube, tmp_path / "p.png", axis=AXIS)
    np.testing.assert_allclose(np.ma.filled(figure.axes[0].images[0].get_array(), NAN), expected)
    metres, nanoseconds = figure.axes[1].get_ylim(), figure.axes[2].get_ylim()
    np.testing.assert_allclose(nanoseconds, np.array(metres) / NS, rtol=1e-9)
    assert read_png(tmp_path / "p.png").size > 10_000
    one = torch.zeros(1, 10, 2, 5)
    one[:, 2] = 1.0
    # At least a bin wide; all of the axis without light.
    assert tt.vis.peak_time_picture(one, axis=AXIS).axes[0].images[0].get_clim() == (3.25, 3.75)
    assert tt.vis.peak_time_picture(0 * one, axis=AXIS).axes[0].images[0].get_clim() == (2.0, 7.0)


def test_rainbow_hue_is_time_and_brightness_is_light(tmp_path):
    cube = sweep()
    cube[:, :, 2] *= 0.1
    image = tt.vis.rainbow(cube, tmp_path / "r.png", axis=AXIS, limits=(2.0, 7.0), exposure=1 / 3)
    np.testing.assert_array_equal(read_png(tmp_path / "r.png"), image)
    expected = colour_maps.rainbow((np.arange(10) + 0.5) / 10, 1.0)
    np.testing.assert_allclose(image[0] / 255, expected, atol=1 / 255)
    assert (image[2].max(-1) < image[0].max(-1)).all()
    assert image[5].max() == 0
    repeated = tt.vis.rainbow(sweep(), axis=AXIS, period_opl=1.0, limits=(2.0, 7.0))
    np.testing.assert_array_equal(repeated[0, 0:8], repeated[0, 2:10])
    assert (repeated[0, 0] != repeated[0, 1]).any()


def test_fusion_mixes_linear_light():
    """Of one pulse it is the style of peaks."""
    arguments = {"axis": AXIS, "limits": (2.0, 7.0), "exposure": 1 / 3}
    peak, fusion = (tt.vis.rainbow(sweep(), style=s, **arguments) for s in ("peak", "fusion"))
    np.testing.assert_allclose(peak.astype(int), fusion.astype(int), atol=1)
    cube = torch.zeros(1, 10, 1, 1)
    cube[0, 0], cube[0, 9] = 0.5, 0.5
    image = tt.vis.rainbow(cube, axis=AXIS, limits=(2.0, 7.0), style="fusion", exposure=1.0)[0, 0] / 255
    mixed = linear(colour_maps.rainbow(np.array([0.05, 0.95]))).mean(0)
    np.testing.assert_allclose(image, 1.055 * mixed ** (1 / 2.4) - 0.055, atol=1 / 255)


def test_rainbow_as_it_is_without_options():
    """Bins are the lengths, hues run from 1 % to 99 % of the light, and 5 % of the pixels are white."""
    cube = torch.zeros(1, 40, 4, 6)
    cube[:, 10:30] = torch.rand(1, 20, 4, 6, generator=torch.Generator().manual_seed(9))
    given = {"axis": tt.TimeAxis(0.0, 1.0, 40), "exposure": tt.vis.exposure_of(cube.sum(1), 0.95)}
    for style in ("peak", "fusion"):
        np.testing.assert_array_equal(
            tt.vis.rainbow(cube, style=style), tt.vis.rainbow(cube, style=style, limits=(10.0, 30.0), **given)
        )


@together("style", ["peak", "fusion"])
def test_rainbow_of_broken_and_dark_cubes(style):
    cube = sweep()
    cube[0, 0, 0, 0], cube[0, 0, 0, 1] = NAN, INF
    image = tt.vis.rainbow(cube, axis=AXIS, style=style)
    assert image[0, 0].tolist() == image[0, 1].tolist() == [255, 0, 255]
    assert image[0, 4].max() > 100
    assert tt.vis.rainbow(torch.zeros(1, 4, 3, 3), style=style).max() == 0


# -------------------------------------------------------------------------- one page, slices, sheets, histograms


def test_overview(tmp_path):
    """The pixel is neither lamp nor dark, and each lit one counts alike: 15 see light for 61 bins, 5 a flash."""
    cube = torch.zeros(3, 100, 6, 5)
    cube[:, 20:81] = 1.0
    cube[:, :, :2] = cube[:, :, 5] = 0.0
    cube[:, 30, 5] = 1e6
    figure = tt.vis.plot_overview(cube, cube.sum(1), tt.TimeAxis(2.0, 0.1, 100), path=tmp_path / "a.png", title="pulse")
    titles = " ".join(panel.get_title() for panel in figure.axes)
    assert re.search("pixel at row [234],", titles)
    assert re.findall(r"bin (\d+)", titles) == ["28", "40", "72"]  # a tenth, half and nine tenths of the light
    assert read_png(tmp_path / "a.png").std() > 10
    flash = torch.zeros(1, 100, 2, 2)
    flash[:, 98] = 1.0
    figure = tt.vis.plot_overview(flash, flash.sum(1), tt.TimeAxis(2.0, 0.1, 100), path=tmp_path / "a.png")
    assert re.findall(r"bin (\d+)", " ".join(panel.get_title() for panel in figure.axes)) == ["98", "99", "99"]


def test_a_streak():
    cube = sweep()
    panel = tt.vis.streak(cube, axis=AXIS).axes[0]
    assert panel.images[0].get_extent() == [-0.5, 9.5, 7.0, 2.0]
    assert ((shown(panel.figure)[..., 0] > 0) == np.eye(10, dtype=bool)).all()
    line = cube[:, :, :, 8]
    other = tt.vis.streak(cube, column=-2, curve="linear", exposure=0.5)
    np.testing.assert_allclose(shown(other), tt.vis.tone_map(line, 0.5, "linear"))
    assert "column 8" in other.axes[0].get_title()


def test_histograms():
    cube = 0.1 + torch.rand(3, 7, 2, 5, generator=torch.Generator().manual_seed(4))
    cube[1, 2, 1, 4] = 0.0
    figure = tt.vis.histogram(cube, pixels=[(1, 4), (0, 2)], axis=tt.TimeAxis(1.5, 0.25, 7), log=True)
    for panel, (row, column) in zip(figure.axes, ((1, 4), (0, 2)), strict=True):
        for channel, patch in enumerate(panel.patches):
            # Nothing is a gap, where the scale has no zero.
            wanted = np.where(cube[channel, :, row, column] > 0, cube[channel, :, row, column], np.nan)
            np.testing.assert_array_equal(patch.get_data().values, wanted)
            np.testing.assert_allclose(patch.get_data().edges, 1.5 + 0.25 * np.arange(8))
    assert len(tt.vis.histogram(cube[:2], pixels=[(0, 0)]).axes[0].patches) == 2


def test_frame_grid(tmp_path):
    figure = tt.vis.frame_grid(sweep(), tmp_path / "g.png", axis=AXIS, bins=(2, 9), exposure=1.0)
    for panel, index in ((0, 2), (1, 9)):
        assert (shown(figure, panel)[0, :, 0] > 0).nonzero()[0].tolist() == [index]
    figure = tt.vis.frame_grid(sweep(), count=5)
    assert [(shown(figure, k)[0, :, 0] > 0).nonzero()[0].tolist() for k in range(5)] == [[0], [2], [4], [6], [8]]


def test_captures_stand_as_the_wall():
    """Rows of the wall run upwards, those of pictures downwards."""
    capture = confocal_plane(size=(4, 3))
    capture.transient[:, :, 0] = 0.0
    peaks = np.ma.filled(tt.vis.peak_time_picture(capture).axes[0].images[0].get_array(), NAN)
    assert peaks.shape == (3, 4) and np.isnan(peaks[2]).all() and np.isfinite(peaks[:2]).all()


# --------------------------------------------------------------------------------------------------- gradients


def test_gradient_picture(tmp_path):
    values = torch.linspace(-1, 2, 3000).reshape(3, 25, 40)
    values[0, 0, 0] = NAN
    figure = tt.vis.gradient_picture(values, tmp_path / "g.png")
    image = figure.axes[0].images[0]
    low, high = image.get_clim()
    assert low == -high
    sums = values.double().sum(0).numpy()
    assert high == pytest.approx(np.nanpercentile(np.abs(sums), 99), rel=1e-9)
    np.testing.assert_array_equal(np.ma.filled(image.get_array(), NAN), sums)
    np.testing.assert_allclose(image.cmap(0.5)[:3], [0.97, 0.97, 0.97], atol=0.02)  # zero is white
    red, blue = image.cmap(1.0), image.cmap(0.0)
    assert red[0] > red[2] and blue[2] > blue[0]
    assert tt.vis.gradient_picture(torch.zeros(4, 4)).axes[0].images[0].get_clim() == (-1.0, 1.0)


# ------------------------------------------------------------------------------------------------------ refused


@together("call, error", [
    (lambda v: v.peak_time_picture(sweep()), ShapeError),  # without an axis
    (lambda v: v.peak_time_picture(sweep(), axis=tt.TimeAxis(0, 1, 9)), ShapeError),
    (lambda v: v.rainbow(sweep(), axis=AXIS, limits=(3, 3)), UnitError),
    (lambda v: v.peak_time(sweep()[None], AXIS), ShapeError),
    (lambda v: v.plot_overview(sweep(), sweep(), AXIS, path="a.png"), ShapeError),
    (lambda v: v.plot_overview(sweep(), sweep().sum(1)[:, 1:], AXIS, path="a.png"), ShapeError),
    (lambda v: v.plot_overview(sweep(), sweep().sum(1), AXIS, path="a.png", errors=sweep()[0, :, 1:]), ShapeError),
    (lambda v: v.plot_overview(sweep(), sweep().sum(1), AXIS, path="a.png", pixel=(6, 0)), ShapeError),
    (lambda v: v.rainbow(sweep(), style="prism"), ArgumentError),
    (lambda v: v.rainbow(sweep(), period_opl=0.0), UnitError), (lambda v: v.streak(sweep(), row=6), ShapeError),
    (lambda v: v.streak(sweep(), row=1, column=1), ArgumentError),
    (lambda v: v.frame_grid(sweep(), bins=[-1]), ShapeError),
    (lambda v: v.gradient_picture(sweep()), ShapeError),
    (lambda v: v.tone_map(torch.ones(2, 2, 3)), ShapeError),
    (lambda v: v.tone_map(torch.ones(1, 2, 3), INF), UnitError),
    (lambda v: v.exposure_of(torch.ones(1, 2, 3), 1.01), UnitError),
    (lambda v: v.rainbow(sweep(), "missing/r.png"), StorageError),
    (lambda v: v.rainbow(sweep(), "r.nonsense"), StorageError),
    (lambda v: v.streak(sweep(), "missing/s.png"), StorageError),
])  # fmt: skip
def test_refused(call, error, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error):
        call(tt.vis)
    assert not list(tmp_path.iterdir())


# -------------------------------------------------------------------------------------------------------- files


def test_endings(tmp_path):
    """A figure without an ending is a PNG; images are what their endings say, in capitals, too."""
    tt.vis.streak(sweep(), tmp_path / "streak")
    assert [path.name for path in tmp_path.iterdir()] == ["streak.png"]
    for name, kind in (("a.PNG", "PNG"), ("b.jpg", "JPEG")):
        tt.vis.rainbow(sweep(), tmp_path / name)
        assert PIL.Image.open(tmp_path / name).format == kind


def test_pictures_of_few_colours(tmp_path):
    """Noise along a ramp of one hue, in a frame: smaller, and hardly another picture. Other files stay as they are."""
    level = np.random.default_rng(0).integers(0, 256, (60, 300))
    ramp = np.stack([level, level // 2, 255 - level], -1).astype(np.uint8)
    ramp[:3], ramp[-3:] = (30, 60, 200), (255, 255, 255)
    for name in ("ramp.png", "ramp.tiff"):
        save_image(ramp, tmp_path / name, "test")
        before = (tmp_path / name).stat().st_size
        to_palette(tmp_path / name)
        found = np.asarray(PIL.Image.open(tmp_path / name).convert("RGB")).astype(int)
        off, smaller = np.abs(found - ramp), (tmp_path / name).stat().st_size < before
        assert (smaller and 0 < off.mean() < 4 and off.max() <= 20) if name == "ramp.png" else not off.any()


@pytest.mark.parametrize(
    ("module", "call", "package"),
    [
        ("PIL", lambda path: tt.vis.rainbow(sweep(), path / "a.png"), "pillow"),
        ("PIL", lambda path: tt.vis.video(sweep(), path / "a.gif"), "pillow"),
        ("imageio_ffmpeg", lambda path: tt.vis.video(sweep(), path / "a.mp4"), "imageio-ffmpeg"),
        ("matplotlib.figure", lambda path: tt.vis.streak(sweep()), "matplotlib"),
    ],
)
def test_missing_packages(module, call, package, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingPackageError, match=rf"package {package}.*pip install\s+'torchtransient\[vis\]'"):
        call(tmp_path)
