"""docs/losses.md: its program runs, and it names every function of the room and no other."""

from __future__ import annotations

import inspect
import re

import torch

from support.loss_cases import OTHERS
from support.pages import Page
from torchtransient import losses

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


def test_every_floor_is_in_the_table():
    """Of what has one as an argument."""
    (table,) = re.findall(r"\| loss \| floor \|.*?\n\n", PAGE, re.DOTALL)
    for name in dir(losses):
        function = getattr(losses, name)
        if inspect.isfunction(function) and {"floor", "background", "smoothing"} & set(
            inspect.signature(function).parameters
        ):
            assert re.search(rf"`{name}\b", table) or name in SHARED_FLOORS, name
