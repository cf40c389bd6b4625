"""`torchtransient reconstruct capture.h5 --method fk`"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from torchtransient.cli.arguments import NumberList, combined
from torchtransient.volume_methods import CAMERAS, FILTERS, METHODS, SETTINGS, SLAB_SNR, TARGETS

_XYZ = (float, float, float)
_SIX = (float,) * 6
# Arguments of read_capture that a file may leave open.
_OPEN = ("wall_size", "bin_width_s", "start_s", "sensor_origin", "laser_origin", "frame")


# Values that a file of another program leaves open.
file_options = combined(
    click.option("--format", "layout", help="Layout of CAPTURE (docs/capture_files.md).  [default: found]"),
    click.option("--wall-size", type=NumberList(float, "WIDTH[,HEIGHT]", 2), help="Of the scanned area, metres."),
    click.option("--bin-width-s", type=float, help="Seconds."),
    click.option("--start-s", type=float, help="Start of the first bin after light leaves the wall."),
    click.option("--sensor-origin", type=_XYZ, metavar="X Y Z", help="Metres."),
    click.option("--laser-origin", type=_XYZ, metavar="X Y Z", help="Metres."),
    click.option("--frame", type=click.IntRange(min=0), help="Of a file with several."),
)
# How a capture is prepared.
capture_options = combined(
    click.option("--record", type=(float, float), metavar="START END", help="Use these bins alone, metres."),
    click.option("--sum-bins", type=click.IntRange(min=1), default=1, show_default=True, help="Add up so many."),
    click.option("--slab", type=float, metavar="METRES", help="Take off a slab of foam so thick (confocal scans)."),
    click.option("--slab-snr", type=float, help=f"Its light over noise, in power.  [default: {SLAB_SNR:g}]"),
)


@click.command()
@click.argument("capture", type=click.Path(path_type=Path, dir_okay=False))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="Volume, .h5 or .npz.  [default: CAPTURE_METHOD.h5]"
)
@click.option("--picture", type=click.Path(path_type=Path), help="Front, top, side, depth.  [default: OUTPUT.png]")
@click.option("--no-picture", is_flag=True, help="The volume alone.")
@click.option("--gamma", type=float, default=1.0, show_default=True, help="Below one lightens what is dim.")
@click.option(
    "--flip", type=click.Choice(("x", "y", "xy")), help="Turn the picture over; files may count rows downwards."
)
@click.option("--threshold", type=float, default=0.1, show_default=True, help="Least brightness that has a depth.")
@click.option("--method", type=click.Choice(tuple(METHODS)), help="[default: what suits the capture]")
@click.option("--depths", type=(float, float), metavar="NEAR FAR", help="Before the wall, metres.  [default: all]")
@click.option(
    "--voxels", type=NumberList(int, "N or X,Y[,Z]", 3), help="bp, fbp; Z of phasor.  [default: as the scan, 64]"
)
@click.option("--extent", type=NumberList(float, "WIDTH[,HEIGHT]", 2), help="Of the planes, metres (bp, fbp).")
@click.option("--bounds", type=_SIX, metavar="X Y Z X Y Z", help="Lowest and highest corner of the voxels (bp, fbp).")
@click.option(
    "--target", type=click.Choice(TARGETS), help="f-k and light-cone.  [default: diffuse]"
)
@click.option("--floor", type=float, help="Of the root of f-k: 0.25 for counts.  [default: 0]")
@click.option("--taps", type=int, help="Of f-k: 4 interpolate finely, 2 in less time.  [default: 4]")
@click.option("--snr", type=float, help="Of the light-cone transforms; larger is sharper.  [default: 10]")
@click.option("--v-bins", type=int, help="Of light-cone transforms: bins of squared depth.  [default: as of time]")
@click.option("--taper", type=float, help="Share of a side over which directional-lct fades light out.  [default: 0.1]")
@click.option("--wavelength", type=float, help="Metres (fbp, phasor).  [default: the shortest without ghosts]")
@click.option("--cycles", type=float, help="Waves of a pulse (fbp, phasor).  [default: 4]")
@click.option("--falloff", type=float, help="-2 makes up for distance (bp, fbp, phasor).  [default: 0]")
@click.option("--filter", "filter", type=click.Choice(FILTERS), help="Of fbp.  [default: phasor]")
@click.option("--camera", type=click.Choice(CAMERAS), help="Of phasor: one picture, or films.  [default: direct]")
@click.option("--times", type=(float, float, int), metavar="START STOP N", help="Of a film, metres after the focus.")
@capture_options
@file_options
@click.option("--device", default="cpu", show_default=True, help="Where to compute, such as cuda.")
@click.option("--quiet", is_flag=True, help="No reasons and no progress bar.")
def command(capture: Path, **options: Any) -> None:
    """Reconstruct what CAPTURE, a file of any known layout, has seen around the corner, and draw it.

    fk, lct, directional-lct: confocal scans of a flat grid. midpoint-fk: single and exhaustive ones. phasor: all three.
    bp, fbp: any points. Which loses what: docs/nlos_reconstruction.md. The volume's file holds values (C, Z, Y, X),
    depths and axes; tt.nlos.read_volume reads it.
    """
    from torchtransient.cli.options import arguments_as_options
    from torchtransient.errors import TorchTransientError

    _check_together(options)
    names = (*_OPEN, *SETTINGS, "format", "camera", "depths")
    try:
        _run(capture, options)
    except TorchTransientError as error:
        raise type(error)(arguments_as_options(str(error), names)) from error


def _run(capture: Path, options: dict[str, Any]) -> None:
    import torchtransient as tt
    from torchtransient.array_files.array_file import check_target
    from torchtransient.nlos.methods import Choice, choose_method

    told = {name: options[name] for name in _OPEN if options[name] is not None}
    if len(told.get("wall_size", ())) == 1:
        (told["wall_size"],) = told["wall_size"]
    measured = tt.nlos.read_capture(capture, options["layout"], **told)
    method = options["method"]
    choice = choose_method(measured) if method is None else Choice(method, "asked for")
    if not options["quiet"]:
        _tell(measured, choice)
    beside = capture.with_name(f"{capture.stem}_{choice.name}.h5")
    target = check_target(options["output"] or beside, "volume file")
    picture = _picture(options, target)
    prepared = _prepared(measured, options)
    settings: dict[str, Any] = {name: options[name] for name in SETTINGS}
    if options["camera"] is not None:
        settings["camera"] = _camera(options)
    grid = _grid(prepared, choice.name, options)
    volume = tt.nlos.reconstruct(
        prepared, choice.name, grid=grid, depths=options["depths"] if grid is None else None,
        progress=not options["quiet"], **settings,
    )  # fmt: skip
    volume = _noted(volume, capture, measured, choice.reason, options)
    tt.nlos.write_volume(target, volume)
    sizes = " x ".join(map(str, volume.values.shape))
    near, far = volume.grid.depths[0], volume.grid.depths[-1]
    click.echo(f"{target}: {sizes} voxels, {near:.3g} to {far:.3g} m before the wall")
    if picture is not None:
        _draw(volume, picture, options)
        click.echo(f"{picture}: front, top, side and depth")


def _tell(measured: Any, choice: Any) -> None:
    """Print the method, and values that neither the file nor the command line had, on stderr."""
    click.echo(f"--method {choice.name}: {choice.reason}", err=True)
    assumed = measured.metadata.get("assumed") or {}
    if assumed:
        values = ", ".join(f"--{name.replace('_', '-')} {_as_words(value)}" for name, value in assumed.items())
        click.echo(f"assumed, since the file does not say it: {values}", err=True)


def _as_words(value: Any) -> str:
    if not isinstance(value, list):
        return f"{value:.4g}" if isinstance(value, float) else str(value)
    return " ".join(_as_words(round(part, 9) + 0.0 if isinstance(part, float) else part) for part in value)


def _check_together(options: dict[str, Any]) -> None:
    """Refuse options that contradict each other, before the file is read."""
    from torchtransient.checks import positive, share

    positive("--gamma", options["gamma"])
    share("--threshold", options["threshold"])
    if options["no_picture"] and options["picture"]:
        raise click.UsageError("--no-picture writes none; leave out --picture, or --no-picture.")
    if options["bounds"] and (options["depths"] or options["extent"]):
        raise click.UsageError("--bounds says where voxels are; leave out --depths and --extent, or --bounds.")
    if options["times"] and options["camera"] in (None, "direct"):
        raise click.UsageError("--times is for --camera confocal and --camera transient.")
    if options["slab_snr"] is not None and options["slab"] is None:
        raise click.UsageError("--slab-snr needs --slab.")


def _picture(options: dict[str, Any], target: Path) -> Path | None:
    from torchtransient.vis.files import check_picture

    if options["no_picture"]:
        return None
    picture: Path = options["picture"] or target.with_suffix(".png")
    check_picture(picture, "--picture")
    return picture


def _prepared(capture: Any, options: dict[str, Any]) -> Any:
    """Return the capture as the method takes it: cut, summed, without its slab, on its device."""
    from torchtransient.nlos.reconstruct import moved_to, sum_bins, without_slab
    from torchtransient.reconstruction.capture_checks import check_record

    if options["record"] is not None:
        check_record(capture.axis, options["record"][1], "--record")
        capture = capture.crop(*options["record"])
    capture = moved_to(sum_bins(capture, options["sum_bins"]), options["device"])
    if options["slab"] is not None:
        snr = options["slab_snr"]
        capture = without_slab(capture, options["slab"], SLAB_SNR if snr is None else snr)
    return capture


def _camera(options: dict[str, Any]) -> Any:
    from torchtransient.nlos.reconstruct import camera_of

    if options["camera"] != "direct" and options["times"] is None:
        raise click.UsageError(f"--camera {options['camera']} films: give --times START STOP N.")
    return camera_of(options["camera"], options["times"])


def _grid(capture: Any, method: str, options: dict[str, Any]) -> Any:
    """Return the voxels that are asked for; None for those of the method."""
    from torchtransient.nlos.reconstruct import default_grid
    from torchtransient.reconstruction import VoxelGrid

    given = [f"--{name}" for name in ("voxels", "extent", "bounds") if options[name] is not None]
    if not given:
        return None
    if not METHODS[method].free_grid:
        raise click.UsageError(
            f"--method {method} has a voxel behind each point and a plane for each bin; leave out "
            f"{' and '.join(given)}, or take bp or fbp."
        )
    voxels: tuple[int, ...] = options["voxels"] or ()
    if options["bounds"] is not None:
        if len(voxels) not in (1, 3):
            raise click.UsageError("--bounds needs --voxels N or X,Y,Z.")
        bounds = (options["bounds"][:3], options["bounds"][3:])
        return VoxelGrid.bounds(bounds, voxels if len(voxels) == 3 else voxels[0])
    extent = options["extent"]
    size = None if not voxels else (voxels[:2] if len(voxels) > 1 else voxels[0])
    planes = voxels[2] if len(voxels) == 3 else None
    extent = extent if extent is None or len(extent) == 2 else extent[0]
    return default_grid(capture, depths=options["depths"], size=size, extent=extent, planes=planes)


def _noted(volume: Any, path: Path, measured: Any, reason: str, options: dict[str, Any]) -> Any:
    """Return the volume with notes of the file and the command line, as far as they are plain data."""
    from dataclasses import replace

    said = {name: options[name] for name in ("record", "sum_bins", "slab", "slab_snr") if options[name] is not None}
    if "slab" in said:
        said.setdefault("slab_snr", SLAB_SNR)
    notes = {"capture": path.name, "reason": reason, "prepared": said}
    assumed = measured.metadata.get("assumed")
    return replace(volume, metadata={**volume.metadata, **notes, **({"assumed": assumed} if assumed else {})})


def _draw(volume: Any, path: Path, options: dict[str, Any]) -> None:
    import torchtransient as tt

    # Axes of pictures (..., Y, X), from behind.
    over = [-1 - "xy".index(axis) for axis in options["flip"] or ""]
    found = volume.picture()
    surface = tt.nlos.depth_map(found.clamp_min(0), volume.grid, threshold=options["threshold"])
    normals = None if volume.directions is None else tt.nlos.normals_of(volume).flip(over)
    tt.vis.volume_views(
        found.flip(over), path, depths=volume.grid.depths, extent=volume.grid.extent, depth=surface.depth.flip(over),
        mask=surface.mask.flip(over), normals=normals, gamma=options["gamma"],
        title=f"{volume.metadata['capture']}, {volume.method}",
    )  # fmt: skip
