"""The boundary term of moving edges: right or not, how noisy, and what it costs.

    boundary_cost.py cases [NAMES]     parts of the derivative beside finite differences with common random numbers
    boundary_cost.py room [NAMES]      closed rooms: derivative of the mean arrival, many bounces
    boundary_cost.py spread [NAMES]    single runs of concave shapes: root mean square over median, slope by samples
    boundary_cost.py variance PACKAGE  variance of every gradient case of a package, beside another checkout's
    boundary_cost.py sweep [SHAPES]    every shape plugin, seen, in shadow, seen from a surface; moved, turned, grown
    boundary_cost.py step              a training step of 8 x 8 x 16 beside one without moving edges; memory by depth
    boundary_cost.py fit               a plate by Adam from 8 cm off

`z` is a difference over its standard error. `gain`: variance x time of finite differences over that of the derivative.
`cases` counts the time of kernels alone, of the fastest of the runs, and prints the figures of an earlier measurement
where there are some (`before`). `variance` reads `PACKAGE.all_cases.ALL_CASES` and `PACKAGE.problem.Problem`; with
`--against FILE`, a report of another checkout with the same seeds, it prints ratios and flags those above 1.1. All runs
in one thread.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import itertools
import json
import math
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _runner import environment
from numpy.typing import NDArray

import torchtransient as tt  # isort: skip
import drjit as dr
import torch

from tools.boundary_cases.closed_rooms import ROOMS
from tools.boundary_cases.edge_derivatives import PASSES, EdgeProblem, choose_passes, components, pixel_weights
from tools.boundary_cases.moving_edges import CASES, CONCAVE, QUICK, MovingEdge, histograms, plain_plate
from tools.boundary_cases.moving_shapes import BODIES, CHANGES, PLACES, moving_shape
from torchtransient.errors import GradientError, TorchTransientWarning

Array = NDArray[np.float64]
Result = dict[str, Any]
# Variance of a derivative over that of another checkout, above which it is listed.
MORE_VARIANCE = 1.1
# Standard errors up to which a derivative agrees with differences.
AGREES = 4.0


def error(values: Sequence[float] | Array) -> float:
    """Standard error of the mean."""
    return float(np.std(values, ddof=1) / math.sqrt(len(values)))


def z_score(a: Array, b: Array) -> float:
    """Difference of two means over its standard error."""
    spread = math.hypot(error(a), error(b))
    return float((a.mean() - b.mean()) / spread) if spread > 0 else 0.0 if a.mean() == b.mean() else math.inf


def pair(values: Array) -> str:
    return f"{values.mean():.4f} +- {error(values):.4f}"


def row(values: Array) -> Result:
    return {"mean": float(values.mean()), "error": error(values), "runs": values.tolist()}


# --------------------------------------------------------------------------------------------- parts of the derivative


def in_kernels(call: Callable[[int], float], seed: int) -> tuple[float, float]:
    """(what a call gives, seconds that Dr.Jit gives for its kernels)."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        value = call(seed)
        dr.sync_thread()
        return value, 1e-3 * sum(kernel.get("execution_time", 0.0) for kernel in dr.kernel_history())


def measure_case(name: str, options: argparse.Namespace) -> Result:
    """Interior term, each pass, their sum and finite differences of one case, and what each costs."""
    case = CASES[name]
    problem = EdgeProblem(case)
    seeds = range(options.seeds)

    def runs(call: Callable[[int], float], first: int) -> tuple[Array, float]:
        """(values, least seconds of kernels), after a run that compiles."""
        call(first - 1)
        found = [in_kernels(call, first + seed) for seed in seeds]
        return np.array([value for value, _ in found]), min(seconds for _, seconds in found)

    def part(first: int, passes: tuple[str, ...], *, interior: bool) -> tuple[Array, float]:
        settings: Result = {"interior": interior, "share": options.share}
        return runs(lambda seed: problem.reverse(seed, options.spp, passes, **settings), first)

    parts = {"interior": part(100, (), interior=True)}
    parts |= {each: part(200, (each,), interior=False) for each in PASSES}
    whole = np.sum([values for values, _ in parts.values()], axis=0)
    seconds = sum(took for _, took in parts.values())
    differences, fd_seconds = runs(lambda seed: problem.difference(seed, options.fd_spp, options.step), 300)
    inside = parts["interior"][1]
    work = whole.var(ddof=1) * seconds
    return {
        "parts": {
            each: row(values) | {"seconds": took, "cost": took / inside} for each, (values, took) in parts.items()
        },
        "total": row(whole) | {"seconds": seconds, "cost": seconds / inside},
        "differences": row(differences) | {"seconds": fd_seconds},
        "z": z_score(whole, differences),
        "gain": float(differences.var(ddof=1) * fd_seconds / work) if work > 0 and not case.left_out else None,
        "before": {
            "interior": case.expected.interior,
            "total": case.expected.total,
            "differences": case.expected.differences,
        },
        "left_out": case.left_out,
    }


