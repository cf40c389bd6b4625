"""`torchtransient plan scene.xml`: what a render of the scene needs, and why."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from torchtransient.cli.arguments import NameList
from torchtransient.cli.options import film_of_options, load_scene, scene_options
from torchtransient.rendering.films import layout_of_plugin
from torchtransient.rendering.plan import Plan, known_outputs
from torchtransient.scene.inventory import scene_inventory

error_option = click.option(
    "--error",
    type=click.Choice(("squared", "relative")),
    help="Error that a plan makes small: of the light, or of every bin relative to its own.  [default: squared]",
)


@click.command()
@scene_options
@click.option(
    "--outputs",
    type=NameList(),
    help=f"Some of {', '.join(known_outputs())}.  [default: that of the film of the options or the scene]",
)
@click.option("--gradient", "gradients", multiple=True, metavar="KEY", help="A parameter that gradients are asked for.")
@click.option("--tail", type=float, default=1e-3, show_default=True, help="Share of the light left to deeper paths.")
@click.option("--missed", type=float, default=1e-3, show_default=True, help="Share of the light outside the time axis.")
@click.option("--sensor", type=click.IntRange(min=0), default=0, show_default=True, help="Which of several sensors.")
@click.option("--strict", is_flag=True, help="Carry polarization between smooth surfaces too.")
@click.option("--no-pilot", is_flag=True, help="Decide from the file alone, without tracing paths.")
@error_option
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
def command(scene: Path, **options: Any) -> None:
    """Choose variant, integrator, film, depth and time axis for SCENE, and print a line of reason for each.

    --bin-width-opl and --num-bins may be given alone here; with --start-opl they replace the axis.
    """
    found = plan_of_options(
        scene,
        options,
        options["outputs"],
        parameters=options["gradients"],
        tail=options["tail"],
        missed=options["missed"],
        strict=options["strict"],
        pilot=not options["no_pilot"],
    )
    click.echo(json.dumps(found.to_dict(), indent=2) if options["as_json"] else str(found))


def plan_of_options(scene: Path, options: Mapping[str, Any], outputs: Sequence[str] | None, **settings: Any) -> Plan:
    """Return the plan of a scene file.

    Args:
        scene: the file.
        options: options of the scene, of films, and ``error``.
        outputs: outputs of the plan, None for what the film of the options measures, or else that of the scene.
        settings: other arguments of ``tt.plan``.
    """
    import torchtransient as tt

    # Without a start, bins and their width are wishes for the axis that the plan finds.
    wishes = ("num_bins", "bin_width_opl") if options["start_opl"] is None else ()
    film = film_of_options({name: value for name, value in options.items() if name not in wishes})
    described = load_scene(scene, None, options["params"])
    if outputs is None:
        measures = film or layout_of_plugin(scene_inventory(described, options["sensor"]).film or "")
        outputs = ["transient" if measures is None else measures.output]
    return tt.plan(
        described,
        outputs,
        max_depth=options["max_depth"],
        variant=options["variant"],
        sensor=options["sensor"],
        seed=options["seed"],
        film=film,
        error=options["error"] or "squared",
        **{name: options[name] for name in wishes},
        **settings,
    )
