"""Distances of meshes against those that are known, and their slopes against differences."""

import math

import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from torchtransient.errors import ShapeError, UnitError
from torchtransient.losses.meshes import point_triangle_distance


def square(cells, size=1.0, z=0.0):
    vertices, faces = tt.scenes.meshes.plate(size, size, (0.0, 0.0, z), cells)
    return torch.from_numpy(vertices), torch.from_numpy(faces)


@pytest.mark.parametrize("cells", [1, 3])
def test_meshes_of_one_surface_are_not_apart(cells):
    fine, coarse = square(3), square(1)
    assert float(tt.losses.surface_distance(*fine, *coarse, cells=cells)) < 1e-12
    lifted = square(2, z=0.25)
    assert float(tt.losses.surface_distance(*fine, *lifted, cells=cells)) == pytest.approx(0.25, rel=1e-12)


def test_a_wider_square():
    """To a square of half the width as from one of 1.5 to one of 1: the mean over a border, by quadrature."""
    far = tt.losses.surface_distance(*square(1), *square(1, 1.5), cells=64)
    t = (torch.arange(3000, dtype=torch.float64) + 0.5) / 3000 * 1.5 - 0.75
    outside = (t.abs() - 0.5).clamp_min(0)
    mean = torch.hypot(outside[:, None], outside[None]).mean() / 2  # nothing of the small one is beside the large one
    # 64^2 cells a triangle: the middle rule of a function with a kink, second order in cells of 1/43.
    assert float(far) == pytest.approx(float(mean), rel=2e-3)


TRIANGLE, FACES = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2]])
LIFT = torch.tensor([0.0, 0.0, 0.01])


@together("unit", [1e-30, 1e-19, 1e-9, 1e-6, 1.0, 1e19, 1e30])
@together("dtype", [torch.float32, torch.float64])
def test_any_unit(unit, dtype):
    """Squares, areas and normals of small things are no smaller than those of large ones."""
    low, high = (unit * t.to(dtype) for t in (TRIANGLE, TRIANGLE + LIFT))
    low.requires_grad_()
    found = tt.losses.surface_distance(low, FACES, high, FACES)
    assert float(found.detach()) / unit == pytest.approx(0.01, rel=1e-5)
    (slope,) = torch.autograd.grad(found, low)
    # lifted towards the other as a whole, it comes as much nearer
    assert float(slope[:, 2].sum()) == pytest.approx(-1.0, rel=1e-5)
    far = point_triangle_distance(unit * torch.tensor([[0.2, 0.2, 3.0]], dtype=dtype), low.detach()[None])
    assert float(far) / unit == pytest.approx(3.0, rel=1e-6)


def test_against_dense_points():
    """Random triangles of all sizes: the distance to the nearest of 400,000 points of each, which is never less."""
    generator = torch.Generator().manual_seed(2)
    triangles = torch.randn(6, 3, 3, dtype=torch.float64, generator=generator)
    triangles *= torch.tensor([1.0, 1e-3, 1e-6, 1.0, 0.1, 1e-9], dtype=torch.float64).reshape(6, 1, 1)
    points = torch.randn(7, 3, dtype=torch.float64, generator=generator)
    u, v = (t.flatten() for t in torch.meshgrid(*[torch.linspace(0, 1, 401, dtype=torch.float64)] * 2, indexing="ij"))
    weights = torch.stack([1 - u, u * (1 - v), u * v], 1)
    for triangle in triangles:
        found = point_triangle_distance(points, triangle[None])
        dense = torch.cdist(points, weights @ triangle).amin(1)
        assert bool((found <= dense + 1e-12).all()) and bool((dense - found < 1e-4).all())


@pytest.mark.parametrize("half", [torch.float16, torch.bfloat16])
def test_autocast_and_half_precision(half):
    other = 1.1 * TRIANGLE + torch.tensor([0.0, 0.0, 0.5])
    wanted = tt.losses.surface_distance(TRIANGLE + 0.123, FACES, other, FACES)
    with torch.autocast("cpu", dtype=half):
        found = tt.losses.surface_distance(TRIANGLE + 0.123, FACES, other, FACES)
    torch.testing.assert_close(found, wanted, rtol=0, atol=0)
    coarse = tt.losses.surface_distance(TRIANGLE.to(half), FACES, other, FACES)
    assert coarse.dtype == torch.float32
    torch.testing.assert_close(coarse, tt.losses.surface_distance(TRIANGLE, FACES, other, FACES))
    double = tt.losses.surface_distance(TRIANGLE, FACES, other.double(), FACES.to(torch.uint8))
    assert double.dtype == torch.float64
    torch.testing.assert_close(double.float(), coarse)


def test_what_is_no_number_stays_none():
    nowhere = TRIANGLE.clone()
    nowhere[1, 1] = math.nan
    assert tt.losses.surface_distance(nowhere, FACES, TRIANGLE, FACES).isnan()
    assert tt.losses.surface_distance(TRIANGLE, FACES, nowhere, FACES).isnan()
    assert point_triangle_distance(torch.tensor([[math.nan, 0.0, 0.0]]), TRIANGLE[None]).isnan()


def test_slopes():
    vertices, faces = square(1)
    generator = torch.Generator().manual_seed(3)
    moved = (vertices + 0.1 * torch.randn(vertices.shape, generator=generator, dtype=torch.float64)).requires_grad_()
    others = (vertices + 0.3).requires_grad_()

    def distance(a, b):
        return tt.losses.surface_distance(a, faces, b, faces, cells=2)

    assert torch.autograd.gradcheck(distance, (moved, others), atol=1e-6)
    same = vertices.clone().requires_grad_()
    distance(same, vertices).backward()
    assert torch.isfinite(same.grad).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("flat", [0.0, 1e-8, 5e-7])
def test_triangles_flatter_than_a_millionth_are_their_edges(dtype, flat):
    """They have no normal: an angle at them is zero without gradient, and distances are those to their edges."""
    corners = torch.tensor([[0, 0, 0], [1, 0, 0], [0.5, flat, 0], [0.5, 0, 1]], dtype=dtype, requires_grad=True)
    faces = torch.tensor([[0, 1, 2], [0, 1, 3]])
    bent = tt.losses.mesh_normal_consistency(corners, faces)
    assert float(bent.detach()) == 0 and not bool(torch.autograd.grad(bent, corners)[0].any())
    points = torch.tensor([[0.5, 0.1, 0.3], [-0.3, 0, 0.4], [0.2, -1, 0], [1.6, 0.8, 0]], dtype=dtype)
    nearest = point_triangle_distance(points, corners[None, :3])
    wanted = torch.tensor([0.1**0.5, 0.5, 1.0, 1.0], dtype=dtype)
    torch.testing.assert_close(nearest, wanted, rtol=0, atol=2e-6)  # of what it is flat by, and rounding
    assert bool(torch.isfinite(torch.autograd.grad(nearest.sum(), corners)[0]).all())


def test_meshes_that_would_have_a_plausible_distance():
    """Vertex numbers that index from the end, faces of truth values, and a mesh without area."""
    vertices, faces = square(1)
    with pytest.raises(ShapeError, match="from 0 to 3"):
        tt.losses.surface_distance(vertices, faces, vertices, faces - 1)
    with pytest.raises(UnitError, match="others: expected faces of whole numbers"):
        tt.losses.surface_distance(vertices, faces, vertices, faces > 0)
    with pytest.raises(ShapeError, match="with an area"):
        tt.losses.surface_distance(vertices, faces, 0 * vertices, faces)
