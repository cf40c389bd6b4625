"""Variances of two ways to render a scene, by a few short runs of each."""

from __future__ import annotations

import torch

from torchtransient.rendering.error_bars import local_mean
from torchtransient.rendering.film_layout import measured
from torchtransient.rendering.job import mix_seed
from torchtransient.rendering.renderer import TransientRenderer

# Runs of each renderer, and their samples per pixel.
RUNS, SPP = 4, 64
_SEED = 0x5A4E


def variances(one: TransientRenderer, other: TransientRenderer, seed: int, relative: bool) -> tuple[float, float]:
    """Return the mean variance of bins or gates of two renderers of one scene.

    Args:
        one, other: the renderers.
        seed: seed of the runs.
        relative: over the squared mean of a bin and its neighbours, and 1 % of the mean over all; gates have
            neighbours in the picture alone.
    """
    runs = _runs(one, mix_seed(seed, _SEED)), _runs(other, seed)
    size = torch.ones(())
    if relative:
        near = local_mean(torch.cat(runs).mean(0), (-3, -2, -1) if one.film.has_bins else (-2, -1))
        size = near.square() + (0.01 * near.mean()).square()
    found = [float((x.var(0) / size).mean()) for x in runs]
    return found[0], found[1]


def _runs(renderer: TransientRenderer, seed: int) -> torch.Tensor:
    """Return the bins of some renders, means over channels, (runs, T, H, W)."""
    with torch.no_grad():
        outputs = (renderer(seed=mix_seed(seed, run), spp=SPP) for run in range(RUNS))
        return torch.stack([measured(out, renderer.film.measures).mean(0) for out in outputs])
