"""One case of the sweep: how many samples a parameter calls for, and whether derivative and differences agree."""

from __future__ import annotations

import time
import zlib
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from tools.gradient_sweep.measure import Array, Subject, Tangent
from torchtransient.errors import GradientError

# The scale beside which an error is small: a part of the loss with absolute weights, for a change of the parameter by
# its own size (a pose: by a metre or a fifth of a radian).
SCALE = 0.1
# A case counts as checked below this standard error, relative to the larger of |finite difference| and scale.
RESOLVED = 0.02
# Below that part of the scale, an effect is weak: errors then count beside this many times the effect itself.
WEAK = 5.0
# A contradiction: more standard errors, and more of the larger of the two, than this.
SIGMAS, TOLERANCE = 3.5, 0.01
# Forward and reverse mode use the same paths and add float32 terms in another order.
ROUNDING = 2e-3
# Samples per pixel are for a film of so many pixels, more of smaller ones.
FILM = 16
# How often a step is halved when its length makes a difference.
SHORTER_STEPS = 4
# How many times as long a step may become where it lessens the noise.
LONGER_STEPS = 4.0


@dataclass(frozen=True)
class Effort:
    """Effort for one parameter: seconds of a processor for one direction, seeds and samples per pixel to
    begin with, at most so many directions from which one on, at most so many paths a seed, seeds to confirm a
    contradiction with. Of so many parameters, one is differentiated in forward mode too. What calls for so many times
    as many paths is given up.
    """

    seconds: float = 45.0
    seeds: int = 6
    spp: int = 2048
    directions: int = 2
    first_direction: int = 0
    paths: int = 2**21
    confirming: int = 12
    forward_of: int = 1
    patience: float = float("inf")

    def chosen(self, tangents: list[Tangent]) -> list[Tangent]:
        """Select directions in a parameter."""
        first = self.first_direction if self.first_direction < len(tangents) else 0
        return tangents[first : first + self.directions]

    def in_both_modes(self, name: str) -> bool:
        """True if the parameter of that name is differentiated in forward mode too."""
        return zlib.crc32(name.encode()) % self.forward_of == 0


# Of the bare parameters, two thirds are decided by 256 samples per pixel and nine tenths by 4096; what is left is the
# matter of the whole sweep. Most of the time goes into building kernels, those of forward mode cost the most.
QUICK = Effort(seconds=60.0, seeds=4, spp=256, directions=1, paths=2**16, confirming=6, forward_of=3, patience=4.0)


@dataclass
class Result:
    """Result for one parameter of one scene along one direction."""

    setting: str
    key: str
    tangent: str
    verdict: str
    reverse: float = float("nan")
    reverse_error: float = float("nan")
    forward: float = float("nan")
    differences: float = float("nan")
    differences_error: float = float("nan")
    scale: float = float("nan")
    spp: int = 0
    seconds: float = 0.0
    note: str = ""
    table: str = ""
    biased: bool = False
    place: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """For JSON, with six figures."""
        return {k: float(f"{v:.6g}") if isinstance(v, float) else v for k, v in asdict(self).items()}


@dataclass
class Runs:
    """Independent runs: derivative and difference of each seed. ``seconds``: what they take with kernels that are
    built.
    """

    reverse: Array
    differences: Array
    scale: float
    first_seed: int = 0
    seconds: float = 0.0

    @property
    def larger(self) -> float:
        """The larger of |finite difference| and scale, beside which errors are small. What hardly has an effect is
        compared with itself, lest everything agrees.
        """
        effect = max(abs(float(self.differences.mean())), abs(float(self.reverse.mean())))
        return (
            max(abs(float(self.differences.mean())), self.scale)
            if effect > RESOLVED * self.scale
            else max(WEAK * effect, RESOLVED * self.scale)
        )

    @staticmethod
    def error_of(values: Array) -> float:
        return float(values.std(ddof=1) / np.sqrt(len(values)))

    @property
    def worst_error(self) -> float:
        """The larger one of the two standard errors, relative."""
        worst = max(self.error_of(self.reverse), self.error_of(self.differences))
        return worst / self.larger if self.larger else 0.0

    @property
    def is_nothing(self) -> bool:
        """True if there is no effect, up to a small part of the scale."""
        error = self.error_of(self.differences)
        small = max(abs(float(self.reverse.mean())), error) <= RESOLVED * self.scale
        return small and abs(float(self.differences.mean())) <= 3 * error + ROUNDING * RESOLVED * self.scale

    @property
    def gap(self) -> float:
        return float(self.reverse.mean() - self.differences.mean())

    @property
    def contradicts(self) -> bool:
        """Seed by seed, since both are of the same paths."""
        error = self.error_of(self.reverse - self.differences)
        return abs(self.gap) > SIGMAS * error and abs(self.gap) > TOLERANCE * self.larger


