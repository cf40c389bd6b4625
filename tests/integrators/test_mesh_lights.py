"""Lights on meshes with normals at their vertices: they shine as their faces do."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

import torchtransient as tt
from support.gradient_cases.cases_curves import file_of
from support.gradient_cases.scenes import camera, room, transform
from support.marks import long
from torchtransient.plugins.mitsuba_compat import has_smooth_shape

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


@pytest.mark.slow
def test_mitsuba_takes_the_interpolated_normal():
    """Fails when Mitsuba mends it: then ``has_smooth_shape`` can go."""
    sums = []
    for face_normals in (True, False):
        scene = lit_by_mesh(face_normals) | {"integrator": {"type": "path", "max_depth": 2}}
        scene["sensor"] = scene["sensor"] | {"film": {"type": "hdrfilm", "width": 8, "height": 8}}
        sums.append(float(np.sum(np.array(mi.render(mi.load_dict(scene), spp=1024, seed=1)))))
    assert abs(sums[0] - sums[1]) > 0.05 * sums[0]


def test_which_lights_have_normals_at_their_vertices():
    mi.set_variant(VARIANT)
    mesh = {"type": "obj", "filename": file_of("tilted.obj", TILTED)}
    shapes = [mesh | {"face_normals": True}, mesh, {"type": "rectangle"}, {"type": "sphere"}]
    lights = [shape | {"emitter": {"type": "area"}} for shape in shapes]
    shapes = [mi.load_dict(light) for light in lights]
    assert [has_smooth_shape(shape.emitter()) for shape in shapes] == [False, True, False, False]
    assert not has_smooth_shape(mi.load_dict({"type": "point"}))
