"""Devices: every preset runs, round trips of their descriptions, errors of files from elsewhere; DeepInverse."""

from __future__ import annotations

import inspect
import json
import sys

import pytest
import torch

from torchtransient import TimeAxis, sensing
from torchtransient.errors import ArgumentError, MissingPackageError, StorageError, UnitError
from torchtransient.sensing import DEVICES, Device, build_stage, device, read_itof
from torchtransient.sensing.devices import KINDS

each = pytest.mark.parametrize("name", sorted(DEVICES))


def light_for(name, axis):
    g = torch.Generator().manual_seed(0)
    if name == "imx250mzr_like":
        s = 2000 * torch.rand(1, 4, 1, 1, 4, 4, generator=g) - 1000
        s[:, 0] += 3000
        return s
    x = 0.001 * torch.rand(1, 1, axis.num_bins, 4, 4, generator=g)
    x[:, :, axis.num_bins // 3] += 0.5
    return x


@each
def test_presets_measure(name):
    preset = device(name)
    axis = preset.axis() if preset.num_bins else None
    x = light_for(name, axis)
    sensor = preset.sensor(grad="straight_through")
    mean = sensor.expected(x)
    y = sensor(x, generator=torch.Generator().manual_seed(1))
    assert y.shape == mean.shape and bool(torch.isfinite(y).all())
    assert float(mean.sum()) > 0
    # The total of all pixels is known to its Poisson noise and better; read noise adds less here.
    total = float(mean.sum())
    slack = 5 * (total + 400 * mean.numel()) ** 0.5
    if name != "imx250mzr_like":
        assert abs(float(y.sum()) - total) < slack + 0.01 * total
    again = sensor(x, generator=torch.Generator().manual_seed(1))
    assert torch.equal(y, again)
    assert preset.description and all(line for line in preset.sources)
    assert any(line.startswith("assumed:") for line in preset.sources)


@each
def test_round_trips(name, tmp_path):
    preset = device(name)
    assert Device.from_dict(preset.to_dict()) == preset
    assert Device.from_json(preset.to_json()) == preset
    preset.to_json(tmp_path / "device.json")
    read = Device.from_json(tmp_path / "device.json")
    assert read == preset


def test_yaml(tmp_path):
    preset = device("kinect_v2_like")
    preset.to_yaml(tmp_path / "device.yaml")
    assert Device.from_yaml(tmp_path / "device.yaml") == preset
    assert Device.from_yaml(preset.to_yaml()) == preset
    # Numbers without a point, as JSON writes them.
    plain = "name: d\ndescription: d\nsources: ['assumed: all']\nstages: [{kind: GaussianResponse, fwhm_s: %s}]\n"
    assert Device.from_yaml(plain % "1e-10").stages[0]["fwhm_s"] == 1e-10
    assert Device.from_yaml(plain % "'1e-10'").stages[0]["fwhm_s"] == "1e-10"
    with pytest.raises(StorageError, match="expected"):
        Device.from_yaml("name: [1\n")
    with pytest.raises(StorageError, match="expected"):
        Device.from_yaml("name: !!python/object/apply:os.getcwd []\nstages: []\n")


def test_missing_packages_are_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(MissingPackageError, match="PyYAML"):
        device("kinect_v2_like").to_yaml()


def test_changes():
    preset = device("kinect_v2_like").changed("PixelElectronics", read_noise_e=3.0)
    assert preset.sensor().stages[1].read_noise_e == 3.0
    assert device("kinect_v2_like").sensor().stages[1].read_noise_e == 20.0
    other = preset.changed(0, frequencies_hz=[50e6])
    assert other.sensor().stages[0].frequencies_hz == (50e6,)
    with pytest.raises(StorageError, match="one stage of kind"):
        preset.changed("ShotNoise", x=1)


def test_a_calibrated_camera_as_data():
    offsets = [0.1, 0.2, 0.3]
    known = {"kind": "ItofCalibration", "phase_offset_rad": offsets, "direction": -1, "depth_map_m": [[0.0, 0.2]]}
    preset = Device.from_json(device("kinect_v2_like").changed("ItofCorrelation", calibration=known).to_json())
    x = torch.zeros(1, preset.axis().num_bins, 1, 2, dtype=torch.float64)
    x[:, 400] = 1.0
    camera = preset.sensor()
    reading = read_itof(
        camera.expected(x), (120e6, 80e6, 16e6), 3, readout="differential", max_depth_m=8.0,
        calibration=camera.stages[0].calibration,
    )  # fmt: skip
    # Square codes wiggle by 19.5 mrad, 4 mm at 120 MHz and 30 at 16, which counts 64 / 2304 of it.
    assert float((reading.depth_m - preset.axis().centers_opl[400] / 2).abs().max()) < 0.01


def test_kinect_sees_the_depth_of_a_wall():
    preset = device("kinect_v2_like")
    axis = preset.axis()
    x = torch.zeros(1, axis.num_bins, 4, 4, dtype=torch.float64)
    x[:, int(axis.bin_index(2 * 3.21))] = 1.0
    frames = preset.sensor(grad="straight_through")(x, torch.Generator().manual_seed(0))
    assert frames.shape == (1, 9, 4, 4)  # three phase steps of three frequencies: differences of two taps
    assert bool((frames % 60 == 0).all()) and float(frames.min()) < 0  # of converters with 60 electrons per number
    reading = read_itof(frames, (120e6, 80e6, 16e6), 3, readout="differential", max_depth_m=8.0)
    assert float((reading.depth_m - 3.21).abs().max()) < 0.05
    # Unmodulated light leaves no difference, but its noise.
    dark = preset.sensor().expected(torch.zeros_like(x))
    torch.testing.assert_close(dark, torch.zeros_like(dark), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "call",
    [
        lambda: Device("x", description="", sources=(), stages=()),
        lambda: Device("x", description="", sources=(), stages=({"kind": "os.system"},)),
        lambda: Device("x", description="", sources=(), stages=("ShotNoise",)),
        lambda: Device(
            "x", description="", sources=(), stages=({"kind": "PixelElectronics", "full_well_e": float("inf")},)
        ),
        lambda: Device(
            "x", description="", sources=(), stages=({"kind": "ImpulseResponse", "response": {"kind": "nothing"}},)
        ),
        lambda: Device("x", description="", sources=(), stages=({"kind": "sine_code"},)).sensor(),
        lambda: Device("x", description="", sources=(), stages=({"kind": "ShotNoise", "colour": 3},)).sensor(),
        lambda: Device("x", description="", sources=(), stages=({"kind": "ShotNoise"},)).axis(),
        lambda: Device(
            "x", description="", sources=(), stages=({"kind": "ShotNoise", "grad": torch.ones(1)},)
        ).to_json(),
        lambda: Device.from_dict({"name": "x"}),
        lambda: Device.from_dict({**device("imx250mzr_like").to_dict(), "more": 1}),
        lambda: Device.from_json("{"),
        lambda: Device.from_json("/nowhere.json"),
        lambda: build_stage("@axis"),
        lambda: build_stage("@bins", TimeAxis(0, 1, 2)),
    ],
)
def test_errors(call):
    with pytest.raises(StorageError, match="expected"):
        call()


def test_an_unknown_device():
    with pytest.raises(ArgumentError, match=r"device: expected one of .*kinect_v2_like.*got 'pmd'"):
        device("pmd")


def test_errors_of_values_keep_their_type():
    with pytest.raises(UnitError, match="read_noise_e"):
        Device("x", description="", sources=(), stages=({"kind": "PixelElectronics", "read_noise_e": -1.0},)).sensor()


NS = 1e-9
AXIS = TimeAxis.from_seconds(0.0, 1e-10, 32)
BASES = {"AddedCounts", "AfterpulseDelays", "CorrelationCode", "MovedCounts", "RandomSensor", "Response", "Sensor"}


def tensor(values):
    return {"kind": "tensor", "values": values}


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
    with pytest.raises(StorageError, match="finite numbers"):
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


# ------------------------------------------------------------------------------------------------------ parts


# ---------------------------------------------------------------------------------------------------- numbers
