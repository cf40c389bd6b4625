"""The page of a fit of a hidden shape: what is drawn where, and what is refused."""

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgba

import torchtransient as tt
from torchtransient.capture import Scan, Wall
from torchtransient.errors import SceneError, ShapeError

AXIS = tt.TimeAxis(1.0, 0.01, 300)
FACES = torch.tensor([[0, 1, 2], [0, 2, 3]])


def page(path=None, **changes):
    """A square that is 0.2 m beside its place, before a wall that looks along +x."""
    wall = Wall.plane(width=2.0, height=2.0, center=(1.0, 0.0, 0.0), normal=(1.0, 0.0, 0.0), up=(0.0, 0.0, 1.0))
    truth = torch.tensor([[1.5, -0.1, -0.1], [1.5, 0.1, -0.1], [1.5, 0.1, 0.1], [1.5, -0.1, 0.1]])
    given = {
        "scan": Scan.grid(wall, (6, 3), kind="confocal"),
        "meshes": {"start": truth + torch.tensor([0.0, 0.2, 0.0]), "truth": truth},
        "faces": FACES,
        "transients": {"measured": torch.arange(300.0)[:, None, None].expand(300, 3, 6)},
        "axis": AXIS,
        "losses": [2.0, 1.0],
        "errors": {"position, mm": [200.0, 20.0, 2.0]},
    }
    return tt.vis.plot_shape_fit(**(given | changes), path=path)


