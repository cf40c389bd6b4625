"""Pictures of scans against captures whose light is known: the arrays that matplotlib is given, and the files."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from mpl_toolkits.mplot3d import art3d

import torchtransient as tt
from support.captures import AXIS, WALL, confocal_plane, tilted
from support.cubes import read_gif, read_png
from torchtransient import scenes
from torchtransient.axes import FrequencyAxis
from torchtransient.capture import Capture, Scan
from torchtransient.errors import ArgumentError, ShapeError, StorageError, TorchTransientError, UnitError
from torchtransient.vis.hidden_shapes import hidden_polygons

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


@pytest.mark.slow
def test_curves_stand_where_their_points_do(tmp_path):
    capture, index = tilted()
    figure = tt.vis.transients_grid(capture, tmp_path / "a.png", rows=3, columns=4)
    assert len(figure.axes) == 12
    shown = [int(np.argmax(values)) for values in curves(figure)]
    # columns 2, 6, 10 and 14 of 16 in each row; the light of farther ones comes later
    expected = index[0, [2, 6, 10, 14]].tolist()
    assert shown == expected * 3 and expected == sorted(expected)
    titles = [panel.get_title() for panel in figure.axes]
    assert titles[0] == "(10, 2)" and titles[-1] == "(2, 14)", "the highest row of the wall is on top"
    assert (read_png(tmp_path / "a.png") < 100).any()


def test_curves_hold_the_closed_form():
    capture = confocal_plane()
    (values,) = curves(tt.vis.transients_grid(capture, rows=1, columns=1))
    np.testing.assert_array_equal(values, capture.transient[0, :, 6, 8].numpy())
    cut = tt.vis.transients_grid(capture, rows=1, columns=1, limits=(1.6, 2.0))
    assert len(curves(cut)[0]) == 20 and cut.axes[0].get_xlim() == pytest.approx((1.6, 2.0))


def test_more_panels_than_points_show_every_point_once():
    figure = tt.vis.transients_grid(confocal_plane(size=(3, 2)), rows=9, columns=9)
    assert [panel.get_title() for panel in figure.axes] == [
        f"({row}, {column})" for row in (1, 0) for column in range(3)
    ]


@pytest.mark.slow
def test_lists_are_an_image_of_points_against_time(tmp_path):
    figure = tt.vis.transients_grid(of_list(), tmp_path / "list.png")
    shown = np.asarray(figure.axes[0].images[0].get_array())
    assert shown.shape == (5, AXIS.num_bins)
    for k in range(5):
        assert shown[k].argmax() == 10 * k and shown[k].max() == 3 * (k + 1)
    assert figure.axes[0].images[0].get_extent() == [AXIS.start_opl, AXIS.end_opl, 4.5, -0.5]
    grid = tt.vis.transients_grid(tilted()[0], style="image")
    assert np.asarray(grid.axes[0].images[0].get_array()).shape == (16 * 12, AXIS.num_bins)


def test_a_spot_of_an_exhaustive_capture():
    capture = exhaustive()
    figure = tt.vis.transients_grid(capture, laser=(0, 3), rows=1, columns=1)
    assert int(np.argmax(curves(figure)[0])) == 3 and "spot (0, 3)" in figure.get_suptitle()
    middle = tt.vis.transients_grid(capture, rows=1, columns=1)
    assert int(np.argmax(curves(middle)[0])) == 6 and "spot (1, 2)" in middle.get_suptitle()
    peak = tt.vis.peak_time_map(capture, laser=(2, 0))
    np.testing.assert_allclose(np.asarray(peak.axes[0].images[0].get_array()), 1.85)


def test_peak_times_stand_as_the_wall(tmp_path):
    capture, index = tilted()
    capture.transient[:, :, 0] = 0.0
    figure = tt.vis.peak_time_map(capture, tmp_path / "peak.png")
    shown = np.ma.filled(np.asarray(figure.axes[0].images[0].get_array(), dtype=float), np.nan)
    assert shown.shape == (12, 16)
    assert np.isnan(shown[-1]).all(), "the lowest row is at the bottom"
    np.testing.assert_allclose(shown[0], AXIS.centers_opl[index[-1]].numpy())
    assert read_png(tmp_path / "peak.png").std() > 10


def test_frames_show_one_bin_of_the_wall(tmp_path):
    capture, index = tilted()
    capture.transient[:, :, 0] = 0.0
    shown = tt.vis.wall_frames(capture, exposure=1.0, stamp=False, scale=1)
    assert len(shown) == AXIS.num_bins
    for number in (0, int(index[0, 3]), int(index[0, 12])):
        expected = 255 * capture.transient[0, number].flip(0).numpy()
        np.testing.assert_array_equal(shown[number][..., 0], expected)
    path = tt.vis.wall_video(capture.crop(1.4, 1.6), tmp_path / "wall.gif", fps=10, exposure=1.0, scale=4)
    images, _ = read_gif(path)
    assert len(images) == 10 and images[0].shape[1] == 64
    lit = [image[:48].max() > 128 for image in images]
    assert lit == [bool(part.max() > 0) for part in capture.crop(1.4, 1.6).transient[0]]


def test_polarized_captures_show_their_intensity():
    capture, _ = tilted()
    stokes = torch.stack([capture.transient, 2 * capture.transient, 0 * capture.transient, 0 * capture.transient])
    polarized = Capture(stokes, AXIS, capture.scan, polarized=True)
    assert max(v.max() for v in curves(tt.vis.transients_grid(polarized, rows=2, columns=2))) == 1.0


def test_the_layout_shows_wall_points_and_origins(tmp_path):
    scan = Scan.grid(WALL, (6, 5), kind="exhaustive", laser_grid=3)
    figure = tt.vis.scan_layout(scan, tmp_path / "layout.png", hidden=scenes.nlos_corner())
    (panel,) = figure.axes
    labels = [text.get_text() for text in panel.get_legend().get_texts()]
    assert labels == ["sensor points (30)", "laser spots (9)", "sensor", "laser"]
    np.testing.assert_allclose(np.stack(panel.collections[4]._offsets3d)[:, 0], scan.sensor_points[0, 0])
    assert panel.get_xlim()[0] <= -1 and panel.get_zlim()[1] >= 1.5
    picture = read_png(tmp_path / "layout.png").astype(int)
    blue = (picture[..., 2] > picture[..., 0] + 80).sum()
    red = (picture[..., 0] > picture[..., 2] + 120).sum()
    assert blue > 100 and red > 50


def test_the_layout_of_a_curved_wall_and_of_a_capture():
    x, y = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5))
    vertices = np.stack([x, y, 0.1 * x**2], -1).reshape(-1, 3)
    i = np.arange(20).reshape(4, 5)[:, :4].ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + 6], 1), np.stack([i, i + 6, i + 5], 1)])
    scan = Scan.grid((vertices, faces), 4, kind="confocal", sensor_origin=(0, 0, 1), laser_origin=(0, 0, 1))
    assert len(tt.vis.scan_layout(scan).axes[0].collections) == 4
    single = confocal_plane()
    assert tt.vis.scan_layout(single, title="name").axes[0].get_title() == "name"


VERTICES = np.array([[-0.5, -0.5, 1.0], [0.5, -0.5, 1.0], [0.5, 0.5, 1.5]])
FACES = np.array([[0, 2, 1]])
MESH = scenes.triangle_mesh(VERTICES, FACES)


@pytest.mark.parametrize(
    "hidden",
    [
        SimpleNamespace(vertices=VERTICES, faces=FACES), MESH, (torch.tensor(VERTICES, requires_grad=True), FACES),
        {"white": {"type": "diffuse"}, "a": MESH | {"bsdf": {"type": "ref", "id": "white"}}},
    ],
)  # fmt: skip
def test_the_layout_draws_what_simulations_take(hidden, monkeypatch):
    """However triangles are given, they are drawn where they are."""
    drawn = []

    class Kept(art3d.Poly3DCollection):
        def __init__(self, polygons, **options):
            drawn.append(polygons)
            super().__init__(polygons, **options)

    monkeypatch.setattr(art3d, "Poly3DCollection", Kept)
    panel = tt.vis.scan_layout(confocal_plane(), hidden=hidden).axes[0]
    (found,) = drawn[-1]
    assert isinstance(panel.collections[1], Kept)
    np.testing.assert_allclose(found, VERTICES[[0, 2, 1]])
    assert panel.get_zlim()[1] > 1.5
    tt.nlos.capture_scene(hidden, confocal_plane().scan)


@pytest.mark.parametrize(
    ("shape", "low", "high"),
    [
        ({"type": "sphere", "center": [0.4, 0, 0.8], "radius": 0.2}, [0.2, -0.2, 0.6], [0.6, 0.2, 1.0]),
        ({"type": "disk"}, [-1, -1, 0], [1, 1, 0]),
        ({"type": "cube"}, [-1, -1, -1], [1, 1, 1]),
        ({"type": "cylinder", "p0": [1, 0, 0], "p1": [3, 0, 0], "radius": 0.5}, [1, -0.5, -0.5], [3, 0.5, 0.5]),
    ],
)
def test_round_things_are_as_large_as_they_are(shape, low, high):
    for matrix in (np.eye(4), scenes.transforms.translate([0.0, 0.1, 2.0]) @ scenes.transforms.scale(0.5)):
        (faces,) = hidden_polygons({"ball": shape | {"to_world": matrix}}, "x")
        points = np.concatenate(faces)
        expected = np.array([low, high]) @ matrix[:3, :3].T + matrix[:3, 3]
        np.testing.assert_allclose([points.min(0), points.max(0)], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("hidden", "message"),
    [
        (3, "expected hidden as shapes by name"),
        ("a.obj", "mesh files are not drawn"),
        ({"body": {"type": "obj", "filename": "a.obj"}}, "hidden 'body': shapes that are drawn are .*'obj'"),
        ({"body": 3}, "'body': expected a dictionary"),
        ({"body": {}}, "'body': expected a dictionary"),
        (SimpleNamespace(vertices=VERTICES), "expected hidden as shapes by name"),
        (SimpleNamespace(faces=FACES), "expected hidden as shapes by name"),
        ([VERTICES, FACES, None], "expected hidden as shapes by name"),
        ((VERTICES, [[0, 1, 7]]), "expected faces of whole numbers from 0 to 2"),
        ({"ball": {"type": "sphere", "to_world": 3}}, "'ball': to_world"),
        ({"ball": {"type": "sphere", "radius": "x"}}, "'ball': radius"),
    ],
)
def test_layouts_of_what_is_no_hidden_thing(hidden, message):
    with pytest.raises(TorchTransientError, match=message):
        tt.vis.scan_layout(confocal_plane(), hidden=hidden)


@pytest.mark.parametrize("given", [WALL, None, torch.zeros(3), {}, "scan"])
def test_layouts_of_what_is_no_scan(given):
    with pytest.raises(ShapeError, match="expected a Scan or a Capture"):
        tt.vis.scan_layout(given)


@pytest.mark.parametrize(
    ("draw", "error", "message"),
    [
        (lambda: tt.vis.transients_grid(torch.zeros(1, 2, 3, 4)), ArgumentError, "expected a Capture"),
        (lambda: tt.vis.transients_grid(confocal_plane(), style="lines"), ArgumentError, "'lines'"),
        (lambda: tt.vis.transients_grid(of_list(), style="curves"), ShapeError, "a list of 5"),
        (lambda: tt.vis.transients_grid(confocal_plane(), rows=0), ShapeError, "at least one row"),
        (lambda: tt.vis.transients_grid(confocal_plane(), laser=1), ShapeError, "a confocal one"),
        (lambda: tt.vis.transients_grid(confocal_plane(), limits=(9.0, 10.0)), UnitError, "hold no bin"),
        (lambda: tt.vis.transients_grid(exhaustive(), laser=(3, 0)), ShapeError, "index"),
        (lambda: tt.vis.peak_time_map(of_list()), ShapeError, "a grid of sensor points"),
        (lambda: tt.vis.wall_frames(of_list()), ShapeError, "a grid of sensor points"),
        (lambda: tt.vis.wall_video(confocal_plane(), "no/folder/a.gif"), StorageError, "folder"),
        (lambda: tt.vis.transients_grid(confocal_plane(), "no/folder/a.png"), StorageError, "cannot write"),
    ],
)
def test_what_is_refused(draw, error, message):
    with pytest.raises(error, match=message):
        draw()


def test_batches_and_phasors_are_refused():
    capture = confocal_plane()
    with pytest.raises(ShapeError, match="a batch"):
        tt.vis.transients_grid(Capture.stack([capture, capture]))
    phasor = torch.zeros(1, 1, *capture.scan.shape, dtype=torch.complex64)
    only = Capture(None, None, capture.scan, phasor=phasor, frequencies=FrequencyAxis((1.0,)))
    with pytest.raises(ShapeError, match="phasors alone"):
        tt.vis.peak_time_map(only)
    many = Capture(capture.transient.expand(5, -1, -1, -1), AXIS, capture.scan)
    with pytest.raises(ShapeError, match="one channel or three"):
        tt.vis.transients_grid(many)


WRONG = (
    "x", b"x", True, [], [1], (1, 2, 3, 4), {}, {"a": 1}, float("nan"), float("inf"), -1, 0, 1.5, 2**33, 1j,
    np.zeros((2, 2)), torch.tensor([1.0, 2.0]), ["a", "b", "c"], object(), (1.0, "x"), (None, None),
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("draw", "right", "arguments"),
    [
        (
            tt.vis.transients_grid,
            {"capture": confocal_plane(size=(2, 1))},
            "capture style rows columns laser limits path",
        ),
        (tt.vis.transients_grid, {"capture": exhaustive()}, "laser"),
        (tt.vis.peak_time_map, {"capture": confocal_plane(size=(2, 1))}, "capture laser limits path"),
        (tt.vis.wall_frames, {"capture": confocal_plane(size=(2, 1))}, "capture laser every"),
        (
            tt.vis.wall_video,
            {"capture": confocal_plane(size=(2, 1)).crop(1.5, 1.6), "path": "a.gif"},
            "capture path fps",
        ),
        (tt.vis.scan_layout, {"scan": exhaustive().scan}, "scan path hidden"),
    ],
)
def test_only_errors_of_this_library(tmp_path, monkeypatch, draw, right, arguments):
    """Whatever is handed to a picture of a capture: it is drawn, or a typed error says why not."""
    monkeypatch.chdir(tmp_path)
    for argument in arguments.split():
        refused = 0
        for value in WRONG:
            try:
                draw(**right | {argument: value})
            except TorchTransientError:
                refused += 1
        assert refused >= 10, argument
