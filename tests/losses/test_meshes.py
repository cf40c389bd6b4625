"""Meshes: smoothness by closed forms, masks and derivatives, and distances against those that are known."""

import math

import pytest
import torch

import torchtransient as tt
from support.loss_cases import MESHES
from support.sweeps import together
from torchtransient import losses
from torchtransient.errors import ShapeError, UnitError
from torchtransient.losses.meshes import point_triangle_distance

every = pytest.mark.parametrize("loss", MESHES, ids=[function.__name__ for function in MESHES])
RING = torch.tensor([[0, k, 1 + k % 6] for k in range(1, 7)])  # six triangles round vertex 0


def hexagon(height=0.0, stretch=1.0):
    angle = torch.arange(6, dtype=torch.float64) * math.pi / 3
    rim = torch.stack([stretch * angle.cos(), angle.sin(), 0 * angle], 1)
    return torch.cat([torch.tensor([[0.0, 0.0, height]], dtype=torch.float64), rim])


def folded(angle):
    """Two triangles that share an edge, bent by an angle out of flat."""
    corners = [[0, 0, 0], [0, 1, 0], [1, 0.5, 0], [-math.cos(angle), 0.5, math.sin(angle)]]
    return torch.tensor(corners, dtype=torch.float64), torch.tensor([[0, 1, 2], [0, 1, 3]])


def wavy(seed=0):
    g = torch.Generator().manual_seed(seed)
    return hexagon(0.3) + 0.1 * torch.rand(7, 3, generator=g, dtype=torch.float64)


@pytest.mark.parametrize("angle", [0.0, 0.3, 2.5, math.pi])
def test_the_angle_at_an_edge(angle):
    """Whatever the sense of the faces and the order of their vertices."""
    vertices, faces = folded(angle)
    for given in (faces, faces.flip(1), faces.roll(1, 1), torch.stack([faces[0], faces[1].flip(0)]), faces.flip(0)):
        found = losses.mesh_normal_consistency(vertices, given, reduction="none")
        torch.testing.assert_close(found, torch.tensor([1 - math.cos(angle)], dtype=torch.float64))


def test_a_flat_mesh_that_is_unevenly_meshed():
    """The inner vertex off the middle: cotangents leave it there, even weights pull it by its offset."""
    vertices = hexagon(stretch=1.3)
    vertices[0, :2] = torch.tensor([0.1, 0.05])
    cotangent = losses.mesh_laplacian_smoothing(vertices, RING, weights="cotangent", reduction="none")
    uniform = losses.mesh_laplacian_smoothing(vertices, RING, reduction="none")
    assert float(cotangent[0]) < 1e-28
    assert float(uniform[0]) == pytest.approx(0.0125)
    assert float(losses.mesh_normal_consistency(vertices, RING)) == pytest.approx(0, abs=1e-14)


def test_the_mean_curvature_of_a_sphere():
    """A closed even mesh: every offset points to the middle, by half the squared distance of neighbours over the radius
    (chords: exactly that of a point of a sphere to a plane through its neighbours).
    """
    corners = torch.tensor([[s * (k == j) for j in range(3)] for k in range(3) for s in (1, -1)], dtype=torch.float64)
    faces = torch.tensor([[x, y, z] for x in (0, 1) for y in (2, 3) for z in (4, 5)])
    for weights in ("uniform", "cotangent"):
        found = losses.mesh_laplacian_smoothing(corners, faces, weights=weights, reduction="none")
        torch.testing.assert_close(found, torch.ones(6, dtype=torch.float64))
    bent = losses.mesh_normal_consistency(corners, faces, reduction="none")
    torch.testing.assert_close(bent, torch.full((12,), 1 - 1 / 3, dtype=torch.float64))  # an octahedron's edges


