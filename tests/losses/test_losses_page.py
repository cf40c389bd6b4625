"""docs/losses.md: its program runs, and it names every function of the room and no other."""

from __future__ import annotations

import inspect
import pkgutil
import re
from pathlib import Path

import torch

from support.loss_cases import OTHERS
from torchtransient import losses

PAGE = (Path(__file__).parents[2] / "docs" / "losses.md").read_text(encoding="utf-8")


def test_its_program_runs():
    (program,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    torch.manual_seed(0)
    names = {}
    exec(compile(program, "losses.md", "exec"), names)
    assert bool(torch.isfinite(names["objective"])) and bool(torch.isfinite(names["loss"]))
    assert bool(torch.isfinite(names["model"].grad).all())


def test_its_names_are_those_of_the_room():
    functions = {name for name in dir(losses) if name.islower() and inspect.isfunction(getattr(losses, name))}
    parts = {function.__name__ for function in OTHERS}
    named = set(re.findall(r"`(?:tt\.losses\.)?([a-z_]+)\b", PAGE)) & functions
    assert named | parts == functions
    likely = re.findall(r"`(?:tt\.losses\.)?([a-z_]+(?:_loss|_nll|_variation|_consistency|_distance))\b", PAGE)
    assert set(likely) <= functions


def test_names_elsewhere_are_there():
    """`tt.nlos.FK` and the like, on the page and in docstrings of the room."""
    texts = [PAGE, *(path.read_text(encoding="utf-8") for path in Path(losses.__file__).parent.glob("*.py"))]
    names = {name for text in texts for name in re.findall(r"\b(?:tt|torchtransient)((?:\.\w+)+)", text)}
    assert len(names) > 10
    for name in names:
        pkgutil.resolve_name("torchtransient" + name)
