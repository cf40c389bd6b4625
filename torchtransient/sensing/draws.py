"""Many binomial, multinomial and Poisson draws at once, for histograms of a whole image.

torch draws these distributions on one core. Large draws on the CPU are therefore cut into a fixed number of pieces,
each with a generator seeded from the one given, and done by as many threads as `torch.get_num_threads()` says: the
result depends on the generator, never on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor

from torchtransient.errors import ShapeError, UnitError
from torchtransient.sensing.layout import TIME

_PIECES = 4
_WORTH_THREADS = 1 << 17  # numbers to draw, above which starting threads costs less than it saves
_WHOLE_FLOAT32 = 2.0**24  # above, float32 skips whole numbers


def _in_pieces(
    draw: Callable[[Tensor, torch.Generator | None], Tensor], data: Tensor, generator: torch.Generator | None
) -> Tensor:
    """`draw` over pieces of `data` along its last dimension; in threads for large tensors on the CPU."""
    if data.device.type != "cpu" or data.numel() < _WORTH_THREADS or data.shape[-1] < _PIECES:
        return draw(data, generator)
    seeds = torch.randint(0, 2**63 - 1, (_PIECES,), generator=generator).tolist()
    pieces = data.tensor_split(_PIECES, dim=-1)
    outer = torch.get_num_threads()

    def job(piece: Tensor, seed: int) -> Tensor:
        own = torch.Generator().manual_seed(seed)
        with torch.no_grad():  # grad mode is per thread
            return draw(piece, own)

    if outer == 1:
        results = [job(p, s) for p, s in zip(pieces, seeds, strict=True)]
    else:
        with ThreadPoolExecutor(min(outer, _PIECES)) as pool:
            results = list(pool.map(job, pieces, seeds))
    return torch.cat(results, dim=-1)


def fast_poisson(mean: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """`torch.poisson` on several cores. Means have to be finite and >= 0, in float32 or float64."""
    return _in_pieces(lambda m, g: torch.poisson(m, generator=g), mean, generator)


def _split(totals: Tensor, weights: Tensor, generator: torch.Generator | None) -> Tensor:
    """Distribute `totals` (P,) over `weights` (T, P) by conditional binomials, halving the bins level by level."""
    levels = [weights]
    while levels[-1].shape[0] > 1:
        finer = levels[-1]
        half = (finer.shape[0] + 1) // 2
        coarser = finer[:half].clone()
        coarser[: finer.shape[0] - half] += finer[half:]
        levels.append(coarser)
    counts = totals.unsqueeze(0)
    for finer, coarser in zip(reversed(levels[:-1]), reversed(levels[1:]), strict=True):
        pairs = finer.shape[0] - coarser.shape[0]
        # at most 1, as a rounded sum of two positive numbers is not below either; 0/0 means no light and no counts
        share = finer[:pairs] / coarser[:pairs].clamp_min(torch.finfo(finer.dtype).tiny)
        first = torch.binomial(counts[:pairs], share, generator=generator)
        counts = torch.cat([first, counts[pairs:], counts[:pairs] - first])
    return counts


def sample_multinomial(trials: int, probabilities: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Multinomial counts of `trials` along time for probabilities (..., T, H, W) whose sum is at most 1.

    The rest of the probability is "no event" and not returned. Drawn by conditional binomials over a tree of bins,
    T binomials a pixel and never a draw a trial, exact for any number of trials up to 2^53. Same shape and dtype as
    `probabilities` (float32 or float64; above 2^24 trials float32 is drawn in float64 and rounded). No gradient.
    Raises ShapeError for fewer than 3 dimensions, UnitError for negative or non-finite probabilities.
    """
    if probabilities.ndim < 3:
        raise ShapeError(f"sample_multinomial: expected (..., T, H, W), got {tuple(probabilities.shape)}.")
    p = probabilities.detach()
    if p.numel() == 0:
        return p.clone()
    low, high = torch.aminmax(p)
    if not bool(low >= 0) or not bool(torch.isfinite(high)):
        raise UnitError(f"sample_multinomial: expected finite values >= 0, got {float(low):g} to {float(high):g}.")
    work = torch.float64 if trials > _WHOLE_FLOAT32 or p.dtype == torch.float64 else torch.float32
    bins, pixels = p.shape[TIME], p.shape[-2] * p.shape[-1]
    columns = p.to(work).reshape(-1, bins, pixels)

    def draw(piece: Tensor, own: torch.Generator | None) -> Tensor:
        rows = []
        for image in piece:  # one pass per leading index, not per pixel
            detected = image.sum(0, dtype=torch.float64).clamp_max(1.0).to(work)
            totals = torch.binomial(torch.full_like(detected, float(trials)), detected, generator=own)
            rows.append(_split(totals, image, own))
        return torch.stack(rows)

    if columns.shape[0] > 1 and pixels < 4 * columns.shape[0]:
        # many small images: one wide one instead
        wide = columns.movedim(1, 0).reshape(1, bins, -1)
        counts = _in_pieces(draw, wide, generator).view(bins, -1, pixels).movedim(0, 1)
    else:
        counts = _in_pieces(draw, columns, generator)
    return counts.reshape(p.shape).to(p.dtype)
