"""Where hidden shapes, scans and fits are drawn, in which colours and sizes, number by number."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgba

import torchtransient as tt
from support.captures import WALL, confocal_plane
from torchtransient.capture import Capture, Scan
from torchtransient.errors import ShapeError
from torchtransient.vis import scans
from torchtransient.vis.hidden_shapes import hidden_polygons

SIDE = np.pi / 32  # half the angle of a side of what is round


def area(faces):
    """Of plane faces, as fans of triangles."""
    parts = [np.cross(face[1:-1] - face[0], face[2:] - face[0]) for face in faces]
    return sum(np.linalg.norm(part, axis=1).sum() for part in parts) / 2


def polygons(shape):
    (faces,) = hidden_polygons(shape, "x")
    return faces


def test_areas_of_shapes():
    """Round things are the polyhedra of 32 sides and 16 rows that stand on them, each face once."""
    assert area(polygons({"type": "rectangle"})) == pytest.approx(4)
    assert area(polygons({"type": "cube"})) == pytest.approx(24)
    assert area(polygons({"type": "disk"})) == pytest.approx(16 * np.sin(2 * SIDE))
    tube = polygons({"type": "cylinder", "p0": [0.1, 0.2, 0.3], "p1": [1.1, -1.8, 2.3], "radius": 0.7})
    assert len(tube) == 32 and area(tube) == pytest.approx(32 * 1.4 * np.sin(SIDE) * 3)
    ball = polygons({"type": "sphere", "center": [0.1, 0.2, 0.3], "radius": 0.5})
    up = np.linspace(0, np.pi, 17)
    height, radius = 0.5 * np.diff(np.cos(up)), 0.5 * np.sin(up)
    slant = np.hypot(np.diff(radius) * np.cos(SIDE), height)
    assert len(ball) == 512 and area(ball) == pytest.approx(32 * np.sin(SIDE) * ((radius[1:] + radius[:-1]) @ slant))
    np.testing.assert_allclose(np.linalg.norm(np.concatenate(ball) - [0.1, 0.2, 0.3], axis=1), 0.5)


def test_a_cylinder_is_round_about_its_axis():
    begin, axis = np.array([0.1, 0.2, 0.3]), np.array([1.0, -2.0, 2.0])
    points = np.concatenate(polygons({"type": "cylinder", "p0": begin, "p1": begin + axis, "radius": 0.7})) - begin
    along = points @ axis / 3
    np.testing.assert_allclose(np.unique(along.round(9)), [0, 3])
    np.testing.assert_allclose(np.linalg.norm(points - np.outer(along, axis / 3), axis=1), 0.7)
    np.testing.assert_array_equal(np.isfinite(np.concatenate(polygons({"type": "cylinder", "p1": [0, 0, 0]}))), True)


def test_shapes_without_options_are_those_of_mitsuba():
    for kind, low, high in (("sphere", [-1, -1, -1], [1, 1, 1]), ("cylinder", [-1, -1, 0], [1, 1, 1])):
        points = np.concatenate(polygons({"type": kind}))
        np.testing.assert_allclose([points.min(0), points.max(0)], [low, high], atol=1e-12)


def test_what_shapes_refer_to_is_not_drawn():
    ball = {"type": "sphere", "bsdf": {"type": "twosided", "inner": {"type": "ref", "id": "white"}}}
    both = hidden_polygons({"type": "scene", "white": {"type": "diffuse"}, "a": ball, "b": {"type": "disk"}}, "x")
    assert [len(faces) for faces in both] == [512, 1] and hidden_polygons(None, "x") == [] == hidden_polygons({}, "x")


def layout(scan, **options):
    return tt.vis.scan_layout(scan, **options).axes[0]


def limits(panel):
    return np.array([panel.get_xlim(), panel.get_ylim(), panel.get_zlim()])


def test_the_box_of_a_layout_is_a_tenth_larger_than_what_is_in_it():
    """One scale for the three axes; what is flat has a twentieth of the greatest extent."""
    origins = {"sensor_origin": (-0.5, 0, 0.04), "laser_origin": (1.5, 0.1, 0.06)}
    scan = Scan.grid(WALL, (6, 5), kind="exhaustive", laser_grid=(3, 2), **origins)
    panel = layout(scan)
    assert panel.figure.get_size_inches().tolist() == [7, 6]
    low, high = np.array([-1, -0.8, 0]), np.array([1.5, 0.8, 0.06])
    size = np.array([2.5, 1.6, 0.125])
    middle = (low + high) / 2
    np.testing.assert_allclose(limits(panel), np.stack([middle - 0.55 * size, middle + 0.55 * size], 1), atol=1e-12)
    np.testing.assert_allclose(panel._box_aspect / panel._box_aspect[0], size / size[0])
    deep = layout(scan, hidden={"a": {"type": "cube", "to_world": tt.scenes.transforms.translate([0.0, 0.3, 2.0])}})
    np.testing.assert_allclose(limits(deep)[1:], [[0.25 - 0.55 * 2.1, 0.25 + 0.55 * 2.1], [1.5 - 1.65, 1.5 + 1.65]])
    assert (panel.get_xlabel(), panel.get_ylabel(), panel.get_zlabel()) == ("x (m)", "y (m)", "z (m)")
    assert (panel.elev, panel.azim, panel._vertical_axis) == (20, -60, 1) and panel.get_title() == repr(scan)
    # From the origin of the laser to the spot in the middle of the list.
    np.testing.assert_allclose(
        np.array(panel.lines[0].get_data_3d()).T, [[1.5, 0.1, 0.06], scan.laser_points.reshape(-1, 3)[3].tolist()],
        rtol=1e-6,
    )  # fmt: skip
    places = [np.stack(one._offsets3d, 1) for one in panel.collections[1:]]
    for found, wanted in zip(
        places, (scan.sensor_points, scan.laser_points, scan.sensor_origin, scan.laser_origin), strict=True
    ):
        np.testing.assert_allclose(found, wanted.reshape(-1, 3), rtol=1e-6)
    assert [one.get_sizes()[0] for one in panel.collections[1:]] == [8, 26, 60, 60]


def test_a_layout_of_one_place_has_a_box():
    scan = Scan.points([[0.2, 0.3, 0.4]], kind="confocal", sensor_origin=[0.2, 0.3, 0.4], laser_origin=[0.2, 0.3, 0.4])
    panel = layout(scan, title="one")
    np.testing.assert_allclose(limits(panel), [[c - 0.0275, c + 0.0275] for c in (0.2, 0.3, 0.4)], rtol=1e-5)
    assert panel.get_title() == "one" and len(panel.collections) == 3
    labels = [text.get_text() for text in panel.get_legend().get_texts()]
    assert labels == ["sensor points (confocal)", "sensor", "laser"]


def test_only_coarse_meshes_have_edges():
    def faces(count):
        vertices = np.stack([np.arange(count + 2.0), np.arange(count + 2) % 2, np.ones(count + 2)], 1)
        mesh = vertices, np.arange(count)[:, None] + np.arange(3)
        return layout(confocal_plane(size=(2, 3)), hidden=mesh).collections[1]

    assert len(faces(64).get_edgecolor()) and not len(faces(65).get_edgecolor())
    assert tuple(faces(2).get_facecolor()[0]) == to_rgba("tab:orange", 0.25)


def test_places_in_the_middles_of_equal_parts():
    assert scans._chosen(5, 2) == [1, 3] and scans._chosen(7, 3) == [1, 3, 5] and scans._chosen(3, 9) == [0, 1, 2]
    assert scans._chosen(10, 4) == [1, 3, 6, 8]


def test_curves_of_three_channels():
    one = confocal_plane(size=(3, 2))
    coloured = Capture(torch.cat([one.transient, 2 * one.transient, 3 * one.transient]), one.axis, one.scan)
    panel = tt.vis.transients_grid(coloured, rows=1, columns=2).axes[1]
    assert panel.get_title() == "(1, 2)"
    for patch, colour, factor in zip(panel.patches, ("tab:red", "tab:green", "tab:blue"), (1, 2, 3), strict=True):
        assert patch.get_edgecolor() == to_rgba(colour)
        np.testing.assert_array_equal(patch.get_data().values, factor * one.transient[0, :, 1, 2])
        np.testing.assert_array_equal(patch.get_data().edges, one.axis.edges_opl)
    dark = tt.vis.transients_grid(Capture(0 * one.transient, one.axis, one.scan), style="image").axes[0]
    assert dark.images[0].get_clim() == (0, 1)
    broken = one.transient.clone()
    broken[0, 5, 1, 1], broken[0, 6, 1, 1], broken[0, 7, 0, 0] = np.inf, np.nan, 9.0
    image = tt.vis.transients_grid(Capture(broken, one.axis, one.scan), style="image").axes
    assert image[0].images[0].get_clim() == (0, 9) and image[1].get_ylabel() == "radiance in a bin"
    with pytest.raises(ShapeError, match="at least one row and column, got 2 and 0"):
        tt.vis.transients_grid(one, rows=2, columns=0)
