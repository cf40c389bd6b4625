"""A fit while it runs: losses, parameters, light and target, noise of gradients."""

from __future__ import annotations

import io
import math
import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from torchtransient.axes import TimeAxis
from torchtransient.errors import ArgumentError, ShapeError
from torchtransient.vis.colour_maps import symmetric_limit
from torchtransient.vis.files import figure_type, needed, save_figure, to_bytes
from torchtransient.vis.fit_page import Curve, Moment, Panel, Picture, write_page
from torchtransient.vis.sources import Source, as_tensor, images_of, pixel_of
from torchtransient.vis.tone_mapping import exposure_of, tone_map

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Entries of a parameter that have a curve each; of more, the mean and the range.
MOST_CURVES = 12
# A page has up to twice as many moments: of more, every second is dropped.
MOST_MOMENTS = 60
MOST_PIXELS = 128
# Looks take this share of the time of the loop by default, and figures of notebooks and TensorBoard as much.
SHARE = 0.01
# Pairs of successive gradients of which the noise is a mean: none is of a larger gradient long ago.
_WINDOW = 20
_COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22")
_CHANNELS = ("#d62728", "#2ca02c", "#1f77b4")
_BLACK, _GREY = "#000000", "#999999"


@dataclass
class _Light:
    """Light at a step: image (C, H, W), histograms of the pixels (P, T) and the places of their bins (T,)."""

    step: int
    image: Tensor
    histograms: NDArray[np.float64]
    places: NDArray[np.float64]
    x_label: str


class _Gradient:
    """Norms and differences of the last pairs of successive gradients, on their device until they are asked."""

    def __init__(self) -> None:
        self._before: Tensor | None = None
        self._step = -1
        self._norm: Tensor | None = None
        self._pairs: deque[tuple[Tensor, Tensor, Tensor]] = deque(maxlen=_WINDOW)

    def add(self, step: int, now: Tensor) -> None:
        norm = torch.linalg.vector_norm(now)
        if self._before is None or self._norm is None:
            self._before = now.clone()
        else:
            if step == self._step + 1:
                self._pairs.append((self._norm, norm, torch.dist(now, self._before)))
            self._before.copy_(now)
        self._step, self._norm = step, norm

    def share(self) -> float | None:
        """Half of the squared differences over the mean squares of their gradients; None before there is a pair."""
        if not self._pairs:
            return None
        first, second, changes = torch.stack([torch.stack(pair) for pair in self._pairs]).double().square().sum(0)
        power = float(first + second)
        return float(changes) / power if power > 0 else float("nan")


class _Turns:
    """Steps that are looked at: each ``every``-th, or as often as looks take ``SHARE`` of the time since the last."""

    def __init__(self, every: int | None) -> None:
        self._every = every
        self._again, self._paired, self._cost = 0.0, False, 0.0

    def begin(self, number: int, now: float) -> tuple[bool, bool]:
        """Return masks of a step: it is looked at; its gradient is taken."""
        if self._every is not None:
            return number % self._every == 0, True
        # The gradients of a look are those of its step and of the one before.
        look = self._paired or self._again == 0.0
        self._paired = not look and now >= self._again
        return look, look or self._paired

    def end(self, begin: float, look: bool) -> None:
        """Count the time of a step."""
        now = time.perf_counter()
        self._cost += now - begin
        if look:
            self._again, self._cost = now + self._cost / SHARE, 0.0


@dataclass
class _Track:
    """A row of numbers for each of some steps."""

    steps: list[int] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)

    def add(self, step: int, row: list[float]) -> None:
        self.steps.append(step)
        self.rows.append(row)


