"""The example of docs/photon_counting.md runs, and its numbers are sensible."""

from __future__ import annotations

import re
from pathlib import Path

import torch

import torchtransient as tt

PAGE = Path(__file__).parents[2] / "docs" / "photon_counting.md"


def test_example():
    code, *_ = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(code, str(PAGE), "exec"), names)
    assert names["counts"].shape == (1, 512, 8, 8)
    assert bool(torch.isfinite(names["loss"]))
    assert bool(torch.isfinite(names["rate"]).all())
    (bound,) = (block for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
                if "crlb" in block)  # fmt: skip
    exec(compile(bound, str(PAGE), "exec"), names)
    assert 0 < float(names["millimetres"]) < 1


def test_modules_that_it_names_exist():
    named = set(re.findall(r"`([A-Z]\w+|[a-z_]+_\w+)`", PAGE.read_text(encoding="utf-8")))
    classes = {n for n in named if n[0].isupper()}
    assert {"PhotonBudget", "TDC", "Crosstalk", "FreeRunningSPAD"} <= classes
    assert all(hasattr(tt.sensing, n) for n in classes)
