"""The boundary term of edges and shadows that a camera sees in plane mirrors and through slabs of glass."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.marks import long_rows
from torchtransient.testing.small_room import pose

VARIANT = "llvm_ad_mono"
CAMERA = np.diag([-1.0, 1, -1, 1]) + pose(0, 0, 4) - np.eye(4)
PATTERN = 0.3 + 0.7 * torch.rand(1, 1, 8, 8, generator=torch.Generator().manual_seed(3))
PLATE, MIRROR, SLAB = "plate.to_world", "mirror.to_world", "slab.vertex_positions"


def turned(degrees, axis=1):
    """A rotation around y, or another axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = np.eye(4)
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def diffuse(reflectance):
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}


def rectangle(to_world, bsdf):
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}


def scene(fov, start, light, shapes, depth):
    film = {"type": "transient_hdr_film", "width": 8, "height": 8, "rfilter": {"type": "box"}, "temporal_bins": 128,
            "start_opl": start, "bin_width_opl": 0.05}  # fmt: skip
    sensor = {"type": "perspective", "fov": fov, "near_clip": 1e-3, "to_world": CAMERA, "film": film}
    light = {"type": "point", "position": light, "intensity": 10.0}
    integrator = {"type": "transient_path", "max_depth": depth, "rr_depth": 100}
    return tt.load(
        {"type": "scene", "integrator": integrator, "sensor": sensor, "light": light} | shapes, variant=VARIANT
    )


def in_mirror(depth=3):
    """A mirror fills the picture: it shows a plate before a wall that shines, and the plate's shadow."""
    return scene(30, 10.0, [0.6, 0.6, 1.6], {
        "mirror": rectangle(turned(25) @ np.diag([2.0, 2, 2, 1]), {"type": "conductor"}),
        "wall": rectangle(pose(5, 0, 4) @ turned(-120) @ np.diag([4.0, 4, 4, 1]), diffuse(0.6))
        | {"emitter": {"type": "area", "radiance": 0.1}},
        "plate": rectangle(
            pose(2.4, 0.1, 2.2) @ turned(-125) @ turned(20, 2) @ np.diag([0.5, 0.35, 1, 1]), diffuse(0.3)
        ),
    }, depth)  # fmt: skip


def behind_glass(depth=5):
    """A plate before a wall, partly behind a slab of glass, which shows its own rims."""
    return scene(50, 4.0, [1.8, 1.5, 2.5], {
        "wall": rectangle(pose(scale=3.0), diffuse(0.6)),
        "plate": rectangle(
            pose(-0.2, 0.1, 1.2) @ turned(25) @ turned(20, 2) @ np.diag([0.5, 0.35, 1, 1]), diffuse(0.4)
        ),
        "slab": {"type": "cube", "to_world": pose(0, 0, 2) @ turned(25) @ turned(10, 0) @ np.diag([0.4, 0.5, 0.12, 1]),
                 "bsdf": {"type": "dielectric", "int_ior": 1.3}},
    }, depth)  # fmt: skip


def weighed(out):
    """The loss: a pattern of pixels times a sine of the time, so that nothing cancels."""
    times = torch.as_tensor(out.axis.centers_opl, dtype=torch.float32)
    return (out.transient * PATTERN * torch.sin(3 * times)[:, None, None]).sum()


def shift_of(value, direction):
    """The derivative of a pose, or of vertices, by how far it is moved along ``direction``."""
    direction = torch.tensor(direction)
    if value.shape == (4, 4):
        shift = torch.zeros(4, 4)
        shift[:3, 3] = direction
        return shift
    return direction.expand(value.numel() // 3, 3).reshape(value.shape)


def reverse(renderer, key, shift, seed):
    renderer.zero_grad()
    weighed(renderer(seed=seed)).backward()
    return float((renderer.values[key].grad * shift).sum())


@pytest.mark.slow
def test_both_modes_agree():
    """They draw the same samples. The mirror shows all of the derivative."""
    renderer = tt.TransientRenderer(in_mirror(), [PLATE], spp=16)
    base = renderer.values[PLATE].detach()
    shift = shift_of(base, (0.5, 0.6, -0.5))
    expected = reverse(renderer, PLATE, shift, 0)
    assert abs(expected) > 0.05

    def loss(x):
        return weighed(renderer({PLATE: base + x * shift}, seed=0))

    _, tangent = torch.func.jvp(loss, (torch.zeros(()),), (torch.ones(()),))
    assert float(tangent) == pytest.approx(expected, rel=1e-4)


CASES = [
    (in_mirror, 2, PLATE, (0.5, 0.6, -0.5)),
    (in_mirror, 3, PLATE, (0.5, 0.6, -0.5)),
    (in_mirror, 3, MIRROR, (0.3, 0.1, 1.0)),
    (behind_glass, 5, PLATE, (1.0, 0.3, 0.0)),
    (behind_glass, 5, SLAB, (0.0, 0.0, 1.0)),
]


@pytest.mark.parametrize(("make", "depth", "key", "direction"), long_rows(CASES, CASES[:1]))
def test_against_finite_differences(make, depth, key, direction):
    """Errors are those of 8 seeds."""
    spp, h = 64 if depth == 2 else 1024, 0.01
    renderer = tt.TransientRenderer(make(depth), [key], spp=spp, spp_boundary=2 * spp)
    base = renderer.values[key].detach()
    shift = shift_of(base, direction)
    found = [reverse(renderer, key, shift, seed) for seed in range(8)]
    with torch.no_grad():
        sides = [
            [float(weighed(renderer({key: base + s * h * shift}, seed=seed, spp=16 * spp))) for s in (1, -1)]
            for seed in range(8)
        ]
    expected = [(plus - minus) / (2 * h) for plus, minus in sides]
    error = np.hypot(np.std(found, ddof=1), np.std(expected, ddof=1)) / np.sqrt(8)
    assert np.mean(found) == pytest.approx(np.mean(expected), abs=4 * error)
    assert error < 0.2 * abs(np.mean(expected))
