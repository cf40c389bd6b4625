"""Parts of scene dictionaries: film, sensor, integrator, surface."""

from __future__ import annotations

from typing import Any

from torchtransient.checks import Numbers, count, finite, positive, shares
from torchtransient.errors import ArgumentError, SceneError
from torchtransient.scenes.transforms import Matrix

SceneDict = dict[str, Any]


def transient_film(
    resolution: int | tuple[int, int], num_bins: int, start_opl: float, bin_width_opl: float
) -> SceneDict:
    """Return a `transient_hdr_film` with a box reconstruction filter.

    Args:
        resolution: one side of a square film in pixels, or (width, height).
        num_bins: number of bins.
        start_opl: start of the first bin, metres of optical path.
        bin_width_opl: width of a bin, metres of optical path.

    Raises:
        SceneError, UnitError: for sizes below one, a width of zero or a start that is not finite.
    """
    sides = resolution if isinstance(resolution, tuple | list) else (resolution, resolution)
    if len(sides) != 2:
        raise SceneError(f"resolution: expected one side in pixels or (width, height), got {resolution!r}.")
    return {
        "type": "transient_hdr_film",
        "width": count("resolution", sides[0]),
        "height": count("resolution", sides[1]),
        "rfilter": {"type": "box"},
        "temporal_bins": count("num_bins", num_bins),
        "start_opl": finite("start_opl", start_opl),
        "bin_width_opl": positive("bin_width_opl", bin_width_opl),
    }


def perspective(to_world: Matrix, fov: float, film: SceneDict, spp: int, sampler: str = "independent") -> SceneDict:
    """Return a pinhole camera.

    Args:
        to_world: pose of the camera (4, 4).
        fov: angle of view along the smaller side of the film, degrees.
        film: dictionary of the film.
        spp: samples per pixel.
        sampler: plugin name of the sampler.
    """
    return {
        "type": "perspective",
        "fov_axis": "smaller",
        "fov": positive("fov", fov),
        "near_clip": 1e-3,
        "far_clip": 100.0,
        "to_world": to_world,
        "sampler": {"type": sampler, "sample_count": count("spp", spp)},
        "film": film,
    }


def transient_path(max_depth: int, rr_depth: int | None = None) -> SceneDict:
    """Return the integrator `transient_path`.

    Args:
        max_depth: segments of the longest path as Mitsuba counts them, -1 for no limit.
        rr_depth: start of Russian roulette, None for the plugin's own.
    """
    integrator: SceneDict = {"type": "transient_path", "max_depth": checked_depth(max_depth)}
    if rr_depth is not None:
        integrator["rr_depth"] = count("rr_depth", rr_depth)
    return integrator


def checked_depth(max_depth: int) -> int:
    """Return the segments of the longest path.

    Args:
        max_depth: whole number, -1 for no limit.

    Raises:
        ArgumentError: for anything else.
    """
    return count("max_depth", max_depth, -1, ArgumentError)


def diffuse(reflectance: float | Numbers) -> SceneDict:
    """Return a Lambertian BSDF.

    Args:
        reflectance: albedo, one for all wavelengths or three of linear sRGB.

    Raises:
        UnitError: outside of [0, 1].
    """
    albedo = shares("albedo or reflectance", reflectance)
    value = {"type": "rgb", "value": list(albedo)} if isinstance(albedo, tuple) else albedo
    return {"type": "diffuse", "reflectance": value}
