"""Films on the command line: options that ask for one, and what is said and shown of its measurements."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import click

from torchtransient.axes import FrequencyAxis, RateAxis, TimeAxis
from torchtransient.chirps import Chirps
from torchtransient.errors import ArgumentError, UnitError
from torchtransient.gates import gates_from_text
from torchtransient.rendering.films import Beats, FilmLayout, Gates, Histogram, Phasors, Rates

Command = TypeVar("Command", bound=Callable[..., Any])

# Options of each film, the first one its name in messages.
OPTIONS: dict[type[FilmLayout], tuple[str, ...]] = {
    Histogram: ("--start-opl", "--bin-width-opl", "--num-bins"),
    Phasors: ("--frequencies",),
    Gates: ("--gates",),
    Rates: ("--rates",),
    Beats: ("--chirps",),
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
        click.option(
            "--rates",
            metavar="START:WIDTH:BINS",
            help="Bins of the rate of path lengths, m/s, beside those of time, of a scene in which things move.",
        ),
        click.option(
            "--chirps",
            metavar="BANDWIDTH:DURATION:WAVELENGTH",
            help="Beats of chirps (Hz, s, m; a window such as :blackman may follow) over the axis, instead of a "
            "transient.",
        ),
    )
    for option in reversed(options):
        command = option(command)
    return command


def film_of_options(options: Mapping[str, Any]) -> FilmLayout | None:
    """Return the film that the options of a command ask for, None without one.

    Raises:
        ArgumentError: for options of two films, and for a part of an axis.
        UnitError: for frequencies, rates and chirps that are no numbers.
    """
    histogram = _histogram(options)
    axis = None if histogram is None else histogram.axis
    rows = [film for film in (_rates(options, axis), _chirps(options, axis)) if film is not None]
    every = (None if rows else histogram, _phasors(options), _gates(options), *rows)
    found = [film for film in every if film is not None]
    if len(found) > 1:
        flags = " and ".join(OPTIONS[type(film)][0] for film in found)
        raise ArgumentError(f"{flags} ask for different films: leave out one of them.")
    return found[0] if found else None


def _histogram(options: Mapping[str, Any]) -> Histogram | None:
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


def _rates(options: Mapping[str, Any], axis: TimeAxis | None) -> FilmLayout | None:
    given = options.get("rates")
    if given is None:
        return None
    try:
        start, width, bins = given.split(":")
        numbers = float(start), float(width), int(bins)
    except ValueError:
        raise UnitError(f"--rates: expected START:WIDTH:BINS in m/s, such as -10.25:0.5:41, got '{given}'.") from None
    return Rates(RateAxis(*numbers), axis)


def _chirps(options: Mapping[str, Any], axis: TimeAxis | None) -> FilmLayout | None:
    given = options.get("chirps")
    if given is None:
        return None
    numbers, window = given.split(":")[:3], given.split(":")[3:]
    try:
        bandwidth, duration, wavelength = map(float, numbers)
    except ValueError:
        raise UnitError(
            f"--chirps: expected BANDWIDTH:DURATION:WAVELENGTH in Hz, s and m, such as 1e9:1e-5:1550e-9, got '{given}'."
        ) from None
    chirps = Chirps(bandwidth, duration, wavelength, **({"window": ":".join(window)} if window else {}))
    return Beats(chirps, axis)


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
    if isinstance(film, Histogram | Rates):
        return ("overview", "peak_time", "rainbow", "video")
    return ("video",) if isinstance(film, Phasors | Gates) else ()


def write_film_video(film: FilmLayout, output: Any, path: Any, progress: bool) -> str:
    """Write a video of a render and return its contents in words.

    Raises:
        ArgumentError: for films without a video.
    """
    from torchtransient.vis.phasors import phasor_video
    from torchtransient.vis.videos import video

    if isinstance(film, Phasors):
        phasor_video(output, path, progress=progress)
        return "the wave of the first frequency"
    if not isinstance(film, Histogram | Gates | Rates):
        raise ArgumentError(f"--video shows nothing of {film.plural}; leave it out.")
    video(output, path, progress=progress)
    return f"{film.count} frames" + (", one for each gate" if isinstance(film, Gates) else "")
