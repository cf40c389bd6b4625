"""Options for pictures of a result, which `render`, `video` and `picture` share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

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


def check_pictures(options: dict[str, Any], phasors: bool) -> None:
    """Raise StorageError when one of the pictures of `picture_options` could not be written, UsageError when it shows
    a histogram over time and the film keeps phasors.
    """
    from torchtransient.vis.overview import check_picture
    from torchtransient.vis.video_file import check_video

    for name in ("overview", "peak_time", "rainbow"):
        if options[name] and phasors:
            flag = name.replace("_", "-")
            raise click.UsageError(f"--{flag} shows a histogram over time; leave it out for phasors and gates.")
        if options[name]:
            check_picture(options[name])
    if options["video"]:
        check_video(options["video"])


def write_pictures(output: Any, options: dict[str, Any], title: str) -> None:
    """Write the pictures of `picture_options` that are asked for, and say so. Phasors become a video of a wave."""
    import torchtransient as tt

    progress = not options["quiet"]
    if options["overview"]:
        power = (output.transient[0], output.steady[0]) if output.polarized else (output.transient, output.steady)
        tt.vis.plot_overview(*power, output.axis, options["overview"], pixel=options["pixel"], title=title)
        click.echo(f"{options['overview']}: overview")
    if options["peak_time"]:
        tt.vis.peak_time_picture(output, options["peak_time"], title=title)
        click.echo(f"{options['peak_time']}: arrival of the peak")
    if options["rainbow"]:
        tt.vis.rainbow(output, options["rainbow"])
        click.echo(f"{options['rainbow']}: hue by arrival")
    if options["video"] and output.transient is None:
        tt.vis.phasor_video(output, options["video"], progress=progress)
        click.echo(f"{options['video']}: the wave of the first frequency")
    elif options["video"]:
        tt.vis.video(output, options["video"], progress=progress)
        click.echo(f"{options['video']}: {output.transient.shape[-3]} frames")
