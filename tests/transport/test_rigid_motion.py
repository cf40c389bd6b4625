"""What moves with everything else changes no light: the derivative of every path is zero, not their mean alone."""

from __future__ import annotations

import pytest
import torch

import torchtransient as tt
from torchtransient.scenes import look_at, rotate, scale, translate

FILM = {"type": "transient_hdr_film", "width": 6, "height": 5, "temporal_bins": 64, "start_opl": 4.0,
        "bin_width_opl": 0.1, "rfilter": {"type": "box"}}  # fmt: skip
MOVING = ("sensor.to_world", "light.position", "lamp.to_world", "ball.to_world", "wall.to_world", "cube.to_world")


@pytest.fixture(scope="module")
def renderer():
    scene = {
        "type": "scene",
        "integrator": {"type": "transient_path", "max_depth": 4},
        "sensor": {"type": "perspective", "fov": 40, "near_clip": 1e-2, "film": FILM,
                   "to_world": look_at(origin=[0.3, 0.2, 4], target=[0, 0, 0], up=[0, 1, 0])},
        "light": {"type": "point", "position": [0.7, 0.4, 3.0], "intensity": 10.0},
        "lamp": {"type": "rectangle",
                 "to_world": translate([-0.8, 0.9, 2.5]) @ rotate([1, 0, 0], 150) @ scale(0.2),
                 "emitter": {"type": "area", "radiance": 10.0}},
        "ball": {"type": "sphere", "center": [0.6, -0.5, 0.4], "radius": 0.3},
        "wall": {"type": "rectangle", "to_world": scale([3, 3, 1]), "bsdf": {"type": "diffuse", "reflectance": 0.7}},
        "cube": {"type": "cube", "to_world": translate([-0.3, 0.1, 0.5]) @ rotate([0, 1, 0], 30) @ scale(0.3),
                 "bsdf": {"type": "roughplastic"}},
    }  # fmt: skip
    return tt.TransientRenderer(tt.load(scene, variant="llvm_ad_mono"), MOVING, spp=32)


def tangent(renderer, generator, keys):
    """(sum of the magnitudes of a render's bins, and of their derivatives by a motion of ``keys``)."""
    values = {key: renderer.values[key].detach() for key in keys}

    def rendered(x):
        motion = torch.eye(4) + x * generator
        moved = {k: motion @ v if v.ndim == 2 else motion[:3, :3] @ v + motion[:3, 3] for k, v in values.items()}
        return renderer(moved, seed=1).transient

    out, derivative = torch.func.jvp(rendered, (torch.zeros(()),), (torch.ones(()),))
    return float(out.detach().abs().sum()), float(derivative.detach().abs().sum())


def translation():
    generator = torch.zeros(4, 4)
    generator[:3, 3] = torch.tensor([0.6, -0.5, 0.3])
    return generator


def rotation():
    generator = torch.zeros(4, 4)
    generator[:3, :3] = torch.tensor([[0.0, -0.7, -0.5], [0.7, 0.0, -0.3], [0.5, 0.3, 0.0]])
    return generator


@pytest.mark.slow
@pytest.mark.parametrize(
    ("generator", "share"),
    [
        # Differences of displacements, some of which are 1 / r times as large: a few hundred roundings of 6e-8.
        (translation(), 2e-5),
        # Points nearer than the damping radius, 5 % of the scene's, are dragged along instead of turned.
        (rotation(), 1e-3),
    ],
    ids=["translate", "rotate"],
)
def test_a_scene_that_moves_as_a_whole(renderer, generator, share):
    light, still = tangent(renderer, generator, MOVING)
    _, one = tangent(renderer, generator, ("cube.to_world",))
    assert one > 0.5 * light
    assert still < share * one
