"""Errors of renders and gradients by the number of samples, and the cost of an accuracy."""

from __future__ import annotations

import itertools
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from torchtransient.accuracy.errors_of_estimates import NOT_MEASURED, TAIL_RUNS, ErrorTally, Reference, Tail, relative
from torchtransient.accuracy.report import AccuracyReport, Choice, CostPoint
from torchtransient.axes import TimeAxis
from torchtransient.checks import Numbers, as_whole, function, mapping, numbers, positive, shown, text
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.rendering.films import layout_of_output
from torchtransient.rendering.output import RenderOutput
from torchtransient.rendering.renderer import TransientRenderer
from torchtransient.scene.opaque import opaque
from torchtransient.scene.variant import active_variant


@dataclass(frozen=True)
class Estimates:
    """Result of one run: arrays by quantity, and the samples per pixel really drawn.

    `derived`: function that makes further arrays, which is not timed.
    """

    arrays: Mapping[str, ArrayLike]
    spp: int
    derived: Callable[[], Mapping[str, ArrayLike]] = dict


@dataclass(frozen=True)
class Task:
    """A run that is timed on its own: `run(spp, seed)` must return finished numbers, not pending kernels.

    `time_dims` gives the axis of time bins for the quantities that have one. `tails`: look at the tail of its
    distribution first, which holds 96 runs in memory. `to_common`: functions by quantity that bring its array to the
    shape which all choices share; they are not timed.
    """

    run: Callable[[int, int], Estimates]
    time_dims: Mapping[str, int] = field(default_factory=dict)
    tails: bool = False
    to_common: Mapping[str, Callable[[NDArray[np.float32]], NDArray[np.float32]]] = field(default_factory=dict)

    def comparable(self, estimates: Estimates) -> dict[str, NDArray[np.float32]]:
        """Return the arrays of a run in the shape that all choices share.

        Args:
            estimates: result of the run.
        """
        given = {**estimates.arrays, **estimates.derived()}
        arrays = {name: np.asarray(array, dtype=np.float32) for name, array in given.items()}
        return {name: self.to_common[name](x) if name in self.to_common else x for name, x in arrays.items()}


Candidate = Mapping[str, Task]
# A quantity of a task of a choice.
Key = tuple[Choice, str, str]
# Samples per pixel of the runs that show a tail, at most: sums of many samples hide it from a few runs.
_TAIL_SPP = 16


def measure(
    candidates: Mapping[Choice, Candidate],
    spp: Sequence[int],
    *,
    reference_spp: int | None = None,
    repeats: int = 4,
    seed: int = 0,
    progress: bool = True,
    settings: dict[str, Any] | None = None,
    finest: Mapping[str, Choice] | None = None,
) -> AccuracyReport:
    """Run every task of every candidate at every `spp`, `repeats` times, and report errors and median seconds.

    Each candidate first warms up (kernels are compiled) at the sample count that follows. Within a repeat, the
    candidates take turns, so that a change of the machine's speed meets all of them. Every candidate is compared with
    itself: with its own reference (two independent halves), or in pairs of independent runs. Of tasks with `tails`, 96
    runs of 16 samples (or of the smallest count) come first: where they show a heavy tail, there is no error.

    Args:
        candidates: tasks of each choice, by name.
        spp: different sample counts, at least 1.
        reference_spp: samples per pixel of a candidate's own reference, at least four times the largest of `spp`; None:
        pairs. repeats: number of runs at each count, at least 2, and an even number where there is no reference. seed:
        seed of the first run; no two runs share one. progress: show a bar that counts the samples. settings: facts to
        keep in the report. finest: choice for each task, by its name, whose reference all choices are compared with as
        well, which gives
            the total error, variance and bias. That reference has `reference_spp` samples, or four times the largest of
            `spp`.

    Returns:
        The report.

    Raises:
        UnitError: for values out of range.
    """
    counts = checked_counts(spp, repeats, reference_spp)
    tail_spp = min(_TAIL_SPP, counts[0])
    finest = dict(finest or {})
    # Choices with a reference of their own, and those that are the reference of the total error.
    referred = {choice: list(candidate) for choice, candidate in candidates.items()} if reference_spp else {}
    for name, choice in finest.items():
        if name not in referred.setdefault(choice, []):
            referred[choice].append(name)
    of_reference = reference_spp or 4 * max(counts)
    total = len(candidates) * sum(counts) * (repeats + 1) + of_reference * sum(map(len, referred.values()))
    total += tail_spp * TAIL_RUNS * sum(task.tails for candidate in candidates.values() for task in candidate.values())
    points: list[CostPoint] = []
    with tqdm(total=total, unit="spp", disable=not progress, desc="cost of accuracy") as bar:
        found = _references(candidates, referred, of_reference, seed, bar)
        own = found if reference_spp else {}
        common = {
            (choice, name, quantity): reference
            for choice in candidates
            for (of, name, quantity), reference in found.items()
            if finest.get(name) == of
        }
        tails = _tails(candidates, tail_spp, seed + 1000 + len(counts) * (repeats + 1), bar)
        for n, count in enumerate(counts):
            first_seed = seed + 1000 + n * (repeats + 1)
            points += _measure_count(candidates, count, repeats, first_seed, own, common, tails, bar)
    method = "in pairs of independent runs" if reference_spp is None else f"against a reference of {reference_spp} spp"
    quantities = list(dict.fromkeys(p.quantity for p in points))
    choices = list(candidates)
    points.sort(key=lambda p: (quantities.index(p.quantity), choices.index(p.choice)))
    return AccuracyReport(points, method, dict(settings or {}))


