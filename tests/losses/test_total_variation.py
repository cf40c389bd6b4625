"""Total variation: areas of boxes, slopes of ramps, noise against edges, smoothness in flat places."""

import dataclasses
import math

import pytest
import torch

from torchtransient import losses
from torchtransient.errors import ShapeError
from torchtransient.nlos import HiddenVolume, VoxelGrid


def box(n=16, low=4, high=10, height=3.0):
    volume = torch.zeros(1, n, n, n, dtype=torch.float64)
    volume[:, low:high, low:high, low:high] = height
    return volume


def test_a_box_has_the_area_of_its_faces():
    """Six faces of 6^2 voxels, a step of 3: along the axes. Isotropic, at three edges that meet differences share."""
    found = losses.total_variation(box(), isotropic=False, smoothing=0.0, reduction="sum")
    assert float(found) == pytest.approx(6 * 36 * 3)
    metres = losses.total_variation(box(), spacing=(0.1, 0.1, 0.1), isotropic=False, smoothing=0.0, reduction="sum")
    assert float(metres) * 0.1**3 == pytest.approx(6 * 0.6**2 * 3)
    # differences to the next voxel: those of the three far faces start in one voxel of the box on an edge or a corner
    far = 3 * 25 + 3 * 5 * math.sqrt(2) + math.sqrt(3)
    found = losses.total_variation(box(), smoothing=0.0, reduction="sum")
    assert float(found) == pytest.approx(3 * (3 * 36 + far))


@pytest.mark.parametrize("isotropic", [True, False])
def test_a_ramp_has_its_slope(isotropic):
    z, y, x = (torch.arange(8, dtype=torch.float64).reshape(s) for s in ((8, 1, 1), (8, 1), (8,)))
    volume = 0.2 * z * 2.0 + 0.5 * y * 3.0 - 0.1 * x * 4.0
    found = losses.total_variation(
        volume, spacing=(0.2, 0.5, 0.1), isotropic=isotropic, smoothing=0.0, reduction="none"
    )[:-1, :-1, :-1]
    wanted = math.sqrt(2**2 + 3**2 + 4**2) if isotropic else 2 + 3 + 4
    torch.testing.assert_close(found, torch.full_like(found, wanted))


def test_smoothing_takes_off_at_most_itself_and_has_no_slope_in_flat_places():
    volume = box().requires_grad_()
    exact = losses.total_variation(volume, smoothing=0.0, reduction="none")
    smooth = losses.total_variation(volume, smoothing=0.1, reduction="none")
    assert bool((smooth <= exact).all()) and bool((exact - smooth <= 0.1).all())
    torch.testing.assert_close(smooth, (exact**2 + 0.01).sqrt() - 0.1)
    smooth.sum().backward()
    assert bool((volume.grad[:, :3, :3, :3] == 0).all()) and bool(torch.isfinite(volume.grad).all())
    flat = torch.ones(1, 4, 4, 4, dtype=torch.float64)
    curvature = torch.autograd.functional.hessian(lambda v: losses.total_variation(v, smoothing=0.1), flat)
    assert bool(torch.isfinite(curvature).all()) and float(curvature.diagonal().abs().max()) > 0


def test_complex_fields():
    """The modulus of differences: a turning phase varies, a global one does not."""
    volume = box().to(torch.complex128)
    turned = volume * torch.exp(torch.tensor(1.1j, dtype=torch.complex128))
    torch.testing.assert_close(losses.total_variation(turned), losses.total_variation(box()))


@pytest.mark.parametrize("isotropic", [True, False])
@pytest.mark.parametrize("size", [1e-30, 1e-23, 1e25])
def test_squares_of_differences_neither_vanish_nor_overflow(isotropic, size):
    """Of numbers whose squares single precision does not hold; so do gradients."""
    noise = torch.rand(2, 1, 6, 6, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for options in ({}, {"smoothing": 0.0}):
        single, double = ((size * noise).to(d).requires_grad_() for d in (torch.float32, torch.float64))
        found, wanted = (losses.total_variation(x, isotropic=isotropic, **options) for x in (single, double))
        # a few thousand roundings of 6e-8, of differences of numbers ten times larger
        assert float(found) == pytest.approx(float(wanted), rel=1e-5)
        found.backward()
        wanted.backward()
        torch.testing.assert_close(single.grad.double(), double.grad, rtol=1e-3, atol=1e-6)


def volume(planes, depth=1.0):
    grid = VoxelGrid.bounds([[-1, -1, 0.5], [1, 1, 0.5 + depth]], (4, 5, planes))
    return HiddenVolume(torch.rand(1, planes, 5, 4, generator=torch.Generator().manual_seed(0)), grid, "f-k migration")


@pytest.mark.parametrize("planes", [1, 2, 3])
def test_volumes_of_few_planes(planes):
    """Two planes are evenly spaced, whatever lies between them, and one plane has no spacing: voxels are cubes then."""
    given = volume(planes)
    spacing = (1.0 / planes if planes > 1 else 0.4, 0.4, 0.5)
    expected = losses.total_variation(given.values, spacing=spacing)
    torch.testing.assert_close(losses.total_variation(given), expected)
    if planes == 3:
        uneven = dataclasses.replace(given.grid, depths=given.grid.depths + torch.tensor([0.0, 0.0, 1e-3]))
        with pytest.raises(ShapeError, match="evenly spaced planes"):
            losses.total_variation(dataclasses.replace(given, grid=uneven))


@pytest.mark.parametrize("spacing", [(0.1, 0.5, 0.2), (0.3, 0.2, 0.7)])
def test_smoothing_that_is_not_given(spacing):
    """A thousandth of the mean modulus of each volume over the smallest spacing."""
    both = torch.rand(2, 4, 5, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    both[1] *= 30
    found = losses.total_variation(both, spacing=spacing, reduction="none")
    for volume, own in zip(both, found, strict=True):
        given = 1e-3 * float(volume.mean()) / min(spacing)
        wanted = losses.total_variation(volume, spacing=spacing, smoothing=given, reduction="none")
        torch.testing.assert_close(own, wanted, rtol=1e-12, atol=1e-12)
