"""docs/losses.md and docs/noisy_renders.md: their programs run, the names and numbers are those of the library."""

import importlib.util
import inspect
import json
import re
from pathlib import Path

import pytest
import torch

from support.loss_cases import OTHERS
from support.pages import Page
from torchtransient import losses

LOSSES = Page("docs/losses.md")
PAGE = LOSSES.text
def test_its_program_runs():
    torch.manual_seed(0)
    names = LOSSES.names()
    assert bool(torch.isfinite(names["objective"])) and bool(torch.isfinite(names["loss"]))
    assert bool(torch.isfinite(names["model"].grad).all())


def test_its_names_are_those_of_the_room():
    functions = {name for name in dir(losses) if name.islower() and inspect.isfunction(getattr(losses, name))}
    parts = {function.__name__ for function in OTHERS}
    named = set(re.findall(r"`(?:tt\.losses\.)?([a-z_]+)\b", PAGE)) & functions
    assert named | parts == functions
    likely = re.findall(r"`(?:tt\.losses\.)?([a-z_]+(?:_loss|_nll|_variation|_consistency|_distance))\b", PAGE)
    assert set(likely) <= functions


# ------------------------------------------------------------------------------------------------ docs/noisy_renders.md


ROOT = Path(__file__).parents[2]
NOISY = Page("docs/noisy_renders.md")
NUMBERS = ROOT / "benchmarks" / "results" / "noisy_renders.json"


@pytest.mark.slow
def test_its_blocks_run():
    """The squared error of one render is above that of two by their variance; the schedule ends above its start."""
    torch.manual_seed(0)
    names = NOISY.names()
    assert names["squares"].item() > 0 and names["noise"].item() > 0
    values = names["renderer"].values[names["key"]]
    assert bool(torch.isfinite(values).all()) and bool(torch.isfinite(values.grad).all())
    assert names["schedule"](0) == 16 and names["schedule"](8) == names["schedule"].last > 16
    significance = names["significance"]
    assert significance.shape == (3,) and bool(torch.isfinite(significance).all())


def test_its_tables_are_those_of_the_numbers():
    maker = ROOT / "docs" / "make_noisy_render_page.py"
    specification = importlib.util.spec_from_file_location("make_noisy_render_page", maker)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    data = json.loads(NUMBERS.read_text(encoding="utf-8"))
    assert not data["settings"]["quick"]
    assert module.written(NOISY.text, data) == NOISY.text
    # what the page says of them
    least = data["least"]
    squares, likelihood = least["`squared_loss`, weighted"], least["`poisson_loss`, `poisson_nll`"]
    assert squares["exact"]["64"]["rms"] < 0.2 and likelihood["exact"]["64"]["rms"] > 1 > squares["own"]["rms"]
    late, few = (data["fits"][f"`expected_root_loss`, 64{more}"] for more in (" to 1024", ""))
    assert late["rms"] < 0.1 < 1 < few["rms"]
    errors = {name: sum(found["percent"]) / 3 for name, found in data["priors"].items()}
    squares, roots, poisson = (
        errors[name] for name in ("weighted squares, 64 samples", "`expected_root_loss`, 64", "`poisson_loss`, 64")
    )
    assert squares < 0.65 * roots and roots < errors["the start"] < 0.6 * poisson
