"""`tt.accuracy.gradient_errors`: a gradient with its error, from passes with seeds of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
import torch

from torchtransient.accuracy.errors_of_estimates import TAIL_RUNS, Tail
from torchtransient.checks import count, function, mapping, several
from torchtransient.errors import ArgumentError, UnitError
from torchtransient.rendering.job import mix_seed
from torchtransient.rendering.output import RenderOutput
from torchtransient.rendering.progress import Bar
from torchtransient.rendering.renderer import TransientRenderer

_PASS, _TAIL = 0x96AD, 0x7A11
# Samples of a run that shows the tail.
_TAIL_SPP = 16


@dataclass(frozen=True)
class GradientEstimate:
    """Gradient of a loss by one key.

    Attributes:
        value: mean over the passes, in the shape of the parameter.
        standard_error: standard error of ``value``, entry by entry; NaN where the tail is heavy: the runs do not tell
            the variance.
        tail: distribution of short runs; None if it was not looked at.
        passes, spp: number of passes, and samples per pixel of each.
    """

    _: KW_ONLY
    value: torch.Tensor
    standard_error: torch.Tensor
    tail: Tail | None
    passes: int
    spp: int

    def __str__(self) -> str:
        size = float(self.value.double().norm())
        shown = f"{float(self.value):.4g}" if self.value.numel() == 1 else f"norm {size:.4g}"
        if self.tail is not None and self.tail.heavy:
            return f"{shown}, heavy tailed: no error"
        return f"{shown} +- {float(self.standard_error.double().norm()):.2g}"


def gradient_errors(
    renderer: TransientRenderer,
    loss: Callable[[RenderOutput], torch.Tensor],
    keys: Sequence[str] | None = None,
    *,
    values: Mapping[str, Any] | None = None,
    spp: int | None = None,
    passes: int = 8,
    seed: int = 0,
    tails: bool = True,
    progress: bool = True,
) -> dict[str, GradientEstimate]:
    """Measure the gradient of a loss and its standard error.

    The gradient is the mean over ``passes``, each a render and a backward pass with seeds of its own. Few passes of
    many samples have the smaller error with the sampler ``owen``, many know it better: of 8 it is known to 27 %. A loss
    that is not linear in the render has a biased gradient, which the passes do not show.

    Args:
        renderer: renderer of the scene.
        loss: scalar of a :class:`~torchtransient.RenderOutput`.
        keys: parameters of the renderer, None for all.
        values: values by key, in place of the renderer's.
        spp: samples per pixel of each pass, None for the renderer's.
        passes: number of passes, at least 2.
        seed: seed of the measurement.
        tails: look at the distribution of 96 runs of 16 samples too: where Hill's index of its tail is below 2, or one
            run has a third of the squared deviations, there is no error.
        progress: show a progress bar.

    Returns:
        By key, the :class:`GradientEstimate`.

    Raises:
        ArgumentError: for a renderer without parameters, and a loss that does not depend on them.
        UnitError: for fewer than 2 passes.
        GradientError: for parameters without a derivative.
    """
    function("gradient_errors: loss", loss, "a function of a RenderOutput")
    number = count("gradient_errors: passes", passes, 2, UnitError)
    known = tuple(renderer.values)
    asked = known if keys is None else tuple(several("gradient_errors: keys", keys, "names of parameters"))
    if not known:
        raise ArgumentError("gradient_errors: the renderer has no parameters; make it with parameters=[...].")
    if not asked or not set(asked) <= set(known):
        raise ArgumentError(f"gradient_errors: expected some of the renderer's parameters {list(known)}, got {asked}.")
    given = {} if values is None else dict(mapping("gradient_errors: values", values, "values by key"))
    if not set(given) <= set(known):
        raise ArgumentError(f"gradient_errors: expected values of {list(known)}, got some of {sorted(given)}.")

    def gradients(own_seed: int, samples: int | None) -> tuple[list[torch.Tensor], int]:
        leaves = {key: torch.as_tensor(given.get(key, renderer.values[key])).detach().float().clone() for key in known}
        for key in asked:
            leaves[key].requires_grad_()
        with torch.enable_grad():
            out = renderer(leaves, seed=own_seed, spp=samples)
            result = loss(out)
            if not isinstance(result, torch.Tensor) or result.numel() != 1 or not result.requires_grad:
                raise ArgumentError("gradient_errors: expected a loss that is one number and depends on the render.")
            found = torch.autograd.grad(result, [leaves[key] for key in asked])
        return [one.detach() for one in found], out.stats.spp

    shown = Bar("gradients") if progress else None
    total, done = number + (TAIL_RUNS if tails else 0), 0
    try:
        runs: list[list[torch.Tensor]] = []
        drawn = 0
        for i in range(number):
            found, drawn = gradients(mix_seed(seed, _PASS + i), spp)
            runs.append(found)
            done += 1
            if shown is not None:
                shown(done / total)
        short: list[list[torch.Tensor]] = []
        for i in range(TAIL_RUNS if tails else 0):
            short.append(gradients(mix_seed(seed, _TAIL + i), min(_TAIL_SPP, drawn))[0])
            done += 1
            if shown is not None:
                shown(done / total)
    finally:
        if shown is not None:
            shown.close()
    results = {}
    for n, key in enumerate(asked):
        all_runs = torch.stack([run[n] for run in runs])
        tail = Tail.of([np.asarray(run[n].cpu(), dtype=np.float32) for run in short]) if tails else None
        error = all_runs.std(0) / number**0.5
        if tail is not None and tail.heavy:
            error = torch.full_like(error, torch.nan)
        results[key] = GradientEstimate(
            value=all_runs.mean(0), standard_error=error, tail=tail, passes=number, spp=drawn
        )
    return results