@pytest.mark.slow
def test_meshes_stand_before_the_wall_in_both_views(tmp_path):
    figure = page(tmp_path / "fit.png")
    assert (tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")
    front, above = figure.subfigs[0].axes
    for panel, rows in ((front, (-0.1, 0.1)), (above, (0.5, 0.5))):
        lines = {c.get_label(): np.concatenate(c.get_segments()) for c in panel.collections if "Line" in repr(type(c))}
        assert set(lines) == {"start", "truth"}
        # four rims, the diagonal belongs to both triangles
        assert len(lines["truth"]) == 8
        np.testing.assert_allclose([lines["truth"][:, 1].min(), lines["truth"][:, 1].max()], rows, atol=1e-6)
        # u of this wall is up x normal = y
        np.testing.assert_allclose(lines["start"][:, 0].mean() - lines["truth"][:, 0].mean(), 0.2, atol=1e-6)


def test_three_points_of_the_diagonal():
    cube = torch.arange(5 * 3 * 6.0).reshape(5, 3, 6) ** 2
    axis = tt.TimeAxis(1.0, 0.25, 5)
    panels = page(transients={"measured": cube, "start": 2 * cube}, axis=axis).subfigs[1].axes[:3]
    assert [panel.get_title() for panel in panels] == ["point 1, 0", "point 3, 1", "point 5, 2"]
    for panel, (column, row) in zip(panels, ((1, 0), (3, 1), (5, 2)), strict=True):
        for patch, factor, colour in zip(panel.patches, (1, 2), ("0.75", "0.55"), strict=True):
            np.testing.assert_array_equal(patch.get_data().values, factor * cube[:, row, column])
            np.testing.assert_array_equal(patch.get_data().edges, axis.edges_opl)
            assert patch.get_edgecolor() == to_rgba(colour)
        assert panel.get_xlabel() == "optical path length (m)" and panel.get_xlim() == (1, 2.25)
    assert [panel.get_ylabel() for panel in panels] == ["counts", "", ""]
    assert [text.get_text() for text in panels[0].get_legend().texts] == ["measured", "start"]
    # 128 bins are drawn as they are, of 259 a last one that fills no three is left out.
    for bins, drawn in ((128, 128), (129, 64), (259, 86)):
        cube = torch.ones(bins, 3, 6)
        patch = page(transients={"x": cube}, axis=tt.TimeAxis(1.0, 0.01, bins)).subfigs[1].axes[2].patches[0]
        assert len(patch.get_data().values) == drawn and set(patch.get_data().values) == {-(-bins // 128)}
        np.testing.assert_allclose(patch.get_data().edges, 1 + 0.01 * -(-bins // 128) * np.arange(drawn + 1))


def test_the_truth_is_broad_and_behind():
    truth = torch.tensor([[1.5, -0.1, -0.1], [1.5, 0.1, -0.1], [1.5, 0.1, 0.1], [1.5, -0.1, 0.1]])
    figure = page(meshes={"start": truth, "found": 1.01 * truth, "truth": truth - 0.03})
    assert figure.get_size_inches().tolist() == [11, 7.4]
    front, above = figure.subfigs[0].axes
    for panel in (front, above):
        points, *shapes = panel.collections
        assert len(points.get_offsets()) == 18 and points.get_sizes()[0] == 1.5 and panel.get_aspect() == 1
        fills, rims = shapes[::2], shapes[1::2]
        assert [rim.get_label() for rim in rims] == ["truth", "start", "found"]
        assert [rim.get_linewidth()[0] for rim in rims] == [3.5, 1.3, 1.3]
        colours = ("tab:green", "0.55", "tab:blue")
        assert [tuple(rim.get_color()[0]) for rim in rims] == [to_rgba(colour) for colour in colours]
        assert [tuple(fill.get_facecolor()[0]) for fill in fills] == [to_rgba(colour, 0.15) for colour in colours]
        assert panel.get_xlabel() == "along the wall (m)" and [len(fill.get_paths()) for fill in fills] == [2, 2, 2]
    # y and z of the wall's frame, whose origin is (1, 0, 0), and x as the distance from it.
    columns, rows = (np.unique(np.round(part, 5)) for part in np.asarray(front.collections[0].get_offsets()).T)
    np.testing.assert_allclose(columns, np.linspace(-1, 1, 6) * columns[-1], atol=1e-4)
    np.testing.assert_allclose(rows, np.linspace(-1, 1, 3) * rows[-1], atol=1e-4)
    assert not above.collections[0].get_offsets()[:, 1].any()
    lines = np.concatenate(above.collections[2].get_segments())
    np.testing.assert_allclose([lines[:, 0].min(), lines[:, 0].max()], [-0.13, 0.07], atol=1e-6)
    np.testing.assert_allclose(lines[:, 1], 0.47, atol=1e-6)
    assert (front.get_ylabel(), above.get_ylabel()) == ("up (m)", "distance from the wall (m)")
    # What is closed has no rim: all of its edges are drawn.
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    corners = torch.tensor([[1.5, 0.0, 0.0], [1.7, 0.2, 0.0], [1.7, 0.0, 0.3], [1.9, 0.1, 0.1]])
    closed = page(meshes={"a": corners}, faces=faces).subfigs[0].axes[0].collections
    assert len(closed[2].get_segments()) == 6


def test_losses_and_errors():
    panel, twin = page(errors={"a": [3.0, 2.0], "b": [5.0, 4.0, 1.0]}).subfigs[1].axes[3:]
    assert [(line.get_label(), line.get_ydata().tolist(), line.get_color()) for line in panel.lines] == [
        ("a", [3, 2], "C0"), ("b", [5, 4, 1], "C1")
    ]  # fmt: skip
    assert twin.lines[0].get_ydata().tolist() == [2, 1] and twin.lines[0].get_label() == "loss"
    assert panel.get_yscale() == twin.get_yscale() == "log" and panel.get_xlabel() == "step"
    assert [text.get_text() for text in panel.get_legend().texts] == ["a", "b", "loss"]


def test_what_cannot_be_drawn_is_refused():
    with pytest.raises(ShapeError, match=r"losses as a row of numbers"):
        page(losses=[[1.0, 2.0]])
    with pytest.raises(ShapeError, match=r"errors of 'a' as a row of numbers"):
        page(errors={"a": [[1.0]]})
    with pytest.raises(ShapeError, match="got 0 and 2"):
        page(meshes={})
    with pytest.raises(ShapeError, match="a mesh and a step"):
        page(losses=[])
    with pytest.raises(ShapeError, match="'found' as"):
        page(transients={"found": torch.zeros(300, 6, 3)})
    points = Scan.points([[0.0, 0.0, 0.0]], kind="confocal", sensor_origin=[0, 0, 1], laser_origin=[0, 0, 1])
    with pytest.raises(SceneError, match="a grid of sensor points and a wall"):
        page(scan=points)
