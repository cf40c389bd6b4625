"""`torchtransient cost scene.xml`: error against seconds."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from torchtransient.cli.arguments import NumberList
from torchtransient.cli.options import film_of_options, load_scene, scene_options

NOT_REACHED = 1


@click.command()
@scene_options
@click.option(
    "--spp", type=NumberList(int, "N,N,..."), default="16,64,256", show_default=True,
    help="Samples per pixel to compare.",
)
@click.option("--gradient", "gradients", multiple=True, metavar="KEY", help="Also the derivative by this parameter.")
@click.option("--sampler", "samplers", multiple=True, default=("owen", "independent"), show_default=True)
@click.option("--temporal-filter", "filters", multiple=True, type=click.Choice(["box", "tent", "gaussian"]))
@click.option("--integrator", "integrators", multiple=True, metavar="PLUGIN")
@click.option("--depth", "depths", multiple=True, type=int, metavar="N", help="A longest path; -1 for no limit.")
@click.option("--bin-width", "widths", multiple=True, type=float, metavar="M", help="Metres of optical path.")
@click.option("--error", type=click.FloatRange(min=0.0, min_open=True), help="Recommend a setting: 0.05 for 5 %.")
@click.option("--reference-spp", type=click.IntRange(1, 2**32 - 1), help="Compare with a long one, not in pairs.")
@click.option("--repeats", type=click.IntRange(min=2), default=4, show_default=True, help="Runs of each kind.")
@click.option("--plot", type=click.Path(path_type=Path), help="Write the log-log picture (.png).")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Write the numbers (.json).")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def command(scene: Path, **options: Any) -> None:
    """Measure the error of SCENE's transient, and of derivatives, against seconds and samples; print a table.

    Options that may be given several times say what is compared. The exit status is 1 where --error is reached by no
    setting.
    """
    from torchtransient.checks import check_folder
    from torchtransient.errors import ArgumentError
    from torchtransient.vis.files import check_picture

    film = film_of_options(options)
    if options["plot"]:
        check_picture(options["plot"])
    if options["json_path"]:
        check_folder(options["json_path"], "--json")
    report = _measure(load_scene(scene, options["variant"], options["params"]), film, options)
    click.echo(report.table())
    reached = True
    if options["error"]:
        for quantity in report.quantities():
            try:
                best = report.recommend(options["error"], quantity=quantity)
                click.echo(f"recommended for {options['error']:.2%}: {best}")
            except ArgumentError as none:
                click.echo(none)
                reached = False
    if options["plot"]:
        report.plot(options["plot"])
        click.echo(f"{options['plot']}: the curves")
    if options["json_path"]:
        report.to_json(options["json_path"])
        click.echo(f"{options['json_path']}: the numbers")
    if not reached:
        sys.exit(NOT_REACHED)


def _measure(described: Any, film: Any, options: dict[str, Any]) -> Any:
    import torchtransient as tt

    gradients = list(options["gradients"])
    renderer = tt.TransientRenderer(described, parameters=gradients, film=film, max_depth=options["max_depth"])
    return tt.cost_of_accuracy(
        renderer, spp=options["spp"], gradients=gradients, reference_spp=options["reference_spp"],
        repeats=options["repeats"], samplers=list(options["samplers"]),
        temporal_filters=list(options["filters"]) or None, integrators=list(options["integrators"]) or None,
        max_depths=list(options["depths"]) or None, bin_widths=list(options["widths"]) or None, seed=options["seed"],
        progress=not options["quiet"],
    )  # fmt: skip
