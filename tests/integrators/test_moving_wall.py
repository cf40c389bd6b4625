"""The gradient that a radiometric renderer does not have: the mean arrival time of a wall that moves.

Camera and light stand at one point, a distance h before the wall. A ray at angle t from the normal returns after
2 h / cos t with a radiance proportional to cos^3 t / h^2, so the mean arrival M of the whole picture is proportional to
h, and moving the wall towards the camera changes it by exactly -M / h.
"""

import pytest
import torch

import torchtransient as tt

VARIANT = "llvm_ad_rgb"
HEIGHT = 4.0


def look_at_wall(fov):
    flip = [[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, HEIGHT], [0, 0, 0, 1]]
    return {
        "type": "scene",
        "integrator": {"type": "transient_path", "max_depth": 2},
        "sensor": {
            "type": "perspective",
            "fov": fov,
            "near_clip": 0.5,
            "to_world": flip,
            "film": {
                "type": "transient_hdr_film",
                "width": 8,
                "height": 8,
                "rfilter": {"type": "box"},
                "temporal_bins": 200,
                "start_opl": 7.5,
                "bin_width_opl": 0.02,
            },
        },
        "light": {"type": "point", "position": [0.0, 0.0, HEIGHT], "intensity": 10.0},
        "wall": {
            "type": "rectangle",
            "to_world": [[3.0, 0, 0, 0], [0, 3.0, 0, 0], [0, 0, 3.0, 0], [0, 0, 0, 1]],
            "bsdf": {"type": "diffuse", "reflectance": 0.5},
        },
    }


@pytest.mark.slow
@pytest.mark.parametrize(("temporal_filter", "fov"), [("auto", 40.0), ("gaussian", 8.0)])
def test_mean_arrival_of_a_moving_wall(fov, temporal_filter):
    scene = tt.load(look_at_wall(fov))
    renderer = tt.TransientRenderer(
        scene, parameters=["wall.to_world"], spp=64, temporal_filter=temporal_filter, grad_seed="same"
    )
    z = torch.zeros((), requires_grad=True)
    pose = torch.diag(torch.tensor([3.0, 3.0, 3.0, 1.0])) + torch.nn.functional.one_hot(
        torch.tensor(2 * 4 + 3), 16
    ).reshape(4, 4) * z
    out = renderer({"wall.to_world": pose}, seed=0)
    centers = out.axis.centers_opl.float()
    histogram = out.transient.sum((0, 2, 3))
    mean = (histogram * centers).sum() / histogram.sum()
    mean.backward()
    expected = -mean.item() / HEIGHT
    assert expected < -2.0
    assert z.grad.item() == pytest.approx(expected, rel=1e-3)
