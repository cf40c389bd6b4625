"""`torchtransient nlos capture.yaml -o capture.h5`"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from torchtransient.cli.options import assignments, video_options

# Pictures of a capture: option, function of `tt.vis`, what it shows.
PICTURES = {
    "transients": ("transients_grid", "histograms of points over the wall"),
    "peak_time": ("peak_time_picture", "when most light arrives"),
    "layout": ("scan_layout", "wall, points and origins"),
}
# What the file may say and the command line replaces.
_REPLACED = ("spp", "seed", "variant")
INTERRUPTED = 130


@click.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Capture, .h5 or .npz.  [default: SCENE.h5]")
@click.option("--part", type=click.Path(path_type=Path), help="Keeps what is finished.  [default: OUTPUT.part]")
@click.option(
    "--parts", type=click.IntRange(min=1), help="How many; a kill loses one at most.  [default: 16; exhaustive 4]"
)
@click.option("--whole", is_flag=True, help="No part file: faster for small captures, and lost by a kill.")
@click.option("--restart", is_flag=True, help="Delete a part file that is there, and start anew.")
@click.option("--describe", is_flag=True, help="Say memory, time and what is chosen, and stop.")
@click.option("--spp", type=click.IntRange(1, 2**32 - 1), help="Samples per sensor point.  [default: the file's]")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), help="Same seed, same capture.  [default: the file's]")
@click.option("--variant", help="Mitsuba variant.  [default: the file's, or the cheapest that shows all colours]")
@click.option("--param", "params", multiple=True, metavar="NAME=VALUE", help="Fill $NAME of an XML file.")
@click.option("--transients", type=click.Path(path_type=Path), help="Draw histograms over the wall (.png).")
@click.option("--peak-time", type=click.Path(path_type=Path), help="Draw when most light arrives (.png).")
@click.option("--layout", type=click.Path(path_type=Path), help="Draw wall, points and origins in space (.png).")
@click.option("--video", type=click.Path(path_type=Path), help="Write the light on the wall (.mp4 or .gif).")
@video_options
@click.option("--quiet", is_flag=True, help="No forecast and no progress bar.")
def command(scene: Path, **options: Any) -> None:
    """Simulate the capture around a corner that SCENE describes: a YAML file of this library (docs/nlos.md), a scene of
    y-tal's renderer (its YAML file or folder), or an XML file of Mitsuba with the integrator transient_nlos_path.

    Memory and time are said before it starts. What is finished is kept in a part file beside the output: after Ctrl-C
    or a kill the same command goes on, and the part file disappears at the end. The file holds the transient (C, T,
    rows, columns) or the phasor, the scan with all its points, and how it was made; tt.nlos.read_capture reads it.
    """
    import torch

    import torchtransient as tt
    from torchtransient.array_files.array_file import check_target
    from torchtransient.nlos.part_file import delete_part_file
    from torchtransient.nlos.renderer import checked_seed

    # What is wrong with the places to write to is said before the simulation, not after it.
    beside = scene / f"{scene.resolve().name}.h5" if scene.is_dir() else scene.with_suffix(".h5")
    target = check_target(options["output"] or beside, "capture file")
    _check_pictures(options)
    part = _part(options, target)
    setup = tt.nlos.read_setup(scene, **assignments(options["params"], "--param"))
    setup |= {name: options[name] for name in _REPLACED if options[name] is not None}
    parts = {} if options["parts"] is None else {"tiles": options["parts"]}
    if options["describe"]:
        click.echo(tt.nlos.forecast(**setup, part=part, **parts))
        return
    if options["restart"] and part is not None:
        delete_part_file(part)
    generator = torch.Generator().manual_seed(checked_seed(scene.name, setup.get("seed") or 0))
    try:
        capture = tt.nlos.simulate(
            **setup, part=part, **parts, progress=not options["quiet"], generator=generator, keep_part=True
        )
    except KeyboardInterrupt:
        kept = "nothing is kept" if part is None else f"what is finished is kept in {part}: the same command goes on"
        click.echo(f"stopped; {kept}", err=True)
        sys.exit(INTERRUPTED)
    tt.nlos.write_capture(target, capture, {"scene": scene.name, "parameters": list(options["params"])})
    if part is not None:
        delete_part_file(part)
    click.echo(f"{target}: {_summary(capture)}")
    _write_pictures(capture, setup, options)


def _part(options: dict[str, Any], target: Path) -> Path | None:
    if not options["whole"]:
        return options["part"] or target.with_name(f"{target.name}.part")
    given = [f"--{name}" for name in ("part", "parts", "restart") if options[name]]
    if given:
        raise click.UsageError(f"--whole keeps no part file; leave out {' and '.join(given)}, or --whole.")
    return None


def _summary(capture: Any) -> str:
    name, letter = ("transient", "T") if capture.transient is not None else ("phasor", "F")
    tensor = getattr(capture, name)
    laser = "laser rows x columns x " if capture.scan.kind == "exhaustive" else ""
    stokes = "Stokes x " if capture.polarized else ""
    sizes = " x ".join(map(str, tensor.shape))
    told = capture.metadata
    return (
        f"{sizes} ({stokes}C x {letter} x {laser}rows x columns), {told['spp']} samples a point, {told['seconds']:.1f} "
        f"s, {told['variant']}"
    )


def _drawable(hidden: Any) -> tuple[dict[str, Any], list[str]]:
    """Return the shapes that a layout can show, and the names of the others."""
    if not isinstance(hidden, dict):
        return {}, ["the shapes of the scene"]
    from torchtransient.vis.scans import DRAWN

    drawn = {name: shape for name, shape in hidden.items() if shape.get("type") in DRAWN}
    return drawn, [name for name in hidden if name not in drawn]


def _check_pictures(options: dict[str, Any]) -> None:
    from torchtransient.vis.files import check_picture
    from torchtransient.vis.videos import check_video

    for name in PICTURES:
        if options[name]:
            check_picture(options[name], f"--{name.replace('_', '-')}")
    if options["video"]:
        check_video(options["video"])


def _write_pictures(capture: Any, setup: dict[str, Any], options: dict[str, Any]) -> None:
    import torchtransient as tt

    for name, (function, shows) in PICTURES.items():
        if not options[name]:
            continue
        draw = getattr(tt.vis, function)
        if name == "layout":
            drawn, others = _drawable(setup["hidden"])
            draw(capture, options[name], hidden=drawn)
            shows += f"; not drawn: {', '.join(others)}" if others else ""
        else:
            draw(capture, options[name])
        click.echo(f"{options[name]}: {shows}")
    if options["video"]:
        look = {name: options[name] for name in ("fps", "exposure", "curve", "accumulate", "every")}
        stamp = not options["no_stamp"]
        tt.vis.video(capture, options["video"], stamp=stamp, progress=not options["quiet"], **look)
        click.echo(f"{options['video']}: the wall as the light arrives")
