"""Options for pictures of a result, which `render`, `video` and `picture` share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from torchtransient.cli.films import pictures_of, write_film_video

if TYPE_CHECKING:
    from torchtransient.rendering.films import FilmLayout

PICTURES = ("overview", "peak_time", "rainbow", "video")
Command = TypeVar("Command", bound=Callable[..., Any])


def video_options(command: Command) -> Command:
    """How the frames of a video look."""
    options = (
        click.option("--fps", type=click.FloatRange(min=0, min_open=True), default=25.0, show_default=True),
        click.option("--exposure", type=click.FloatRange(min=0, min_open=True), help="Factor.  [default: measured]"),
        click.option(
            "--curve", type=click.Choice(["srgb", "gamma", "log", "linear"]), default="srgb", show_default=True
        ),
        click.option("--accumulate", is_flag=True, help="Show the light that has arrived so far."),
        click.option("--every", type=click.IntRange(min=1), default=1, show_default=True, help="Bins in a frame."),
        click.option("--no-stamp", is_flag=True, help="No time under the frames."),
    )
    for option in reversed(options):
        command = option(command)
    return command


def picture_options(command: Command) -> Command:
    """Which pictures `render` writes beside the result."""
    options = (
        click.option("--overview", type=click.Path(path_type=Path), help="Write a picture of the result too (.png)."),
        click.option("--video", type=click.Path(path_type=Path), help="Write the light in flight (.mp4 or .gif)."),
        click.option("--peak-time", type=click.Path(path_type=Path), help="Write when most light arrives (.png)."),
        click.option("--rainbow", type=click.Path(path_type=Path), help="Write time as hue (.png)."),
    )
    for option in reversed(options):
        command = option(command)
    return command


def check_pictures(options: dict[str, Any], film: FilmLayout | None) -> None:
    """Raise StorageError when one of the pictures of `picture_options` could not be written, UsageError when it does
    not show what the film measures. None: it is not known yet.
    """
    from torchtransient.vis.files import check_picture
    from torchtransient.vis.videos import check_video

    for name in PICTURES:
        if not options[name]:
            continue
        flag = f"--{name.replace('_', '-')}"
        if film is not None and name not in pictures_of(film):
            raise click.UsageError(f"{flag} shows a histogram over time; leave it out for {film.plural}.")
        if name == "video":
            check_video(options[name])
        else:
            check_picture(options[name], flag)


def write_pictures(output: Any, film: FilmLayout, options: dict[str, Any], title: str) -> None:
    """Write the pictures of `picture_options` that are asked for, and say so."""
    import torchtransient as tt

    if options["overview"]:
        transient = output.rates.sum(-4) if output.transient is None else output.transient
        power = (transient[0], output.steady[0]) if output.polarized else (transient, output.steady)
        errors = None
        if output.cells is not None:
            errors = output.error_map()[0] if output.polarized else output.error_map()
        tt.vis.plot_overview(
            *power, output.axis, path=options["overview"], pixel=options["pixel"], title=title, errors=errors
        )
        click.echo(f"{options['overview']}: overview")
    if options["peak_time"]:
        tt.vis.peak_time_picture(output, options["peak_time"], title=title)
        click.echo(f"{options['peak_time']}: arrival of the peak")
    if options["rainbow"]:
        tt.vis.rainbow(output, options["rainbow"])
        click.echo(f"{options['rainbow']}: hue by arrival")
    if options["video"]:
        shown = write_film_video(film, output, options["video"], progress=not options["quiet"])
        click.echo(f"{options['video']}: {shown}")