def line_of_case(name: str, found: Result) -> str:
    def number(part: Result) -> str:
        return f"{part['mean']:.4f} +- {part['error']:.4f}"

    parts = " ".join(f"{each} {number(part)}" for each, part in found["parts"].items())
    costs = " ".join(f"{each} {part['cost']:.2f}" for each, part in found["parts"].items() if each != "interior")
    gain = "-" if found["gain"] is None else f"{found['gain']:.2g}"
    return (
        f"{name}: {parts} | total {number(found['total'])}, differences {number(found['differences'])}, "
        f"z {found['z']:+.1f}{before_of(found)} | cost {costs}, all {found['total']['cost']:.2f} of "
        f"{found['parts']['interior']['seconds']:.4f} s; gain {gain}"
        + (f" | left out: {found['left_out']}" if found["left_out"] else "")
    )


def before_of(found: Result) -> str:
    """The earlier figures, and how far off they are where they have an error."""
    words = []
    if found["before"]["interior"] is not None:
        words.append(f"interior {found['before']['interior']:g}")
    for name in ("total", "differences"):
        if (kept := found["before"][name]) is None:
            continue
        value, wide = kept
        spread = math.hypot(wide or 0, found[name]["error"])
        z = f" (z {(found[name]['mean'] - value) / spread:+.1f})" if wide and spread else ""
        words.append(f"{name} {value:g}" + (f" +- {wide:g}" if wide else "") + z)
    return f" | before: {', '.join(words)}" if words else ""


def cases(options: argparse.Namespace) -> Result:
    names = options.names or (QUICK if options.quick else list(CASES))
    found: Result = {}
    for name in names:
        try:
            found[name] = measure_case(name, options)
            print(line_of_case(name, found[name]), flush=True)
            if options.layer:
                found[name]["layer"] = by_layer(CASES[name], found[name], options)
        except Exception as failure:  # noqa: BLE001 - printed; the other cases are measured
            traceback.print_exc()
            found[name] = {"failed": f"{type(failure).__name__}: {failure}"}
            print(f"{name}: FAILED {found[name]['failed'][:300]}", flush=True)
    off = [name for name, case in found.items() if "z" in case and abs(case["z"]) > 3 and not case["left_out"]]
    print(f"{len(found)} cases, beyond 3 standard errors: {', '.join(off) or 'none'}")
    return found


# ------------------------------------------------------------------------------------------------------ by the layer