def _measure_count(
    candidates: Mapping[Choice, Candidate],
    count: int,
    repeats: int,
    first_seed: int,
    own: Mapping[Key, Reference],
    common: Mapping[Key, Reference],
    tails: Mapping[Key, Tail],
    bar: Any,
) -> list[CostPoint]:
    """Measure all points at one sample count. `own`: references of each choice, `common`: references of the total
    error.
    """
    for candidate in candidates.values():
        for task in candidate.values():
            task.run(count, first_seed + repeats)
        bar.update(count)
    seconds: dict[tuple[Choice, str], list[float]] = {}
    cpu_seconds: dict[tuple[Choice, str], list[float]] = {}
    tallies: dict[Key, ErrorTally] = {}
    totals: dict[Key, ErrorTally] = {}
    drawn: dict[tuple[Choice, str], int] = {}
    for repeat in range(repeats):
        for choice, candidate in candidates.items():
            for name, task in candidate.items():
                begin, begin_cpu = time.perf_counter(), time.process_time()
                estimates = task.run(count, first_seed + repeat)
                cpu_seconds.setdefault((choice, name), []).append(time.process_time() - begin_cpu)
                seconds.setdefault((choice, name), []).append(time.perf_counter() - begin)
                drawn[choice, name] = estimates.spp
                for quantity, array in task.comparable(estimates).items():
                    key = (choice, name, quantity)
                    if key not in tallies:
                        tallies[key] = ErrorTally(task.time_dims.get(quantity), own.get(key))
                        if key in common:
                            totals[key] = ErrorTally(None, common[key])
                    tallies[key].add(array)
                    if key in totals:
                        totals[key].add(array)
            bar.update(count)
    points = []
    for (choice, name, quantity), tally in tallies.items():
        tail = tails.get((choice, name, quantity))
        error = tally.result(tail)
        total = totals[choice, name, quantity].result(tail) if (choice, name, quantity) in totals else NOT_MEASURED
        points.append(
            CostPoint(
                choice=choice,
                quantity=quantity,
                spp=drawn[choice, name],
                seconds=statistics.median(seconds[choice, name]),
                squared_error=error.squared,
                squared_error_standard_error=error.squared_standard_error,
                # What is compared with one reference is relative to it.
                relative_error=error.relative if math.isnan(total.power) else relative(error.squared, total.power),
                median_bin_error=error.median_bin,
                repeats=repeats,
                tail=tail,
                cpu_seconds=statistics.median(cpu_seconds[choice, name]),
                comparisons=error.comparisons,
                total_squared_error=total.squared,
                total_squared_error_standard_error=total.squared_standard_error,
                total_error=total.relative,
                bias=total.bias,
            )
        )
    return points


