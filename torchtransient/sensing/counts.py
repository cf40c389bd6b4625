"""Counts: shot noise, counts added to others, and counts that move in time.

A move is a table of shares: of the counts of bin t, a share goes `lag` bins later. Whole counts are split over the lags
by a tree of binomials, which is the multinomial distribution exactly. Rare lags part first and are followed for the few
entries that reach them; the others part in halves of nearly equal weight, which `halve` draws fast.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchtransient.errors import GradientError, UnitError
from torchtransient.floating import in_single, single
from torchtransient.sensing.checks import TIME, check_transient, reals
from torchtransient.sensing.draws import WHOLE_FLOAT32, by_pieces, check_rates, fast_poisson, halve, thin
from torchtransient.sensing.sensor import RandomSensor, record_score, standard_normal, straight_through
from torchtransient.sensing.time_convolution import Boundary


@in_single
def poisson(mean: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Draw Poisson counts of a given mean, without gradient.

    Float32 above 2^24 is drawn in float64, then rounded to the dtype of `mean`.

    Args:
        mean: tensor of any shape, finite, >= 0; half precision gives float32.
        generator: source of randomness.

    Returns:
        Counts in shape, dtype and device of `mean`.

    Raises:
        UnitError: for negative or non-finite means: negative lobes of a filter have to be dealt with where they arise.
    """
    (mean,) = reals("poisson", mean=mean)
    mean = check_rates(mean.detach(), "poisson")
    return torch.poisson(_room_for_counts(mean), generator=generator).to(mean.dtype)


def _room_for_counts(mean: Tensor) -> Tensor:
    """Means in a dtype that holds whole numbers of their size."""
    bright = mean.dtype == torch.float32 and mean.numel() > 0 and float(mean.amax()) > WHOLE_FLOAT32 / 2
    return mean.double() if bright else mean


@in_single
def poisson_log_prob(counts: Tensor, mean: Tensor) -> Tensor:
    """Log-probability of counts under Poisson means, elementwise; finite gradients at mean 0 with count 0.

    Args:
        counts: tensor of any shape.
        mean: Poisson means, in a shape that broadcasts.

    Returns:
        Broadcast shape; -inf for a count above 0 where the mean is 0.
    """
    empty = counts == 0
    # where on the input: xlogy(0, 0) has a NaN gradient
    log_mean = torch.where(empty, torch.ones_like(mean), mean).log()
    return counts * log_mean - mean - torch.lgamma(counts + 1)


class ShotNoise(RandomSensor):
    """Draw Poisson counts of a mean (..., C, T, H, W). Fano factor 1. All four gradient policies.

    Args:
        grad: gradient policy.
    """

    takes, gives = ("electrons",), "counts"

    def expected(self, x: Tensor) -> Tensor:
        return check_transient(x, "ShotNoise")

    def variance(self, x: Tensor) -> Tensor:
        return x

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return poisson(check_transient(x, "ShotNoise"), generator)

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        return poisson_log_prob(measurement, x).sum(-3)


# --------------------------------------------------------------------------------------------------------- added counts


# Events per entry, on average, above which following them one by one is given up for Poisson numbers.
_MOST_EVENTS = 16
_BLOCK = 1 << 16  # entries at a time, so that temporaries stay in the cache