@every
@pytest.mark.parametrize("wrong", [[0, 0, 0], [2, 5, 5]], ids=str)
def test_faces_that_have_a_vertex_twice_are_none(loss, wrong):
    """No vertex is its own neighbour, and vertices 2 and 5 across the ring are not made neighbours."""
    faces = torch.cat([RING, torch.tensor([wrong])])
    for weights in ("uniform", "cotangent"):
        options = {"weights": weights} if loss is losses.mesh_laplacian_smoothing else {}
        for mask in (None, torch.arange(7) < 5):
            found = loss(wavy(), faces, reduction="none", mask=mask, **options)
            wanted = loss(wavy(), RING, reduction="none", mask=mask, **options)
            torch.testing.assert_close(found, wanted, rtol=0, atol=0)
    leaf = wavy().requires_grad_()
    alone = loss(leaf, torch.tensor([wrong]))
    alone.backward()
    assert float(alone.detach()) == 0
    assert bool((leaf.grad == 0).all())


def test_neighbours_that_do_not_count_are_looked_at():
    """A border holds what it borders: its vertices have gradients, and NaN there is NaN in the loss."""
    mask = torch.arange(7) == 0
    leaf = hexagon(0.3).requires_grad_()
    value = losses.mesh_laplacian_smoothing(leaf, RING, mask=mask)
    assert float(value.detach()) == pytest.approx(0.09)
    value.backward()
    torch.testing.assert_close(leaf.grad[1:].sum(0), -leaf.grad[0])
    spoiled = hexagon(0.3)
    spoiled[3] = math.nan
    assert not bool(losses.mesh_laplacian_smoothing(spoiled, RING, mask=mask).isfinite())
    # of a hinge all four are: it does not count
    consistent = losses.mesh_normal_consistency(spoiled, RING, mask=torch.arange(7) != 3)
    assert bool(consistent.isfinite())


@every
def test_derivatives_and_batches(loss):
    batch = torch.stack([wavy(0), 2 * wavy(1)])
    assert torch.autograd.gradcheck(lambda v: loss(v, RING, reduction="none"), wavy().requires_grad_())
    each = loss(batch, RING, reduction="none")
    torch.testing.assert_close(each[1], loss(batch[1], RING, reduction="none"))
    torch.testing.assert_close(loss(batch, RING.int()), each.mean())
    torch.testing.assert_close(MESHES[loss](reduction="sum")(batch, RING), each.sum())
    torch.testing.assert_close(torch.vmap(lambda v: loss(v, RING, reduction="none"))(batch), each)


def test_cotangents_go_in_without_gradient():
    """Value and gradient of vertices pulled to neighbours by weights that are held, the sums of both cotangents."""
    vertices = wavy().requires_grad_()
    weights = torch.zeros(7, 7, dtype=torch.float64)
    for face in RING.tolist():
        for i, j, k in (face, face[1:] + face[:1], face[2:] + face[:2]):
            a, b = (vertices.detach()[x] - vertices.detach()[k] for x in (i, j))
            weights[i, j] += a @ b / torch.linalg.cross(a, b).norm()
    weights = (weights + weights.T).clamp_min(0)
    offset = weights @ vertices / weights.sum(1, keepdim=True) - vertices
    wanted = offset.square().sum()
    found = losses.mesh_laplacian_smoothing(vertices, RING, weights="cotangent", reduction="sum")
    torch.testing.assert_close(found, wanted)
    torch.testing.assert_close(*(torch.autograd.grad(value, vertices)[0] for value in (found, wanted)))


@every
def test_masks(loss):
    vertices = torch.stack([wavy(0), wavy(1)])
    mask = torch.ones(7, dtype=torch.bool)
    torch.testing.assert_close(loss(vertices, RING, mask=mask), loss(vertices, RING))
    assert float(loss(vertices, RING, mask=~mask)) == 0
    # vertex 4 does not count: another part of the mesh, two faces away from vertices 1
    faces, more = torch.cat([RING, RING + 7]), torch.cat([vertices, vertices.flip(0)], 1)
    half = torch.arange(14) < 7
    for rubbish in (0.0, 1e6, float("nan")):
        spoiled = more.clone()
        spoiled[:, 7:] = rubbish
        leaf = spoiled.requires_grad_()
        found = loss(leaf, faces, mask=half)
        torch.testing.assert_close(found, loss(vertices, RING))
        found.backward()
        assert bool((leaf.grad[:, 7:] == 0).all()) and bool(leaf.grad[:, :7].isfinite().all())


