"""Derivatives of light at one point of a wall, seen by a single ray: closed forms with little noise or none."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.gradient_cases.cases_curves import file_of
from support.runs import T

VARIANT = "llvm_ad_mono"
REFLECTANCE = "wall.bsdf.reflectance.value"


def scene(film, **objects):
    """A meter that looks at the origin, on a wall in z = 0."""
    film = {"width": 1, "height": 1, "rfilter": {"type": "box"}} | film
    sensor = {"type": "radiancemeter", "origin": [-1, 0, 1], "direction": [1, 0, -1], "film": film}
    integrator = {"type": "transient_path", "max_depth": 2}
    return tt.load({"type": "scene", "integrator": integrator, "sensor": sensor, **objects}, variant=VARIANT)


def test_phasors_of_a_wall_that_shines_itself():
    """Of two events at one vertex the one that the reflectance scales has its phase, not that of the other."""
    wall = {"type": "rectangle", "to_world": T().scale(3), "bsdf": {"type": "diffuse", "reflectance": 0.5},
            "emitter": {"type": "area", "radiance": 2.0}}  # fmt: skip
    lamp = {"type": "point", "position": [0, 0, 3], "intensity": 40.0}
    renderer = tt.TransientRenderer(
        scene({"type": "phasor_hdr_film", "frequencies": "0.3, 0.7"}, wall=wall, lamp=lamp), [REFLECTANCE], spp=2**16
    )
    weights = torch.tensor([2.0 + 1j, 3.0 - 5j])

    def loss(reflectance=None):
        values = {} if reflectance is None else {REFLECTANCE: torch.tensor(reflectance)}
        return (renderer(values, seed=0).phasor.ravel() * weights).real.sum()

    loss().backward()
    with torch.no_grad():
        expected = (loss(0.6) - loss(0.4)) / 0.2
    assert abs(expected) > 0.1  # each sample is of one light: half of them, to 0.4 %
    assert float(renderer.values[REFLECTANCE].grad) == pytest.approx(float(expected), rel=0.03)


@pytest.mark.filterwarnings("ignore:the derivative by")
def test_a_far_lamp_that_grows():
    """A triangle without texture coordinates: light goes by its area, whose derivative is twice that of its size."""
    corners = np.array([[-0.1, -0.1, 6.0], [0.0, 0.15, 6.0], [0.1, -0.05, 6.0]])
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "f 1 2 3\n"
    lamp = {"type": "obj", "filename": file_of("far lamp.obj", text), "face_normals": True,
            "emitter": {"type": "area", "radiance": 500.0}}  # fmt: skip
    wall = {"type": "rectangle", "to_world": T().scale(3), "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    film = {"type": "transient_hdr_film", "temporal_bins": 40, "bin_width_opl": 0.5, "start_opl": 0.0,
            "temporal_filter": "tent"}  # fmt: skip
    key = "lamp.vertex_positions"
    renderer = tt.TransientRenderer(scene(film, wall=wall, lamp=lamp), [key], spp=4096)
    out = renderer(seed=0).steady.sum()
    out.backward()
    away = torch.tensor(corners - corners.mean(0), dtype=torch.float32)
    found = float((renderer.values[key].grad.reshape(3, 3) * away).sum())
    assert out > 0.01
    assert found == pytest.approx(2 * out.item(), rel=0.01)
