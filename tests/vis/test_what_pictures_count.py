"""Curves, peaks and moments behind pictures, number by number, of tensors that have a gradient."""

from __future__ import annotations

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure

import torchtransient as tt
from support.captures import WALL
from support.cubes import read_gif
from torchtransient.capture import Capture, Scan
from torchtransient.vis import colour_maps
from torchtransient.vis.arrival import _arrival_limits, _fused, _hue
from torchtransient.vis.overview import _draw_histogram, light_curve, median_pixel, moments_of_arrival, peak_time
from torchtransient.vis.shape_fit import _numbers
from torchtransient.vis.sources import as_tensor
from torchtransient.vis.tone_mapping import exposure_of, exposure_of_video, tone_map
from torchtransient.vis.volumes import _plain

AXIS = tt.TimeAxis(1.0, 0.5, 5)


def cube(rows=35, columns=3):
    """More rows than are looked at in one piece; some pixels are dark, some numbers below zero."""
    values = np.random.default_rng(2).random((3, 5, rows, columns)).astype(np.float32) - 0.2
    values[:, :, 3, 1] = 0
    values[:, :, rows - 1, 0] = -1
    return values


def tracked(values):
    return torch.tensor(values).requires_grad_()


def test_every_pixel_counts_alike():
    values = cube()
    light = np.clip(values.sum(0, dtype=np.float64), 0, None)
    seen = light.sum(0) > 0
    expected = (light[:, seen] / light.sum(0)[seen]).sum(1) / seen.sum()
    found = light_curve(tracked(values))
    assert not found.requires_grad and found.dtype == torch.float64
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert light_curve(torch.zeros(3, 5, 2, 2)).tolist() == [0] * 5


def test_when_most_light_arrives():
    values = cube()
    summed = values.sum(0)
    centers = 1.25 + 0.5 * np.arange(5)
    expected = np.where(summed.max(0) > 0, centers[summed.argmax(0)], np.nan)
    found = peak_time(tracked(values), AXIS)
    assert found.shape == (35, 3) and not found.requires_grad
    np.testing.assert_array_equal(found, expected)


def test_moments_by_which_shares_have_arrived():
    """Of one pixel with shares 0.1, 0.2, 0.4, 0.2 and 0.1; they differ where they can."""
    one = tracked(np.array([1.0, 2, 4, 2, 1], np.float32).reshape(1, 5, 1, 1))
    assert moments_of_arrival(one) == [0, 2, 3] and moments_of_arrival(one, (0.11, 0.12, 0.13)) == [1, 2, 3]
    assert moments_of_arrival(one, (0.99, 0.999, 1.0)) == [4, 4, 4] and moments_of_arrival(one, (1.5,)) == [4]
    assert moments_of_arrival(torch.zeros(1, 9, 1, 1), (0.0, 0.5, 1.0)) == [0, 4, 8]
    # Between the first and the last hundredth of the light, whole bins.
    assert _arrival_limits(one.detach(), AXIS) == (1.0, 3.5)
    late = torch.tensor([0.0, 1, 1, 0, 0]).reshape(1, 5, 1, 1)
    assert _arrival_limits(late, AXIS) == (1.5, 2.5) and _arrival_limits(0 * late, AXIS) == (1.0, 3.5)


def test_the_pixel_of_median_brightness():
    """Of those that see light, over all channels; the lower one of two."""
    steady = np.zeros((2, 3, 4), np.float32)
    for n, at in enumerate(((2, 3), (0, 1), (1, 2), (2, 0))):
        steady[0, *at], steady[1, *at] = 1.0, n
    assert median_pixel(tracked(steady)) == (0, 1)
    assert median_pixel(tracked(np.zeros((1, 1, 3), np.float32))) == (0, 1)


