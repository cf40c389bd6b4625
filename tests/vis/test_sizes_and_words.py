"""How large pictures are on paper, what is written on them and when, and on which scales they are drawn."""

from __future__ import annotations

import unittest

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw, ImageFont

import torchtransient as tt
from support.number_case import capture
from torchtransient.vis import files, overview, stamps
from torchtransient.vis.slices import _to_metres, _to_nanoseconds
from torchtransient.vis.tone_mapping import exposure_of, tone_map

AXIS = tt.TimeAxis(1.5, 0.25, 7)
CUBE = 0.1 + torch.rand(3, 7, 2, 5, generator=torch.Generator().manual_seed(4))
NS = 0.299792458  # metres of a nanosecond


def words(panel):
    return panel.get_title(), panel.get_xlabel(), panel.get_ylabel()


def size(figure):
    return pytest.approx(tuple(figure.get_size_inches()))


@pytest.fixture
def kept(monkeypatch):
    """The figures that functions of a module write, which they do not return."""

    def keep(module):
        figures = []
        monkeypatch.setattr(module, "save_figure", lambda figure, *_, **__: figures.append(figure))
        return figures

    return keep


def test_panels_share_rows_evenly():
    for arguments, expected, panels in (
        ((3, 6, 5, 2.0, 4), (6.9, 2.54), 6),
        ((1, 100, 1, 2.0, 4), (2.3, 0.81), 1),
        ((100, 1, 2, 2.0, 4), (4.6, 7.71), 2),
        ((6, 3, 4, 1.0, 4), (4.6, 2.19), 4),
    ):
        figure, axes = files.picture_figure(*arguments)
        assert size(figure) == expected and len(axes) == panels and not any(axis.axison for axis in axes)


def test_an_overview(kept):
    figures = kept(overview)
    told = tt.vis.plot_overview(CUBE, CUBE.sum(1), AXIS, path="x.png", pixel=(1, 3), title="a room")
    (figure,) = figures
    steady, peaks, curve = figure.subfigs[0].axes[:3]
    assert size(figure) == (12, 7.4) and figure.get_suptitle() == "a room" and told.pixel == (1, 3)
    np.testing.assert_allclose(steady.images[0].get_array(), tone_map(CUBE.sum(1)))
    assert (list(steady.lines[0].get_xdata()), list(steady.lines[0].get_ydata())) == ([3], [1])
    np.testing.assert_array_equal(peaks.images[0].get_array(), tt.vis.peak_time(CUBE, AXIS))
    assert words(curve) == ("pixel at row 1, column 3", "optical path length (m)", "radiance in a bin")
    for channel, (patch, colour) in enumerate(zip(curve.patches, ("tab:red", "tab:green", "tab:blue"), strict=True)):
        np.testing.assert_array_equal(patch.get_data().values, CUBE[channel, :, 1, 3])
        np.testing.assert_array_equal(patch.get_data().edges, AXIS.edges_opl)
        assert patch.get_edgecolor() == pytest.approx(tt_colour(colour))
    for panel, index in zip(figure.subfigs[1].axes, told.frames, strict=True):
        opl = 1.5 + 0.25 * (index + 0.5)
        assert panel.get_title() == f"{opl:.3f} m = {opl / NS:.3f} ns (bin {index})"
        np.testing.assert_allclose(panel.images[0].get_array(), tone_map(CUBE[:, index]))
    tt.vis.plot_overview(CUBE[:1], CUBE[:1].sum(1), AXIS, path="x.png")
    grey = figures[1].subfigs[0].axes[2].patches
    assert len(grey) == 1 and grey[0].get_edgecolor() == (0, 0, 0, 1) and not figures[1].get_suptitle()


def tt_colour(name):
    from matplotlib.colors import to_rgba

    return to_rgba(name)


def test_a_streak():
    figure = tt.vis.streak(CUBE, axis=AXIS)
    panel = figure.axes[0]
    assert size(figure) == (6.2, 5.2) and panel.images[0].get_extent() == [-0.5, 4.5, 3.25, 1.5]
    assert words(panel) == ("light along row 1, logarithmic", "column of the image", "optical path length (m)")
    assert panel.child_axes[0].get_ylabel() == "time (ns)"
    line = CUBE[:, :, 1]
    np.testing.assert_allclose(panel.images[0].get_array(), tone_map(line, exposure_of(line, 0.999), "log"))
    other = tt.vis.streak(CUBE, column=-2, curve="linear", exposure=0.5).axes[0]
    assert words(other) == ("light along column 3", "row of the image", "bin") and not other.child_axes
    assert other.images[0].get_extent() == [-0.5, 1.5, 7.0, 0.0]
    np.testing.assert_allclose(other.images[0].get_array(), tone_map(CUBE[:, :, :, 3], 0.5, "linear"))
    np.testing.assert_allclose(_to_nanoseconds([NS, 3.0]), [1, 3 / NS])
    np.testing.assert_allclose(_to_metres([1.0, 2.0]), [NS, 2 * NS])


