"""Still pictures against cubes whose answer is known: the arrays that matplotlib is given, and the files."""

from __future__ import annotations

import numpy as np
import PIL.Image
import pytest
import torch

import torchtransient as tt
from support.cubes import AXIS, read_png, sweep
from torchtransient.errors import ArgumentError, ShapeError, StorageError, UnitError
from torchtransient.vis import colour_maps
from torchtransient.vis.arrival import _arrival_limits
from torchtransient.vis.files import save_image, to_palette

NAN, INF = float("nan"), float("inf")


def shown(figure, panel=0):
    """The array of the image of a panel."""
    return np.asarray(figure.axes[panel].images[0].get_array())


def luminance_in_oklab(image):
    """Lightness of sRGB colours, from scratch: cube root of the mean cone response (Ottosson 2020, first row)."""
    linear = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
    lms = np.array([[0.4122214708, 0.5363325363, 0.0514459929], [0.2119034982, 0.6806995451, 0.1073969566],
                    [0.0883024619, 0.2817188376, 0.6299787005]])  # fmt: skip
    return np.cbrt(linear @ lms.T) @ np.array([0.2104542553, 0.7936177850, -0.0040720468])


# ------------------------------------------------------------------------------------------------- colour maps


def test_cyclic_colours_are_equally_light_and_close_the_circle():
    turns = np.linspace(0, 1, 200)
    light = luminance_in_oklab(colour_maps.cyclic(turns))
    assert np.ptp(light) < 0.02 and light.mean() == pytest.approx(0.75, abs=0.01)
    np.testing.assert_allclose(colour_maps.cyclic(0.0), colour_maps.cyclic(1.0), atol=1e-9)
    steps = np.linalg.norm(np.diff(colour_maps.cyclic(turns), axis=0), axis=1)
    assert steps.max() < 4 * steps.mean()
    np.testing.assert_array_equal(colour_maps.cyclic(0.3, 0.0), np.zeros(3))


def test_rainbow_is_monotone_in_value_and_equal_in_hue():
    for value in (0.3, 0.7):
        light = luminance_in_oklab(colour_maps.rainbow(np.linspace(0, 1, 50), value))
        assert np.ptp(light) < 0.05
    assert (np.diff(luminance_in_oklab(colour_maps.rainbow(0.4, np.linspace(0, 1, 20)))) > 0).all()
    r, g, b = colour_maps.rainbow(NAN, 0.5)
    assert r == pytest.approx(g, abs=1e-3) and g == pytest.approx(b, abs=1e-3)


def test_cyclic_map_has_zero_in_the_middle():
    np.testing.assert_allclose(colour_maps.cyclic_map()(128)[:3], colour_maps.cyclic(0.5 / 256), atol=1e-6)
    np.testing.assert_allclose(colour_maps.cyclic_map("hsv")(128)[:3], [1, 0, 0], atol=0.05)


def test_symmetric_limit():
    values = np.r_[np.linspace(-1, 1, 201), 1e6]
    assert colour_maps.symmetric_limit(values, 95) == pytest.approx(0.95, abs=0.02)
    assert colour_maps.symmetric_limit([0.0, 0.0]) == 1.0
    assert colour_maps.symmetric_limit([NAN, -INF]) == 1.0
    assert colour_maps.symmetric_limit(np.r_[np.zeros(1000), -3.0]) == 3.0


# ------------------------------------------------------------------------------------------------- tone curves


def test_curves():
    ramp = torch.tensor([0.0, 2.0**-10, 2.0**-5, 0.25, 1.0, 4.0, -1.0]).reshape(1, 1, 7)
    assert tt.vis.tone_map(ramp, 1.0, "linear")[0, :, 0].tolist() == [0, 2**-10, 2**-5, 0.25, 1, 1, 0]
    gamma = tt.vis.tone_map(ramp, 1.0, "gamma", gamma=2.0)[0, :, 1]
    np.testing.assert_allclose(gamma, [0, 2**-5, 2**-2.5, 0.5, 1, 1, 0], atol=1e-12)
    log = tt.vis.tone_map(ramp, 1.0, "log", stops=10.0)[0, :, 2]
    np.testing.assert_allclose(log, [0, 0, 0.5, 0.8, 1, 1, 0], atol=1e-12)


def test_log_curve_keeps_colours_apart():
    """A red of one hundredth the light has the colour of the bright red, only darker."""
    colour = torch.tensor([1.0, 0.5, 0.25]).reshape(3, 1, 1)
    bright, weak = tt.vis.tone_map(colour, 1.0, "log")[0, 0], tt.vis.tone_map(colour / 128, 1.0, "log")[0, 0]
    np.testing.assert_allclose(weak / weak[0], bright / bright[0], atol=1e-12)
    assert weak[0] == pytest.approx(0.3)


