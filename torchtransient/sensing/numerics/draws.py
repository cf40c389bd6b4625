"""Many binomial, multinomial and Poisson draws at once, for histograms of a whole image.

torch draws these distributions on one core. Large draws on the CPU are therefore cut into a fixed number of pieces,
each with a generator seeded from the one given, and done by as many threads as `torch.get_num_threads()` says: the
result depends on the generator, never on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import holds
from torchtransient.sensing.base.layout import TIME
from torchtransient.sensing.numerics.thinning import halve
from torchtransient.sensing.numerics.worker_threads import side_by_side

Result = TypeVar("Result")

_PIECES = 4
_BLOCK = 1 << 16  # pairs of bins at a time, so that temporaries stay in the cache
_SMALL_IMAGE = 1 << 12  # pixels, below which several images are drawn side by side
_WORTH_THREADS = 1 << 17  # numbers to draw, above which starting threads costs less than it saves
_SMALL_DRAW = 1 << 14  # bins of all pixels, up to which few counts are drawn one by one
_FEW_COUNTS = 1 << 13
WHOLE_FLOAT32 = 2.0**24  # above, float32 skips whole numbers


def check_rates(rate: Tensor, where: str) -> Tensor:
    """`rate` when all of it is finite and >= 0, else UnitError: torch.binomial never returns from a NaN count, and the
    formulas of detectors that saturate give plausible counts of negative light. Not looked at where nobody can
    (`floating.holds`).
    """
    low, high = torch.aminmax(rate.detach()) if rate.numel() else (rate.new_zeros(()), rate.new_zeros(()))
    if not holds((low >= 0) & torch.isfinite(high)):
        raise UnitError(
            f"{where}: expected finite values >= 0, got {float(low):g} to {float(high):g}. Look for NaN upstream; "
            "clamp or use softplus where a network gives the rate."
        )
    return rate


def by_pieces(
    job: Callable[[Tensor, int, torch.Generator | None], Result], data: Tensor, generator: torch.Generator | None
) -> list[Result]:
    """`job(piece, begin, generator)` of consecutive pieces along dimension 0, in threads for large data on the CPU.

    `begin` is the place of the piece's first entry along that dimension.
    """
    if data.device.type != "cpu" or data.numel() < _WORTH_THREADS or data.shape[0] < _PIECES:
        return [job(data, 0, generator)]
    pieces = data.tensor_split(_PIECES)
    begins = [0]
    for piece in pieces[:-1]:
        begins.append(begins[-1] + piece.shape[0])
    return _in_threads(job, list(zip(pieces, begins, strict=True)), generator)


def _in_threads(
    job: Callable[..., Result], arguments: Sequence[tuple[Any, ...]], generator: torch.Generator | None
) -> list[Result]:
    seeds = torch.randint(0, 2**63 - 1, (len(arguments),), generator=generator).tolist()

    def run(given: tuple[Any, ...], seed: int) -> Result:
        own = torch.Generator().manual_seed(seed)
        with torch.no_grad():  # grad mode is per thread
            return job(*given, own)

    return side_by_side(run, arguments, seeds)


def _in_columns(
    draw: Callable[[Tensor, torch.Generator | None], Tensor], data: Tensor, generator: torch.Generator | None
) -> Tensor:
    """`draw` over pieces of `data` along its last dimension; in threads for large tensors on the CPU."""
    if data.device.type != "cpu" or data.numel() < _WORTH_THREADS or data.shape[-1] < _PIECES:
        return draw(data, generator)
    result = torch.empty_like(data, memory_format=torch.contiguous_format)
    places = zip(data.tensor_split(_PIECES, dim=-1), result.tensor_split(_PIECES, dim=-1), strict=True)
    _in_threads(lambda piece, into, own: into.copy_(draw(piece, own)), list(places), generator)
    return result


def fast_poisson(mean: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """`torch.poisson` on several cores. Means have to be finite and >= 0, in float32 or float64."""
    return _in_columns(lambda m, g: torch.poisson(m, generator=g), mean, generator)


def _distribute(
    trials: int, weights: Tensor, chance: Callable[[Tensor], Tensor], generator: torch.Generator | None
) -> Tensor:
    """Counts (T, P) of `trials` in bins by conditional binomials, halving the bins level by level.

    `weights`: (T, P). `chance` turns the sum of the weights of neighbouring bins into the probability of their counts,
    or that up to a factor which is 1 for all bins together. Neighbours part last: there are few counts then, and
    their shares are nearly equal, which `halve` draws fast.
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
    together = max(_BLOCK // max(weights.shape[1], 1), 1)
    while weights.shape[0] > counts.shape[0]:
        finer = levels.pop()
        even = finer.shape[0] // 2
        split = torch.empty_like(finer)
        for begin in range(0, even, together):
            parent = counts[begin : min(begin + together, even)]
            pair = slice(2 * begin, 2 * begin + 2 * parent.shape[0])
            first = halve(parent, _first_of_two(finer[pair], chance), generator)
            split[pair][0::2] = first
            torch.sub(parent, first, out=split[pair][1::2])
        split[2 * even :] = counts[even:]
        counts = split
    return counts


def _one_by_one(number: Tensor, chances: Tensor, generator: torch.Generator | None) -> Tensor:
    """Counts (T, P), float64, of which every column has its `number` (P,), each looked up by itself.

    `chances`: (T, P) float64 of an event up to the end of each bin.
    """
    bins, pixels = chances.shape
    column = torch.arange(pixels, dtype=torch.float64)
    below = chances / chances[-1].clamp_min(torch.finfo(torch.float64).tiny)
    # one ascending list of all columns: column p lies between p and p + 1
    pixel = column.repeat_interleave(number.long())
    u = torch.rand(pixel.shape, dtype=torch.float64, generator=generator).add_(pixel)
    u = torch.minimum(u, torch.nextafter(pixel + 1, pixel))  # a sum that rounds up is another column's
    found = torch.searchsorted((below.T + column.unsqueeze(1)).reshape(-1), u, right=True)
    return torch.bincount(found, minlength=bins * pixels).view(pixels, bins).T.double()


def _first_of_two(weights: Tensor, chance: Callable[[Tensor], Tensor]) -> Tensor:
    """Share of the counts of rows 0 and 1, 2 and 3, ... that is in the first of the two."""
    first = weights[0::2]
    whole = chance(first + weights[1::2]).clamp_min_(torch.finfo(weights.dtype).tiny)
    # 0/0 means no light and no counts
    return chance(first).div_(whole).clamp_max_(1)


def _any_photon(rate: Tensor) -> Tensor:
    return rate.neg().expm1_().neg_()


def _as_it_is(probability: Tensor) -> Tensor:
    return probability.clone()


def sample_multinomial(trials: int, probabilities: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Multinomial counts of `trials` along time for probabilities (..., T, H, W) whose sum is at most 1.

    The rest of the probability is "no event" and not returned. Drawn by conditional binomials over a tree of bins,
    T binomials a pixel and never a draw a trial, exact for any number of trials up to 2^53. Same shape and dtype as
    `probabilities` (float32 or float64; above 2^24 trials float32 is drawn in float64 and rounded). No gradient.
    Raises ShapeError for fewer than 3 dimensions, UnitError for negative or non-finite probabilities.
    """
    return _sample_tree(trials, probabilities, _as_it_is, generator, "sample_multinomial")


def sample_first_photons(cycles: int, rate: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Histogram of the first photon of each of `cycles` cycles, for `rate` (..., T, H, W) photons per cycle and bin.

    The multinomial of `first_photon_probabilities`. Nothing is summed over earlier bins: of the photons first in one
    of two neighbouring stretches of time, those in the earlier are a share (1 - exp(-a)) / (1 - exp(-a - b)) that
    does not depend on what came before. Otherwise as `sample_multinomial`.
    """
    return _sample_tree(cycles, rate, _any_photon, generator, "sample_first_photons")


def _sample_tree(
    trials: int, weights: Tensor, chance: Callable[[Tensor], Tensor], generator: torch.Generator | None, where: str
) -> Tensor:
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
