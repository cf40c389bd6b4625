"""What `reconstruct` and the operators refuse before they compute: units that are off, light that is none, volumes that
do not fit; and that the settings of a volume are all told.
"""

from __future__ import annotations

import inspect
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from torchtransient.errors import StorageError, TorchTransientError, UnitError
from torchtransient.volume_methods import METHODS

N = tt.nlos
AXIS = tt.TimeAxis(0.0, 0.02, 64)
OPERATORS = {
    "fk": N.FK, "midpoint-fk": N.MidpointFK, "lct": N.LCT, "directional-lct": N.DirectionalLCT,
    "bp": N.Backprojection, "fbp": N.FilteredBackprojection, "phasor": N.PhasorField,
}  # fmt: skip
every = pytest.mark.parametrize("name", METHODS)
# What is wrong, as factors of a wall of 1 m, and time axes.
SIZES = {
    "a wall in millimetres": (600.0, AXIS),
    "a wall in kilometres": (6e-4, AXIS),
    "bins in seconds": (1.0, tt.TimeAxis(0.0, 250e-9, 64)),
    "bins of picoseconds taken for seconds": (1.0, tt.TimeAxis(0.0, tt.units.seconds_to_opl(16.0), 64)),
    "a start in picoseconds, early": (1.0, tt.TimeAxis(-100 * tt.units.SPEED_OF_LIGHT, 5e-3, 64)),
    "a start in picoseconds, late": (1.0, tt.TimeAxis(100 * tt.units.SPEED_OF_LIGHT, 0.5, 64)),
}


def scanned(name, side=1.0, size=6):
    kind = "single" if name == "midpoint-fk" else "confocal"
    return N.Scan.grid(N.Wall.plane(side, side), size, kind=kind)


def captured(name, side=1.0, axis=AXIS, dtype=torch.float32):
    scan = scanned(name, side)
    light = torch.rand(1, axis.num_bins, *scan.shape, generator=torch.Generator().manual_seed(0), dtype=dtype)
    return N.Capture(light, axis, scan)


def made(name, scan, axis, depths=(0.3, 0.4), pulse=0.4):
    """The operator of a method."""
    filters = {"fbp": {"filter": N.PhasorFilter(pulse)}, "phasor": {"pulse": N.PhasorFilter(pulse)}}
    points = [N.VoxelGrid.before(scan, depths)] if METHODS[name].free_grid else []
    return OPERATORS[name](scan, *points, time_axis=axis, **filters.get(name, {}))


@every
@together("wrong", SIZES)
def test_units_that_are_off_are_told(name, wrong):
    side, axis = SIZES[wrong]
    with pytest.raises(UnitError, match=r"metres|first bin begin"):
        N.reconstruct(captured(name, side, axis), name, progress=False)
    with pytest.raises(UnitError, match=r"metres|first bin begin|two bins at least"):
        made(name, scanned(name, side), axis)


@every
@pytest.mark.parametrize("depths", [(300.0, 900.0), (1.5, 2.0)])
def test_depths_beyond_the_record_are_told(name, depths):
    with pytest.raises(UnitError, match="within the record"):
        N.reconstruct(captured(name), name, depths=depths, progress=False)
    if METHODS[name].free_grid and depths[0] > 10:
        with pytest.raises(UnitError, match="within the record"):
            made(name, scanned(name), AXIS, depths)


@pytest.mark.parametrize("name", ["bp", "fbp"])
def test_extents_and_points_out_of_proportion_are_told(name):
    grid = N.default_grid(captured(name), extent=600.0, depths=(0.3, 0.6), size=4)
    with pytest.raises(UnitError, match="within the record"):
        N.reconstruct(captured(name), name, grid=grid, progress=False)
    with pytest.raises(UnitError, match="within the record"):
        N.Backprojection(scanned(name), torch.tensor([[0.0, 0.0, 0.5], [0.0, 300.0, 0.5]]), time_axis=AXIS)
    near = N.VoxelGrid.before(scanned(name), [0.01, 0.02])
    late = N.Capture(torch.rand(1, 64, 6, 6), replace(AXIS, start_opl=3.5), scanned(name))
    with pytest.raises(UnitError, match="within the record"):
        N.reconstruct(late, name, grid=near, progress=False)


@pytest.mark.parametrize("name", [name for name, entry in METHODS.items() if "wavelength" in entry.options])
def test_wavelengths_longer_than_the_record_are_told(name):
    with pytest.raises(UnitError, match="wavelength"):
        N.reconstruct(captured(name), name, wavelength=60.0, progress=False)
    with pytest.raises(UnitError, match="wavelength"):
        made(name, scanned(name), AXIS, pulse=1.3)


def test_slabs_in_other_units_are_told():
    with pytest.raises(UnitError, match="a slab in metres"):
        N.without_slab(captured("fk"), 2 * 2.54, 1e3)


