"""Poisson, binomial and multinomial draws for whole histograms, exact and on several cores.

torch draws these distributions on one core, a binomial number in 40 to 120 ns. Here large draws on the CPU are cut into
a fixed number of pieces, each with a generator seeded from the one given, and done by `torch.get_num_threads()`
threads: results depend on the generator, not on the number of threads. Rare events (`thin`), splits of counts into two
places (`halve`) and counts of one small probability (`add_passing`) are drawn by comparisons and tables that settle
most entries, and in double precision where those do not.
"""

from __future__ import annotations

import functools
import itertools
import math
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import holds
from torchtransient.sensing.checks import TIME

Result = TypeVar("Result")

WHOLE_FLOAT32 = 2.0**24  # above, float32 skips integers

# threads
_LOCK = threading.Lock()
_POOLS: dict[int, ThreadPoolExecutor] = {}
_OWN = threading.local()
_PIECES = 4  # of a large draw
_WORTH_THREADS = 1 << 17  # numbers to draw, above which starting threads costs less than it saves

# tables
_VALUES = 1 << 16  # of a random number of 16 bits
_BORDER = 1e-9  # beside the border of two results, more than the rounding of the distribution function
_FEW_TRIALS = 127  # of an entry: their numbers fit into a byte. With more, torch.binomial is cheaper than two tables
_RARE, _RARE_TRIALS = 0.05, 511  # up to this probability so many trials have results that fit into a byte

# thinning
_WORTH_TABLES = 1 << 15  # draws, below which many short operations cost more than they save
_WORTH_ONE_TABLE = 1 << 13  # ... of one probability, which may be new in every call
_ENTRIES = 1 << 17  # at a time, so that temporaries stay in the cache
_ROUNDING = 2e-6  # of probabilities and uniform numbers in single precision
_HEAVY = 6.0  # expected events of an entry, above which torch.binomial is cheaper than inversion
_GRID = 65536.0  # steps of a 16 bit number
_LARGE = 1500  # trials, above which torch.binomial is cheaper than repeated table lookups
_MOST_MISFITS = 0.6  # share of entries with too many counts, above which tables do not pay

# multinomials
_PAIRS = 1 << 16  # of bins at a time, so that temporaries stay in the cache
_SMALL_IMAGE = 1 << 12  # pixels, below which several images are drawn as one wide one
_SMALL_DRAW = 1 << 14  # bins of all pixels, up to which few counts are drawn one by one
_FEW_COUNTS = 1 << 13


def check_rates(rate: Tensor, where: str) -> Tensor:
    """Return `rate` if all of it is finite and >= 0.

    torch.binomial does not return from a NaN count, and formulas of saturating detectors give plausible counts of
    negative light. Skipped where values cannot be read (`floating.holds`).

    Args:
        rate: tensor of any shape.
        where: name of the caller, for errors.

    Raises:
        UnitError: for negative, infinite or NaN rates.
    """
    low, high = torch.aminmax(rate.detach()) if rate.numel() else (rate.new_zeros(()), rate.new_zeros(()))
    if not holds((low >= 0) & torch.isfinite(high)):
        raise UnitError(
            f"{where}: expected finite values >= 0, got {float(low):g} to {float(high):g}. Look for NaN upstream; "
            "clamp or use softplus where a network gives the rate."
        )
    return rate


# -------------------------------------------------------------------------------------------------------------- threads


def _forget() -> None:
    """Drop the pools of a forked process: threads do not survive the fork, and the lock may be held."""
    global _LOCK
    _LOCK = threading.Lock()
    _POOLS.clear()
    _OWN.works_alone = False


os.register_at_fork(after_in_child=_forget)


def _pool(threads: int) -> ThreadPoolExecutor:
    """Pool of threads that work alone, made once for each number of threads."""
    with _LOCK:
        if threads not in _POOLS:
            pool, all_there = ThreadPoolExecutor(threads), threading.Barrier(threads)

            def begin(_: int) -> None:
                # a first look takes over the number of the process, which would undo the next line
                torch.get_num_threads()
                torch.set_num_threads(1)  # operations of torch take no threads of their own
                _OWN.works_alone = True
                all_there.wait()

            before = torch.get_num_threads()
            try:
                list(pool.map(begin, range(threads)))
            except BaseException:
                all_there.abort()  # those that did start would wait for the others, and the process for them
                raise
            finally:
                # the number of a thread is also that of the process, until it is set again
                torch.set_num_threads(before)
            _POOLS[threads] = pool
        return _POOLS[threads]


