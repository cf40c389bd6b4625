"""docs/noisy_renders.md: its blocks run in their order, its tables are the measured numbers."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest
import torch

from support.pages import Page

ROOT = Path(__file__).parents[2]
PAGE = Page("docs/noisy_renders.md")
TEXT = PAGE.text
NUMBERS = ROOT / "benchmarks" / "results" / "noisy_renders.json"


@pytest.mark.slow
def test_its_blocks_run():
    """The squared error of one render is above that of two by their variance; the schedule ends above its start."""
    torch.manual_seed(0)
    names = PAGE.names()
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
    assert module.written(TEXT, data) == TEXT
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
