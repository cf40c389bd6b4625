"""docs/parametrize.md: its blocks run, its fit finds the truth, and its table has what the rooms have."""

from __future__ import annotations

import inspect
import re

import numpy as np
import pytest
import torch
from torch import nn

import torchtransient as tt
from support.pages import Page

VARIANT = "llvm_ad_mono"
PARAMETRIZE = Page("docs/parametrize.md")
PAGE = PARAMETRIZE.text


@pytest.fixture(scope="module")
def names():
    return PARAMETRIZE.names()


def normal_and_distance(pose):
    """Of the wall, and where it meets the camera's axis."""
    matrix = np.asarray(pose, dtype=np.float64)
    normal = np.cross(matrix[:3, 0], matrix[:3, 1])
    normal /= np.linalg.norm(normal)
    return normal, normal @ matrix[:3, 3] / normal[2]


def errors(names, values):
    found, known = (normal_and_distance(pose) for pose in (values[names["POSE"]], names["TRUTH"]["pose"]))
    upper = values[names["POSE"]][:3, :3].double() / 3
    return {
        "albedo": abs(values[names["ALBEDO"]].item() - 0.95),
        "index": abs(values[names["INDEX"]].item() - 1.5),
        "distance": abs(found[1] - known[1]),
        "tilt_deg": float(np.degrees(np.arccos(min(1.0, found[0] @ known[0])))),
        "rigid": (upper.mT @ upper - torch.eye(3).double()).abs().max().item(),
    }


@pytest.mark.soak
def test_the_fit_finds_the_truth(names):
    """Bounds: three times the worst of the page's three seeds."""
    found = errors(names, names["history"][-1])
    assert found["albedo"] < 0.01 and found["index"] < 0.002
    assert found["distance"] < 0.002 and found["tilt_deg"] < 0.08 and found["rigid"] < 1e-5
    for values in names["history"]:
        assert 0 <= values[names["ALBEDO"]] <= 1 and 1 <= values[names["INDEX"]] <= 2
        upper = values[names["POSE"]][:3, :3] / 3
        assert torch.allclose(upper.mT @ upper, torch.eye(3), atol=1e-5)


@pytest.mark.slow
def test_other_blocks(names):
    assert torch.allclose(names["back"], names["depth"], atol=1e-4)
    assert names["pose"].shape == (4, 4, 4) and names["normals"].shape == (3, 6, 8)
    assert torch.allclose(names["matrix"], names["camera"].intrinsics, atol=1e-4)
    assert isinstance(names["other"].values["slab.bsdf.eta"], nn.Parameter)


def test_its_names_are_those_of_the_rooms():
    for room in (tt.parametrize, tt.geometry):
        public = {name for name, value in vars(room).items() if inspect.isfunction(value) or inspect.isclass(value)}
        assert len(public) > 10
        assert {name for name in public if not re.search(rf"\b{name}\b", PAGE)} == set()
    for room, name in re.findall(r"\btt\.(parametrize|geometry)\.(\w+)", PAGE):
        assert hasattr(getattr(tt, room), name), name
