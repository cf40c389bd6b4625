"""Curves, peaks and moments behind pictures, number by number, of tensors that have a gradient."""

from __future__ import annotations

import numpy as np
import torch

import torchtransient as tt
from support.cubes import read_gif
from torchtransient.vis import colour_maps
from torchtransient.vis.arrival import _arrival_limits, _fused, _hue
from torchtransient.vis.overview import light_curve, median_pixel, moments_of_arrival, peak_time
from torchtransient.vis.shape_fit import _numbers
from torchtransient.vis.tone_mapping import exposure_of_video, tone_map
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
    assert moments_of_arrival(one, (0.99, 0.999, 1.0)) == [4, 4, 4]
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
