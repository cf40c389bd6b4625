"""Captures through a diffusing slab: against the transmittance in closed form, and letters that were measured."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from support.grid_operators import SCAN as SMALL
from support.grid_operators import confocal_points
from tools import diffusion
from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan, Wall
from torchtransient.errors import UnitError
from torchtransient.reconstruction import FK, DiffusionDeconvolution

F64 = torch.float64
SMALL_AXIS = TimeAxis(0.0, 0.02, 32)
MEASURED = Path(__file__).parents[2] / "benchmarks" / "data" / "foam_captures.npz"


def test_the_slab_keeps_light_and_delays_it_twice():
    axis = TimeAxis(0.0, 0.02, 192)
    scan = Scan.grid(Wall.plane(0.6, 0.6), 24, kind="confocal")
    flash = torch.zeros(192, 24, 24, dtype=F64)
    flash[10, 12, 12] = 1.0
    slab = DiffusionDeconvolution(scan, time_axis=axis, dtype=F64)
    spread = slab(flash)
    # A slab that lets none through at the sides keeps it; 3 per mille leave the record and the scan.
    assert float(spread.sum()) == pytest.approx(1.0, abs=3e-3)
    assert float(spread.min()) >= 0
    mean = float((spread.sum((1, 2)) * axis.centers_opl).sum() / spread.sum()) - 0.21
    scattering, absorption, index, extrapolation = slab.properties
    opl = 0.02 * np.arange(1, 192)
    once = sum(
        2 * math.pi * rho * 0.01 * diffusion.slab_transmittance(
            opl, slab.thickness, scattering, absorption, index, rho=rho, extrapolation=extrapolation
        )
        for rho in 0.005 + 0.01 * np.arange(40)
    )  # fmt: skip
    # The light that leaves record and scan is late: 3 % of the delay.
    assert mean == pytest.approx(2 * float((once * opl).sum() / once.sum()), rel=0.04)


def test_deconvolution_undoes_the_slab_up_to_noise():
    axis = TimeAxis(0.0, 0.02, 128)
    scan = Scan.grid(Wall.plane(0.6, 0.6), 20, kind="confocal")
    light = confocal_points([(0.0, 0.0, 0.6), (0.1, 0.1, 0.7)], scan, axis, sigma_bins=3.0)
    slab = DiffusionDeconvolution(scan, time_axis=axis, snr=1e8, dtype=F64)
    through = slab(light)

    def alike(x):
        return float((x * light).sum() / (x.norm() * light.norm()))

    assert alike(through) < 0.75
    assert alike(slab.reconstruct(through)) > 0.95
    weak = DiffusionDeconvolution(scan, time_axis=axis, snr=1e2, dtype=F64)
    assert alike(through) < alike(weak.reconstruct(through)) < alike(slab.reconstruct(through))


def written_out(light, thickness, pitch, width, reach):
    """Light (T, Y, X) through a slab that reaches ``reach`` points beyond the scan, each crossing in closed form."""
    bins = len(light)
    scattering, absorption, index, extrapolation = DiffusionDeconvolution(SMALL, time_axis=SMALL_AXIS).properties
    y, x = (p * np.arange(-2 * reach, 2 * reach + 1) for p in pitch)
    rho = np.sqrt(y[:, None] ** 2 + x**2)

    def flash(count):
        opl = width * np.arange(1, count)
        found = [
            diffusion.slab_transmittance(
                opl, thickness, scattering, absorption, index, rho=float(r), extrapolation=extrapolation
            )
            for r in rho.ravel()
        ]
        later = torch.from_numpy(np.stack(found, 1)).reshape(-1, *rho.shape)
        return torch.nn.functional.pad(later, (0, 0, 0, 0, 1, 0))  # nothing comes at once

    kernel = flash(bins) / flash(600).sum()
    wide = torch.nn.functional.pad(light, (reach,) * 4)
    for _ in range(2):
        late = torch.nn.functional.pad(wide, (2 * reach,) * 4 + (bins - 1, 0))
        wide = torch.nn.functional.conv3d(late[None, None], kernel.flip(0)[None, None])[0, 0]
    return wide[:, reach:-reach, reach:-reach]


@pytest.mark.parametrize("thickness", [0.0254, 0.1])
def test_crossings_are_convolutions_that_do_not_wrap(thickness):
    axis, scan = TimeAxis(0.0, 0.04, 12), Scan.grid(Wall.plane(0.4, 0.3), (4, 3), kind="confocal")
    operator = DiffusionDeconvolution(scan, time_axis=axis, thickness=thickness, dtype=F64)
    light = torch.rand(operator.data_shape, dtype=F64, generator=torch.Generator().manual_seed(0))
    expected = written_out(light, thickness, (0.1, 0.1), 0.04, 5)
    torch.testing.assert_close(operator(light), expected, rtol=0, atol=1e-11 * float(expected.max()))


def test_what_it_cannot_take_is_refused():
    for settings, message in (
        ({"thickness": 0.0}, "thickness"),
        ({"snr": -1.0}, "snr"),
        ({"properties": (262.0, -0.5, 1.1, 0.003)}, "absorption"),
        ({"properties": (1e5, 1e5, 1.1, 0.003)}, "slab thinner"),
    ):
        with pytest.raises(UnitError, match=message):
            DiffusionDeconvolution(SMALL, time_axis=SMALL_AXIS, **settings)


# ---------------------------------------------------------------------------------------- letters behind measured foam


def front_view(name):
    """All light of each place (32, 32) behind the foam; one set of parameters for every capture."""
    with np.load(MEASURED) as arrays:
        counts, size = torch.from_numpy(arrays[name].astype(np.float64)), float(arrays[f"{name}_size"])
    axis = TimeAxis.from_seconds(0.0, 48e-12, len(counts))
    scan = Scan.grid(Wall.plane(size, size), 32, kind="confocal")
    clear = DiffusionDeconvolution(scan, time_axis=axis, snr=3e3, dtype=F64).reconstruct(counts)
    volume = FK(scan, time_axis=axis, target="retroreflective", dtype=F64).reconstruct(clear)
    # The foam's own light comes first, and what the deconvolution makes of the record's end last.
    return volume[8:-16].sum(0)


@pytest.mark.slow
def test_bars_behind_foam_are_told_apart():
    picture = front_view("resolution_50")
    for row, bars in ((8, 2), (17, 3)):
        profile = picture[row - 1 : row + 2].mean(0)
        inner = profile[1:-1]
        peaks = [k + 1 for k in range(30) if inner[k] > profile[k] and inner[k] >= profile[k + 2]]
        peaks = [k for k in peaks if profile[k] > 0.4 * profile.max()]
        assert len(peaks) == bars
        for left, right in itertools.pairwise(peaks):
            low, high = float(profile[left:right].min()), float(torch.minimum(profile[left], profile[right]))
            assert (high - low) / (high + low) >= 0.2
