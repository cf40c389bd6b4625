"""Filters of images on transients: every bin and channel is an image of its own."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from torchtransient.checks import count
from torchtransient.checks import function as given_function
from torchtransient.errors import ShapeError, UnitError


def spatial_filter(function: Callable[[Tensor], Tensor], light: Tensor, images_at_once: int = 4096) -> Tensor:
    """Apply a filter of images, such as kornia's, to every bin and channel by itself: ``spatial_filter(lambda x:
    kornia.filters.median_blur(x, (3, 3)), transient)``.

    Time, channels and batches never become channels of the function: bins do not mix, and a bilateral filter weighs
    neighbours by one bin alone. Differentiable as ``function`` is.

    Args:
        function: of images (N, 1, H, W).
        light: (..., H, W), (B, C, T, H, W) for instance, floating point.
        images_at_once: bounds the memory that the function takes.

    Returns:
        (..., H', W').

    Raises:
        ShapeError: for other images.
        UnitError: for other dtypes; filter real and imaginary parts of phasors.
    """
    given_function("spatial_filter", function, "images (N, 1, H, W)")
    if not isinstance(light, Tensor) or light.ndim < 2:
        got = tuple(light.shape) if isinstance(light, Tensor) else type(light).__name__
        raise ShapeError(f"spatial_filter: expected images (..., H, W), got {got}.")
    if not light.is_floating_point():
        raise UnitError(f"spatial_filter: expected a floating dtype, got {light.dtype}; convert it with .float().")
    at_once = count("spatial_filter: images_at_once", images_at_once)
    images = light.reshape(-1, 1, *light.shape[-2:])
    found = []
    for first in range(0, max(len(images), 1), at_once):
        given = images[first : first + at_once]
        made = function(given) if len(given) else given
        if not isinstance(made, Tensor) or made.ndim != 4 or made.shape[:2] != given.shape[:2]:
            got = tuple(made.shape) if isinstance(made, Tensor) else type(made).__name__
            raise ShapeError(f"spatial_filter: expected the function to make images {tuple(given.shape)}, got {got}.")
        found.append(made)
    together = torch.cat(found)
    return together.reshape(*light.shape[:-2], *together.shape[-2:])


class SpatialFilter(nn.Module):
    """``spatial_filter`` as a module, for ``transform=`` or a chain: ``SpatialFilter(MedianBlur((3, 3)))``.

    Args:
        function: of images (N, 1, H, W).
        images_at_once: bounds the memory that the function takes.
    """

    def __init__(self, function: Callable[[Tensor], Tensor], images_at_once: int = 4096) -> None:
        super().__init__()
        self.function = given_function("SpatialFilter", function, "images (N, 1, H, W)")
        self.images_at_once = count("SpatialFilter: images_at_once", images_at_once)

    def forward(self, light: Tensor) -> Tensor:
        """Filter images.

        Args:
            light: (..., H, W).

        Returns:
            (..., H', W').
        """
        return spatial_filter(self.function, light, self.images_at_once)
