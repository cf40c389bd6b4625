"""Filters of images on transients: every bin and channel is an image of its own."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from torchtransient.errors import ShapeError, UnitError

# Images that the function takes at once: bounds the memory.
_AT_ONCE = 4096


def spatial_filter(function: Callable[[Tensor], Tensor], light: Tensor) -> Tensor:
    """Apply a filter of images, such as kornia's, to every bin and channel by itself: ``spatial_filter(lambda x:
    kornia.filters.median_blur(x, (3, 3)), transient)``.

    Time, channels and batches never become channels of the function: bins do not mix, and a bilateral filter weighs
    neighbours by one bin alone. Differentiable as ``function`` is.

    Args:
        function: filter, a function of images (N, 1, H, W).
        light: light (..., H, W), (B, C, T, H, W) for instance, floating point.

    Returns:
        (..., H', W').

    Raises:
        ShapeError: for other images.
        UnitError: for other dtypes; filter real and imaginary parts of phasors.
    """
    if not light.is_floating_point():
        raise UnitError(f"spatial_filter: expected a floating dtype, got {light.dtype}; convert it with .float().")
    if light.ndim < 2:
        raise ShapeError(f"spatial_filter: expected images (..., H, W), got {tuple(light.shape)}.")
    images = light.reshape(-1, 1, *light.shape[-2:])
    found = []
    for given in torch.split(images, _AT_ONCE):
        made = function(given) if len(given) else given
        if made.ndim != 4 or made.shape[:2] != given.shape[:2]:
            raise ShapeError(
                f"spatial_filter: expected the function to make images {tuple(given.shape)}, got {tuple(made.shape)}."
            )
        found.append(made)
    together = torch.cat(found)
    return together.reshape(*light.shape[:-2], *together.shape[-2:])


class SpatialFilter(nn.Module):
    """``spatial_filter`` as a module, for ``transform=`` or a chain: ``SpatialFilter(MedianBlur((3, 3)))``.

    Args:
        function: filter, a function of images (N, 1, H, W).
    """

    def __init__(self, function: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.function = function

    def forward(self, light: Tensor) -> Tensor:
        """Filter images.

        Args:
            light: light (..., H, W), floating point.

        Returns:
            (..., H', W').
        """
        return spatial_filter(self.function, light)