@pytest.mark.parametrize("bad", [{"exposure": 0.0}, {"exposure": NAN}, {"gamma": 0}, {"stops": -1}])
def test_curve_arguments(bad):
    with pytest.raises(UnitError, match="tone_map: expected"):
        tt.vis.tone_map(torch.ones(1, 2, 2), **bad)
    with pytest.raises(ArgumentError, match="tone_map: expected a curve"):
        tt.vis.tone_map(torch.ones(1, 2, 2), curve="x")


# --------------------------------------------------------------------------------------------- time of arrival


def test_peak_time_picture(tmp_path):
    figure = tt.vis.peak_time_picture(sweep(), tmp_path / "p.png", axis=AXIS)
    image = shown(figure)
    np.testing.assert_allclose(image[0], AXIS.centers_opl.numpy())
    assert np.isnan(np.ma.filled(figure.axes[0].images[0].get_array(), np.nan)[5]).all()
    metres, nanoseconds = figure.axes[1].get_ylim(), figure.axes[2].get_ylim()
    np.testing.assert_allclose(nanoseconds, np.array(metres) / 0.299792458, rtol=1e-9)
    assert read_png(tmp_path / "p.png").size > 10_000


def test_rainbow_hue_is_time_and_brightness_is_light(tmp_path):
    cube = sweep()
    cube[:, :, 2] *= 0.1
    image = tt.vis.rainbow(cube, tmp_path / "r.png", axis=AXIS, limits=(2.0, 7.0), exposure=1 / 3)
    np.testing.assert_array_equal(read_png(tmp_path / "r.png"), image)
    expected = colour_maps.rainbow((np.arange(10) + 0.5) / 10, 1.0)
    np.testing.assert_allclose(image[0] / 255, expected, atol=1 / 255)
    assert (image[2].max(-1) < image[0].max(-1)).all()
    assert image[5].max() == 0


def test_fusion_of_one_pulse_is_the_peak_style():
    arguments = {"axis": AXIS, "limits": (2.0, 7.0), "exposure": 1 / 3}
    peak, fusion = (tt.vis.rainbow(sweep(), style=s, **arguments) for s in ("peak", "fusion"))
    np.testing.assert_allclose(peak.astype(int), fusion.astype(int), atol=1)


def test_fusion_mixes_linear_light():
    cube = torch.zeros(1, 10, 1, 1)
    cube[0, 0], cube[0, 9] = 0.5, 0.5
    image = tt.vis.rainbow(cube, axis=AXIS, limits=(2.0, 7.0), style="fusion", exposure=1.0)[0, 0] / 255
    ends = colour_maps.rainbow(np.array([0.05, 0.95]))
    linear = np.where(ends <= 0.04045, ends / 12.92, ((ends + 0.055) / 1.055) ** 2.4).mean(0)
    np.testing.assert_allclose(image, 1.055 * linear ** (1 / 2.4) - 0.055, atol=1 / 255)


def test_rainbow_repeats_with_its_period():
    image = tt.vis.rainbow(sweep(), axis=AXIS, period_opl=1.0, limits=(2.0, 7.0))
    np.testing.assert_array_equal(image[0, 0:8], image[0, 2:10])
    assert (image[0, 0] != image[0, 1]).any()


def test_rainbow_as_it_is_without_options():
    """Bins are the lengths, 5 % of the pixels are white, and light below zero is none."""
    cube = torch.rand(1, 7, 4, 6, generator=torch.Generator().manual_seed(9)) - 0.1
    cube[0, 2, 0, 0] = -3.0
    given = {"axis": tt.TimeAxis(0.0, 1.0, 7), "exposure": tt.vis.exposure_of(cube.sum(1), 0.95)}
    for style in ("peak", "fusion"):
        limits = _arrival_limits(cube, given["axis"])
        np.testing.assert_array_equal(
            tt.vis.rainbow(cube, style=style), tt.vis.rainbow(cube, style=style, limits=limits, **given)
        )
    cube = torch.tensor([2.0, -5.0, 6.0]).reshape(1, 3, 1, 1)
    mixed = tt.vis.rainbow(cube, style="fusion", limits=(0, 3), exposure=1.0)
    np.testing.assert_array_equal(
        mixed, tt.vis.rainbow(cube.clamp(min=0), style="fusion", limits=(0, 3), exposure=1.0)
    )


