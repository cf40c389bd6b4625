"""Errors and warnings of the library. A message says in one line what was expected, what came and what to do."""

from __future__ import annotations

import sys
from typing import Any

# Packages whose lines a warning passes over on its way to the user's.
_INSIDE = ("torchtransient", "torch", "contextlib")


class _InOneLine(Exception):  # noqa: N818 - no error of its own
    """Base whose messages are one line, also where they show an array of several rows."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*(" ".join(a.split()) if isinstance(a, str) and "\n" in a else a for a in args), **kwargs)


class TorchTransientError(_InOneLine):
    """Base of every error that torchtransient raises on purpose."""


class ShapeError(TorchTransientError, ValueError):
    """A tensor has the wrong number of dimensions or the wrong size along one."""


class UnitError(TorchTransientError, ValueError):
    """A quantity lies outside the range that its unit allows (negative bin width, NaN length, ...)."""


class SceneError(TorchTransientError, ValueError):
    """A scene description, plugin parameter or parameter key cannot be used."""


class PhysicsError(SceneError):
    """A scene or value is unphysical, and an error was asked for (``physics="error"``). See ``PhysicsWarning``."""


class UnknownKeyError(SceneError, KeyError):
    """A table or a renderer has no entry under a key."""

    __str__ = Exception.__str__  # that of KeyError would put the message in quotation marks


class ArgumentError(TorchTransientError, ValueError):
    """An option of a function or class has an unknown value or type, or excludes another one."""


class MissingPackageError(TorchTransientError, ImportError):
    """A function needs a package that is not installed; the message says how to install it."""


class StorageError(TorchTransientError, ValueError):
    """A file cannot be read or written, or a result would not fit into memory."""


class VariantError(TorchTransientError, RuntimeError):
    """The active Mitsuba variant cannot do what was asked, or no usable LLVM was found."""


class DeviceError(TorchTransientError, RuntimeError):
    """Tensors live on a device that the active variant cannot reach."""


class GradientError(TorchTransientError, RuntimeError):
    """A derivative was asked for that does not exist or is not supported."""


class PluginRegistrationError(TorchTransientError, RuntimeError):
    """A Mitsuba plugin of this library could not be registered for the active variant."""


class TorchTransientWarning(_InOneLine, UserWarning):
    """Base of every warning that torchtransient gives on purpose."""


class PhysicsWarning(TorchTransientWarning):
    """A scene, a value or a render is computed as asked for, although no physical system is like that.

    More light scattered than arrives, a transform without an inverse, a window that misses the light, paths that end
    early.
    """


class GradientWarning(TorchTransientWarning):
    """A derivative is computed and lacks a part: the light that moving edges hide and uncover, if edges are not
    followed or the boundary term was switched off. Or it is zero, of a velocity on a film that measures no rates.
    """


class VariantWarning(TorchTransientWarning, RuntimeWarning):
    """A library that is loaded already does not work with the variants of this library."""


class VersionWarning(TorchTransientWarning):
    """Mitsuba or Dr.Jit has a version that this library was never tested with."""


def level_of_user() -> int:
    """Return the ``stacklevel`` of the first line outside of this library and torch, for a warning of the caller."""
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in _INSIDE:
        level, frame = level + 1, frame.f_back
    return level
