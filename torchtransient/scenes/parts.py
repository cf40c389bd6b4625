"""The pieces that every scene dictionary of this room is made of: film, sensor, integrator, surface."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from torchtransient.checks import Numbers, count, finite, positive, shares, shown, text
from torchtransient.errors import ArgumentError, SceneError
from torchtransient.scenes.transforms import Matrix

SceneDict = dict[str, Any]


def transient_film(
    resolution: int | tuple[int, int], num_bins: int, start_opl: float, bin_width_opl: float
) -> SceneDict:
    """A `transient_hdr_film` with a box reconstruction filter.

    `resolution` is one side of a square film or (width, height) in pixels; `start_opl` and `bin_width_opl` are metres
    of optical path length. Raises SceneError or UnitError for sizes below one, a width of zero or a start that is not
    finite.
    """
    given: Any = resolution
    array = getattr(given, "ndim", None)
    several = array != 0 and isinstance(given, Iterable) and not isinstance(given, (str, bytes))
    sides = list(given) if several else [given, given]
    if len(sides) != 2:
        raise SceneError(f"resolution: expected one side in pixels or (width, height), got {shown(resolution)}.")
    width, height = sides
    return {
        "type": "transient_hdr_film",
        "width": count("resolution", width),
        "height": count("resolution", height),
        "rfilter": {"type": "box"},
        "temporal_bins": count("num_bins", num_bins),
        "start_opl": finite("start_opl", start_opl),
        "bin_width_opl": positive("bin_width_opl", bin_width_opl),
    }


def perspective(
    to_world: Matrix, fov: float, film: SceneDict, spp: int, sampler: str = "independent", near_clip: float = 1e-3
) -> SceneDict:
    """A pinhole camera; `fov` in degrees along the smaller side of the film, `near_clip` in metres, `spp` samples per
    pixel."""
    return {
        "type": "perspective",
        "fov_axis": "smaller",
        "fov": positive("fov", fov),
        "near_clip": positive("near_clip", near_clip),
        "far_clip": 100.0,
        "to_world": to_world,
        "sampler": {
            "type": text("sampler", sampler, "the plugin name of a sampler"),
            "sample_count": count("spp", spp),
        },
        "film": film,
    }


def transient_path(max_depth: int, rr_depth: int | None = None) -> SceneDict:
    """The integrator `transient_path`; `max_depth` counts segments as Mitsuba does, -1 for no limit.

    `rr_depth=None` keeps the plugin's own start of Russian roulette.
    """
    integrator: SceneDict = {"type": "transient_path", "max_depth": checked_depth(max_depth)}
    if rr_depth is not None:
        integrator["rr_depth"] = count("rr_depth", rr_depth)
    return integrator


def checked_depth(max_depth: int) -> int:
    """Segments of the longest path. Raises ArgumentError unless it is a whole number, -1 for no limit."""
    return count("max_depth", max_depth, -1, ArgumentError)


def diffuse(reflectance: float | Numbers) -> SceneDict:
    """A Lambertian BSDF; one albedo for all wavelengths or three, linear sRGB. Raises UnitError outside of [0, 1]."""
    albedo = shares("albedo or reflectance", reflectance)
    value = {"type": "rgb", "value": list(albedo)} if isinstance(albedo, tuple) else albedo
    return {"type": "diffuse", "reflectance": value}