def look_at_items(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Find the items (C, T, H, W) of a batch that hold whole numbers >= 0 alone, and their sums.

    Item by item, so that an item is drawn or not whatever is beside it in a batch.

    Args:
        counts: (..., C, T, H, W).

    Returns:
        Mask and float64 sums, both (..., 1, 1, 1, 1).
    """
    shape = (*counts.shape[:-4], 1, 1, 1, 1)
    rows = counts.detach().reshape(math.prod(shape), math.prod(counts.shape[-4:]))
    whole, total = rows.new_ones(rows.shape[0], dtype=torch.bool), rows.new_zeros(rows.shape[0], dtype=torch.float64)
    for block in torch.split(rows, max(_BLOCK // max(rows.shape[0], 1), 1), 1):
        total += block.sum(1)
        nearest = block.round().clamp_min_(0)
        if not torch.equal(nearest, block):
            whole &= (nearest == block).all(1)
    return whole.view(shape), total.view(shape)


class AddedCounts(RandomSensor):
    """Base of sensors that add counts n to those they are given: x + n with mean `extra(x)`. All four policies.

    The counts given pass with their own gradient under every policy. Every detection triggers others with a small
    probability: whole counts are followed one by one (`trigger`), which is exact. Poisson numbers of the same mean
    stand for the sum where there is no such number, or no use in it: for items (C, T, H, W) of which not all counts are
    whole (the means of another sensor), for those with more than 16 events per entry on average, and under the policy
    "score", whose probabilities are theirs. Their variance is off by the probability of the effect (by 1 % at 1 %).

    A subclass defines `extra`, `trigger` and `share`.

    Args:
        grad: gradient policy.
    """

    takes, gives = ("counts",), "counts"

    def extra(self, x: Tensor) -> Tensor:
        """Mean of the counts added.

        Args:
            x: counts (..., C, T, H, W).

        Returns:
            Shape of `x`.
        """
        raise NotImplementedError(f"{type(self).__name__} has to define extra(x).")

    def trigger(self, counts: Tensor, generator: torch.Generator | None) -> Tensor:
        """Add the detections that counts trigger, drawn event by event.

        Args:
            counts: whole numbers >= 0, (..., C, T, H, W), float32 or float64.
            generator: source of randomness.

        Returns:
            Shape of `counts`.
        """
        raise NotImplementedError(f"{type(self).__name__} has to define trigger(counts, generator).")

    def share(self) -> float:
        """Return the expected events of one detection."""
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
        return fast_poisson(_room_for_counts(mean.detach().clamp_min(0)), generator).to(mean.dtype)

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


# --------------------------------------------------------------------------------------------------------- moved counts


_MOVED_BLOCK = 1 << 18  # entries at a time, so that temporaries stay in the cache
_RARE = 0.3  # counts of an entry in a branch, on average, below which single events are sought
_LEAST_BY_TABLE = 1.0  # counts of an entry in the smaller branch, on average, below which torch.binomial is quick
_MOST_BY_TABLE = 60.0  # counts of an entry, on average, above which many have more than tables hold
_SINGLE = 1 << 14  # counts in all, up to which each is moved by itself
_NOTHING_LOST = 1e-12  # what rounding leaves of shares that sum to 1
_FEW = 0.25  # share of occupied entries below which these alone are followed


class Moving(Protocol):
    """Table of moves, as `MovedCounts` uses it."""

    @property
    def learned(self) -> bool:
        """True if the probabilities have gradients."""

    def detached(self) -> Moving:
        """Return the same without gradients."""

    def mean(self, x: Tensor) -> Tensor:
        """Mean of moved counts, linear in `x` (..., T, H, W)."""

    def noise(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Draw normal noise with the covariance of moved counts `x` that are known themselves."""

    def draw(self, counts: Tensor, generator: torch.Generator | None, tally: bool) -> tuple[Tensor, Tensor | None]:
        """Move each of whole `counts`, float32 or float64; if `tally` also return how many went each way."""

    def log_prob(self, tallies: Tensor) -> Tensor:
        """Log-probability of the ways that were drawn, (..., C, H, W) float64, differentiable."""


@dataclass(frozen=True)
class Moves:
    """Shares of the counts of a bin that go some bins later.

    Attributes:
        first: lag of the first share, in bins.
        shares: (L,) for all bins, or (L, T) for each. They sum to 1 over L, or to less: the rest is lost.
        boundary: "zero" loses counts that leave the window; "periodic" brings them in at the other end.
    """

    first: int
    shares: Tensor
    boundary: Boundary

    @property
    def learned(self) -> bool:
        return self.shares.requires_grad

    def detached(self) -> Moves:
        return Moves(self.first, self.shares.detach(), self.boundary)

    def draw(self, counts: Tensor, generator: torch.Generator | None, tally: bool) -> tuple[Tensor, Tensor | None]:
        return move_counts(counts, self, generator, tally=tally)

    def log_prob(self, tallies: Tensor) -> Tensor:
        if self.shares.ndim > 1:
            raise GradientError(
                "MovedCounts: expected shares (L,) under grad='score', got those of every bin. Choose another policy."
            )
        shares = self.shares.clamp_min(torch.finfo(torch.float64).tiny).log()
        return (tallies.double() * shares.view(-1, *[1] * (tallies.ndim - 1))).sum(0)

    def of_lag(self, index: int, like: Tensor) -> Tensor:
        """Return the share of one lag.

        Args:
            index: number of the lag.
            like: light (..., T, H, W) whose dtype and device are taken.
        """
        share = self.shares[index].to(like)
        return share.view(-1, 1, 1) if share.ndim else share

    def mean(self, x: Tensor) -> Tensor:
        """Mean of moved counts, linear in `x` (..., T, H, W)."""
        total = torch.zeros_like(x)
        for index in range(self.shares.shape[0]):
            total = total + shifted(x * self.of_lag(index, x), self.first + index, self.boundary)
        return total

    def noise(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Draw normal noise with the covariance of moved counts `x` that are known themselves, one draw for each lag.

        Counts of a bin that go elsewhere are missing where they would have gone: n (diag p - p p^T) for each bin.
        """
        variance = x.clamp_min(0)
        root = (variance + 1e-4).sqrt() - 1e-2
        total, drawn = torch.zeros_like(x), torch.zeros_like(x)
        for index in range(self.shares.shape[0]):
            part = root * self.of_lag(index, x).clamp_min(0).add(1e-30).sqrt() * standard_normal(x, generator)
            drawn = drawn + part
            total = total + shifted(part, self.first + index, self.boundary)
        if float(self.shares.detach().sum(0).amin()) < 1 - 1e-6:
            rest = (1 - self.shares.sum(0)).clamp_min(1e-30).to(x)
            drawn = drawn + root * (rest.view(-1, 1, 1) if rest.ndim else rest).sqrt() * standard_normal(x, generator)
        return total - self.mean(drawn)


def shifted(x: Tensor, lag: int, boundary: Boundary) -> Tensor:
    """Shift light or counts to later bins.

    Args:
        x: (..., T, H, W).
        lag: bins, of either sign.
        boundary: "zero" or "periodic".

    Returns:
        Shape of `x`.
    """
    if boundary == "periodic":
        return x.roll(lag, TIME)
    bins = x.shape[TIME]
    if abs(lag) >= bins:
        return torch.zeros_like(x)
    kept = x.narrow(TIME, max(-lag, 0), bins - abs(lag))
    gap = torch.zeros_like(x.narrow(TIME, 0, abs(lag)))
    return torch.cat([gap, kept] if lag >= 0 else [kept, gap], TIME)


def move_counts(
    counts: Tensor, moves: Moves, generator: torch.Generator | None = None, *, tally: bool = False
) -> tuple[Tensor, Tensor | None]:
    """Move each detection of whole counts by itself, without gradient. Exact for any counts that the dtype holds.

    Args:
        counts: whole numbers >= 0, (..., T, H, W), float32 or float64.
        moves: shares of the lags.
        generator: source of randomness.
        tally: also count how many took each lag.

    Returns:
        Counts in the shape of `counts`, and tallies (L, ..., H, W) or None.
    """
    given = counts.detach()
    bins, shape = given.shape[TIME], given.shape
    if given.numel() == 0:
        return given.clone(), given.new_zeros(moves.shares.shape[0], *shape[:TIME], *shape[-2:]) if tally else None
    data = given.reshape(-1, bins, shape[-2] * shape[-1])
    tallies: Tensor | None = None
    if tally:
        tallies = data.new_zeros(moves.shares.shape[0], data.shape[0], data.shape[2])
        moved = _Tree(moves, data.contiguous(), tallies).run(generator)
        tallies = tallies.view(-1, *shape[:TIME], *shape[-2:])
    elif moves.shares.ndim == 1 and float(data.sum()) <= _SINGLE:
        moved = _one_by_one(data, moves, generator)
    else:
        columns = data.movedim(2, 0)
        parts = by_pieces(lambda piece, _, own: _by_blocks(piece.movedim(0, 2), moves, own), columns, generator)
        moved = torch.cat(parts, 2) if len(parts) > 1 else parts[0]
    return moved.reshape(shape), tallies


def _one_by_one(data: Tensor, moves: Moves, generator: torch.Generator | None) -> Tensor:
    """`data` (N, T, P), the lag of every single count looked up."""
    _, bins, pixels = data.shape
    place = torch.repeat_interleave(data.reshape(-1).long())
    below = moves.shares.detach().to(data.device, torch.float64).cumsum(0)
    if float(below[-1]) > 1 - _NOTHING_LOST:
        below[-1] = 1.0
    u = torch.rand(place.shape, dtype=torch.float64, device=data.device, generator=generator)
    lag = torch.searchsorted(below, u, right=True)
    time = place.div(pixels, rounding_mode="floor") % bins
    later = time + lag + moves.first
    inside = later % bins
    kept = lag < below.numel()
    if moves.boundary == "zero":
        kept &= inside == later
    place = (place + (inside - time) * pixels)[kept]
    return torch.bincount(place, minlength=data.numel()).view(data.shape).to(data.dtype)


def _by_blocks(data: Tensor, moves: Moves, generator: torch.Generator | None) -> Tensor:
    width = max(1, _MOVED_BLOCK // max(data.shape[0] * data.shape[1], 1))
    if data.shape[2] <= width:
        return _Tree(moves, data.contiguous(), None).run(generator)
    pieces = torch.split(data, width, 2)
    return torch.cat([_Tree(moves, p.contiguous(), None).run(generator) for p in pieces], 2)


class _Tree:
    """Splits counts (N, T, P) over lags, adding them up where they go."""

    def __init__(self, moves: Moves, data: Tensor, tallies: Tensor | None) -> None:
        self.moves, self.data, self.tallies = moves, data.contiguous(), tallies
        self.shares = moves.shares.detach().double().to(data.device)
        rest = 1 - self.shares.sum(0, keepdim=True)
        if float(rest.max()) > _NOTHING_LOST:
            self.shares = torch.cat([self.shares, rest])  # those that are lost
        self.weights = (self.shares if self.shares.ndim == 1 else self.shares.mean(1)).tolist()
        self.total = torch.zeros_like(self.data)

    def run(self, generator: torch.Generator | None) -> Tensor:
        self._node(list(range(len(self.weights))), None, self.data, generator)
        return self.total

    def _node(self, lags: list[int], place: Tensor | None, counts: Tensor, generator: torch.Generator | None) -> None:
        """`counts` go to these lags; `place`: which entries they are, None for all."""
        if len(lags) == 1:
            self._leaf(lags[0], place, counts)
            return
        level = float(counts.sum(dtype=torch.float64)) / counts.numel()
        small, large = self._split(lags, level)
        few, whole = (self.shares[list(part)].sum(0) for part in (small, lags))
        share = few / whole.clamp_min(1e-300)
        highest = float(share.max())
        if highest * level < _RARE:
            events = thin(counts, self._of_entries(share, place, counts), generator)
            rest = counts.clone()
            rest.view(-1)[events.place] -= events.number
            few_place = events.place if place is None else place[events.place]
            parts = [(small, few_place, events.number), (large, place, rest)]
        else:
            fewer = min(float(share.min()), 1 - highest) * level
            by_table = level < _MOST_BY_TABLE and fewer > _LEAST_BY_TABLE
            shares = self._of_entries(share, place, counts).to(counts.dtype).expand_as(counts)
            if by_table:
                taken = halve(counts, shares, generator)
            else:
                taken = torch.binomial(counts, shares.contiguous(), generator=generator)
            parts = [(small, place, taken), (large, place, counts - taken)]
        for part, where, number in parts:
            occupied = int(torch.count_nonzero(number))
            if occupied < _FEW * number.numel():
                kept = number.view(-1).nonzero().squeeze(-1)
                where = kept if where is None else where[kept]
                number = number.view(-1)[kept]
            if occupied:
                self._node(part, where, number, generator)

    def _split(self, lags: list[int], level: float) -> tuple[list[int], list[int]]:
        """Two parts: the rare lags and the others, where there are rare ones, else halves as equal as they get.

        `level`: counts of an entry, on average.
        """
        order = sorted(lags, key=self.weights.__getitem__)
        whole, total, rare = sum(self.weights[i] for i in lags), 0.0, 0
        while rare < len(order) - 1 and (total + self.weights[order[rare]]) * level < _RARE * whole:
            total += self.weights[order[rare]]
            rare += 1
        if rare:
            return order[:rare], order[rare:]
        halves: tuple[list[int], list[int]] = ([], [])
        sums = [0.0, 0.0]
        for i in reversed(order):
            side = int(sums[1] < sums[0])
            halves[side].append(i)
            sums[side] += self.weights[i]
        return halves

    def _of_entries(self, share: Tensor, place: Tensor | None, counts: Tensor) -> Tensor:
        """A share of bins as one of entries."""
        if share.ndim == 0:
            return share
        if place is None:
            return share.view(-1, 1).expand(self.data.shape)
        return share[place.div(self.data.shape[2], rounding_mode="floor") % self.data.shape[1]]

    def _leaf(self, index: int, place: Tensor | None, counts: Tensor) -> None:
        if index >= self.moves.shares.shape[0]:
            return
        _, bins, pixels = self.data.shape
        lag = self.moves.first + index
        if place is None:
            if self.moves.boundary == "periodic":
                lag %= bins
                self.total[:, lag:] += counts[:, : bins - lag]
                self.total[:, :lag] += counts[:, bins - lag :]
            elif abs(lag) < bins:
                self.total[:, max(lag, 0) : bins + min(lag, 0)] += counts[:, max(-lag, 0) : bins - max(lag, 0)]
            if self.tallies is not None:
                self.tallies[index] += counts.sum(1)
            return
        row, pixel = place.div(pixels, rounding_mode="floor"), place % pixels
        item, time = row.div(bins, rounding_mode="floor"), row % bins
        later = time + lag
        inside = later % bins
        counts_inside = counts * (inside == later) if self.moves.boundary == "zero" else counts
        self.total.view(-1).index_add_(0, (item * bins + inside) * pixels + pixel, counts_inside)
        if self.tallies is not None:
            self.tallies[index].view(-1).index_add_(0, item * pixels + pixel, counts)


class MovedCounts(RandomSensor):
    """Base of sensors that move detections in time. All four policies.

    Whole counts move one by one; draws refuse NaN and infinity with UnitError. Items (C, T, H, W) of which not all
    counts are whole, the means of another stage, stay means under every policy but "gaussian", which takes its input
    for a normal surrogate of counts; what is beside an item in a batch makes no difference. Under "score" the
    probabilities are those of the moves; the counts given pass with the gradient of the mean, as under
    "straight_through".

    A subclass defines `expected` and `moves`.

    Args:
        grad: gradient policy.
    """

    def moves(self, x: Tensor) -> Moving:
        """Table of moves, differentiable in the parameters.

        Args:
            x: counts (..., C, T, H, W).
        """
        raise NotImplementedError(f"{type(self).__name__} has to define moves(x).")

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self.expected(x) + self.moves(x).noise(x, generator)

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            return self._drawn(x, generator, tally=False)[0]

    def _drawn(self, x: Tensor, generator: torch.Generator | None, tally: bool) -> tuple[Tensor, Tensor | None, Tensor]:
        """Items moved, how many of the whole ones went each way, and which are whole; see `look_at_items`."""
        given = check_transient(x, type(self).__name__)
        counts = single(given)
        highest = float(counts.abs().amax()) if counts.numel() else 0.0
        if not math.isfinite(highest):
            raise UnitError(f"{type(self).__name__}: expected finite counts, got NaN or infinity. Look upstream.")
        whole, _ = look_at_items(counts)
        if whole.numel() and not bool(whole.any()):
            return self.expected(given), None, whole
        every = bool(whole.all())
        counts = counts if every else torch.where(whole, counts, 0)
        if counts.dtype == torch.float32 and highest > WHOLE_FLOAT32 / 2:
            counts = counts.double()
        moved, tallies = self.moves(x).draw(counts, generator, tally)
        moved = moved.to(x.dtype)
        return moved if every else torch.where(whole, moved, self.expected(given)), tallies, whole

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if self.grad != "score":
            return super().forward(x, generator)
        with torch.no_grad():
            moved, tallies, whole = self._drawn(x, generator, tally=True)
        if tallies is None:
            return self.expected(x)
        if not torch.is_grad_enabled():
            return moved
        moves, counted = self.moves(x), tallies
        if moves.learned:
            record_score(lambda: moves.log_prob(counted), type(self).__name__)
        if x.requires_grad:
            moved = straight_through(moved, moves.detached().mean(x))
        return moved if bool(whole.all()) else torch.where(whole, moved, self.expected(x))
