"""Material from scattering: the example runs, and its formula is the tracer's light where diffusion theory holds."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
import torch

FOLDER = Path(__file__).parents[2] / "training_examples"
METHODS = ("transient", "steady", "steady, power known", "diffusion theory")


@pytest.fixture
def example(monkeypatch):
    """The script imports its scene, as it does where it is run."""
    monkeypatch.syspath_prepend(FOLDER)
    return importlib.import_module


@pytest.fixture(autouse=True)
def one_thread():
    import torchtransient as tt

    with tt.threads(1):
        yield


@pytest.mark.slow
def test_the_transient_tells_what_the_steady_image_does_not(example, tmp_path, capsys):
    (fits,) = example("scattering_material").main(["--smoke", "--output", str(tmp_path)])
    rows = re.findall(rf"^({'|'.join(METHODS)}) +([\d. ]+)$", capsys.readouterr().out, re.MULTILINE)
    printed = {name: [float(x) for x in values.split()] for name, values in rows}
    assert tuple(printed) == METHODS
    for name, (scattering, off_scattering, absorption, off_absorption, _) in printed.items():
        assert (scattering, absorption) == pytest.approx(fits[name].found.tolist(), abs=0.06)
        assert (off_scattering, off_absorption) == pytest.approx(fits[name].errors, abs=0.06)
    # from a start 50 and 150 % off
    transient, steady, known, _ = (sum(fits[name].errors) for name in METHODS)
    assert transient < 0.6 * steady
    assert known < 0.4 * steady
    assert (tmp_path / "scattering_material.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_the_formula_is_right_late_and_in_the_dark(example):
    scene = example("turbid_block")
    coefficients = (200.0, 6.0)
    model = scene.Block(coefficients)
    with torch.no_grad():
        traced = torch.stack([model(seed, 1 << 12)[0, :, 0].double() for seed in range(8)])
    formula = scene.diffused(*torch.tensor(coefficients, dtype=torch.float64))[0, :, 0]
    # From 30 free paths on, four dark pixels in three stretches of time, as shares of their light.
    late = scene.AXIS.centers_opl > 2 * scene.HEIGHT + 30 / coefficients[0]
    tables = [
        torch.stack([part.sum(-2) for part in light[..., late, :4].tensor_split(3, -2)], -2)
        for light in (traced, formula)
    ]
    tables = [table / table.sum((-2, -1), keepdim=True) for table in tables]
    error = tables[0].std(0) / len(traced) ** 0.5
    # Diffusion theory errs by some per cent here, the tracer by its noise.
    assert ((tables[0].mean(0) - tables[1]).abs() < 4 * error + 0.05 * tables[1]).all()
    assert (error < 0.08 * tables[1]).all()