def _tails(candidates: Mapping[Choice, Candidate], spp: int, first_seed: int, bar: Any) -> dict[Key, Tail]:
    found: dict[Key, Tail] = {}
    for choice, candidate in candidates.items():
        for name, task in candidate.items():
            if not task.tails:
                continue
            runs: dict[str, list[NDArray[np.float32]]] = {}
            for run in range(TAIL_RUNS):
                for quantity, array in task.comparable(task.run(spp, first_seed + run)).items():
                    runs.setdefault(quantity, []).append(np.array(array))
                bar.update(spp)
            found |= {(choice, name, quantity): Tail.of(several) for quantity, several in runs.items()}
    return found


def _references(
    candidates: Mapping[Choice, Candidate], referred: Mapping[Choice, Sequence[str]], spp: int, seed: int, bar: Any
) -> dict[Key, Reference]:
    """References of some tasks of some choices."""
    references: dict[Key, Reference] = {}
    for choice, names in referred.items():
        for name in names:
            task = candidates[choice][name]
            halves = [task.comparable(task.run(spp // 2, seed + half)) for half in range(2)]
            for quantity in halves[0]:
                references[choice, name, quantity] = Reference(halves[0][quantity], halves[1][quantity])
            bar.update(spp)
    return references


def checked_counts(spp: Sequence[int], repeats: int, reference_spp: int | None) -> list[int]:
    """Return the sample counts of a measurement, in order.

    Args:
        spp: different counts.
        repeats: number of runs at each count, at least 2, and an even number where there is no reference.
        reference_spp: samples per pixel of the reference, or None for pairs of runs.

    Raises:
        UnitError: for other numbers.
    """
    listed = isinstance(spp, Sequence) or getattr(spp, "ndim", None) == 1
    found = [as_whole(n) for n in spp] if listed and not isinstance(spp, (str, bytes)) else []
    counts = [n for n in found if n is not None and 1 <= n < 2**32]
    if not counts or len(set(counts)) != len(found):
        raise UnitError(f"spp: expected different sample counts of at least 1, below 2^32, got {shown(spp)}")
    for name, value in (("repeats", repeats), ("reference_spp", reference_spp)):
        if as_whole(value) is None and (value is not None or name == "repeats"):
            raise UnitError(f"{name}: expected a whole number, got {shown(value)}")
    if repeats < 2 or (reference_spp is None and repeats % 2):
        raise UnitError(
            "repeats: expected at least 2, and an even number without a reference (runs are compared in pairs), "
            f"got {repeats}"
        )
    if reference_spp is not None and reference_spp < 4 * max(counts):
        raise UnitError(
            f"reference_spp: expected at least four times the largest spp ({4 * max(counts)}), got "
            f"{shown(reference_spp)}; use None to compare independent runs instead"
        )
    return sorted(counts)


Loss = Callable[[RenderOutput], torch.Tensor]


def cosine_over_the_window(out: RenderOutput) -> torch.Tensor:
    """Sum the transient times one period of a cosine over the time axis, mean over pixels: the default loss.

    Of phasors, the sum of their real parts, mean over pixels. It is linear in the measurement, so that its gradient has
    no bias, and it changes with energy and arrival time.

    Args:
        out: output of a render.

    Raises:
        ShapeError: for a steady image alone.
    """
    response = _response(out)
    pixels = response.shape[-2] * response.shape[-1]
    if response.is_complex():
        return response.real.sum() / pixels
    bins = response.shape[-3]
    phase = 2.0 * math.pi * (torch.arange(bins, device=response.device) + 0.5) / bins
    return (response * torch.cos(phase)[:, None, None]).sum() / pixels


def _response(out: RenderOutput) -> torch.Tensor:
    """Return the tensor that the film of a render measured."""
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
    quantities: Mapping[str, Loss] | None = None,
    reference_spp: int | None = None,
    repeats: int = 4,
    samplers: Sequence[str] = ("owen", "independent"),
    temporal_filters: Sequence[str] | None = None,
    integrators: Sequence[str] | None = None,
    max_depths: Sequence[int] | None = None,
    bin_widths: Numbers | None = None,
    loss: Loss = cosine_over_the_window,
    seed: int = 0,
    progress: bool = True,
) -> AccuracyReport:
    """Measure the error of the transient, of quantities made of it, and of gradients, against seconds and samples.

    Every combination of samplers, filters, integrators, depths and bin widths is one curve. Its *error* is that of its
    own noise: every curve is compared with its own expectation, and detail that a filter blurs does not count. Its
    *total error* is measured where anything but samplers is compared, and of ``quantities``: the distance to a
    reference of the finest setting (deepest paths, narrowest bins, box before tent before gaussian, the first
    integrator, and of the samplers "owen" or else the first), so that light that a small depth leaves out, and detail
    that a filter or a wide bin blurs, count as bias. Errors of the finest setting itself are not seen. Histograms are
    compared on the narrowest bins, wide ones spread evenly over them.

    Errors are squared and relative, of independent runs. Seconds are medians of wall time, with CPU seconds beside: a
    forward render for values, render and backward for gradients; the runs of all curves take turns. A loss that is not
    linear has a biased gradient, which only a reference shows, and only in part.

    A few runs do not show that a gradient is rarely very wrong. Of every gradient 96 more runs, of 16 samples per pixel
    at most, show the tail of its distribution (`CostPoint.tail`): where Hill's index of it is below 2, so that the
    variance is infinite, or one run holds more than a third of the squared deviations, the errors of the curve are NaN
    and the table says "heavy tailed: no error". Of others, the standard error of the squared error comes from the
    spread of these runs. Outliers that come less than about once in 30 of them stay unseen.

    Of a phasor film the quantity "phasor" takes the place of "transient": real and imaginary parts, frequencies in the
    place of bins; of a gated film "gated". Both have no temporal filters and no bins to choose from. A temporary copy
    of the largest cube is held per curve, three where there is a total error.

    Args:
        renderer: renders at the current values of its parameters.
        spp: samples per pixel.
        gradients: keys of the renderer, each the derivative of ``loss``. Where a filter has no slope in time (box) and
            a key moves path lengths, there is no gradient: that filter's curve then shows the values alone, and
            `settings` of the report names the pair under "without_gradients".
        quantities: functions of a `RenderOutput` by name: a depth, a phase, a degree of polarization, a loss. Each
            returns a real or complex tensor (a phase best as a complex number of magnitude one, whose error is the
            phase's in radians), finite and of one shape in all settings.
        reference_spp: None compares each curve's noise in pairs of runs (``repeats`` even); a number, at least four
            times the largest ``spp``, with a reference of that many samples. That of the total error has as many, with
            None four times the largest ``spp``.
        repeats: independent runs at each of ``spp``.
        samplers: plugin names of the samplers.
        temporal_filters: "box", "tent", "gaussian"; None for the one that the renderer uses.
        integrators: plugin names; None for the renderer's.
        max_depths: longest paths, in segments, -1 for no limit; None for the renderer's.
        bin_widths: widths of the bins, metres of optical path; None for the renderer's.
        loss: a scalar of the `RenderOutput`, for ``gradients``.
        seed: seed of the first run.
        progress: show a progress bar.

    Returns:
        An `AccuracyReport` with `table()`, `plot(path)`, `recommend(error=)`, `pareto()` and `to_json(path)`.

    Raises:
        ArgumentError: for an argument that is no renderer, settings that its film does not have, and ``quantities``
            that are no functions by name, or have the name of a quantity that is measured anyway.
        SceneError: for a key, sampler or integrator that the renderer does not know.
        UnitError: for counts out of range, and a quantity that is not finite.
        ShapeError: for a quantity whose shape depends on the setting.
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
    own = [renderer.film.measures, *map(_gradient_name, gradients)]
    made = _Quantities({} if quantities is None else _checked_quantities(quantities, own))
    twins = _variations(renderer, samplers, temporal_filters, integrators, max_depths, bin_widths)
    axes = [twin.axis for twin in twins.values() if twin.axis is not None]
    narrowest = min(axes, key=lambda axis: axis.bin_width_opl, default=None)
    candidates: dict[Choice, Candidate] = {}
    without: list[str] = []
    for choice, twin in twins.items():
        candidate = {"values": _values_task(twin, made, str(choice), narrowest)}
        if gradients and twin.has_slope_for(gradients):
            candidate["gradients"] = _gradients_task(twin, tuple(gradients), loss)
        elif gradients:
            without.append(str(choice))
        candidates[choice] = candidate
    finest: dict[str, Choice] = {}
    if len({replace(choice, sampler="") for choice in candidates}) > 1 or made.functions:
        for task in ("values", "gradients"):
            having = [choice for choice in sorted(candidates, key=_blur) if task in candidates[choice]]
            finest |= {task: having[0]} if having else {}
    settings = {
        "scene": repr(renderer.scene),
        "variant": renderer.scene.variant,
        "spp": counts,
        "gradients": list(gradients),
        "loss": getattr(loss, "__name__", type(loss).__name__),
        "measured": repr(renderer.film.settings),
        "time_axis": narrowest and [narrowest.start_opl, narrowest.bin_width_opl, narrowest.num_bins],
        "without_gradients": without,
        "finest": {task: str(choice) for task, choice in finest.items()},
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
            finest=finest,
        )


def _variations(
    renderer: TransientRenderer,
    samplers: Sequence[str],
    temporal_filters: Sequence[str] | None,
    integrators: Sequence[str] | None,
    max_depths: Sequence[int] | None,
    bin_widths: Numbers | None,
) -> dict[Choice, TransientRenderer]:
    """A renderer for every combination; choices name the compared settings beside sampler and filter."""
    filters = [renderer.effective_filter or "auto"] if temporal_filters is None else list(temporal_filters)
    if not samplers or not filters:
        raise ArgumentError("expected at least one sampler and one temporal filter, got none")
    found = {}
    widths = (None,) if bin_widths is None else numbers("bin_widths", bin_widths).reshape(-1).tolist()
    builds = itertools.product(integrators or (None,), max_depths or (None,), widths)
    for integrator, depth, width in builds:
        built = renderer.variation(
            integrator=integrator, max_depth=depth, time_axis=None if width is None else _axis(renderer, width)
        )
        for sampler, name in itertools.product(samplers, filters):
            twin = built.variation(sampler=sampler, temporal_filter=name)
            found[Choice(sampler, twin.effective_filter, integrator or "", depth, width)] = twin
    return found


def _axis(renderer: TransientRenderer, width: float) -> TimeAxis:
    """The renderer's window in bins of another width."""
    axis, wanted = renderer.axis, positive("bin_widths", width)
    if axis is None:
        raise ArgumentError(f"bin_widths: a {renderer.film.measures} film has no bins; leave them out.")
    # A window that holds a whole number of bins up to rounding has no bin more.
    bins = math.ceil(axis.num_bins * axis.bin_width_opl / wanted - 1e-6)
    return TimeAxis(axis.start_opl, wanted, bins)


def _blur(choice: Choice) -> tuple[float, float, int, bool]:
    """Order of choices, the finest first, of equal ones that with the quieter reference; others stay in their order."""
    depth = choice.max_depth
    return (
        0.0 if depth is None else -math.inf if depth < 0 else -depth,
        choice.bin_width_opl or 0.0,
        ("box", "tent", "gaussian").index(choice.temporal_filter) if choice.temporal_filter else 0,
        choice.sampler != "owen",
    )


def _checked_quantities(given: Mapping[str, Loss], own: Sequence[str]) -> dict[str, Loss]:
    """Return functions by name. ``own``: names of quantities that are measured in any case."""
    checked = {}
    for name, each in mapping("quantities", given, "{name: function of a RenderOutput}").items():
        text("quantities", name, "names, texts")
        if name in own:
            raise ArgumentError(
                f"quantities: {name!r} is measured in any case, got a function of that name too; leave it out, or give "
                "it another name."
            )
        checked[name] = function(f"quantities: {name!r}", each, "a RenderOutput")
    return checked


@dataclass
class _Quantities:
    """Functions of a render by name. ``shapes``: shape that each returned first, and the setting of that render."""

    functions: Mapping[str, Loss]
    shapes: dict[str, tuple[torch.Size, str]] = field(default_factory=dict)

    def of(self, out: RenderOutput, setting: str) -> dict[str, NDArray[np.float32]]:
        """Return the quantities of a render. ``setting``: how it was made, for messages."""
        return {name: _array(self._one(name, out, setting)) for name in self.functions}

    def _one(self, name: str, out: RenderOutput, setting: str) -> torch.Tensor:
        with torch.no_grad():
            made = self.functions[name](out)
        try:
            tensor = _real(torch.as_tensor(made))
        except (TypeError, ValueError, RuntimeError):
            raise ArgumentError(
                f"quantities: {name!r}: expected a function that returns a tensor or a number, got {shown(made)}."
            ) from None
        if not bool(tensor.isfinite().all()):
            raise UnitError(
                f"quantities: {name!r}: expected finite numbers, got others of a render with {setting}; say what dark "
                "pixels have (torch.where, nan_to_num, a clamped divisor)."
            )
        if not tensor.numel():
            raise ShapeError(f"quantities: {name!r}: expected one number at least, got none of {setting}.")
        first, of_first = self.shapes.setdefault(name, (tensor.shape, setting))
        if tensor.shape != first:
            raise ShapeError(
                f"quantities: {name!r}: expected numbers of one shape in all settings, got {tuple(first)} with "
                f"{of_first} and {tuple(tensor.shape)} with {setting}. Make it of what no setting changes: sums over "
                "windows in metres, not bins."
            )
        return tensor


def _values_task(renderer: TransientRenderer, made: _Quantities, choice: str, narrowest: TimeAxis | None) -> Task:
    film = renderer.film

    def run(spp: int, seed: int) -> Estimates:
        with torch.no_grad():
            out = renderer(seed=seed, spp=spp)
        arrays = {film.measures: _array(_real(_response(out)))}
        return Estimates(arrays, renderer.samples_drawn(spp), lambda: made.of(out, f"{spp} spp [{choice}]"))

    spread = {}
    if narrowest is not None and renderer.axis is not None and renderer.axis != narrowest:
        matrix = _shares(renderer.axis, narrowest)
        spread = {film.measures: lambda cube: np.einsum("kt,...thw->...khw", matrix, cube, optimize=True)}
    # After the film's own dimension come rows and columns, and real and imaginary parts of complex numbers.
    return Task(run, {film.measures: -4 if film.is_complex else -3}, to_common=spread)


def _shares(wide: TimeAxis, narrow: TimeAxis) -> NDArray[np.float32]:
    """Shares of each wide bin that lie in each narrow one, (narrow, wide)."""
    edges, ends = wide.edges_opl.numpy(), narrow.edges_opl.numpy()
    low = np.maximum(edges[None, :-1], ends[:-1, None])
    high = np.minimum(edges[None, 1:], ends[1:, None])
    return np.asarray(np.maximum(high - low, 0.0) / wide.bin_width_opl, dtype=np.float32)


def _real(tensor: torch.Tensor) -> torch.Tensor:
    return torch.view_as_real(tensor) if tensor.is_complex() else tensor


def _gradient_name(key: str) -> str:
    return f"d loss / d {key}"


def _gradients_task(renderer: TransientRenderer, keys: tuple[str, ...], loss: Loss) -> Task:
    # The samples of the derivative are as many as those of the render, whatever the renderer's settings.
    renderer.spp_grad = None

    def run(spp: int, seed: int) -> Estimates:
        values = {key: renderer.values[key].detach().clone().requires_grad_(key in keys) for key in renderer.values}
        out = renderer(values, seed=seed, spp=spp)
        found = torch.autograd.grad(loss(out), [values[key] for key in keys])
        arrays = {_gradient_name(key): _array(gradient) for key, gradient in zip(keys, found, strict=True)}
        return Estimates(arrays, renderer.samples_drawn(spp))

    return Task(run, tails=True)


def _array(tensor: torch.Tensor) -> NDArray[np.float32]:
    """On the CPU a view; from a GPU a copy, which waits for it."""
    return np.asarray(tensor.detach().cpu().numpy(), dtype=np.float32)
