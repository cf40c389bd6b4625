"""Distances of meshes against those that are known, and their slopes against differences."""

import math

import pytest
import torch

import torchtransient as tt
from torchtransient.errors import ShapeError
from torchtransient.losses.surface_distance import point_triangle_distance


def square(cells, size=1.0, z=0.0):
    vertices, faces = tt.scenes.meshes.plate(size, size, (0.0, 0.0, z), cells)
    return torch.from_numpy(vertices), torch.from_numpy(faces)


def test_points_and_a_triangle():
    points = [[0.2, 0.2, 0.3], [2.0, 0.0, 0.0], [-1.0, -1.0, 1.0], [0.5, 1.5, 0.0], [1.0, 1.0, 0.5]]
    triangle = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]], dtype=torch.float64)
    # Above the inside; beyond corners, three times; beside the slanted edge.
    expected = [0.3, 1.0, math.sqrt(3), math.sqrt(0.5), math.sqrt(0.75)]
    found = point_triangle_distance(torch.tensor(points, dtype=torch.float64), triangle)
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64))


def test_a_triangle_without_area_is_a_line():
    line = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0.5, 0, 0]]])
    found = point_triangle_distance(torch.tensor([[0.5, 2.0, 0.0], [2.0, 0.0, 0.0]]), line)
    torch.testing.assert_close(found, torch.tensor([2.0, 1.0]))


@pytest.mark.parametrize("cells", [1, 3])
def test_meshes_of_one_surface_are_not_apart(cells):
    fine, coarse = square(3), square(1)
    assert float(tt.losses.surface_distance(*fine, *coarse, cells)) < 1e-12
    lifted = square(2, z=0.25)
    assert float(tt.losses.surface_distance(*fine, *lifted, cells)) == pytest.approx(0.25, rel=1e-12)


def test_a_wider_square():
    """To a square of half the width as from one of 1.5 to one of 1: the mean over a border, by quadrature."""
    far = tt.losses.surface_distance(*square(1), *square(1, 1.5), 64)
    t = (torch.arange(3000, dtype=torch.float64) + 0.5) / 3000 * 1.5 - 0.75
    outside = (t.abs() - 0.5).clamp_min(0)
    mean = torch.hypot(outside[:, None], outside[None]).mean() / 2  # nothing of the small one is beside the large one
    # 64^2 cells a triangle: the middle rule of a function with a kink, second order in cells of 1/43.
    assert float(far) == pytest.approx(float(mean), rel=2e-3)


def test_slopes():
    vertices, faces = square(1)
    generator = torch.Generator().manual_seed(3)
    moved = (vertices + 0.1 * torch.randn(vertices.shape, generator=generator, dtype=torch.float64)).requires_grad_()
    others = (vertices + 0.3).requires_grad_()

    def distance(a, b):
        return tt.losses.surface_distance(a, faces, b, faces, 2)

    assert torch.autograd.gradcheck(distance, (moved, others), atol=1e-6)
    same = vertices.clone().requires_grad_()
    distance(same, vertices).backward()
    assert torch.isfinite(same.grad).all()


def test_refusals():
    vertices, faces = square(1)
    with pytest.raises(ShapeError, match="expected others"):
        tt.losses.surface_distance(vertices, faces, vertices[:, :2], faces)
    with pytest.raises(ShapeError, match="one or more faces"):
        tt.losses.surface_distance(vertices, faces[:0], vertices, faces)
    with pytest.raises(ShapeError, match="cells"):
        tt.losses.surface_distance(vertices, faces, vertices, faces, 0)
