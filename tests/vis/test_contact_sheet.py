"""Samples beside each other: where each picture and curve stands, on which scale, and what is written."""

from __future__ import annotations

import numpy as np
import pytest

from torchtransient.errors import ShapeError
from torchtransient.vis.contact_sheet import Cell, contact_sheet

RNG = np.random.default_rng(3)
COLOURS, DEPTHS = RNG.random((5, 4, 6, 3)), RNG.random((5, 4, 6)) + 2.0
CURVES = np.array([[4.0, 9.0, 16.0]]) * np.arange(1.0, 6.0)[:, None] ** 2
TIMES = np.array([1.25, 2.0, 2.75, 3.5])


def cells(count=5, curves=True):
    return [
        Cell("abcde"[n], {"light": COLOURS[n], "depth": DEPTHS[n]}, CURVES[n] if curves else None) for n in range(count)
    ]


def test_samples_stand_in_rows_from_the_upper_left():
    figure = contact_sheet(cells(), times=TIMES, title="a sheet")
    # 2.85 x 2.0 inches each, two beside and three below each other, 0.25 for a line below and 0.2 for the title.
    np.testing.assert_allclose(figure.get_size_inches(), [5.7, 6.5])
    shares = np.array([axes.get_position(original=True).bounds for axes in figure.axes])
    placed = (shares * np.tile(figure.get_size_inches(), 2)).reshape(5, 3, 4)
    for number, (light, depth, curve) in enumerate(placed):
        left, low = 2.85 * (number % 2) + 0.05, 0.25 + 2.0 * (2 - number // 2)
        np.testing.assert_allclose(light, [left, low + 0.45, 1.3095, 1.3095], atol=1e-9)
        np.testing.assert_allclose(depth, [left + 1.35, low + 0.45, 1.3095, 1.3095], atol=1e-9)
        np.testing.assert_allclose(curve, [left, low + 0.06, 2.65, 0.33], atol=1e-9)


def test_pictures_are_what_is_given_and_numbers_share_a_scale():
    figure = contact_sheet(cells(curves=False))
    for number in range(5):
        light, depth = (figure.axes[2 * number + place].images[0] for place in (0, 1))
        np.testing.assert_array_equal(light.get_array(), COLOURS[number])
        np.testing.assert_array_equal(depth.get_array(), DEPTHS[number])
        assert depth.get_clim() == (DEPTHS.min(), DEPTHS.max())
        assert depth.get_cmap()(np.nan)[:3] == (0.15, 0.15, 0.15)

    def limits(*images):
        sheet = contact_sheet([Cell("", {"depth": np.array(image)}) for image in images])
        return sheet.axes[0].images[0].get_clim()

    assert limits([[np.inf, 3.0]], [[np.nan, 7.0]]) == (3.0, 7.0)
    assert limits([[np.nan, np.inf]]) == (0.0, 1.0)
    assert limits([[5.0, 5.0]]) == (5.0, 5.0 + 1e-12)


def test_light_over_time_is_drawn_as_its_root():
    figure = contact_sheet(cells(2), times=TIMES)
    for number in (0, 1):
        axes = figure.axes[3 * number + 2]
        steps = axes.patches[0].get_data()
        np.testing.assert_allclose(steps.values, (number + 1) * np.array([2.0, 3.0, 4.0]))
        np.testing.assert_array_equal(steps.edges, TIMES)
        assert axes.get_xlim() == (1.25, 3.5) and axes.get_ylim()[0] == 0
    assert "1.25 m to 3.5 m" in figure.texts[0].get_text()
    below = contact_sheet([Cell("", {"light": COLOURS[0]}, np.array([-4.0, 1.0]))])
    steps = below.axes[1].patches[0].get_data()
    assert steps.values.tolist() == [2, 1] and steps.edges.tolist() == [0, 1, 2] and not below.texts


def test_what_is_no_sheet():
    with pytest.raises(ShapeError):
        contact_sheet([])
