"""Films on the command line: options that ask for one, and what is said and shown of its measurements."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import click

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.errors import ArgumentError, UnitError
from torchtransient.gates import gates_from_text
from torchtransient.rendering.films import FilmLayout, Gates, Histogram, Phasors

Command = TypeVar("Command", bound=Callable[..., Any])

# Options of each film, the first one its name in messages.
OPTIONS: dict[type[FilmLayout], tuple[str, ...]] = {
    Histogram: ("--start-opl", "--bin-width-opl", "--num-bins"),
    Phasors: ("--frequencies",),
    Gates: ("--gates",),
}


def film_options(command: Command) -> Command:
    """Add the options of all films to a command."""
    options = (
        click.option("--start-opl", type=float, help="Start of the time axis, metres of optical path."),
        click.option("--bin-width-opl", type=float, help="Width of a bin, metres of optical path."),
        click.option("--num-bins", type=int, help="Number of bins."),
        click.option(
            "--frequencies", metavar="NU,NU,...", help="Phasors at these cycles per metre instead of a transient."
        ),
        click.option(
            "--gates", metavar="GATE;GATE;...", help="Gates as scene files write them, instead of a transient."
        ),
    )
    for option in reversed(options):
        command = option(command)
    return command


def film_of_options(options: Mapping[str, Any]) -> FilmLayout | None:
    """Return the film that the options of a command ask for, None without one.

    Raises:
        ArgumentError: for options of two films, and for a part of an axis.
        UnitError: for frequencies that are no numbers.
    """
    read = (_histogram, _phasors, _gates)
    found = [film for film in (each(options) for each in read) if film is not None]
    if len(found) > 1:
        flags = " and ".join(OPTIONS[type(film)][0] for film in found)
        raise ArgumentError(f"{flags} ask for different films: leave out one of them.")
    return found[0] if found else None


def _histogram(options: Mapping[str, Any]) -> FilmLayout | None:
    start, width, bins = (options.get(name) for name in ("start_opl", "bin_width_opl", "num_bins"))
    if start is None and width is None and bins is None:
        return None
    if start is None or width is None or bins is None:
        raise ArgumentError("--start-opl, --bin-width-opl and --num-bins replace the scene's axis together: give all.")
    return Histogram(TimeAxis(start, width, bins))


def _phasors(options: Mapping[str, Any]) -> FilmLayout | None:
    given = options.get("frequencies")
    if given is None:
        return None
    try:
        return Phasors(FrequencyAxis(tuple(float(text) for text in given.split(","))))
    except ValueError:
        raise UnitError(f"--frequencies: expected numbers with commas, got '{given}'.") from None


def _gates(options: Mapping[str, Any]) -> FilmLayout | None:
    given = options.get("gates")
    return None if given is None else Gates(gates_from_text(given))


def summary(film: FilmLayout, output: Any) -> tuple[str, str]:
    """Return the contents of a written file in words, and how they were made."""
    tensor = film.tensor(output)
    sizes = " x ".join(map(str, () if tensor is None else tensor.shape))
    shape = f"{sizes} ({'Stokes x ' if output.polarized else ''}C x {film.letter} x H x W)"
    if film.has_bins:
        return shape, f", {output.stats.temporal_filter} filter"
    return f"{shape} {film.plural}", ""


def pictures_of(film: FilmLayout) -> tuple[str, ...]:
    """Return the pictures of ``torchtransient render`` that show a film."""
    if isinstance(film, Histogram):
        return ("overview", "peak_time", "rainbow", "video")
    return ("video",) if isinstance(film, Phasors | Gates) else ()


def write_film_video(film: FilmLayout, output: Any, path: Any, progress: bool) -> str:
    """Write a video of a render and return its contents in words.

    Raises:
        ArgumentError: for films without a video.
    """
    from torchtransient.vis.phasors import phasor_video
    from torchtransient.vis.video import video

    if isinstance(film, Phasors):
        phasor_video(output, path, progress=progress)
        return "the wave of the first frequency"
    if not isinstance(film, Histogram | Gates):
        raise ArgumentError(f"--video shows nothing of {film.plural}; leave it out.")
    video(output, path, progress=progress)
    return f"{film.count} frames" + (", one for each gate" if isinstance(film, Gates) else "")
