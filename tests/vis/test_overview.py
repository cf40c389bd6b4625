"""What the overview picture shows, against cubes whose answer is known."""

from __future__ import annotations

import pytest
import torch

from support.marks import long
from torchtransient.axes import TimeAxis
from torchtransient.errors import ShapeError, StorageError, UnitError
from torchtransient.vis.overview import light_curve, median_pixel, moments_of_arrival, peak_time, plot_overview
from torchtransient.vis.tone_mapping import exposure_of, tone_map

AXIS = TimeAxis(2.0, 0.5, 10)


def pulse(channels=3, height=40, width=7):
    """Every pixel sees one pulse in bin (row mod 10), pixel (17, 3) another of five in bin 7, and row 39 is dark."""
    cube = torch.zeros(height, width, 10, channels)
    for row in range(height - 1):
        cube[row, :, row % 10] = 1.0
    cube[17, 3, 7] = 5.0
    return cube.movedim((-1, -2), (0, 1))


@pytest.mark.parametrize("channels", [1, 3])
def test_peak_time(channels):
    peaks = peak_time(pulse(channels), AXIS)
    assert peaks.shape == (40, 7)
    expected = AXIS.centers_opl[torch.arange(39) % 10]
    assert torch.equal(peaks[:39, 0], expected)
    assert torch.isnan(peaks[39]).all()


def test_peak_counts_all_channels():
    cube = torch.zeros(3, 10, 1, 1)
    cube[0, 2] = 1.0
    cube[:, 6] = 0.5
    assert peak_time(cube, AXIS).item() == AXIS.centers_opl[6].item()


def test_light_curve_counts_every_pixel_that_sees_light_alike():
    cube = torch.zeros(3, 10, 40, 7)
    cube[:, 2, :20] = 1.0
    cube[0, 8, 20:] = 1e6  # twenty rows of lamp
    cube[:, :, 30:] = 0.0  # ten of them dark
    curve = light_curve(cube)
    expected = torch.zeros(10, dtype=torch.float64)
    expected[2], expected[8] = 2 / 3, 1 / 3
    torch.testing.assert_close(curve, expected)
    assert light_curve(torch.zeros(1, 10, 2, 2)).tolist() == [0.0] * 10


def test_median_pixel_is_neither_lamp_nor_darkness():
    steady = torch.zeros(3, 6, 5)
    steady[:, 1:4, 2] = torch.tensor([100.0, 1.0, 0.5])
    assert median_pixel(steady) == (2, 2)
    assert median_pixel(torch.zeros(1, 4, 4)) == (1, 3)
    with pytest.raises(ShapeError, match="steady image"):
        median_pixel(torch.zeros(4, 4))


def test_moments_of_arrival():
    cube = torch.zeros(1, 100, 2, 2)
    cube[:, 20:80] = 1.0
    assert moments_of_arrival(cube) == [25, 49, 73]
    flash = torch.zeros(1, 100, 2, 2)
    flash[:, 98] = 1.0
    assert moments_of_arrival(flash) == [98, 99, 99]
    assert moments_of_arrival(torch.zeros(1, 11, 2, 2)) == [1, 5, 9]


def test_srgb_curve():
    linear = torch.tensor([0.0, 0.0031308, 0.2140411, 1.0]).reshape(1, 2, 2)
    shown = tone_map(linear, exposure=1.0)
    assert shown.shape == (2, 2, 3)
    expected = torch.tensor([0.0, 0.04045, 0.5, 1.0], dtype=torch.float64)
    torch.testing.assert_close(shown.reshape(4, 3), expected[:, None].expand(4, 3), rtol=0, atol=2e-6)


def test_exposure_ignores_outliers_and_broken_pixels():
    image = torch.full((1, 100, 100), 0.5)
    image[0, 0, 0] = 1e6
    image[0, 0, 1] = torch.nan
    assert exposure_of(image) == 2.0
    assert tone_map(image)[0, 1].tolist() == [1.0, 0.0, 1.0]
    assert exposure_of(torch.zeros(3, 4, 4)) == 1.0
    spot = torch.zeros(1, 100, 100)
    spot[0, 3, 3] = 0.25
    assert exposure_of(spot) == 4.0


@pytest.mark.slow
@pytest.mark.parametrize("channels", long([1, 3], [3]))
def test_picture(tmp_path, channels):
    cube = pulse(channels)
    path = tmp_path / "overview.png"
    shown = plot_overview(cube, cube.sum(1), AXIS, path=path, title="pulse")
    assert shown.pixel == (19, 4)  # the 137th of 273 equal pixels, the brighter one being last
    assert len(shown.frames) == 3
    content = path.read_bytes()
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    assert len(content) > 10_000


def test_refused(tmp_path):
    cube = pulse()
    with pytest.raises(ShapeError, match=r"\(C, T, H, W\)"):
        peak_time(cube[None], AXIS)
    with pytest.raises(ShapeError, match="T = 9"):
        peak_time(cube, TimeAxis(0, 1, 9))
    with pytest.raises(ShapeError, match="steady of shape"):
        plot_overview(cube, cube, AXIS, path=tmp_path / "a.png")
    with pytest.raises(ShapeError, match="outside"):
        plot_overview(cube, cube.sum(1), AXIS, path=tmp_path / "a.png", pixel=(40, 0))
    with pytest.raises(StorageError, match="cannot write"):
        plot_overview(cube, cube.sum(1), AXIS, path=tmp_path / "missing" / "a.png")
    with pytest.raises(StorageError, match="cannot write"):
        plot_overview(cube, cube.sum(1), AXIS, path=tmp_path / "a.docx")
    with pytest.raises(ShapeError, match="image"):
        tone_map(torch.zeros(4, 2, 2))
    with pytest.raises(UnitError, match="quantile"):
        exposure_of(torch.zeros(1, 2, 2), quantile=0)
