"""Options that commands share, and the library's messages in their words."""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from torchtransient.axes import FrequencyAxis, RateAxis, TimeAxis
from torchtransient.chirps import Chirps
from torchtransient.cli.arguments import combined
from torchtransient.errors import ArgumentError, UnitError
from torchtransient.gates import gates_from_text
from torchtransient.rendering.films import Beats, FilmLayout, Gates, Histogram, Phasors, Rates

if TYPE_CHECKING:
    import torch

    from torchtransient.scene.load import Scene

# Options of each film, the first one its name in messages.
OPTIONS: dict[type[FilmLayout], tuple[str, ...]] = {
    Histogram: ("--start-opl", "--bin-width-opl", "--num-bins"),
    Phasors: ("--frequencies",),
    Gates: ("--gates",),
    Rates: ("--rates",),
    Beats: ("--chirps",),
}
_PICTURES = ("overview", "peak_time", "rainbow", "video")
# Python of messages, and the options in its place.
_WORDS = {
    "print(scene.parameters()) lists all keys": "`torchtransient render SCENE --list-parameters` lists all keys",
    "tt.plan(scene) finds a window": "`torchtransient plan SCENE` finds a window",
    ", by a sigmoid or, after each step, by torch.no_grad() and x.clamp_(0, 1)": "",
    "tt.plan: outputs are some of": "--outputs takes some of",
    "tt.plan: error='relative'": "--error relative",
    "temporal_filter: ": "--temporal-filter: ",
    "sensors: the scene has": "--sensor: the scene has",
    " to read_capture": "",
    "Give extent=(width, height) in metres": "Give --extent WIDTH,HEIGHT in metres",
    "expected size= for a list of points": "expected --voxels for a list of points",
}


def assignments(given: Sequence[str], option: str) -> dict[str, str]:
    """Return `("a=1", "b=x")` as a dictionary.

    Args:
        given: texts NAME=VALUE.
        option: name of the option, for messages.

    Raises:
        BadParameter: for a text without `=`, and a name that comes twice.
    """
    found: dict[str, str] = {}
    for text in given:
        name, sign, value = text.partition("=")
        if not sign or not name:
            raise click.BadParameter(f"expected NAME=VALUE, got '{text}'", param_hint=option)
        if name in found:
            raise click.BadParameter(f"'{name}' is given twice", param_hint=option)
        found[name] = value
    return found


def scene_values(given: Sequence[str], option: str) -> dict[str, torch.Tensor]:
    """Return `("red.reflectance.value=0.5,0.1,0.1",)` as tensors. Nested lists as in Python give more dimensions.

    Args:
        given: texts KEY=VALUE.
        option: name of the option, for messages.

    Raises:
        BadParameter: for values that are no numbers.
    """
    import torch

    values = {}
    for key, text in assignments(given, option).items():
        try:
            values[key] = torch.tensor(ast.literal_eval(text), dtype=torch.float32)
        except (ValueError, SyntaxError, TypeError):
            raise click.BadParameter(
                f"expected a number, or numbers with commas, for '{key}', got '{text}'", param_hint=option
            ) from None
    return values


def load_scene(scene: Path, variant: str | None, params: Sequence[str]) -> Scene:
    """Return the scene of a command line.

    Args:
        scene: file of the scene.
        variant: Mitsuba variant, None for the default.
        params: texts NAME=VALUE that fill $NAME of the file.
    """
    import torchtransient as tt

    values: dict[str, Any] = dict(assignments(params, "--param"))
    return tt.load(scene, variant=variant, **values)

# ---------------------------------------------------------------------------------------------------------------- films


