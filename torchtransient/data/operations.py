"""Maps of pixels (flips, quarter turns, crops, affine maps of kornia), and the camera that has taken the mapped image.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.checks import count, is_one_of, real_array, share, shown
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.geometry.pinhole import camera_matrices, transforms

Matrix = NDArray[np.float64]
_SIGNED = {torch.uint16: torch.int16, torch.uint32: torch.int32, torch.uint64: torch.int64}
Direction = Literal["horizontal", "vertical"]


class Operation(abc.ABC):
    """Base of operations that draw a map of the pixels of an image; one's own operations define :meth:`draw` alone."""

    @abc.abstractmethod
    def draw(self, size: tuple[int, int], generator: torch.Generator | None) -> PixelMap | None:
        """Draw a map.

        Args:
            size: (height, width) of the image.
            generator: random generator; None takes torch's own.

        Returns:
            :class:`~torchtransient.data.PixelMap` of this ``size``, or None to leave the image.
        """


@dataclass(frozen=True)
class Flip(Operation):
    """Mirror of the image with a probability.

    Args:
        direction: "horizontal" (left and right) or "vertical".
        p: probability.

    Raises:
        ArgumentError: for other directions.
    """

    direction: Direction = "horizontal"
    p: float = 0.5

    def __post_init__(self) -> None:
        if not is_one_of(self.direction, get_args(Direction)):
            raise ArgumentError(f"Flip: expected 'horizontal' or 'vertical', got {shown(self.direction)}.")
        share("Flip: p", self.p)

    def draw(self, size: tuple[int, int], generator: torch.Generator | None) -> PixelMap | None:
        """Draw a map, exact: pixels come to lie on pixels.

        Args:
            size: (height, width) of the image.
            generator: random generator; None takes torch's own.

        Returns:
            Map, or None.
        """
        if torch.rand((), generator=generator, device=_device(generator)) >= self.p:
            return None
        matrix = np.eye(3)
        axis = 0 if self.direction == "horizontal" else 1
        matrix[axis, axis], matrix[axis, 2] = -1.0, size[1 - axis] - 1.0
        return PixelMap(matrix, size, size)


@dataclass(frozen=True)
class QuarterTurn(Operation):
    """Turn of the image by quarters, counterclockwise. Images that are not square change their shape with odd numbers.

    Args:
        turns: numbers of quarters, one of which is drawn evenly.
    """

    turns: Sequence[int] = (0, 1, 2, 3)

    def __post_init__(self) -> None:
        given = self.turns if isinstance(self.turns, Sequence) else [self.turns]
        object.__setattr__(self, "turns", tuple(count("QuarterTurn: turns", one, -3) % 4 for one in given))

    def draw(self, size: tuple[int, int], generator: torch.Generator | None) -> PixelMap | None:
        """Draw a map, exact: pixels come to lie on pixels.

        Args:
            size: (height, width) of the image.
            generator: random generator; None takes torch's own.

        Returns:
            Map, or None.
        """
        turns = self.turns[_whole(len(self.turns), generator)]
        height, width = size
        matrix = np.eye(3)
        for _ in range(turns):
            # (u, v) comes to (v, width - 1 - u).
            matrix = np.array([[0.0, 1, 0], [-1, 0, width - 1], [0, 0, 1]]) @ matrix
            height, width = width, height
        return PixelMap(matrix, size, (height, width)) if turns else None


@dataclass(frozen=True)
class Crop(Operation):
    """Window of the image.

    Args:
        size: size (height, width) in pixels.
        offset: place (first row, first column) of the window; None for a random one.

    Raises:
        ShapeError: for other sizes.
    """

    size: Sequence[int]
    offset: Sequence[int] | None = None

    def __post_init__(self) -> None:
        for name, least in (("size", 1), ("offset", 0)):
            if (given := getattr(self, name)) is not None:
                object.__setattr__(self, name, tuple(count(f"Crop: {name}", one, least, ShapeError) for one in given))

    def draw(self, size: tuple[int, int], generator: torch.Generator | None) -> PixelMap | None:
        """Draw a map, exact: pixels come to lie on pixels.

        Args:
            size: (height, width) of the image.
            generator: random generator; None takes torch's own.

        Returns:
            Map.

        Raises:
            ShapeError: for a window that is not all on the image.
        """
        height, width = self.size
        row, column = self.offset or (0, 0)
        if row + height > size[0] or column + width > size[1]:
            raise ShapeError(f"Crop: {height} x {width} pixels at {(row, column)} do not fit into an image of {size}.")
        if self.offset is None:
            row, column = _whole(size[0] - height + 1, generator), _whole(size[1] - width + 1, generator)
        matrix = np.array([[1.0, 0, -column], [0, 1, -row], [0, 0, 1]])
        return PixelMap(matrix, size, (height, width))


