"""Rates of whatever hangs on a body that moves, and of cameras that leave out their first segment."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.rates import VARIANT, mean_rate, plate, rates_of, scene
from torchtransient.scenes import translate

RATES = tt.RateAxis(-10.0, 0.25, 80)


def slopes_of_mean_rates(description, motions, key, change, step, spp):
    """Mean rate of the derivative by ``change`` of a key: forward mode, and differences of the same samples."""
    moving = tt.load(description, variant=VARIANT).moving(motions)
    renderer = tt.TransientRenderer(
        moving, [key], rates=RATES, time_axis=tt.TimeAxis(0.0, 0.5, 100), temporal_filter="tent", grad_seed="same",
        spp=spp, physics="ignore",
    )  # fmt: skip
    base = renderer.values[key].detach().clone()

    def light(x, seed):
        return renderer({key: base + x * change}, seed=seed).rates[0].sum((1, 2, 3))

    found, differences = 0.0, 0.0
    for seed in range(4):
        found = found + torch.func.jvp(lambda x, s=seed: light(x, s), (torch.zeros(()),), (torch.ones(()),))[1].detach()
        with torch.no_grad():
            differences = differences + (light(step, seed) - light(-step, seed)) / (2 * step)
    return [float((d * RATES.centers).sum() / d.sum()) for d in (found, differences)]


@pytest.mark.slow
@pytest.mark.parametrize("unwarp", [False, True])
def test_the_shadow_of_a_hider_that_grows(unwarp):
    """The light that it takes away has the rate of the light that is there."""
    hider = plate((0.7, 0, 1.2), (1.4, 0, 0.4), half=0.15)
    nodes = scene(fov=40, wall=plate((0, 0, 2), (0, 0, 0), half=3), hider=hider)
    nodes["lamp"] = {"type": "point", "position": [1.4, 0, 0.4], "intensity": 1.0}
    nodes["integrator"]["camera_unwarp"] = unwarp
    grows = torch.zeros(4, 4)
    grows[:3, :3] = torch.as_tensor(np.asarray(nodes["hider"]["to_world"])[:3, :3].astype(np.float32))
    motions = {"wall": tt.Motion(linear=(0, 0, 2.0))}
    found, differences = slopes_of_mean_rates(nodes, motions, "hider.to_world", grows, 0.05, 2048)
    # 2 v along both segments, of which the camera's is left out.
    assert found == pytest.approx(differences, abs=0.03)
    assert found == pytest.approx(1.48 if unwarp else 3.45, abs=0.05)


def test_fog_moves_with_the_glass_around_it():
    fog = {"type": "homogeneous", "id": "smoke", "sigma_t": 0.5, "albedo": 0.9}
    cube = {"type": "cube", "to_world": translate([0, 0, 3]), "bsdf": {"type": "null"}, "interior": fog}
    still = tt.load(scene(depth=6, kind="transient_prbvolpath", cube=cube), variant=VARIANT)
    comes = tt.Motion(linear=(0, 0, -1.0))
    rates = [float(mean_rate(rates_of(still, {name: comes}))) for name in ("cube", "smoke")]
    assert rates[0] == pytest.approx(rates[1], abs=1e-5) and rates[0] == pytest.approx(-2.0, abs=0.05)
    # Its own motion comes first.
    own = float(mean_rate(rates_of(still, {"cube": comes, "smoke": tt.Motion()})))
    assert own == pytest.approx(0.0, abs=1e-5)
