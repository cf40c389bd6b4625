"""Choice between ``transient_path`` and ``transient_path_reuse`` by the relative error of single bins."""

from __future__ import annotations

from collections.abc import Callable

import torch

from torchtransient.errors import SceneError
from torchtransient.rendering.error_bars import local_mean
from torchtransient.rendering.films import measured
from torchtransient.rendering.job import mix_seed
from torchtransient.rendering.renderer import TransientRenderer

# Runs of each integrator, their samples per pixel, and the largest side of their films.
RUNS, SPP, PIXELS = 4, 64, 64
# Path reuse takes up to twice the time of as many paths.
LEAST_GAIN = 2.0
_SEED = 0x5A4E


def prefers_reuse(renderer: Callable[[str], TransientRenderer], seed: int, gates: bool) -> tuple[bool, str]:
    """Return whether path reuse has the lower relative error in equal time, and the reason as text.

    Args:
        renderer: makes a renderer with the integrator of a name.
        seed: seed of the runs.
        gates: the film has gates, whose order says nothing about time.
    """
    try:
        shared = _runs(renderer("transient_path_reuse"), seed)
    except SceneError as error:
        return False, str(error).removeprefix("transient_path_reuse: ").split("; ")[0]
    plain = _runs(renderer("transient_path"), mix_seed(seed, _SEED))
    near = local_mean(torch.cat([plain, shared]).mean(0), (-3, -2, -1)[gates:])
    size = near.square() + (0.01 * near.mean()).square()
    errors = [float((runs.var(0) / size).mean()) for runs in (plain, shared)]
    if not errors[0] > 0:
        return False, f"no light in {RUNS} runs of {SPP} samples per pixel"
    gain = errors[0] / errors[1]
    return gain >= LEAST_GAIN, (
        f"relative variance of single bins {errors[0]:.2g}, with path reuse {errors[1]:.2g}, {SPP} samples per pixel"
    )


def _runs(renderer: TransientRenderer, seed: int) -> torch.Tensor:
    """Return the bins of some renders, means over channels, (runs, T, H, W)."""
    with torch.no_grad():
        outputs = (renderer(seed=mix_seed(seed, run), spp=SPP) for run in range(RUNS))
        return torch.stack([measured(out, renderer.film.measures).mean(0) for out in outputs])
