"""docs/sensors.md, docs/photon_counting.md: their examples run, and their numbers are sensible."""

from __future__ import annotations

import re

import pytest
import torch

from support.pages import Page
from torchtransient import sensing

SENSORS = Page("docs/sensors.md")
PAGE, TEXT = SENSORS.path, SENSORS.text


def run(number):
    code = dict(SENSORS.programs())[number]
    names: dict[str, object] = {}
    exec(compile(code, str(PAGE), "exec"), names)
    return names


def test_every_example_is_run_here():
    assert len(SENSORS.programs()) == 5


def test_first_example():
    names = run(0)
    assert names["taps"].shape == (1, 8, 16, 16)
    # Bin 133 ends at 13.4 ns; 4000 electrons with a contrast of 0.6 measure to some millimetres.
    wanted = 0.5 * 133.5 * names["axis"].bin_width_opl
    assert float((names["depth_m"] - wanted).abs().max()) < 0.15
    assert abs(float(names["depth_m"].mean()) - wanted) < 0.01
    assert bool(torch.isfinite(names["reading"].depth_std_m).all())


def test_example_of_two_taps():
    names = run(1)
    assert names["frames"].shape == (1, 4, 16, 16)
    error = names["found"].depth_m - 0.5 * 120.5 * names["axis"].bin_width_opl
    # The deviation that the reading says, and what noise leaves of a mean of 256 pixels.
    said = float(names["found"].depth_std_m.mean())
    assert abs(float(error.std()) / said - 1) < 0.2
    assert abs(float(error.mean())) < 4 * said / 16


def test_example_of_depth():
    names = run(2)
    for found, bound in ((names["depth_m"], 1.1), (names["rough_m"], 1.2)):
        assert float((found - 1.2).square().mean().sqrt()) < bound * sensing.range_deviation_m(300e-12, 200)
    assert int(names["several"].valid.sum()) == 256


def test_example_of_a_coherent_lidar():
    names = run(3)
    # Half a bin of the light, 9 mm, and some noise; speckle of bins for themselves stays within a line.
    assert names["range_m"].item() == pytest.approx(names["distance"], abs=0.02)
    assert names["speed_m_s"].item() == pytest.approx(names["speed"], abs=0.01)
    assert names["rough_m"].item() == pytest.approx(names["distance"], abs=0.15)
    assert names["rough_m_s"].item() == pytest.approx(names["speed"], abs=0.077)
    assert bool(torch.isfinite(names["likelihood"]).all())


def test_devices_example():
    assert run(4)["quiet"].sensor().stages[1].read_noise_e == 5.0


def test_all_devices_are_listed_and_drawn():
    assert all(f"`{name}`" in TEXT and f"images/chains/{name}.png" in TEXT for name in sensing.DEVICES)


@pytest.mark.parametrize("name", [n for n, d in sensing.DEVICES.items() if d.num_bins])
def test_windows_and_wavelengths_are_those_of_the_devices(name):
    """Three digits of each, in the second table of devices."""
    device = sensing.device(name)
    _, row = re.findall(rf"^\| [^|]*`{name}`.*$", TEXT, flags=re.MULTILINE)[:2]
    window_s = device.num_bins * device.bin_width_s
    assert f"{window_s * 1e9:.3g} ns" in row
    assert f"{device.axis().end_opl / 2:.3g} m" in row
    budget = next((s for s in device.stages if s["kind"] == "PhotonBudget"), None)
    if budget:
        assert f"{budget['wavelength_m'] * 1e9:.0f} nm" in row
        assert f"of {1e9 / budget['repetition_rate_hz']:.0f} ns" in row


def test_photon_counting():
    """All blocks, one after the other, as a reader would run them."""
    names: dict[str, object] = {}
    # Its light is drawn: two of four losses that are the same by chance would have a slope of zero.
    torch.manual_seed(0)
    for number, code in Page("docs/photon_counting.md").run(names):
        if number == 0:
            assert names["counts"].shape == (1, 512, 8, 8)
            assert bool(torch.isfinite(names["loss"]))
            assert bool(torch.isfinite(names["rate"]).all())
        if "ScoreFunction" in code:
            assert names["losses"].shape == (4,) and 0 < float(names["losses"].mean()) < 1
            slope = names["brightness"].grad.flatten()
            assert bool(torch.isfinite(slope).all()) and bool((slope != 0).all())
        if "register_parametrization" in code:
            # 1.2 MHz in 5 us of bins are 3100 counts of a pixel, which tell the rate to 1.8 %; from a sixth of it
            found = names["learnt"].ambient_rate_hz.detach()
            assert float((found / (3 * (0.4e6 + 100)) - 1).abs().max()) < 5 * 0.018
    assert 0 < float(names["millimetres"]) < 1
