"""Samples in memory: their arrays, their light outside of the time window, and the generators that belong to them."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.checks import count, shown
from torchtransient.errors import PhysicsWarning, ShapeError, TorchTransientWarning, UnitError, level_of_user

# Least size of arrays that are copied in blocks, and pixels of a block.
_LARGE, _BLOCK = 2**15, 64
# Share of light outside of the window above which a sample counts as cut.
CUT = 0.01
# Quantile of the normal distribution for an interval of 95 %.
_Z = 1.96


@dataclass(frozen=True, eq=False)
class Sample:
    """Sample of a recipe.

    ``arrays`` are in torch's layout: ``transient`` float32 (C, T, H, W) or ``phasor`` complex64 (C, F, H, W), ``gated``
    (C, G, H, W), ``rates`` (C, R, T, H, W), ``beats`` (C, 2, T, H, W), ``steady`` (C, H, W), labels, ``measurement``;
    leading dimensions as in :class:`~torchtransient.RenderOutput`; a capture has its scan's shape behind T.

    Args:
        index: number of the sample in the recipe, from 0.
        seed: seed of the render, 0 to 2^32 - 1.
        arrays: arrays by name.
        values: drawn values by key, numbers as arrays, everything else as a text.
        outside: shares of the light before and after the window.
        structure: scene of the recipe that it is made of.
    """

    index: int
    seed: int
    _: KW_ONLY
    arrays: dict[str, NDArray[Any]]
    values: dict[str, NDArray[Any] | str] = field(default_factory=dict)
    outside: tuple[float, float] = (0.0, 0.0)
    structure: str = ""

    def __repr__(self) -> str:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in self.arrays.items())
        return f"Sample({self.index}: {shapes}; drawn: {', '.join(self.values) or 'nothing'})"


@dataclass(frozen=True)
class OutsideLight:
    """Light outside of the time window, over some samples of a recipe.

    Args:
        samples: number of samples; 0 for films without a window.
        cut: number of samples with more than 1 % of their light outside.
        mean: mean share of the light outside, over samples.
        most: largest share.
        failed: number of samples that could not be rendered.
        reason: reason of the first failure.
    """

    _: KW_ONLY
    samples: int
    cut: int
    mean: float
    most: float
    failed: int = 0
    reason: str = ""

    @classmethod
    def of(cls, shares: Iterable[Sequence[float]], failed: Sequence[str] = ()) -> Self:
        """Summarize samples.

        Args:
            shares: shares of the light of each sample before and after the window.
            failed: reasons of samples that could not be rendered.

        Returns:
            OutsideLight.
        """
        missed = np.array([sum(pair) for pair in shares], dtype=np.float64)
        reason = failed[0] if failed else ""
        if not len(missed):
            return cls(samples=0, cut=0, mean=0.0, most=0.0, failed=len(failed), reason=reason)
        mean, most, cut = float(missed.mean()), float(missed.max()), int((missed > CUT).sum())
        return cls(samples=len(missed), cut=cut, mean=mean, most=most, failed=len(failed), reason=reason)

    @property
    def expected(self) -> tuple[float, float]:
        """Share of cut samples among all of the recipe: ends of its 95 % interval (Wilson 1927)."""
        if not self.samples:
            return 0.0, 1.0
        n, p = self.samples, self.cut / self.samples
        middle, half = p + _Z**2 / (2 * n), _Z * math.sqrt(p * (1 - p) / n + _Z**2 / (4 * n**2))
        low, high = ((middle + sign * half) / (1 + _Z**2 / n) for sign in (-1, 1))
        return max(low, 0.0) if self.cut else 0.0, min(high, 1.0) if self.cut < n else 1.0

    def shares(self) -> str:
        """Return the figures of these samples as text."""
        if not self.samples:
            return "not looked at"
        return (
            f"more than {CUT:.0%} in {self.cut} of {self.samples} samples, {self.mean:.2%} on average, {self.most:.2%} "
            "at most"
        )

    def __str__(self) -> str:
        text = self.shares()
        if self.samples:
            low, high = self.expected
            text += f"; more than {CUT:.0%} in {low:.1%} to {high:.1%} of all samples (95% confidence)"
        return text + (f"; {self.failed} of {self.failed + self.samples} samples failed" if self.failed else "")

    def warn(self, what: str) -> None:
        """Warn of cut samples (PhysicsWarning) and of failed ones (TorchTransientWarning).

        Args:
            what: caller for messages.
        """
        if self.failed:
            warnings.warn(
                f"{what}: {self.failed} of {self.failed + self.samples} samples that were looked at failed and do not "
                f"count in the light outside of the time window. The first one: {self.reason}",
                TorchTransientWarning,
                level_of_user(),
            )
        if self.cut:
            warnings.warn(
                f"{what}: light outside of the time window: {self}. Samples are kept all the same, each with its "
                "shares under 'outside'. A time_axis= that starts earlier or has more bins holds more.",
                PhysicsWarning,
                level_of_user(),
            )


class Epochs:
    """Data set with an epoch, which persistent workers of a DataLoader receive too.

    An index may be (number, passes): a sample of so many epochs later, as ``tt.training.Batches`` asks for.
    """

    takes_passes = True

    def __init__(self) -> None:
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()  # type: ignore[no-untyped-call]

    def sample(self, number: int, epoch: int | None = None) -> Any:
        """Return a sample.

        Args:
            number: number of the sample in the data set, from 0; negative ones count from the end.
            epoch: number of the epoch, which distinguishes the draws of epochs; None is 0.
        """
        raise NotImplementedError

    def __getitem__(self, number: int | tuple[int, int]) -> Any:
        number, passes = number if isinstance(number, tuple) else (number, 0)
        return self.sample(number, self.epoch + passes)

    @property
    def epoch(self) -> int:
        """Epoch of samples that are read by number."""
        return int(self._epoch)

    def set_epoch(self, epoch: int) -> None:
        """Choose the draws of ``seed`` for samples that are read from now on; call it before iterating over a loader.

        Args:
            epoch: number of the epoch, from 0.

        Raises:
            UnitError: for other numbers.
        """
        self._epoch.fill_(count(f"{type(self).__name__}: epoch", epoch, 0, UnitError))


def in_order(tensor: torch.Tensor) -> NDArray[Any]:
    """Return a tensor as an array in C order. Films have the pixels first in memory and torch has them last: large
    arrays are copied in blocks, since a copy from end to end meets one line of the cache again and again where bins are
    a power of two.

    Args:
        tensor: tensor of any shape.

    Returns:
        Array of the same shape.
    """
    array: NDArray[Any] = tensor.cpu().numpy()
    pixels = array.shape[-1] * array.shape[-2] if array.ndim > 2 else 0
    if array.flags.c_contiguous or array.size < _LARGE or pixels < _BLOCK:
        return np.ascontiguousarray(array)
    found = np.empty(array.shape, array.dtype)
    target = found.reshape(*array.shape[:-2], pixels)
    try:
        source = tensor.view(target.shape).cpu().numpy()
    except RuntimeError:
        # Rows and columns do not form one axis in memory.
        return np.ascontiguousarray(array)
    for first in range(0, pixels, _BLOCK):
        target[..., first : first + _BLOCK] = source[..., first : first + _BLOCK]
    return found


def sample_number(what: str, number: Any, size: int) -> int:
    """Return the place of a sample, negative numbers counted from the end.

    Args:
        what: caller for messages.
        number: number of the sample.
        size: number of samples in the data set.

    Returns:
        0 to ``size`` - 1.

    Raises:
        IndexError: for other numbers, as loops over a data set expect it.
    """
    try:
        found = count(what, number, -size)
    except ValueError:
        found = size
    if not found < size:
        raise IndexError(f"{what}: expected a number from 0 to {size - 1}, got {shown(number)}.")
    return found % size


def outside_tensor(shares: Any) -> Tensor:
    """Return shares of light before and after the window as a tensor.

    Args:
        shares: two numbers.

    Returns:
        float64 (2,).
    """
    return torch.tensor([float(share) for share in shares], dtype=torch.float64)


def checked_seed(what: str, seed: Any) -> int | None:
    """Check a seed.

    Args:
        what: caller for messages.
        seed: whole number from 0 on, or None.

    Returns:
        The seed.

    Raises:
        UnitError: for other seeds.
    """
    return None if seed is None else count(f"{what}: seed", seed, 0, UnitError, None)


def sample_generator(what: str, seed: int | None, number: int, epoch: Any = None, *more: int) -> torch.Generator | None:
    """Return the generator of one sample in one epoch: the same draws in every process.

    Args:
        what: caller for messages.
        seed: seed of the draws; None for no generator.
        number: number of the sample.
        epoch: number of the epoch; None is 0.
        more: further numbers that distinguish samples.

    Returns:
        Generator, or None.

    Raises:
        UnitError: for other epochs.
    """
    places = [] if epoch is None else [count(f"{what}: epoch", epoch, 0, UnitError)]
    if seed is None:
        return None
    key = np.random.SeedSequence([seed, number, *places, *more])
    return torch.Generator().manual_seed(int(key.generate_state(1, np.uint64)[0] >> np.uint64(1)))


def value_tensors(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return drawn values as tensors of the caller's own; texts stay texts.

    Args:
        values: drawn values of a sample by key.

    Returns:
        Tensors and texts by key.
    """
    return {key: v if isinstance(v, str) else torch.from_numpy(np.array(v)) for key, v in values.items()}


def measurement(
    what: str, transform: Callable[..., Any], sample: Mapping[str, Any], generator: torch.Generator | None = None
) -> Any:
    """Transform the transient of a sample, without gradients.

    Args:
        what: caller for messages.
        transform: function or module.
        sample: tensors by name.
        generator: random generator; None takes torch's own.

    Returns:
        Result of the transform.

    Raises:
        ShapeError: for a sample without a transient.
    """
    if "transient" not in sample:
        raise ShapeError(f"{what}: transform= is for transients, and samples have {', '.join(sample)}.")
    with torch.no_grad():
        if generator is None:
            return transform(sample["transient"])
        return transform(sample["transient"], generator=generator)