class LayerProblem:
    """A case as a function of torch tensors: its loss, derivative and differences by ``tt.TransientRenderer``."""

    def __init__(self, case: MovingEdge, **settings: Any) -> None:
        self.case, self.key = case, case.key
        self.renderer = tt.TransientRenderer(tt.load(case.scene(), variant=case.variant), [case.key], **settings)
        self.base = self.renderer.values[case.key].detach().clone()
        change = case.direction(self.base.double().numpy())
        self.direction = torch.as_tensor(np.array(change), dtype=torch.float32).reshape(self.base.shape)
        self.weights = torch.ones(())

    def transient(self, x: Any, seed: int, spp: int) -> torch.Tensor:
        """(C, T, H, W)"""
        found: torch.Tensor = self.renderer({self.key: self.base + x * self.direction}, seed=seed, spp=spp).transient
        return found

    def weigh(self, spp: int = 1 << 18, renders: int = 4) -> None:
        """Make the loss's weights; of a mean over the light by ``renders`` renders."""
        axis = torch.as_tensor(np.asarray(self.renderer.axis.centers_opl))
        if self.case.weights in ("arrival", "sine"):
            with torch.no_grad():
                record = sum(self.transient(0.0, 9000 + seed, spp).double() for seed in range(renders)) / renders
            light, record = float(record.sum()), record.sum((-2, -1)).reshape(-1)
            mean = float((record * axis).sum()) / light
            weights = (axis - mean if self.case.weights == "arrival" else torch.sin(3 * axis)) / light
        else:
            weights = torch.sin(3 * axis)
        channels, _, height, width = self.transient(0.0, 0, 1).shape
        shares = torch.as_tensor(components(channels) * pixel_weights(self.case, height, width)).permute(3, 2, 0, 1)
        self.weights = weights.float()[:, None, None] * shares.float()

    def loss(self, x: Any, seed: int, spp: int) -> torch.Tensor:
        return (self.transient(x, seed, spp) * self.weights).sum()

    def reverse(self, seed: int, spp: int) -> float:
        x = torch.zeros((), requires_grad=True)
        self.loss(x, seed, spp).backward()
        return 0.0 if x.grad is None else float(x.grad)

    def difference(self, seed: int, spp: int, step: float | None = None) -> float:
        h = step or self.case.step
        with torch.no_grad():
            return float(self.loss(h, seed, spp) - self.loss(-h, seed, spp)) / (2 * h)


def by_layer(case: MovingEdge, parts: Result, options: argparse.Namespace) -> Result | None:
    """The derivative as a user has it, beside the sum of its parts; None of films that are no histograms."""
    if case.scene()["sensor"]["film"]["type"] != "transient_hdr_film":
        return None
    problem = LayerProblem(case)
    problem.weigh()
    found = np.array([problem.reverse(400 + seed, options.spp) for seed in range(options.seeds)])
    z = z_score(found, np.array(parts["total"]["runs"]))
    print(f"    by the layer: {pair(found)}, z {z:+.1f}", flush=True)
    return row(found) | {"z": z}


DEPTHS = {"meter": (2, 3, 8), "far": (3, 4), "near": (4,), "far_small_lamp": (3, 4), "lamp": (3,), "piston": (3,)}


def room(options: argparse.Namespace) -> Result:
    """Derivative of the mean arrival by reverse mode and by differences; ``error``: relative, of 2^20 paths."""
    names = options.names or ["meter", "lamp", "far", "piston"]
    names = [options.sensor] if options.sensor else names
    found: Result = {}
    for name in names:
        for depth in options.depth or DEPTHS.get(name, (3,)):
            problem = LayerProblem(ROOMS[name](depth))
            problem.weigh(1 << 10 if options.quick else 1 << 18)
            spp = options.spp
            problem.reverse(299, spp)
            begun = time.process_time()
            reverse = np.array([problem.reverse(300 + seed, spp) for seed in range(options.seeds)])
            cpu = (time.process_time() - begun) / options.seeds
            begun = time.process_time()
            runs = [problem.difference(5000 + seed, 4 * spp, options.step) for seed in range(options.seeds)]
            fd_cpu = (time.process_time() - begun) / options.seeds
            differences = np.array(runs)
            variance = float(reverse.var(ddof=1) * spp)
            size = abs(differences.mean())
            relative = math.sqrt(variance / 2**20) / size if size > 0 else math.inf
            found[f"{name}, depth {depth}"] = {
                "reverse": row(reverse) | {"median": float(np.median(reverse)), "cpu": cpu, "variance x spp": variance},
                "differences": row(differences) | {"cpu": fd_cpu},
                "z": z_score(reverse, differences),
                "relative error of 2^20": relative,
            }
            print(
                f"{name}, depth {depth}: reverse {pair(reverse)}, median {np.median(reverse):.4f}, differences "
                f"{pair(differences)}, z {z_score(reverse, differences):+.1f}; variance x spp {variance:.3g}, relative "
                f"error of 2^20 paths {100 * relative:.2f} %, CPU {cpu:.2f} s ({fd_cpu:.2f} s)",
                flush=True,
            )
    return found


