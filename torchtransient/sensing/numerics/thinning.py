"""Binomial draws for whole histograms: exact, and much cheaper than `torch.binomial`.

`torch.binomial` spends 40 to 120 ns a draw on the CPU. Two kinds of draws that histograms need by the million take
less: rare events (`thin`), where one comparison with a random number says "none" for most entries, or a table gives the
number (`add_passing`); and splits of counts into two places (`halve`), by tables and the few events that the steps of
the tables leave out. All draw from the exact distribution: the cheap numbers only sort out the entries of which
nothing more need be known.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchtransient.errors import UnitError
from torchtransient.sensing.numerics.binomial_tables import FEW_TRIALS, sixteen_bits, table_of, up_to_share

_WORTH_TABLES = 1 << 15  # draws, below which many short operations cost more than they save
_WORTH_ONE_TABLE = 1 << 13  # ... of one probability, which may be new in every call
_BLOCK = 1 << 17  # entries at a time, so that temporaries stay in the cache
_ROOM = 2e-6  # for the rounding of probabilities and uniform numbers in single precision
_HEAVY = 6.0  # expected events of an entry, above which torch.binomial is cheaper than inversion
_GRID = 65536.0  # steps of a 16 bit number
_LARGE = 1500  # trials, above which torch.binomial is cheaper than several looks into a table
_MOST_MISFITS = 0.6  # share of entries with too many counts, above which tables do not pay


class Events(NamedTuple):
    """Events of the entries that may have any, ascending: `place` (K,) int64 in the flattened input, `number` (K,).

    Most numbers are at least 1. Entries that are left out have none.
    """

    place: Tensor
    number: Tensor


class _Candidates(NamedTuple):
    """Entries that may have events: place, trials, probability of each, first 16 bits of their uniform number."""

    place: Tensor
    many: Tensor
    share: Tensor
    bits: Tensor


def thin(counts: Tensor, probability: Tensor | float, generator: torch.Generator | None = None) -> Events:
    """How many of `counts` pass, each with `probability`, for the few entries that have any. Binomial, no gradient.

    `counts`: any shape, float32 or float64, whole numbers >= 0. `probability`: a number or one for each entry, in
    [0, 1]. `number` is of the dtype of `counts`.
    """
    flat = counts.detach().reshape(-1)
    p = torch.as_tensor(probability, dtype=torch.float64, device=flat.device).detach().reshape(-1)
    if p.numel() == 1 and flat.device.type == "cpu" and flat.numel() >= _WORTH_ONE_TABLE and 0 <= float(p) <= 0.5:
        return _thin_by_table(flat, float(p), generator)
    found = []
    for begin in range(0, max(flat.numel(), 1), _BLOCK):
        at = slice(begin, begin + _BLOCK)
        candidates = _sift(flat[at], p if p.numel() == 1 else p[at], generator)
        found.append(candidates._replace(place=candidates.place + begin))
    return _decide(_joined(found), flat.dtype, generator)


def add_passing(counts: Tensor, probability: float, into: Tensor, generator: torch.Generator | None = None) -> None:
    """Add to `into` how many of `counts` pass, each with `probability` in [0, 1/2]. Binomial, no gradient.

    Both of one shape, float32 or float64, `into` contiguous; meant for some 1e5 entries at a time.
    """
    if counts.device.type == "cpu" and counts.numel() >= _WORTH_ONE_TABLE:
        trials, large, others = _apart(counts.reshape(-1), probability, generator)
        table = table_of(probability, small=counts.numel() < _BLOCK // 4)
        into.view(-1).add_(table.draw(0, trials, generator)).index_add_(0, large, others)
        return
    events = thin(counts, probability, generator)
    into.view(-1).scatter_add_(0, events.place, events.number)


def _thin_by_table(flat: Tensor, probability: float, generator: torch.Generator | None) -> Events:
    places, numbers = [], []
    table = table_of(probability, small=flat.numel() < _BLOCK // 4)
    for begin in range(0, flat.numel(), _BLOCK):
        trials, large, others = _apart(flat[begin : begin + _BLOCK], probability, generator)
        place, number = table.draw_some(trials, generator)
        places.append(place.add_(begin))
        numbers.append(number.to(flat.dtype))
        if large.numel():
            places.append(large + begin)
            numbers.append(others)
    place, number = torch.cat(places), torch.cat(numbers)
    if place.numel() and not bool((place[1:] > place[:-1]).all()):
        place, order = place.sort()
        number = number[order]
    return Events(place, number)


def _apart(
    counts: Tensor, probability: float, generator: torch.Generator | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Trials (K,) int32 without those of large counts; the places of these, and their numbers from torch.binomial."""
    low, high = torch.aminmax(counts)
    if not float(low) >= 0:
        raise UnitError(f"thin: expected counts >= 0, got {float(low):g}. Look for NaN or a difference upstream.")
    trials = counts.to(torch.int32)
    if float(high) <= _LARGE:
        return trials, counts[:0].long(), counts[:0]
    large = (counts > _LARGE).nonzero().squeeze(-1)
    trials[large] = 0
    many = counts[large]
    return trials, large, torch.binomial(many, torch.full_like(many, probability), generator=generator)


def _sift(n: Tensor, p: Tensor, generator: torch.Generator | None) -> _Candidates:
    """The entries that may have events, by 16 random bits each: P(any) <= n p. `p`: as many as `n`, or one."""
    # one step more than the bound covers what rounding takes
    steps = (n * p.to(n.dtype)).mul_(_GRID).sub_(_GRID / 2 - 2).clamp_(max=_GRID / 2 - 1).to(torch.int16)
    bits = sixteen_bits(n, generator)
    place = (bits <= steps).nonzero().squeeze(-1)
    return _Candidates(place, n[place], p if p.numel() == 1 else p[place], bits[place])


