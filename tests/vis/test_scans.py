"""Pictures of scans against captures whose light is known: the arrays that matplotlib is given, and the files."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from mpl_toolkits.mplot3d import art3d

import torchtransient as tt
from support.captures import AXIS, WALL, confocal_plane, tilted
from support.cubes import read_png
from support.sweeps import together
from torchtransient import scenes
from torchtransient.errors import ArgumentError, ShapeError, StorageError, TorchTransientError
from torchtransient.nlos import Capture, Scan

ORIGIN = (-0.5, 0.0, 0.25)


def exhaustive(size=(4, 3), bins=10):
    """Spot k of 12 lights bin k % 10 alone, at all points."""
    scan = Scan.grid(WALL, size, kind="exhaustive")
    transient = torch.zeros(1, bins, 12, *scan.sensor_shape)
    for spot in range(12):
        transient[0, spot % bins, spot] = 1.0
    return Capture(transient.reshape(1, bins, *scan.shape), tt.TimeAxis(1.0, 0.1, bins), scan)


def of_list(count=5):
    points = np.stack([np.linspace(-0.8, 0.8, count), np.zeros(count), np.zeros(count)], 1)
    scan = Scan.points(points, kind="confocal", sensor_origin=ORIGIN, laser_origin=ORIGIN)
    transient = torch.zeros(3, AXIS.num_bins, count)
    for k in range(count):
        transient[:, 10 * k, k] = k + 1.0
    return Capture(transient, AXIS, scan)


def curves(figure):
    """The values of the histograms of a figure, panel by panel."""
    return [panel.patches[0].get_data().values for panel in figure.axes]


# --------------------------------------------------------------------------------------------------- transients


def test_curves_stand_where_their_points_do(tmp_path):
    capture, index = tilted()
    figure = tt.vis.transients_grid(capture, tmp_path / "a.png", rows=2, columns=4)
    shown = [int(np.argmax(values)) for values in curves(figure)]
    # columns 2, 6, 10 and 14 of 16 in each row; the light of farther ones comes later
    expected = index[0, [2, 6, 10, 14]].tolist()
    assert shown == expected * 2 and expected == sorted(expected)
    titles = [panel.get_title() for panel in figure.axes]
    assert titles[0] == "(9, 2)" and titles[-1] == "(3, 14)", "the highest row of the wall is on top"
    assert (read_png(tmp_path / "a.png") < 100).any()


def test_curves_hold_the_closed_form():
    capture = confocal_plane()
    (values,) = curves(tt.vis.transients_grid(capture, rows=1, columns=1))
    np.testing.assert_array_equal(values, capture.transient[0, :, 6, 8].numpy())
    cut = tt.vis.transients_grid(capture.crop(1.6, 2.0), rows=1, columns=1)
    assert len(curves(cut)[0]) == 20 and cut.axes[0].get_xlim() == pytest.approx((1.6, 2.0))
    # More panels than points show every point once.
    figure = tt.vis.transients_grid(confocal_plane(size=(3, 2)), rows=9, columns=9)
    titles = [f"({row}, {column})" for row in (1, 0) for column in range(3)]
    assert [panel.get_title() for panel in figure.axes] == titles


def test_lists_are_an_image_of_points_against_time():
    figure = tt.vis.transients_grid(of_list())
    shown = np.asarray(figure.axes[0].images[0].get_array())
    assert shown.shape == (5, AXIS.num_bins)
    for k in range(5):
        assert shown[k].argmax() == 10 * k and shown[k].max() == 3 * (k + 1)
    assert figure.axes[0].images[0].get_extent() == [AXIS.start_opl, AXIS.end_opl, 4.5, -0.5]
    grid = tt.vis.transients_grid(tilted()[0], style="image")
    assert np.asarray(grid.axes[0].images[0].get_array()).shape == (16 * 12, AXIS.num_bins)


def test_a_spot_of_an_exhaustive_capture():
    """The one that is chosen, or the middle one."""
    capture = exhaustive()
    for laser, bin_ in (((0, 3), 3), (None, 6)):
        figure = tt.vis.transients_grid(capture, laser=laser, rows=1, columns=1)
        assert int(np.argmax(curves(figure)[0])) == bin_
    chosen = tt.vis.peak_time_picture(capture.single((2, 0)))
    np.testing.assert_allclose(np.asarray(chosen.axes[0].images[0].get_array()), 1.85)
    np.testing.assert_allclose(np.asarray(tt.vis.peak_time_picture(capture).axes[0].images[0].get_array()), 1.65)


def test_polarized_captures_show_their_intensity():
    capture, _ = tilted()
    stokes = torch.stack([capture.transient, 2 * capture.transient, 0 * capture.transient, 0 * capture.transient])
    polarized = Capture(stokes, AXIS, capture.scan, polarized=True)
    assert max(v.max() for v in curves(tt.vis.transients_grid(polarized, rows=2, columns=2))) == 1.0


# ------------------------------------------------------------------------------------------------------- layout


def layout(scan, **options):
    return tt.vis.scan_layout(scan, **options).axes[0]


def limits(panel):
    return np.array([panel.get_xlim(), panel.get_ylim(), panel.get_zlim()])


def test_the_layout_shows_wall_points_and_origins(tmp_path):
    scan = Scan.grid(WALL, (6, 5), kind="exhaustive", laser_grid=3)
    figure = tt.vis.scan_layout(scan, tmp_path / "layout.png", hidden=scenes.nlos_corner())
    (panel,) = figure.axes
    places = [np.stack(one._offsets3d, 1) for one in panel.collections[-4:]]
    for found, wanted in zip(
        places, (scan.sensor_points, scan.laser_points, scan.sensor_origin, scan.laser_origin), strict=True
    ):
        np.testing.assert_allclose(found, wanted.reshape(-1, 3), rtol=1e-6)
    picture = read_png(tmp_path / "layout.png").astype(int)
    blue = (picture[..., 2] > picture[..., 0] + 80).sum()
    red = (picture[..., 0] > picture[..., 2] + 120).sum()
    assert blue > 100 and red > 50


def test_the_box_of_a_layout_holds_all_of_it():
    """One scale for the three axes, a tenth larger than the scan and the hidden cube."""
    scan = Scan.grid(WALL, (6, 5), kind="exhaustive", sensor_origin=(-0.5, 0, 0.04), laser_origin=(1.5, 0.1, 0.06))
    hidden = {"a": {"type": "cube", "to_world": scenes.transforms.translate([0.0, 0.3, 2.0])}}
    panel = layout(scan, hidden=hidden)
    low, high = np.array([-1, -0.8, 0]), np.array([1.5, 1.3, 3.0])
    middle, size = (low + high) / 2, high - low
    np.testing.assert_allclose(limits(panel), np.stack([middle - 0.55 * size, middle + 0.55 * size], 1), atol=1e-6)
    np.testing.assert_allclose(panel._box_aspect / panel._box_aspect[0], size / size[0])


VERTICES = np.array([[-0.5, -0.5, 1.0], [0.5, -0.5, 1.0], [0.5, 0.5, 1.5]])
FACES = np.array([[0, 2, 1]])
MESH = scenes.triangle_mesh(VERTICES, FACES)


@pytest.fixture
def corners(monkeypatch):
    """Corners (N, 3) of the hidden faces that a layout draws."""
    drawn = []

    class Kept(art3d.Poly3DCollection):
        def __init__(self, polygons, **options):
            drawn.append(polygons)
            super().__init__(polygons, **options)

    monkeypatch.setattr(art3d, "Poly3DCollection", Kept)

    def of(hidden):
        layout(confocal_plane(), hidden=hidden)
        return np.concatenate(drawn[-1])

    return of


@together("hidden", [
    SimpleNamespace(vertices=VERTICES, faces=FACES), MESH, (torch.tensor(VERTICES, requires_grad=True), FACES),
    {"white": {"type": "diffuse"}, "a": MESH | {"bsdf": {"type": "ref", "id": "white"}}},
])  # fmt: skip
def test_the_layout_draws_what_simulations_take(hidden, corners):
    """However triangles are given, they are drawn where they are."""
    np.testing.assert_allclose(corners(hidden), VERTICES[[0, 2, 1]])
    tt.nlos.capture_scene(hidden, confocal_plane().scan)


@together(
    "shape, low, high",
    [
        ({"type": "sphere", "center": [0.4, 0, 0.8], "radius": 0.2}, [0.2, -0.2, 0.6], [0.6, 0.2, 1.0]),
        ({"type": "disk"}, [-1, -1, 0], [1, 1, 0]),
        ({"type": "cube"}, [-1, -1, -1], [1, 1, 1]),
        ({"type": "cylinder"}, [-1, -1, 0], [1, 1, 1]),
        ({"type": "cylinder", "p0": [1, 0, 0], "p1": [3, 0, 0], "radius": 0.5}, [1, -0.5, -0.5], [3, 0.5, 0.5]),
    ],
)
def test_shapes_are_as_large_as_they_are(shape, low, high, corners):
    for matrix in (np.eye(4), scenes.transforms.translate([0.0, 0.1, 2.0]) @ scenes.transforms.scale(0.5)):
        points = corners({"ball": shape | {"to_world": matrix}})
        expected = np.array([low, high]) @ matrix[:3, :3].T + matrix[:3, 3]
        np.testing.assert_allclose([points.min(0), points.max(0)], expected, atol=1e-6)


# ------------------------------------------------------------------------------------------------------ refused


@together("hidden", ["a.obj", {"body": {"type": "obj", "filename": "a.obj"}}, (VERTICES, [[0, 1, 7]])])
def test_layouts_of_what_is_no_hidden_thing(hidden):
    with pytest.raises(TorchTransientError, match="scan_layout: "):
        layout(confocal_plane(), hidden=hidden)


def phasors_alone():
    scan = confocal_plane().scan
    phasor = torch.zeros(1, 1, *scan.shape, dtype=torch.complex64)
    return Capture(None, None, scan, phasor=phasor, frequencies=tt.FrequencyAxis((1.0,)))


@together("draw, error", [
    (lambda v: v.transients_grid(confocal_plane(), style="lines"), ArgumentError),
    (lambda v: v.transients_grid(of_list(), style="curves"), ShapeError),
    (lambda v: v.transients_grid(confocal_plane(), laser=1), ShapeError),
    (lambda v: v.transients_grid(Capture.stack([confocal_plane()] * 2)), ShapeError),
    (lambda v: v.peak_time_picture(phasors_alone()), ShapeError),
    (lambda v: v.peak_time_picture(of_list()), ShapeError),
    (lambda v: v.transients_grid(confocal_plane(), "no/folder/a.png"), StorageError),
])  # fmt: skip
def test_what_is_refused(draw, error):
    with pytest.raises(error):
        draw(tt.vis)