def spread(options: argparse.Namespace) -> Result:
    """Single runs: root mean square of their distances from the median over the median distance (1.48 of a normal
    distribution), and the slope of log variance by log samples (-1).
    """
    found: Result = {}
    counts = (8, 16) if options.quick else tuple(options.spps)
    for name in options.names or (["corner"] if options.quick else list(CONCAVE)):
        for depth in options.depth or (3, 4):
            problem = LayerProblem(CONCAVE[name](depth))
            problem.weigh()
            rows = []
            for spp in counts:
                runs = np.array([problem.reverse(100 + seed, spp) for seed in range(options.seeds)])
                off = np.abs(runs - np.median(runs))
                tails = float(np.sqrt((off**2).mean()) / max(np.median(off), 1e-12))
                rows.append(row(runs) | {"spp": spp, "rms over median": tails, "variance": float(runs.var(ddof=1))})
            slope = np.polyfit(np.log(counts), np.log([max(r["variance"], 1e-30) for r in rows]), 1)[0]
            found[f"{name}, depth {depth}"] = {"rows": rows, "slope": float(slope)}
            words = "; ".join(
                f"{r['spp']} spp: {r['mean']:.4f} +- {r['error']:.4f}, deviation "
                f"{100 * math.sqrt(r['variance']) / abs(r['mean']):.0f} %, rms over median {r['rms over median']:.1f}"
                for r in rows
            )
            print(f"{name}, depth {depth}: {words}; slope {slope:+.2f}", flush=True)
    return found


# ------------------------------------------------------------------------------------------- variance of what there is


def ratio_of(now: Array, before: Array) -> tuple[float, float]:
    """(ratio of variances, its standard error by leaving out one pair of runs at a time)."""
    ratio = float(now.var(ddof=1) / before.var(ddof=1))
    without = [np.delete(now, k).var(ddof=1) / np.delete(before, k).var(ddof=1) for k in range(len(now))]
    n = len(without)
    return ratio, float(np.sqrt((n - 1) / n * np.square(np.array(without) - np.mean(without)).sum()))


