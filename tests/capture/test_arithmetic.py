"""Captures of every kind of number: what is computed of them is what is computed of the same numbers in double
precision. Files hand on whole numbers of 8 bits and half precision as they are.
"""

from __future__ import annotations

import numpy as np
import torch

from support.sweeps import together
from torchtransient import vis
from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan, Wall
from torchtransient.nlos import reconstruct, sum_bins, without_slab
from torchtransient.reconstruction import subtract_legs

AXIS = TimeAxis(2.0, 0.05, 60)
WALL = Wall.plane(1.0, 1.0)
KINDS = {"confocal": {}, "single": {}, "exhaustive": {"laser_grid": (2, 1)}}
NUMBERS = (
    torch.bool, torch.uint8, torch.int8, torch.int32, torch.int64, torch.uint16, torch.uint64, torch.float16,
    torch.bfloat16, torch.float8_e5m2,
)  # fmt: skip


def scanned(kind, legs=True):
    return Scan.grid(WALL, (4, 3), kind=kind, first_and_last_leg=legs, **KINDS[kind])


def counts(scan, dtype, channels=2):
    """The highest and the lowest numbers of a type side by side (what fits 32 bits, with few digits), and zeros."""
    if dtype == torch.bool:
        low, high = 0.0, 1.0
    else:
        limits = torch.finfo(dtype) if dtype.is_floating_point else torch.iinfo(dtype)
        low, high = max(float(limits.min), -(2.0**31)), min(float(limits.max), 2.0**31) / 2
        high, low = (2.0 ** np.floor(np.log2(high)), -(2.0 ** np.floor(np.log2(-low))) if low < 0 else 0.0)
    chosen = torch.randint(3, (channels, AXIS.num_bins, *scan.shape), generator=torch.Generator().manual_seed(0))
    return torch.tensor([low, 0.0, high], dtype=torch.float64)[chosen].to(dtype)


FUNCTIONS = {
    "subtract_legs": lambda c: subtract_legs(c).transient,
    "sum_bins": lambda c: sum_bins(c, 7).transient,
    "total": Capture.total,
    "peak_time": Capture.peak_time,
}


@together("dtype", NUMBERS)
@together("name", FUNCTIONS)
def test_numbers_of_every_kind(name, dtype):
    for kind in ("confocal", "exhaustive"):
        scan = scanned(kind)
        given = counts(scan, dtype)
        found = FUNCTIONS[name](Capture(given, AXIS, scan))
        expected = FUNCTIONS[name](Capture(given.double(), AXIS, scan))
        assert found.dtype in (torch.float32, torch.float64, torch.int64)
        scale = 1e-6 * float(torch.nan_to_num(expected).abs().max())
        torch.testing.assert_close(found.double(), expected, rtol=1e-6, atol=scale, equal_nan=True)


def test_sums_of_counts_stay_whole():
    """Against Python's whole numbers, beyond the digits of any float."""
    scan = scanned("single")
    given = torch.full((1, AXIS.num_bins, *scan.shape), 2**53 + 1, dtype=torch.int64)
    assert int(Capture(given, AXIS, scan).total()[0, 0, 0]) == 60 * (2**53 + 1)
    assert int(sum_bins(Capture(given, AXIS, scan), 3).transient[0, 0, 0, 0]) == 3 * (2**53 + 1)


def test_legs_are_taken_off_counts_as_linear_interpolation_does():
    scan = scanned("confocal")
    given = (torch.rand(1, 60, 3, 4, generator=torch.Generator().manual_seed(1)) * 255).to(torch.uint8)
    found = subtract_legs(Capture(given, AXIS, scan))
    for y, x in ((0, 0), (2, 1)):
        expected = np.interp(
            found.axis.centers_opl.numpy() + float(scan.legs[y, x]),
            np.concatenate([[AXIS.start_opl - 0.025], AXIS.centers_opl.numpy(), [AXIS.end_opl + 0.025]]),
            np.concatenate([[0.0], given[0, :, y, x].double().numpy(), [0.0]]),
        )
        np.testing.assert_allclose(found.transient[0, :, y, x].numpy(), expected, atol=1e-4)


def test_volumes_and_pictures_of_counts():
    scan = scanned("confocal")
    given = counts(scan, torch.uint8, channels=1)
    capture, precise = (Capture(t, AXIS, scan) for t in (given, given.float()))
    for method in ("fk", "bp", "phasor"):
        torch.testing.assert_close(reconstruct(capture, method).values, reconstruct(precise, method).values)
    vis.transients_grid(capture, rows=1, columns=1)
    vis.peak_time_picture(capture)


def test_polarized_light_behind_a_slab_keeps_its_signs():
    """The slab is linear: it makes of -Q what it makes of Q with the other sign. Intensities alone are not negative."""
    scan = scanned("confocal", legs=False)
    light = torch.rand(1, 60, 3, 4, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    for dtype in (torch.float32, torch.float64):
        t = light.to(dtype)
        stokes = without_slab(Capture(torch.stack([t, t, -t, 0 * t]), AXIS, scan, polarized=True), 0.0254, 1e3)
        assert stokes.transient.dtype == dtype
        s0, q, u, v = stokes.transient
        assert float(q.min()) < 0 and torch.equal(u, -q) and torch.equal(s0, q.clamp_min(0)) and not bool(v.any())
        alone = without_slab(Capture(t, AXIS, scan), 0.0254, 1e3).transient
        assert torch.equal(alone, s0) and alone.dtype == dtype