def test_colours_of_arrival_are_mixed_by_their_share():
    """Equal shares of two hues are the mean of their linear colours, of the brightness of the pixel."""
    values = torch.zeros(2, 2, 1, 3)
    values[0, 0, 0, 0], values[1, 1, 0, 1] = 2.0, 5.0
    values[0, :, 0, 2] = torch.tensor([3.0, 3.0])
    hues, level = np.array([0.1, 0.7]), np.array([[0.5, 1.0, 1.0]])
    first, second, both = _fused(values, hues, level)[0]
    pure = [_fused(values[:, k : k + 1, :, k : k + 1], hues[k : k + 1], np.ones((1, 1)))[0, 0] for k in range(2)]
    np.testing.assert_allclose(first, 0.5 * pure[0], atol=1e-9)
    np.testing.assert_allclose(second, pure[1], atol=1e-9)

    def linear(shown):
        return np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)

    np.testing.assert_allclose(linear(both), (linear(pure[0]) + linear(pure[1])) / 2, atol=1e-6)
    np.testing.assert_allclose(_hue(np.array([1.0, 2.0, 4.0]), 1.0, 3.0, None), [0, 0.5, 1.5])
    np.testing.assert_allclose(_hue(np.array([1.0, 2.0, 4.0]), 1.0, 3.0, 2.0), [0, 0.5, 0.5])


def test_tone_mapping_of_tensors_with_a_gradient():
    image = tracked(np.array([[[0.25, 0.001, -1.0]], [[0.5, 0.001, 0.0]], [[2.0, 0.001, np.nan]]], np.float32))
    found = tone_map(image, exposure=0.5)
    assert not found.requires_grad and found.shape == (1, 3, 3)
    srgb = [1.055 * x ** (1 / 2.4) - 0.055 for x in (0.125, 0.25)]
    np.testing.assert_allclose(found[0, 0], [*srgb, 1.0], rtol=1e-6)
    np.testing.assert_allclose(found[0, 1], [12.92 * 0.0005] * 3, rtol=1e-6)
    assert found[0, 2].tolist() == [1, 0, 1]
    np.testing.assert_allclose(tone_map(image[:, :, :1], 0.5, "gamma", gamma=2.0)[0, 0], np.sqrt([0.125, 0.25, 1.0]))
    assert tone_map(image[:, :, :1], 0.25, "linear")[0, 0].tolist() == [0.0625, 0.125, 0.5]
    video = tracked(np.linspace(0.5, 4.0, 40, dtype=np.float32).reshape(1, 20, 1, 2))
    assert exposure_of_video(video, 1.0) == 0.25


def test_numbers_of_what_is_drawn():
    leaf = tracked(np.array([1.0, 2.0], np.float32))
    assert _numbers(leaf).tolist() == _numbers([1.0, 2.0]).tolist() == [1, 2]
    found = _plain("x", leaf)
    assert found.tolist() == [1, 2] and not found.requires_grad
    assert _plain("x", torch.tensor([3.0 + 4.0j])).tolist() == [25]


def test_hues_run_from_red_to_violet():
    hues = np.array([0.0, 0.25, 1.0])
    np.testing.assert_allclose(colour_maps.rainbow(hues), colour_maps.oklch(0.78, 0.16, [25.0, 95.0, 305.0]))
    np.testing.assert_allclose(colour_maps.rainbow([-1.0, 2.0]), colour_maps.rainbow([0.0, 1.0]))
    np.testing.assert_allclose(colour_maps.cyclic([0.0, 0.25]), colour_maps.oklch(0.75, 0.125, [25.0, 115.0]))
    red, violet = colour_maps.rainbow([0.0, 1.0])
    assert red.argmax() == 0 and violet.argmax() == 2 and violet.argmin() == 1


