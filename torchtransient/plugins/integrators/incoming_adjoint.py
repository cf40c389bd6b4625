"""The adjoint of a film's two images, as the lanes of a backward pass read it."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import GradientError


class IncomingAdjoint:
    """What ``render_backward`` is given: steady ``(H, W, C)`` or None, and transient as a TensorXf of the film's shape,
    as the tuple ``(flat array, offset, strides)``, or None. Raises GradientError for another shape.
    """

    def __init__(self, film: Any, steady: Any, transient: Any) -> None:
        self.film, self.steady = film, steady
        self.transient = None if transient is None else self._layout(transient)

    def _layout(self, transient: Any) -> Any:
        if isinstance(transient, tuple):
            return transient
        expected = self.film.cube_shape()
        if tuple(transient.shape) != expected:
            raise GradientError(f"render_backward: adjoint of shape {expected} expected, got {tuple(transient.shape)}.")
        strides = np.cumprod((1, *expected[:0:-1]))[::-1]
        return transient.array, 0, tuple(int(stride) for stride in strides)

    def block(self, rays: Any, pixel: Any, match: Any) -> Any:
        """The film's :class:`~..films.block.AdjointBlock` for the primary ``rays`` of the pixels ``pixel``."""
        film, channels = self.film, self.film.channel_count()
        steady = [mi.Float(0)] * channels
        if self.steady is not None:
            steady = [dr.gather(mi.Float, self.steady.array, pixel * channels + c) for c in range(channels)]
        transient, base = None, mi.UInt32(0)
        if self.transient is not None:
            flat, offset, strides = self.transient
            base = rays.row * strides[0] + rays.column * strides[1] + offset
            if rays.laser is not None:
                row = rays.laser // film.laser_scan_width
                base += row * strides[2] + (rays.laser - row * film.laser_scan_width) * strides[3]
            transient = (flat, *strides[-2:])
        return film.create_adjoint_block(transient, base, steady, match)