def run(subject: Subject, tangent: Tangent, seeds: range, spp: int, step: float) -> Runs:
    """Derivatives and differences of some seeds."""
    direction = tangent.direction.double().reshape(-1).numpy()
    reverse, differences, scales, seconds = [], [], [], []
    for seed in seeds:
        started = time.process_time()
        reverse.append(float(subject.reverse(seed, spp) @ direction))
        difference, scale = subject.difference(tangent, seed, spp, step)
        differences.append(difference)
        scales.append(scale)
        seconds.append(time.process_time() - started)
    scale = SCALE * float(np.mean(scales))
    return Runs(np.array(reverse), np.array(differences), scale, seeds[0], len(seeds) * min(seconds))


def resolved_runs(subject: Subject, tangent: Tangent, effort: Effort) -> tuple[Runs, int, Tangent]:
    """More and more samples, and longer steps where it is the differences that are noisy, until errors are small or
    time is over. Returns the samples per pixel and the tangent with its step, too.
    """
    deadline = time.process_time() + effort.seconds
    spp, longest = effort.spp * max(1, FILM // subject.pixels), LONGER_STEPS * tangent.step
    while True:
        runs = run(subject, tangent, range(effort.seeds), spp, tangent.step)
        if not np.isfinite(runs.gap) or runs.worst_error < RESOLVED or runs.is_nothing:
            return runs, spp, tangent
        needed = 1.5 * (runs.worst_error / RESOLVED) ** 2
        noisy = runs.error_of(runs.differences) > 2 * runs.error_of(runs.reverse) and 2 * tangent.step <= longest
        if noisy:
            # Paths that differ between the two sides are as many as the step is long.
            needed /= 2
        factor = float(np.clip(needed, 1 if noisy else 1.5, 16))
        if needed * spp * subject.pixels > effort.patience * effort.paths:
            return runs, spp, tangent
        if spp * factor * subject.pixels > effort.paths or time.process_time() + runs.seconds * factor > deadline:
            return runs, spp, tangent
        spp = int(np.ceil(spp * factor / 16) * 16)
        tangent = replace(tangent, step=2 * tangent.step) if noisy else tangent


def confirmed_runs(subject: Subject, tangent: Tangent, spp: int, count: int) -> tuple[Runs, str]:
    """Once more with ``count`` fresh seeds, and with what the length of the step does taken away: shorter steps, until
    they change nothing, and what is left extrapolated to a step of zero.
    """
    seeds, step = range(100, 100 + count), tangent.step
    whole = run(subject, tangent, seeds, spp, step)
    for _ in range(SHORTER_STEPS):
        if not whole.contradicts:
            return whole, "" if step == tangent.step else f"step of {step:g}"
        half = run(subject, tangent, seeds, spp, step / 2)
        extrapolated = replace(whole, differences=(4 * half.differences - whole.differences) / 3)
        change = Runs(whole.differences, half.differences, whole.scale)
        if not extrapolated.contradicts or not change.contradicts:
            return extrapolated, f"differences extrapolated from steps of {step:g} and {step / 2:g}"
        whole, step = half, step / 2
    return whole, f"step of {step:g}, shorter ones may differ"


def judge(subject: Subject, tangent: Tangent, effort: Effort, both_modes: bool = True) -> Result:
    """Compare the derivative of a parameter along a direction with finite differences. ``both_modes``: in forward mode
    too.
    """
    started = time.process_time()
    runs, spp, tangent = resolved_runs(subject, tangent, effort)
    note = ""
    if runs.contradicts:
        runs, note = confirmed_runs(subject, tangent, spp, effort.confirming)
    reverse = forward = float(runs.reverse[0])
    if both_modes:
        try:
            forward = subject.forward(tangent.direction, runs.first_seed, spp)
        except GradientError:
            both_modes, note = False, f"{note}; forward mode is refused".lstrip("; ")
    return Result(
        setting="",
        key=subject.key,
        tangent=tangent.name,
        verdict=verdict(runs, forward, reverse),
        reverse=float(runs.reverse.mean()),
        reverse_error=runs.error_of(runs.reverse),
        forward=forward - reverse + float(runs.reverse.mean()) if both_modes else float("nan"),
        differences=float(runs.differences.mean()),
        differences_error=runs.error_of(runs.differences),
        scale=runs.scale,
        spp=spp,
        seconds=time.process_time() - started,
        note=note,
    )


def verdict(runs: Runs, forward: float, reverse: float) -> str:
    """agree, contradict, modes differ, not finite, unresolved, or no effect."""
    if not np.isfinite([runs.gap, forward, reverse]).all():
        return "not finite"
    if runs.contradicts:
        return "contradict"
    if abs(forward - reverse) > ROUNDING * max(runs.larger, abs(reverse)):
        return "modes differ"
    if runs.is_nothing:
        return "no effect"
    return "agree" if runs.worst_error < RESOLVED else "unresolved"
