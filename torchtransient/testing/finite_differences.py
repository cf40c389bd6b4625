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
    """Derivative by finite differences.

    Attributes:
        per_seed: derivative of each seed, (K, ...), in the shape of one render.
        step: half the distance of the two renders, in units of the parameter.
    """

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
        """Compare gradients of independent runs with these differences by Welch's test.

        Args:
            gradients: gradients of independent runs, (M, ...), M >= 2.
            alpha: probability that right gradients fail.
            rounding: absolute error that is forgiven.

        Raises:
            ShapeError: if the shapes of one run differ, or M < 2.
        """
        return two_sample_z_test(gradients, self.per_seed, alpha=alpha, rounding=rounding)


def central_difference(
    render: Render, value: float, step: float, seeds: Sequence[int], richardson: bool = False
) -> Derivative:
    """Differentiate a render by one number: (render(value + step, seed) - render(value - step, seed)) / (2 step).

    Args:
        render: `render(x, seed)` returns a number or an array of one shape.
        value: number at which the derivative is taken; the coordinate along a direction in many parameters.
        step: half the distance of the two renders, in units of `value`.
        seeds: two or more different seeds; both renders of a difference use the same one.
        richardson: render at `step / 2` too, and cancel the error of second order, (4 D(step / 2) - D(step)) / 3.

    Returns:
        The derivative of each seed.

    Raises:
        UnitError: if `step` is not positive, or there are fewer than two different seeds, which leave no error.
        ShapeError: if the shape of a render depends on `x`.
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