film_options = combined(
    click.option("--start-opl", type=float, help="Start of the time axis, metres of optical path."),
    click.option("--bin-width-opl", type=float, help="Width of a bin, metres of optical path."),
    click.option("--num-bins", type=int, help="Number of bins."),
    click.option(
        "--frequencies", metavar="NU,NU,...", help="Phasors at these cycles per metre instead of a transient."
    ),
    click.option("--gates", metavar="GATE;GATE;...", help="Gates as scene files write them, instead of a transient."),
    click.option(
        "--rates",
        metavar="START:WIDTH:BINS",
        help="Bins of the rate of path lengths, m/s, beside those of time, of a scene in which things move.",
    ),
    click.option(
        "--chirps",
        metavar="BANDWIDTH:DURATION:WAVELENGTH",
        help="Beats of chirps (Hz, s, m; a window such as :blackman may follow) over the axis, instead of a transient.",
    ),
)
scene_options = combined(
    click.argument("scene", type=click.Path(path_type=Path)),
    click.option("--variant", help="Mitsuba variant, such as llvm_ad_rgb, llvm_ad_mono, cuda_ad_rgb."),
    click.option("--param", "params", multiple=True, metavar="NAME=VALUE", help="Fill $NAME of the scene file."),
    click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Same seed, same image."),
    click.option("--max-depth", type=int, help="Longest path, in segments; -1 for no limit."),
    film_options,
)


def film_of_options(options: Mapping[str, Any]) -> FilmLayout | None:
    """Return the film that the options of a command ask for, None without one.

    Args:
        options: values by name.

    Raises:
        ArgumentError: for options of two films, and for a part of an axis.
        UnitError: for frequencies, rates and chirps that are no numbers.
    """
    names = ("frequencies", "gates", "rates", "chirps")
    given = {name: options[name] for name in names if options.get(name) is not None}
    axis = _axis_of(options)
    if len(given) > 1 or (axis is not None and not given.keys().isdisjoint(("frequencies", "gates"))):
        flags = [f"--{name}" for name in given] + ["--start-opl"] * (axis is not None)
        raise ArgumentError(f"{' and '.join(flags)} ask for different films: leave out one of them.")
    for name, text in given.items():
        match name:
            case "frequencies":
                return Phasors(FrequencyAxis(tuple(_numbers(name, text.split(","), "numbers with commas"))))
            case "gates":
                return Gates(gates_from_text(text))
            case "rates":
                start, width, bins = _numbers(name, text.split(":"), "START:WIDTH:BINS in m/s, as -10.25:0.5:41", 3)
                return Rates(RateAxis(start, width, bins), axis)
            case "chirps":
                parts, form = text.split(":"), "BANDWIDTH:DURATION:WAVELENGTH in Hz, s and m, as 1e9:1e-5:1550e-9"
                numbers = _numbers(name, parts[:3], form, 3)
                window: dict[str, Any] = {"window": ":".join(parts[3:])} if parts[3:] else {}
                return Beats(Chirps(*numbers, **window), axis)
    return None if axis is None else Histogram(axis)


def _axis_of(options: Mapping[str, Any]) -> TimeAxis | None:
    start, width, bins = (options.get(name) for name in ("start_opl", "bin_width_opl", "num_bins"))
    if start is None and width is None and bins is None:
        return None
    if start is None or width is None or bins is None:
        raise ArgumentError("--start-opl, --bin-width-opl and --num-bins replace the scene's axis together: give all.")
    return TimeAxis(start, width, bins)


def _numbers(name: str, parts: Sequence[str], form: str, count: int | None = None) -> list[Any]:
    """Return the numbers of a text, whole ones as int."""
    try:
        found = [int(part) if part.strip().isdigit() else float(part) for part in parts]
    except ValueError:
        found = []
    if not found or count not in (None, len(found)):
        raise UnitError(f"--{name}: expected {form}, got '{':'.join(parts)}'.")
    return found


def summary(film: FilmLayout, output: Any) -> tuple[str, str]:
    """Return the contents of a written file in words, and how they were made.

    Args:
        film: film of the render.
        output: the render.
    """
    tensor = film.tensor(output)
    sizes = " x ".join(map(str, () if tensor is None else tensor.shape))
    shape = f"{sizes} ({'Stokes x ' if output.polarized else ''}C x {film.letter} x H x W)"
    if film.has_bins:
        return shape, f", {output.stats.temporal_filter} filter"
    return f"{shape} {film.plural}", ""


