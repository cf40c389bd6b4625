"""Find where a letter hangs that no camera sees, and how it is bent, from light that went around a corner.

A laser lights a relay wall and a SPAD looks at it; the letter, behind the corner, is lit by the wall alone. 100 photons
of signal and 10 of background a scan point, 512 bins of 16 ps, jitter of 60 ps. The model starts with a flat letter
0.9 m before the wall; the true one is 10 cm and 20 degrees off, another way for every seed. Its brightness and the
background are found from the counts.

Two fits by gradient descent through the renderer:

pose    six numbers, of a letter whose shape is known;
shape   first the pose, then every vertex on its own, of a letter that is bent, wider and slanted.

    python training_examples/nlos_letter.py --output demo_output

What is measured is rendered by path tracing, with other random numbers, filter and more samples than the model.
Settings of the fits follow from the size of scan and start and are the same for all seeds and both kinds of scans.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from torch import Tensor
from torch.nn import functional
from tqdm import tqdm

import torchtransient as tt
from torchtransient import sensing

KEY, VARIANT = "letter.vertex_positions", "llvm_ad_mono"
LETTER = "F"  # looks like itself in one pose alone
SIZE_M, DEPTH_M, WALL_M, OFF_M, OFF_DEG = 0.6, 0.9, 1.5, 0.1, 20.0
START_OPL, BIN_S, BINS = 1.2, 16e-12, 512
JITTER_S = 60e-12
SIGNAL, BACKGROUND, CYCLES = 100.0, 10.0, 100_000  # counts of a scan point, mean over the scan; laser cycles
MEASURED_SEED, SHAPE_SEED = 1_000_003, 500_009


@dataclass(frozen=True)
class Settings:
    """How much is computed. `points`: of the scan, a side. `spp`, `measured_spp`: hidden samples of a step, paths of a
    point of what is measured. `subdivide`: of the letter's triangles, for its shape. `late`: measure light of 3 to 5
    bounces, of which the model knows the first 3.
    """

    points: int = 32
    spp: int = 256
    measured_spp: int = 8192
    pose_steps: int = 80
    shape_steps: int = 200
    subdivide: int = 2
    late: bool = False


@dataclass
class Measurement:
    """`counts` (T, H, W) of a scan, and the `vertices` (V, 3) that they come from, metres."""

    scan: tt.nlos.Scan
    axis: tt.TimeAxis
    response: sensing.ImpulseResponse
    counts: Tensor
    vertices: Tensor


@dataclass
class Fit:
    """What a fit leaves behind. Vertices (V, 3); `errors` by name with their unit, before every step and at last."""

    name: str
    measurement: Measurement
    faces: Tensor
    start: Tensor
    found: Tensor
    losses: list[float] = field(default_factory=list)
    errors: dict[str, list[float]] = field(default_factory=dict)
    seconds_a_step: float = 0.0


# ------------------------------------------------------------------------------------------------------ the letter


def rotation(turn: Tensor) -> Tensor:
    """Rotation matrix (3, 3) about the vector `turn` (3,) by its length in radians."""
    x, y, z = turn.unbind()
    o = torch.zeros_like(x)
    cross = torch.stack([torch.stack([o, -z, y]), torch.stack([z, o, -x]), torch.stack([-y, x, o])])
    return torch.linalg.matrix_exp(cross)


def placed(vertices: Tensor, shift: Tensor, turn: Tensor) -> Tensor:
    """Vertices (V, 3) turned about their own centre and shifted."""
    center = vertices.mean(0)
    return (vertices - center) @ rotation(turn).T + center + shift


def true_pose(seed: int) -> tuple[Tensor, Tensor]:
    """Shift and turn of the true letter, in directions that depend on the seed."""
    generator = torch.Generator().manual_seed(seed)
    shift, turn = functional.normalize(torch.randn(2, 3, generator=generator, dtype=torch.float64), dim=1)
    return OFF_M * shift, math.radians(OFF_DEG) * turn


def bent(vertices: Tensor) -> Tensor:
    """The letter 15 % wider, slanted by 15 %, and bent around an upright cylinder that the wall looks at."""
    center, radius = vertices.mean(0), SIZE_M
    x, y, z = (vertices - center).unbind(1)
    angle = (1.15 * x + 0.15 * y) / radius
    return torch.stack([radius * angle.sin(), y, z + radius * (1 - angle.cos())], 1) + center


def letter(subdivide: int) -> dict[str, Any]:
    """The letter where the fits start: upright and flat."""
    return tt.scenes.nlos_letter(LETTER, size=SIZE_M, depth=DEPTH_M, subdivide=subdivide)


def arrays(shape: dict[str, Any]) -> tuple[Tensor, Tensor]:
    """Vertices (V, 3) and faces (F, 3)."""
    return torch.from_numpy(shape["letter"]["vertices"]), torch.from_numpy(shape["letter"]["faces"])


# ----------------------------------------------------------------------------------------------------- measurement


def measure(kind: str, shape: dict[str, Any], vertices: Tensor, seed: int, settings: Settings) -> Measurement:
    """What a SPAD counts of a letter with its vertices elsewhere. Pixels and bins are rendered by plain paths."""
    wall = tt.nlos.Wall.plane(width=WALL_M, height=WALL_M, albedo=0.5)
    scan = tt.nlos.Scan.grid(wall, settings.points, kind=kind)
    axis = tt.TimeAxis(START_OPL, tt.units.seconds_to_opl(BIN_S), BINS)
    hidden = {"letter": shape["letter"] | {"vertices": vertices.numpy()}}
    scene = tt.nlos.capture_scene(hidden, scan, bounces=(3, 4, 5) if settings.late else (3,))
    scene["integrator"]["third_bounce"] = "paths"
    renderer = tt.TransientRenderer(tt.load(scene, variant=VARIANT), time_axis=axis, physics="ignore")
    with torch.no_grad():
        light = renderer(seed=MEASURED_SEED + seed, spp=settings.measured_spp).transient
    response = sensing.ImpulseResponse(sensing.GaussianResponse(JITTER_S), axis=axis)
    rate = light * (SIGNAL * settings.points**2 / light.sum()) + BACKGROUND / BINS
    detector = sensing.Compose([response, sensing.SynchronousSPAD(CYCLES)])
    counts = detector.sample(rate / CYCLES, torch.Generator().manual_seed(MEASURED_SEED + seed))[0]
    return Measurement(scan, axis, response, counts, vertices)


class Model:
    """Expected light of each bin, up to its scale, as a function of vertices."""

    def __init__(self, shape: dict[str, Any], measurement: Measurement, spp: int) -> None:
        self.renderer = tt.nlos.CaptureRenderer(
            shape, measurement.scan, (KEY,), time_axis=measurement.axis, spp=spp, variant=VARIANT, physics="ignore"
        )
        self.response = measurement.response

    def __call__(self, vertices: Tensor, seed: int) -> Tensor:
        """(T, H, W). Each call has its own samples, and their derivative others (`grad_seed` of the renderer)."""
        capture = self.renderer({KEY: vertices}, seed=seed)
        return self.response.expected(capture.transient)[0]


class Misfit:
    """Measured counts against light. The light's scale and the background are found on the way.

    Both losses are squares of what is linear in the light, so that the noise of a render does not move their least.
    """

    def __init__(self, counts: Tensor) -> None:
        self.counts = counts
        # The quietest sixteenth of the window, over all points, is background alone.
        width = max(1, len(counts) // 16)
        lowest = functional.avg_pool1d(counts.sum((1, 2))[None], width, 1).min()
        self.background = float(lowest) / counts[0].numel()
        self.scale: float | None = None
        self.level: Tensor | None = None

    @property
    def signal(self) -> float:
        """Counts that are not background."""
        return max(1.0, float(self.counts.sum()) - self.background * self.counts.numel())

    def running_sums(self, light: Tensor) -> Tensor:
        """Mean square of the difference of the sums over all earlier bins: has a slope however far apart they are."""
        difference = light * (self.signal / light.sum()) + self.background - self.counts
        return difference.cumsum(0).square().mean()

    def likelihood(self, light: Tensor) -> Tensor:
        """Chi-square a bin, with the slope of the Poisson likelihood: its variance, the expected counts, is an average
        over renders and neighbouring bins.
        """
        with torch.no_grad():
            self._update(light)
            assert self.level is not None and self.scale is not None
            variance = functional.avg_pool3d(self.level[None, None], (9, 1, 1), 1, (4, 0, 0))[0, 0] + self.background
        return ((self.scale * light + self.background - self.counts).square() / variance).mean()

    def expected(self, light: Tensor) -> Tensor:
        """Counts of light, with the scale found."""
        return light * (self.signal / light.sum() if self.scale is None else self.scale) + self.background

    def _update(self, light: Tensor) -> None:
        """Three steps of expectation and maximisation for scale and background."""
        scale = self.signal / float(light.sum()) if self.scale is None else self.scale
        for _ in range(3):
            ratio = self.counts / (scale * light + self.background)
            scale *= float((ratio * light).sum() / light.sum())
            self.background *= float(ratio.mean())
        self.scale = scale
        self.level = scale * light if self.level is None else 0.8 * self.level + 0.2 * scale * light


# ------------------------------------------------------------------------------------------------------------ fits


def rate_at(step: int, steps: int) -> float:
    """Cosine from 1 to nearly 0."""
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / steps))


def fit_pose(fit: Fit, model: Model, misfit: Misfit, steps: int, seed: int) -> None:
    """Shift and turn: running sums first, then the likelihood. Moves `fit.found`."""
    vertices = fit.found
    shift, turn = (torch.zeros(3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    # Adam's steps are as long as its rate: 1 % of the scan's width, for shifts and for what turns do to the letter.
    rate, radius = 0.01 * WALL_M, float((vertices - vertices.mean(0)).norm(dim=1).mean())
    rates = {shift: rate, turn: rate / radius}
    # One for each loss: what Adam remembers of the slopes of one says nothing about the other.
    optimizers = [torch.optim.Adam([{"params": [p]} for p in rates], betas=(0.8, 0.9)) for _ in range(2)]
    true_shift, true_turn = true_pose(seed)

    def note() -> str:
        left = rotation(turn.detach()) @ rotation(true_turn).T
        sine = torch.stack([left[2, 1] - left[1, 2], left[0, 2] - left[2, 0], left[1, 0] - left[0, 1]]).norm()
        degrees = math.degrees(math.atan2(float(sine), float(left.trace()) - 1))
        fit.errors.setdefault("position, mm", []).append(1000 * float((shift.detach() - true_shift).norm()))
        fit.errors.setdefault("rotation, degrees", []).append(degrees)
        return f"{fit.errors['position, mm'][-1]:.1f} mm, {degrees:.2f} deg"

    def loss_of(step: int) -> Tensor:
        light = model(placed(vertices, shift, turn), seed * 100_000 + step)
        return misfit.running_sums(light) if step < steps // 2 else misfit.likelihood(light)

    def move(step: int) -> None:
        optimizer = optimizers[step >= steps // 2]
        for group, longest in zip(optimizer.param_groups, rates.values(), strict=True):
            group["lr"] = longest * rate_at(step, steps)
        optimizer.step()
        optimizer.zero_grad()

    descend(fit, steps, loss_of, move, note)
    fit.found = placed(vertices, shift.detach(), turn.detach())


def fit_shape(fit: Fit, model: Model, misfit: Misfit, steps: int, seed: int) -> None:
    """All vertices of `fit.found`. Their gradient is smoothed over a length on the letter that shrinks from half the
    letter to the edge of a triangle; Adam with one scale for all of them, so that smooth stays smooth.
    """
    vertices, truth = fit.found.clone().requires_grad_(), fit.measurement.vertices
    apart, corners = torch.cdist(fit.start, fit.start), fit.start[fit.faces]
    longest, shortest = 0.5 * SIZE_M, float((corners - corners.roll(1, 1)).norm(dim=2).mean())
    rate, momentum, square = 0.01 * WALL_M, torch.zeros_like(fit.start), 0.0

    def note() -> str:
        found = vertices.detach()
        surface = 1000 * float(tt.losses.surface_distance(found, fit.faces, truth, fit.faces))
        fit.errors.setdefault("surface, mm", []).append(surface)
        fit.errors.setdefault("vertices, mm", []).append(1000 * float((found - truth).norm(dim=1).mean()))
        return f"{surface:.1f} mm"

    def loss_of(step: int) -> Tensor:
        light = model(vertices, SHAPE_SEED + seed * 100_000 + step)
        return misfit.running_sums(light) if step < steps // 2 else misfit.likelihood(light)

    def move(step: int) -> None:
        nonlocal momentum, square
        length = longest * (shortest / longest) ** min(1.0, 1.6 * step / steps)
        kernel = torch.exp(-0.5 * (apart / length).square())
        kernel = kernel / kernel.sum(1, keepdim=True)
        assert vertices.grad is not None
        slope = kernel @ (kernel.T @ vertices.grad)
        since = step if step < steps // 2 else step - steps // 2
        if since == 0:  # the slopes of one loss say nothing about those of the other
            momentum, square = torch.zeros_like(slope), 0.0
        momentum = 0.8 * momentum + 0.2 * slope
        square = 0.9 * square + 0.1 * float(slope.square().sum(1).mean())
        unbiased = (momentum / (1 - 0.8 ** (since + 1))) / math.sqrt(square / (1 - 0.9 ** (since + 1)))
        with torch.no_grad():
            vertices.sub_(rate * rate_at(step, steps) * unbiased)
        vertices.grad = None

    descend(fit, steps, loss_of, move, note)
    fit.found = vertices.detach()


def descend(
    fit: Fit, steps: int, loss_of: Callable[[int], Tensor], move: Callable[[int], None], note: Callable[[], str]
) -> None:
    """Steps with a bar. The first step compiles kernels and is not timed."""
    began, text = time.perf_counter(), note()
    bar = tqdm(range(steps), desc=fit.name, unit="step", postfix=text)
    for step in bar:
        loss = loss_of(step)
        loss.backward()
        move(step)
        fit.losses.append(float(loss.detach()))
        bar.set_postfix_str(note())
        if step == 0:
            began = time.perf_counter()
    fit.seconds_a_step = (time.perf_counter() - began) / max(1, steps - 1)


# ------------------------------------------------------------------------------------------------------ the example


def run(what: str, kind: str, seed: int, settings: Settings, folder: Path) -> Fit:
    """One fit of a capture of its own; writes meshes, counts and curves as .npz, and a picture."""
    shape = letter(settings.subdivide if what == "shape" else 0)
    start, faces = arrays(shape)
    truth = placed(bent(start) if what == "shape" else start, *true_pose(seed))
    measurement = measure(kind, shape, truth, seed, settings)
    model, misfit = Model(shape, measurement, settings.spp), Misfit(measurement.counts)
    fit = Fit(f"{what}, {kind}, seed {seed}", measurement, faces, start, start)
    meshes, expected = {"start": start}, {"measured": measurement.counts}

    def look(name: str) -> None:
        with torch.no_grad():
            expected[name] = misfit.expected(model(fit.found, MEASURED_SEED - 1))
        meshes[name] = fit.found

    look("start")
    fit_pose(fit, model, misfit, settings.pose_steps, seed)
    if what == "shape":
        # A bent letter has no pose: its errors are those of its surface.
        look("after pose")
        misfit, fit.start, fit.losses, fit.errors = Misfit(measurement.counts), fit.found, [], {}
        fit_shape(fit, model, misfit, settings.shape_steps, seed)
    look("found")
    name = "nlos_letter_" + fit.name.replace(", ", "_").replace(" ", "")
    folder.mkdir(parents=True, exist_ok=True)
    arrays_of = {key.replace(", ", "_"): np.array(values) for key, values in fit.errors.items()}
    arrays_of |= {key.replace(" ", "_"): mesh.numpy() for key, mesh in (meshes | {"truth": truth}).items()}
    counts = measurement.counts.to(torch.int32).numpy()
    np.savez_compressed(folder / f"{name}.npz", counts=counts, faces=faces.numpy(), losses=fit.losses, **arrays_of)
    draw(fit, measurement, meshes | {"truth": truth}, faces.numpy(), expected, folder / f"{name}.png")
    return fit


# -------------------------------------------------------------------------------------------------------- the figure


def draw(
    fit: Fit, measurement: Measurement, meshes: Mapping[str, Tensor], faces: Any, expected: Mapping[str, Tensor],
    path: Path,
) -> None:  # fmt: skip
    """Write the fit as a picture: the letter from the wall and from above, three transients, loss and errors."""
    colours = dict(zip(meshes, ("0.55", "tab:blue", "tab:orange", "tab:purple"), strict=False))
    colours[list(meshes)[-1]] = "tab:green"
    figure = Figure(figsize=(11.0, 7.4), layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.25, 1.0)).flat
    front, above = upper.subplots(1, 2)
    vertices = {name: mesh.numpy() for name, mesh in meshes.items()}
    draw_views(front, above, measurement.scan, vertices, faces, colours)
    *panels, last = lower.subplots(1, 4, width_ratios=(1.0, 1.0, 1.0, 1.2))
    axis = measurement.axis
    together = -(-axis.num_bins // 128)  # finer bins are added up
    whole = axis.num_bins // together * together
    edges = axis.edges_opl.numpy()[: whole + 1 : together]
    for n, panel in enumerate(panels):
        for name, cube in expected.items():
            row, column = (int((2 * n + 1) * size / 6) for size in cube.shape[1:])
            values = cube[:whole, row, column].detach().cpu().numpy().reshape(-1, together).sum(1)
            panel.stairs(values, edges, color=colours.get(name, "0.75"), linewidth=1.1, label=name)
        panel.set_title(f"point {column}, {row}", fontsize=9)
        panel.set_xlabel("optical path length (m)", fontsize=8)
        panel.tick_params(labelsize=7)
        panel.margins(x=0)
    panels[0].set_ylabel("counts", fontsize=8)
    panels[0].legend(fontsize=7, frameon=False)
    for n, (name, errors) in enumerate(fit.errors.items()):
        last.plot(errors, color=f"C{n}", linewidth=1.2, label=name)
    last.set_yscale("log")
    last.set_xlabel("step", fontsize=8)
    last.tick_params(labelsize=7, which="both")
    last.grid(True, color="0.9", linewidth=0.6)
    twin = last.twinx()
    twin.plot(fit.losses, color="0.6", linewidth=0.8, linestyle="--", label="loss")
    twin.set_yscale("log")
    twin.tick_params(labelsize=7, colors="0.6", which="both")
    lines = [*last.get_lines(), *twin.get_lines()]
    last.legend(lines, [line.get_label() for line in lines], fontsize=7, frameon=False)
    last.set_title("errors, and the loss (dashed)", fontsize=9)
    figure.savefig(path, dpi=120)


def draw_views(front: Any, above: Any, scan: Any, meshes: Mapping[str, Any], faces: Any, colours: Any) -> None:
    """Draw meshes as the wall sees them, along its axes u and v, and from above, along u and its normal."""
    wall = tt.nlos.Wall.of(scan.wall)
    frame = np.stack([axis / np.linalg.norm(axis) for axis in (wall.half_u, wall.half_v, wall.normal)], axis=1)
    points = (scan.sensor_points.numpy().reshape(-1, 3) - wall.center) @ frame
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    rims = unique[count == 1]
    for panel, (i, j) in ((front, (0, 1)), (above, (0, 2))):
        panel.scatter(points[:, i], points[:, j], s=1.5, color="0.8", linewidths=0)
        # The truth first and broad, so that what was found shows on it.
        for n, name in enumerate(sorted(meshes, key=list(meshes)[-1].__ne__)):
            corners, width = ((meshes[name] - wall.center) @ frame)[:, [i, j]], 1.3 if n else 3.5
            fill = PolyCollection(list(corners[faces]), facecolor=colours[name], edgecolor="none", alpha=0.15)
            panel.add_collection(fill)
            panel.add_collection(LineCollection(list(corners[rims]), color=colours[name], linewidth=width, label=name))
            panel.autoscale_view()
        panel.set_aspect("equal")
        panel.set_xlabel("along the wall (m)")
    front.set_ylabel("up (m)")
    front.set_title("seen from the wall", fontsize=10)
    front.legend(fontsize=8, frameon=False, loc="upper left")
    above.set_ylabel("distance from the wall (m)")
    above.set_title("seen from above", fontsize=10)


# ------------------------------------------------------------------------------------------------------- command line


def summary(fits: Sequence[Fit]) -> dict[str, Any]:
    """Errors before and after of each fit, and their medians."""
    names = list(fits[0].errors)
    rows: dict[str, Any] = {f.name: {"steps": len(f.losses), "s_a_step": f.seconds_a_step} for f in fits}
    for fit in fits:
        rows[fit.name] |= {n: [fit.errors[n][0], fit.errors[n][-1]] for n in names}
    return {"fits": rows, "median": {n: statistics.median(f.errors[n][-1] for f in fits) for n in names}}


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Command line. Prints a line for each fit and the medians; returns and writes them as `nlos_letter.json`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    both = ["confocal", "single"]
    parser.add_argument("--fit", nargs="+", choices=["pose", "shape"], default=["pose", "shape"], help="what is fitted")
    parser.add_argument("--kind", nargs="+", choices=both, default=both, help="kinds of scans (both)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="true poses and noise (%(default)s)")
    numbers = ("points", "spp", "pose_steps", "shape_steps")
    for name in numbers:
        option = f"--{name.replace('_', '-')}"
        parser.add_argument(option, type=int, default=getattr(Settings, name), help="(%(default)s)")
    parser.add_argument("--late", action="store_true", help="measure light of up to five bounces, too")
    parser.add_argument("--smoke", action="store_true", help="few points and steps: seconds, and coarse")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder (%(default)s)")
    options = parser.parse_args(argv)
    settings = Settings(late=options.late, **{name: getattr(options, name) for name in numbers})
    if options.smoke:
        settings = replace(settings, points=8, spp=256, measured_spp=1024, pose_steps=24, shape_steps=24)
    found: dict[str, Any] = {}
    for what in options.fit:
        for kind in options.kind:
            fits = [run(what, kind, seed, settings, options.output) for seed in options.seeds]
            found[f"{what}, {kind}"] = made = summary(fits)
            for name, row in made["fits"].items():
                words = [f"{key} {v[0]:.1f} -> {v[1]:.2f}" for key, v in row.items() if isinstance(v, list)]
                print(f"{name}: {'; '.join(words)}; {row['steps']} steps of {row['s_a_step']:.2f} s")
            medians = ", ".join(f"{key} {value:.3f}" for key, value in made["median"].items())
            print(f"{what}, {kind}: median of {len(fits)}: {medians}")
    (options.output / "nlos_letter.json").write_text(json.dumps(found, indent=1))
    print(f"nlos_letter: {options.output}")
    return found


if __name__ == "__main__":
    main()