def in_threads(
    job: Callable[..., Result], arguments: Sequence[tuple[Any, ...]], generator: torch.Generator | None
) -> list[Result]:
    """Apply `job` to tuples of arguments side by side, without gradients, each with a generator of its own.

    As many threads as `torch.get_num_threads()`; operations of torch inside of them take one thread each: more threads
    than cores wait for each other, at up to four times the processor time. Nested calls run in the caller's thread.

    Args:
        job: function of the elements of a tuple, and a generator.
        arguments: the tuples.
        generator: source of the seeds.

    Returns:
        Results in the order of the arguments.
    """
    seeds = torch.randint(0, 2**63 - 1, (len(arguments),), generator=generator).tolist()
    inferring = torch.is_inference_mode_enabled()

    def run(given: tuple[Any, ...], seed: int) -> Result:
        # modes are per thread, and what was made in inference mode can only be written to in it
        with torch.inference_mode(inferring), torch.no_grad():
            return job(*given, torch.Generator().manual_seed(seed))

    threads = min(torch.get_num_threads(), len(arguments))
    if threads < 2 or getattr(_OWN, "works_alone", False):
        return list(map(run, arguments, seeds))
    return list(_pool(threads).map(run, arguments, seeds))


def by_pieces(
    job: Callable[[Tensor, int, torch.Generator | None], Result], data: Tensor, generator: torch.Generator | None
) -> list[Result]:
    """Apply `job(piece, begin, generator)` to pieces of `data` along dimension 0, in threads for large data on the CPU.

    Args:
        job: function of a piece, the index of its first entry along dimension 0, and its own generator.
        data: tensor of any shape.
        generator: source of the seeds of the pieces.

    Returns:
        Results of the pieces in order; the number of pieces does not depend on the number of threads.
    """
    if data.device.type != "cpu" or data.numel() < _WORTH_THREADS or data.shape[0] < _PIECES:
        return [job(data, 0, generator)]
    pieces = data.tensor_split(_PIECES)
    begins = itertools.accumulate((piece.shape[0] for piece in pieces[:-1]), initial=0)
    return in_threads(job, list(zip(pieces, begins, strict=True)), generator)


def _in_columns(
    draw: Callable[[Tensor, torch.Generator | None], Tensor], data: Tensor, generator: torch.Generator | None
) -> Tensor:
    """Apply `draw` to pieces of `data` along its last dimension, in threads for large data on the CPU."""
    if data.device.type != "cpu" or data.numel() < _WORTH_THREADS or data.shape[-1] < _PIECES:
        return draw(data, generator)
    result = torch.empty_like(data, memory_format=torch.contiguous_format)
    places = zip(data.tensor_split(_PIECES, dim=-1), result.tensor_split(_PIECES, dim=-1), strict=True)
    in_threads(lambda piece, into, own: into.copy_(draw(piece, own)), list(places), generator)
    return result