def variance(options: argparse.Namespace) -> Result:
    """Variance of the reverse-mode derivative of every case, each at 1 / 16 of its samples, with all of its seeds."""
    package = options.package
    every = importlib.import_module(f"{package}.all_cases").ALL_CASES
    problem_of = importlib.import_module(f"{package}.problem").Problem
    before = json.loads(options.against.read_text(encoding="utf-8"))["results"] if options.against else {}
    taken = [case for case in every if not options.names or case.name in options.names]
    found: Result = {}
    flagged = []
    for case in taken[:3] if options.quick else taken:
        try:
            spp = max(1, case.spp // 16)
            problem = problem_of(dataclasses.replace(case, spp=spp, fd_spp=spp))
            if options.interior:
                choose_passes(problem.scene.integrator(), ())
            runs = np.array([problem.reverse(100 + seed) for seed in range(options.seeds)])
        except Exception as failure:  # noqa: BLE001 - printed; the other cases are measured
            found[case.name] = {"failed": f"{type(failure).__name__}: {failure}"[:500]}
            print(f"{case.name}: FAILED {found[case.name]['failed'][:200]}", flush=True)
            continue
        found[case.name] = row(runs) | {"spp": spp, "variance": float(runs.var(ddof=1))}
        words = f"{case.name}: {runs.mean():.6g} +- {error(runs):.2g}, variance x spp {runs.var(ddof=1) * spp:.4g}"
        other = before.get(case.name, {})
        if "runs" in other and len(other["runs"]) == len(runs) and other["spp"] == spp and np.var(other["runs"]) > 0:
            ratio, wide = ratio_of(runs, np.array(other["runs"]))
            more = ratio > MORE_VARIANCE
            found[case.name] |= {"ratio": ratio, "error of the ratio": wide, "more": more}
            flagged += [case.name] * more
            words += f", {ratio:.2f} +- {wide:.2f} x" + (" MORE" if more else "")
        print(words, flush=True)
    if before:
        print(f"more than {MORE_VARIANCE} x the variance: {', '.join(flagged) or 'none'}")
    return found


# --------------------------------------------------------------------------------------------------- every shape


def judged(case: MovingEdge, options: argparse.Namespace) -> Result:
    """``agrees``, ``contradicts``, ``warned`` (off, and the library said so) or ``refused`` (GradientError)."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            problem = LayerProblem(case, physics="ignore")
            problem.weigh()
            reverse = np.array([problem.reverse(100 + seed, options.spp) for seed in range(options.seeds)])
        except GradientError as refusal:
            return {"verdict": "refused", "why": str(refusal)}
        runs = [problem.difference(300 + seed, options.fd_spp, options.step) for seed in range(options.seeds)]
    differences = np.array(runs)
    said = [str(warning.message) for warning in heard if issubclass(warning.category, TorchTransientWarning)]
    z = z_score(reverse, differences)
    verdict = "agrees" if abs(z) < AGREES else "warned" if said else "contradicts"
    strong = abs(differences.mean()) > 3 * error(differences)
    return {
        "verdict": verdict, "z": z, "reverse": row(reverse), "differences": row(differences), "warnings": said,
        "differences differ from zero": bool(strong),
    }  # fmt: skip


def sweep(options: argparse.Namespace) -> Result:
    bodies = options.names or (["rectangle"] if options.quick else list(BODIES))
    found: Result = {}
    with tempfile.TemporaryDirectory() as folder:
        for body, place, change in itertools.product(bodies, PLACES, CHANGES):
            name = f"{body}, {place}, {change}"
            try:
                found[name] = judged(moving_shape(body, place, change, Path(folder)), options)
            except Exception as failure:  # noqa: BLE001 - printed; the other cases are measured
                found[name] = {"verdict": "failed", "why": f"{type(failure).__name__}: {failure}"}
            result = found[name]
            words = result.get("why", "")[:160]
            if "z" in result:
                words = f"reverse {{}}, differences {{}}, z {result['z']:+.1f}".format(
                    *(
                        f"{result[side]['mean']:.4f} +- {result[side]['error']:.4f}"
                        for side in ("reverse", "differences")
                    )
                )
                words += "" if result["differences differ from zero"] else " (differences are noise)"
            print(f"{name}: {result['verdict']}; {words}", flush=True)
    counts = {verdict: sum(r["verdict"] == verdict for r in found.values()) for verdict in
              ("agrees", "contradicts", "warned", "refused", "failed")}  # fmt: skip
    print(", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count))
    if options.page is not None:
        options.page.write_text(page_of(found, options), encoding="utf-8")
    return found


def page_of(found: Result, options: argparse.Namespace) -> str:
    """The sweep as a page of the documentation."""
    lines = [
        "# Every shape that moves",
        "The derivative of a loss (random pixel weights, times a sine of the path length) by one number that moves a "
        "shape before a background (*primary*), that throws a shadow into the picture (*shadow*), and that another "
        "surface sees (*surface*): translated, turned, and grown or with moved vertices. Reverse mode with the "
        "[boundary term](gradients.md#edges-that-move) against central differences with common random numbers, each "
        f"+- its standard error over {options.seeds} seeds; `make sweep` writes this page.",
        "",
        "*agrees*: within 4 standard errors; *warned*: off, and a `GradientWarning` said so at the first call.",
        "",
        "| shape | seen | moved | reverse mode | differences | |",
        "|---|---|---|---|---|---|",
    ]
    for name, result in found.items():
        body, place, change = name.split(", ")
        numbers = ["", ""]
        if "z" in result:
            numbers = [f"{result[s]['mean']:.4f} +- {result[s]['error']:.4f}" for s in ("reverse", "differences")]
        lines.append(f"| {body} | {place} | {change} | {numbers[0]} | {numbers[1]} | {result['verdict']} |")
    return "\n".join(lines) + "\n"


# ----------------------------------------------------------------------------------------------- training steps, a fit

POSE, ALBEDO = "body.to_world", "body.bsdf.reflectance.value"


def small_plate(depth: int, size: int = 8) -> Result:
    film = histograms(5.5) | {"temporal_bins": 16, "bin_width_opl": 0.4, "width": size, "height": size}
    found = plain_plate(film)
    return found | {"integrator": found["integrator"] | {"max_depth": depth}}


def stepper(key: str, spp: int = 1, depth: int = 4, size: int = 8) -> Callable[[int], tuple[float, float]]:
    """A training step by a parameter: (wall seconds, CPU seconds)."""
    scene = tt.load(small_plate(depth, size), variant="llvm_ad_mono")
    renderer = tt.TransientRenderer(scene, [key], spp=spp, temporal_filter="tent")

    def step(seed: int) -> tuple[float, float]:
        wall, cpu = time.perf_counter(), time.process_time()
        renderer.zero_grad()
        renderer(seed=seed).transient.square().sum().backward()
        return time.perf_counter() - wall, time.process_time() - cpu

    return step


def peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def child(depth: int, key: str, *, quick: bool) -> None:
    """Growth of the peak memory of two steps, after a small one that compiles."""
    size, spp = (8, 4) if quick else (64, 64)
    stepper(key, 1, depth)(0)
    step = stepper(key, spp, depth, size)
    before = peak_bytes()
    for seed in (1, 2):
        step(seed)
    print(json.dumps(peak_bytes() - before))


def step(options: argparse.Namespace) -> Result:
    """The step by the plate's pose beside the one by its albedo, in turns."""
    repeats = 3 if options.quick else options.repeats
    steps = {name: stepper(key) for name, key in (("pose", POSE), ("albedo", ALBEDO))}
    for warm_up, run in itertools.product(range(3), steps.values()):
        run(warm_up)
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in steps}
    for seed in range(repeats):
        for name, run in steps.items():
            seconds[name].append(run(100 + seed))
    found: Result = {}
    for place, kind in enumerate(("wall", "cpu")):
        median = {name: statistics.median(times[place] for times in runs) for name, runs in seconds.items()}
        ratio = statistics.median(a[place] / b[place] for a, b in zip(seconds["pose"], seconds["albedo"], strict=True))
        found[kind] = median | {"ratio": ratio}
        print(f"{kind}: pose {median['pose']:.4f} s, albedo {median['albedo']:.4f} s, {ratio:.2f} x", flush=True)
    memory: Result = {}
    for depth, (name, key) in itertools.product((4, 16), (("pose", POSE), ("albedo", ALBEDO))):
        command = [sys.executable, __file__, *(["--quick"] if options.quick else []), "child", str(depth), key]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        memory[f"{name}, depth {depth}"] = grown = int(done.stdout.splitlines()[-1])
        print(f"{name}, depth {depth}: peak grows by {grown / 2**20:.1f} MiB", flush=True)
    return found | {"memory": memory}