def _pictures_of(film: FilmLayout) -> tuple[str, ...]:
    """Return the pictures of ``torchtransient render`` that show a film."""
    if isinstance(film, Histogram | Rates):
        return _PICTURES
    return ("video",) if isinstance(film, Phasors | Gates) else ()


# ------------------------------------------------------------------------------------------------------------- pictures


video_options = combined(
    click.option("--fps", type=click.FloatRange(min=0, min_open=True), default=25.0, show_default=True),
    click.option("--exposure", type=click.FloatRange(min=0, min_open=True), help="Factor.  [default: measured]"),
    click.option("--curve", type=click.Choice(["srgb", "gamma", "log", "linear"]), default="srgb", show_default=True),
    click.option("--accumulate", is_flag=True, help="Show the light that has arrived so far."),
    click.option("--every", type=click.IntRange(min=1), default=1, show_default=True, help="Bins in a frame."),
    click.option("--no-stamp", is_flag=True, help="No time under the frames."),
)
picture_options = combined(
    click.option("--overview", type=click.Path(path_type=Path), help="Write a picture of the result too (.png)."),
    click.option("--video", type=click.Path(path_type=Path), help="Write the light in flight (.mp4 or .gif)."),
    click.option("--peak-time", type=click.Path(path_type=Path), help="Write when most light arrives (.png)."),
    click.option("--rainbow", type=click.Path(path_type=Path), help="Write time as hue (.png)."),
)


def check_pictures(options: dict[str, Any], film: FilmLayout | None) -> None:
    """Check that the pictures of `picture_options` can be written and show the film.

    Args:
        options: values by name.
        film: film of the render, None before it is known.

    Raises:
        StorageError: for a place that cannot be written.
        UsageError: for a picture that does not show what the film measures.
    """
    from torchtransient.vis.files import check_picture
    from torchtransient.vis.videos import check_video

    for name in _PICTURES:
        if not options[name]:
            continue
        flag = f"--{name.replace('_', '-')}"
        if film is not None and name not in _pictures_of(film):
            raise click.UsageError(f"{flag} shows a histogram over time; leave it out for {film.plural}.")
        if name == "video":
            check_video(options[name])
        else:
            check_picture(options[name], flag)


def write_pictures(output: Any, film: FilmLayout, options: dict[str, Any], title: str) -> None:
    """Write the pictures of `picture_options` that are asked for, and print their names.

    Args:
        output: the render.
        film: film of the render.
        options: values by name.
        title: title of the pictures.
    """
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
        write = tt.vis.phasor_video if isinstance(film, Phasors) else tt.vis.video
        write(output, options["video"], progress=not options["quiet"])
        shows = "the wave of the first frequency" if isinstance(film, Phasors) else f"{film.count} frames"
        click.echo(f"{options['video']}: {shows}")


# ------------------------------------------------------------------------------------------------------------- messages


def in_options(message: str) -> str:
    """Return a message of the library with options in the place of Python.

    Args:
        message: message of an error or a warning.
    """
    for kind, flags in OPTIONS.items():
        message = message.replace(f"Give {kind.example}", f"Give {', '.join(flags)}")
    for python, option in _WORDS.items():
        message = message.replace(python, option)
    return re.sub(r"^(tt\.\w+|reconstruct): ", "", message)


def arguments_as_options(message: str, names: Sequence[str]) -> str:
    """Return a message with ``name=`` as ``--name``.

    Args:
        message: message of an error.
        names: arguments that are options.
    """
    for name in names:
        option = f"--{name.replace('_', '-')}"
        # With a value behind it, or as a name alone.
        message = re.sub(rf"\b{name}=(?=['\"\w])", f"{option} ", message)
        message = re.sub(rf"\b{name}=", option, message)
    return message
