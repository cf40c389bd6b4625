"""How a random sensor lets gradients through: four policies, and what each gets wrong.

With counts n drawn from a distribution whose mean is m(x), and a loss f:

- `expected`: the value is m, the gradient that of f(m). No noise at all: f(E n) stands for E f(n), which is wrong by
  (1/2) f'' Var n to second order.
- `gaussian`: m + sqrt(v) eps with gradients through m and the variance v. Right for losses up to second order; skewness
  and discreteness are lost, values can be negative, and v near 0 is softened (see `gaussian_noise`).
- `straight_through`: the value is n, the gradient f'(n) dm/dx. Exact for linear losses only: for f = n^2 and Poisson n
  the gradient is short by dm/dx (that of the variance).
- `score`: the value is n, the gradient (f(n) - baseline) d log p(n | x)/dx. Unbiased for every loss, continuous or not;
  high variance, which falls with a baseline.

`score` needs the value of the loss, which no backward pass knows. It is therefore used through a context:

    with ScoreFunction() as score:
        counts = sensor(x, generator=g)              # a sensor with grad="score", or several in a row
        losses = loss_of(counts)                     # (B,): one number per item, or () or (B, C, H, W)
    score.surrogate(losses, baseline="leave_one_out").mean().backward()

Source: Mohamed et al., Monte Carlo gradient estimation in machine learning, JMLR 21 (2020).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from contextvars import ContextVar, Token
from types import TracebackType
from typing import Literal, cast, get_args

import torch
from torch import Tensor

from torchtransient.checks import is_one_of, shown
from torchtransient.errors import ArgumentError, GradientError, ShapeError
from torchtransient.floating import in_single
from torchtransient.sensing.base.layout import check_generator, going_together, reals

GradPolicy = Literal["expected", "gaussian", "straight_through", "score"]
GRAD_POLICIES: tuple[GradPolicy, ...] = get_args(GradPolicy)

# Variance (in counts squared) below which the Gaussian surrogate is softened: sqrt has no slope at 0.
VARIANCE_FLOOR = 1e-4

_ACTIVE: ContextVar[tuple[ScoreFunction, ...]] = ContextVar("active_score_functions", default=())


def check_policy(grad: str, where: str) -> GradPolicy:
    """`grad` when it is one of GRAD_POLICIES, else GradientError."""
    if not is_one_of(grad, GRAD_POLICIES):
        raise ArgumentError(f"{where}: expected grad to be one of {', '.join(GRAD_POLICIES)}, got {shown(grad)}.")
    return cast("GradPolicy", grad)


def standard_normal(like: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Standard normal numbers in the shape, dtype and on the device of `like`."""
    return torch.randn(like.shape, dtype=like.dtype, device=like.device, generator=generator)


@in_single
def gaussian_noise(variance: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Zero-mean normal noise of the given variance (any shape, counts squared), differentiable in the variance.

    The scale is sqrt(v + e) - sqrt(e) with e = VARIANCE_FLOOR: an empty bin stays empty, its gradient is finite (at
    most 50 |eps|), and at v = 1 the variance is 2 % short. Negative variances (rounding) count as 0.
    """
    (variance,) = reals("gaussian_noise", variance=variance)
    check_generator(generator, "gaussian_noise")
    v = variance.clamp_min(0)
    scale: Tensor = (v + VARIANCE_FLOOR).sqrt() - math.sqrt(VARIANCE_FLOOR)
    return scale * standard_normal(v, generator)


def straight_through(sample: Tensor, mean: Tensor) -> Tensor:
    """The values of `sample` with the gradient of `mean`. Exact for losses that are linear in the sample."""
    sample, mean = going_together("straight_through", sample=sample, mean=mean)
    return sample.detach() + (mean - mean.detach())


class ScoreFunction:
    """Collects log-probabilities of what random sensors draw inside the context, and turns losses into surrogates.

    Sensors in a row add their log-probabilities, each given its own input, so chains of random sensors are right too.
    Contexts nest; each thread and task has its own.
    """

    def __init__(self) -> None:
        self._log_probs: list[Tensor] = []
        self._token: Token[tuple[ScoreFunction, ...]] | None = None

    def __enter__(self) -> ScoreFunction:
        self._log_probs.clear()
        self._token = _ACTIVE.set((*_ACTIVE.get(), self))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._token is not None:
            _ACTIVE.reset(self._token)
            self._token = None

    def log_prob(self, shape: tuple[int, ...] | torch.Size) -> Tensor:
        """Sum of the collected log-probabilities over all dimensions behind `shape`.

        Raises ShapeError when `shape` does not begin the shape of what was collected, GradientError when nothing was.
        """
        if not self._log_probs:
            raise GradientError(
                "ScoreFunction: no sensor with grad='score' and a differentiable input ran inside the context, so "
                "there is nothing to differentiate. Run the sensor inside the `with` block."
            )
        parts: list[Tensor] = []
        for value in self._log_probs:
            if tuple(value.shape[: len(shape)]) != tuple(shape):
                raise ShapeError(
                    f"ScoreFunction.surrogate: expected losses whose shape begins that of the log-probabilities "
                    f"{tuple(value.shape)}, got {tuple(shape)}. Reduce the losses to one number per item or pixel."
                )
            parts.append(value.reshape((*shape, -1)).sum(-1))
        return functools.reduce(torch.add, parts)

    def surrogate(self, losses: Tensor, baseline: Tensor | float | Literal["leave_one_out"] | None = None) -> Tensor:
        """The losses, value unchanged, whose gradient is unbiased for the gradient of their expectation.

        `losses`: one number per item, shape () or (B,) or as far as (..., C, H, W); an item may depend only on draws
        that share its leading indices (a per-pixel loss behind crosstalk is biased). `baseline`: what is subtracted
        from the loss in front of the score: a number, a tensor without dependence on the draws, or "leave_one_out":
        the mean of the other items along dimension 0 (independent items, at least 2; unbiased when all items have the
        same expectation or not). Dependence of the loss on anything else keeps its ordinary gradient.
        """
        advantage = losses.detach()
        if isinstance(baseline, str):
            if baseline != "leave_one_out":
                raise ArgumentError(f"ScoreFunction: expected baseline 'leave_one_out' or a number, got {baseline!r}.")
            if losses.ndim == 0 or losses.shape[0] < 2:
                raise ShapeError(
                    f"ScoreFunction: leave_one_out needs at least 2 items along dimension 0, got {tuple(losses.shape)}."
                )
            count = losses.shape[0]
            advantage = (advantage * count - advantage.sum(0, keepdim=True)) / (count - 1)
        elif baseline is not None:
            advantage = advantage - (baseline.detach() if isinstance(baseline, Tensor) else baseline)
        log_prob = self.log_prob(losses.shape)
        return losses + (advantage * (log_prob - log_prob.detach())).to(losses.dtype)


def record_score(log_prob: Callable[[], Tensor], where: str) -> None:
    """Hand a log-probability, shape (..., C, H, W), to the innermost ScoreFunction. For sensors with grad="score".

    `log_prob` is called only if a gradient is wanted. Raises GradientError when it is and no context is open: the
    gradient would silently be zero otherwise.
    """
    if not torch.is_grad_enabled():
        return
    value = log_prob()
    if not value.requires_grad:
        return
    active = _ACTIVE.get()
    if not active:
        raise GradientError(
            f"{where}: grad='score' needs the value of the loss. Call the sensor inside `with ScoreFunction() as "
            "score:` and differentiate score.surrogate(losses), or choose another grad policy."
        )
    active[-1]._log_probs.append(value)
