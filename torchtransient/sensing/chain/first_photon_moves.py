"""First photons of a cycle and what moves their time stamps, drawn at once.

A cycle has one detection at most, so that counts whose detections move by themselves are multinomial again, with the
moved probabilities: one draw of `sample_multinomial` instead of one for every place that a detection may go to.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchtransient.sensing.base.layout import TIME, check_generator
from torchtransient.sensing.base.policies import GradPolicy, record_score, straight_through
from torchtransient.sensing.counts.moved_counts import MovedCounts
from torchtransient.sensing.numerics.draws import sample_multinomial
from torchtransient.sensing.spad.spad import SynchronousSPAD, multinomial_noise
from torchtransient.sensing.timing.tdc import TDC


def moving_together(
    stages: Sequence[nn.Module], *, policy: bool
) -> tuple[SynchronousSPAD, list[MovedCounts]] | None:
    """The SPAD that a chain begins with and the moves behind it, where they can be drawn at once; None elsewhere.

    `policy`: only if all have the same gradient policy, and one that draws.
    """
    spad = stages[0]
    if not isinstance(spad, SynchronousSPAD) or type(spad) is not SynchronousSPAD or spad.dead_bins is not None:
        return None
    moves: list[MovedCounts] = []
    for stage in stages[1:]:
        if not isinstance(stage, MovedCounts) or (isinstance(stage, TDC) and stage.acts_on == "rates"):
            break
        moves.append(stage)
    same = not policy or (spad.grad != "expected" and all(m.grad == spad.grad for m in moves))
    return (spad, moves) if moves and same and not any(_watched(s) for s in (spad, *moves)) else None


def _watched(stage: nn.Module) -> bool:
    """Whether somebody wants to see what goes in and comes out."""
    return bool(stage._forward_hooks or stage._forward_pre_hooks or stage._backward_hooks)


def moved_probabilities(spad: SynchronousSPAD, moves: Sequence[MovedCounts], x: Tensor) -> Tensor:
    """Probability of each time stamp in a cycle, in single precision at least."""
    p = spad.probabilities(x)
    for stage in moves:
        p = stage.expected(p)
    return p


def moved_first_photons(
    spad: SynchronousSPAD,
    moves: Sequence[MovedCounts],
    x: Tensor,
    generator: torch.Generator | None,
    policy: GradPolicy | None = None,
) -> Tensor:
    """The measurement behind a SPAD and its moves under a policy; None: a draw without gradient."""
    check_generator(generator, type(spad).__name__)
    p = moved_probabilities(spad, moves, x)
    if policy == "gaussian":
        return p * spad.cycles + multinomial_noise(p, spad.cycles, generator)
    with torch.no_grad():
        counts = sample_multinomial(spad.cycles, p, generator)
    if policy == "straight_through" and torch.is_grad_enabled():
        counts = straight_through(counts, p * spad.cycles)
    elif policy == "score":
        record_score(lambda: multinomial_log_prob(counts, p, spad.cycles), type(spad).__name__)
    return counts


def multinomial_log_prob(counts: Tensor, probabilities: Tensor, trials: int) -> Tensor:
    """Log-probability of multinomial counts (..., T, H, W) and the trials without one: (..., H, W), float64.

    Gradients are finite at probability 0 with count 0; a count there has log-probability -inf.
    """
    n, p = counts.detach().double(), probabilities.double()
    none, rest = trials - n.sum(TIME), 1 - p.sum(TIME)
    value = (n * torch.where(n > 0, p, 1.0).log()).sum(TIME)
    # probabilities that add up to one leave rounding of either sign
    rest = rest.clamp_min(1e-18)
    counted = torch.lgamma(none + 1) + torch.lgamma(n + 1).sum(TIME)
    return value + none * rest.log() - counted + torch.lgamma(n.new_tensor(trials + 1.0))