def test_histograms():
    cube = CUBE.clone()
    cube[1, 2, 1, 4] = 0.0
    figure = tt.vis.histogram(cube, pixels=[(1, 4), (0, 2)], axis=AXIS, log=True, title="pixels")
    first, last = figure.axes[:2]
    assert size(figure) == (7, 4.7) and figure.get_suptitle() == "pixels"
    assert first.get_title(loc="left") == "row 1, column 4" and last.get_title(loc="left") == "row 0, column 2"
    assert first.get_ylabel() == "radiance in a bin" and last.get_xlabel() == "optical path length (m)"
    assert not first.get_xlabel() and first.child_axes[0].get_xlabel() == "time (ns)" and not last.child_axes
    # Nothing is a gap, where the scale has no zero.
    drawn = first.patches[1].get_data()
    np.testing.assert_array_equal(np.isnan(drawn.values), np.arange(7) == 2)
    assert drawn.baseline is None
    assert tt.vis.histogram(cube, pixels=[(1, 4)]).axes[0].patches[1].get_data().baseline == 0
    plain = tt.vis.histogram(cube[:2], pixels=[(0, 0)])
    assert plain.axes[0].patches[0].get_data().edges.tolist() == list(range(8))
    assert plain.axes[0].get_xlabel() == "bin" and not plain.get_suptitle() and not plain.axes[0].child_axes
    colours = [patch.get_edgecolor() for patch in plain.axes[0].patches]
    assert colours[0] == pytest.approx((0.267, 0.005, 0.329, 1), abs=1e-3) and colours[1][0] > 0.7


def test_a_sheet_of_moments():
    figure = tt.vis.frame_grid(CUBE, axis=AXIS, bins=(0, 6, 3), columns=2, title="moments")
    assert size(figure) == (5.52, 2 * (2.4 * 0.4 * 0.92 + 0.35)) and figure.get_suptitle() == "moments"
    assert [panel.get_title() for panel in figure.axes] == [
        "1.6 m = 5.4 ns", "3.1 m = 10.4 ns", "2.4 m = 7.9 ns", ""
    ]  # fmt: skip
    np.testing.assert_allclose(figure.axes[1].images[0].get_array(), tone_map(CUBE[:, 6]))
    assert tt.vis.frame_grid(CUBE, bins=[5]).axes[0].get_title() == "bin 5 of 7"


def test_times_of_peaks():
    figure = tt.vis.peak_time_picture(CUBE, axis=AXIS)
    panel, bar, twin = figure.axes
    peaks = np.asarray(tt.vis.peak_time(CUBE, AXIS))
    low, high = np.percentile(peaks, [1, 99])
    assert panel.images[0].get_clim() == pytest.approx((low, high)) and size(figure) == (5.75, 5 * 0.4 * 0.92 + 0.35)
    assert panel.get_title() == "arrival of the peak" and bar.get_ylabel() == "optical path length (m)"
    assert twin.get_ylabel() == "time (ns)" and twin.get_ylim() == pytest.approx((low / NS, high / NS))
    assert tt.vis.peak_time_picture(CUBE, axis=AXIS, title="t", limits=(1, 9)).axes[0].images[0].get_clim() == (1, 9)
    one = torch.zeros(1, 7, 2, 5)
    one[:, 2] = 1.0
    # At least a bin wide; all of the axis without light.
    assert tt.vis.peak_time_picture(one, axis=AXIS).axes[0].images[0].get_clim() == (2.125, 2.375)
    assert tt.vis.peak_time_picture(0 * one, axis=AXIS).axes[0].images[0].get_clim() == (1.5, 3.25)