def test_white_of_a_video_lies_within_nine_decades_of_the_brightest():
    light = torch.full((1, 2, 3, 4), 1e-12, dtype=torch.float64)
    light[0, 1, 2, 3] = 1.0
    np.testing.assert_allclose(exposure_of_video(light, 0.5), 1e9, rtol=0.01)
    light[light < 1] = 1e-7
    np.testing.assert_allclose(exposure_of_video(light, 0.5), 1e7, rtol=0.01)
    np.testing.assert_allclose(exposure_of_video(light, 1.0), 1.0)


def test_the_palette_is_of_frames_out_of_all(tmp_path):
    """Each second one of 30 is looked at: a colour that comes late is there."""
    frames = [np.full((8, 6, 3), (200, 40, 12) if n < 15 else (12, 72, 220), np.uint8) for n in range(30)]
    frames = [np.where(np.arange(6)[:, None] == n % 6, np.uint8(255), one) for n, one in enumerate(frames)]
    found, _ = read_gif(tt.vis.write_video(tmp_path / "a.gif", frames, 30, fps=20))
    for got, wanted in zip(found, frames, strict=True):
        assert np.abs(got.astype(int) - wanted).max() < 8


def test_white_of_a_video_is_found_to_half_a_hundredth():
    """4096 steps over nine decades below the maximum, each light at the upper edge of its step."""
    step = 9 * np.log(10) / 4096
    for highest in (1000.0, 0.002):
        light = torch.full((1, 3, 4, 5), highest * 3.3e-4, dtype=torch.float64)
        light[0, 0, 0, 0], light[0, 2, 0, 1:3] = highest, 0.0
        found = 1 / exposure_of_video(light, 0.5)
        assert highest * 3.3e-4 * (1 - 1e-9) <= found <= highest * 3.3e-4 * np.exp(step) * (1 + 1e-9)
    for one in np.random.default_rng(1).random(40) + 0.1:  # alone, it is the white
        np.testing.assert_allclose(1 / exposure_of_video(torch.full((1, 1, 1, 1), one, dtype=torch.float64)), one)
    # Half of what is lit, of all pieces of sixteen frames.
    light = torch.zeros(1, 40, 1, 2, dtype=torch.float64)
    light[0, :, 0, 0] = torch.arange(1.0, 41.0)
    for quantile, wanted in ((0.25, 10), (0.5, 20), (0.9, 36)):
        found = 1 / exposure_of_video(light, quantile)
        assert wanted * (1 - 1e-9) <= found <= wanted * np.exp(step) * (1 + 1e-9)


def test_white_of_an_image():
    image = torch.tensor([[[1.0, 7.0, 3.0], [np.inf, 5.0, 2.0]], [[4.0, 0.0, 6.0], [0.0, np.nan, -1.0]]])
    image = torch.cat([image, 0 * image[:1].nan_to_num(posinf=0.0)])
    # The brightest channels are 4, 7, 6 and 2 among what is finite.
    for quantile, white in ((0.1, 2), (0.25, 4), (0.5, 6), (0.74, 6), (0.75, 7), (1.0, 7)):
        assert exposure_of(image, quantile) == 1 / white
    assert exposure_of(-image[:1]) == 1.0


def test_the_logarithmic_curve():
    """Stops below white on a scale of one; the ratio of the channels to the brightest on that of the eye."""
    image = torch.tensor([0.25, 1.0, 2.0, 2.0**-9]).reshape(1, 1, 4) * torch.tensor([0.5, 1.0, 0.2]).reshape(3, 1, 1)
    ratio = 1.055 * np.array([0.5, 1.0, 0.2]) ** (1 / 2.4) - 0.055
    found = tone_map(image, 1.0, "log", stops=8.0)[0]
    np.testing.assert_allclose(found, np.array([[0.75], [1], [1], [0]]) * ratio, rtol=1e-6)
    assert tone_map(torch.zeros(3, 1, 1), 1.0, "log").tolist() == [[[0, 0, 0]]]
    np.testing.assert_allclose(tone_map(image[:1], 2.0, "gamma")[0, 0], (2 * 0.125) ** (1 / 2.2), rtol=1e-6)


