"""What can be rendered and cannot be: more light scattered than arrives, numbers out of their range, transforms without
an inverse, windows that miss the light, depths that had to be bounded.

Nothing of it stops a computation by itself: an optimiser steps over the edge of [0, 1] and comes back, and a window may
be meant to be short. So it is said once, and where it would be a mistake, it can be made an error.
"""

from __future__ import annotations

import contextlib
import math
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchtransient.checks import is_one_of, shown
from torchtransient.errors import ArgumentError, GradientError, GradientWarning, PhysicsError, PhysicsWarning
from torchtransient.plugins.physical_ranges import SHARE, PhysicalRange

MODES = ("warn", "error", "ignore")
# Light outside of the window, as a share of all light, from which on it is said.
MISSED = 0.05
# Findings about a description that are said one by one.
_SAID_OF_A_SCENE = 4
# What single precision makes of a matrix that has an inverse.
_SINGULAR = 1e-7


class PhysicsWatch:
    """Says each finding about one renderer once. ``mode``: "warn" gives ``PhysicsWarning``, "error" raises
    ``PhysicsError``, "ignore" looks at nothing.

    ``told``: what was said before, of the same scene: ``tt.render`` in a loop makes a renderer each time.
    ``window_name``: what tells its window from others, empty where none is looked at. ``ranges``: those that the
    renderer's keys have; ``transforms``: which are transforms; ``directions``: which are those of a sun, with the axis
    of its sky. ``installed``: looks at a built scene that holds the values of a call, for the sensor of a number, and
    returns what it finds by what it is about; None looks at nothing.
    """

    def __init__(self, mode: str, told: set[str]):
        if not is_one_of(mode, MODES):
            raise ArgumentError(f"physics: expected one of {', '.join(map(repr, MODES))}, got {shown(mode)}.")
        self.mode = mode
        self.window_name = ""
        self.ranges: dict[str, PhysicalRange] = {}
        self.transforms: frozenset[str] = frozenset()
        self.directions: dict[str, np.ndarray] = {}
        self.installed: Callable[[Any, int], Mapping[str, str]] | None = None
        self._told = told

    @property
    def looks(self) -> bool:
        """Whether anything is looked at."""
        return self.mode != "ignore"

    def tell(self, about: str, message: str, *, is_error: bool = True) -> None:
        """Say a finding, in the way of the mode; those that are about the same once. ``is_error``: False for one that
        is a warning in the mode "error", too.
        """
        if self.mode == "error" and is_error:
            raise PhysicsError(f"{message} With physics='warn' it is computed all the same.")
        if about not in self._told:
            self._told.add(about)
            warnings.warn(message, PhysicsWarning, stacklevel=level_of_user())

    def gradient(self, message: str, *, is_error: bool = True) -> None:
        """Warn once of a derivative that lacks a part; the mode "error" makes it a ``GradientError``, "ignore" does not
        silence it.
        """
        if self.mode == "error" and is_error:
            raise GradientError(f"{message} With physics='warn' it is computed all the same.")
        if message not in self._told:
            self._told.add(message)
            warnings.warn(message, GradientWarning, stacklevel=level_of_user())

    def scene(self, findings: Mapping[str, str]) -> None:
        """Say what is found in the description itself, by key: the first ones, where there are many."""
        for number, (key, message) in enumerate(findings.items()):
            if number < _SAID_OF_A_SCENE:
                more = len(findings) - _SAID_OF_A_SCENE if number == _SAID_OF_A_SCENE - 1 else 0
                self.tell(key, message + (f" So {'is' if more == 1 else 'are'} {more} more." if more > 0 else ""))

    def value(self, key: str, value: torch.Tensor, low: float, high: float) -> None:
        """A value of a call, with its smallest and largest number."""
        limits = self.ranges.get(key)
        if limits is not None:
            if limits.above(high):
                self.tell(key, outside_message(key, limits, low, high))
            elif limits.below(low):
                self.tell(f"{key} too small", outside_message(key, limits, low, high))
        elif key in self.directions:
            given = value.detach().cpu().double().numpy()
            if (given == 0).all(-1).any():
                self.tell(key, f"{key!r} is a direction and has no length. Give it one.")
            elif value.requires_grad and (np.cross(given, self.directions[key]) == 0).all(-1).any():
                self.tell(
                    f"{key} at the pole",
                    f"{key!r} points along the axis of its sky, where Mitsuba's derivative by it is NaN. Tilt it by a "
                    "thousandth.",
                )
        elif key in self.transforms and (self.mode == "error" or key not in self._told):
            matrices = value.detach().cpu().numpy().reshape(-1, *value.shape[-2:])
            if any(is_singular(matrix) for matrix in matrices):
                self.tell(key, singular_message(key))

    def placed(self, scene: Any, sensor: int) -> None:
        """A built scene that holds the values of a call, before it is rendered."""
        if self.looks and self.installed is not None:
            for about, message in self.installed(scene, sensor).items():
                self.tell(about, message)

    def window(self, total: float, before: float, after: float) -> None:
        """Light of a render, all and what its window missed."""
        if not self.window_name or before + after <= 0 or (self.mode != "error" and self.window_name in self._told):
            return
        if total > 0 and before + after > MISSED * total:
            self.tell(
                self.window_name,
                f"the window misses {(before + after) / total:.1%} of the light: {before / total:.1%} arrives before "
                f"it, {after / total:.1%} after it. tt.plan(scene) finds a window; a start_opl that is earlier, more "
                "bins or wider ones hold more. RenderOutput.stats has the energies.",
            )


