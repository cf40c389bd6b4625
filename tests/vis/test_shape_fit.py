"""The page of a fit of a hidden shape: what is drawn where, and what is refused."""

import numpy as np
import pytest
import torch

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


def test_fine_bins_are_added_up():
    panel = page().subfigs[1].axes[0]
    values = panel.patches[0].get_data().values
    # 300 bins are drawn as 100 of three
    np.testing.assert_allclose(values, 9 * np.arange(100) + 3)


def test_what_cannot_be_drawn_is_refused():
    with pytest.raises(ShapeError, match="a mesh and a step"):
        page(losses=[])
    with pytest.raises(ShapeError, match="'found' as"):
        page(transients={"found": torch.zeros(300, 6, 3)})
    points = Scan.points([[0.0, 0.0, 0.0]], kind="confocal", sensor_origin=[0, 0, 1], laser_origin=[0, 0, 1])
    with pytest.raises(SceneError, match="a grid of sensor points and a wall"):
        page(scan=points)