def _joined(parts: list[_Candidates]) -> _Candidates:
    place, many, share, bits = zip(*parts, strict=True)
    one_share = all(s.numel() == 1 for s in share) and len(parts) > 1
    return _Candidates(torch.cat(place), torch.cat(many), share[0] if one_share else torch.cat(share), torch.cat(bits))


def _decide(chosen: _Candidates, dtype: torch.dtype, generator: torch.Generator | None) -> Events:
    """Binomial numbers of the candidates.

    The number is at least k where u < P(K >= k). With the binomial moments x = n p, y = n (n - 1) p^2 / 2 and
    z = n (n - 1) (n - 2) p^3 / 6, Bonferroni's inequalities say that P(K >= 1) lies in [x - y, x - y + z], P(K >= 2)
    in [y - 2 z, y] and P(K >= 3) below z. In single precision and with room for its rounding they decide most
    entries; the others are looked at in double precision.
    """
    n, p = chosen.many.float(), chosen.share.float()
    finer = torch.rand(n.shape, dtype=torch.float32, device=n.device, generator=generator)
    u = finer.add(chosen.bits).add_(_GRID / 2).mul_(1 / _GRID)
    x = n * p
    y = (x - p).mul_(x).mul_(0.5)
    z = (x - 2 * p).mul_(y).mul_(1 / 3)
    below, above = u + _ROOM, u.sub_(_ROOM)
    x.sub_(y)
    one = (below < x).logical_and_(above >= y)
    zero = above >= x.add_(z)
    two = (above >= z).logical_and_(below < y.sub_(z, alpha=2))
    number = one.to(dtype).add_(two, alpha=2)
    unsure = zero.logical_or_(one).logical_or_(two).logical_not_().nonzero().squeeze(-1)
    if unsure.numel():
        many = chosen.many[unsure].double()
        share = (chosen.share if chosen.share.numel() == 1 else chosen.share[unsure]).double().expand(many.shape)
        exact = (finer[unsure].double() + chosen.bits[unsure]).add_(_GRID / 2).div_(_GRID)
        number[unsure] = _count_down(many, share, exact, generator).to(dtype)
    return Events(chosen.place, number)


def _count_down(many: Tensor, share: Tensor, u: Tensor, generator: torch.Generator | None) -> Tensor:
    """Binomial by inversion from the top, in float64: every round follows the entries that have more events.

    Entries with many events take a fresh draw instead: of none of them has `u` decided anything yet.
    """
    number = torch.where(share < 1, torch.zeros_like(many), many)
    heavy = many * share > _HEAVY
    light = heavy.logical_or(share >= 1).logical_not_()
    drawn = heavy.nonzero().squeeze(-1)
    if drawn.numel():
        number[drawn] = torch.binomial(many[drawn], share[drawn], generator=generator)
    log_none = many * torch.log1p(-share)
    tail = -torch.expm1(log_none)
    where = ((u < tail) & light).nonzero().squeeze(-1)
    odds = share / (1 - share)
    chance = log_none.exp_()
    u, tail, many, odds, chance = (v[where] for v in (u, tail, many, odds, chance))
    k = 0
    while where.numel():
        k += 1
        number[where] = float(k)
        chance = chance * odds * ((many - (k - 1)) / k)
        tail = tail - chance
        more = ((u < tail) & (many > k)).nonzero().squeeze(-1)
        where, u, tail, many, odds, chance = (v[more] for v in (where, u, tail, many, odds, chance))
    return number


def halve(counts: Tensor, share: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """How many of `counts` go to the first of two places that gets each with probability `share`: binomial.

    No gradient. Exact for any share in [0, 1], cheap for counts up to 127; other draws, few draws, and all draws
    on other devices than the CPU, are those of `torch.binomial`. Same shapes and dtype, float32 or float64.

    Tables give the number for a share just below the one that is meant, or below its complement; of the trials that
    are left each is added with the small probability that is missing.
    """
    n, p = counts.detach(), share.detach()
    if n.device.type != "cpu" or n.numel() < _WORTH_TABLES:
        return torch.binomial(n, p.contiguous(), generator=generator)
    flat, shares = n.reshape(-1), p.reshape(-1)
    out = torch.empty_like(flat)
    found: list[_Candidates] = []
    for begin in range(0, flat.numel(), _BLOCK):
        at = slice(begin, begin + _BLOCK)
        many, p = flat[at], shares[at]
        less = torch.minimum(p, 1 - p)
        # NaN fits nowhere and is torch.binomial's to refuse
        if float(many.amax()) <= FEW_TRIALS and float(less.amin()) >= 0:
            unfit = flat[:0].long()
        else:
            unfit = (many <= FEW_TRIALS).logical_and_(less >= 0).logical_not_().nonzero().squeeze(-1)
        if unfit.numel() > _MOST_MISFITS * many.numel():
            out[at] = torch.binomial(many, p, generator=generator)
            continue
        trials = many.to(torch.int32)
        if unfit.numel():
            trials[unfit], less[unfit] = 0, 0.0
        number, left, missing = up_to_share(trials, less, generator)
        likely = p > 0.5
        candidates = _sift(left.to(flat.dtype), missing, generator)
        # not `where`, which guesses at every entry
        out[at] = trials.sub_(number, alpha=2).mul_(likely).add_(number)
        if unfit.numel():
            out[at][unfit] = torch.binomial(many[unfit], p[unfit], generator=generator)
        found.append(candidates._replace(place=(candidates.place + begin) * 2 + likely[candidates.place]))
    if found:
        added = _decide(_joined(found), flat.dtype, generator)
        place = added.place >> 1
        out[place] += added.number * (1 - (added.place & 1) * 2)
    return out.view(n.shape)