def fast_poisson(mean: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Draw Poisson numbers on several cores.

    Args:
        mean: finite, >= 0, float32 or float64.
        generator: source of randomness.

    Returns:
        Shape and dtype of `mean`.
    """
    return _in_columns(lambda m, g: torch.poisson(m, generator=g), mean, generator)


# ------------------------------------------------------------------------------------------- tables of binomial numbers


class BinomialTables:
    """Binomial numbers of fixed probabilities by one lookup each, on the CPU.

    A row of the table belongs to a probability and a number of trials, a cell of it to a stretch of the uniform number.
    Most cells hold one result; where a border of two results lies inside a cell, more of the uniform number is drawn
    and looked up in the distribution function, in double precision.

    Args:
        probabilities: (S,) float64 in [0, 1).
        most: trials of the last row, such that results above 127 have probability below 1e-20.
        cells: stretches of the uniform number, a power of 2 up to 65536.
    """

    def __init__(self, probabilities: Tensor, most: int, cells: int) -> None:
        self._most, self._cells = most, cells
        below = _distribution(probabilities, most)
        rows, self._results = below.shape
        row = torch.arange(rows, device="cpu").unsqueeze(1)
        # one ascending list of all rows: row r lies between r and r + 1
        self._below = (below + row).reshape(-1)
        place = below * cells
        started = torch.zeros(rows, cells + 1, dtype=torch.int8, device="cpu")
        one = torch.ones(1, dtype=torch.int8, device="cpu").expand(below.numel())
        started.view(-1).scatter_add_(0, (row * (cells + 1) + place.ceil().long()).view(-1), one)
        number = started[:, :-1].cumsum(1, dtype=torch.int8)
        for shift in (-_BORDER, _BORDER):
            cell = (place + shift * cells).floor().long()
            number.view(-1)[(cell + row * cells)[(cell >= 0) & (cell < cells)]] = -1
        self._number = number.view(-1)

    def draw(self, which: Tensor | int, trials: Tensor, generator: torch.Generator | None) -> Tensor:
        """Numbers (K,) int32 of `trials` (K,) int32 with the probabilities of index `which`, (K,) int32 or one."""
        if int(trials.max()) <= self._most:
            return self._of_few(which, trials, generator).to(torch.int32)
        number = self._of_few(which, trials.clamp_max(self._most), generator).to(torch.int32)
        more = (trials > self._most).nonzero().squeeze(-1)
        others = which[more] if isinstance(which, Tensor) else which
        number[more] += self.draw(others, trials[more] - self._most, generator)
        return number

    def _of_few(self, which: Tensor | int, trials: Tensor, generator: torch.Generator | None) -> Tensor:
        """Numbers (K,) int8 of at most `most` trials."""
        cell, number = self._look_up(self._row(which, trials), generator)
        unsure = (number < 0).nonzero().squeeze(-1)
        if unsure.numel():
            number[unsure] = self._draw_exactly(self._row(which, trials)[unsure], cell[unsure], generator)
        return number

    def draw_some(self, trials: Tensor, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Places (J,) int64 and numbers (J,) int32 of the entries above 0 (and a few of 0), of one probability."""
        if int(trials.max()) > self._most:
            number = self.draw(0, trials, generator)
            place = number.nonzero().squeeze(-1)
            return place, number.index_select(0, place)
        cell, number = self._look_up(trials, generator)
        place = number.nonzero().squeeze(-1)
        some = number.index_select(0, place)
        unsure = (some < 0).nonzero().squeeze(-1)
        if unsure.numel():
            among = place[unsure]
            some[unsure] = self._draw_exactly(trials[among], cell[among], generator)
        return place, some.to(torch.int32)

    def _row(self, which: Tensor | int, trials: Tensor) -> Tensor:
        return trials if isinstance(which, int) and which == 0 else trials + which * (self._most + 1)

    def _look_up(self, row: Tensor, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Cells (K,) and their results (K,), -1 where a border lies inside the cell."""
        cell = sixteen_bits(row, generator).to(torch.int32).bitwise_and_(self._cells - 1)
        return cell, self._number.index_select(0, cell.add(row, alpha=self._cells))

    def _draw_exactly(self, row: Tensor, cell: Tensor, generator: torch.Generator | None) -> Tensor:
        """Results by the distribution function, with the uniform number completed inside its cell."""
        u = torch.rand(row.shape, dtype=torch.float64, device="cpu", generator=generator)
        u = u.add_(cell).mul_(1 / self._cells).add_(row)
        k = torch.searchsorted(self._below, u, right=True) - row * self._results
        # the end of a row is rounded
        return k.clamp_(min=0).minimum(row % (self._most + 1)).to(torch.int8)


class LagTable:
    """Draws of 0 ... K - 1 with given probabilities, from a table.

    Args:
        probabilities: (K,) float64 of sum 1, K at most 32767, on the CPU.
    """

    def __init__(self, probabilities: Tensor) -> None:
        self._below = probabilities.cumsum(0)[:-1]
        place = self._below * _VALUES
        started = torch.bincount(place.ceil().long().clamp_(max=_VALUES), minlength=_VALUES + 1)
        self._number = started.cumsum(0)[:_VALUES].to(torch.int16)
        for shift in (-_BORDER, _BORDER):
            cell = (place + shift * _VALUES).floor().long()
            self._number[cell[(cell >= 0) & (cell < _VALUES)]] = -1

    def draw(self, like: Tensor, generator: torch.Generator | None) -> Tensor:
        """Draws (N,) int64 for `like` (N,)."""
        cell = sixteen_bits(like, generator).to(torch.int32).bitwise_and_(_VALUES - 1)
        number = self._number.index_select(0, cell).long()
        unsure = (number < 0).nonzero().squeeze(-1)
        if unsure.numel():
            u = torch.rand(unsure.shape, dtype=torch.float64, device="cpu", generator=generator)
            number[unsure] = torch.searchsorted(self._below, u.add_(cell[unsure]).mul_(1 / _VALUES), right=True)
        return number


def sixteen_bits(like: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Draw uniform int16 numbers, four from every 64 random bits.

    Args:
        like: tensor, one number for each entry.
        generator: source of randomness.
    """
    words = torch.empty((like.numel() + 3) // 4, dtype=torch.int64, device=like.device)
    return words.random_(-(2**63), None, generator=generator).view(torch.int16)[: like.numel()]


def _distribution(probabilities: Tensor, most: int) -> Tensor:
    """P(K <= k), float64, a row for each probability and n = 0 ... `most`, a column for each k within reach."""
    mean = most * float(probabilities.max())
    results = min(most, math.ceil(mean + 10 * math.sqrt(mean) + 25))
    n = torch.arange(most + 1, dtype=torch.float64, device="cpu").unsqueeze(1)
    k = torch.arange(results + 1, dtype=torch.float64, device="cpu")
    ways = torch.lgamma(n + 1) - torch.lgamma(k + 1) - torch.lgamma(n - k + 1)  # none of k > n
    p = probabilities.view(-1, 1, 1)
    chance = torch.exp(ways + torch.xlogy(k, p) + (n - k) * torch.log1p(-p))
    return chance.cumsum_(-1).clamp_(max=1.0).view(-1, results + 1)


@functools.lru_cache(maxsize=32)
def binomial_table(probability: float, *, small: bool = False) -> BinomialTables:
    """Make the table of binomial numbers of one probability.

    Args:
        probability: probability of a success, in [0, 1/2].
        small: a table that takes less time to make, for fewer entries.
    """
    most = _RARE_TRIALS if probability <= _RARE and not small else _FEW_TRIALS
    return BinomialTables(torch.tensor([probability], dtype=torch.float64, device="cpu"), most, 256 if small else 1024)


@functools.cache
def _share_tables() -> tuple[tuple[BinomialTables, int], ...]:
    """Tables of shares in steps of 1/32 up to 1/2, and in steps of 1/1024 up to 1/16, with their steps."""
    coarse = torch.arange(17, dtype=torch.float64, device="cpu") / 32
    fine = torch.arange(64, dtype=torch.float64, device="cpu") / 1024
    return (BinomialTables(coarse, _FEW_TRIALS, 4096), 32), (BinomialTables(fine, _FEW_TRIALS, 512), 1024)


def draw_lower_share(trials: Tensor, share: Tensor, generator: torch.Generator | None) -> tuple[Tensor, Tensor, Tensor]:
    """Draw binomial numbers with a probability just below `share`, in steps of 1/32, then of 1/1024 of what is left.

    Args:
        trials: (K,) int32.
        share: probabilities (K,) in [0, 1/2].
        generator: source of randomness.

    Returns:
        Numbers (K,) int32, trials left (K,), and the probability (K,), below 1.1e-3, of each of those to be added.
    """
    # a share in steps of 1/32, then what is left of it in steps of 1/1024: trials pass the first time or the second
    number, rest, left = torch.zeros_like(trials), share, trials
    for table, steps in _share_tables():
        which = (rest * steps).to(torch.int32)
        lower = which * (1 / steps)
        rest = (rest - lower).div_(1 - lower)
        drawn = table.draw(which, left, generator)
        left = left - drawn
        number += drawn
    return number, left, rest


# ----------------------------------------------------------------------------------------------- rare events and splits


class Events(NamedTuple):
    """Entries that may have events, ascending: `place` (K,) int64 in the flattened input, `number` (K,), most >= 1."""

    place: Tensor
    number: Tensor


class _Candidates(NamedTuple):
    """Entries that may have events: place, trials, probability, first 16 bits of their uniform number."""

    place: Tensor
    many: Tensor
    share: Tensor
    bits: Tensor


def thin(counts: Tensor, probability: Tensor | float, generator: torch.Generator | None = None) -> Events:
    """Draw how many of `counts` pass, each with `probability`, as a list of the few entries that have any.

    Args:
        counts: tensor of any shape, float32 or float64, integers >= 0.
        probability: one number, or one for each entry, in [0, 1].
        generator: source of randomness.

    Returns:
        Events whose `number` has the dtype of `counts`. Binomial, exact, without gradient.

    Raises:
        UnitError: for counts below 0 or NaN.
    """
    flat = counts.detach().reshape(-1)
    p = torch.as_tensor(probability, dtype=torch.float64, device=flat.device).detach().reshape(-1)
    if p.numel() == 1 and flat.device.type == "cpu" and flat.numel() >= _WORTH_ONE_TABLE and 0 <= float(p) <= 0.5:
        return _thin_by_table(flat, float(p), generator)
    found = []
    for begin in range(0, max(flat.numel(), 1), _ENTRIES):
        at = slice(begin, begin + _ENTRIES)
        candidates = _find_candidates(flat[at], p if p.numel() == 1 else p[at], generator)
        found.append(candidates._replace(place=candidates.place + begin))
    return _decide_numbers(_concatenate(found), flat.dtype, generator)


def add_passing(counts: Tensor, probability: float, into: Tensor, generator: torch.Generator | None = None) -> None:
    """Add to `into` how many of `counts` pass, each with `probability`. Binomial, exact, without gradient.

    Args:
        counts: float32 or float64, integers >= 0, some 1e5 entries.
        probability: probability of passing, in [0, 1/2].
        into: tensor in the shape and dtype of `counts`, contiguous; changed in place.
        generator: source of randomness.
    """
    if counts.device.type == "cpu" and counts.numel() >= _WORTH_ONE_TABLE:
        trials, large, others = _split_large(counts.reshape(-1), probability, generator)
        table = binomial_table(probability, small=counts.numel() < _ENTRIES // 4)
        into.view(-1).add_(table.draw(0, trials, generator)).index_add_(0, large, others)
        return
    events = thin(counts, probability, generator)
    into.view(-1).scatter_add_(0, events.place, events.number)


def _thin_by_table(flat: Tensor, probability: float, generator: torch.Generator | None) -> Events:
    """`thin` of one probability in [0, 1/2], by a table."""
    places, numbers = [], []
    table = binomial_table(probability, small=flat.numel() < _ENTRIES // 4)
    for begin in range(0, flat.numel(), _ENTRIES):
        trials, large, others = _split_large(flat[begin : begin + _ENTRIES], probability, generator)
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


def _split_large(
    counts: Tensor, probability: float, generator: torch.Generator | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Trials (K,) int32 with 0 in place of large counts; places and numbers of those, by torch.binomial."""
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


def _find_candidates(n: Tensor, p: Tensor, generator: torch.Generator | None) -> _Candidates:
    """Entries that may have events, by 16 random bits each: P(any) <= n p. `p`: one for each of `n`, or one."""
    # one step more than the bound covers what rounding takes
    steps = (n * p.to(n.dtype)).mul_(_GRID).sub_(_GRID / 2 - 2).clamp_(max=_GRID / 2 - 1).to(torch.int16)
    bits = sixteen_bits(n, generator)
    place = (bits <= steps).nonzero().squeeze(-1)
    return _Candidates(place, n[place], p if p.numel() == 1 else p[place], bits[place])


def _concatenate(parts: list[_Candidates]) -> _Candidates:
    place, many, share, bits = zip(*parts, strict=True)
    one_share = all(s.numel() == 1 for s in share) and len(parts) > 1
    return _Candidates(torch.cat(place), torch.cat(many), share[0] if one_share else torch.cat(share), torch.cat(bits))


def _decide_numbers(chosen: _Candidates, dtype: torch.dtype, generator: torch.Generator | None) -> Events:
    """Binomial numbers of candidates.

    The number is at least k where u < P(K >= k). With the binomial moments x = n p, y = n (n - 1) p^2 / 2 and z = n (n
    - 1) (n - 2) p^3 / 6, Bonferroni's inequalities bound P(K >= 1) by [x - y, x - y + z], P(K >= 2) by [y - 2 z, y] and
    P(K >= 3) by z. In single precision, with a margin for its rounding, they settle most entries; the others are
    settled in double precision.
    """
    n, p = chosen.many.float(), chosen.share.float()
    finer = torch.rand(n.shape, dtype=torch.float32, device=n.device, generator=generator)
    u = finer.add(chosen.bits).add_(_GRID / 2).mul_(1 / _GRID)
    x = n * p
    y = (x - p).mul_(x).mul_(0.5)
    z = (x - 2 * p).mul_(y).mul_(1 / 3)
    below, above = u + _ROUNDING, u.sub_(_ROUNDING)
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
    """Binomial numbers by inversion from the top, float64: every round follows the entries that have more events.

    Entries with many expected events take a fresh draw instead, since `u` has not settled anything of them.
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
    """Draw how many of `counts` go to the first of two places, each with probability `share`.

    Tables draw with a probability just below the share, or its complement; of the trials left each is added with the
    small missing probability. Counts above 127, few draws and other devices than the CPU take torch.binomial.

    Args:
        counts: tensor of any shape, float32 or float64, integers >= 0.
        share: probability, in the shape and dtype of `counts`, in [0, 1].
        generator: source of randomness.

    Returns:
        Binomial numbers in shape and dtype of `counts`, exact, without gradient.
    """
    n, p = counts.detach(), share.detach()
    if n.device.type != "cpu" or n.numel() < _WORTH_TABLES:
        return torch.binomial(n, p.contiguous(), generator=generator)
    flat, shares = n.reshape(-1), p.reshape(-1)
    out = torch.empty_like(flat)
    found: list[_Candidates] = []
    for begin in range(0, flat.numel(), _ENTRIES):
        at = slice(begin, begin + _ENTRIES)
        many, p = flat[at], shares[at]
        less = torch.minimum(p, 1 - p)
        # NaN fits nowhere and is torch.binomial's to refuse
        if float(many.amax()) <= _FEW_TRIALS and float(less.amin()) >= 0:
            unfit = flat[:0].long()
        else:
            unfit = (many <= _FEW_TRIALS).logical_and_(less >= 0).logical_not_().nonzero().squeeze(-1)
        if unfit.numel() > _MOST_MISFITS * many.numel():
            out[at] = torch.binomial(many, p, generator=generator)
            continue
        trials = many.to(torch.int32)
        if unfit.numel():
            trials[unfit], less[unfit] = 0, 0.0
        number, left, missing = draw_lower_share(trials, less, generator)
        likely = p > 0.5
        candidates = _find_candidates(left.to(flat.dtype), missing, generator)
        # not `where`, which guesses at every entry
        out[at] = trials.sub_(number, alpha=2).mul_(likely).add_(number)
        if unfit.numel():
            out[at][unfit] = torch.binomial(many[unfit], p[unfit], generator=generator)
        found.append(candidates._replace(place=(candidates.place + begin) * 2 + likely[candidates.place]))
    if found:
        added = _decide_numbers(_concatenate(found), flat.dtype, generator)
        place = added.place >> 1
        out[place] += added.number * (1 - (added.place & 1) * 2)
    return out.view(n.shape)


# ----------------------------------------------------------------------------------------------- multinomial histograms


def _distribute(
    trials: int, weights: Tensor, chance: Callable[[Tensor], Tensor], generator: torch.Generator | None
) -> Tensor:
    """Counts (T, P) of `trials` in bins by conditional binomials, halving the bins level by level.

    `weights` (T, P); `chance` turns the sum of weights of neighbouring bins into the probability of their counts, up to
    a factor that is 1 for all bins together. Neighbours part last: counts are few then, with nearly equal shares, which
    `halve` draws fast.
    """
    number: Tensor | None = None
    if weights.numel() <= _SMALL_DRAW and weights.device.type == "cpu":
        sums = weights.double().cumsum(0)
        total = chance(sums[-1]).clamp_max_(1)
        number = torch.binomial(torch.full_like(total, float(trials)), total, generator=generator)
        if float(number.sum()) <= _FEW_COUNTS:
            return _one_by_one(number, chance(sums), generator).to(weights.dtype)
    levels = [weights]
    while levels[-1].shape[0] > 1:
        finer = levels[-1]
        even = finer.shape[0] // 2
        coarser = torch.add(finer[0 : 2 * even : 2], finer[1::2])
        levels.append(coarser if finer.shape[0] == 2 * even else torch.cat([coarser, finer[-1:]]))
    total = chance(levels.pop() if len(levels) > 1 else weights).clamp_max_(1)
    if number is None:
        number = torch.binomial(torch.full_like(total[0], float(trials)), total[0], generator=generator)
    counts = number.unsqueeze(0).to(weights.dtype)
    together = max(_PAIRS // max(weights.shape[1], 1), 1)
    while weights.shape[0] > counts.shape[0]:
        finer = levels.pop()
        even = finer.shape[0] // 2
        split = torch.empty_like(finer)
        for begin in range(0, even, together):
            parent = counts[begin : min(begin + together, even)]
            pair = slice(2 * begin, 2 * begin + 2 * parent.shape[0])
            sums = chance(finer[pair][0::2] + finer[pair][1::2]).clamp_min_(torch.finfo(finer.dtype).tiny)
            # 0/0 means no light and no counts
            share = chance(finer[pair][0::2]).div_(sums).clamp_max_(1)
            first = halve(parent, share, generator)
            split[pair][0::2] = first
            torch.sub(parent, first, out=split[pair][1::2])
        split[2 * even :] = counts[even:]
        counts = split
    return counts


def _one_by_one(number: Tensor, chances: Tensor, generator: torch.Generator | None) -> Tensor:
    """Counts (T, P) float64 of `number` (P,) events, each looked up in `chances` (T, P), cumulative over bins."""
    bins, pixels = chances.shape
    column = torch.arange(pixels, dtype=torch.float64)
    below = chances / chances[-1].clamp_min(torch.finfo(torch.float64).tiny)
    # one ascending list of all columns: column p lies between p and p + 1
    pixel = column.repeat_interleave(number.long())
    u = torch.rand(pixel.shape, dtype=torch.float64, generator=generator).add_(pixel)
    u = torch.minimum(u, torch.nextafter(pixel + 1, pixel))  # a sum that rounds up is another column's
    found = torch.searchsorted((below.T + column.unsqueeze(1)).reshape(-1), u, right=True)
    return torch.bincount(found, minlength=bins * pixels).view(pixels, bins).T.double()


def sample_multinomial(trials: int, probabilities: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Draw multinomial counts along time by conditional binomials over a tree of bins: T binomials a pixel.

    Args:
        trials: number of trials, up to 2^53.
        probabilities: (..., T, H, W), float32 or float64, sum over T at most 1; the rest is "no event".
        generator: source of randomness.

    Returns:
        Counts in shape and dtype of `probabilities`, without gradient; above 2^24 trials float32 is drawn in float64.

    Raises:
        ShapeError: for fewer than 3 dimensions.
        UnitError: for negative or non-finite probabilities.
    """
    return _sample_tree(trials, probabilities, lambda p: p.clone(), generator, "sample_multinomial")


def sample_first_photons(cycles: int, rate: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Draw the histogram of the first photons of `cycles` cycles, the multinomial of `first_photon_probabilities`.

    Of the photons that are first in one of two neighbouring stretches of time a share (1 - exp(-a)) / (1 - exp(-a - b))
    is in the earlier one, whatever came before: no sums over earlier bins are needed.

    Args:
        cycles: number of cycles.
        rate: photons per cycle and bin, (..., T, H, W).
        generator: source of randomness.

    Returns, Raises:
        As `sample_multinomial`.
    """
    return _sample_tree(cycles, rate, lambda r: r.neg().expm1_().neg_(), generator, "sample_first_photons")


def _sample_tree(
    trials: int, weights: Tensor, chance: Callable[[Tensor], Tensor], generator: torch.Generator | None, where: str
) -> Tensor:
    """`_distribute` over the pixels of (..., T, H, W), in threads for large data."""
    if weights.ndim < 3:
        raise ShapeError(f"{where}: expected (..., T, H, W), got {tuple(weights.shape)}.")
    w = weights.detach()
    if w.numel() == 0:
        return w.clone()
    check_rates(w, where)
    work = torch.float64 if trials > WHOLE_FLOAT32 or w.dtype == torch.float64 else torch.float32
    bins, pixels = w.shape[TIME], w.shape[-2] * w.shape[-1]
    columns = w.to(work).reshape(-1, bins, pixels)

    def draw(piece: Tensor, own: torch.Generator | None) -> Tensor:
        # one pass per leading index, not per pixel
        images = [_distribute(trials, image, chance, own) for image in piece]
        return torch.stack(images) if len(images) > 1 else images[0].unsqueeze(0)

    if columns.shape[0] > 1 and pixels < _SMALL_IMAGE:
        # many small images: one wide one instead
        wide = columns.movedim(1, 0).reshape(1, bins, -1)
        counts = _in_columns(draw, wide, generator).view(bins, -1, pixels).movedim(0, 1)
    else:
        counts = _in_columns(draw, columns, generator)
    return counts.reshape(w.shape).to(w.dtype)
