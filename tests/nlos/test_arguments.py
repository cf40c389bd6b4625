"""Whatever is handed to a public function of captures and hidden scenes, what comes out is an error of this library."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient import scenes
from torchtransient.errors import TorchTransientError

VARIANT = "llvm_ad_mono"
VERTICES, FACES = np.array([[0, 0, 1.0], [1, 0, 1], [0, 1, 1]]), [[0, 2, 1]]
WALL = tt.nlos.Wall.plane()
POINTS = tt.nlos.Scan.grid(WALL, 2, kind="confocal")
AXIS = tt.TimeAxis(1.9, 0.05, 20)
HIDDEN = scenes.nlos_z()


@pytest.mark.parametrize("values", [None, [1], "x", 3, torch.tensor([1.0]), {1: 2}])
def test_values_that_are_none(values):
    renderer = tt.nlos.CaptureRenderer(HIDDEN, POINTS, ["letter.bsdf.reflectance.value"], time_axis=AXIS, spp=2)
    if values is None:
        assert renderer(values, seed=0).transient.shape == (1, 20, 2, 2)
        return
    with pytest.raises(TorchTransientError, match=r"expected keys of scene\.parameters"):
        renderer(values, seed=0)


def test_albedos_are_those_of_walls_and_meshes():
    """One number of any library, or three in a list, a tuple or an array."""
    for given in (0.5, np.float32(0.5), torch.tensor(0.5), 1, 0):
        wall, mesh = tt.nlos.Wall.plane(albedo=given).shape, scenes.triangle_mesh(VERTICES, FACES, reflectance=given)
        assert wall["bsdf"] == mesh["bsdf"] == {"type": "diffuse", "reflectance": float(given)}
    for three in ([0.25, 0.5, 1], (0.25, 0.5, 1.0), np.array([0.25, 0.5, 1.0]), torch.tensor([0.25, 0.5, 1.0])):
        wall, mesh = tt.nlos.Wall.plane(albedo=three).shape, scenes.triangle_mesh(VERTICES, FACES, reflectance=three)
        assert wall["bsdf"] == mesh["bsdf"]
        assert mesh["bsdf"]["reflectance"] == {"type": "rgb", "value": [0.25, 0.5, 1.0]}
