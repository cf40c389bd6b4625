"""The training examples as modules, and what their small runs leave behind."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "training_examples"


def example(name):
    """A script as a module. Scripts import each other, as where one of them is run."""
    if str(FOLDER) not in sys.path:
        sys.path.append(str(FOLDER))
    return importlib.import_module(name)


def small_run(name, folder, *options):
    """What ``main`` of a script returns for ``--smoke`` and more options; its picture is there."""
    result = example(name).main(["--smoke", "--output", str(folder), *map(str, options)])
    assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    return result


def measured_data():
    """The folder of measured data, which is no part of the repository."""
    named = os.environ.get("TORCHTRANSIENT_MEASURED_DATA")
    if not named:
        pytest.fail("set TORCHTRANSIENT_MEASURED_DATA to the folder of published captures", pytrace=False)
    return Path(named)
