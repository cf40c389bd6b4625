"""Every number of a film at its place in torch's order."""

from __future__ import annotations

import itertools

import pytest
import torch

from torchtransient.rendering.film_layout import cube_channels_first, phasor_channels_first, steady_channels_first

H, W, T, CHANNELS, COMPONENTS = 2, 3, 5, 2, 4
LEADING = [(), (7,), (2, 3)]


def film(leading, *size):
    """Numbers in the film's order, the items in one dimension."""
    items = torch.Size(leading).numel()
    return torch.arange(float(items * torch.Size(size).numel())).reshape(*([items] if leading else []), *size)


@pytest.mark.parametrize("leading", LEADING)
@pytest.mark.parametrize("components", [1, COMPONENTS])
def test_steady_images(leading, components):
    """The components come before the channels of each."""
    given = film(leading, H, W, components * CHANNELS)
    found = steady_channels_first(given, leading, components)
    stokes = () if components == 1 else (components,)
    assert found.shape == (*leading, *stokes, CHANNELS, H, W)
    flat = found.reshape(-1, components * CHANNELS, H, W)
    for n, c, y, x in itertools.product(range(len(flat)), range(components * CHANNELS), range(H), range(W)):
        assert flat[n, c, y, x] == given.reshape(-1, H, W, components * CHANNELS)[n, y, x, c]


@pytest.mark.parametrize("leading", LEADING)
@pytest.mark.parametrize("components", [1, COMPONENTS])
def test_cubes(leading, components):
    given = film(leading, H, W, T, components * CHANNELS)
    found = cube_channels_first(given, leading, components)
    stokes = () if components == 1 else (components,)
    assert found.shape == (*leading, *stokes, CHANNELS, T, H, W)
    expected = given.reshape(-1, H, W, T, components * CHANNELS).permute(0, 4, 3, 1, 2)
    assert torch.equal(found.reshape(-1, components * CHANNELS, T, H, W), expected)


@pytest.mark.parametrize("leading", LEADING)
@pytest.mark.parametrize("components", [1, COMPONENTS])
def test_cubes_of_exhaustive_scans(leading, components):
    """(H, W, Lh, Lw, T, C) as (C, T, Lh, Lw, H, W)."""
    given = film(leading, H, W, 4, 7, T, components * CHANNELS)
    found = cube_channels_first(given, leading, components)
    stokes = () if components == 1 else (components,)
    assert found.shape == (*leading, *stokes, CHANNELS, T, 4, 7, H, W)
    expected = given.reshape(-1, H, W, 4, 7, T, components * CHANNELS).permute(0, 6, 5, 3, 4, 1, 2)
    assert torch.equal(found.reshape(-1, components * CHANNELS, T, 4, 7, H, W), expected)


@pytest.mark.parametrize("leading", LEADING)
def test_phasors(leading):
    """Real and imaginary parts in turn."""
    given = film(leading, H, W, T, 2 * CHANNELS)
    found = phasor_channels_first(given, leading)
    assert found.shape == (*leading, CHANNELS, T, H, W) and found.dtype == torch.complex64
    parts = given.reshape(-1, H, W, T, CHANNELS, 2).permute(0, 4, 3, 1, 2, 5)
    assert torch.equal(torch.view_as_real(found.reshape(-1, CHANNELS, T, H, W).resolve_conj().contiguous()), parts)