class FitMonitor:
    """Losses, parameters, light beside its target and the noise of gradients of a training loop, as it runs.

    Call :meth:`step` once in each step, after ``backward``. In a notebook one figure is shown and brought up to date,
    ``log_dir`` makes a TensorBoard log, and :meth:`save` writes a page for a browser. Looks at parameters, light and
    gradients come so rarely that they take 1 % of the loop's time, unless ``every`` says how often; figures of
    notebooks and logs take as much, after the first. Pages are drawn when they are saved. Needs matplotlib and Pillow
    (extra ``vis``).

    The noise of a gradient is the part of its square that changes from one step to the next: half the square of the
    difference of successive gradients over their mean square, both averaged over 20 pairs of successive steps, the last
    ones with ``every``, else those that were looked at. It is 0 for equal gradients, 1 for random ones, and up to 2
    where steps overshoot.

    Args:
        parameters: a renderer, whose ``values`` are shown; another ``nn.Module``; or ``{name: tensor}``. Up to 12
            entries of a tensor have a curve each; of more, the mean and the range from smallest to largest are shown.
        target: light that the outputs should have, in their unit: (C, T, H, W), an image (C, H, W), a ``RenderOutput``
            or a file.
        pixels: pixels (row, column) whose histograms are shown, measured and rendered, summed over channels.
        truth: values aimed at by name, dashed.
        axis: time axis of the histograms; None takes the output's or the renderer's.
        every: steps from one point of the curves, and one moment of a page, to the next; None for as many as take 1 %
            of the time. Losses have all points. A page has 120 moments at most, evenly spread.
        log_dir: folder of a TensorBoard log: scalars ``loss/NAME``, ``parameter/NAME``, ``gradient_noise/NAME``, and
            the picture ``fit``, all of them at looks. Needs the package tensorboard (extra ``tensorboard``).

    Raises:
        ArgumentError: for truth of names that are not shown.
        ShapeError: for a target that is neither a transient nor an image, pixels outside of it.
        MissingPackageError: without matplotlib or tensorboard, where they are needed.
    """

    def __init__(
        self,
        parameters: nn.Module | Mapping[str, Tensor],
        *,
        target: Source | None = None,
        pixels: Sequence[tuple[int, int]] = (),
        truth: Mapping[str, Any] | None = None,
        axis: TimeAxis | None = None,
        every: int | None = None,
        log_dir: str | Path | None = None,
    ) -> None:
        self._parameters = parameters
        self._turns = _Turns(every)
        self._axis = axis if axis is not None else getattr(parameters, "axis", None)
        self._pixels = list(pixels)
        self._target = None if target is None else self._light(0, target)
        self._truth = {name: _numbers(aim) for name, aim in (truth or {}).items()}
        known = [key for key, _ in self._shown_values()]
        unknown = [name for name in self._truth if name not in known]
        if unknown:
            raise ArgumentError(f"FitMonitor: expected truth of some of {', '.join(known)}, got {', '.join(unknown)}.")
        self._next = 0
        self._pending: list[tuple[int, dict[str, Any]]] = []
        self._losses: dict[str, _Track] = {}
        self._values: dict[str, _Track] = {}
        self._noise: dict[str, _Track] = {}
        # Kept, for the names of a module's parameters take longer than their gradients.
        self._differentiated = [(name, leaf) for name, leaf in self._leaves() if leaf.is_leaf]
        self._gradients = {name: _Gradient() for name, _ in self._differentiated}
        self._lights: list[_Light] = []
        self._now: _Light | None = None
        self._looks, self._between = 0, 1
        self._live = _in_notebook()
        self._writer: Any = None
        if log_dir is not None:
            self._writer = needed("torch.utils.tensorboard", "tensorboard", "tensorboard").SummaryWriter(log_dir)
        if self._live or self._writer is not None:
            figure_type()  # whose import is no cost of a step
        self._handle: Any = None
        self._draw_again = 0.0

    # -------------------------------------------------------------------------------------------------- in the loop

    @torch.no_grad()
    def step(self, loss: Tensor | float | Mapping[str, Any], output: Source | None = None) -> None:
        """Take in a step of the loop, after ``backward`` and before the gradients are set to zero.

        Args:
            loss: a number, or several by name.
            output: light of the step, in the form and unit of ``target``; read in steps that are looked at. Without
                it a fit is watched without its light.

        Raises:
            ShapeError: for an output that is no light, or not over the target's channels, bins and pixels.
        """
        number = self._next
        self._next = number + 1
        begin = time.perf_counter()
        look, taken = self._turns.begin(number, begin)
        losses = loss if isinstance(loss, Mapping) else {"loss": loss}
        # Tensors stay on their device until they are looked at.
        self._pending.append((number, {n: v.detach() if isinstance(v, Tensor) else v for n, v in losses.items()}))
        for key, leaf in self._differentiated if taken else ():
            if leaf.grad is not None:
                self._gradients[key].add(number, leaf.grad)
        if look:
            self._look(number, output)
        self._turns.end(begin, look)
        if look and (self._live or self._writer is not None) and time.perf_counter() >= self._draw_again:
            self._show()

    def _look(self, number: int, output: Source | None) -> None:
        self._take_losses()
        for name, gradient in self._gradients.items():
            share = gradient.share()
            if share is not None:
                self._noise.setdefault(name, _Track()).add(number, [share])
        for name, value in self._shown_values():
            self._values.setdefault(name, _Track()).add(number, _row(value))
        if output is not None:
            self._take_light(self._light(number, output))
        if self._writer is not None:
            for name, track in self._losses.items():
                if track.steps[-1] == number:
                    self._writer.add_scalar(f"loss/{name}", track.rows[-1][0], number)
            for kind, tracks in (("parameter", self._values), ("gradient_noise", self._noise)):
                for name, track in tracks.items():
                    row = track.rows[-1] if track.steps[-1] == number else []
                    for n, entry in enumerate(row):
                        word = _word(name, n, len(row), of_many=kind == "parameter" and self._is_many(name))
                        self._writer.add_scalar(f"{kind}/{word}", entry, number)

    def _leaves(self) -> Iterator[tuple[str, Tensor]]:
        if isinstance(self._parameters, nn.Module):
            for name, leaf in self._parameters.named_parameters():
                # Of parametrized ones "parametrizations.KEY.original"; "original0", "original1" where there are two.
                yield name.replace("parametrizations.", "").replace(".original", "").replace("/", "."), leaf
        else:
            yield from self._parameters.items()

    def _shown_values(self) -> Iterator[tuple[str, Tensor]]:
        values = getattr(self._parameters, "values", None)
        if isinstance(self._parameters, nn.Module) and isinstance(values, Mapping):
            yield from values.items()
        else:
            yield from self._leaves()

    def _is_many(self, name: str) -> bool:
        return any(value.numel() > MOST_CURVES for key, value in self._shown_values() if key == name)

    def _take_losses(self) -> None:
        for number, losses in self._pending:
            for name, value in losses.items():
                self._losses.setdefault(name, _Track()).add(number, [float(value)])
        self._pending.clear()

    def _light(self, number: int, source: Source) -> _Light:
        who, axis, bins = "FitMonitor: light", None, "bin"
        if getattr(source, "ndim", None) == 3:
            image = as_tensor(source, who)
            cube = image[:, None]
        else:
            cube, axis, bins = images_of(source, None, who)
            image = cube.sum(1)
        if axis is None and self._axis is not None and self._axis.num_bins == cube.shape[1]:
            axis = self._axis
        height, width = cube.shape[2:]
        pixels = [pixel_of(pixel, (height, width), "FitMonitor") for pixel in self._pixels]
        curves = [cube[:, :, row, column].sum(0).double().numpy() for row, column in pixels]
        block = -(-max(height, width) // MOST_PIXELS)
        if block > 1:
            image = avg_pool2d(image, block, ceil_mode=True)
        places = np.arange(cube.shape[1], dtype=np.float64) if axis is None else axis.centers_opl.double().numpy()
        label = bins if axis is None else "optical path length (m)"
        # Images of a film's memory are written again by the next step.
        return _Light(number, image.clone(), np.stack(curves) if curves else np.empty((0, 0)), places, label)

    def _check_like_target(self, light: _Light, target: _Light) -> None:
        bins, got = len(target.places), len(light.places)
        # Images have no bins; without an axis places are numbers.
        same = got == bins and (light.x_label != target.x_label or np.allclose(light.places, target.places))
        if light.image.shape != target.image.shape or not (same or 1 in (bins, got)):
            raise ShapeError(
                f"FitMonitor.step: expected light as the target's, (C, H, W) = {tuple(target.image.shape)} over {bins} "
                f"bins from {target.places[0]:g} to {target.places[-1]:g}, got {tuple(light.image.shape)} over {got} "
                f"from {light.places[0]:g} to {light.places[-1]:g}."
            )

    def _take_light(self, light: _Light) -> None:
        if self._target is not None:
            self._check_like_target(light, self._target)
        self._now = light
        self._looks += 1
        if (self._looks - 1) % self._between:
            return
        self._lights.append(light)
        if len(self._lights) > 2 * MOST_MOMENTS:
            self._between *= 2
            self._lights = self._lights[::2]

    # ------------------------------------------------------------------------------------------------------ pictures

    def figure(self) -> Figure:
        """Return a matplotlib figure of the fit as it is now."""
        self._take_losses()
        panels, pictures = self._panels(), []
        if self._now is not None:
            panels = [*self._pixel_panels(self._now), *panels]
            pictures = [*self._fixed(), *self._pictures(self._now)]
        columns = 4
        rows = -(-len(panels) // columns)
        heights = ([2.9] if pictures else []) + [2.3] * rows
        figure = figure_type()(figsize=(13.0, sum(heights) or 2.3))
        grid = figure.add_gridspec(
            len(heights) or 1, columns, height_ratios=heights or None, hspace=0.5, wspace=0.3, left=0.06, right=0.98,
            bottom=0.45 / (sum(heights) or 2.3), top=1 - 0.3 / (sum(heights) or 2.3),
        )  # fmt: skip
        for n, picture in enumerate(pictures):
            axes = figure.add_subplot(grid[0, n])
            axes.imshow(picture.image, interpolation="nearest")
            axes.set_title(picture.title, fontsize=9)
            axes.set_axis_off()
        for n, panel in enumerate(panels):
            row, column = divmod(n, columns)
            _draw(figure.add_subplot(grid[row + bool(pictures), column]), panel)
        return figure

    def save(self, path: str | Path) -> None:
        """Write the fit: ``.html`` is a page with a slider over its moments, any other ending a picture of its state.

        The page is one file that needs no network. Losses that are not finite are named with their first step. Raises
        StorageError when it cannot be written.

        Args:
            path: file to write.
        """
        if Path(path).suffix.lower() not in (".html", ".htm"):
            save_figure(self.figure(), path, "FitMonitor.save")
            return
        self._take_losses()
        lights = list(self._lights)
        if self._now is not None and self._now is not lights[-1]:
            lights.append(self._now)
        moments = [Moment(light.step, self._pictures(light), self._pixel_panels(light)) for light in lights]
        write_page(path, self._panels(), moments, self._fixed(), "FitMonitor.save")

    def close(self) -> None:
        """Bring figures up to date for the last time and close the log."""
        self._take_losses()
        if self._live or self._writer is not None:
            self._show()
        if self._writer is not None:
            self._writer.close()

    def callback(self) -> Any:
        """Return a Lightning callback that calls ``step`` after each batch, and ``close`` at the end.

        ``training_step`` returns the loss, or a dictionary with ``loss`` and perhaps ``output``, the light. Gradients
        are those that Lightning holds then: over batches that it accumulates, sums. Raises MissingPackageError without
        Lightning (extra ``lightning``).
        """
        monitor, callbacks = self, needed("lightning.pytorch.callbacks", "lightning", "lightning")

        class MonitorCallback(callbacks.Callback):  # type: ignore[misc, name-defined]  # found when it is called
            def on_train_batch_end(self, trainer: Any, module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
                result = outputs if isinstance(outputs, Mapping) else {"loss": outputs}
                monitor.step(result["loss"], result.get("output"))

            def on_fit_end(self, trainer: Any, module: Any) -> None:
                monitor.close()

        return MonitorCallback()

    def _show(self) -> None:
        begin = time.perf_counter()
        figure = self.figure()
        if self._writer is not None:
            self._writer.add_image("fit", _drawn(figure), self._next - 1, dataformats="HWC")
        if self._live:
            self._handle = _display(figure, self._handle)
        now = time.perf_counter()
        self._draw_again = now + (now - begin) / SHARE

    def _panels(self) -> list[Panel]:
        """Losses, gradient noise, and each parameter over the steps."""
        lines, noise = _curves(self._losses), _curves(self._noise)
        log = all(value > 0 for curve in lines for value in curve.y if math.isfinite(value))
        lines = [replace(curve, label=curve.label + _not_finite(curve)) for curve in lines]
        panels = [Panel("loss", "step", lines, log)] if lines else []
        if noise:
            panels.append(Panel("noise of the gradient (1: random)", "step", noise))
        return panels + [self._values_panel(name, track) for name, track in self._values.items()]

    def _values_panel(self, name: str, track: _Track) -> Panel:
        curves, columns = [], list(zip(*track.rows, strict=True))
        truth = self._truth.get(name, [])
        if self._is_many(name):
            mean, low, high = columns
            curves.append(Curve("mean and range", _COLOURS[0], track.steps, mean, band=(low, high)))
            if truth:
                truth = [float(np.mean(truth))]
            columns = [mean]
        else:
            colours = _CHANNELS if len(columns) == 3 else _COLOURS
            for n, column in enumerate(columns):
                curves.append(Curve("", colours[n % len(colours)], track.steps, column))
        colours = _CHANNELS if len(columns) == 3 else _COLOURS
        ends = [track.steps[0], track.steps[-1]]
        for n, value in enumerate(truth[: len(columns)]):
            curves.append(Curve("", colours[n % len(colours)], ends, [value, value], dashed=True))
        return Panel(name, "step", curves)

    def _pixel_panels(self, light: _Light) -> list[Panel]:
        panels = []
        for n, (row, column) in enumerate(self._pixels):
            curves = []
            if self._target is not None:
                curves.append(Curve("target", _GREY, light.places.tolist(), self._target.histograms[n].tolist()))
            curves.append(Curve("now", _BLACK, light.places.tolist(), light.histograms[n].tolist()))
            panels.append(Panel(f"row {row}, column {column}", light.x_label, curves))
        return panels

    def _fixed(self) -> list[Picture]:
        first = [] if not self._lights else [("start", self._lights[0])]
        lights = first + ([] if self._target is None else [("target", self._target)])
        return [Picture(title, to_bytes(tone_map(light.image, self._exposure()))) for title, light in lights]

    def _pictures(self, light: _Light) -> list[Picture]:
        pictures = [Picture(f"step {light.step}", to_bytes(tone_map(light.image, self._exposure())))]
        if self._target is not None:
            difference = (light.image - self._target.image).double().sum(0).numpy()
            limit = symmetric_limit(difference)
            import matplotlib

            colours = matplotlib.colormaps["RdBu_r"]((difference / limit + 1) / 2)[..., :3]
            pictures.append(Picture(f"step {light.step} - target, red: +{limit:.2g}", to_bytes(colours)))
        return pictures

    def _exposure(self) -> float:
        return exposure_of((self._target or self._lights[0]).image)


def _numbers(values: Any) -> list[float]:
    numbers: list[float] = torch.as_tensor(values, dtype=torch.float64).flatten().tolist()
    return numbers


def _curves(tracks: Mapping[str, _Track]) -> list[Curve]:
    """One curve for each track of single numbers."""
    return [
        Curve(name, _COLOURS[n % len(_COLOURS)], track.steps, [row[0] for row in track.rows])
        for n, (name, track) in enumerate(tracks.items())
    ]


def _not_finite(curve: Curve) -> str:
    """From which step on a curve is not finite, or how often; empty where it is."""
    wrong = [step for step, value in zip(curve.x, curve.y, strict=True) if not math.isfinite(value)]
    if not wrong:
        return ""
    if len(wrong) == sum(step >= wrong[0] for step in curve.x):
        return f", not finite from step {wrong[0]}"
    return f", not finite in {len(wrong)} steps from {wrong[0]} on"


def _row(value: Tensor) -> list[float]:
    """Entries of a small tensor; mean, minimum and maximum of a large one."""
    flat = value.detach().flatten()
    if flat.numel() > MOST_CURVES:
        flat = torch.stack([flat.mean(), flat.amin(), flat.amax()])
    row: list[float] = flat.tolist()
    return row


def _word(name: str, entry: int, entries: int, of_many: bool) -> str:
    if of_many:
        return f"{name}/{('mean', 'min', 'max')[entry]}"
    return name if entries == 1 else f"{name}/{entry}"


def _draw(axes: Any, panel: Panel) -> None:
    for curve in panel.curves:
        style = "--" if curve.dashed else "-"
        axes.plot(curve.x, curve.y, style, color=curve.colour, linewidth=1.0, label=curve.label or None)
        if curve.band is not None:
            axes.fill_between(curve.x, *curve.band, color=curve.colour, alpha=0.2, linewidth=0)
    if panel.log:
        axes.set_yscale("log")
    if any(curve.label not in ("", panel.title) for curve in panel.curves):
        axes.legend(fontsize=7, frameon=False)
    axes.set_title(panel.title, fontsize=9)
    axes.set_xlabel(panel.x_label, fontsize=8)
    axes.tick_params(labelsize=7, which="both")
    axes.grid(True, color="0.9", linewidth=0.6)


def _drawn(figure: Figure) -> NDArray[np.uint8]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _display(figure: Figure, handle: Any) -> Any:
    """Show a figure in the place of the one before."""
    from IPython.display import Image, display

    written = io.BytesIO()
    figure.savefig(written, format="png", dpi=80)
    picture = Image(data=written.getvalue(), format="png")
    if handle is None:
        return display(picture, display_id=True)
    handle.update(picture)
    return handle


def _in_notebook() -> bool:
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None
