"""From a capture to a hidden volume in one call, by a method that is given or that suits the capture."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture
from torchtransient.capture.capture import precision_of, summed
from torchtransient.checks import Numbers, count, finite, positive, real_array, shown
from torchtransient.errors import ArgumentError, DeviceError, ShapeError, UnitError
from torchtransient.nlos.methods import (
    AT_ONCE,
    Choice,
    check_method,
    check_volume_fits,
    choose_method,
    default_wavelength,
    is_planar,
)
from torchtransient.reconstruction import (
    FK,
    LCT,
    Backprojection,
    ConfocalCamera,
    DiffusionDeconvolution,
    DirectionalLCT,
    DirectLight,
    FilteredBackprojection,
    HiddenVolume,
    LaplacianFilter,
    MidpointFK,
    PhasorField,
    PhasorFilter,
    TransientCamera,
    VoxelGrid,
    subtract_legs,
)
from torchtransient.reconstruction.capture_checks import (
    check_proportions,
    check_reach,
    check_wavelength,
    checked_capture,
    one_of,
)
from torchtransient.volume_methods import FILTERS, Method


def _checked_light(capture: Capture, who: str) -> Capture:
    """Return a capture whose light is finite. Raises UnitError for NaN, which transforms spread over the volume."""
    light, _ = checked_capture(capture, who)
    finite = torch.isfinite(light)
    if bool(finite.all()):
        return capture
    dims = len(capture.scan.shape)
    # All but the points: channels, batches and times.
    dead = ~finite.reshape(-1, *light.shape[light.ndim - dims :]).all(0)
    places = dead.nonzero().tolist()
    first = ", ".join(map(str, places[0]))
    what = "pairs of laser and sensor points" if capture.scan.kind == "exhaustive" else "points"
    raise UnitError(
        f"{who}: expected finite light, got NaN or infinity at {len(places)} of {dead.numel()} {what}, the first at "
        f"[{first}]. Put the mean of its neighbours in the place of a dead point, or leave it out: Scan.points takes "
        "those that are left, and fbp their light."
    )


def sum_bins(capture: Capture, number: int) -> Capture:
    """Add up neighbouring bins; bins left over at the record's end are dropped.

    Args:
        capture: capture with a transient; phasors beside it stay.
        number: number of bins in a sum.

    Returns:
        Capture; counts stay whole (int64), half precision becomes float32.

    Raises:
        ShapeError: without a transient and for more bins than there are.
        SceneError: for other numbers.
    """
    number = count("sum_bins: number", number)
    transient, axis = checked_capture(capture, "sum_bins")
    if number == 1:
        return capture
    bins = axis.num_bins // number
    if bins < 1:
        raise ShapeError(f"sum_bins: expected {axis.num_bins} bins at most, got {number}.")
    dim = transient.ndim - len(capture.scan.shape) - 1
    together = summed(transient.narrow(dim, 0, bins * number).unflatten(dim, (bins, number)), dim + 1)  # type: ignore[no-untyped-call]
    return replace(capture, transient=together, axis=TimeAxis(axis.start_opl, axis.bin_width_opl * number, bins))


def without_slab(capture: Capture, thickness: float, snr: float) -> Capture:
    """Remove the foam slab on the wall of a confocal capture by :class:`DiffusionDeconvolution`.

    The foam is that of Lindell and Wetzstein (2020). Intensities below zero become zero, the other Stokes components
    stay.

    Args:
        capture: confocal capture of a flat wall.
        thickness: thickness of the slab, metres.
        snr: signal-to-noise power ratio of the Wiener filter, see :class:`DiffusionDeconvolution`.

    Returns:
        Capture without legs, in double precision where the capture is, else in single.

    Raises:
        ShapeError, UnitError: as :class:`DiffusionDeconvolution`, and for light that is not finite.
    """
    capture = subtract_legs(capture)
    transient, axis = checked_capture(capture, "without_slab")
    _checked_light(capture, "without_slab")
    # The Wiener filter works at the brightness of the data; float64 keeps what the slab lost.
    slab = DiffusionDeconvolution(capture.scan, time_axis=axis, thickness=thickness, snr=snr, dtype=torch.float64)
    clear = slab.to(transient.device).reconstruct(transient.double())
    if capture.polarized:
        stokes = -len(capture.scan.shape) - 3
        intensity, others = clear.split((1, 3), stokes)  # type: ignore[no-untyped-call]
        clear = torch.cat([intensity.clamp_min(0), others], stokes)
    else:
        clear = clear.clamp_min(0)
    return replace(capture, transient=clear.to(precision_of(transient)), phasor=None, frequencies=None, steady=None)


def moved_to(capture: Capture, device: Any) -> Capture:
    """Move a capture to a device.

    Args:
        capture: capture of any kind.
        device: name of a device, or a torch.device.

    Raises:
        DeviceError: for a device that torch does not have.
    """
    try:
        return capture.to(device)
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise DeviceError(f"reconstruct: expected a device that torch has, got {shown(device)}: {reason}") from None


# Planes of a volume whose depths nobody gave, and how near the first is, as a share of the last one's depth.
MOST_PLANES, NEAREST = 64, 0.02


def reconstruct(
    capture: Capture,
    method: str | None = None,
    *,
    grid: VoxelGrid | None = None,
    depths: Numbers | None = None,
    progress: bool = True,
    **options: Any,
) -> HiddenVolume:
    """Reconstruct the hidden volume of a capture, without gradients (for those, take the operators: :class:`FK` and
    others).

    Args:
        capture: capture with a transient. First and last legs are removed where a method cannot count them; light
            before time zero, and phasors beside a transient, are left out; for polarized captures the intensity is
            used.
        method: "fk", "midpoint-fk", "lct", "directional-lct", "bp", "fbp", "phasor"; None takes the one that suits the
            scan, with the reason in ``metadata["reason"]``. For confocal grids that is f-k, which bears background: a
            light-cone transform is as good or better where background has been taken off, phasor fields where there are
            few photons.
        grid: voxels of bp, fbp and phasor, None for :func:`default_grid`; the other methods have a plane for each bin
            and a voxel behind each point.
        depths: (near, far) to look at, metres; planes of the other methods outside of it are left out.
        progress: show a bar.
        options: ``target``, ``floor``, ``taps`` (fk, midpoint-fk), ``target``, ``snr``, ``v_bins`` (lct,
            directional-lct), ``taper`` (directional-lct), ``falloff`` (bp, fbp, phasor), ``wavelength`` in metres, None
            for the shortest without ghosts, and ``cycles`` (fbp, phasor), ``filter`` "phasor" or "laplacian" (fbp),
            ``camera`` (phasor).

    Returns:
        Values, grid, method and settings; times of a film; directions of methods that find normals.

    Raises:
        ArgumentError: for a method or an option that does not fit the capture or each other.
        StorageError: for a volume beyond the memory.
        ShapeError, UnitError: as the operators.
    """
    _, axis = checked_capture(capture, "reconstruct")
    choice = choose_method(capture) if method is None else Choice(method, "asked for")
    entry = check_method(choice.name, capture)
    options = {name: value for name, value in options.items() if value is not None}
    _check_options(choice.name, entry.options, options)
    if grid is not None and (depths is not None or not entry.free_grid):
        why = "it says its depths itself; leave one of them out" if entry.free_grid else "its voxels are its own"
        raise ArgumentError(f"reconstruct: method '{choice.name}' takes no grid= here: {why}.")
    check_proportions(capture.scan, axis, "reconstruct")
    capture = _checked_light(_intensities(capture), "reconstruct")
    if not entry.takes_legs:
        capture = _from_zero(subtract_legs(capture))
    _, axis = checked_capture(capture, "reconstruct")
    near_far = None if depths is None else _checked_depths(depths)
    with torch.no_grad():
        if entry.free_grid:
            voxels = default_grid(capture, depths=near_far) if grid is None else grid
            check_reach(capture.scan, voxels, axis, "reconstruct", seen=True)
            check_volume_fits(choice.name, capture, voxels, options)
            values, directions, times, used = _on_grid(choice.name, capture, voxels, options, progress)
        else:
            check_volume_fits(choice.name, capture, None, options)
            values, directions, voxels = _on_own_grid(choice.name, capture, near_far, options, progress)
            times, used = None, options
    metadata = {"reason": choice.reason, "settings": _settings(entry, used, axis)}
    return HiddenVolume(values, voxels, choice.name, metadata=metadata, times=times, directions=directions)


def default_grid(
    capture: Capture,
    *,
    depths: Numbers | None = None,
    size: int | Sequence[int] | None = None,
    extent: float | Numbers | None = None,
    planes: int | None = None,
) -> VoxelGrid:
    """Make voxels before the wall of a capture.

    Args:
        capture: capture with a transient.
        depths: (near, far) in metres, None for all that a record reaches.
        size, extent: (X, Y) voxels and (width, height) in metres, see `VoxelGrid.before`.
        planes: number of planes between the depths, None for one a bin and 64 at most.

    Raises:
        ShapeError, UnitError: as `VoxelGrid.before`, and for phasors alone.
        SceneError: for other numbers of planes, and where sensor points on one line say nothing of an ``extent``.
    """
    _, axis = checked_capture(capture, "default_grid")
    legs = float(capture.scan.legs.detach().min()) if capture.scan.first_and_last_leg else 0.0
    far = (axis.end_opl - legs) / 2
    if depths is None:
        if far <= 0:
            raise UnitError(
                f"reconstruct: expected a record that is longer than its legs, {legs:.4g} m, got {axis.end_opl:.4g} m."
            )
        near = max((axis.start_opl - legs) / 2, NEAREST * far)
    else:
        near, far = _checked_depths(depths)
    if planes is None:
        # Depths that are whole bins to rounding are as many planes.
        planes = max(2, min(MOST_PLANES, math.ceil((far - near) / (axis.bin_width_opl / 2) - 1e-6)))
    planes = count("reconstruct: planes", planes)
    middles = near + (far - near) * (torch.arange(planes, dtype=torch.float64, device="cpu") + 0.5) / planes
    if size is None and not is_planar(capture.scan):
        # As many as points: of a curved wall's grid, or of the square that a list of them would fill.
        shape = capture.scan.sensor_shape
        size = tuple(reversed(shape)) if len(shape) == 2 else math.ceil(math.sqrt(math.prod(shape)))
    return VoxelGrid.before(capture.scan, middles, size=size, extent=extent)


def _checked_depths(depths: Any) -> tuple[float, float]:
    """Return (near, far), metres, 0 <= near < far. Raises UnitError for other values."""
    plain = real_array(depths)
    if plain is None or plain.shape != (2,):
        raise UnitError(f"reconstruct: expected depths as (near, far) in metres, got {shown(depths)}.")
    near, far = (finite("reconstruct: depths", value) for value in plain)
    if not 0 <= near < far:
        raise UnitError(f"reconstruct: expected depths with 0 <= near < far in metres, got {near:g} to {far:g}.")
    return near, far


def normals_of(volume: HiddenVolume) -> Tensor:
    """Return unit normals where a volume with directions is brightest behind each pixel.

    Args:
        volume: volume with directions; of a batch the first item, summed over its channels.

    Returns:
        (3, Y, X) in world coordinates.

    Raises:
        ShapeError: for a volume without directions.
    """
    if volume.directions is None:
        raise ShapeError(
            f"normals_of: expected a volume with directions (method directional-lct), got one by {volume.method}."
        )
    vectors = volume.directions
    while vectors.ndim > 5:
        vectors = vectors[0]
    vectors = vectors.sum(0)
    index = vectors.norm(dim=0).argmax(0).expand(3, 1, *vectors.shape[-2:])
    brightest: Tensor = vectors.gather(1, index)[:, 0]
    length: Tensor = brightest.norm(dim=0)
    return brightest / length.clamp_min(torch.finfo(brightest.dtype).tiny)


# ------------------------------------------------------------------------------------------------------------- parts


def _check_options(name: str, known: Iterable[str], options: dict[str, Any]) -> None:
    for option in options:
        if option not in known:
            raise ArgumentError(
                f"reconstruct: method '{name}' has no {option}=, it takes {', '.join(f'{n}=' for n in known)}."
            )
    if "filter" in options:
        one_of("reconstruct: filter", options["filter"], FILTERS)
    if options.get("filter") == "laplacian" and ("wavelength" in options or "cycles" in options):
        raise ArgumentError(
            "reconstruct: wavelength= and cycles= have no meaning for filter='laplacian'. Leave them out."
        )


def _settings(entry: Method, used: dict[str, Any], axis: TimeAxis) -> dict[str, Any]:
    """Return all options that a method has, defaults too, as plain data."""
    found = {**entry.options, **used}
    if "v_bins" in found and found["v_bins"] is None:
        found["v_bins"] = axis.num_bins
    if "camera" in found and found["camera"] is None:
        found["camera"] = DirectLight()
    if found.get("filter") == "laplacian":
        found = {name: value for name, value in found.items() if name not in ("wavelength", "cycles")}
        found["sigma"] = LaplacianFilter().sigma
    return {name: value if isinstance(value, int | float | str) else repr(value) for name, value in found.items()}


def _intensities(capture: Capture) -> Capture:
    transient, _ = checked_capture(capture, "reconstruct")
    if capture.polarized:
        transient = transient.select(-len(capture.scan.shape) - 3, 0)
    return replace(capture, transient=transient, steady=None, polarized=False, phasor=None, frequencies=None)


def _from_zero(capture: Capture) -> Capture:
    """Without the bins that begin before time zero."""
    _, axis = checked_capture(capture, "reconstruct")
    early = math.ceil(-axis.start_opl / axis.bin_width_opl - 1e-6)
    if early < 1:
        return capture
    if early >= axis.num_bins:
        raise UnitError(f"reconstruct: expected light after time zero, got {axis}. Does the record begin too early?")
    return capture.crop(axis.start_opl + early * axis.bin_width_opl, axis.end_opl)


def _bar(total: int, progress: bool) -> Any:
    from tqdm.auto import tqdm

    return tqdm(total=total, desc="volume", disable=not progress)


def _on_own_grid(
    name: str, capture: Capture, depths: tuple[float, float] | None, options: dict[str, Any], progress: bool
) -> tuple[Tensor, Tensor | None, VoxelGrid]:
    """By a method with a plane for each bin, a channel at a time, all by one operator."""
    kinds: dict[str, Callable[..., Any]] = {
        "fk": FK, "midpoint-fk": MidpointFK, "lct": LCT, "directional-lct": DirectionalLCT,
    }  # fmt: skip
    transient, axis = checked_capture(capture, "reconstruct")
    dim = transient.ndim - len(capture.scan.shape) - 2
    found, z = [], axis.centers_opl / 2
    seen = torch.ones_like(z, dtype=torch.bool) if depths is None else (z >= depths[0]) & (z <= depths[1])
    if not bool(seen.any()):
        raise UnitError(f"reconstruct: expected depths within the record's, {float(z[0]):.4g} to {float(z[-1]):.4g} m.")
    kept = seen.nonzero()[:, 0]
    operator = kinds[name](capture.scan, time_axis=axis, dtype=precision_of(transient), **options).to(transient.device)
    with _bar(transient.shape[dim], progress) as bar:
        for channel in range(transient.shape[dim]):
            one = replace(capture, transient=transient.narrow(dim, channel, 1), channels=())
            found.append(operator.reconstruct(one).index_select(-3, kept.to(transient.device)))
            bar.update()
    grid = operator.grid.at_depths(z[kept])
    together = torch.cat(found, dim)
    return (together.norm(dim=-4), together, grid) if name == "directional-lct" else (together, None, grid)


def _on_grid(
    name: str, capture: Capture, grid: VoxelGrid, options: dict[str, Any], progress: bool
) -> tuple[Tensor, Tensor | None, Tensor | None, dict[str, Any]]:
    """By a method that takes any planes, some of them at a time."""
    transient, axis = checked_capture(capture, "reconstruct")
    used = dict(options)
    laplacian = used.get("filter") == "laplacian"
    if laplacian:
        LaplacianFilter().check(grid, axis.bin_width_opl, "reconstruct")
    elif name != "bp":
        wavelength = used.setdefault("wavelength", default_wavelength(capture))
        check_wavelength(positive("reconstruct: wavelength", wavelength), capture.scan, axis, "reconstruct")
    make = _maker(name, capture, used)
    found = []
    # Phasor fields share their spectra over all planes; backprojection takes a step of the bar for some of them.
    at_once = len(grid.depths) if name == "phasor" else AT_ONCE
    with _bar(len(grid.depths), progress) as bar:
        for first in range(0, len(grid.depths), at_once):
            part = grid.depths[first : first + at_once]
            found.append(make(grid.at_depths(part)).to(transient.device).reconstruct(capture))
            bar.update(len(part))
    values = torch.cat(found, -3)
    if laplacian:
        negative_laplacian = LaplacianFilter()
        values = negative_laplacian.image(negative_laplacian.volume(values))
    camera = used.get("camera", DirectLight())
    return values, None, camera.times, used


def _maker(name: str, capture: Capture, options: dict[str, Any]) -> Callable[[VoxelGrid], Any]:
    """The operator of a method on some planes."""
    transient, axis = checked_capture(capture, "reconstruct")
    common = {"time_axis": axis, "falloff": options.get("falloff", 0.0), "dtype": precision_of(transient)}
    if name == "bp" or options.get("filter") == "laplacian":
        return lambda grid: Backprojection(capture.scan, grid, **common)
    pulse = PhasorFilter(options["wavelength"], options.get("cycles", 4.0))
    if name == "fbp":
        return lambda grid: FilteredBackprojection(capture.scan, grid, filter=pulse, **common)
    camera = options.get("camera")
    return lambda grid: PhasorField(capture.scan, grid, pulse=pulse, camera=camera, **common)


def camera_of(name: str, times: tuple[float, float, int] | None) -> DirectLight | ConfocalCamera | TransientCamera:
    """Return a virtual camera by its name.

    Args:
        name: "direct", "confocal" or "transient".
        times: times of the frames for "confocal" and "transient", (start, stop, count), metres.

    Raises:
        UnitError: for times that are not finite.
    """
    if name == "direct":
        return DirectLight()
    assert times is not None  # the command has asked for them
    start, stop, frames = times
    moments = torch.linspace(start, stop, count("reconstruct: times", frames), dtype=torch.float64, device="cpu")
    return ConfocalCamera(moments) if name == "confocal" else TransientCamera(moments)
