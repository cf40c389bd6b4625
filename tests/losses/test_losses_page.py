"""docs/losses.md: its program runs, and it names every function of the room and no other."""

from __future__ import annotations

import re
from pathlib import Path

import torch

from torchtransient import losses

PAGE = (Path(__file__).parents[2] / "docs" / "losses.md").read_text(encoding="utf-8")
# Of what the page describes in other words, or what serves a loss.
PARTS = {"relative_floor", "anscombe", "transient_phasors", "maximum_projections"}


def test_its_program_runs():
    (program,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    torch.manual_seed(0)
    names = {}
    exec(compile(program, "losses.md", "exec"), names)
    assert bool(torch.isfinite(names["objective"])) and bool(torch.isfinite(names["loss"]))
    assert bool(torch.isfinite(names["model"].grad).all())


def test_its_names_are_those_of_the_room():
    functions = {name for name in dir(losses) if name.islower() and callable(getattr(losses, name))}
    named = set(re.findall(r"`(?:tt\.losses\.)?([a-z_]+(?:_loss|_nll|_variation|_consistency|_distance))\b", PAGE))
    assert named == functions - PARTS
