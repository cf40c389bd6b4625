"""The decisions of a plan that need no render: variant, integrator, film, depth by albedo, each with its reason."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torchtransient.checks import is_one_of, several, shown
from torchtransient.errors import ArgumentError, SceneError
from torchtransient.rendering.films.choice import FilmChoice, PlannedFilm
from torchtransient.rendering.films.choices import all_films
from torchtransient.rendering.inventory import Finding, SceneInventory
from torchtransient.rendering.nodes import is_transient_integrator
from torchtransient.rendering.translation import NO_LIMIT

# What every film can show beside its own measurement.
_OF_ANY_FILM = ("steady", "stokes", "bands")
SURFACES, VOLUMES = "transient_path", "transient_prbvolpath"
_ALIASES = {"transient_volpath": VOLUMES}
# They add pictures to what a nested integrator traces.
_WITH_PICTURES = ("aov", "moment")


@dataclass(frozen=True)
class Choice:
    """A decision with the line that explains it."""

    value: str
    reason: str


def some(findings: Sequence[Finding], most: int = 3) -> str:
    """The first few findings as text."""
    named = "; ".join(str(finding) for finding in findings[:most])
    return named if len(findings) <= most else f"{named}; and {len(findings) - most} more"


def known_outputs() -> tuple[str, ...]:
    """What a plan can be asked for."""
    return (*(kind.output for kind in all_films()), *_OF_ANY_FILM)


def checked_outputs(outputs: Sequence[str] | str) -> tuple[str, ...]:
    """The outputs as a tuple. Raises ``ArgumentError`` for unknown ones, and for two that need different films."""
    asked = (outputs,) if isinstance(outputs, str) else tuple(several("tt.plan: outputs", outputs, "names"))
    of_films, known = tuple(kind.output for kind in all_films()), known_outputs()
    if not asked or not all(is_one_of(name, known) for name in asked):
        raise ArgumentError(f"tt.plan: outputs are some of {', '.join(known)}; got {shown(list(asked))}.")
    films = [name for name in asked if name in of_films]
    if len(set(films)) > 1:
        raise ArgumentError(
            f"tt.plan: a film measures one of {', '.join(of_films)}, got {' and '.join(films)}; make a plan for each."
        )
    return asked


def film_settings(
    film: PlannedFilm, given: FilmChoice | None, plugin: str | None, outputs: Sequence[str]
) -> FilmChoice | None:
    """The settings of the plan's film: those ``given`` by the call; None to keep those of the scene's film, which is a
    ``plugin``, or to find them. ``outputs``: what is asked for, from which ``film`` follows. Raises ``ArgumentError``.
    """
    if given is not None and type(given) is not film.kind:
        of_any_film = (name for name in outputs if name in _OF_ANY_FILM)
        raise ArgumentError(
            f"tt.plan: outputs={tuple(outputs)} call for a {film.name} film, on which {given.argument} have no effect; "
            f"ask for outputs={(given.output, *of_any_film)}."
        )
    if given is None and plugin != film.kind.plugin and film.kind.needed():
        raise SceneError(film.kind.needed())
    return given


def choose_variant(
    inventory: SceneInventory, outputs: Sequence[str], device: str, strict: bool
) -> tuple[Choice, list[str]]:
    """The cheapest variant in which nothing of the scene that was asked for is lost, and what is approximated."""
    spectral = bool(inventory.measured or inventory.bands or "bands" in outputs)
    if "bands" in outputs and not inventory.bands:
        raise SceneError(
            "tt.plan: bands are asked for, and no film has response curves. Give the film spectra as children, such as "
            "'red': {'type': 'spectrum', 'value': [(600, 0.0), (650, 1.0), (700, 0.0)]}."
        )
    colour, colour_why = _colour(inventory, spectral)
    polarized, polarization_why, notes = _polarization(inventory, outputs, strict)
    if polarized and colour == "rgb":
        colour, colour_why = "spectral", f"{colour_why}, and Mitsuba has no polarized RGB variant"
    name = f"{device}_ad_{colour}" + ("_polarized" if polarized else "")
    return Choice(name, f"variant: {name}; {colour_why}; {polarization_why}"), notes


def _colour(inventory: SceneInventory, spectral: bool) -> tuple[str, str]:
    if inventory.bands:
        return "spectral", f"wavelengths, since the film has bands: {some(inventory.bands)}"
    if spectral:
        return "spectral", f"wavelengths, which three numbers cannot stand in for: {some(inventory.measured)}"
    if inventory.colours:
        return "rgb", f"colour: {some(inventory.colours)}"
    return "mono", "every spectrum is grey, so that one channel carries all of it"


def _polarization(inventory: SceneInventory, outputs: Sequence[str], strict: bool) -> tuple[bool, str, list[str]]:
    if "stokes" in outputs:
        return True, "polarized, since Stokes vectors are asked for", []
    if inventory.integrator == "stokes":
        return True, "polarized, since the scene's own integrator is stokes", []
    if inventory.elements:
        return True, f"polarized, since it changes the intensity: {some(inventory.elements)}", []
    if not inventory.interfaces:
        return False, "unpolarized, since nothing polarizes light", []
    if not inventory.interfaces_in_a_row:
        return False, f"unpolarized, which is exact: a single flat surface polarizes, {some(inventory.interfaces)}", []
    if strict:
        return True, f"polarized (strict), since light can meet several of these: {some(inventory.interfaces)}", []
    note = (
        "approximation: the light between polarizing surfaces is taken as unpolarized, as unpolarized renderers do; "
        f"strict=True carries it. Found: {some(inventory.interfaces)}"
    )
    return False, "unpolarized, see the approximation", [note]


def choose_integrator(inventory: SceneInventory) -> tuple[Choice, list[str]]:
    """Surface or volume; a transient integrator of the scene that is neither is kept."""
    notes = [
        f"not used: {some(inventory.declared_only)}, declared and referred to by nothing"
    ] if inventory.declared_only else []  # fmt: skip
    own = inventory.integrator or ""
    if own in _WITH_PICTURES:
        notes.append(
            f"not rendered: the pictures that {own!r} adds to those of its nested integrator; "
            "torchtransient.rendering.labels has depth, normals, shapes and albedos"
        )
    if is_transient_integrator(own) and _ALIASES.get(own, own) not in (SURFACES, VOLUMES):
        return Choice(own, f"integrator: {own}, the scene's own"), notes
    if inventory.media:
        return Choice(VOLUMES, f"integrator: {VOLUMES}, since the scene has {some(inventory.media)}"), notes
    return Choice(SURFACES, f"integrator: {SURFACES}, since no medium can be reached from the scene"), notes


def depth_in_words(depth: int) -> str:
    """A ``max_depth`` in the words of reasons."""
    return "no limit" if depth == NO_LIMIT else str(depth)


def depth_by_albedo(inventory: SceneInventory, tail: float) -> tuple[int | None, str]:
    """The depth at which at most ``tail`` of the emitted power is still on its way, if the albedos bound it."""
    if inventory.albedo >= 1:
        return None, (
            f"max_depth: {depth_in_words(inventory.max_depth)}, kept; not bounded, since {inventory.brightest} may "
            "reflect everything and no pilot run was asked for"
        )
    bounces = 1 if inventory.albedo == 0 else max(1, math.ceil(math.log(tail) / math.log(inventory.albedo)))
    depth = bounces + 1
    left = inventory.albedo**bounces
    return depth, (
        f"max_depth: {depth}; no albedo exceeds {inventory.albedo:.4g} ({inventory.brightest}), so that after "
        f"{bounces} bounces at most {left:.2g} of the emitted power is left"
    )
