"""Crosstalk: detections that trigger neighbouring pixels."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchtransient.errors import UnitError
from torchtransient.floating import in_single
from torchtransient.sensing.added_counts import AddedCounts
from torchtransient.sensing.draws import by_pieces
from torchtransient.sensing.layout import check_number, check_transient
from torchtransient.sensing.policies import GradPolicy
from torchtransient.sensing.thinning import sixteen_bits, thin

_EDGES = ((-1, 0), (1, 0), (0, -1), (0, 1))
_CORNERS = ((-1, -1), (-1, 1), (1, -1), (1, 1))
_MOST = 0.25  # of each of four neighbours: one detection may trigger one other
_BLOCK = 1 << 15  # entries at a time, so that temporaries stay in the cache
_VALUES = 1 << 16  # of a 16 bit number
_CELLS = 1 << 12  # of the table that they are looked up in: small enough to make for every call


@in_single
def add_crosstalk(
    counts: Tensor, probability: Tensor | float, diagonal: Tensor | float = 0.0, *, only_added: bool = False
) -> Tensor:
    """Mean histogram with optical crosstalk: each detection triggers each of the 4 neighbours with `probability`.

    `diagonal`: the same for the 4 neighbours across a corner. No delay: crosstalk takes less than a bin. What leaves
    the rim of the sensor is lost. First order: crosstalk of crosstalk is left out. (..., C, T, H, W), dtype kept.
    """
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
    return added if only_added else counts + added


class Crosstalk(AddedCounts):
    """Crosstalk between pixels, on counts, behind the SPAD; see `add_crosstalk`. `learnable`: `logit_probability`.

    `diagonal_ratio`: probability across a corner over that across an edge.
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
        if learnable:
            self.register_parameter("logit_probability", nn.Parameter(tensor))
        else:
            self.register_buffer("logit_probability", tensor)

    @property
    def probability(self) -> Tensor:
        """Of one neighbour per detection, float64."""
        return self.logit_probability.double().sigmoid()

    def _probabilities(self) -> tuple[Tensor, Tensor | float]:
        """Of an edge and of a corner."""
        p = self.probability
        if not bool(p.detach() <= _MOST * (1 + 1e-9)):
            raise UnitError(
                f"Crosstalk: expected probability in (0, {_MOST:g}], got {float(p.detach()):g}. If it is learnt, lower "
                "the learning rate."
            )
        return p, p * self.diagonal_ratio if self.diagonal_ratio > 0 else 0.0

    @in_single
    def extra(self, x: Tensor) -> Tensor:
        return add_crosstalk(x, *self._probabilities(), only_added=True)

    def variance(self, x: Tensor) -> Tensor:
        near, far = self._probabilities()
        return add_crosstalk(x, near * (1 - near), far * (1 - far), only_added=True)

    def share(self) -> float:
        return 4 * float(self.probability) * (1 + self.diagonal_ratio)

    def trigger(self, counts: Tensor, generator: torch.Generator | None) -> Tensor:
        check_transient(counts, "Crosstalk")
        near, far = (float(p) for p in self._probabilities())
        neighbours = [(step, near) for step in _EDGES] + [(step, far) for step in _CORNERS if far > 0]
        *_, height, width = counts.shape
        wide = width + 2
        steps = [dy * wide + dx for (dy, dx), _ in neighbours]
        sets = _Neighbours(steps, [p for _, p in neighbours], counts.device)

        frames = counts.reshape(-1, height, width)
        result = torch.empty_like(frames, memory_format=torch.contiguous_format)
        one = torch.ones(1, dtype=counts.dtype, device=counts.device)

        def follow(piece: Tensor, begin: int, own: torch.Generator | None) -> None:
            """Add to images with a rim what the detections of some frames trigger, and cut the rim off."""
            total = torch.nn.functional.pad(piece, (1, 1, 1, 1))
            events = thin(piece, sets.any, own)
            row = events.place.div(width, rounding_mode="floor")
            frame = row.div(height, rounding_mode="floor")
            place = events.place + (row * 2).add_(frame, alpha=2 * wide).add_(wide + 1)
            for block in range(0, place.numel(), _BLOCK):
                at = slice(block, block + _BLOCK)
                start = place[at].repeat_interleave(events.number[at].long())
                for reached in sets.reached(start, own):
                    total.view(-1).scatter_add_(0, reached, one.expand(reached.shape))
            result[begin : begin + piece.shape[0]] = total[:, 1:-1, 1:-1]

        by_pieces(follow, frames, generator)
        return result.view(counts.shape)


class _Neighbours:
    """Which neighbours a detection triggers, given that it triggers any: sets of bits 1, 2, 4, ...

    Nearly always it is one neighbour, and 16 random bits tell which; the others are looked at more closely.
    """

    def __init__(self, steps: list[int], probabilities: list[float], device: torch.device) -> None:
        subset = torch.arange(1, 2 ** len(probabilities))
        chance = torch.ones(subset.shape, dtype=torch.float64)
        for k, p in enumerate(probabilities):
            chance *= torch.where((subset >> k) & 1 > 0, p, 1 - p)
        self.any = float(chance.sum())
        # set number m + 1 ends where the uniform number is edges[m]; the last ends at 1
        edges = (chance.cumsum(0) / chance.sum())[:-1]
        self._edges = edges.to(device)
        self._steps = steps
        # by the first 12 bits of the uniform number: the step to the only neighbour, 0 if they do not tell
        starts = torch.arange(_CELLS + 1, dtype=torch.float64) / _CELLS
        first = torch.bucketize(starts[:-1], edges, right=True) + 1
        last = torch.bucketize(starts[1:], edges) + 1
        only = torch.zeros(2 ** len(steps), dtype=torch.int64)
        only[[1 << k for k in range(len(steps))]] = torch.tensor(steps)
        # numbers are signed: cell 0 is the lowest
        self._only = torch.where(first == last, only[first], 0).roll(-_CELLS // 2).to(device)

    def reached(self, start: Tensor, generator: torch.Generator | None) -> list[Tensor]:
        """Flat indices reached from detections at `start` (K,), in several tensors."""
        bits = sixteen_bits(start, generator)
        step = self._only[bits.long().bitwise_and_(_VALUES - 1).bitwise_right_shift_(4)]
        unsure = (step == 0).nonzero().squeeze(-1)
        value = bits[unsure].double().add_(_VALUES / 2)
        u = torch.rand(unsure.shape, dtype=torch.float64, device=start.device, generator=generator)
        subset = torch.bucketize(value.add_(u).div_(_VALUES), self._edges, right=True) + 1
        origin = start[unsure]
        # a set that is not told yet points to the rim, which nobody sees
        found = [torch.where(step != 0, start + step, 0)]
        found += [origin[(subset >> k) & 1 > 0] + distance for k, distance in enumerate(self._steps)]
        return found
