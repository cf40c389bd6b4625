"""Exact captures of small things around a corner: isotropic points that light reaches as Gaussian pulses."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.checks import finite, positive, real_array, shown
from torchtransient.errors import ShapeError


def point_capture(
    scan: Scan,
    points: Any,
    *,
    time_axis: TimeAxis,
    strength: Any = 1.0,
    falloff: float = 2.0,
    pulse_sigma_opl: float | None = None,
) -> Capture:
    """The float64 capture (1, T, *scan.shape) of hidden points (N, 3), metres, by a scan of any kind.

    A point of ``strength`` a (one number or (N,)) adds a (r_laser r_sensor)^-falloff to each pair, at the length
    r_laser + r_sensor (with the legs, where the scan counts them), spread by a Gaussian of ``pulse_sigma_opl`` metres
    (None: two bins) and integrated exactly over each bin. Points are isotropic and hide nothing. Raises ShapeError and
    UnitError.
    """
    plain = real_array(points)
    if plain is None or plain.ndim != 2 or plain.shape[1] != 3:
        raise ShapeError(f"point_capture: expected points (N, 3), got {shown(points)}.")
    sigma = 2 * time_axis.bin_width_opl if pulse_sigma_opl is None else positive("pulse_sigma_opl", pulse_sigma_opl)
    given = real_array(strength)
    if given is None or given.shape not in ((), (len(plain),)):
        raise ShapeError(f"point_capture: expected one strength or {len(plain)}, got {shown(strength)}.")
    strengths = torch.from_numpy(given).expand(len(plain))
    power, edges = finite("falloff", falloff), time_axis.edges_opl
    legs = _legs(scan)
    light = torch.zeros(len(legs), time_axis.num_bins, dtype=torch.float64)
    for point, weight in zip(torch.from_numpy(plain), strengths, strict=True):
        to_spot, to_sensor = _distances(scan, point)
        share = torch.special.ndtr((edges - (to_spot + to_sensor + legs)[:, None]) / sigma).diff(dim=1)
        light += (weight * (to_spot * to_sensor) ** -power)[:, None] * share
    return Capture(light.T.reshape(1, time_axis.num_bins, *scan.shape), time_axis, scan)


def _distances(scan: Scan, point: Tensor) -> tuple[Tensor, Tensor]:
    """Distances of a point from spot and sensor point of every pair, (P,)."""
    spots, sensors = (
        torch.linalg.vector_norm(tensor.detach().cpu().reshape(-1, 3) - point, dim=-1)
        for tensor in (scan.laser_points, scan.sensor_points)
    )
    return _paired(scan, spots, sensors)


def _legs(scan: Scan) -> Tensor:
    if not scan.first_and_last_leg:
        return torch.zeros(scan.pairs, dtype=torch.float64)
    first, last = _paired(scan, *(legs.detach().cpu().reshape(-1) for legs in (scan.laser_legs, scan.sensor_legs)))
    return first + last


def _paired(scan: Scan, spots: Tensor, sensors: Tensor) -> tuple[Tensor, Tensor]:
    if scan.kind == "exhaustive":
        return spots.repeat_interleave(len(sensors)), sensors.repeat(len(spots))
    return spots.expand(len(sensors)), sensors
