"""`torchtransient picture result.h5 out.png --kind rainbow`"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

KINDS = ("overview", "peak-time", "rainbow", "fusion", "streak", "frames", "histogram", "polarization", "phasor")


@click.command()
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("target", type=click.Path(path_type=Path))
@click.option("--kind", type=click.Choice(KINDS), default="overview", show_default=True)
@click.option("--pixel", type=(int, int), metavar="ROW COLUMN", help="For histogram and overview.")
@click.option("--row", type=int, help="Row of a streak picture.  [default: the middle]")
@click.option("--column", type=int, help="Column of a streak picture.")
def command(result: Path, target: Path, kind: str, **options: Any) -> None:
    """Draw RESULT, a file that `torchtransient render` wrote, to TARGET (.png).

    overview: all at once. peak-time: when most light arrives. rainbow: the same as hue over the steady picture. fusion:
    the hues of all bins mixed. streak: a row or column over time. frames: a sheet of moments. histogram: one pixel.
    polarization: intensity, degrees and angle. phasor: real part, phase and amplitude.
    """
    from torchtransient.vis.files import check_picture

    check_picture(target)
    for name, kinds in (("pixel", ("histogram", "overview")), ("row", ("streak",)), ("column", ("streak",))):
        if options[name] is not None and kind not in kinds:
            raise click.UsageError(f"--{name} has no effect on --kind {kind}: leave it out.")
    if kind == "histogram" and options["pixel"] is None:
        raise click.UsageError("--kind histogram needs --pixel ROW COLUMN.")
    _draw(kind, result, target, options)
    click.echo(f"{target}: {kind}")


def _draw(kind: str, result: Path, target: Path, options: dict[str, Any]) -> None:
    import torchtransient as tt
    from torchtransient.files.result_file import Result
    from torchtransient.rendering.films import layout_of_output
    from torchtransient.vis.sources import read_any, transient_of

    def overview() -> None:
        held = read_any(result)
        if not isinstance(held, Result):
            cube, axis = transient_of(held)
            if axis is None:
                raise click.UsageError(f"--kind overview needs a time axis, which {result.name} lacks; see --kind.")
            tt.vis.plot_overview(cube, cube.sum(1), axis, path=target, pixel=options["pixel"], title=result.name)
            return
        film = layout_of_output(held)
        if held.axis is None:
            what = "something else" if film is None else film.plural
            raise click.UsageError(f"--kind overview shows a histogram over time, and this file holds {what}.")
        cube, _ = transient_of(held)
        steady = held.steady[0] if held.steady.ndim == 4 else held.steady
        tt.vis.plot_overview(cube, steady, held.axis, path=target, pixel=options["pixel"], title=result.name)

    draw: dict[str, Callable[[], Any]] = {
        "overview": overview,
        "peak-time": lambda: tt.vis.peak_time_picture(result, target),
        "rainbow": lambda: tt.vis.rainbow(result, target),
        "fusion": lambda: tt.vis.rainbow(result, target, style="fusion"),
        "streak": lambda: tt.vis.streak(result, target, row=options["row"], column=options["column"]),
        "frames": lambda: tt.vis.frame_grid(result, target),
        "histogram": lambda: tt.vis.histogram(result, target, pixels=[options["pixel"]]),
        "polarization": lambda: tt.vis.polarization_picture(result, target),
        "phasor": lambda: tt.vis.phasor_picture(result, target, show=("real", "phase", "amplitude")),
    }
    draw[kind]()
