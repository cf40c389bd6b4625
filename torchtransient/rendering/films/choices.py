"""The list of films, and which of them a call, a film, an output or a file is about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torchtransient.errors import ArgumentError, SceneError
from torchtransient.interfaces import is_time_resolved
from torchtransient.rendering.films.choice import FilmChoice, PlannedFilm
from torchtransient.rendering.films.gates import Gates
from torchtransient.rendering.films.histogram import Histogram
from torchtransient.rendering.films.phasors import Phasors

# A new film is added here. The first one is what a plan takes when no film is asked for by name.
CHOICES: tuple[type[FilmChoice], ...] = (Histogram, Phasors, Gates)


def all_films() -> tuple[type[FilmChoice], ...]:
    """The class of every film, in the order of :data:`CHOICES`."""
    return CHOICES


def chosen(arguments: Mapping[str, Any]) -> FilmChoice | None:
    """The film that keyword arguments ask for (``time_axis``, ``frequencies``, ``gates``: at most one that is not
    None), None without one. Raises ``ArgumentError``.
    """
    given = [(kind, arguments.get(kind.argument)) for kind in all_films()]
    given = [(kind, value) for kind, value in given if value is not None]
    if len(given) > 1:
        names, films = ", ".join(kind.argument for kind in all_films()), [f"a {kind.noun}" for kind in all_films()]
        raise ArgumentError(f"{names}: a film is {', '.join(films[:-1])} or {films[-1]}; give one of them.")
    return given[0][0].from_argument(given[0][1]) if given else None


def from_options(options: Mapping[str, Any]) -> FilmChoice | None:
    """The film that the options of a command line ask for, None without one. Raises typed errors."""
    found = [choice for choice in (kind.from_options(options) for kind in all_films()) if choice is not None]
    if len(found) > 1:
        flags = [f"--{choice.options[0].name.replace('_', '-')}" for choice in found]
        raise ArgumentError(f"{' and '.join(flags)} ask for different films: leave out one of them.")
    return found[0] if found else None


def of_film(film: Any) -> FilmChoice:
    """What a film plugin measures. Raises ``SceneError`` for films that are not time-resolved, or not listed."""
    if not is_time_resolved(film):
        raise SceneError(
            f"the sensor's film has no time axis; use one of {plugins_in_words()}, or give "
            f"{' or '.join(kind.example for kind in all_films())}."
        )
    for kind in all_films():
        if kind.measures == film.measures:
            return kind.from_film(film)
    known = ", ".join(kind.measures for kind in all_films())
    raise SceneError(f"the film {film.plugin!r} measures {film.measures!r}, expected one of {known}; see FilmChoice.")


def of_output(output: Any) -> FilmChoice | None:
    """The film of a ``RenderOutput`` or a ``Result``, None when it holds nothing but a steady image."""
    return next((found for kind in all_films() if (found := kind.from_output(output)) is not None), None)


def of_entries(values: Mapping[str, Any]) -> FilmChoice:
    """The film of a result file's arrays and numbers. Raises ``KeyError`` for a file of none of them."""
    for kind in all_films():
        found = kind.from_entries(values)
        if found is not None:
            return found
    raise KeyError(" or ".join(kind.measures for kind in all_films()))


def of_plugin(plugin: str) -> type[FilmChoice] | None:
    """The class for a film plugin, None for the plugins of others."""
    return next((kind for kind in all_films() if kind.plugin == plugin), None)


def planned(outputs: Sequence[str]) -> PlannedFilm:
    """The film of a plan for some outputs."""
    return next((kind for kind in all_films() if kind.output in outputs), all_films()[0]).planned(outputs)


def plugins_in_words(kinds: Sequence[type[FilmChoice]] | None = None) -> str:
    """Names of the film plugins, for messages."""
    return ", ".join(kind.plugin for kind in (all_films() if kinds is None else kinds))