def scene_findings(
    ranges: Iterable[tuple[str, PhysicalRange, float, float]],
    transforms: Mapping[str, np.ndarray],
    dark: Iterable[str] = (),
) -> dict[str, str]:
    """What is unphysical in a description, by key. ``ranges``: (key, its range, smallest, largest). ``dark``: names of
    the lights that no path meets.
    """
    found = {name: dark_message(name) for name in dark}
    for key, limits, low, high in ranges:
        if limits.below(low) or limits.above(high):
            found[key] = outside_message(key, limits, low, high)
    for key, matrix in transforms.items():
        if is_singular(matrix):
            found[key] = singular_message(key)
    return found


def dark_message(name: str) -> str:
    """The message for a light that paths from a sensor never meet."""
    return (
        f"{name!r} is black here: a directionalarea shines in one direction alone, which no path from a sensor ever "
        "meets. Describe it as an 'angulararea' with a small cutoff_angle, or as a 'directional' light."
    )


def outside_message(key: str, limits: PhysicalRange, low: float, high: float) -> str:
    """The message for a number outside of its range."""
    if limits == SHARE:
        number = f"{high:.6g}, more than all" if limits.above(high) else f"{low:.6g}, less than nothing"
        message = (
            f"{key!r} is a share of the light and reaches {number}: no surface or medium scatters so. Keep it in "
            "[0, 1], by a sigmoid or, after each step, by torch.no_grad() and x.clamp_(0, 1)."
        )
        if key.rsplit(".", 1)[-1].startswith(("vertex_", "face_")) and 1 < high <= 255:
            message += " Bytes of a PLY file (uchar) are 0 to 255: give the 'mesh_attribute' a scale of 1/255."
        return message
    least = f"{'more than' if limits.is_open else 'at least'} {limits.low:g}"
    most = f" and {'less than' if limits.is_open else 'at most'} {limits.high:g}" if math.isfinite(limits.high) else ""
    return (
        f"{key!r} is {limits.meaning} and reaches {high if limits.above(high) else low:.6g}: expected {least}{most}. "
        "Keep it there, by torch.no_grad() and x.clamp_() after each step or by a function that stays inside."
    )


def singular_message(key: str) -> str:
    """The message for a transform without an inverse."""
    return (
        f"{key!r} has no inverse: it flattens space, and what it is applied to has no normals and is not hit. Scale by "
        "numbers other than 0, flat shapes too."
    )


def is_singular(matrix: np.ndarray) -> bool:
    """Whether a transform (4, 4) or (3, 3) flattens space, up to single precision; not for numbers that are not finite,
    of which others speak.
    """
    linear = np.asarray(matrix, dtype=np.float64)
    linear = linear[:-1, :-1]
    if not np.isfinite(linear).all():
        return False
    sizes = np.linalg.svd(linear, compute_uv=False)
    return bool(sizes[-1] <= _SINGULAR * sizes[0])


def smallest_and_largest(value: torch.Tensor) -> tuple[float, float]:
    """Of a tensor; NaN for both where it holds one, 0 for an empty one. One wait for the device."""
    if value.numel() == 0:
        return 0.0, 0.0
    low, high = torch.stack(torch.aminmax(value.detach())).tolist()
    return low, high


def are_finite(low: float, high: float) -> bool:
    """Whether numbers between these are all finite, as :func:`smallest_and_largest` tells."""
    return math.isfinite(low) and math.isfinite(high)


_INSIDE = (str(Path(__file__).parents[1]), str(Path(torch.__file__).parent), contextlib.__file__)


def level_of_user() -> int:
    """How far above the line that warns the first one outside of this library and torch is."""
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_INSIDE):
        level, frame = level + 1, frame.f_back
    return level
