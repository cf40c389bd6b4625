"""`torchtransient plan scene.xml`: what a render of the scene needs, and why."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from torchtransient.cli.options import load_scene, scene_options, time_axis


class Names(click.ParamType):
    """Words with commas between them."""

    name = "NAME,NAME,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        """The words of a text."""
        return value if isinstance(value, tuple) else tuple(part.strip() for part in value.split(",") if part.strip())


class Numbers(click.ParamType):
    """Numbers with commas between them."""

    name = "X,X,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        """The numbers of a text; a usage error for anything else."""
        if isinstance(value, tuple):
            return value
        try:
            return tuple(float(part) for part in value.split(","))
        except ValueError:
            self.fail(f"expected numbers such as 0.5,1.5, got '{value}'", param, ctx)


@click.command()
@scene_options
@click.option(
    "--outputs",
    type=Names(),
    default="transient",
    show_default=True,
    help="Some of transient, steady, phasor, stokes, gates, bands.",
)
@click.option("--gradient", "gradients", multiple=True, metavar="KEY", help="A parameter that gradients are asked for.")
@click.option("--frequencies", type=Numbers(), help="For phasors: cycles per metre of optical path.")
@click.option("--tail", type=float, default=1e-3, show_default=True, help="Share of the light left to deeper paths.")
@click.option("--missed", type=float, default=1e-3, show_default=True, help="Share of the light outside the time axis.")
@click.option("--strict", is_flag=True, help="Carry polarization between smooth surfaces too.")
@click.option("--no-pilot", is_flag=True, help="Decide from the file alone, without tracing paths.")
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
def command(scene: Path, **options: Any) -> None:
    """Choose variant, integrator, film, depth and time axis for SCENE, and print a line of reason for each.

    --bin-width-opl and --num-bins may be given alone here; with --start-opl they replace the axis.
    """
    import torchtransient as tt

    start, width, bins = options["start_opl"], options["bin_width_opl"], options["num_bins"]
    axis = time_axis(start, width, bins) if start is not None else None
    found = tt.plan(
        load_scene(scene, None, options["params"]),
        options["outputs"],
        parameters=options["gradients"],
        frequencies=options["frequencies"],
        time_axis=axis,
        num_bins=None if axis else bins,
        bin_width_opl=None if axis else width,
        max_depth=options["max_depth"],
        variant=options["variant"],
        tail=options["tail"],
        missed=options["missed"],
        strict=options["strict"],
        pilot=not options["no_pilot"],
        seed=options["seed"],
    )
    click.echo(json.dumps(found.to_dict(), indent=2) if options["as_json"] else str(found))