def test_gradients():
    values = torch.tensor([[[1.0, -2.0]], [[3.0, 5.0]]])
    figure = tt.vis.gradient_picture(values, title="g", label="per metre", percentile=100)
    assert np.asarray(figure.axes[0].images[0].get_array()).tolist() == [[4.0, 3.0]]
    assert figure.axes[0].images[0].get_clim() == (-4, 4) and figure.axes[0].get_title() == "g"
    assert figure.axes[1].get_ylabel() == "per metre" and not figure.get_suptitle()
    assert size(figure) == (4.4 * 1.15, 4.4 * 0.5 * 0.92 + 0.35)
    assert figure.axes[0].images[0].colorbar.extend == "neither"
    apart = tt.vis.gradient_picture(values, title="g", limit=4.5, per_channel=True)
    assert [panel.get_title() for panel in apart.axes[:2]] == ["channel 0", "channel 1"] and apart.get_suptitle() == "g"
    assert apart.axes[1].images[0].colorbar.extend == "both"
    three = tt.vis.gradient_picture(values[[0, 1, 0]], limit=5.0, per_channel=True)
    assert [panel.get_title() for panel in three.axes[:3]] == ["red", "green", "blue"] and not three.get_suptitle()
    assert three.axes[2].images[0].colorbar.extend == "neither"


def test_captures():
    many = tt.vis.transients_grid(capture("exhaustive"), rows=2, columns=3)
    assert size(many) == (6.7, 3.4) and many.get_suptitle() == "exhaustive scan, spot (2, 1)"
    assert many.get_supxlabel() == "optical path length (m)" and many.get_supylabel() == "radiance in a bin"
    assert [panel.get_title() for panel in many.axes] == ["(3, 0)", "(3, 2)", "(3, 3)", "(1, 0)", "(1, 2)", "(1, 3)"]
    image = tt.vis.transients_grid(capture(), style="image", title="wall")
    panel = image.axes[0]
    light = capture().transient.sum(0).flatten(1).T
    assert size(image) == (8, 4.5) and image.get_suptitle() == "wall"
    assert panel.images[0].get_extent() == [2.0, 8.4, 15.5, -0.5]
    assert panel.images[0].get_clim() == (0, float(light.max()))
    assert words(panel)[1:] == ("optical path length (m)", "sensor point, row by row")
    assert tt.vis.transients_grid(capture("exhaustive"), laser=(1, 0)).get_suptitle() == "exhaustive scan, spot (1, 0)"
    assert tt.vis.peak_time_map(capture()).axes[0].get_title() == "confocal scan"


def test_stamps():
    assert stamps.moment(AXIS, 2, 7) == "2.1 m   7.1 ns" and stamps.moment(None, 2, 7, "gate") == "gate 2 of 7"
    assert stamps.moment(tt.TimeAxis(0.0, 0.003, 4), 2, 4) == "0.007 m   0.025 ns"
    # Halves of a bin are 0.05 m and 0.167 ns: two digits, and one.
    assert stamps.moment(tt.TimeAxis(0.0, 0.1, 4), 2, 4) == "0.25 m   0.8 ns"
    assert stamps.moment(tt.TimeAxis(0.0, 50.0, 4), 1, 4) == "75 m   250 ns"
    assert stamps.moment(tt.TimeAxis(0.0, 1e-7, 4), 1, 4) == "0.000000 m   0.000001 ns"


