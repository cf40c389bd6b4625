"""Optical crosstalk: detections that trigger neighbouring pixels."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchtransient.errors import UnitError
from torchtransient.floating import in_single
from torchtransient.sensing.checks import check_number, check_transient, one_number
from torchtransient.sensing.counts import AddedCounts
from torchtransient.sensing.draws import add_passing, by_pieces
from torchtransient.sensing.parameters import keep_number
from torchtransient.sensing.sensor import GradPolicy

_EDGES = ((-1, 0), (1, 0), (0, -1), (0, 1))
_CORNERS = ((-1, -1), (-1, 1), (1, -1), (1, 1))
_MOST = 0.25  # of each of four neighbours: one detection may trigger one other
_BLOCK = 1 << 17  # entries at a time, so that temporaries stay in the cache


@in_single
def add_crosstalk(counts: Tensor, probability: Tensor | float, diagonal: Tensor | float = 0.0) -> Tensor:
    """Mean histogram with optical crosstalk: each detection triggers each of its neighbours with a probability.

    Without delay: crosstalk takes less than a bin. Counts across the rim of the sensor are lost. First order: crosstalk
    of crosstalk is left out. Differentiable in all three.

    Args:
        counts: (..., C, T, H, W).
        probability: probability of each of the 4 neighbours across an edge.
        diagonal: probability of each of the 4 neighbours across a corner.

    Returns:
        Shape and dtype of `counts`.
    """
    near = one_number(probability, "probability", "add_crosstalk")
    return counts + _crosstalk(counts, near, one_number(diagonal, "diagonal", "add_crosstalk"))


@in_single
def _crosstalk(counts: Tensor, probability: Tensor | float, diagonal: Tensor | float) -> Tensor:
    """Mean of the counts added."""
    check_transient(counts, "add_crosstalk")
    near = torch.as_tensor(probability, device=counts.device).to(counts.dtype)
    far = torch.as_tensor(diagonal, device=counts.device).to(counts.dtype)
    padded = torch.nn.functional.pad(counts, (1, 1, 1, 1))
    height, width = counts.shape[-2:]

    def seen(dy: int, dx: int) -> Tensor:
        return padded[..., 1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]

    added = near * (seen(-1, 0) + seen(1, 0) + seen(0, -1) + seen(0, 1))
    if far.requires_grad or bool(far != 0):
        added = added + far * (seen(-1, -1) + seen(-1, 1) + seen(1, -1) + seen(1, 1))
    return added


class Crosstalk(AddedCounts):
    """Crosstalk between pixels, on counts, behind the SPAD; see `add_crosstalk`.

    Args:
        probability: probability of each neighbour across an edge, in (0, 0.25].
        diagonal_ratio: probability across a corner over that across an edge, in [0, 1].
        learnable: make `logit_probability` a parameter.
        grad: gradient policy.

    Raises:
        UnitError: for values outside of their ranges.
    """

    logit_probability: Tensor

    def __init__(
        self,
        probability: float,
        *,
        diagonal_ratio: float = 0.0,
        learnable: bool = False,
        grad: GradPolicy = "expected",
    ) -> None:
        super().__init__(grad)
        p = check_number(probability, "probability", "Crosstalk", high=_MOST, open_low=True)
        self.diagonal_ratio = check_number(diagonal_ratio, "diagonal_ratio", "Crosstalk", high=1.0)
        tensor = torch.tensor(math.log(p / (1 - p)), dtype=torch.float64)
        keep_number(self, "logit_probability", tensor, learnable)

    @property
    def probability(self) -> Tensor:
        """Probability for one neighbour across an edge, float64."""
        return self.logit_probability.double().sigmoid()

    def _probabilities(self) -> tuple[Tensor, Tensor | float]:
        """Probabilities across an edge and across a corner."""
        p = self.probability
        if not bool(p <= _MOST * (1 + 1e-9)):
            raise UnitError(
                f"Crosstalk: expected probability in (0, {_MOST:g}], got {float(p.detach()):g}. If it is "
                "learnt, lower the learning rate."
            )
        return p, p * self.diagonal_ratio if self.diagonal_ratio > 0 else 0.0

    def extra(self, x: Tensor) -> Tensor:
        return _crosstalk(x, *self._probabilities())

    def variance(self, x: Tensor) -> Tensor:
        near, far = self._probabilities()
        return _crosstalk(x, near * (1 - near), far * (1 - far))

    def share(self) -> float:
        return 4 * float(self.probability.detach()) * (1 + self.diagonal_ratio)

    def trigger(self, counts: Tensor, generator: torch.Generator | None) -> Tensor:
        check_transient(counts, "Crosstalk")
        *_, height, width = counts.shape
        frames = counts.reshape(-1, height, width)
        result = frames.clone(memory_format=torch.contiguous_format)
        near, far = self._probabilities()
        rings = [(_EDGES, float(near.detach())), (_CORNERS, float(far.detach()) if isinstance(far, Tensor) else far)]
        together = max(_BLOCK // max(height * width, 1), 1)

        def follow(piece: Tensor, begin: int, own: torch.Generator | None) -> None:
            """Add crosstalk to the frames of a piece, one draw for all neighbours at one distance."""
            for first in range(0, piece.shape[0], together):
                rimmed = torch.nn.functional.pad(piece[first : first + together], (1, 1, 1, 1))
                into = result[begin + first : begin + first + rimmed.shape[0]]
                for ring, p in rings:
                    if p > 0:
                        near = torch.zeros_like(into)
                        for y, x in ring:
                            near += rimmed[:, 1 + y : 1 + y + height, 1 + x : 1 + x + width]
                        add_passing(near, p, into, own)

        by_pieces(follow, frames, generator)
        return result.view(counts.shape)
