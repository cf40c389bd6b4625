"""Named devices: every number is in the sources, derived numbers follow from those they are derived from."""

from __future__ import annotations

import itertools
import math
import re

import pytest
import torch

from torchtransient.sensing import DEVICES, TailedResponse, device, frames_to_rate
from torchtransient.units import SPEED_OF_LIGHT

FWHM_PER_SIGMA = 2.3548200450309493  # 2 sqrt(2 log 2)


each = pytest.mark.parametrize("name", sorted(DEVICES))


def numbers_of(value, path):
    """(path, number) of a description; evenly spaced lists give their start and their step."""
    if isinstance(value, dict):
        return [pair for key, v in value.items() if key != "kind" for pair in numbers_of(v, f"{path}.{key}")]
    if isinstance(value, (list, tuple)):
        if len(value) > 4 and all(isinstance(v, float) for v in value):
            (step,) = {round(b - a, 14) for a, b in itertools.pairwise(value)}
            return [(f"{path}[0]", value[0]), (f"{path} step", step), (f"{path} count", len(value))]
        return [pair for k, v in enumerate(value) for pair in numbers_of(v, f"{path}[{k}]")]
    return [(path, float(value))] if isinstance(value, (int, float)) else []


def mantissa(x):
    """The digits of a number without its unit: 27 ps, 27e-12 s and 0.27 are the same."""
    return f"{x:.5e}".split("e")[0]


def missing(preset):
    """The numbers of a device that no line of its sources has."""
    text = re.sub(r"(?<=\d) (?=\d{3}\b)", "", " ".join(preset.sources))
    said = {mantissa(float(t)) for t in re.findall(r"(?<![\w.])\d+(?:\.\d+)?(?:e[-+]?\d+)?", text) if float(t) > 0}
    said |= {mantissa(float(t)) for t in re.findall(r"(?<=f/)\d+(?:\.\d+)?", text)}
    kept = {"stages": list(preset.stages), "bin_width_s": preset.bin_width_s, "num_bins": preset.num_bins}
    return [pair for pair in numbers_of(kept, preset.name) if pair[1] != 0 and mantissa(pair[1]) not in said]


@each
def test_every_number_is_in_the_sources(name):
    assert missing(device(name)) == []
    read = [line for line in device(name).sources if not line.startswith("assumed:")]
    assert read and sum(line.startswith("assumed:") for line in device(name).sources) == 1


def stage(name, kind):
    (found,) = [s for s in device(name).stages if s["kind"] == kind]
    return found


def test_derived_numbers():
    """Roundings are of the last digit given."""
    assert abs(device("vl53l8_like").bin_width_s - 2 * 37.5348e-3 / SPEED_OF_LIGHT) < 0.05e-12
    # 0.11 mW at 10 MHz; full well over dynamic range; full well over 12 bit above the black level.
    assert math.isclose(stage("mpd_spad_like", "PhotonBudget")["pulse_energy_j"], 0.11e-3 / 10e6)
    electronics = stage("imx250mzr_like", "PixelElectronics")
    assert abs(electronics["read_noise_e"] - 11_000 / 10 ** (76.4 / 20)) < 0.05
    top = electronics["full_well_e"] / electronics["gain_e_per_dn"] + electronics["black_level_dn"]
    assert 0.99 * 4095 < top < 4095
    for name, sigma_s in (("picoharp300_like", 12e-12), ("hydraharp400_like", 12e-12), ("multiharp150_like", 45e-12)):
        fwhm_s = stage(name, "DetectionJitter")["response"]["fwhm_s"]
        assert abs(fwhm_s - FWHM_PER_SIGMA * sigma_s) < 0.5e-12
    frequencies = stage("kinect_v2_like", "ItofCorrelation")["frequencies_hz"]
    assert abs(SPEED_OF_LIGHT / (2 * math.gcd(*(int(f) for f in frequencies))) - 18.7) < 0.05
    # A binary frame takes 10 us; gates are whole steps of 17 ps apart.
    budget, gates = stage("spad512s_like", "PhotonBudget"), stage("spad512s_like", "GatedIntegration")
    assert budget["cycles"] == round(budget["repetition_rate_hz"] * 10e-6)
    assert device("spad512s_like").sensor().stages[1].electrons_per_unit == budget["cycles"]
    assert all(abs(d / 17e-12 - round(d / 17e-12)) < 1e-6 for d in gates["delays_s"])
    assert gates["delays_s"][-1] + gates["widths_s"] < 600 * 50e-12


def test_gates_of_the_array_see_light_while_they_are_open():
    preset = device("spad512s_like").changed("PhotonBudget", ambient_rate_hz=0.0, dark_count_rate_hz=0.0)
    axis = preset.axis()
    x = torch.zeros(1, axis.num_bins, 1, 1, dtype=torch.float64)
    x[:, 240] = 0.2  # 12.0 to 12.05 ns
    sensor = preset.sensor()
    rate = frames_to_rate(sensor.expected(x), 255).flatten()
    per_frame = 0.2 * sensor.stages[0].detections_per_unit * 200
    opened = torch.tensor(stage("spad512s_like", "GatedIntegration")["delays_s"])
    inside = (opened < 12e-9 - 1e-9) & (opened + 6e-9 > 12.05e-9 + 1e-9)
    outside = (opened > 12.05e-9 + 1e-9) | (opened + 6e-9 < 12e-9 - 1e-9)
    assert int(inside.sum()) == 12 and int(outside.sum()) > 30
    # edges of 0.2 ns (standard deviation below that), 1 ns away
    torch.testing.assert_close(rate[inside], torch.full_like(rate[inside], per_frame), rtol=1e-4, atol=0.0)
    assert float(rate[outside].abs().max()) < 1e-4 * per_frame
    bright = sensor.expected(1e6 * x).flatten()
    assert float(bright.max()) <= 255 and float(bright[inside].min()) > 254.999


def test_the_fine_chip_has_the_shape_of_its_frames():
    """Half a narrow core and a slow tail: rise within two bins, one in ten photons more than 0.88 ns late."""
    preset = device("tmf882x_like").changed("PhotonBudget", ambient_rate_hz=0.0, dark_count_rate_hz=0.0)
    x = torch.zeros(1, 128, 1, 1, dtype=torch.float64)
    x[:, 40] = 1e-4
    sensor = preset.sensor()
    shape = sensor.expected(x * 1e-3).flatten()  # far from pile-up
    shape = shape / shape.sum()
    assert int(shape.argmax()) in (40, 41)
    assert float(shape[:39].sum()) < 0.01
    # pulse and jitter together are the measured response, but for the places in the bins between the two: 88^2/6 ps^2
    # more than its variance of 129^2/2.35^2 and 88^2/6, which takes a seventh off the top
    measured = TailedResponse(129e-12, [103e-12, 549e-12], [0.75, 0.24])
    first, kernel = measured.kernel(88e-12)
    wanted = torch.nn.functional.pad(kernel, (40 + first, 0))[:128]
    assert float((shape - wanted).abs().max()) < float(kernel.max()) / 7
    # Late by 10 bins: 0.24 exp(-880 / 549) and nearly nothing of the fast tail, to the width of a bin.
    late = float(shape[51:].sum())
    assert 0.24 * math.exp(-968 / 549) < late < 0.24 * math.exp(-792 / 549)