def fit(options: argparse.Namespace) -> Result:
    """Where Adam ends, in millimetres, that starts 8 cm off."""
    steps, spp = (3, 16) if options.quick else (options.steps, 256)
    renderer = tt.TransientRenderer(tt.load(plain_plate(), variant="llvm_ad_mono"), [POSE], spp=spp, spp_grad=spp)
    base = renderer.values[POSE].detach().clone()

    def render(shift: torch.Tensor, seed: int, samples: int = spp) -> torch.Tensor:
        offset = torch.zeros(4, 4)
        offset[:2, 3] = shift
        transient: torch.Tensor = renderer({POSE: base + offset}, seed=seed, spp=samples).transient
        return transient

    with torch.no_grad():
        target = render(torch.zeros(2), 1000, 64 if options.quick else 8192)
    found: Result = {}
    for start in options.seeds_of_fits:
        angle = 2 * math.pi * start / 5 - 0.64
        shift = torch.tensor([0.08 * math.cos(angle), 0.08 * math.sin(angle)], requires_grad=True)
        optimizer = torch.optim.Adam([shift], 0.02, betas=(0.8, 0.95))
        begun = time.process_time()
        for k in range(steps):
            optimizer.param_groups[0]["lr"] = 0.02 * 0.5 ** (k / 12)
            optimizer.zero_grad()
            (render(shift, 100 * start + k) - target).square().sum().backward()
            optimizer.step()
        end = 1000 * float(shift.detach().norm())
        found[f"start {start}"] = {"end_mm": end, "cpu": time.process_time() - begun}
        print(f"start {start}: {end:.2f} mm after {steps} steps, {found[f'start {start}']['cpu']:.1f} s", flush=True)
    return found


