"""`tt.cost_of_accuracy`: what a smaller error of a transient, or of a gradient, costs in time."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.accuracy.measure import Candidate, Estimates, Task, checked_counts, measure
from torchtransient.accuracy.report import AccuracyReport, Choice
from torchtransient.checks import as_whole, shown
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.rendering.films import layout_of_output
from torchtransient.rendering.output import RenderOutput
from torchtransient.rendering.renderer import TransientRenderer
from torchtransient.scene.opaque import opaque
from torchtransient.scene.variant import active_variant

Loss = Callable[[RenderOutput], torch.Tensor]


def cosine_over_the_window(out: RenderOutput) -> torch.Tensor:
    """The default loss: the transient times one period of a cosine over the time axis, summed over bins, mean over
    pixels; of phasors, the sum of their real parts, mean over pixels.

    It is linear in what is measured, so that its gradient has no bias, and it changes with energy and arrival time.
    """
    response = _response(out)
    pixels = response.shape[-2] * response.shape[-1]
    if response.is_complex():
        return response.real.sum() / pixels
    bins = response.shape[-3]
    phase = 2.0 * math.pi * (torch.arange(bins, device=response.device) + 0.5) / bins
    return (response * torch.cos(phase)[:, None, None]).sum() / pixels


def _response(out: RenderOutput) -> torch.Tensor:
    """What the film of a render measured."""
    film = layout_of_output(out)
    response = None if film is None else film.tensor(out)
    if response is None:
        raise ShapeError("cost_of_accuracy: expected a render with what its film measured, got a steady image alone.")
    return response


@opaque
def cost_of_accuracy(
    renderer: TransientRenderer,
    spp: Sequence[int] = (16, 64, 256, 1024),
    gradients: Sequence[str] = (),
    *,
    reference_spp: int | None = None,
    repeats: int = 4,
    samplers: Sequence[str] = ("owen", "independent"),
    temporal_filters: Sequence[str] | None = None,
    loss: Loss = cosine_over_the_window,
    seed: int = 0,
    progress: bool = True,
) -> AccuracyReport:
    """Measure the error of the transient, and of gradients, against seconds and samples per pixel.

    `renderer` renders at the current values of its parameters; `gradients` are keys among them, each the derivative of
    `loss`, a scalar of the `RenderOutput`. Every pair of `samplers` (plugin names) and `temporal_filters`
    ("box", "tent", "gaussian"; None: the one that the renderer uses) is one curve. Where a filter has no slope in time
    (box) and a key moves path lengths, there is no gradient: that filter's curve then shows the transient alone, and
    `settings` of the report names the pair under "without_gradients".

    Errors are squared and relative, over `repeats` independent runs at each of `spp`, either against a reference of
    `reference_spp` samples (at least four times the largest `spp`) or, with None, in pairs of runs (`repeats` even).
    Every curve is compared with its own expectation: what a filter blurs does not count as an error. Seconds are
    medians of wall time: a forward render for the transient, render and backward for gradients; the runs of all curves
    take turns. A loss that is not linear has a biased gradient, which only a reference shows, and only in part.

    A few runs do not show that a gradient is rarely very wrong. Of every gradient 96 more runs, of 16 samples per pixel
    at most, show the tail of its distribution (`CostPoint.tail`): where Hill's index of it is below 2, so that the
    variance is infinite, or one run holds more than a third of the squared deviations, the errors of the curve are NaN
    and the table says "heavy tailed: no error". Of others, the standard error of the squared error comes from the
    spread of these runs. Outliers that come less than about once in 30 of them stay unseen.

    Of a phasor film the quantity "phasor" takes the place of "transient": real and imaginary parts, frequencies in the
    place of bins; of a gated film "gated". Both have no temporal filters to choose from.

    Returns an `AccuracyReport` with `table()`, `plot(path)` and `to_json(path)`. Raises ArgumentError for what is no
    renderer, SceneError for a key or sampler
    that the renderer does not know and UnitError for counts out of range. A temporary copy of the largest cube is held
    per curve.
    """
    if not isinstance(renderer, TransientRenderer):
        raise ArgumentError(
            f"cost_of_accuracy: expected a tt.TransientRenderer, got {type(renderer).__name__}. Make one of a scene: "
            "tt.TransientRenderer(scene, parameters=[...])."
        )
    counts = checked_counts(spp, repeats, reference_spp)
    if (first := as_whole(seed)) is None:
        raise UnitError(f"cost_of_accuracy: seed: expected a whole number, got {shown(seed)}.")
    missing = [key for key in gradients if key not in renderer.values]
    if missing:
        raise SceneError(
            f"gradients: {missing} are not parameters of this renderer, which has {list(renderer.values)}; "
            "name them in TransientRenderer(parameters=[...])"
        )
    filters = [renderer.effective_filter or "auto"] if temporal_filters is None else list(temporal_filters)
    if not samplers or not filters:
        raise ArgumentError("expected at least one sampler and one temporal filter, got none")
    axis = renderer.axis
    candidates: dict[Choice, Candidate] = {}
    without: list[str] = []
    for sampler in samplers:
        for name in filters:
            twin = renderer.variation(sampler=sampler, temporal_filter=name)
            choice = Choice(sampler, twin.effective_filter)
            candidate = {"values": _values_task(twin)}
            if gradients and twin.has_slope_for(gradients):
                candidate["gradients"] = _gradients_task(twin, tuple(gradients), loss)
            elif gradients:
                without.append(str(choice))
            candidates[choice] = candidate
    settings = {
        "scene": repr(renderer.scene),
        "variant": renderer.scene.variant,
        "spp": counts,
        "gradients": list(gradients),
        "loss": getattr(loss, "__name__", type(loss).__name__),
        "measured": repr(renderer.film.settings),
        "time_axis": axis and [axis.start_opl, axis.bin_width_opl, axis.num_bins],
        "without_gradients": without,
    }
    # One switch of variant for all runs: a switch within each would be timed with it.
    with active_variant(renderer.scene.variant):
        return measure(
            candidates,
            counts,
            reference_spp=reference_spp,
            repeats=repeats,
            seed=first,
            progress=progress,
            settings=settings,
        )


def _values_task(renderer: TransientRenderer) -> Task:
    film = renderer.film

    def run(spp: int, seed: int) -> Estimates:
        with torch.no_grad():
            out = renderer(seed=seed, spp=spp)
        response = _response(out)
        numbers = torch.view_as_real(response) if film.is_complex else response
        return Estimates({film.measures: _array(numbers)}, renderer.samples_drawn(spp))

    # After the film's own dimension come rows and columns, and real and imaginary parts of complex numbers.
    return Task(run, {film.measures: -4 if film.is_complex else -3})


def _gradients_task(renderer: TransientRenderer, keys: tuple[str, ...], loss: Loss) -> Task:
    # The samples of the derivative are as many as those of the render, whatever the renderer was told.
    renderer.spp_grad = None

    def run(spp: int, seed: int) -> Estimates:
        values = {key: renderer.values[key].detach().clone().requires_grad_(key in keys) for key in renderer.values}
        out = renderer(values, seed=seed, spp=spp)
        found = torch.autograd.grad(loss(out), [values[key] for key in keys])
        arrays = {f"d loss / d {key}": _array(gradient) for key, gradient in zip(keys, found, strict=True)}
        return Estimates(arrays, renderer.samples_drawn(spp))

    return Task(run, tails=True)


def _array(tensor: torch.Tensor) -> NDArray[np.float32]:
    """On the CPU a view; from a GPU a copy, which waits for it."""
    return np.asarray(tensor.detach().cpu().numpy(), dtype=np.float32)
