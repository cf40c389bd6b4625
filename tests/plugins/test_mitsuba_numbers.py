"""What Mitsuba keeps of installed values in plain numbers: shown on Mitsuba alone, and what the layer makes of it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import make_room

VARIANT = "llvm_ad_rgb"
UPRIGHT, REFLECTED = np.diag([0.3, 0.3, 0.3, 1.0]), np.diag([-0.3, 0.3, 0.3, 1.0])


@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
@pytest.mark.parametrize("described", [UPRIGHT, REFLECTED], ids=["upright", "reflected"])
def test_poses_that_reflect_are_refused(kind, described):
    scene = tt.load(make_room() | {"ball": {"type": kind, "to_world": described}}, variant=VARIANT)
    renderer = tt.TransientRenderer(scene, parameters=["ball.to_world"], spp=2, physics="ignore")
    with pytest.raises(tt.errors.SceneError, match="without a reflection"):
        renderer({"ball.to_world": torch.tensor(REFLECTED)}, seed=0)


@pytest.mark.slow
def test_the_ends_of_an_irregular_spectrum_are_not_recorded():
    room = make_room()
    spectrum = {"type": "irregular", "wavelengths": "450, 550, 650", "values": ".2, .8, .4"}
    room["wall"]["bsdf"] = {"type": "diffuse", "reflectance": spectrum}
    key = "wall.bsdf.reflectance.wavelengths"
    steady = []
    for freeze in (False, True):
        scene = tt.load(room, variant="llvm_ad_spectral")
        renderer = tt.TransientRenderer(scene, parameters=[key], spp=16, freeze=freeze, physics="ignore")
        for nodes in ([450.0, 550.0, 650.0],) * (3 * freeze) + ([400.0, 550.0, 700.0],):
            out = renderer({key: torch.tensor(nodes)}, seed=0)
        steady.append(out.steady)
    torch.testing.assert_close(steady[1], steady[0], rtol=2e-5, atol=1e-6)
    assert out.stats.recorded[0].startswith("traced: numbers of wall.bsdf.reflectance.wavelengths")
