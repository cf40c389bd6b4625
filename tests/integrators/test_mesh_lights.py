"""Lights on meshes with normals at their vertices: they shine as their faces do."""

from __future__ import annotations

import numpy as np
import pytest

import torchtransient as tt
from support.gradient_cases.cases_curves import file_of
from support.gradient_cases.scenes import camera, room, transform
from support.marks import long

VARIANT = "llvm_ad_mono"
# Normals that stand 45 degrees off those of the faces.
TILTED = """v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vn -0.5 -0.5 0.7
vn 0.5 -0.5 0.7
vn 0.5 0.5 0.7
vn -0.5 0.5 0.7
f 1//1 2//2 3//3
f 1//1 3//3 4//4
"""


def lit_by_mesh(face_normals, integrator="transient_path"):
    light = {
        "type": "obj",
        "filename": file_of("tilted.obj", TILTED),
        "face_normals": face_normals,
        "to_world": transform().translate([1.2, 0.2, 1.5]).rotate([0, 1, 0], 200).scale(0.5),
        "emitter": {"type": "area", "radiance": 3.0},
    }
    scene = room(light=light, depth=3, sensor=camera(start=4.5))
    scene["integrator"]["type"] = integrator
    return scene


@pytest.mark.slow
@pytest.mark.parametrize("integrator", long(["transient_path", "transient_prbvolpath"], ["transient_path"]))
def test_brightness_does_not_depend_on_the_normals(integrator):
    """Its radiance is the same in all directions that the normals do not turn away."""
    found = []
    for face_normals in (True, False):
        scene = tt.load(lit_by_mesh(face_normals, integrator), variant=VARIANT)
        found.append([float(tt.render(scene, spp=2048, seed=seed).steady.double().sum()) for seed in range(4)])
    (a, b), error = np.mean(found, axis=1), np.hypot(*np.std(found, axis=1, ddof=1)) / 2
    # Mitsuba's density made it 20 % darker.
    assert abs(a - b) < 4 * error + 2e-4 * a and error < 5e-3 * a