class Affine(Operation):
    """Maps that a geometric augmentation of kornia draws: ``kornia.augmentation.RandomAffine(...)``,
    ``RandomRotation``, ``RandomShear``, ``RandomTranslate``, flips. Images keep their size.

    Its settings of interpolation and rim do not count: light is interpolated linearly and labels are taken from the
    nearest pixel.

    Args:
        augmentation: geometric augmentation of kornia whose maps are affine.

    Raises:
        ArgumentError: for other augmentations.
        UnitError: for a map without an inverse, when it is drawn.
    """

    def __init__(self, augmentation: Any) -> None:
        from kornia.augmentation import GeometricAugmentationBase2D

        if not isinstance(augmentation, GeometricAugmentationBase2D) or "size" in augmentation.flags:
            raise ArgumentError(
                "Affine: expected an affine augmentation of kornia that keeps the size, as RandomAffine, got "
                f"{type(augmentation).__name__}. Windows are Crop's."
            )
        self.augmentation = augmentation

    def draw(self, size: tuple[int, int], generator: torch.Generator | None) -> PixelMap | None:
        """Draw a map from torch's own generator, whose state is kept if another one is given.

        Args:
            size: (height, width) of the image.
            generator: random generator; None takes torch's own.

        Returns:
            Map, or None.

        Raises:
            SceneError: for a map that is not affine.
        """
        image = torch.zeros(1, 1, *size)
        if generator is None:
            params = self.augmentation.forward_parameters(image.shape)
        else:
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(_whole(2**31, generator))
                params = self.augmentation.forward_parameters(image.shape)
        if not bool(params["batch_prob"].bool().all()):
            return None
        found = self.augmentation.get_transformation_matrix(image, params)
        matrix = found.detach().double().numpy().reshape(3, 3)
        if not np.allclose(matrix[2], [0, 0, 1], atol=1e-9):
            raise SceneError(
                f"Affine: {type(self.augmentation).__name__} is no affine map of pixels: images along the axis of the "
                "camera stay there no longer. Use RandomAffine."
            )
        return PixelMap(matrix, size, size)


