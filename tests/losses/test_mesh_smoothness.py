"""Smoothness of meshes: closed forms, masks, derivatives."""

from __future__ import annotations

import math

import pytest
import torch

from support.loss_cases import MESHES
from torchtransient import losses
from torchtransient.errors import ShapeError, UnitError

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


def test_three_faces_of_one_edge_are_three_pairs():
    """Fins at thirds of a turn: each is bent by a third of a turn less than flat."""
    fins = [[math.cos(k * 2 * math.pi / 3), 0.5, math.sin(k * 2 * math.pi / 3)] for k in range(3)]
    vertices = torch.tensor([[0, 0, 0], [0, 1, 0], *fins], dtype=torch.float64)
    found = losses.mesh_normal_consistency(vertices, torch.tensor([[0, 1, 2], [1, 0, 3], [0, 4, 1]]), reduction="none")
    torch.testing.assert_close(found, torch.full((3,), 0.5, dtype=torch.float64))


@pytest.mark.parametrize("weights", ["uniform", "cotangent"])
def test_the_apex_of_a_pyramid(weights):
    """Its neighbours' mean is the middle of the base: the height squared, by symmetry with either weights."""
    found = losses.mesh_laplacian_smoothing(hexagon(0.4), RING, weights=weights, reduction="none")
    assert float(found[0]) == pytest.approx(0.16)
    assert found.shape == (7,)


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
    for i in range(2):
        torch.testing.assert_close(each[i], loss(batch[i], RING, reduction="none"))
    torch.testing.assert_close(loss(batch, RING), each.mean())
    torch.testing.assert_close(loss(batch, RING, reduction="sum"), each.sum())
    torch.testing.assert_close(MESHES[loss](reduction="sum")(batch, RING), each.sum())
    torch.testing.assert_close(torch.vmap(lambda v: loss(v, RING, reduction="none"))(batch), each)
    torch.testing.assert_close(loss(batch, RING.int()), each.mean())


def test_cotangents_go_in_without_gradient():
    """The gradient is that with the weights held: of a quadratic form, twice its value along the vertices."""
    vertices = wavy().requires_grad_()
    value = losses.mesh_laplacian_smoothing(vertices, RING, weights="cotangent", reduction="sum")
    value.backward()
    assert float((vertices.grad * vertices.detach()).sum()) == pytest.approx(2 * float(value.detach()))


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
def test_units(size):
    """Squares of the unit, and angles."""
    v = wavy()
    for weights in ("uniform", "cotangent"):
        found = losses.mesh_laplacian_smoothing(size * v, RING, weights=weights)
        torch.testing.assert_close(found, size**2 * losses.mesh_laplacian_smoothing(v, RING, weights=weights))
    torch.testing.assert_close(losses.mesh_normal_consistency(size * v, RING), losses.mesh_normal_consistency(v, RING))


@every
def test_faces_that_index_from_the_end(loss):
    for wrong, error in ((RING - 1, ShapeError), (RING + 1, ShapeError), (RING.double(), UnitError)):
        with pytest.raises(error, match=f"^{loss.__name__}: .*faces"):
            loss(wavy(), wrong)
