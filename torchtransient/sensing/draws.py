"""Many binomial, multinomial and Poisson draws at once, for histograms of a whole image.

torch draws these distributions on one core. Large draws on the CPU are therefore cut into a fixed number of pieces,
each with a generator seeded from the one given, and done by as many threads as `torch.get_num_threads()` says: the
result depends on the generator, never on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import holds
from torchtransient.sensing.layout import TIME
from torchtransient.sensing.thinning import halve

Result = TypeVar("Result")

_PIECES = 4
_SMALL_IMAGE = 1 << 12  # pixels, below which several images are drawn side by side
_WORTH_THREADS = 1 << 17  # numbers to draw, above which starting threads costs less than it saves
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

    threads = min(torch.get_num_threads(), len(arguments))
    if threads == 1:
        return [run(given, seed) for given, seed in zip(arguments, seeds, strict=True)]
    # a pool for each call: it costs less than a millisecond, and processes forked later inherit no dead threads
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(run, arguments, seeds))


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
    levels = [weights]
    while levels[-1].shape[0] > 1:
        finer = levels[-1]
        even = finer.shape[0] // 2
        coarser = torch.add(finer[0 : 2 * even : 2], finer[1::2])
        levels.append(coarser if finer.shape[0] == 2 * even else torch.cat([coarser, finer[-1:]]))
    chances = [chance(level) for level in levels[1:]]
    total = (chances[-1] if chances else chance(weights)).clamp_max(1)
    counts = torch.binomial(torch.full_like(total, float(trials)), total, generator=generator)
    while chances:
        whole, finer = chances.pop(), levels[len(chances)]
        even = finer.shape[0] // 2
        share = chances[-1][0 : 2 * even : 2] if chances else chance(finer[0 : 2 * even : 2])
        # 0/0 means no light and no counts
        share = share.div(whole[:even].clamp_min(torch.finfo(finer.dtype).tiny)).clamp_max_(1)
        split = torch.empty_like(finer)
        first = halve(counts[:even], share, generator)
        split[0 : 2 * even : 2] = first
        torch.sub(counts[:even], first, out=split[1::2])
        split[2 * even :] = counts[even:]
        counts = split
    return counts


def _any_photon(rate: Tensor) -> Tensor:
    return torch.expm1(-rate).neg_()


def _as_it_is(probability: Tensor) -> Tensor:
    return probability


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
