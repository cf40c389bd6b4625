"""Central differences with common random numbers: the yardstick for every gradient of the library.

Both sides of a difference use the same seed, so that most of the noise cancels; the error that is left is measured over
independent seeds. Where a path jumps between the two sides (a silhouette, a box filter's bin edge) the variance grows
like 1 / step: take a step that spans many such events, or more seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchtransient.accuracy.statistics import ZTest, standard_error, two_sample_z_test
from torchtransient.errors import ShapeError, UnitError

Array = NDArray[np.float64]
Render = Callable[[float, int], ArrayLike]


@dataclass(frozen=True)
class Derivative:
    """A derivative by finite differences: `per_seed` (K, ...) in the shape of what was rendered, and the `step` that
    was used."""

    per_seed: Array
    step: float

    @property
    def mean(self) -> Array:
        """Mean over the seeds, shape (...)."""
        return np.asarray(self.per_seed.mean(axis=0), dtype=np.float64)

    @property
    def standard_error(self) -> Array:
        """Standard error of `mean` over the seeds, shape (...). Does not contain the truncation error of the step."""
        return standard_error(self.per_seed)

    def compare(self, gradients: ArrayLike, alpha: float = 1e-3, rounding: float = 0.0) -> ZTest:
        """Welch's test of gradients from independent runs (M, ...), M >= 2, against these differences."""
        return two_sample_z_test(gradients, self.per_seed, alpha, rounding)


def central_difference(
    render: Render, value: float, step: float, seeds: Sequence[int], richardson: bool = False
) -> Derivative:
    """d render(value, seed) / d value at `value`, from render(value + step, seed) - render(value - step, seed), per
    seed.

    `render(x, seed)` returns a number or an array of any fixed shape. `richardson=True` renders twice as often, at
    `step` and `step / 2`, and cancels the error of second order: (4 D(step / 2) - D(step)) / 3. At least two different
    seeds (UnitError otherwise, since no error can be told). For the derivative with respect to a direction in many
    parameters, let `value` be the coordinate along it.
    """
    if not step > 0.0:
        raise UnitError(f"step: expected a number greater than zero, got {step!r}")
    if len(set(seeds)) < 2 or len(set(seeds)) != len(seeds):
        raise UnitError(f"seeds: expected at least two, all different, got {list(seeds)}")
    slopes = []
    for seed in seeds:
        slope = _slope(render, value, step, seed)
        if richardson:
            slope = (4.0 * _slope(render, value, step / 2.0, seed) - slope) / 3.0
        slopes.append(slope)
    return Derivative(np.stack(slopes), step)


def _slope(render: Render, value: float, step: float, seed: int) -> Array:
    above = np.asarray(render(value + step, seed), dtype=np.float64)
    below = np.asarray(render(value - step, seed), dtype=np.float64)
    if above.shape != below.shape:
        raise ShapeError(f"render: expected one shape on both sides of the step, got {above.shape} and {below.shape}")
    return (above - below) / (2.0 * step)
