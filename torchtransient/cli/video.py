"""`torchtransient video result.h5 light.mp4`"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from torchtransient.cli.options import video_options


@click.command()
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("target", type=click.Path(path_type=Path))
@video_options
@click.option("--scale", type=click.IntRange(min=1), help="Screen pixels of a pixel.  [default: some 320 in all]")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def command(result: Path, target: Path, **options: Any) -> None:
    """Write the light in flight of RESULT, a file that `torchtransient render` wrote, to TARGET (.mp4 or .gif).

    All frames have one exposure. RESULT may also be a .npy with an array (C, T, H, W).
    """
    import torchtransient as tt

    stamp, quiet = not options.pop("no_stamp"), options.pop("quiet")
    tt.vis.video(result, target, stamp=stamp, progress=not quiet, **options)
    click.echo(f"{target}: {target.stat().st_size / 1e6:.1f} MB")
