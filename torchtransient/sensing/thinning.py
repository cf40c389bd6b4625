"""Binomial draws for whole histograms: exact, and much cheaper than `torch.binomial` where most results are 0 or 1.

`torch.binomial` spends 70 to 120 ns a draw on the CPU. Two kinds of draws that histograms need by the million take
less: rare events (`thin`), where one comparison with a random number says "none" for most entries, and splits of a few
counts into nearly equal halves (`halve`), by counting random bits and turning the few coins that the bias asks for.
Both draw from the exact distribution: the cheap numbers only sort out the entries of which nothing more need be known.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_WORTH_TOSSING = 1 << 15  # draws, below which many short operations cost more than they save
_BLOCK = 1 << 17  # entries at a time, so that temporaries stay in the cache
_ROOM = 2e-6  # for the rounding of probabilities and uniform numbers in single precision
_HEAVY = 6.0  # expected events of an entry, above which torch.binomial is cheaper than inversion
_GRID = 65536.0  # steps of a 16 bit number
_BITS = 31  # random bits of an int32 that is not negative
_MOST_WORDS = 2  # as many as `_coins` counts together
_TURNED = 2.0  # number of coins an entry has to turn, above which tossing them does not pay
_FEW_MISFITS = 0.04  # share of entries with too many counts, above which more random bits are drawn
_MOST_MISFITS = 0.6  # ... above which tossing coins does not pay at all


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
    found = []
    for begin in range(0, max(flat.numel(), 1), _BLOCK):
        at = slice(begin, begin + _BLOCK)
        candidates = _sift(flat[at], p if p.numel() == 1 else p[at], generator)
        found.append(candidates._replace(place=candidates.place + begin))
    return _decide(_joined(found), flat.dtype, generator)


def _sift(n: Tensor, p: Tensor, generator: torch.Generator | None) -> _Candidates:
    """The entries that may have events, by 16 random bits each: P(any) <= n p. `p`: as many as `n`, or one."""
    # one step more than the bound covers what rounding takes
    steps = (n * p.to(n.dtype)).mul_(_GRID).sub_(_GRID / 2 - 2).clamp_(max=_GRID / 2 - 1).to(torch.int16)
    bits = sixteen_bits(n, generator)
    place = (bits <= steps).nonzero().squeeze(-1)
    return _Candidates(place, n[place], p if p.numel() == 1 else p[place], bits[place])


def sixteen_bits(like: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """One int16, uniform over all its values, for each entry of `like`: four out of every random 64 bits."""
    words = torch.empty((like.numel() + 3) // 4, dtype=torch.int64, device=like.device)
    return words.random_(-(2**63), None, generator=generator).view(torch.int16)[: like.numel()]


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

    No gradient. Exact for any share in [0, 1], cheap for counts below about 60 and shares near one half; other draws,
    few draws, and all draws on other devices than the CPU, are those of `torch.binomial`. Same shapes and dtype,
    float32 or float64.

    A fair coin is tossed for every count; those on the side that is too unlikely are turned with |2 share - 1|.
    """
    n, p = counts.detach(), share.detach()
    if n.device.type != "cpu" or n.numel() < _WORTH_TOSSING:
        return torch.binomial(n, p.contiguous(), generator=generator)
    flat, shares = n.reshape(-1), p.reshape(-1)
    out = torch.empty_like(flat)
    found: list[_Candidates] = []
    for begin in range(0, flat.numel(), _BLOCK):
        at = slice(begin, begin + _BLOCK)
        coins = _coins(flat[at], shares[at], generator)
        if coins is None:
            out[at] = torch.binomial(flat[at], shares[at], generator=generator)
            continue
        tilt, number, heads, unfit = coins
        out[at] = heads
        if unfit is not None:
            out[at][unfit] = torch.binomial(flat[at][unfit], shares[at][unfit], generator=generator)
        # heads count for the first place; tails become heads where it is the likely one, heads tails where not
        to_first = tilt >= 0
        candidates = _sift(torch.where(to_first, number - heads, heads), tilt.abs(), generator)
        sign = to_first[candidates.place]
        found.append(candidates._replace(place=(candidates.place + begin) * 2 + sign))
    if found:
        turned = _decide(_joined(found), flat.dtype, generator)
        place = turned.place >> 1
        out[place] += turned.number * ((turned.place & 1) * 2 - 1)
    return out.view(n.shape)


def _coins(
    n: Tensor, p: Tensor, generator: torch.Generator | None
) -> tuple[Tensor, Tensor, Tensor, Tensor | None] | None:
    """(2 p - 1, coins tossed, heads, indices of entries that toss none); None if it does not pay.

    Entries with too many counts, or too many coins to turn, toss none.
    """
    tilt = 2 * p - 1
    turned = (n * tilt).abs_()
    for words in range(1, _MOST_WORDS + 1):
        fits = (turned <= 2 * _TURNED).logical_and_(n <= _BITS * words)
        misfits = n.numel() - int(torch.count_nonzero(fits))
        if misfits <= _FEW_MISFITS * n.numel():
            break
    if misfits > _MOST_MISFITS * n.numel():
        return None
    coins, unfit = n, None
    if misfits:
        coins, unfit = n * fits, (~fits).nonzero().squeeze(-1)
    left = coins.to(torch.int32)
    if words == 1:
        nibbles = _nibble_counts(_tossed(left, generator))
    else:
        now = left.clamp_max(_BITS)
        nibbles = _nibble_counts(_tossed(now, generator))
        # two words have at most eight ones in a nibble
        nibbles += _nibble_counts(_tossed(left.sub_(now), generator))
    heads = _sum_of_nibbles(nibbles)
    return tilt, coins, heads.to(n.dtype), unfit


def _tossed(coins: Tensor, generator: torch.Generator | None) -> Tensor:
    """As many random bits as there are coins (int32, up to 31), the others 0."""
    bits = torch.empty_like(coins).random_(generator=generator)  # 0 to 2^31 - 1
    # a shift by 31 leaves no bit
    return bits.bitwise_right_shift_(_BITS - coins)


def _nibble_counts(v: Tensor) -> Tensor:
    """Number of ones of every 4 bits of int32 values >= 0, in their place. `v` is overwritten."""
    v -= (v >> 1).bitwise_and_(0x55555555)
    pairs = (v >> 2).bitwise_and_(0x33333333)
    return v.bitwise_and_(0x33333333).add_(pairs)


def _sum_of_nibbles(v: Tensor) -> Tensor:
    """Sum of the eight nibbles, each at most 8. `v` is overwritten."""
    v = (v >> 4).bitwise_and_(0x0F0F0F0F).add_(v.bitwise_and_(0x0F0F0F0F))
    # the product holds the sum of all bytes, at most 64, in the highest one
    return v.mul_(0x01010101).bitwise_right_shift_(24)
