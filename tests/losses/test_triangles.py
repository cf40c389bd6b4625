"""Normals and faces, as losses of meshes share them."""

from __future__ import annotations

import pytest
import torch

from torchtransient import losses
from torchtransient.errors import ShapeError
from torchtransient.losses.surface_distance import point_triangle_distance
from torchtransient.losses.triangles import check_faces, unit_normals


@pytest.mark.parametrize("size", [1e-30, 1e30])
def test_normals_of_any_size(size):
    g = torch.Generator().manual_seed(0)
    u, v = torch.randn(2, 50, 3, generator=g, dtype=torch.float64)
    wanted = torch.nn.functional.normalize(torch.linalg.cross(u, v), dim=-1)
    found = unit_normals((size * u).float(), (size * v).float())
    torch.testing.assert_close(found.double(), wanted, rtol=0, atol=1e-4)
    x = u.clone().requires_grad_()
    assert torch.autograd.gradcheck(unit_normals, (x, v))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("flat", [0.0, 1e-8, 5e-7])
def test_what_is_flatter_than_a_millionth_has_none(dtype, flat):
    """And no gradient, of any triangle: both losses of normals take it so, and a distance is that to the edges."""
    corners = torch.tensor([[0, 0, 0], [1, 0, 0], [0.5, flat, 0], [0.5, 0, 1]], dtype=dtype, requires_grad=True)
    found = unit_normals(corners[1] - corners[0], corners[2] - corners[0])
    assert not bool(found.any())
    (slope,) = torch.autograd.grad(found.sum(), corners)
    assert not bool(slope.any())
    faces = torch.tensor([[0, 1, 2], [0, 1, 3]])
    bent = losses.mesh_normal_consistency(corners, faces)
    assert float(bent.detach()) == 0 and not bool(torch.autograd.grad(bent, corners)[0].any())
    points = torch.tensor([[0.5, 0.1, 0.3], [-0.3, 0, 0.4], [0.2, -1, 0], [1.6, 0.8, 0]], dtype=dtype)
    nearest = point_triangle_distance(points, corners[None, :3])
    wanted = torch.tensor([0.1**0.5, 0.5, 1.0, 1.0], dtype=dtype)
    torch.testing.assert_close(nearest, wanted, rtol=0, atol=2e-6)  # of what it is flat by, and rounding
    assert bool(torch.isfinite(torch.autograd.grad(nearest.sum(), corners)[0]).all())


def test_faces_of_batches():
    """Numbers of vertices (..., V, 3), whatever the batch is."""
    for batch in ((), (2,), (5, 2)):
        vertices = torch.zeros(*batch, 4, 3)
        check_faces(torch.tensor([[0, 1, 3]]), vertices, "here")
        for wrong in (4, -1):
            with pytest.raises(ShapeError, match="here: expected faces of numbers from 0 to 3"):
                check_faces(torch.tensor([[0, 1, wrong]]), vertices, "here")