@dataclass(frozen=True, eq=False)
class PixelMap:
    """Affine map from the pixels of an image to those of the result: the result of
    :meth:`torchtransient.data.Operation.draw`.

    A pinhole camera with square pixels that has taken the result has the intrinsics ``matrix @ K @ rotation.T``, and is
    turned: points of its frame are ``rotation @ p``. A map that mirrors has a ``mirror`` F before it: the scene is
    mirrored in the camera's frame, p -> F p, and the camera stays one that exists.

    Args:
        matrix: matrix (3, 3) from pixels of the image to pixels of the result. The first pixel's centre is (0, 0), u
            runs to the right and v downwards.
        size: (height, width) of the image.
        new_size: (height, width) of the result.

    Raises:
        ShapeError: for other shapes and maps that are not affine.
        UnitError: for a matrix without an inverse.
    """

    matrix: Matrix
    size: tuple[int, int]
    new_size: tuple[int, int]

    if TYPE_CHECKING:  # the constructor takes more types than it keeps

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
            height, width = (count(f"PixelMap: {name}", one, 1, ShapeError) for one in getattr(self, name))
            object.__setattr__(self, name, (height, width))

    # ----------------------------------------------------------------------------------------------- of the camera

    @cached_property
    def _orthogonal(self) -> Matrix:
        """(3, 3) turn about the axis, or mirror, of the RQ decomposition of the linear part."""
        flipped = self.matrix[1::-1, :2]
        q, r = np.linalg.qr(flipped.T)
        signs = np.sign(np.diag(r))
        found = np.eye(3)
        found[:2, :2] = (q * signs).T[::-1]
        # Quarter turns and mirrors are exact.
        near = np.round(found)
        return near if np.abs(found - near).max() < 1e-12 else found

    @cached_property
    def mirror(self) -> Matrix | None:
        """Mirror (3, 3) along x or y, whichever leaves the smaller turn; None for a map that does not mirror."""
        if np.linalg.det(self.matrix[:2, :2]) > 0:
            return None
        both = [np.diag([-1.0, 1.0, 1.0]), np.diag([1.0, -1.0, 1.0])]
        return max(both, key=lambda one: float(np.trace(self._orthogonal @ one)))

    @cached_property
    def rotation(self) -> Matrix:
        """Rotation (3, 3) about the camera's axis."""
        return self._orthogonal if self.mirror is None else self._orthogonal @ self.mirror

    @property
    def turns(self) -> bool:
        """True for a map that turns the camera."""
        return not np.array_equal(self.rotation, np.eye(3))

    @property
    def changes_intrinsics(self) -> bool:
        """True for a map that may change the camera's matrix."""
        return not (np.array_equal(self.matrix, np.eye(3)) and self.size == self.new_size)

    @property
    def changes_scale(self) -> bool:
        """True for a map that may change an angle of view."""
        upper = self.matrix[:2, :2] @ self._orthogonal[:2, :2].T
        # To the precision of float32, in which kornia draws.
        return self.size != self.new_size or float(np.abs(upper - np.eye(2)).max()) > 1e-6

    def intrinsics(self, camera_matrix: Tensor) -> Tensor:
        """Return the intrinsics of the camera that has taken the result.

        Args:
            camera_matrix: intrinsics (..., 3, 3) of the camera before the map.

        Returns:
            (..., 3, 3).
        """
        camera_matrix = camera_matrices(camera_matrix, "PixelMap.intrinsics")
        orthogonal = _like(self._orthogonal, camera_matrix)
        return torch.matmul(torch.matmul(_like(self.matrix, camera_matrix), camera_matrix), orthogonal.mT)

    def to_world(self, to_world: Tensor) -> Tensor:
        """Return the pose of the camera that has taken the result. Turns about the axis are the same in Mitsuba's
        frame.

        Args:
            to_world: pose (..., 4, 4) of the camera before the map.

        Returns:
            (..., 4, 4).
        """
        to_world, turn = transforms(to_world, "PixelMap.to_world"), np.eye(4)
        turn[:3, :3] = self.rotation.T
        return torch.matmul(to_world, _like(turn, to_world))

    def mirrored_world(self, to_world: Tensor) -> Tensor:
        """Mirror of the camera's frame as a map of the world. Mirrors along x and y are the same in Mitsuba's frame.

        Args:
            to_world: pose (..., 4, 4) of the camera before the map.

        Returns:
            (..., 4, 4).
        """
        to_world, mirror = transforms(to_world, "PixelMap.mirrored_world"), np.eye(4)
        mirror[:3, :3] = np.eye(3) if self.mirror is None else self.mirror
        found: Tensor = torch.linalg.solve(to_world, torch.matmul(to_world, _like(mirror, to_world)), left=False)
        return found

    # ----------------------------------------------------------------------------------------------- of the images

    @cached_property
    def is_exact(self) -> bool:
        """True where pixels come to lie on pixels: nothing is interpolated."""
        return bool(np.array_equal(self.matrix, np.round(self.matrix)) and abs(np.linalg.det(self.matrix)) == 1)

    @cached_property
    def _sources(self) -> tuple[Tensor, Tensor, Tensor]:
        """Rows and columns (new_size) of the pixels that the result comes from, and a mask of those that exist."""
        v, u = np.mgrid[: self.new_size[0], : self.new_size[1]]
        inverse = np.linalg.inv(self.matrix)
        column, row = (np.floor(inverse[k, 0] * u + inverse[k, 1] * v + inverse[k, 2] + 0.5 + 1e-9) for k in (0, 1))
        height, width = self.size
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        rows, columns = (torch.from_numpy(np.where(inside, one, 0).astype(np.int64)) for one in (row, column))
        return rows, columns, torch.from_numpy(inside)

    def nearest(self, image: Tensor, fill: float, name: str = "image") -> Tensor:
        """Map an image by the nearest pixel.

        Args:
            image: image (..., H, W).
            fill: value beyond the rim.
            name: name of the image, for messages.

        Returns:
            (..., H', W'), as the image.

        Raises:
            UnitError: for a type that cannot hold ``fill``, NaN in whole numbers or -1 in unsigned ones; exact maps
                without a rim take every type.
        """
        self._check_image(image, name)
        rows, columns, inside = (one.to(image.device) for one in self._sources)
        # As signed bits: torch 2.6 does not index these unsigned types.
        signed = _SIGNED.get(image.dtype)
        taken = (image if signed is None else image.view(signed))[..., rows, columns]
        has_rim = not bool(inside.all())
        # Also for a draw without a rim, since others of its kind have one.
        if (has_rim or not self.is_exact) and not _holds(image.dtype, fill):
            raise UnitError(
                f"Augment: {name!r} of {image.dtype} cannot hold {fill}, which stands for nothing beyond the rim: "
                + ("convert it with .float(), or call it a number in fields=." if math.isnan(fill) else
                   "convert it with .long() or .float().")
            )  # fmt: skip
        placed = torch.where(inside, taken, torch.tensor(fill).to(taken)) if has_rim else taken
        return placed if signed is None else placed.view(image.dtype)

    def smooth(self, image: Tensor, name: str = "image") -> Tensor:
        """Map an image by linear interpolation, zero beyond the rim; every bin and channel by itself.

        Args:
            image: image (..., H, W).
            name: name of the image, for messages.

        Returns:
            (..., H', W'), as the image.

        Raises:
            UnitError: for whole numbers that would have to be interpolated; exact maps take every type.
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

    def _check_image(self, image: Tensor, name: str) -> None:
        if image.shape[-2:] != self.size:
            height, width = self.size
            raise ShapeError(f"PixelMap: expected {name!r} as (..., {height}, {width}), got {tuple(image.shape)}.")


def _holds(dtype: torch.dtype, fill: float) -> bool:
    if dtype.is_floating_point or dtype.is_complex:
        return True
    least, most = (0, 1) if dtype == torch.bool else (torch.iinfo(dtype).min, torch.iinfo(dtype).max)
    return least <= fill <= most


def _like(matrix: Matrix, tensor: Tensor) -> Tensor:
    return torch.tensor(np.ascontiguousarray(matrix), dtype=tensor.dtype, device=tensor.device)


def _whole(number: int, generator: torch.Generator | None) -> int:
    return int(torch.randint(number, (), generator=generator, device=_device(generator)))


def _device(generator: torch.Generator | None) -> torch.device | None:
    """Return the device of a generator, on which it draws; None without one."""
    return None if generator is None else generator.device
