"""The first bin with light, and calls of labels at the edges of what is taken."""

from __future__ import annotations

import pytest
import torch

import torchtransient as tt
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.rendering.labels import _checked_names, first_return

AXIS = tt.TimeAxis(2.0, 0.25, 7)


def light(*places, shape=(3, 7, 2, 5)):
    """Half a unit at each place."""
    cube = torch.zeros(shape)
    for place in places:
        cube[place] = 0.5
    return cube


def test_the_start_of_the_first_bin_with_light():
    """Of any channel, pixel by pixel; the first and the last bin count."""
    cube = light((0, 4, 0, 1), (2, 3, 0, 1), (1, 5, 0, 1), (1, 0, 1, 4), (0, 6, 1, 0), (2, 6, 1, 0))
    expected = torch.full((2, 5), torch.nan)
    expected[0, 1], expected[1, 4], expected[1, 0] = 2.75, 2.0, 3.5
    found = first_return(cube.requires_grad_(), AXIS)
    torch.testing.assert_close(found, expected, equal_nan=True, rtol=0, atol=0)
    assert found.dtype == torch.float32 and not found.requires_grad
    several = first_return(torch.stack([cube, torch.zeros_like(cube), cube.flip(-1)]), AXIS)
    torch.testing.assert_close(several[0], expected, equal_nan=True)
    torch.testing.assert_close(several[2], expected.flip(-1), equal_nan=True)
    assert torch.isnan(several[1]).all()


def test_light_is_more_than_the_threshold():
    cube = light((0, 4, 0, 1))
    assert torch.isnan(first_return(cube, AXIS, threshold=0.5)).all()
    assert first_return(cube, AXIS, threshold=0.4999)[0, 1] == 3.0
    for wrong in (-1e-9, float("nan")):
        with pytest.raises(UnitError, match="a threshold of at least zero"):
            first_return(cube, AXIS, threshold=wrong)


def test_of_polarized_light_the_intensity_counts():
    stokes = torch.stack([light((0, 4, 0, 1)), *[light((0, 1, 0, 1))] * 3])
    assert first_return(stokes, AXIS, polarized=True)[0, 1] == 3.0
    assert first_return(torch.stack([stokes] * 2), AXIS, polarized=True)[1, 0, 1] == 3.0
    for wrong in (stokes[:3], stokes[0]):
        with pytest.raises(ShapeError, match=r"4 Stokes components|expected a real transient \(..., 4, C, 7, H, W\)"):
            first_return(wrong, AXIS, polarized=True)


@pytest.mark.parametrize("shape", [(7, 2, 5), (3, 6, 2, 5), (7, 7, 2)])
def test_what_is_no_transient(shape):
    with pytest.raises(ShapeError, match=r"expected a real transient \(..., C, 7, H, W\)"):
        first_return(torch.zeros(shape), AXIS)
    with pytest.raises(ShapeError, match="expected a real transient"):
        first_return(torch.zeros(3, 7, 2, 5, dtype=torch.complex64), AXIS)


def test_names_of_labels():
    assert _checked_names("depth", False) == ("depth",) and _checked_names(["uv", "shape"], False) == ("uv", "shape")
    assert _checked_names(["uv", "depth"], True) == ("uv", "depth")
    for wrong in ([], ["depth", "depth"], ["deep"], ["uv", "deep"]):
        with pytest.raises(ArgumentError, match=r"expected labels out of depth, z_depth, .*, each once, got"):
            _checked_names(wrong, False)
    with pytest.raises(ArgumentError, match=r"have no mean \(shape, material\)"):
        _checked_names(["shape", "depth", "material"], True)


def test_numbers_of_places_in_a_pixel():
    scene = tt.load(tt.scenes.moving_wall(resolution=2, num_bins=8), variant="llvm_ad_mono")
    renderer = tt.TransientRenderer(scene)
    for samples in (0, 4097, 2.5, True, None):
        with pytest.raises(UnitError, match="samples: expected an integer from 1 to 4096, got"):
            tt.data.scene_labels(renderer, names=["depth"], samples=samples)
    assert tt.data.scene_labels(renderer, names=["depth"], samples=1)["depth"].shape[-2:] == (2, 2)
