"""Sensors from descriptions and from parts: every public kind, errors that are typed, numbers of any make."""

from __future__ import annotations

import inspect
import json

import pytest
import torch
from torch import nn

from torchtransient import TimeAxis, sensing
from torchtransient.errors import StorageError, UnitError
from torchtransient.sensing import Device, build_stage
from torchtransient.sensing.devices import KINDS

NS = 1e-9
AXIS = TimeAxis.from_seconds(0.0, 1e-10, 32)
BASES = {"AddedCounts", "AfterpulseDelays", "CorrelationCode", "MovedCounts", "RandomSensor", "Response", "Sensor"}


def tensor(values):
    return {"kind": "tensor", "values": values}


def budget(rate_hz=1e6, **given):
    numbers = {"pulse_energy_j": 1e-10, "wavelength_m": 9e-7, "repetition_rate_hz": rate_hz, "cycles": 1000}
    return sensing.PhotonBudget(sensing.Optics(f_number=2.0), axis=AXIS, **numbers, **given)


# ------------------------------------------------------------------------------------------------------ kinds


def test_every_public_part_of_a_chain_is_a_kind():
    kinds = (sensing.Sensor, sensing.Response, sensing.CorrelationCode, sensing.AfterpulseDelays, sensing.Optics)
    public = {n for n, c in vars(sensing).items() if inspect.isclass(c) and issubclass(c, kinds)}
    makers = {n for n in vars(sensing) if n.endswith(("_code", "_codes", "_psf", "_analysers"))}
    makers = {n for n in makers if inspect.isfunction(getattr(sensing, n)) and n != "decode_code"}
    assert public - BASES <= set(KINDS)
    assert makers | {"ambient_photon_rate", "hot_pixel_rates"} <= set(KINDS)


BUILT = {
    "gaussian_psf": ({"kind": "gaussian_psf", "fwhm_px": 1.5, "size": 5}, (5, 5)),
    "defocus_psf": ({"kind": "defocus_psf", "radius_px": 1.2}, (3, 3)),
    "hot_pixel_rates": ({"kind": "hot_pixel_rates", "height": 3, "width": 4, "median_hz": 50.0, "seed": 3}, (3, 4)),
    "circular_analyzers": ({"kind": "circular_analyzers", "transmission": 0.9}, (2, 4)),
    "ambient_photon_rate": (
        {
            "kind": "ambient_photon_rate",
            "optics": {"kind": "Optics", "f_number": 2.0},
            "albedo": tensor([[0.5, 1.0]]),
            "spectral_irradiance_w_m2_nm": 0.9,
            "filter_bandwidth_m": 1e-8,
            "wavelength_m": 9e-7,
        },
        (1, 2),
    ),
}


@pytest.mark.parametrize("spec, shape", BUILT.values(), ids=BUILT)
def test_maps_of_descriptions(spec, shape):
    made = build_stage(json.loads(json.dumps(spec)))
    assert tuple(made.shape) == shape and made.dtype == torch.float64 and bool(made.isfinite().all())
    torch.testing.assert_close(made, build_stage(spec))


def test_codes_of_descriptions():
    lines = {"kind": "PiecewiseLinearCode", "knots": tensor([[0.0, 0.5]] * 2), "values": tensor([[1.0, -1.0]] * 2)}
    assert isinstance(build_stage(lines), sensing.PiecewiseLinearCode)
    gates = {"kind": "binary_code", "light_duty": 0.5, "gates": [[[0.0, 0.5]], [[0.5, 1.0]]]}
    assert isinstance(build_stage(gates), sensing.PiecewiseLinearCode)


