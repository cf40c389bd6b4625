"""docs/metrics.md: its program runs, and it names every function of the room and no other."""

import inspect
import re

import pytest
import torch

from support.pages import Page
from torchtransient import metrics, units

PAGE = Page("docs/metrics.md")


def test_its_program_runs(capsys):
    found = PAGE.names()
    printed = capsys.readouterr().out.splitlines()
    assert float(printed[0]) == pytest.approx(0.01, rel=0.05)
    assert printed[1] == "torch.Size([4])"
    assert float(printed[2]) == pytest.approx(0.06, rel=1e-5)
    assert float(printed[3]) == pytest.approx(0.06 / units.SPEED_OF_LIGHT, rel=1e-5)
    row = found["row"]
    assert row["rmse [m]"] == pytest.approx(float(printed[0]), rel=1e-6) and row["within 1.25"] == 1
    assert row["off by more than 2 cm"] == pytest.approx(0.0455, abs=0.01)  # two standard deviations
    assert float(found["alike"]) > 0.5 and float(found["overlap"]) > 0.3
    assert float(found["depth"]) < float(found["fk"].grid.depths.diff()[0])
    assert bool(torch.isfinite(found["seen"]).all())


def test_its_names_are_those_of_the_room():
    functions = {name for name, value in vars(metrics).items() if inspect.isfunction(value)}
    rows = [line.split("|")[1] for line in PAGE.text.splitlines() if line.startswith("| `")]
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} == functions
