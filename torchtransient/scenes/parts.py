"""The pieces that every scene dictionary of this room is made of: film, sensor, integrator and checked numbers."""

from __future__ import annotations

import math
from typing import Any

from torchtransient.errors import SceneError, UnitError
from torchtransient.scenes.transforms import Matrix

SceneDict = dict[str, Any]


def positive(name: str, value: float) -> float:
    """`value` as a float; UnitError unless it is finite and greater than zero."""
    number = float(value)
    if not math.isfinite(number) or number <= 0:
        raise UnitError(f"{name}: expected a finite number greater than zero, got {value!r}")
    return number


def albedo(name: str, value: float) -> float:
    """`value` as a float; UnitError unless it lies in [0, 1]."""
    number = float(value)
    if not 0.0 <= number <= 1.0:
        raise UnitError(f"{name}: expected an albedo between 0 and 1, got {value!r}")
    return number


def count(name: str, value: int) -> int:
    """`value` as an int; SceneError unless it is a whole number of at least one."""
    if isinstance(value, bool) or int(value) != value or value < 1:
        raise SceneError(f"{name}: expected a whole number of at least 1, got {value!r}")
    return int(value)


def transient_film(
    resolution: int | tuple[int, int], num_bins: int, start_opl: float, bin_width_opl: float
) -> SceneDict:
    """A `transient_hdr_film` with a box reconstruction filter.

    `resolution` is one side of a square film or (width, height) in pixels; `start_opl` and `bin_width_opl` are metres
    of optical path length. Raises SceneError or UnitError for sizes below one, a width of zero or a start that is not
    finite.
    """
    width, height = (resolution, resolution) if isinstance(resolution, int) else resolution
    if not math.isfinite(start_opl):
        raise UnitError(f"start_opl: expected a finite length in metres, got {start_opl!r}")
    return {
        "type": "transient_hdr_film",
        "width": count("resolution", width),
        "height": count("resolution", height),
        "rfilter": {"type": "box"},
        "temporal_bins": count("num_bins", num_bins),
        "start_opl": float(start_opl),
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
        "sampler": {"type": sampler, "sample_count": count("spp", spp)},
        "film": film,
    }


def transient_path(max_depth: int, rr_depth: int | None = None) -> SceneDict:
    """The integrator `transient_path`; `max_depth` counts segments as Mitsuba does, -1 for no limit.

    `rr_depth=None` keeps the plugin's own start of Russian roulette.
    """
    if isinstance(max_depth, bool) or int(max_depth) != max_depth or max_depth < -1:
        raise SceneError(f"max_depth: expected -1 or a whole number of at least 0, got {max_depth!r}")
    integrator: SceneDict = {"type": "transient_path", "max_depth": int(max_depth)}
    if rr_depth is not None:
        integrator["rr_depth"] = count("rr_depth", rr_depth)
    return integrator


def diffuse(reflectance: float | tuple[float, float, float]) -> SceneDict:
    """A Lambertian BSDF; one albedo for all wavelengths or a linear sRGB triple."""
    if isinstance(reflectance, tuple):
        value = [albedo("reflectance", channel) for channel in reflectance]
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}
    return {"type": "diffuse", "reflectance": albedo("reflectance", reflectance)}
