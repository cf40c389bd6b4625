"""docs/losses.md: its program runs, and it names every function of the room and no other."""

from __future__ import annotations

import dataclasses
import inspect
import pkgutil
import re
from pathlib import Path

import torch

from support.loss_cases import CASES, OTHERS
from support.pages import Page
from torchtransient import losses
from torchtransient.errors import ShapeError

LOSSES = Page("docs/losses.md")
PAGE = LOSSES.text
# By the row of another: second names, and phasors of transients.
SHARED_FLOORS = ("poisson_loss", "first_photon_loss", "transient_phasor_loss")


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


def asks_for_dim(case):
    """Of lists of points, without levels that are given: a scale is then that of an item."""
    known = {name: value for name, value in case.options.items() if name not in ("floor", "background")}
    x, y = (t.flatten(-2) for t in case.tensors())
    if "operator" in known:
        known["operator"], x = torch.clone, y  # one that takes lists
    try:
        dataclasses.replace(case, options=known)(x, y)
    except ShapeError as error:
        return "expected dim=" in str(error)
    return False


def test_what_asks_for_dim_is_said():
    """The paragraph names all losses that do, and no other."""
    (text,) = re.findall(r"\nIt is asked for by (.*?)\.\s+All", PAGE, re.DOTALL)
    functions = {name for name in dir(losses) if name.islower() and inspect.isfunction(getattr(losses, name))}
    asking = {case.function.__name__ for case in CASES if asks_for_dim(case)}
    for function, call in OTHERS.items():
        try:
            call(torch.rand(2, 8, 9))
        except ShapeError as error:
            asking |= {function.__name__} if "expected dim=" in str(error) else set()
    assert set(re.findall(r"`(\w+)`", text)) & functions == asking


def test_every_floor_is_in_the_table():
    """Of what has one as an argument."""
    (table,) = re.findall(r"\| loss \| floor \|.*?\n\n", PAGE, re.DOTALL)
    for name in dir(losses):
        function = getattr(losses, name)
        if inspect.isfunction(function) and {"floor", "background", "smoothing"} & set(
            inspect.signature(function).parameters
        ):
            assert re.search(rf"`{name}\b", table) or name in SHARED_FLOORS, name


def test_names_elsewhere_are_there():
    """`tt.nlos.FK` and the like, on the page and in docstrings of the room."""
    texts = [PAGE, *(path.read_text(encoding="utf-8") for path in Path(losses.__file__).parent.glob("*.py"))]
    names = {name for text in texts for name in re.findall(r"\b(?:tt|torchtransient)((?:\.\w+)+)", text)}
    assert len(names) > 10
    for name in names:
        pkgutil.resolve_name("torchtransient" + name)