def test_colours_of_oklch():
    """White, black, and the primaries as Ottosson's matrices have them; the dark end of sRGB is a line."""
    np.testing.assert_allclose(colour_maps.oklch([1.0, 0.0], 0.0, 77.0), [[1, 1, 1], [0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(colour_maps.oklch(0.62796, 0.25768, 29.2339), [1, 0, 0], atol=3e-3)
    np.testing.assert_allclose(colour_maps.oklch(0.86644, 0.29483, 142.4953), [0, 1, 0], atol=3e-3)
    np.testing.assert_allclose(colour_maps.oklch(0.45201, 0.31321, 264.0520), [0, 0, 1], atol=3e-3)
    np.testing.assert_allclose(colour_maps.oklch(0.1, 0.0, 0.0), [12.92e-3] * 3, rtol=1e-5)
    np.testing.assert_allclose(colour_maps.oklch(0.5, 0.0, 0.0), [1.055 * 0.125 ** (1 / 2.4) - 0.055] * 3, rtol=1e-5)


def test_brightness_of_colours():
    for colours, light, chroma in ((colour_maps.rainbow, 0.78, 0.16), (colour_maps.cyclic, 0.75, 0.125)):
        np.testing.assert_allclose(colours(0.0, 0.5), colour_maps.oklch(0.5 * light, 0.5 * chroma, 25.0))
        np.testing.assert_allclose(colours(0.0, [3.0, -2.0, np.nan]), [colours(0.0), np.zeros(3), np.zeros(3)])
    np.testing.assert_allclose(colour_maps.rainbow([np.nan, np.inf], 0.5), [colour_maps.oklch(0.39, 0, 0)] * 2)
    np.testing.assert_allclose(colour_maps.cyclic([np.nan, 2.25, -0.75]), colour_maps.cyclic([0.0, 0.25, 0.25]))
    for kind, colours in (("even", colour_maps.cyclic), ("hsv", matplotlib.colormaps["hsv"])):
        for n in (0, 40, 127, 128, 255):
            wanted = colours(((n + 0.5) / 256 - 0.5) % 1.0)[:3]
            np.testing.assert_allclose(colour_maps.cyclic_map(kind)(n)[:3], wanted, atol=1e-9)
    bar = colour_maps.rainbow_map()
    np.testing.assert_allclose([bar(n)[:3] for n in (0, 85, 255)], colour_maps.rainbow([0, 1 / 3, 1]), atol=1e-9)
    # Where its inverse is none, a percentile is no scale.
    assert colour_maps.symmetric_limit([1e-310] * 99 + [2.0], 50) == 2.0


def test_pictures_of_tensors_with_a_gradient():
    """Each is drawn as the same numbers without one."""
    cube = np.random.default_rng(8).random((1, 5, 2, 3)).astype(np.float32) + 0.1
    turned = torch.tensor(cube[:, 0]).requires_grad_() * (1 + 2j)
    np.testing.assert_array_equal(tt.vis.domain_colors(turned), tt.vis.domain_colors(turned.detach()))
    scan = Scan.grid(WALL, (3, 2), kind="confocal")
    for style in ("curves", "image"):
        tt.vis.transients_grid(Capture(tracked(cube), AXIS, scan), style=style)
    moved = Scan.points(tracked(cube[0, 0]), kind="confocal", sensor_origin=[0.0, 0, 5], laser_origin=[0.0, 0, 5])
    points = tt.vis.scan_layout(moved).axes[0].collections[0]
    np.testing.assert_allclose(np.stack(points._offsets3d, 1), cube[0, 0])
    assert not as_tensor(tracked(cube), "x").requires_grad
    panel = Figure().subplots()
    _draw_histogram(panel, tracked(cube), AXIS, (1, 2))
    np.testing.assert_array_equal(panel.patches[0].get_data().values, cube[0, :, 1, 2])