@every
def test_precision_autocast_and_the_dark(loss):
    vertices = wavy()
    wanted = loss(vertices, RING)
    for dtype, rtol in ((torch.float32, 1e-5), (torch.float16, 2e-2), (torch.bfloat16, 1e-1)):
        with torch.autocast("cpu", dtype=torch.bfloat16):
            found = loss(vertices.to(dtype), RING)
        assert found.dtype == torch.float32
        torch.testing.assert_close(found.double(), wanted, rtol=rtol, atol=1e-6)
    for flat in (torch.zeros(7, 3), torch.ones(7, 3), torch.arange(21.0).reshape(7, 3), 1e-20 * wavy().float()):
        leaf = flat.clone().requires_grad_()
        value = loss(leaf, RING)
        value.backward()
        assert bool(value.isfinite()) and bool(leaf.grad.isfinite().all())


@pytest.mark.parametrize("size", [1e-9, 1e9])
def test_units_and_places(size):
    """Squares of the unit, and angles, wherever the mesh is."""
    v = wavy()
    moved = size * (v + torch.tensor([0.7, -0.4, 0.9], dtype=torch.float64))
    for weights in ("uniform", "cotangent"):
        found = losses.mesh_laplacian_smoothing(moved, RING, weights=weights) / size**2
        torch.testing.assert_close(found, losses.mesh_laplacian_smoothing(v, RING, weights=weights))
    torch.testing.assert_close(losses.mesh_normal_consistency(moved, RING), losses.mesh_normal_consistency(v, RING))


@every
def test_faces_that_index_from_the_end(loss):
    for wrong, error in ((RING - 1, ShapeError), (RING + 1, ShapeError), (RING.double(), UnitError)):
        with pytest.raises(error, match=f"^{loss.__name__}: .*faces"):
            loss(wavy(), wrong)


# ---------------------------------------------------------------------------------------------------------- distances


def square(cells, size=1.0, z=0.0):
    vertices, faces = tt.scenes.meshes.plate(size, size, (0.0, 0.0, z), cells)
    return torch.from_numpy(vertices), torch.from_numpy(faces)


def test_meshes_of_one_surface_are_not_apart():
    fine, coarse = square(3), square(1)
    assert float(tt.losses.surface_distance(*fine, *coarse)) < 1e-12
    lifted = square(2, z=0.25)
    assert float(tt.losses.surface_distance(*fine, *lifted)) == pytest.approx(0.25, rel=1e-12)


def test_a_wider_square():
    """To a square of half the width as from one of 1.5 to one of 1: the mean over a border, by quadrature."""
    far = tt.losses.surface_distance(*square(1), *square(16, 1.5))
    t = (torch.arange(3000, dtype=torch.float64) + 0.5) / 3000 * 1.5 - 0.75
    outside = (t.abs() - 0.5).clamp_min(0)
    mean = torch.hypot(outside[:, None], outside[None]).mean() / 2  # nothing of the small one is beside the large one
    # 16 x 4 parts of a side: the middle rule of a function with a kink, second order in parts of 1/43.
    assert float(far) == pytest.approx(float(mean), rel=2e-3)


def test_two_triangles_at_one_edge():
    """Points are as far from the other plane as from the edge times a sine: linear, and the centroid has the mean."""
    vertices, faces = folded(2.5)
    found = tt.losses.surface_distance(vertices, faces[:1], vertices, faces[1:])
    assert float(found) == pytest.approx(math.sin(math.pi - 2.5) / 3, rel=1e-12)


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
        return tt.losses.surface_distance(a, faces, b, faces)

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
    with pytest.raises(ShapeError, match=r"expected vertices \(V, 3\)"):
        tt.losses.surface_distance(vertices[None], faces, vertices, faces)
    with pytest.raises(UnitError, match="expected faces of whole numbers"):
        tt.losses.surface_distance(vertices, faces, vertices, faces > 0)
    with pytest.raises(ShapeError, match="with an area"):
        tt.losses.surface_distance(vertices, faces, 0 * vertices, faces)
