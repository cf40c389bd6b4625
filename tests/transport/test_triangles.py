"""Meshes that move, of several in a scene, and what draws points on shapes."""

from __future__ import annotations

import pytest
import torch

import torchtransient as tt
from support.gradient_cases.cases_curves import file_of
from support.gradient_cases.scenes import film, transform

VARIANT = "llvm_ad_mono"
SHEETS = {
    "two": "v -1 -1 0\nv 1 -1 0.2\nv 1 1 0\nv -1 1.5 0.1\nf 1 2 3\nf 1 3 4\n",
    "one": "v 2 -1 0\nv 4.5 -1 0.5\nv 2 1.5 0.3\nf 1 2 3\n",
    "still": "v -5 -1 0\nv -3 -1 0\nv -3 1 0\nf 1 2 3\n",
    "three": "v 5 -1 0\nv 7 -1 0.1\nv 7 1 0\nv 5 1 0.2\nv 6 3 0\nf 1 2 3\nf 1 3 4\nf 4 3 5\n",
}


def sheets():
    """Meshes side by side under a wall that the camera looks at, lit by a point: light goes by way of both."""
    pose = transform().look_at(origin=[1, 0, 3], target=[1, 0, 6], up=[0, 1, 0])
    wall = transform().translate([1, 0, 6]).rotate([0, 1, 0], 180).scale(6)
    grey = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": 0.6}}
    return {
        "type": "scene",
        "integrator": {"type": "transient_path", "max_depth": 3},
        "sensor": {"type": "perspective", "fov": 90, "to_world": pose, "film": film(4.0, 60, 0.5, 8)},
        "light": {"type": "point", "position": [1.5, 0.5, 4.0], "intensity": 300.0},
        "wall": {"type": "rectangle", "to_world": wall, "bsdf": grey},
        **{
            name: {"type": "obj", "filename": file_of(f"sheet {name}.obj", text), "face_normals": True, "bsdf": grey}
            for name, text in SHEETS.items()
        },
    }


@pytest.mark.filterwarnings("ignore:the derivative by")  # of edges, which are left out
def test_meshes_that_move_together_have_the_derivatives_of_each_alone():
    """Their points are looked up in one table, those of a mesh alone in its own buffer; the others stand still."""
    scene = tt.load(sheets(), variant=VARIANT)
    adjoint = torch.sin(torch.arange(60.0) * 0.7)[None, :, None, None]

    def gradients(*names):
        keys = [f"{name}.vertex_positions" for name in names]
        renderer = tt.TransientRenderer(scene, keys, spp=256, temporal_filter="tent", boundary=False)
        (renderer(seed=0).transient * adjoint).sum().backward()
        return [renderer.values[key].grad for key in keys]

    moving = ("two", "three")
    for name, found in zip(moving, gradients(*moving), strict=True):
        (expected,) = gradients(name)
        assert expected.shape[-2] == SHEETS[name].count("v") and expected.abs().amax(-1).min() > 1e-3
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4 * float(expected.abs().max()))
