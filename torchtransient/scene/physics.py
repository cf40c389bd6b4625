"""Warnings of unphysical scenes and values, which can be rendered all the same.

More light scattered than arrives, numbers out of their range, transforms without an inverse, windows that miss the
light, depths that had to be bounded. None stops a computation: an optimiser steps over the edge of [0, 1] and comes
back, and a window may be short on purpose. Each is a warning, given once, or an error where that is asked for.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import torch

from torchtransient.checks import is_one_of, shown
from torchtransient.errors import (
    ArgumentError,
    GradientError,
    GradientWarning,
    PhysicsError,
    PhysicsWarning,
    level_of_user,
)
from torchtransient.plugins.parameters import SHARE, PhysicalRange

MODES = ("warn", "error", "ignore")
# Largest share of the light outside of the window without a warning.
MISSED = 0.05
# Findings about a description that have a warning of their own.
_MOST_WARNINGS = 4
# Ratio of singular values below which single precision has no inverse.
_SINGULAR = 1e-7


class PhysicsWatch:
    """Checks of the physics of one renderer, each with one warning.

    Attributes:
        mode: "warn" gives ``PhysicsWarning``, "error" raises ``PhysicsError``, "ignore" checks nothing.
        window_name: identity of the renderer's time window, empty for none to be checked.
        ranges: physical ranges of the renderer's keys.
        transforms: keys of transforms.
        directions: keys of directions of a sun, with the axis of its sky.
        installed: function of a built scene that holds the values of a call, and the index of a sensor, which returns
            messages by subject; None to check nothing.
    """

    def __init__(self, mode: str, warned: set[str]):
        if not is_one_of(mode, MODES):
            raise ArgumentError(f"physics: expected one of {', '.join(map(repr, MODES))}, got {shown(mode)}.")
        self.mode = mode
        self.window_name = ""
        self.ranges: dict[str, PhysicalRange] = {}
        self.transforms: frozenset[str] = frozenset()
        self.directions: dict[str, np.ndarray] = {}
        self.installed: Callable[[Any, int], Mapping[str, str]] | None = None
        # Shared by the renderers of a scene: ``tt.render`` in a loop makes one each time.
        self._warned = warned

    @property
    def enabled(self) -> bool:
        """The mode is not "ignore"."""
        return self.mode != "ignore"

    def warn(self, about: str, message: str, *, is_error: bool = True) -> None:
        """Warn once of a subject, or raise.

        Args:
            about: the subject, of which the first message is given only.
            message: text of the warning or error.
            is_error: False warns in the mode "error" too.

        Raises:
            PhysicsError: in the mode "error".
        """
        if self.mode == "error" and is_error:
            raise PhysicsError(f"{message} With physics='warn' it is computed all the same.")
        if about not in self._warned:
            self._warned.add(about)
            warnings.warn(message, PhysicsWarning, stacklevel=level_of_user())

    def warn_of_gradient(self, message: str, *, is_error: bool = True) -> None:
        """Warn once of a derivative that lacks a part, in the mode "ignore" too.

        Args:
            message: text of the warning or error.
            is_error: False warns in the mode "error" too.

        Raises:
            GradientError: in the mode "error".
        """
        if self.mode == "error" and is_error:
            raise GradientError(f"{message} With physics='warn' it is computed all the same.")
        if message not in self._warned:
            self._warned.add(message)
            warnings.warn(message, GradientWarning, stacklevel=level_of_user())

    def check_description(self, findings: Mapping[str, str]) -> None:
        """Warn of unphysical values of the description, four at most; ``findings``: messages by key."""
        for number, (key, message) in enumerate(findings.items()):
            if number < _MOST_WARNINGS:
                more = len(findings) - _MOST_WARNINGS if number == _MOST_WARNINGS - 1 else 0
                self.warn(key, message + (f" {more} more of such values." if more > 0 else ""))

    def check_value(self, key: str, value: torch.Tensor, low: float, high: float) -> None:
        """Check a value of a call against its physical range.

        Args:
            key: key of the parameter.
            value: the value, with or without a batch.
            low, high: smallest and largest number of the value.
        """
        limits = self.ranges.get(key)
        if limits is not None:
            if limits.above(high):
                self.warn(key, outside_message(key, limits, low, high))
            elif limits.below(low):
                self.warn(f"{key} too small", outside_message(key, limits, low, high))
        elif key in self.directions:
            given = value.detach().cpu().double().numpy()
            if (given == 0).all(-1).any():
                self.warn(key, f"{key!r} is a direction and has no length. Give it one.")
            elif value.requires_grad and (np.cross(given, self.directions[key]) == 0).all(-1).any():
                self.warn(
                    f"{key} at the pole",
                    f"{key!r} points along the axis of its sky, where Mitsuba's derivative by it is NaN. Tilt it by a "
                    "thousandth.",
                )
        elif key in self.transforms and (self.mode == "error" or key not in self._warned):
            matrices = value.detach().cpu().numpy().reshape(-1, *value.shape[-2:])
            if any(is_singular(matrix) for matrix in matrices):
                self.warn(key, singular_message(key))

    def check_installed(self, scene: Any, sensor: int) -> None:
        """Check a built scene that holds the values of a call; ``sensor``: index of the one to be rendered."""
        if self.enabled and self.installed is not None:
            for about, message in self.installed(scene, sensor).items():
                self.warn(about, message)

    def check_window(self, total: float, before: float, after: float, rates: bool = False) -> None:
        """Check the share of the light that a render's time window misses.

        Args:
            total: all light, in units of the steady image.
            before, after: light before and after the window, in the same units.
            rates: light outside of the axis of rates counts as after the window.
        """
        if not self.window_name or before + after <= 0 or (self.mode != "error" and self.window_name in self._warned):
            return
        if total > 0 and before + after > MISSED * total:
            self.warn(
                self.window_name,
                f"the window misses {(before + after) / total:.1%} of the light: {before / total:.1%} arrives before "
                f"it, {after / total:.1%} after it{' or at other rates than those of the rate axis' if rates else ''}. "
                f"tt.plan(scene) finds a window; a start_opl that is earlier, more "
                "bins or wider ones hold more. RenderOutput.stats has the energies.",
            )


def scene_findings(
    ranges: Iterable[tuple[str, PhysicalRange, float, float]],
    transforms: Mapping[str, np.ndarray],
    dark: Iterable[str] = (),
) -> dict[str, str]:
    """Return messages about unphysical values of a description, by key.

    Args:
        ranges: (key, physical range, smallest value, largest value).
        transforms: matrices (4, 4) by key.
        dark: names of lights that no path meets.
    """
    found = {name: _dark_message(name) for name in dark}
    for key, limits, low, high in ranges:
        if limits.below(low) or limits.above(high):
            found[key] = outside_message(key, limits, low, high)
    for key, matrix in transforms.items():
        if is_singular(matrix):
            found[key] = singular_message(key)
    return found


def _dark_message(name: str) -> str:
    """Return the message for a light that paths from a sensor never meet."""
    return (
        f"{name!r} is black here: a directionalarea shines in one direction alone, which no path from a sensor ever "
        "meets. Describe it as an 'angulararea' with a small cutoff_angle, or as a 'directional' light."
    )


def outside_message(key: str, limits: PhysicalRange, low: float, high: float) -> str:
    """Return the message for a value outside of its physical range.

    Args:
        key: key of the parameter.
        limits: physical range of the parameter.
        low, high: smallest and largest number of the value.
    """
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
    """Return the message for a transform without an inverse.

    Args:
        key: key of the transform.
    """
    return (
        f"{key!r} has no inverse: it flattens space, and what it is applied to has no normals and is not hit. Scale by "
        "numbers other than 0, flat shapes too."
    )


def is_singular(matrix: np.ndarray) -> bool:
    """Return whether a transform (4, 4) or (3, 3) flattens space, up to single precision.

    False for numbers that are not finite, which other checks refuse.

    Args:
        matrix: matrix (4, 4) or (3, 3).
    """
    linear = np.asarray(matrix, dtype=np.float64)
    linear = linear[:-1, :-1]
    if not np.isfinite(linear).all():
        return False
    sizes = np.linalg.svd(linear, compute_uv=False)
    return bool(sizes[-1] <= _SINGULAR * sizes[0])


def smallest_and_largest(value: torch.Tensor) -> tuple[float, float]:
    """Return both numbers of a real tensor, NaN if it holds one, 0 for an empty one. Waits once for the device.

    Args:
        value: tensor of any shape.
    """
    if value.numel() == 0:
        return 0.0, 0.0
    for dim, stride in enumerate(value.stride()):  # entries that `expand` has repeated are read once
        if stride == 0 and value.shape[dim] > 1:
            value = value.narrow(dim, 0, 1)
    low, high = torch.stack(torch.aminmax(value.detach())).tolist()
    return low, high


def are_finite(low: float, high: float) -> bool:
    """Return whether all numbers of a tensor with this smallest and largest one are finite.

    Args:
        low, high: result of :func:`smallest_and_largest`.
    """
    return math.isfinite(low) and math.isfinite(high)


def all_finite(value: torch.Tensor) -> bool:
    """Return whether all numbers of a real tensor are finite.

    Args:
        value: tensor of any shape.
    """
    return are_finite(*smallest_and_largest(value))
