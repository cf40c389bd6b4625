"""Colours of parameters in spectral variants, where Mitsuba keeps the coefficients of smooth spectra."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import make_room

KEY = "box.bsdf.reflectance.data"


def test_colours_come_back():
    colours = np.random.default_rng(0).uniform(0.0, 1.0, (6, 10, 3)).astype(np.float32)
    colours[0, :3] = [[0.3, 0.3, 0.3], [0.570068, 0.0430135, 0.0443706], [0.9, 0.9, 0.05]]
    room = make_room()
    room["box"]["bsdf"] = {"type": "diffuse", "reflectance": {"type": "bitmap", "data": colours, "raw": False}}
    scene = tt.load(room, variant="llvm_ad_spectral")
    found = scene.parameters()[KEY].value
    np.testing.assert_allclose(found, colours, atol=1e-4)
    described, given = (
        tt.render(scene, values, spp=16, seed=0).steady for values in ({}, {KEY: torch.as_tensor(np.array(found))})
    )
    torch.testing.assert_close(given, described, rtol=1e-3, atol=1e-4 * float(described.max()))
    assert float(described.sum()) == pytest.approx(float(given.sum()), rel=1e-3)
