"""`torchtransient render scene.xml -o result.h5`"""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import click

from torchtransient.cli.options import (
    assignments,
    check_pictures,
    film_of_options,
    load_scene,
    picture_options,
    scene_options,
    scene_values,
    summary,
    write_pictures,
)
from torchtransient.cli.plan import error_option, plan_of_options
from torchtransient.errors import PhysicsWarning
from torchtransient.rendering.films import layout_of_output


@click.command()
@scene_options
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Result, .h5 or .npz.  [default: SCENE.h5]")
@picture_options
@click.option("--pixel", type=(int, int), metavar="ROW COLUMN", help="Pixel whose histogram the picture shows.")
@click.option("--spp", type=click.IntRange(1, 2**32 - 1), help="Samples per pixel.  [default: the scene's]")
@click.option("--errors", is_flag=True, help="Keep error bars in the result, and show them in the overview.")
@click.option(
    "--rtol", type=click.FloatRange(0, 1, min_open=True, max_open=True), metavar="ERROR",
    help="Render until 90 % of the bins with light have this relative error: 0.05.",
)
@click.option(
    "--max-seconds", type=click.FloatRange(min=0, min_open=True), metavar="SECONDS", help="With --rtol: the most time."
)
@click.option("--set", "values", multiple=True, metavar="KEY=VALUE", help="Change a parameter of the scene.")
@click.option("--temporal-filter", type=click.Choice(["auto", "box", "tent", "gaussian"]), default="auto")
@click.option("--sensor", type=click.IntRange(min=0), default=0, show_default=True, help="Which of several sensors.")
@click.option("--plan", "planned", is_flag=True, help="Render what `torchtransient plan` chooses, and say why.")
@error_option
@click.option("--list-parameters", is_flag=True, help="Print the keys that --set takes, and stop.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def command(scene: Path, **options: Any) -> None:
    """Render SCENE, a Mitsuba XML file, and write the transient.

    The file holds transient (C, T, H, W) and steady (C, H, W), both with the four Stokes components in front in a
    polarized variant, the time axis in metres of optical path, and how it was made. With --frequencies, --gates,
    --rates or --chirps, or for a scene with such a film, phasor (C, F, H, W), gated (C, G, H, W), rates (C, R, T, H, W)
    or beats (C, 2, T, H, W) stands in place of the transient; pictures of rates show their sum.
    With --plan, variant, integrator, depth and time axis are those that the scene calls for at its described values,
    where options do not say otherwise; --bin-width-opl and --num-bins may be given alone then.
    torchtransient.files.result_file.read_result reads it.
    """
    from torchtransient.array_files.array_file import check_target
    from torchtransient.files.result_file import write_result

    assignments(options["params"], "--param")
    _check_tolerance(options)
    if options["error"] and not options["planned"]:
        raise click.UsageError("--error is for --plan, which chooses what makes that error small.")
    film = None if options["planned"] else film_of_options(options)
    values = scene_values(options["values"], "--set")
    # What is wrong with the places to write to is said before the render, not after it.
    target = check_target(options["output"] or scene.with_suffix(".h5"), "result file")
    check_pictures(options, film)
    described = load_scene(scene, options["variant"], options["params"])
    if options["list_parameters"]:
        click.echo(described.parameters())
        return
    metadata = {"scene": scene.name, "parameters": options["params"], "set": options["values"]}
    if options["planned"]:
        chosen = None if options["temporal_filter"] == "auto" else options["temporal_filter"]
        plan = plan_of_options(scene, options, None, temporal_filter=chosen)
        click.echo(plan)
        check_pictures(options, plan.film_choice)
        described, metadata["plan"] = plan.scene, plan.to_dict()
        settings: dict[str, Any] = {"effects": plan}
    else:
        names = ("max_depth", "temporal_filter")
        settings = {"film": film, "sensors": options["sensor"], **{name: options[name] for name in names}}
    output, found = _rendered(described, values, settings, options)
    if found is not None:
        error = found.error if math.isfinite(found.error) else None  # JSON has no infinity
        metadata["tolerance"] = {
            "rtol": found.rtol, "quantile": found.quantile, "error": error, "reached": found.reached,
        }  # fmt: skip
        said = f"{'reached' if found.reached else 'not reached'}: {found.reason}"
        click.echo(f"relative error {found.error:.3g} of {found.quantile:.0%} of the bins with light, {said}")
    write_result(target, output, metadata)
    stats, film = output.stats, layout_of_output(output)
    assert film is not None  # a steady film was refused before the render
    what, how = summary(film, output)
    if options["errors"] and (error := output.relative_error()) is not None:
        how += f", sum known to {error:.2%}"
    click.echo(f"{target}: {what}, {stats.spp} samples per pixel, {stats.seconds:.1f} s, {stats.variant}{how}")
    if output.axis is not None:
        _report_energy(output)
    check_pictures(options, film)
    write_pictures(output, film, options, scene.name)


def _rendered(
    described: Any, values: dict[str, Any], settings: dict[str, Any], options: dict[str, Any]
) -> tuple[Any, Any]:
    """Return a render, and with --rtol what was reached of it."""
    import torch

    import torchtransient as tt

    common = {"seed": options["seed"], "progress": not options["quiet"]}
    with warnings.catch_warnings():
        # What the axis misses is said in the words of the command line, by `_report_energy`.
        warnings.filterwarnings("ignore", "the window misses", PhysicsWarning)
        if options["rtol"] is None:
            with torch.no_grad():
                errors = options["errors"]
                return tt.render(described, values, spp=options["spp"], errors=errors, **common, **settings), None
        renderer = tt.TransientRenderer(described, list(values), **settings)
        found = renderer.to_tolerance(values, rtol=options["rtol"], max_seconds=options["max_seconds"], **common)
        return found.output, found


def _check_tolerance(options: dict[str, Any]) -> None:
    if options["rtol"] is None and options["max_seconds"] is not None:
        raise click.UsageError("--max-seconds is for --rtol: a render of a given --spp ends with its last sample.")
    if options["rtol"] is not None and options["errors"]:
        raise click.UsageError("--rtol, --errors: give one of them; --rtol says the error that it reached.")
    if options["rtol"] is not None and options["spp"] is not None:
        raise click.UsageError("--rtol, --spp: give one of them; --rtol finds the samples, --max-seconds bounds them.")


def _report_energy(output: Any) -> None:
    """Print the light outside of the time axis, which is easily overlooked in a picture."""
    before, after = output.outside
    if before + after > 0.001:
        axis = output.axis
        click.echo(
            f"note: the axis from {axis.start_opl:g} m to {axis.end_opl:g} m misses light: "
            f"{before:.1%} arrives before it and {after:.1%} after it."
        )