def test_a_map_of_values_and_of_chains():
    """A dead time for every pixel, and a chain for every kind of pixel."""
    dead = [[1 * NS, 2 * NS], [2 * NS, 1 * NS]]
    spad = {"kind": "SynchronousSPAD", "cycles": 1000, "dead_time_s": "@value", "axis": "@axis"}
    stage = {"kind": "PixelGroups.by_value", "values": tensor(dead), "make": spad}
    device = Device("d", description="", sources=("assumed: all",), stages=(stage,), bin_width_s=1e-10, num_bins=32)
    assert Device.from_json(device.to_json()) == device
    x = torch.full((1, 1, 32, 2, 2), 0.05)
    alone = sensing.SynchronousSPAD(1000, dead_time_s=2 * NS, axis=AXIS).expected(x[..., :1, :1])
    torch.testing.assert_close(device.sensor().expected(x)[..., :1, 1:], alone)
    chain = {"kind": "Compose", "stages": [{**spad, "dead_time_s": 2 * NS}]}
    groups = {"kind": "PixelGroups", "sensors": [chain, chain], "which": tensor([[0, 1], [1, 0]])}
    torch.testing.assert_close(build_stage(groups, AXIS).expected(x)[..., :1, :1], alone)
    for wrong in (None, 3.0, {"kind": "SynchronousSPAD", "cycles": 9}):
        with pytest.raises(StorageError, match="'@value' in it"):
            build_stage({**stage, "make": wrong}, AXIS)
    with pytest.raises(StorageError, match="@value"):
        build_stage(spad, AXIS)


@pytest.mark.parametrize(
    "inside", [float("nan"), [1.0, float("inf")], [[1.0], [float("nan")]], {"a": [float("nan")]}, (float("nan"),)]
)
def test_numbers_that_are_none_are_found_everywhere(inside):
    with pytest.raises(StorageError, match="finite numbers in tensor"):
        Device(
            "d",
            description="",
            sources=(),
            stages=({"kind": "TDC", "code_widths": {"kind": "tensor", "values": inside}},),
        )


def test_unknown_kinds_are_found_in_lists():
    for inside in ([{"kind": "os.system"}], [[{"kind": "os.system"}]], {"a": {"kind": "os.system"}}):
        with pytest.raises(StorageError, match=r"os\.system"):
            Device("d", description="", sources=(), stages=({"kind": "PixelGroups", "sensors": inside, "which": 0},))


@pytest.mark.parametrize("stage", [17, -2, 1, True, 0.0, None])
def test_a_stage_that_is_not_there(stage):
    device = Device("d", description="", sources=(), stages=({"kind": "SynchronousSPAD", "cycles": 9},))
    with pytest.raises(StorageError, match="by its kind or by a number from 0 to 0"):
        device.changed(stage, cycles=10)
    assert device.changed(-1, cycles=10).stages[0]["cycles"] == 10


# ------------------------------------------------------------------------------------------------------ parts


def test_lists_of_parts():
    spad, x = sensing.SynchronousSPAD(1000), torch.full((1, 32, 4, 4), 1e-3)
    plain = sensing.counting_chain(budget(), spad, optics=None, readout=None)
    for parts in ([sensing.LensBlur(1.0)], nn.ModuleList([sensing.LensBlur(1.0)]), (sensing.LensBlur(1.0),)):
        blurred = sensing.counting_chain(budget(), spad, optics=parts)
        torch.testing.assert_close(blurred.expected(x), plain.expected(x))
    with pytest.raises(UnitError, match="average counts"):
        sensing.counting_chain(budget(), spad, readout=[sensing.LensBlur(1.0)])


# ---------------------------------------------------------------------------------------------------- numbers


class Twice(sensing.MovedCounts):
    """A plug-in: half of the counts come one bin later."""

    def expected(self, x):
        return self.moves(x).mean(x)

    def moves(self, x):
        return sensing.Moves(0, torch.tensor([0.5, 0.5], dtype=torch.float64), "periodic")


def test_bases_for_plug_ins():
    x = torch.full((1, 8, 1, 1), 4.0)
    y = sensing.Compose([Twice(grad="straight_through")])(x, generator=torch.Generator().manual_seed(0))
    assert torch.equal(y, y.round()) and float(y.sum()) == 32 and not torch.equal(y, x)
    assert issubclass(sensing.Crosstalk, sensing.AddedCounts)
    p = sensing.detections_with_dead_time(torch.full((1, 8, 1, 1), 0.1), 2.0)
    assert p.shape == (1, 8, 1, 1)