def test_unusual_scans_pass():
    """One point, a wide wall before a short record, a record that begins late, planes beyond its end."""
    one = N.Scan.points(torch.zeros(1, 3), kind="confocal", sensor_origin=(0, 0, 1.0), laser_origin=(0, 0, 1.0))
    N.Backprojection(one, torch.tensor([[0.0, 0.0, 0.5]]), time_axis=AXIS)
    N.FK(scanned("fk", 8.0), time_axis=AXIS)
    N.FK(scanned("fk", 0.05), time_axis=AXIS)
    N.Backprojection(scanned("bp"), torch.tensor([[0.0, 0.0, 5.0]]), time_axis=AXIS)
    N.reconstruct(captured("bp"), "bp", depths=(0.3, 5.0), progress=False)
    N.FK(scanned("fk"), time_axis=replace(AXIS, start_opl=100.0))
    for start in (100.0, -3.0):
        N.Backprojection(scanned("bp"), torch.tensor([[0.0, 0.0, 0.5]]), time_axis=replace(AXIS, start_opl=start))


@every
def test_dead_points_are_counted(name):
    capture = captured(name)
    light = capture.transient.clone()
    light[0, 3, 2, 4], light[0, :, 5, 1] = torch.nan, torch.inf
    broken = replace(capture, transient=light)
    with pytest.raises(UnitError, match=r"at 2 of 36 points, the first at \[2, 4\].*neighbours"):
        N.reconstruct(broken, name, progress=False)
    if METHODS[name].kinds == ("confocal",):
        with pytest.raises(UnitError, match="without_slab: expected finite light"):
            N.without_slab(broken, 0.02, 1e3)
    pairs = N.Scan.grid(N.Wall.plane(1.0, 1.0), 4, kind="exhaustive", laser_grid=2)
    light = torch.rand(2, 1, 64, *pairs.shape)
    light[1, 0, 0, 1, 0, 3, 2] = -torch.inf
    with pytest.raises(UnitError, match=r"at 1 of 64 pairs of laser and sensor points, the first at \[1, 0, 3, 2\]"):
        N.reconstruct(N.Capture(light, AXIS, pairs), progress=False)


def test_dead_points_may_be_left_out_or_filled():
    """As docs/nlos_reconstruction.md says."""
    capture = captured("bp")
    light, scan = capture.transient.clone(), capture.scan
    light[0, :, 2, 4] = torch.nan
    alive = torch.isfinite(light).all(1)[0]
    left = N.Scan.points(
        scan.sensor_points[alive], kind="confocal", sensor_origin=scan.sensor_origin, laser_origin=scan.laser_origin
    )
    grid = N.VoxelGrid.before(scan, [0.3, 0.4])
    found = N.reconstruct(N.Capture(light[..., alive], AXIS, left), "bp", grid=grid, progress=False)
    dark = replace(capture, transient=torch.nan_to_num(light, nan=0.0))
    torch.testing.assert_close(found.values, N.reconstruct(dark, "bp", grid=grid, progress=False).values)


@every
def test_all_settings_are_told(name):
    settings = N.reconstruct(captured(name), name, depths=(0.3, 0.6), progress=False).metadata["settings"]
    assert set(settings) == set(METHODS[name].options)
    assert None not in settings.values() and "None" not in settings.values()
    again = N.reconstruct(
        captured(name), name, depths=(0.3, 0.6), progress=False,
        **{option: value for option, value in settings.items() if option != "camera"},
    )  # fmt: skip
    assert again.metadata["settings"] == settings


@every
def test_options_of_other_kinds_have_typed_errors(name):
    for option in METHODS[name].options.keys() - {"camera"}:
        with pytest.raises(TorchTransientError):
            N.reconstruct(captured(name), name, progress=False, **{option: object()})


def test_settings_of_the_laplacian():
    found = N.reconstruct(captured("fbp"), "fbp", depths=(0.3, 0.6), filter="laplacian", progress=False)
    assert found.metadata["settings"] == {"falloff": 0.0, "filter": "laplacian", "sigma": 1.0}


@every
def test_defaults_that_are_told_are_those_of_the_operators(name):
    parameters, pulse = (inspect.signature(kind).parameters for kind in (OPERATORS[name], N.PhasorFilter))
    for option, default in METHODS[name].options.items():
        if option not in ("wavelength", "filter"):
            assert (pulse if option == "cycles" else parameters)[option].default == default, option


@every
def test_volumes_that_do_not_fit_are_refused(name, monkeypatch):
    capture = captured(name)
    grid = N.default_grid(capture) if METHODS[name].free_grid else None
    needed = N.methods.least_bytes(name, capture, grid, {})
    assert needed > 4 * 64 * 36
    for there, error in ((needed - 1, StorageError), (needed, None)):
        monkeypatch.setattr(N.methods, "available_bytes", lambda variant, there=there: there)
        with pytest.raises(error, match=f"'{name}' would take .* at least") if error else nullcontext():
            N.reconstruct(capture, name, progress=False)


def test_a_volume_of_terabytes_is_refused_at_once():
    capture = captured("bp")
    grid = N.VoxelGrid.before(capture.scan, torch.linspace(0.1, 0.6, 9000), size=9000, extent=1.0)
    for name in ("bp", "fbp"):
        with pytest.raises(StorageError, match="TiB at least for 9000 x 9000 x 9000"):
            N.reconstruct(capture, name, grid=grid, progress=False)