# -------------------------------------------------------------------------------------------------------- command line


def numbers(parser: argparse.ArgumentParser, **defaults: int) -> None:
    """Options of one number each, by name with their defaults."""
    for name, value in defaults.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, default=value)


def parsed() -> argparse.Namespace:
    common = argparse.ArgumentParser(add_help=False, argument_default=argparse.SUPPRESS)
    common.add_argument(
        "--quick", action="store_true", help="tiny sizes: checks that the script runs, measures nothing"
    )
    common.add_argument("--json", type=Path, help="write the report to this file")
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, parents=[common]
    )
    commands = parser.add_subparsers(dest="command", required=True)
    adders = {}
    for function in (cases, room, spread, variance, sweep, step, fit):
        adders[function.__name__] = own = commands.add_parser(function.__name__, parents=[common])
        own.set_defaults(run=function)
    for name in ("room", "cases", "sweep"):
        adders[name].add_argument("--step", type=float, help="of differences, the case's own if not given")
    adders["cases"].add_argument("names", nargs="*", metavar="NAMES", help=", ".join(CASES))
    adders["cases"].add_argument("--layer", action="store_true", help="by tt.TransientRenderer as well")
    adders["cases"].add_argument("--share", type=float, help="edge samples for each path")
    numbers(adders["cases"], spp=512, fd_spp=2048, seeds=6)
    adders["room"].add_argument("names", nargs="*", metavar="NAMES", help=", ".join(ROOMS))
    adders["room"].add_argument("--sensor", choices=("meter", "far", "near"), help="the room by this sensor alone")
    adders["room"].add_argument("--depth", type=int, nargs="+")
    numbers(adders["room"], spp=1 << 16, seeds=10)
    adders["spread"].add_argument("names", nargs="*", metavar="NAMES", help=", ".join(CONCAVE))
    adders["spread"].add_argument("--depth", type=int, nargs="+")
    adders["spread"].add_argument("--spps", type=int, nargs="+", default=[256, 1024, 4096])
    numbers(adders["spread"], seeds=24)
    adders["variance"].add_argument("package", help="with all_cases.ALL_CASES and problem.Problem")
    adders["variance"].add_argument("names", nargs="*", metavar="NAMES", help="of cases; all if none is given")
    adders["variance"].add_argument("--against", type=Path, help="a report of another checkout")
    adders["variance"].add_argument("--interior", action="store_true", help="without the boundary term")
    numbers(adders["variance"], seeds=32)
    adders["sweep"].add_argument("names", nargs="*", metavar="SHAPES", help=", ".join(BODIES))
    adders["sweep"].add_argument("--page", type=Path, help="write the result as a page of the documentation")
    numbers(adders["sweep"], spp=256, fd_spp=4096, seeds=8)
    numbers(adders["step"], repeats=20)
    adders["fit"].add_argument("--starts", dest="seeds_of_fits", type=int, nargs="+", default=[0])
    numbers(adders["fit"], steps=70)
    inner = commands.add_parser("child", parents=[common])
    inner.add_argument("depth", type=int)
    inner.add_argument("key")
    options = parser.parse_args()
    options.quick, options.json = getattr(options, "quick", False), getattr(options, "json", None)
    if options.quick:
        small = {"spp": 16, "fd_spp": 32, "seeds": 3, "depth": [3]}
        for name in small.keys() & vars(options).keys() if options.command != "child" else ():
            setattr(options, name, small[name])
    return options


def main() -> None:
    options = parsed()
    tt.threads(1)
    if options.command == "child":
        child(options.depth, options.key, quick=options.quick)
        return
    results = options.run(options)
    if options.json is not None:
        settings = {name: str(value) for name, value in vars(options).items() if name not in ("run", "json")}
        data = {"benchmark": "boundary_cost", "settings": settings, "results": results, "environment": environment()}
        options.json.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
        print(f"written to {options.json}")


if __name__ == "__main__":
    main()
