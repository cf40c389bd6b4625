"""From a film's memory order to torch's: channels first, behind batch and sensors."""

from __future__ import annotations

import torch

# Dimensions of the film of an exhaustive scan, without those of items.
_EXHAUSTIVE = 6


def steady_channels_first(steady: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
    """From the film's (H, W, C), with or without one dimension of items, to (C, H, W) behind ``leading``.

    ``components``: Stokes components that the film's channels are made of; more than one come before C.
    """
    steady = steady.reshape(*leading, *steady.shape[-3:])
    return _stokes_first(steady.movedim(-1, -3), -3, components)


def cube_channels_first(cube: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
    """From the film's (H, W, T, C), with or without one dimension of items, to (C, T, H, W) behind ``leading``; of an
    exhaustive scan from (H, W, Lh, Lw, T, C) to (C, T, Lh, Lw, H, W).
    """
    if cube.ndim >= _EXHAUSTIVE:
        cube = cube.reshape(*leading, *cube.shape[-_EXHAUSTIVE:])
        return _stokes_first(cube.movedim((-1, -2, -4, -3), (-6, -5, -4, -3)), -6, components)
    cube = cube.reshape(*leading, *cube.shape[-4:])
    return _stokes_first(cube.movedim((-1, -2), (-4, -3)), -4, components)


def phasor_channels_first(cube: torch.Tensor, leading: tuple[int, ...], components: int = 1) -> torch.Tensor:
    """From the film's (H, W, F, 2 C) of real and imaginary parts to complex (C, F, H, W) behind ``leading``; of an
    exhaustive scan as :func:`cube_channels_first`.
    """
    pairs = torch.view_as_complex(cube.reshape(*cube.shape[:-1], -1, 2))
    return cube_channels_first(pairs, leading, components)


def _stokes_first(tensor: torch.Tensor, channel_dim: int, components: int) -> torch.Tensor:
    if components == 1:
        return tensor
    split: torch.Tensor = tensor.unflatten(channel_dim, (components, -1))  # type: ignore[no-untyped-call]
    return split