def test_strips():
    """Under the picture, with a bar as long as its share of the width; text that does not fit is made smaller."""
    for height, width, rows in ((30, 50, 16), (400, 100, 30), (100, 400, 30)):
        image = np.full((height, width, 3), 7, np.uint8)
        found = stamps.with_strip(image, "", 0.3)
        assert found.shape == (height + rows, width, 3) and (found[:height] == 7).all()
        bar = max(2, rows // 9)
        lit = (found[height : height + bar] == stamps.INK).all(-1)
        assert lit[:, : round(0.3 * width)].all() and not lit[:, round(0.3 * width) :].any()
        assert (found[height : height + bar][~lit] == stamps.DIM).all()
        assert (found[height + bar :] == stamps.GROUND).all()
        assert (stamps.with_strip(image, "")[height:] == stamps.GROUND).all()
        for share, columns in ((0.5 / width, 0), (0.6 / width, 1), (1 / width, 1), (1.0, width)):
            drawn = (stamps.with_strip(image, "", share) == stamps.INK).all(-1)
            assert drawn[height : height + bar, :columns].all() and drawn.sum() == bar * columns
    long = stamps.with_strip(np.zeros((40, 300, 3), np.uint8), "many words " * 4)[40:]
    written = np.nonzero((long != stamps.GROUND).any((0, 2)))[0]
    assert written.min() >= 5 and written.max() < 295


def test_letters_of_a_strip():
    """As high as the strip has room for, in its middle, from a quarter of its height; not below six pixels."""
    found = stamps.with_strip(np.zeros((100, 400, 3), np.uint8), "H", None)[100:]
    rows, columns = np.nonzero((found != stamps.GROUND).any(-1))
    assert 11 <= np.ptp(rows) + 1 <= 14 and abs((rows.min() + rows.max()) / 2 - 16.5) <= 1.5
    assert 7 <= columns.min() <= 10
    draw = ImageDraw.Draw(Image.new("RGB", (9, 9)))
    text = "some words"
    length = draw.textlength(text, ImageFont.load_default(20.0))
    for room, size_ in ((length, 20.0), (length - 0.5, 18.0), (1.0, 20 * 0.9**12)):
        assert stamps._font(draw, text, 20.0, room).size == pytest.approx(size_)
    assert stamps._font(draw, text, 6.0, 1.0).size == 6


def test_endings_and_scales(tmp_path):
    """A figure without an ending is a PNG; images are what their endings say, in capitals, too."""
    figure = tt.vis.streak(CUBE, tmp_path / "streak")
    assert size(figure) == (6.2, 5.2) and (tmp_path / "streak.png").read_bytes()[:4] == b"\x89PNG"
    assert [path.name for path in tmp_path.iterdir()] == ["streak.png"]
    image = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    for name, kind in (("a.PNG", "PNG"), ("b.jpg", "JPEG"), ("c.jpeg", "JPEG")):
        assert files.save_image(image, tmp_path / name, "x") is image
        assert Image.open(tmp_path / name).format == kind
    large = files.enlarge(image, 4)
    assert large.shape == (8, 12, 3) and (files.enlarge(image, 1) == image).all()
    for row, column in ((0, 0), (3, 4), (7, 11), (4, 3)):
        assert large[row, column].tolist() == image[row // 4, column // 4].tolist()


@pytest.mark.slow
def test_volumes():
    values = torch.rand(2, 3, 4, generator=torch.Generator().manual_seed(5)) + 0.1
    depth = torch.arange(12.0).reshape(3, 4)
    figure = tt.vis.volume_views(values, depths=[0.5, 0.7], extent=(2.0, 1.5), depth=depth, title="hidden")
    front, top, side, map_, bar = figure.axes
    assert size(figure) == (3.4 * 4 + 0.6, 4.0) and figure.get_suptitle() == "hidden"
    assert [words(panel) for panel in (front, top, side, map_)] == [
        ("front", "x (m)", "y (m)"), ("top", "x (m)", "depth (m)"), ("side", "depth (m)", "y (m)"),
        ("depth", "x (m)", "y (m)"),
    ]  # fmt: skip
    np.testing.assert_allclose(front.images[0].get_array(), values.amax(0) / values.max(), rtol=1e-6)
    np.testing.assert_allclose(top.images[0].get_array(), values.amax(1) / values.max(), rtol=1e-6)
    np.testing.assert_allclose(side.images[0].get_array(), values.amax(2).T / values.max(), rtol=1e-6)
    assert front.get_aspect() == 1 and top.get_aspect() == side.get_aspect() == "auto"
    assert map_.images[0].get_extent() == [-1, 1, -0.75, 0.75] and bar.get_ylabel() == "depth (m)"
    bare = tt.vis.volume_views(values)
    assert words(bare.axes[1]) == ("top", "x (voxels)", "depth (voxels)") and not bare.get_suptitle()
    assert bare.axes[1].images[0].get_extent() == [-2, 2, -0.5, 1.5] and size(bare) == (3.4 * 3 + 0.6, 4.0)
    # One plane is a metre thick.
    assert tt.vis.volume_views(values[:1], depths=[3.0]).axes[1].images[0].get_extent() == [-2, 2, 2.5, 3.5]


def test_maps_of_a_surface():
    depth = torch.arange(12.0).reshape(3, 4)
    seen = depth > 4
    volume = torch.rand(2, 3, 4)
    figure = tt.vis.volume_views(volume, depth=depth, mask=seen, extent=(2.0, 1.5))
    assert words(figure.axes[3]) == ("depth", "x (m)", "y (m)") and len(figure.axes) == 5
    drawn = np.ma.filled(figure.axes[3].images[0].get_array(), np.nan)
    np.testing.assert_array_equal(drawn, torch.where(seen, depth, torch.nan))
    assert len(tt.vis.volume_views(volume, depth=depth, mask=torch.zeros(3, 4)).axes) == 4  # nothing has no scale
    normals = torch.stack([depth / 11, -depth / 11, torch.full((3, 4), 3.0)])
    with unittest.TestCase().assertNoLogs("matplotlib"):  # which says so where colours lie outside
        panel = tt.vis.volume_views(volume, normals=normals, mask=seen).axes[3]
    expected = ((normals + 1) / 2).clamp(0, 1).permute(1, 2, 0)
    expected[~seen] = 0.85
    np.testing.assert_allclose(panel.images[0].get_array(), expected, rtol=1e-6)
    assert panel.images[0].get_extent() == [-2, 2, -1.5, 1.5]
    assert words(panel) == ("normals", "x (voxels)", "y (voxels)")


@pytest.mark.parametrize("off, even", [(0.9e-3, True), (1.1e-3, False)])
def test_planes_are_even_to_a_thousandth(off, even):
    from torchtransient.vis.volumes import _even

    edges = torch.tensor([0.0, 1.0 + off, 2.0, 3.0], dtype=torch.float64)
    assert _even(edges) == even and _even(5 * edges) == even
    assert _even(torch.tensor([0.0, 1.0 - off, 2.0, 3.0], dtype=torch.float64)) == even


def test_polarization():
    vectors = torch.tensor([[4.0, 0.03, 8.0], [2.0, 0.0, 0.0], [0.0, 0.01, -6.0], [-1.0, 0.0, 2.0]]).reshape(4, 1, 1, 3)
    figure = tt.vis.polarization_picture(vectors, quantities=("aolp", "docp", "s2"), title="light")
    angle, circular, component, *bars = figure.axes
    assert [panel.get_title() for panel in (angle, circular, component)] == [
        "angle of linear polarization", "degree of circular polarization", "$S_2$"
    ]  # fmt: skip
    assert size(figure) == (3 * 3.4 * 1.15, 3.4 * (1 / 3) * 0.92 + 0.35) and figure.get_suptitle() == "light"
    assert list(bars[0].get_yticks()) == [-90, -45, 0, 45, 90] and bars[0].get_ylim() == (-90, 90)
    # A hundredth of the median of what is lit, 0.04, is dark: 0.03 is.
    np.testing.assert_array_equal(np.ma.getmaskarray(circular.images[0].get_array()), [[False, True, False]])
    np.testing.assert_allclose(np.ma.compressed(circular.images[0].get_array()), [-0.25, 0.25])
    limit = np.percentile([0, 0.01, 6], 99)
    assert component.images[0].get_clim() == pytest.approx((-limit, limit))
    low = tt.vis.polarization_picture(vectors, quantities=("docp",), floor=0.02)
    assert not np.ma.getmaskarray(low.axes[0].images[0].get_array()).any() and not low.get_suptitle()
    at = tt.vis.polarization_picture(vectors, quantities=("dolp",), floor=4.0).axes[0].images[0].get_array()
    np.testing.assert_array_equal(np.ma.getmaskarray(at), [[True, True, False]])


def test_phasors():
    phasor = torch.tensor([[[3.0 + 4.0j, 1e-5j, -2.0]], [[1.0, 2.0j, 0.0]]]).reshape(1, 2, 1, 3)
    figure = tt.vis.phasor_picture(
        phasor, show=("real", "imaginary", "amplitude", "phase"), which=(0, 1), percentile=100, title="wave"
    )
    panels = figure.axes[:8]
    assert size(figure) == (4 * 3.6 * 1.15, 2 * (3.6 * (1 / 3) * 0.92 + 0.35)) and figure.get_suptitle() == "wave"
    assert [panel.get_title() for panel in panels[::4]] == ["real, frequency 0", "real, frequency 1"]
    drawn = [panel.images[0] for panel in panels]
    for image, wanted, limits in (
        (drawn[0], [3, 0, -2], (-3, 3)), (drawn[1], [4, 1e-5, 0], (-4, 4)), (drawn[2], [5, 1e-5, 2], (0, 5)),
        (drawn[6], [1, 2, 0], (0, 2)),
    ):  # fmt: skip
        np.testing.assert_allclose(np.asarray(image.get_array()).ravel(), wanted, atol=1e-6)
        assert image.get_clim() == pytest.approx(limits)
    grey = np.ptp(np.asarray(drawn[3].get_array())[0], axis=-1) < 1e-9
    assert grey.tolist() == [False, True, False]  # what is as good as dark has no phase
    bar = figure.axes[-1]
    assert list(bar.get_yticks()) == [-1, -0.5, 0, 0.5, 1] and bar.get_ylabel() == "phase"
