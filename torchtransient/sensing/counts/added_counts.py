"""The base of sensors that add detections no photon made to those they are given."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchtransient.errors import UnitError
from torchtransient.sensing.base.layout import TIME, check_transient
from torchtransient.sensing.base.policies import record_score
from torchtransient.sensing.base.sensor import RandomSensor
from torchtransient.sensing.counts.shot_noise import poisson_log_prob
from torchtransient.sensing.numerics.draws import WHOLE_FLOAT32, fast_poisson, parallel_map

# Events per entry, on average, above which following them one by one is given up for Poisson numbers.
_MOST_EVENTS = 16
_BLOCK = 1 << 16  # entries at a time, so that temporaries stay in the cache
_PIECES = 4
_WORTH_THREADS = 1 << 17  # entries, above which threads cost less than they save


def look_at_items(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Which items (C, T, H, W) of a batch hold whole numbers >= 0 alone, and their sums: two (..., 1, 1, 1, 1).

    Item by item, so that an item is drawn or not whatever is beside it in a batch. Sums are float64.
    """
    shape = (*counts.shape[:-4], 1, 1, 1, 1)
    rows = counts.reshape(math.prod(shape), math.prod(counts.shape[-4:]))
    large = counts.device.type == "cpu" and counts.numel() >= _WORTH_THREADS
    found = parallel_map(_look_at_rows, rows.tensor_split(_PIECES, 1)) if large else [_look_at_rows(rows)]
    whole, total = found[0]
    for also, more in found[1:]:
        whole, total = whole & also, total + more
    return whole.view(shape), total.view(shape)


def _look_at_rows(rows: Tensor) -> tuple[Tensor, Tensor]:
    whole, total = rows.new_ones(rows.shape[0], dtype=torch.bool), rows.new_zeros(rows.shape[0], dtype=torch.float64)
    with torch.no_grad():  # grad mode is per thread
        for block in torch.split(rows, max(_BLOCK // max(rows.shape[0], 1), 1), 1):
            total += block.sum(1)
            nearest = block.round().clamp_min_(0)
            if not torch.equal(nearest, block):
                whole &= (nearest == block).all(1)
    return whole, total


def whole_items(counts: Tensor) -> Tensor:
    """(..., 1, 1, 1, 1): which items of a batch hold whole numbers >= 0 alone; see `look_at_items`."""
    return look_at_items(counts)[0]


class AddedCounts(RandomSensor):
    """A sensor that adds counts n to those it is given: x + n with mean `extra(x)`. All four policies.

    The counts given pass with their own gradient under every policy. Every detection triggers others with a small
    probability: whole counts are followed one by one (`trigger`), which is exact. Where there is no such number, or
    no use in it, Poisson numbers of the same mean stand for the sum: for items (C, T, H, W) of which not all counts are
    whole (the means of another sensor), for those with more than 16 events per entry on average, and under the policy
    "score", whose probabilities are theirs. Their variance is off by the probability of the effect (by 1 % at 1 %).
    """

    takes, gives = ("counts",), "counts"

    def extra(self, x: Tensor) -> Tensor:
        """Mean of the counts added, in the shape of `x`."""
        raise NotImplementedError(f"{type(self).__name__} has to define extra(x).")

    def trigger(self, counts: Tensor, generator: torch.Generator | None) -> Tensor:
        """Whole `counts` (..., C, T, H, W) >= 0, float32 or float64, with what they trigger, drawn event by event."""
        raise NotImplementedError(f"{type(self).__name__} has to define trigger(counts, generator).")

    def share(self) -> float:
        """Expected events of one detection."""
        raise NotImplementedError(f"{type(self).__name__} has to define share().")

    def expected(self, x: Tensor) -> Tensor:
        return x + self.extra(x)

    def variance(self, x: Tensor) -> Tensor:
        return self.extra(x)

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            counts = check_transient(x, type(self).__name__)
            if not counts.numel():
                return counts.clone()
            followed, totals = look_at_items(counts)
            self._check_total(float(totals.sum()))
            events = totals * (self.share() / max(math.prod(counts.shape[-4:]), 1))
            followed &= events <= _MOST_EVENTS
            if bool(followed.all()):
                return self.trigger(counts, generator)
            others = counts + self._poisson(self.extra(counts), generator)
            if not bool(followed.any()):
                return others
            return torch.where(followed, self.trigger(torch.where(followed, counts, 0), generator), others)

    def _check_total(self, total: float) -> None:
        if not math.isfinite(total):
            raise UnitError(f"{type(self).__name__}: expected finite counts, got NaN or infinity. Look upstream.")

    def _poisson(self, mean: Tensor, generator: torch.Generator | None) -> Tensor:
        self._check_total(float(mean.detach().sum()))
        work = mean.detach().clamp_min(0)
        if work.dtype == torch.float32 and work.numel() and float(work.amax()) > WHOLE_FLOAT32 / 2:
            work = work.double()
        return fast_poisson(work, generator).to(mean.dtype)

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        return poisson_log_prob((measurement - x).detach().clamp_min(0), self.extra(x)).sum(TIME)

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if self.grad != "score":
            return super().forward(x, generator)
        # the counts given pass with their own gradient, those added with their probabilities
        mean = self.extra(x)
        added = self._poisson(mean, generator)
        record_score(lambda: poisson_log_prob(added, mean).sum(TIME), type(self).__name__)
        return x + added
