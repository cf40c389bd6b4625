"""Rates of light around a corner: hidden things that move."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.errors import SceneError
from torchtransient.scenes import look_at, scale

ORIGIN, SPOT, POINTS = (-0.5, 0.0, 0.25), (-0.2, 0.1, 0.0), 4
LINEAR, ANGULAR, CENTER = (0.8, -0.5, -1.6), (0.6, 1.5, 0.4), (0.1, 0.05, 1.0)
NORMAL = np.array([0.2, 0.1, -1.0])
HALF = 0.3
RATES = tt.RateAxis(-8.0, 0.5, 32)


def plate(center, target, half):
    return {
        "type": "rectangle", "to_world": look_at(center, target, [0, 1, 0]) @ scale([half, half, 1.0]),
        "bsdf": {"type": "diffuse", "reflectance": 0.6},
    }  # fmt: skip


def capture(kind, **more):
    """A wall of 4 x 4 points, and a plate behind the corner that moves and turns."""
    film = {
        "type": "transient_hdr_film", "width": POINTS, "height": POINTS, "rfilter": {"type": "box"},
        "temporal_bins": 60, "bin_width_opl": 0.05, "start_opl": 1.0,
    }  # fmt: skip
    scene = {
        "type": "scene",
        "integrator": {
            "type": "transient_nlos_path", "capture_type": kind, "nlos_laser_sampling": True,
            "nlos_hidden_geometry_sampling": True, "max_depth": 3,
        },
        "laser": {"type": "laser_beam", "to_world": look_at(ORIGIN, SPOT, [0, 1, 0])},
        "wall": {
            "type": "rectangle", "to_world": scale([0.5, 0.5, 1.0]), "bsdf": {"type": "diffuse", "reflectance": 0.9},
            "sensor": {"type": "nlos_capture_meter", "sensor_origin": list(ORIGIN), "film": film},
        },
        "hidden": plate(CENTER, np.array(CENTER) + NORMAL, HALF), **more,
    }  # fmt: skip
    motion = tt.Motion(linear=LINEAR, angular=ANGULAR, center=CENTER)
    return tt.load(scene, variant="llvm_ad_mono").moving({"hidden": motion})


def mean_rates(kind):
    """Quadrature over the plate: mean of v . (u_in - u_out) by the light of each point of the wall, (4, 4)."""
    frame = np.asarray(look_at(CENTER, np.array(CENTER) + NORMAL, [0, 1, 0]), dtype=np.float64)
    n = NORMAL / np.linalg.norm(NORMAL)
    grid = ((np.arange(100) + 0.5) / 100 * 2 - 1) * HALF
    x, y = (a.reshape(-1, 1) for a in np.meshgrid(grid, grid))
    hidden = np.array(CENTER) + x * frame[:3, 0] + y * frame[:3, 1]
    velocity = np.array(LINEAR) + np.cross(ANGULAR, hidden - CENTER)
    found = np.zeros((POINTS, POINTS))
    for i, j in np.ndindex(POINTS, POINTS):
        point = np.array([(j + 0.5) / POINTS - 0.5, (i + 0.5) / POINTS - 0.5, 0.0])
        spot = point if kind == "confocal" else np.array(SPOT)
        a, b = hidden - point, spot - hidden
        ra, rb = (np.linalg.norm(v, axis=1) for v in (a, b))
        ua, ub = a / ra[:, None], b / rb[:, None]
        light = ua[:, 2] / ra**2 * np.maximum(-(ua @ n), 0) * np.maximum(ub @ n, 0) * -ub[:, 2] / rb**2
        found[i, j] = (light * (velocity * (ua - ub)).sum(1)).sum() / light.sum()
    return found


@pytest.mark.parametrize("kind", ["single", "confocal"])
def test_mean_rate_of_a_hidden_plate(kind):
    out = tt.render(capture(kind), rates=RATES, spp=1 << 12, seed=0, temporal_filter="tent")
    light = out.rates[0].double()
    mean = (light.sum(1) * RATES.centers[:, None, None]).sum(0) / light.sum((0, 1))
    # Some 4096 samples of a plate whose rates differ by 1 m/s.
    np.testing.assert_allclose(mean.numpy(), mean_rates(kind), atol=3e-3)


@pytest.mark.parametrize(
    ("key", "step"),
    [pytest.param("hidden.velocity.angular", 1e-2, marks=pytest.mark.slow), ("hidden.to_world", 4e-3)],
)
def test_derivatives_behind_an_occluder(key, step):
    """Both modes against differences with the same samples, with the outline of the occluder in the pose's."""
    scene = capture("single", occluder=plate((0.05, 0.02, 0.5), (0.05, 0.02, 0.0), 0.12))
    renderer = tt.TransientRenderer(scene, [key], rates=RATES, spp=1 << 12, grad_seed="same", temporal_filter="tent")
    base = renderer.values[key].detach().clone()
    change = torch.randn(base.shape, generator=torch.Generator().manual_seed(1))
    if key.endswith("to_world"):
        change[3] = 0
    weights = torch.outer(torch.sin(0.2 * torch.arange(32.0)), torch.cos(0.13 * torch.arange(60.0)))[..., None, None]

    def loss(x, seed):
        return (renderer({key: base + x * change}, seed=seed).rates * weights).sum()

    found, differences = [], []
    for seed in range(4):
        x = torch.zeros((), requires_grad=True)
        loss(x, seed).backward()
        _, tangent = torch.func.jvp(lambda y, s=seed: loss(y, s), (torch.zeros(()),), (torch.ones(()),))
        torch.testing.assert_close(x.grad, tangent.detach(), rtol=1e-3, atol=1e-7)
        found.append(float(x.grad))
        with torch.no_grad():
            differences.append(float(loss(step, seed) - loss(-step, seed)) / (2 * step))
    error = np.hypot(np.std(found, ddof=1), np.std(differences, ddof=1)) / 2
    assert abs(np.mean(found) - np.mean(differences)) < 4 * error + 1e-3 * abs(np.mean(found))


@pytest.mark.parametrize("body", ["wall", "laser"])
def test_wall_and_laser_rest(body):
    moving = capture("single").moving({body: tt.Motion(linear=(0, 0, 1))})
    with pytest.raises(SceneError, match="the wall, its sensor and the laser rest"):
        tt.render(moving, rates=RATES, spp=4, seed=0)