@pytest.mark.parametrize("style", ["peak", "fusion"])
def test_rainbow_of_broken_and_dark_cubes(style):
    cube = sweep()
    cube[0, 0, 0, 0], cube[0, 0, 0, 1] = NAN, INF
    image = tt.vis.rainbow(cube, axis=AXIS, style=style)
    assert image[0, 0].tolist() == image[0, 1].tolist() == [255, 0, 255]
    assert image[0, 4].max() > 100
    assert tt.vis.rainbow(torch.zeros(1, 4, 3, 3), style=style).max() == 0


# ----------------------------------------------------------------------------------- slices, sheets, histograms


def test_frame_grid(tmp_path):
    figure = tt.vis.frame_grid(sweep(), tmp_path / "g.png", axis=AXIS, bins=(2, 9), exposure=1.0)
    for panel, index in ((0, 2), (1, 9)):
        image = shown(figure, panel)
        assert (image[0, :, 0] > 0).nonzero()[0].tolist() == [index]
    assert figure.axes[0].get_title().startswith("3.3 m = ") or figure.axes[0].get_title().startswith("3.2 m = ")
    figure = tt.vis.frame_grid(sweep(), count=5)
    assert [(shown(figure, k)[0, :, 0] > 0).nonzero()[0].tolist() for k in range(5)] == [[0], [2], [4], [6], [8]]


# --------------------------------------------------------------------------------------------------- gradients


def test_gradient_picture(tmp_path):
    values = torch.linspace(-1, 2, 3000).reshape(3, 25, 40)
    values[0, 0, 0] = NAN
    figure = tt.vis.gradient_picture(values, tmp_path / "g.png", percentile=100)
    image = figure.axes[0].images[0]
    low, high = image.get_clim()
    assert low == -high
    assert high == pytest.approx(float(values[:, 1:].sum(0).abs().max()), rel=1e-6)
    np.testing.assert_allclose(image.cmap(0.5)[:3], [0.97, 0.97, 0.97], atol=0.02)  # zero is white
    red, blue = image.cmap(1.0), image.cmap(0.0)
    assert red[0] > red[2] and blue[2] > blue[0]
    figure = tt.vis.gradient_picture(values, per_channel=True, limit=0.5)
    assert [figure.axes[k].images[0].get_clim() for k in range(3)] == [(-0.5, 0.5)] * 3
    np.testing.assert_allclose(shown(figure, 2), values[2].numpy())
    dark = tt.vis.gradient_picture(torch.zeros(4, 4)).axes[0].images[0]
    assert dark.get_clim() == (-1.0, 1.0)


# ------------------------------------------------------------------------------------------------------ refused


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda v: v.peak_time_picture(sweep()), ShapeError, "without an axis"),
        (lambda v: v.peak_time_picture(sweep(), axis=AXIS, limits=(3, 3)), UnitError, "first below the second"),
        (lambda v: v.rainbow(sweep(), style="prism"), ArgumentError, "'peak' or 'fusion'"),
        (lambda v: v.rainbow(sweep(), period_opl=0.0), UnitError, "period_opl > 0"),
        (lambda v: v.streak(sweep(), row=1, column=1), ArgumentError, "got both"),
        (lambda v: v.streak(sweep(), row=6), ShapeError, "row 6 lies outside"),
        (lambda v: v.frame_grid(sweep(), bins=[10]), ShapeError, "bin 10"),
        (lambda v: v.frame_grid(sweep(), bins=[]), ShapeError, "some bins"),
        (lambda v: v.histogram(sweep(), pixels=[]), ShapeError, "at least one pixel"),
        (lambda v: v.histogram(sweep(), pixels=[(6, 0)]), ShapeError, "outside"),
        (lambda v: v.gradient_picture(sweep()), ShapeError, r"\(C, H, W\) or \(H, W\)"),
        (lambda v: v.gradient_picture(torch.ones(2, 2), percentile=0), UnitError, "percentile"),
        (lambda v: v.gradient_picture(torch.ones(2, 2), limit=0), UnitError, "limit > 0"),
        (lambda v: v.rainbow(sweep(), "missing/r.png"), StorageError, "cannot write"),
        (lambda v: v.rainbow(sweep(), "r.nonsense"), StorageError, "cannot write"),
        (lambda v: v.streak(sweep(), "missing/s.png"), StorageError, "cannot write"),
    ],
)
def test_refused(call, error, message):
    with pytest.raises(error, match=message):
        call(tt.vis)


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
