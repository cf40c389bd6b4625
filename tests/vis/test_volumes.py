"""Pictures of volumes: what they show stands where it is, and what cannot be drawn is a typed error."""

import numpy as np
import pytest
import torch

from support.sweeps import together
from torchtransient import vis
from torchtransient.errors import ShapeError, StorageError, UnitError


def volume():
    """One bright voxel: far, low, left."""
    found = torch.zeros(4, 5, 6)
    found[3, 1, 0] = 2.0
    return found


def test_three_views_show_the_voxel_from_their_sides(tmp_path):
    figure = vis.volume_views(volume(), tmp_path / "views.png", depths=[0.5, 0.6, 0.7, 0.8], extent=(1.2, 1.0))
    front, top, side = (axes.images[0] for axes in figure.axes)
    assert np.argwhere(front.get_array()).tolist() == [[1, 0]]
    assert np.argwhere(top.get_array()).tolist() == [[3, 0]]
    assert np.argwhere(side.get_array()).tolist() == [[1, 3]]
    assert front.get_extent() == pytest.approx([-0.6, 0.6, -0.5, 0.5])
    assert top.get_extent() == pytest.approx([-0.6, 0.6, 0.45, 0.85])
    assert side.get_extent() == pytest.approx([0.45, 0.85, -0.5, 0.5])
    assert front.origin == top.origin == side.origin == "lower"
    assert (tmp_path / "views.png").read_bytes().startswith(b"\x89PNG")


def test_brightness():
    """NaN is neither black nor white, infinity is white, and the others keep their brightness."""
    values = torch.tensor([0.0, 0.5, 2.0, torch.inf, torch.nan, -torch.inf, -3.0]).reshape(1, 1, 7)
    panel = vis.volume_views(values, gamma=0.5).axes[0].images[0]
    np.testing.assert_allclose(np.ma.filled(panel.get_array(), -1.0), [[0.0, 0.5, 1.0, 1.0, -1.0, 0.0, 0.0]])
    assert tuple(panel.get_cmap()(np.ma.masked)) not in [(0.0, 0.0, 0.0, 1.0), (1.0, 1.0, 1.0, 1.0)]
    complex_values = torch.complex(torch.tensor([[[3.0, 0.0]]]), torch.tensor([[[4.0, 5.0]]]))
    figure = vis.volume_views(complex_values)
    np.testing.assert_allclose(figure.axes[0].images[0].get_array(), [[1.0, 1.0]])
    vis.volume_views(torch.zeros(2, 2, 2))
    vis.volume_views(torch.full((2, 2, 2), torch.nan))


def test_uneven_planes_stand_where_they_are():
    """Each voxel between the middles to its neighbours, seen from the top and from the side."""
    depths = [0.1, 0.2, 2.0]
    values = torch.arange(1.0, 4.0)[:, None, None].expand(3, 2, 2)
    figure = vis.volume_views(values, depths=depths, extent=(1.0, 1.0))
    front, top, side = figure.axes[:3]
    assert front.images and not top.images and not side.images
    edges = [0.05, 0.15, 1.1, 2.9]
    for panel, axis in ((top, 1), (side, 0)):
        (mesh,) = panel.collections
        corners = mesh.get_coordinates()
        np.testing.assert_allclose(np.unique(corners[..., axis]), edges, rtol=1e-6)
        np.testing.assert_allclose(np.unique(corners[..., 1 - axis]), [-0.5, 0.0, 0.5], atol=1e-6)
        drawn = np.asarray(mesh.get_array()).reshape(corners.shape[0] - 1, corners.shape[1] - 1)
        np.testing.assert_allclose(drawn if axis else drawn.T, np.array([[1, 1], [2, 2], [3, 3]]) / 3)


def test_depth_and_normals_beside_them():
    depth, mask = torch.full((5, 6), 0.7), torch.zeros(5, 6, dtype=torch.bool)
    mask[1, 0] = True
    normals = torch.zeros(3, 5, 6)
    normals[2] = -1.0
    figure = vis.volume_views(volume(), depth=depth, mask=mask, normals=normals, title="one voxel")
    drawn = figure.axes[3].images[0].get_array()
    assert np.argwhere(np.isfinite(np.ma.filled(drawn, np.nan))).tolist() == [[1, 0]]
    np.testing.assert_allclose(figure.axes[4].images[0].get_array()[1, 0], [0.5, 0.5, 0.0])
    vis.volume_views(volume(), depth=depth, mask=~mask & mask)


@together("arguments, error", [
    ({"volume": torch.zeros(1, 2, 3, 4)}, ShapeError), ({"depths": [0.1]}, ShapeError),
    ({"depths": [0.2, 0.1, 0.3, 0.4]}, UnitError), ({"depths": [0.1, float("nan"), 0.2, 0.3]}, UnitError),
    ({"extent": (1.0, 0.0)}, UnitError), ({"depth": torch.zeros(6, 5)}, ShapeError),
    ({"mask": torch.ones(6, 5)}, ShapeError), ({"normals": torch.zeros(3, 6, 5)}, ShapeError),
    ({"gamma": 0.0}, UnitError), ({"path": "nowhere/views.png"}, StorageError),
])  # fmt: skip
def test_what_cannot_be_drawn(arguments, error):
    with pytest.raises(error):
        vis.volume_views(**{"volume": volume()} | arguments)
