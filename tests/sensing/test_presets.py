"""Named devices: every number is in the sources, derived numbers follow from those they are derived from."""

from __future__ import annotations

import itertools
import re

import pytest
import torch

from torchtransient.sensing import DEVICES, device, frames_to_rate

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
