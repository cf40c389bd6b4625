"""Kinds of plugins, declared where a change of the variant does not reach.

Plugin modules are executed again for each variant, so that their classes are others afterwards. The markers here stay
the same: ``isinstance(film, FilmInterface)`` holds for the films of every variant. A plugin's base cannot inherit from
them (Mitsuba's classes take one base), so it signs up with ``FilmInterface.register``.
"""

from __future__ import annotations

import abc
import enum
from typing import TYPE_CHECKING, Any, TypeGuard

# The jobs of an integrator: a render, its derivative in reverse mode, and along one tangent.
RENDER, BACKWARD, FORWARD = JOBS = ("render", "backward", "forward")


class FilmInterface(abc.ABC):  # noqa: B024  # a marker
    """Films that keep an array behind every pixel beside the steady image.

    ``torchtransient.plugins.films.base.TimeResolvedFilm`` documents the members.
    """

    if TYPE_CHECKING:  # types change with the variant

        def __getattr__(self, name: str) -> Any: ...


class IntegratorInterface(abc.ABC):
    """Integrators that write to such films.

    ``torchtransient.plugins.integrators.base.TransientIntegrator`` documents the members.
    """

    @abc.abstractmethod
    def strategies(self, contents: Any) -> tuple[Any, Any, list[Any]]:
        """Return (segment, scattering, list of connections) for a scene with these contents, anew for every job."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...


def is_time_resolved(film: object) -> TypeGuard[FilmInterface]:
    """Return True for a film that transient integrators can write to, of any variant.

    Args:
        film: any object.
    """
    return isinstance(film, FilmInterface)


def missing_members(plugin: type) -> list[str]:
    """Return the abstract members of its bases and its kind that a plugin class does not define.

    Args:
        plugin: class of a film or an integrator.
    """
    abstract = {name for name in dir(plugin) if getattr(getattr(plugin, name), "__isabstractmethod__", False)}
    kinds: tuple[type, ...] = (FilmInterface, IntegratorInterface)
    declared = {name for kind in kinds if issubclass(plugin, kind) for name in getattr(kind, "__abstractmethods__", ())}
    return sorted(abstract | {name for name in declared if not hasattr(plugin, name)})


class CaptureType(enum.Enum):
    """Laser positions of a scanned point: one for all, itself, each of a grid, or one of its own."""

    SINGLE = 1
    CONFOCAL = 2
    EXHAUSTIVE = 3
    PAIRS = 4
