"""What draws maps of pixels: flips, quarter turns, crops, and kornia's affine augmentations."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch

from torchtransient.checks import count, is_one_of, share, shown
from torchtransient.data.augmentation.pixel_map import PixelMap
from torchtransient.errors import ArgumentError, SceneError, ShapeError

Direction = Literal["horizontal", "vertical"]


class Operation(abc.ABC):
    """Draws a map of the pixels of an image: the base of one's own operations, which have :meth:`draw` alone."""

    @abc.abstractmethod
    def draw(self, size: tuple[int, int], generator: torch.Generator | None) -> PixelMap | None:
        """A :class:`~torchtransient.data.PixelMap` for images of ``size`` (height, width), with that as its ``size``;
        None to leave them. ``generator``: to draw with, None for torch's own.
        """


@dataclass(frozen=True)
class Flip(Operation):
    """Mirrors images, ``"horizontal"`` (left and right) or ``"vertical"``, with the probability ``p``."""

    direction: Direction = "horizontal"
    p: float = 0.5

    def __post_init__(self) -> None:
        if not is_one_of(self.direction, get_args(Direction)):
            raise ArgumentError(f"Flip: expected 'horizontal' or 'vertical', got {shown(self.direction)}.")
        share("Flip: p", self.p)

    def draw(self, size: tuple[int, int], generator: torch.Generator | None) -> PixelMap | None:
        """Exact: pixels come to lie on pixels."""
        if not _happens(self.p, generator):
            return None
        matrix = np.eye(3)
        axis = 0 if self.direction == "horizontal" else 1
        matrix[axis, axis], matrix[axis, 2] = -1.0, size[1 - axis] - 1.0
        return PixelMap(matrix, size, size)


@dataclass(frozen=True)
class QuarterTurn(Operation):
    """Turns images by quarters of a turn, counterclockwise: one of ``turns``, drawn evenly. Images that are not square
    change their shape with odd numbers.
    """

    turns: Sequence[int] = (0, 1, 2, 3)

    def __post_init__(self) -> None:
        given = list(self.turns) if isinstance(self.turns, Sequence) else [self.turns]
        if not given:
            raise ArgumentError("QuarterTurn: expected numbers of quarter turns, got none.")
        object.__setattr__(self, "turns", tuple(count("QuarterTurn: turns", one, -3) % 4 for one in given))

    def draw(self, size: tuple[int, int], generator: torch.Generator | None) -> PixelMap | None:
        """Exact: pixels come to lie on pixels."""
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
    """A window of ``size`` (height, width) pixels, at ``offset`` (first row, first column); None: anywhere."""

    size: Sequence[int]
    offset: Sequence[int] | None = None

    def __post_init__(self) -> None:
        for name, least in (("size", 1), ("offset", 0)):
            given = getattr(self, name)
            if given is None and name == "offset":
                continue
            if not isinstance(given, Sequence) or len(given) != 2:
                raise ShapeError(f"Crop: expected {name} as two numbers of pixels, got {shown(given)}.")
            object.__setattr__(self, name, tuple(count(f"Crop: {name}", one, least, ShapeError) for one in given))

    def draw(self, size: tuple[int, int], generator: torch.Generator | None) -> PixelMap | None:
        """Exact. Raises ShapeError for a window that is not all on the image."""
        height, width = self.size
        row, column = self.offset or (0, 0)
        if row + height > size[0] or column + width > size[1]:
            raise ShapeError(f"Crop: {height} x {width} pixels at {(row, column)} do not fit into an image of {size}.")
        if self.offset is None:
            row, column = _whole(size[0] - height + 1, generator), _whole(size[1] - width + 1, generator)
        matrix = np.array([[1.0, 0, -column], [0, 1, -row], [0, 0, 1]])
        return PixelMap(matrix, size, (height, width))


class Affine(Operation):
    """The maps that a geometric augmentation of kornia draws, ``kornia.augmentation.RandomAffine(...)``,
    ``RandomRotation``, ``RandomShear``, ``RandomTranslate``, flips. Images keep their size.

    Its settings of interpolation and rim do not count: light is interpolated linearly and labels are taken from the
    nearest pixel, with nothing beyond the rim. Raises ArgumentError for what is no affine augmentation, UnitError for
    a map without an inverse when it is drawn.
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
        """Not exact. Kornia draws from torch's own generator, which stays where it was if another one is given."""
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


def _whole(number: int, generator: torch.Generator | None) -> int:
    return int(torch.randint(number, (), generator=generator, device=_device(generator)))


def _happens(p: float, generator: torch.Generator | None) -> bool:
    return bool(torch.rand((), generator=generator, device=_device(generator)) < p)


def _device(generator: torch.Generator | None) -> torch.device | None:
    """A generator draws where it is."""
    return None if generator is None else generator.device
