"""Media whose velocity is a volume: rates against closed forms, files, and refusals."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.rates import RATES, VARIANT, mean_length, mean_rate, rates_of, scene
from torchtransient.scenes import scale, translate

WIND, WHIRL, CENTER = np.array([0.3, 0.2, 1.4]), np.array([0.3, 0.8, 0.2]), np.array([0.7, 0.1, 2.0])
# The grid's box and the centres of its cells along each axis: a linear field is exact between those.
LOW, SIZE, CELLS = np.array([-6.0, -6.0, -1.0]), np.array([12.0, 12.0, 8.0]), (4, 3, 5)


def blown(field, variant=VARIANT, size=1, fov=0.02, depth=2):
    """Fog from 1 to 4 metres whose velocity is a function of places (..., 3)."""
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n for n in CELLS[::-1]), indexing="ij")
    velocity = {"type": "gridvolume", "data": field(LOW + np.stack([x, y, z], -1) * SIZE).astype(np.float32),
                "to_world": translate(LOW) @ scale(SIZE)}  # fmt: skip
    fog = {"type": "homogeneous", "sigma_t": 0.4, "albedo": 0.9, "id": "mist", "velocity": velocity}
    box = {"type": "cube", "to_world": translate([0, 0, 2.5]) @ scale([3, 3, 1.5]), "bsdf": {"type": "null"},
           "interior": fog}  # fmt: skip
    return tt.load(scene(size, fov, depth, kind="transient_prbvolpath", box=box), variant=variant)


def rigid(p):
    return WIND + np.cross(WHIRL, p - CENTER)


@pytest.mark.parametrize("variant", ["llvm_ad_mono", pytest.param("llvm_ad_spectral", marks=pytest.mark.slow)])
def test_a_whirl_on_a_grid_is_that_of_a_rigid_motion(variant):
    """Light of one to three bounces, in all pixels."""
    still = blown(rigid, variant, size=4, fov=40, depth=4)
    light = rates_of(still, variant=variant)
    expected = rates_of(still, {"mist": tt.Motion(linear=WIND, angular=WHIRL, center=CENTER)}, variant=variant)
    assert float((light - expected).abs().sum()) < 1e-4 * float(expected.sum())
    assert float(mean_rate(light).std()) > 0.1


def test_a_wind_that_grows_with_distance():
    """v_z = 0.5 z: light that is scattered once after the length tau has the rate 0.5 tau."""
    loaded = blown(lambda p: p * [0, 0, 0.5])
    light = rates_of(loaded, spp=4096)
    for bins in (slice(25, 40), slice(40, 60)):
        part = torch.zeros_like(light)
        part[:, bins] = light[:, bins]
        # Of light at the ends of the part, which tents split, one share is left out.
        assert float(mean_rate(part)) == pytest.approx(0.5 * float(mean_length(part)), abs=2e-3)


def test_files_copies_and_calls_keep_a_wind(tmp_path):
    loaded = blown(rigid)
    expected = rates_of(loaded)
    loaded.save(tmp_path / "wind.xml")
    for other in (tt.load(tmp_path / "wind.xml", variant=VARIANT), pickle.loads(pickle.dumps(loaded))):
        assert float((rates_of(other) - expected).abs().sum()) < 1e-4 * float(expected.sum())
    renderer = tt.TransientRenderer(loaded, ["mist.velocity.data"], rates=RATES, temporal_filter="tent", spp=256)
    still = renderer.values["mist.velocity.data"].detach()
    found = [float(mean_rate(renderer({"mist.velocity.data": x * still}, seed=0).rates[0])) for x in (1.0, 0.5, -1.0)]
    assert found == pytest.approx([found[0], found[0] / 2, -found[0]], abs=1e-4)
