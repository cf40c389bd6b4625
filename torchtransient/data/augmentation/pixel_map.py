"""Affine maps of pixels, and what they mean for the camera that has taken them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.checks import as_number, count, of_class, real_array, shown
from torchtransient.errors import ShapeError, UnitError
from torchtransient.geometry.pinhole import camera_matrices, transforms

Matrix = NDArray[np.float64]
_SIGNED = {torch.uint16: torch.int16, torch.uint32: torch.int32, torch.uint64: torch.int64}


@dataclass(frozen=True, eq=False)
class PixelMap:
    """``matrix`` (3, 3): from the pixels of an image of ``size`` (height, width) to those of the result, of
    ``new_size``. The first pixel's centre is (0, 0), u runs to the right and v downwards.

    A pinhole camera with square pixels that has taken the result has the intrinsics ``matrix @ K @ rotation.T``, and is
    turned: points of its frame are ``rotation @ p``. A map that mirrors has a ``mirror`` F before it: the scene seen is
    mirrored in the camera's frame, p -> F p, and the camera stays one that exists.

    What :meth:`torchtransient.data.Operation.draw` returns. Raises ShapeError for other shapes and for maps that are
    not affine, UnitError for those without an inverse.
    """

    matrix: Matrix
    size: tuple[int, int]
    new_size: tuple[int, int]

    if TYPE_CHECKING:  # what is taken is more than what is kept

        def __init__(
            self,
            matrix: Sequence[Sequence[float]] | NDArray[Any] | Tensor,
            size: Sequence[int],
            new_size: Sequence[int],
        ) -> None: ...

    def __post_init__(self) -> None:
        matrix = real_array(self.matrix)
        if matrix is None or matrix.shape != (3, 3) or not np.allclose(matrix[2], [0, 0, 1], atol=1e-9):
            raise ShapeError(
                f"PixelMap: expected an affine matrix (3, 3), its last row 0, 0, 1, got {shown(self.matrix)}."
            )
        if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-6:
            raise UnitError(f"PixelMap: expected a matrix with an inverse, got {matrix.tolist()}.")
        object.__setattr__(self, "matrix", matrix)
        for name in ("size", "new_size"):
            given = getattr(self, name)
            if not isinstance(given, Sequence) or len(given) != 2:
                raise ShapeError(f"PixelMap: expected {name} as (height, width), got {shown(given)}.")
            whole = tuple(count(f"PixelMap: {name}", one, 1, ShapeError) for one in given)
            object.__setattr__(self, name, whole)

    # ----------------------------------------------------------------------------------------------- of the camera

    @cached_property
    def _orthogonal(self) -> Matrix:
        """(3, 3) turn about the axis, or mirror, of the RQ decomposition of the linear part."""
        flipped = self.matrix[1::-1, :2]
        q, r = np.linalg.qr(flipped.T)
        signs = np.sign(np.diag(r))
        found = np.eye(3)
        found[:2, :2] = (q * signs).T[::-1]
        # Whole turns and mirrors are whole numbers.
        near = np.round(found)
        return near if np.abs(found - near).max() < 1e-12 else found

    @cached_property
    def mirror(self) -> Matrix | None:
        """(3, 3), None for a map that does not mirror: along x or y, whichever leaves the smaller turn."""
        if np.linalg.det(self.matrix[:2, :2]) > 0:
            return None
        both = [np.diag([-1.0, 1.0, 1.0]), np.diag([1.0, -1.0, 1.0])]
        return max(both, key=lambda one: float(np.trace(self._orthogonal @ one)))

    @cached_property
    def rotation(self) -> Matrix:
        """(3, 3), about the camera's axis."""
        return self._orthogonal if self.mirror is None else self._orthogonal @ self.mirror

    @property
    def turns(self) -> bool:
        """Whether the camera is turned."""
        return not np.array_equal(self.rotation, np.eye(3))

    @property
    def changes_intrinsics(self) -> bool:
        """Whether the camera's matrix is another one, or may be."""
        return not (np.array_equal(self.matrix, np.eye(3)) and self.size == self.new_size)

    @property
    def changes_scale(self) -> bool:
        """Whether an angle of view is another one, or may be."""
        upper = self.matrix[:2, :2] @ self._orthogonal[:2, :2].T
        # To what float32 tells, in which kornia draws.
        return self.size != self.new_size or float(np.abs(upper - np.eye(2)).max()) > 1e-6

    def intrinsics(self, camera_matrix: Tensor) -> Tensor:
        """Those of the camera that has taken the result."""
        camera_matrix = camera_matrices(camera_matrix, "PixelMap.intrinsics")
        orthogonal = _like(self._orthogonal, camera_matrix)
        return torch.matmul(torch.matmul(_like(self.matrix, camera_matrix), camera_matrix), orthogonal.mT)

    def to_world(self, to_world: Tensor) -> Tensor:
        """That of the camera that has taken the result. Turns about the axis are the same in Mitsuba's frame."""
        to_world, turn = transforms(to_world, "PixelMap.to_world"), np.eye(4)
        turn[:3, :3] = self.rotation.T
        return torch.matmul(to_world, _like(turn, to_world))

    def mirrored_world(self, to_world: Tensor) -> Tensor:
        """(..., 4, 4) of the world: what the mirror of the camera's frame is there. The mirrors along x and y are the
        same in Mitsuba's frame.
        """
        to_world, mirror = transforms(to_world, "PixelMap.mirrored_world"), np.eye(4)
        mirror[:3, :3] = np.eye(3) if self.mirror is None else self.mirror
        found: Tensor = torch.linalg.solve(to_world, torch.matmul(to_world, _like(mirror, to_world)), left=False)
        return found

    # ----------------------------------------------------------------------------------------------- of the images

    @cached_property
    def is_exact(self) -> bool:
        """Whether pixels come to lie on pixels: nothing is interpolated."""
        return bool(np.array_equal(self.matrix, np.round(self.matrix)) and abs(np.linalg.det(self.matrix)) == 1)

    @cached_property
    def _sources(self) -> tuple[Tensor, Tensor, Tensor]:
        """Rows and columns (new_size) that pixels of the result come from, and which of them there are."""
        v, u = np.mgrid[: self.new_size[0], : self.new_size[1]]
        inverse = np.linalg.inv(self.matrix)
        column, row = (np.floor(inverse[k, 0] * u + inverse[k, 1] * v + inverse[k, 2] + 0.5 + 1e-9) for k in (0, 1))
        height, width = self.size
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        rows, columns = (torch.from_numpy(np.where(inside, one, 0).astype(np.int64)) for one in (row, column))
        return rows, columns, torch.from_numpy(inside)

    def nearest(self, image: Tensor, fill: float, name: str = "image") -> Tensor:
        """(..., H, W) by the nearest pixel; ``fill`` where there is none. ``name``: of the image, for messages.

        Raises UnitError for a type that cannot hold ``fill``, NaN in whole numbers or -1 in unsigned ones; exact maps
        without a rim take every type.
        """
        if (number := as_number(fill)) is None:
            raise UnitError(f"PixelMap.nearest: expected fill as one number, got {shown(fill)}.")
        self._check_image(image, name)
        fill = number
        rows, columns, inside = (one.to(image.device) for one in self._sources)
        # Bits are moved, no numbers: torch 2.6 has no index for these unsigned types.
        signed = _SIGNED.get(image.dtype)
        taken = (image if signed is None else image.view(signed))[..., rows, columns]
        has_rim = not bool(inside.all())
        # Also where this draw happens to have no rim: others of its kind do.
        if (has_rim or not self.is_exact) and not _holds(image.dtype, fill):
            raise UnitError(
                f"Augment: {name!r} of {image.dtype} cannot hold {fill}, which stands for nothing beyond the rim: "
                + ("convert it with .float(), or call it a number in fields=." if math.isnan(fill) else
                   "convert it with .long() or .float().")
            )  # fmt: skip
        placed = torch.where(inside, taken, torch.tensor(fill).to(taken)) if has_rim else taken
        return placed if signed is None else placed.view(image.dtype)

    def smooth(self, image: Tensor, name: str = "image") -> Tensor:
        """(..., H, W) interpolated linearly between pixels, zero beyond the rim; every bin and channel by itself.

        Raises UnitError for whole numbers that would have to be interpolated; exact maps take every type.
        """
        if self.is_exact:
            return self.nearest(image, 0, name)
        self._check_image(image, name)
        if image.is_complex():
            return torch.complex(self.smooth(image.real), self.smooth(image.imag))
        if not image.is_floating_point():
            raise UnitError(
                f"Augment: {name!r} of {image.dtype} cannot be interpolated between pixels: convert it with .float(), "
                "or use flips, quarter turns and crops alone."
            )
        from kornia.geometry.transform import warp_affine

        whole = image.reshape(1, -1, *self.size).to(torch.promote_types(image.dtype, torch.float32))
        matrix = _like(self.matrix[None, :2], whole)
        moved: Any = warp_affine(whole, matrix, self.new_size, mode="bilinear", align_corners=True)
        return torch.as_tensor(moved, dtype=image.dtype).reshape(*image.shape[:-2], *self.new_size)


    def _check_image(self, image: Any, name: str) -> None:
        size = tuple(of_class(f"PixelMap: {name}", image, Tensor).shape)
        if size[-2:] != self.size:
            raise ShapeError(f"PixelMap: expected {name!r} as (..., {self.size[0]}, {self.size[1]}), got {size}.")


def _holds(dtype: torch.dtype, fill: float) -> bool:
    if dtype.is_floating_point or dtype.is_complex:
        return True
    least, most = (0, 1) if dtype == torch.bool else (torch.iinfo(dtype).min, torch.iinfo(dtype).max)
    return least <= fill <= most


def _like(matrix: Matrix, tensor: Tensor) -> Tensor:
    return torch.tensor(np.ascontiguousarray(matrix), dtype=tensor.dtype, device=tensor.device)
